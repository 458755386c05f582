"""The figure that explains a gripper's profile: every field where it is on the gripper's boxes."""

from __future__ import annotations

import io
import textwrap
from typing import Any

import numpy as np

from graspdb.figures.canvas import Axes, Figure, new_figure, place
from graspdb.figures.style import BLUE, GREEN, GREY, ORANGE
from graspdb.wire import GripperProfile
from graspdb.wire.base import Triple

_MM = 1e3
_FINGER, _PALM, _GHOST = "#cfe3f2", "#e4e4e4", "#f0a060"
_DPI = 130
_ARROW: dict[str, Any] = {"arrowstyle": "->", "color": BLUE, "shrinkA": 0, "shrinkB": 0}
#: Inches: both views together, how high they are at most, the words below, and between them.
_WIDE, _HIGH, _WORDS, _MARGIN = 10.6, 6.0, 3.2, 0.3
#: So many times as wide as the gripper is a view, for the dimensions beside it.
_ROOM, _NARROWEST_M = 1.6, 0.08

_MEANINGS = {
    "finger_mass_kg": "mass of one finger in the physics",
    "max_speed_m_s": "speed of each finger while it closes: half of that of the jaw",
    "max_acceleration_m_s2": "of each finger; leave it out for no limit",
    "force_n": "with which each finger presses; a data sheet's grip force is most often this one",
    "friction": "of the pads on the object, Coulomb's coefficient; rubber 0.8, plastic 0.3",
    "symmetric": "whether the fingers are alike: half a turn about z is the same grasp then",
    "frames": "more frames, each its pose in base, such as the robot's flange",
    "joints": "names in the robot's description, with their values open and closed",
    "source": "where the values are from",
    "unverified": "which of them nobody has checked",
}


_NOTES = (
    "Lengths are metres in a profile, millimetres here. tool: its origin is midway between the fingers, z"
    " points to the object, y is the closing direction. base: the link that the gripper's description begins"
    " with, or where it is screwed on; base_to_tool is the tool's pose in it. A finger's box may be that of"
    " its last centimetres, which touch the object. All that is behind the fingers is palm."
)


def draw_explained(profile: GripperProfile, name: str) -> Figure:
    """Draw it: the jaw from the front and from the side to one scale, and below what no drawing shows."""
    figure = new_figure()
    low, high = _heights(profile)
    widths = [
        2 * _ROOM * _half_width(profile),
        2 * _ROOM * _MM * max(profile.palm_size_m[0], _NARROWEST_M) / 2,
    ]
    scale = min(_WIDE / sum(widths), _HIGH / (high - low))
    tall = scale * (high - low)
    figure.set_size_inches(_WIDE + 3 * _MARGIN, _WORDS + tall + 0.9)
    left = _MARGIN + (_WIDE - scale * sum(widths)) / 2
    views = ("from the front: fingers close along the tool's y", "from the side")
    for draw, title, width in zip((_front, _side), views, widths, strict=True):
        axes = place(figure, left, _WORDS + 0.2, scale * width, tall)
        draw(axes, profile)
        axes.axis("off")
        axes.set_xlim(-width / 2, width / 2)
        axes.set_ylim(low, high)
        axes.set_title(title, fontsize=10)
        left += scale * width + _MARGIN
    figure.suptitle(f"{name}: the fields of its profile. The gripper points up; millimetres", fontsize=12)
    _words(figure, profile)
    return figure


def render_explained(profile: GripperProfile, name: str, format: str) -> bytes:
    """The figure as a PNG's or an SVG's bytes; the same for the same profile."""
    figure = draw_explained(profile, name)
    import matplotlib

    target = io.BytesIO()
    metadata = {"Date": None} if format == "svg" else {"Software": None}
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "graspdb"}):
        figure.savefig(target, format=format, dpi=_DPI, metadata=metadata)
    return target.getvalue()


def _half_width(profile: GripperProfile) -> float:
    fingers = profile.max_opening_m / 2 + profile.finger.thickness_m
    return _MM * max(fingers, profile.palm_size_m[1] / 2)


def _heights(profile: GripperProfile) -> tuple[float, float]:
    """Lowest and highest of what is drawn, in the tool frame, with room for the dimensions."""
    lowest = _lowest(profile)
    room = 0.14 * (_top(profile) - lowest)
    return lowest - 1.4 * room, _top(profile) + 1.9 * room


def _lowest(profile: GripperProfile) -> float:
    """Where the palm ends, or the frame that is farthest behind."""
    return min([_levels(profile)[0], *(_MM * at[2] for _, at in _behind(profile))])


def _top(profile: GripperProfile) -> float:
    """Where the tips are at most, and the tool's z axis ends."""
    ahead = [profile.tip_offset_m, *(tip.tip_offset_m for tip in profile.tip_offsets)]
    return max(_MM * max(ahead), _axis_length(profile))


