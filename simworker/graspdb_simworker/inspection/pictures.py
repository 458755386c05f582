"""One grasp to look at: simulated where it can be seen, written as a picture of its end or as a film."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from graspdb.wire import Pose, SimulatePayload
from graspdb_geometry import collision
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.bodies import Part
from graspdb_simworker.simulation.labels import Label, Outcome

FRAME_S = 0.1
"""Time between the pictures of a film, shown as fast as it was."""


@dataclass(frozen=True)
class SeenGrasp:
    """A grasp's label, and pictures (height, width, 3) where physics was needed, the end last."""

    label: Label
    pictures: Sequence[NDArray[np.uint8]]


def simulate_one(
    payload: SimulatePayload, parts: Sequence[Part], pose: Pose, *, film_every_s: float = math.inf
) -> SeenGrasp:
    """Simulate one grasp, with a picture of its end, and before it one at every interval."""
    with closing(chunks.prepare(payload, parts, visible=True, film_every_s=film_every_s)) as workpiece:
        position, quaternion = np.array([pose.position]), np.array([pose.quaternion_xyzw])
        codes, travel = workpiece.classify(position, quaternion)
        if codes[0] == collision.COLLIDES:
            return SeenGrasp(Label(Outcome.COLLISION, workpiece.gripper.max_opening_m, 0.0), [])
        if codes[0] == collision.EMPTY:
            return SeenGrasp(Label(Outcome.MISSED, 0.0, 0.0), [])
        label = workpiece.simulate(position[0], quaternion[0], float(travel[0]))
        return SeenGrasp(label, list(workpiece.world.pictures))


def write(path: Path, pictures: Sequence[NDArray[np.uint8]], caption: str = "") -> str:
    """Write a film to a ``.gif``, to any other name the end as PNG, and say where; nothing without pictures.

    The caption is written on the last one, the end, and the time on those before it.
    """
    if not pictures:
        return ""
    if path.suffix.lower() != ".gif":
        _captioned(pictures[-1], caption).save(path, format="PNG")
        return str(path)
    texts = [f"{FRAME_S * (k + 1):.1f} s" for k in range(len(pictures) - 1)] + [caption]
    images = [_captioned(*both) for both in zip(pictures, texts, strict=True)]
    # The end stays for a second and a half.
    durations = [round(1000 * FRAME_S)] * (len(images) - 1) + [1500]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
    return str(path)


def _captioned(picture: NDArray[np.uint8], text: str) -> Image.Image:
    """The picture with a text in its lower left corner."""
    image = Image.fromarray(picture)
    if text:
        pen = ImageDraw.Draw(image)
        font = ImageFont.load_default(20)
        place = (14, picture.shape[0] - 36)
        left, top, right, bottom = pen.textbbox(place, text, font=font)
        pen.rectangle((left - 6, top - 5, right + 6, bottom + 5), fill=(255, 255, 255))
        pen.text(place, text, fill=(48, 50, 56), font=font)
    return image
