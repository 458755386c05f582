"""Write what was seen of a grasp: the end as PNG, or the whole as GIF or as numbered PNGs."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspdb_simworker import png

FRAME_S = 0.1
"""Time between the pictures of a film, shown as fast as it was."""


def write(path: Path, pictures: Sequence[NDArray[np.uint8]], caption: str = "") -> str:
    """Write pictures (height, width, 3) and say where; nothing without any.

    With Pillow the caption is written on the last one, the end, and the time on those before it.

    A ``.gif`` holds all of them if Pillow is there (it comes with the extra ``plot``), otherwise each
    becomes a PNG beside it with its number. Any other name gets the last one as PNG.
    """
    if not pictures:
        return ""
    if path.suffix.lower() != ".gif":
        path.write_bytes(png.encode(_captioned(pictures[-1], caption)))
        return str(path)
    if importlib.util.find_spec("PIL") is None:
        for number, picture in enumerate(pictures):
            path.with_name(f"{path.stem}-{number:03d}.png").write_bytes(png.encode(picture))
        return f"{path.with_name(path.stem)}-*.png (a GIF needs `pip install 'graspdb[plot]'`)"
    from PIL import Image

    texts = [f"{FRAME_S * (k + 1):.1f} s" for k in range(len(pictures) - 1)] + [caption]
    images = [Image.fromarray(_captioned(*both)) for both in zip(pictures, texts, strict=True)]
    # The end stays for a second and a half.
    durations = [round(1000 * FRAME_S)] * (len(images) - 1) + [1500]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
    return str(path)


def _captioned(picture: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """The picture with a text in its lower left corner; as it is without Pillow."""
    if not text or importlib.util.find_spec("PIL") is None:
        return picture
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    font = ImageFont.load_default(20)
    place = (14, picture.shape[0] - 36)
    left, top, right, bottom = pen.textbbox(place, text, font=font)
    pen.rectangle((left - 6, top - 5, right + 6, bottom + 5), fill=(255, 255, 255))
    pen.text(place, text, fill=(48, 50, 56), font=font)
    return np.asarray(image, dtype=np.uint8)
