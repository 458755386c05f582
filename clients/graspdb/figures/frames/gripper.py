"""A gripper as GraspDB has it: its boxes from three sides, its frames, and where a pose puts it.

Everything is drawn in the tool frame with the approach downwards, to scale; axes x, y, z of every frame are
vermilion, green and blue.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb import wire
from graspdb.figures.canvas import Axes, Figure, new_figure, place
from graspdb.figures.style import BLUE, GREEN, GREY, ORANGE
from graspdb.poses import matrices

Floats = NDArray[np.float64]

AXES = (ORANGE, GREEN, BLUE)
Space = Any
"""Matplotlib's axes in space, which have no types."""
_STEEL, _EDGE = "#B8C4CE", "#5B6770"
_HEIGHT_IN, _WIDTH_IN = 3.9, 4.0
_TOP_IN, _BOTTOM_IN = 0.55, 0.45
#: The corners of a box by its faces, for corners in the order of :func:`_corners`.
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
#: From the tool frame to the drawing, where the approach is downwards: half a turn about x.
_DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class _Triad:
    """Frames that have one origin, and their axes; ``pose`` (4, 4) is in the tool frame."""

    names: tuple[str, ...]
    pose: Floats


def draw_gripper(
    name: str,
    profile: wire.GripperProfile,
    *,
    pose: wire.Pose | None = None,
    frame: str = "tool",
    convention: wire.Convention = "graspdb",
) -> Figure:
    """A gripper's boxes and frames; with a ``pose`` of its ``frame`` in an object's, the gripper there, too.

    NoSuchFrame, ToolUnknown as :meth:`graspdb.wire.GripperProfile.in_tool`.
    """
    triads, fixed = _triads(profile), _matrix(profile.in_tool(frame, convention))
    if convention != "graspdb":
        triads.append(_Triad((f"{frame} as {convention}",), fixed))
    boxes = _boxes(profile)
    length = 0.22 * float(np.ptp(np.concatenate([_corners(*box) for box in boxes]), axis=0).max())
    panels = 3 if pose is None else 4
    figure = new_figure()
    figure.set_size_inches(panels * _WIDTH_IN, _HEIGHT_IN + _TOP_IN + _BOTTOM_IN)
    opening = f"{1e3 * profile.max_opening_m:.0f} mm open"
    figure.suptitle(f"{name}: {opening}; axes x, y, z of each frame vermilion, green, blue", fontsize=11)

    solid = _panel(figure, 0, projection="3d")
    _draw_solid(solid, boxes, triads, np.eye(4), length)
    _say(solid, "The gripper, approach downwards")
    front, side = _panel(figure, 1), _panel(figure, 2)
    _draw_side(front, boxes, triads, 1, length)
    _draw_side(side, boxes, triads, 0, length)
    _measure(front, profile)
    # One scale and one height for both.
    widest = max(np.ptp(axes.get_xlim()) for axes in (front, side)) / 2
    for axes in (front, side):
        middle = sum(axes.get_xlim()) / 2
        axes.set_xlim(middle - widest, middle + widest)
    if pose is not None:
        there = _matrix(pose) @ np.linalg.inv(fixed)
        _draw_there(_panel(figure, 3, projection="3d"), boxes, there, _matrix(pose), frame, length)
    return figure


def _panel(figure: Figure, number: int, **shared: Any) -> Axes:
    # A view with ticks needs room for them; one in space leaves much of its own.
    left, right, low, high = (-0.35, 0.35, 0.3, 0.4) if shared else (0.75, -0.1, 0.0, -0.1)
    return place(
        figure,
        number * _WIDTH_IN + left,
        _BOTTOM_IN - low,
        _WIDTH_IN + right - left,
        _HEIGHT_IN + low + high,
        **shared,
    )


def _boxes(profile: wire.GripperProfile) -> list[tuple[Floats, Floats]]:
    """Half extents and centre of each finger, wide open, and of the palm, tool frame."""
    finger = profile.finger
    half = np.array([finger.width_m, finger.thickness_m, finger.length_m]) / 2
    across = profile.max_opening_m / 2 + half[1]
    palm = np.array(profile.palm_size_m) / 2
    root = profile.tip_offset_m - finger.length_m
    fingers = [(half, np.array([0.0, side * across, root + half[2]])) for side in (1.0, -1.0)]
    return [*fingers, (palm, np.array([0.0, 0.0, root - palm[2]]))]


def _corners(half: Floats, centre: Floats) -> Floats:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.asarray(centre + signs * half)


def _triads(profile: wire.GripperProfile) -> list[_Triad]:
    """The frames that are known, those at one pose together."""
    names = profile.frames if "tool" in profile.frames else ["tool"]
    found: list[_Triad] = []
    for name in sorted(names, key=lambda name: (name != "tool", name != "base", name)):
        pose = _matrix(profile.in_tool(name))
        same = [triad for triad in found if np.abs(triad.pose - pose).max() < 1e-6]
        if same:
            found[found.index(same[0])] = _Triad((*same[0].names, name), pose)
        else:
            found.append(_Triad((name,), pose))
    return found


def _matrix(pose: wire.Pose) -> Floats:
    return matrices(pose.position, pose.quaternion_xyzw)


def _labels(triads: Sequence[_Triad], near: float) -> list[tuple[Floats, str]]:
    """Where frames' names stand: those whose origins lie together share a place."""
    places: list[tuple[Floats, list[str]]] = []
    for triad in triads:
        origin = triad.pose[:3, 3]
        shared = next((names for at, names in places if np.linalg.norm(at - origin) < near), None)
        if shared is None:
            places.append((origin, list(triad.names)))
        else:
            shared += triad.names
    return [(at, ", ".join(names)) for at, names in places]