def _axis_length(profile: GripperProfile) -> float:
    return 0.25 * _half_width(profile)


def _behind(profile: GripperProfile) -> list[tuple[str, Triple]]:
    """Frames behind the tool: their names and where the tool is in them, where that is straight ahead."""
    if profile.base_to_tool is None:
        return []
    found = []
    for name in profile.frames:
        if name != "tool":
            at = profile.in_tool(name).position
            if abs(at[0]) < 1e-3 and abs(at[1]) < 1e-3 and at[2] < 0:
                found.append((name, at))
    return found


def _levels(profile: GripperProfile) -> tuple[float, float, float]:
    """Heights of the palm's back, its face and the open tips above the tool's origin, millimetres."""
    tip = _MM * profile.tip_offset_m
    face = tip - _MM * profile.finger.length_m
    return face - _MM * profile.palm_size_m[2], face, tip


def _front(axes: Axes, profile: GripperProfile) -> None:
    bottom, face, tip = _levels(profile)
    half, thick = _MM * profile.max_opening_m / 2, _MM * profile.finger.thickness_m
    palm = _MM * profile.palm_size_m[1] / 2
    _rectangle(axes, -palm, bottom, 2 * palm, face - bottom, _PALM)
    for left in (-half - thick, half):
        _rectangle(axes, left, face, thick, tip - face, _FINGER)
    _arcs(axes, profile, face)
    outer = max(half + thick, palm)
    aside, gap = outer - half - thick, 0.12 * outer
    opening = _top(profile) - tip + 0.1 * outer
    _measure(axes, (-half, tip), (half, tip), "max_opening_m", 2 * half, off=(0, opening), above=True)
    _measure(axes, (half, face), (half + thick, face), "finger.thickness_m", thick, off=(0, -gap))
    length = half + thick, aside + gap
    _measure(axes, (length[0], face), (length[0], tip), "finger.length_m", tip - face, off=(length[1], 0))
    below = _lowest(profile) - bottom - 1.3 * gap
    _measure(axes, (-palm, bottom), (palm, bottom), "palm_size_m[1]", 2 * palm, off=(0, below))
    _measure(axes, (palm, bottom), (palm, face), "palm_size_m[2]", face - bottom, off=(outer - palm + gap, 0))
    _measure(
        axes, (-half - thick, 0), (-half - thick, tip), "tip_offset_m", tip, off=(-gap - aside, 0), left=True
    )
    axes.plot([-half - thick, half + thick], [0, 0], color=GREY, linewidth=0.6, linestyle=":")
    _frame(axes, 0, 0, _axis_length(profile), "tool", ("y", "z"))
    for number, (name, at) in enumerate(_behind(profile)):
        height = _MM * at[2]
        if name == "base":
            beside = -0.4 * outer
            _measure(axes, (beside, height), (beside, 0), "base_to_tool", -height, off=(0, 0), left=True)
            axes.plot([beside, 0], [height, height], color=BLUE, linewidth=0.6)
        label = "base" if name == "base" else f"frames.{name}"
        _frame(axes, 0, height, 0.0, label, None, shift=(6, 5 - 13 * number))


