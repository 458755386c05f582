"""``graspdb robots``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graspdb.cli.common import State
from graspdb.cli.options import Commands, Numbers, vector_option
from graspdb.wire import RobotInfo

robots = Commands(no_args_is_help=True, help="Store, list, show and delete robots: arms by their URDFs.")

RobotId = Annotated[str, typer.Argument(help="Id of the robot.", show_default=False)]


@robots.command("put")
def put_robot(
    state: State,
    id: RobotId,
    file: Annotated[Path, typer.Argument(help="The robot's URDF, or a zip of it.", exists=True)],
    flange: Annotated[str, typer.Option(help="The link that the gripper is mounted on.")],
    meshes: Annotated[
        Path | None, typer.Option(help="Folder with its meshes; by default the URDF's and the one above.")
    ] = None,
    gripper_mount: Annotated[
        Numbers | None,
        vector_option("The gripper's base in the flange link.", "--gripper-mount", "x,y,z,qx,qy,qz,qw"),
    ] = None,
) -> None:
    """Store a robot, or replace it, with the meshes of its collision shapes."""
    sent = file.read_bytes() if file.suffix.lower() == ".zip" else file
    stored = state.db.robots.put(id, sent, flange=flange, meshes=meshes, gripper_mount=gripper_mount)
    told = f"Robot {stored.id} is stored: {len(stored.joints)} joints to {stored.flange}"
    told += f"; not tested for collisions: {', '.join(stored.untested)}" if stored.untested else ""
    state.show(stored, f"{told}.")


@robots.command("list")
def list_robots(state: State) -> None:
    """List the robots."""
    state.show_list(
        list(state.db.robots),
        {
            "id": lambda robot: robot.id,
            "name": lambda robot: robot.name,
            "joints": lambda robot: len(robot.joints),
            "flange": lambda robot: robot.flange,
            "not tested": lambda robot: ", ".join(robot.untested),
        },
        empty="No robots.",
    )


@robots.command("show")
def show_robot(state: State, id: RobotId) -> None:
    """Show a robot's joints with their limits, and which links are tested for collisions."""
    found = state.db.robots.get(id)
    state.show(found, _rows(found))


def _rows(robot: RobotInfo) -> dict[str, str]:
    def limits(lower: float | None, upper: float | None, unit: str) -> str:
        return "no limits" if lower is None or upper is None else f"{lower:g} to {upper:g} {unit}"

    rows = {"name": robot.name, "flange": robot.flange, "links": ", ".join(robot.links)}
    rows |= {
        f"joint {joint.name}": limits(joint.lower, joint.upper, "m" if joint.sliding else "rad")
        for joint in robot.joints
    }
    return rows | {"tested": ", ".join(robot.tested), "not tested": ", ".join(robot.untested) or "none"}


@robots.command("delete")
def delete_robot(state: State, id: RobotId) -> None:
    """Delete a robot."""
    state.db.robots.delete(id)
    state.show({"deleted": id}, f"{id} is deleted.")
