"""Gripper and object as URDF, the one way in which pybullet gives shapes the faces that flat contact needs.

A shape made by a call touches another in one point a step, and gathers more only as it turns: enough
for the balance of forces, too little for what two faces on each other resist, a turn about their normal.
With faces known, two of them touch in a whole polygon at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from graspdb_simworker.simulation.bodies import Gripper, MassProperties, Part, Vector, obj_of_parts

_NO_INERTIA = (
    '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def write_object(folder: Path, parts: Sequence[Part], mass: MassProperties) -> Path:
    """Write the object, in its principal frame, with one mesh a part; the path of the URDF."""
    shapes = []
    for number, part in enumerate(parts):
        mesh = folder / f"part{number}.obj"
        mesh.write_text(obj_of_parts([part], mass), encoding="ascii")
        shapes.append(_shape(f'<mesh filename="{mesh}"/>', (0.93, 0.62, 0.25)))
    x, y, z = mass.inertia
    inertia = (
        f'<inertial><mass value="{mass.mass_kg!r}"/>'
        f'<inertia ixx="{x!r}" iyy="{y!r}" izz="{z!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    path = folder / "object.urdf"
    path.write_text(
        f'<robot name="object"><link name="object">\n{inertia}\n{_lines(shapes)}\n</link></robot>',
        encoding="ascii",
    )
    return path


def write_gripper(folder: Path, gripper: Gripper) -> Path:
    """Write a palm and two fingers on prismatic joints that open with rising position; the path of the
    URDF. The base is the palm's centre."""
    finger, palm = gripper.finger_half_extents, gripper.palm_half_extents
    lines = [f'<link name="palm">{_NO_INERTIA}{_box(palm, (0.55, 0.58, 0.62))}</link>']
    # Prismatic joints: a finger's moments of inertia never matter.
    mass = f'<inertial><mass value="{gripper.finger_mass_kg!r}"/>' + (
        '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    height = gripper.tip_offset_m - finger[2] - gripper.palm_centre_z
    for number, side in enumerate((-1.0, 1.0)):
        lines.append(f'<link name="finger{number}">{mass}{_box(finger, (0.25, 0.30, 0.38))}</link>')
        lines.append(
            f'<joint name="joint{number}" type="prismatic">\n'
            f'<parent link="palm"/><child link="finger{number}"/>\n'
            f'<origin xyz="0 {side * finger[1]!r} {height!r}"/><axis xyz="0 {side!r} 0"/>'
            '<limit lower="-1" upper="1" effort="100000" velocity="100"/></joint>'
        )
    path = folder / "gripper.urdf"
    path.write_text(f'<robot name="gripper">\n{_lines(lines)}\n</robot>', encoding="ascii")
    return path


def _lines(elements: Sequence[str]) -> str:
    """One below the other: pybullet's parser loses itself in lines beyond a thousand characters."""
    return "\n".join(elements)


def _box(half_extents: Vector, colour: Vector) -> str:
    x, y, z = (2.0 * extent for extent in half_extents)
    return _shape(f'<box size="{x!r} {y!r} {z!r}"/>', colour)


def _shape(geometry: str, colour: Vector) -> str:
    r, g, b = colour
    material = f'<material name="m{r}"><color rgba="{r} {g} {b} 1"/></material>'
    return (
        f"<collision><geometry>{geometry}</geometry></collision>\n"
        f"<visual><geometry>{geometry}</geometry>{material}</visual>"
    )