def _draw_solid(
    axes: Space,
    boxes: Sequence[tuple[Floats, Floats]],
    triads: Sequence[_Triad],
    there: Floats,
    length: float,
) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]  # extra: plot

    axes.patch.set_visible(False)
    axes.computed_zorder = False
    shown = []
    for half, centre in boxes:
        corners = (_corners(half, centre) @ there[:3, :3].T + there[:3, 3]) @ _DOWN.T
        faces = [corners[list(face)] for face in _FACES]
        shown.append(corners)
        axes.add_collection3d(
            Poly3DCollection(faces, facecolor=_STEEL, edgecolor=_EDGE, linewidth=0.6, alpha=0.35, zorder=1)
        )
    for triad in triads:
        pose = there @ triad.pose
        origin = _DOWN @ pose[:3, 3]
        for axis, colour in enumerate(AXES):
            end = origin + length * (_DOWN @ pose[:3, axis])
            axes.plot(
                *np.stack([origin, end]).T, color=colour, linewidth=2.4, solid_capstyle="round", zorder=3
            )
            shown.append(end[None])
        axes.scatter(*origin[:, None], color="black", s=14, depthshade=False, zorder=4)
    for origin, text in _labels(triads, length / 4):
        at = _DOWN @ (there @ [*origin, 1.0])[:3]
        axes.text(*at, f"  {text}", fontsize=9, fontweight="bold", zorder=10)
    _frame_all(axes, np.concatenate(shown))


def _frame_all(axes: Space, points: Floats) -> None:
    """Equal scales about all there is, seen from the front, a little from above and the side."""
    middle, reach = (points.max(axis=0) + points.min(axis=0)) / 2, np.ptp(points, axis=0)
    reach = np.maximum(reach, 0.35 * reach.max())
    for limits, centre, size in zip(
        (axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, reach, strict=True
    ):
        limits(centre - 0.5 * size, centre + 0.5 * size)
    axes.set_box_aspect(tuple(reach), zoom=1.0)
    axes.view_init(elev=18, azim=-55)
    axes.set_axis_off()


def _draw_side(
    axes: Axes,
    boxes: Sequence[tuple[Floats, Floats]],
    triads: Sequence[_Triad],
    across: int,
    length: float,
) -> None:
    """The gripper's outline across one of the tool's axes and along its approach, in millimetres."""
    from matplotlib.patches import Rectangle

    for half, centre in boxes:
        low, size = centre - half, 2 * half
        corner = 1e3 * low[across], 1e3 * low[2]
        axes.add_patch(
            Rectangle(corner, 1e3 * size[across], 1e3 * size[2], facecolor=_STEEL, edgecolor=_EDGE, alpha=0.5)
        )
    for triad in triads:
        origin = 1e3 * triad.pose[[across, 2], 3]
        for axis, colour in enumerate(AXES):
            step = 1e3 * length * triad.pose[[across, 2], axis]
            if math.hypot(*step) > 0.15e3 * length:
                style = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
                axes.annotate("", xy=tuple(origin + step), xytext=tuple(origin), arrowprops=style)
        axes.plot(*origin, "o", color="black", markersize=4)
    for origin, text in _labels(triads, length / 4):
        at = 1e3 * origin[[across, 2]]
        axes.annotate(
            text, xy=tuple(at), xytext=(7, 7), textcoords="offset points", fontsize=9, weight="bold"
        )
    corners = 1e3 * np.concatenate([_corners(*box) for box in boxes])
    origins = 1e3 * np.array([triad.pose[:3, 3] for triad in triads])
    shown = np.concatenate([corners, origins, origins + 1e3 * length, origins - 0.3e3 * length])
    axes.set_xlim(shown[:, across].min() - 8, shown[:, across].max() + 8)
    axes.set_ylim(shown[:, 2].max() + 8, shown[:, 2].min() - 8)
    axes.set_aspect("equal")
    axes.set_xlabel(("x", "closing: y")[across] + " [mm]", fontsize=8)
    axes.set_ylabel("approach: z [mm], downwards", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set_title(("From the side", "From the front")[across] + ", tool frame", fontsize=9)


def _measure(axes: Axes, profile: wire.GripperProfile) -> None:
    """The opening between the fingertips."""
    half, tip = 0.5e3 * profile.max_opening_m, 1e3 * profile.tip_offset_m
    style = {"arrowstyle": "<->", "color": GREY, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=(-half, tip), xytext=(half, tip), arrowprops=style)
    axes.text(-0.5 * half, tip + 2.0, f"{2 * half:.0f} mm", ha="center", va="top", fontsize=8, color=GREY)


def _draw_there(
    axes: Space,
    boxes: Sequence[tuple[Floats, Floats]],
    there: Floats,
    pose: Floats,
    frame: str,
    length: float,
) -> None:
    """The gripper where the pose puts it, with the axes that the pose is in."""
    turned = np.eye(4)
    turned[:3, :3] = _DOWN.T  # the drawing turns the tool's approach downwards, and here z is upwards
    origin = _Triad(("object",), np.asarray(np.linalg.inv(there)))
    own = _Triad((frame,), np.asarray(np.linalg.inv(there) @ pose))
    _draw_solid(axes, boxes, [origin, own], turned @ there, length)
    axes.plot(*np.stack([np.zeros(3), pose[:3, 3]]).T, color=GREY, linewidth=1.0, linestyle="--")
    at = ", ".join(f"{x:.3f}" for x in pose[:3, 3])
    _say(axes, f"{frame} at {at} m\nin the object frame, z upwards")


def _say(axes: Space, title: str) -> None:
    axes.text2D(0.5, 0.94, title, transform=axes.transAxes, ha="center", fontsize=9)
