"""ACRONYM-like HDF5, and GraspGen's JSON: homogeneous matrices, and whether each grasp held."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from graspdb.interop.formats.acronym import HELD
from graspdb.interop.formats.source import extra
from graspdb.interop.grasps import Report
from graspdb.interop.writers.content import Content

_FLEX = ("closing_linear", "closing_angular", "shaking_linear", "shaking_angular")


def acronym(path: Path, content: Content, report: Report) -> None:
    """HDF5 with ACRONYM's names; what else is known of a grasp lies below ``grasps/qualities``."""
    h5py = extra("h5py", "HDF5")
    with h5py.File(path, "w") as file:
        file["grasps/transforms"] = content.poses.matrices
        file[f"grasps/qualities/flex/{HELD}"] = content.held(report).astype(np.int64)
        flex = {f"object_motion_during_{what}" for what in _FLEX}
        for name, values in content.qualities.items():
            if name != HELD:
                folder = "grasps/qualities/flex" if name in flex else "grasps/qualities"
                file[f"{folder}/{name}"] = values
        file["object/scale"] = 1.0
        file["object/file"] = content.object_name or ""
        file["gripper/type"] = content.gripper_name or ""
    report.map("outcome to object_in_gripper")
    content.left(report, *content.qualities)


def graspgen(path: Path, content: Content, report: Report) -> None:
    """GraspGen's training data: matrices and whether they held."""
    data = {
        "object": {"file": content.object_name or "", "scale": 1.0},
        "grasps": {
            "transforms": content.poses.matrices.tolist(),
            HELD: content.held(report).tolist(),
        },
    }
    path.write_text(json.dumps(data, allow_nan=False), encoding="utf-8")
    report.map("outcome to object_in_gripper")
    content.left(report, HELD)
