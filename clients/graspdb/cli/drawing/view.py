"""``graspdb view``: the web viewer, from this process until Ctrl-C."""

from __future__ import annotations

import contextlib
import importlib
import os
import threading
import webbrowser
from typing import Annotated

import typer

from graspdb.cli.common import ERRORS, State
from graspdb.cli.options import Numbers, vector_option
from graspdb.poses import as_vector7
from graspdb.processes import end_with_parent

PORT = 8080
_POSE = "x,y,z,qx,qy,qz,qw"


def view(
    state: State,
    id: Annotated[
        str | None, typer.Argument(metavar="[OBJECT]", help="The object to show first.", show_default=False)
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the page; 0: any that is free.")] = PORT,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on. Whoever reaches it sees what the viewer's key may read."),
    ] = "127.0.0.1",
    name: Annotated[
        list[str] | None,
        typer.Option(help="A name that the page is opened under, beside addresses and localhost; repeated."),
    ] = None,
    object_pose: Annotated[
        Numbers | None, vector_option("Where the object stands in the world.", "--object-pose", _POSE)
    ] = None,
    robot: Annotated[str | None, typer.Option(help="A stored robot that takes the grasps.")] = None,
    scene: Annotated[str | None, typer.Option(help="A stored scene that stands around.")] = None,
    robot_base_pose: Annotated[
        Numbers | None,
        vector_option(
            "The robot's root in the world; by default its origin, or beside the object without its pose.",
            "--robot-base-pose",
            _POSE,
        ),
    ] = None,
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = False,
) -> None:
    """Look at an object, its grasps and trials in a browser, and drag constraints about (extra `view`)."""
    end_with_parent()
    try:
        viewer = importlib.import_module("graspdb_viewer.serving")
    except ImportError as error:
        raise ImportError(f"the viewer needs {error.name}: pip install 'graspdb[view]'") from error
    key = state.api_key or os.environ.get("GRASPDB_API_KEY") or None
    start = importlib.import_module("graspdb_viewer.view").View(
        object=id,
        robot=robot,
        scene=scene,
        object_pose=_placed(object_pose, "object_pose"),
        robot_base=_placed(robot_base_pose, "robot_base_pose"),
    )
    with viewer.serving(state.db, host=host, port=port, view=start, names=name or (), api_key=key) as server:
        typer.echo(f"Look at {server.url} (Ctrl-C ends it)")
        if browser:
            webbrowser.open(server.url)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
    ERRORS.print("The viewer has ended.")


def _placed(pose: Numbers | None, name: str) -> dict[str, tuple[float, ...]] | None:
    if pose is None:
        return None
    values = as_vector7(pose, name)
    return {"position": values[:3], "quaternion_xyzw": values[3:]}
