"""The server: what agents are told first, its tools and its resources."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from graspdb import __version__
from graspdb.agents import guide
from graspdb.agents.asking import Questions
from graspdb.agents.changing import Changes
from graspdb.errors import GraspDBError
from graspdb.transport import Transport

if TYPE_CHECKING:
    from mcp.server.mcpserver import MCPServer

INSTRUCTIONS = """\
GraspDB keeps grasp trials (a gripper's pose relative to an object, and whether it held) and answers where to
grasp.

Units are metres and radians (degrees only in names that end in _deg); quaternions are x, y, z, w. A grasp is
the pose of the gripper's tool frame in the object's frame: origin midway between the fingers, z approach, y
closing. Robots are told where their flange goes: ask with frame="flange", and give object_pose (the object in
the robot's base) to get each grasp's `world` pose and to have constraints in the robot's base. Tool `frames`
says which frames there are.

A density is not a probability: say success_probability with its interval; null means that too little was
tried near there. Pass on `warnings`, `status` and `prior`: a grasp marked prior comes from the shape alone.
The resource graspdb://guide has the user guide.
"""


def build_server(transport: Transport, *, write: bool = False) -> MCPServer[Any]:
    """A server whose tools ask through ``transport``; ``write`` adds what stores trials and starts sweeps.

    ImportError names the extra that is missing.
    """
    try:
        from mcp.server.mcpserver import MCPServer
    except ImportError as error:
        raise ImportError("the server for agents needs mcp: pip install 'graspdb[mcp]'") from error
    server: MCPServer[Any] = MCPServer(
        "graspdb", title="GraspDB", instructions=INSTRUCTIONS, version=__version__, log_level="WARNING"
    )
    for question in Questions(transport).tools():
        _add_tool(server, question, reads=True)
    if write:
        for change in Changes(transport).tools():
            _add_tool(server, change, reads=False)
    guide.add_resources(server, transport)
    return server


def _add_tool(server: MCPServer[Any], method: Callable[..., Any], *, reads: bool) -> None:
    """The method as a tool: refusals reach the agent in the service's words, to act on."""
    from mcp.server.mcpserver.exceptions import ToolError
    from mcp_types import ToolAnnotations

    @functools.wraps(method)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return method(*args, **kwargs)
        except (GraspDBError, ImportError, TimeoutError, ValueError) as error:
            raise ToolError(str(error)) from error

    hints = ToolAnnotations(read_only_hint=reads, destructive_hint=False, open_world_hint=False)
    server.add_tool(call, annotations=hints)
