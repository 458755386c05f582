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


def write(path: Path, pictures: Sequence[NDArray[np.uint8]]) -> str:
    """Write pictures (height, width, 3) and say where; nothing without any.

    A ``.gif`` holds all of them if Pillow is there (it comes with the extra ``plot``), otherwise each
    becomes a PNG beside it with its number. Any other name gets the last one as PNG.
    """
    if not pictures:
        return ""
    if path.suffix.lower() != ".gif":
        path.write_bytes(png.encode(pictures[-1]))
        return str(path)
    if importlib.util.find_spec("PIL") is None:
        for number, picture in enumerate(pictures):
            path.with_name(f"{path.stem}-{number:03d}.png").write_bytes(png.encode(picture))
        return f"{path.with_name(path.stem)}-*.png (a GIF needs `pip install 'graspdb[plot]'`)"
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    # The end stays for a second and a half.
    durations = [round(1000 * FRAME_S)] * (len(images) - 1) + [1500]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
    return str(path)
