"""An object's mesh as triangles in metres."""

from __future__ import annotations

import io

import numpy as np
import trimesh

from graspdb.files.trials import METRES
from graspdb.wire import MeshInfo
from graspdb_viewer.scene.shapes import Shape

_FILE_TYPES = {"model/stl": "stl", "model/obj": "obj", "model/ply": "ply", "model/gltf-binary": "glb"}


def triangles(content: bytes, info: MeshInfo) -> Shape:
    """The file that was uploaded, in the object frame, metres; ValueError if trimesh can't read it."""
    try:
        scene = trimesh.load_scene(io.BytesIO(content), file_type=_FILE_TYPES[info.media_type])
        mesh = scene.to_mesh()
    except Exception as error:
        raise ValueError(f"trimesh can't read this mesh ({info.media_type}): {error}") from error
    factor = info.scale * METRES[info.unit]
    return Shape(factor * np.asarray(mesh.vertices), np.asarray(mesh.faces))
