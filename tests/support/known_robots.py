"""The Panda of pybullet's data, as a robot to upload: nothing of it is copied here."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pybullet_data

FOLDER = Path(pybullet_data.getDataPath())
PANDA = FOLDER / "franka_panda/panda.urdf"
KUKA = FOLDER / "kuka_iiwa/model.urdf"


def panda_zip() -> bytes:
    """The Panda's URDF and the meshes of its links."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.write(PANDA, "panda.urdf")
        for path in sorted((PANDA.parent / "meshes").rglob("*.obj")):
            archive.write(path, path.relative_to(PANDA.parent).as_posix())
    return stream.getvalue()
