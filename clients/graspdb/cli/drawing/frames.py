"""``graspdb frames``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graspdb import wire
from graspdb.cli.common import State, numbers
from graspdb.cli.options import Numbers, vector_option
from graspdb.figures import FILE_FORMATS
from graspdb.figures.frames.gripper import draw_gripper
from graspdb.poses import as_poses
from graspdb.resources.selection import PoseFrame


def frames(
    state: State,
    id: Annotated[str, typer.Argument(metavar="GRIPPER", show_default=False)],
    pose_frame: PoseFrame,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The .png or .svg file to write [GRIPPER.svg].", dir_okay=False),
    ] = None,
    pose: Annotated[
        Numbers | None, vector_option("A grasp to draw the gripper at.", "--pose", "x,y,z,qx,qy,qz,qw")
    ] = None,
) -> None:
    """Draw a gripper and its frames, and where a grasp of --frame in the object's frame puts it."""
    output = output or Path(f"{id.partition('@')[0]}.svg")
    suffix = output.suffix.lower()
    if suffix not in FILE_FORMATS:
        raise typer.BadParameter("figures are .png or .svg files", param_hint="--output")
    named, axes = pose_frame.get("frame") or "tool", pose_frame.get("convention") or "graspdb"
    if axes not in wire.CONVENTIONS:
        there_are = ", ".join(wire.CONVENTIONS)
        raise typer.BadParameter(f"{axes!r} is none of {there_are}", param_hint="--convention")
    found = state.db.grippers.get(id)
    placed = None
    if pose is not None:
        (position,), (quaternion,) = as_poses(pose)
        placed = wire.Pose(position=position.tolist(), quaternion_xyzw=quaternion.tolist())
    figure = draw_gripper(found.id, found.profile, pose=placed, frame=named, convention=axes)
    # No date: a file that is drawn again differs only where the gripper does.
    metadata = {"Date": None} if suffix == ".svg" else {"Software": None}
    figure.savefig(output, format=FILE_FORMATS[suffix], dpi=120, metadata=metadata)
    rows = {
        f"{name} in the base": f"{numbers(at.position)} m, {numbers(at.quaternion_xyzw)}"
        for name, at in found.profile.frames.items()
    }
    if found.profile.base_to_tool is None:
        rows["tool in the base"] = "not known: frames but the tool's can't be used"
    state.show({"file": output, "frames": found.profile.frames}, {**rows, "drawn": str(output)})
