"""Pictures of an object, and of a gripper at a grasp of it."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb_geometry.grippers import FINGER_MINUS, FINGER_PLUS, PALM, GripperShape
from graspdb_geometry.picturing import views
from graspdb_geometry.picturing.drawing import Stage
from graspdb_geometry.picturing.surfaces import Body, Floats
from graspdb_geometry.picturing.views import View

THING, FINGERS, STEEL = (0.70, 0.75, 0.81), (0.91, 0.46, 0.11), (0.39, 0.44, 0.51)
_SIDE = math.radians(-55.0), math.radians(24.0)
"""From where an object is seen unless somebody says: azimuth and elevation."""
_SIDES = 16
_ELEVATIONS = tuple(math.radians(angle) for angle in (12.0, 30.0))
_PALM_SHOWN = 0.45
"""So much of the palm is surely seen, in lengths of a finger and as wide as the open jaw: the whole would be
all that is."""
_SMALL = 64, 48
_FROM_HEIGHT = 180
"""Axes are drawn in pictures from this many pixels high on: in smaller ones they can't be read."""
_AXES = (("x", (204, 51, 63)), ("y", (28, 140, 60)), ("z", (32, 98, 201)))


@dataclass(frozen=True, eq=False)
class Held:
    """A gripper at a grasp: its shape, the tool's pose (4, 4) in the object frame, and how far open it is."""

    shape: GripperShape
    pose: Floats
    opening_m: float


def png(
    vertices: Floats,
    faces: NDArray[np.int64],
    held: Held | None,
    *,
    width: int,
    height: int,
    azimuth_deg: float | None = None,
    elevation_deg: float | None = None,
    breathe: Callable[[], None] = lambda: None,
) -> bytes:
    """A picture (PNG) of a mesh, vertices (v, 3) in metres and faces (n, 3), and of a gripper at a grasp.

    The object's z is upward; its axes are drawn in the corner of all but small ones. Seen from
    ``azimuth_deg``, about z from x, and ``elevation_deg`` above the x-y plane; without either a grasp from
    where its fingers are seen best.
    ``breathe`` is called every few milliseconds. The same arguments give the same bytes.

    ImportError without the extra ``pictures``.
    """
    thing = Body.of_mesh(vertices, faces, THING)
    bodies, shown = [thing], [thing.points]
    if held is not None:
        half, centres = held.shape.boxes(held.opening_m)
        colours = {FINGER_PLUS: FINGERS, FINGER_MINUS: FINGERS, PALM: STEEL}
        boxes = [Body.of_box(half[k], centres[k], held.pose, colours[k]) for k in range(3)]
        bodies += boxes
        depth = min(half[PALM][2], 0.5 * _PALM_SHOWN * held.shape.finger_length_m)
        front = centres[PALM] + np.array([0.0, 0.0, half[PALM][2] - depth])
        across = np.minimum(half[PALM][:2], 0.5 * held.shape.max_opening_m + held.shape.finger_thickness_m)
        near = Body.of_box(np.array([*across, depth]), front, held.pose, STEEL)
        shown += [boxes[FINGER_PLUS].points, boxes[FINGER_MINUS].points, near.points]
    from PIL import Image

    stage, points = Stage(bodies, breathe), np.concatenate(shown)
    aspect = width / height
    if held is None or azimuth_deg is not None or elevation_deg is not None:
        azimuth = _SIDE[0] if azimuth_deg is None else math.radians(azimuth_deg)
        elevation = _SIDE[1] if elevation_deg is None else math.radians(elevation_deg)
        view = views.view_from(points, azimuth, elevation, aspect)
    else:
        every = list(views.around(points, _ELEVATIONS, _SIDES, aspect))
        counts = np.array([stage.counted(view, *_SMALL) for view in every])
        view = views.best(every, held.pose[:3, 0], counts[:, 1], counts[:, 2], counts[:, 0])
    image = Image.fromarray(stage.draw(view, width, height))
    if height >= _FROM_HEIGHT:
        _add_axes(image, view)
    file = io.BytesIO()
    image.save(file, format="PNG")
    return file.getvalue()


def _add_axes(image: Any, view: View) -> None:
    """The object's axes in the lower left corner of a picture."""
    from PIL import Image, ImageDraw, ImageFont

    height = image.height
    long = 0.06 * height
    # Drawn four times as large, and made small again: Pillow's lines have steps.
    side = round(5.2 * long)
    scale = 4
    corner = image.crop((0, height - side, side, height)).resize((scale * side,) * 2)
    pen = ImageDraw.Draw(corner)
    font: Any = ImageFont.load_default(max(9.0, 0.04 * height) * scale)
    middle = np.array([0.42 * side, 0.58 * side]) * scale
    axes = view.axes
    # On white that one can see through, whatever is behind.
    plate = Image.new("L", corner.size, 0)
    radius = 1.65 * long * scale
    ImageDraw.Draw(plate).ellipse([*(middle - radius), *(middle + radius)], fill=150)
    corner.paste((255, 255, 255), mask=plate)
    for k in np.argsort(axes[2]):  # the farthest first
        name, colour = _AXES[k]
        tip = np.array([axes[0, k], -axes[1, k]]) * long * scale
        pen.line([*middle, *(middle + tip)], fill=colour, width=max(2, round(0.008 * height * scale)))
        pen.text(tuple(middle + 1.38 * tip), name, fill=colour, font=font, anchor="mm")
    image.paste(corner.resize((side, side), Image.Resampling.LANCZOS), (0, height - side))