def _arcs(axes: Axes, profile: GripperProfile, face: float) -> None:
    """Where the tips are as the jaw closes, and the closed fingers."""
    if not profile.tip_offsets:
        return
    path = [(t.opening_m, t.tip_offset_m) for t in profile.tip_offsets]
    path = [*path, (profile.max_opening_m, profile.tip_offset_m)]
    thick = _MM * profile.finger.thickness_m
    for sign in (-1.0, 1.0):
        at = [sign * _MM * opening / 2 for opening, _ in path]
        axes.plot(
            at, [_MM * offset for _, offset in path], color=ORANGE, marker=".", markersize=3, linewidth=1
        )
    opening, offset = path[len(path) // 3]
    for left in (-_MM * opening / 2 - thick, _MM * opening / 2):
        _rectangle(axes, left, face, thick, _MM * offset - face, "none", edge=_GHOST, dashed=True)
    axes.annotate(
        "tip_offsets: tips move on arcs;\nthe tips' height at several openings",
        (_MM * opening / 2, _MM * offset),
        (_MM * profile.max_opening_m / 2 + 0.08 * _half_width(profile), _top(profile)),
        fontsize=8,
        color=ORANGE,
        arrowprops={"arrowstyle": "-", "color": ORANGE, "linewidth": 0.7},
        va="bottom",
    )


def _side(axes: Axes, profile: GripperProfile) -> None:
    bottom, face, tip = _levels(profile)
    palm, finger = _MM * profile.palm_size_m[0] / 2, _MM * profile.finger.width_m / 2
    _rectangle(axes, -palm, bottom, 2 * palm, face - bottom, _PALM)
    _rectangle(axes, -finger, face, 2 * finger, tip - face, _FINGER)
    size = max(palm, finger)
    over = _top(profile) - tip + 0.12 * size
    _measure(axes, (-finger, tip), (finger, tip), "finger.width_m", 2 * finger, off=(0, over), above=True)
    _measure(
        axes,
        (-palm, bottom),
        (palm, bottom),
        "palm_size_m[0]",
        2 * palm,
        off=(0, -0.18 * _half_width(profile)),
    )
    _frame(axes, 0, 0, _axis_length(profile), "tool", ("x", "z"), mirrored=True)


def _rectangle(
    axes: Axes,
    left: float,
    bottom: float,
    width: float,
    height: float,
    colour: str,
    *,
    edge: str = "0.35",
    dashed: bool = False,
) -> None:
    from matplotlib.patches import Rectangle

    style: dict[str, Any] = {"linestyle": "--"} if dashed else {}
    axes.add_patch(
        Rectangle((left, bottom), width, height, facecolor=colour, edgecolor=edge, linewidth=1, **style)
    )


def _measure(
    axes: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    name: str,
    millimetres: float,
    *,
    off: tuple[float, float],
    above: bool = False,
    left: bool = False,
) -> None:
    """A dimension: an arrow of two heads beside what it measures, with the field's name and value."""
    one, other = np.add(start, off), np.add(end, off)
    for corner, moved in ((start, one), (end, other)):
        axes.plot(*np.transpose([corner, moved]), color=BLUE, linewidth=0.6)
    axes.annotate(
        "",
        tuple(other),
        tuple(one),
        arrowprops=_ARROW | {"arrowstyle": "<->"},
    )
    middle = (one + other) / 2
    upright = abs(other[1] - one[1]) > abs(other[0] - one[0])
    text = f"{name}\n{millimetres:.4g}"
    if upright:
        place: dict[str, Any] = {"ha": "right" if left else "left", "va": "center"}
        gap = (-4, 0) if left else (4, 0)
    else:
        place = {"ha": "center", "va": "bottom" if above else "top"}
        gap = (0, 3 if above else -3)
    axes.annotate(text, tuple(middle), gap, textcoords="offset points", fontsize=8, color=BLUE, **place)


def _frame(
    axes: Axes,
    x: float,
    y: float,
    size: float,
    name: str,
    names: tuple[str, str] | None,
    *,
    mirrored: bool = False,
    shift: tuple[float, float] = (5, -11),
) -> None:
    """The origin of a frame, and its axes where they are drawn."""
    axes.plot([x], [y], marker="o", color=GREEN, markersize=4)
    if names is not None:
        sign = -1.0 if mirrored else 1.0
        for (dx, dy), axis in zip(((sign * size, 0.0), (0.0, size)), names, strict=True):
            axes.annotate(
                "",
                (x + dx, y + dy),
                (x, y),
                arrowprops=_ARROW | {"color": GREEN},
            )
            axes.annotate(axis, (x + dx, y + dy), (3, 3), textcoords="offset points", fontsize=9, color=GREEN)
    axes.annotate(name, (x, y), shift, textcoords="offset points", fontsize=9, color=GREEN)


def _words(figure: Figure, profile: GripperProfile) -> None:
    """Fields that have no place in a drawing: name, value and what it means."""
    told = {
        **{name: getattr(profile, name) for name in _MEANINGS},
        "max_acceleration_m_s2": profile.max_acceleration_m_s2 or "no limit",
        "symmetric": "yes" if profile.symmetric else "no",
        "frames": ", ".join(profile.frames),
        "joints": ", ".join(f"{n} {at.open:g}/{at.closed:g}" for n, at in profile.joints.items()) or "none",
        "source": profile.source or "nobody said",
        "unverified": "; ".join(text.partition(":")[0] for text in profile.unverified) or "nothing named",
    }
    width, high = figure.get_size_inches()
    down = _WORDS + 0.05
    for name, meaning in _MEANINGS.items():
        value = textwrap.wrap(str(told[name]), 64)[:2]
        y = down / high
        figure.text(_MARGIN / width, y, name, fontsize=8.5, color=BLUE, va="top", family="monospace")
        figure.text((_MARGIN + 2.0) / width, y, "\n".join(value), fontsize=8.5, va="top")
        figure.text((_MARGIN + 6.0) / width, y, meaning, fontsize=8.5, color=GREY, va="top")
        down -= 0.2 if len(value) < 2 else 0.34
    figure.text(_MARGIN / width, (down - 0.06) / high, textwrap.fill(_NOTES, 165), fontsize=8.5, va="top")
