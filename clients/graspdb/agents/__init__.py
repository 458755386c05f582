"""GraspDB for agents: a server of the Model Context Protocol that asks a GraspDB service.

It is a client like any other, by the public API alone: whoever starts it lends it a key, and by default it
only reads. Needs the ``mcp`` package (extra ``mcp``).
"""

from graspdb.agents.server import build_server

__all__ = ["build_server"]
