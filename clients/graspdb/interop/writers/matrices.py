"""ACRONYM-like HDF5, and GraspGen's JSON: homogeneous matrices, and whether each grasp held."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from graspdb.interop.formats.acronym import HELD
from graspdb.interop.grasps import Report
from graspdb.interop.parsing.events import extra
from graspdb.interop.writers.content import Content

_FLEX = ("closing_linear", "closing_angular", "shaking_linear", "shaking_angular")


def acronym(path: Path, contents: Iterator[Content], report: Report) -> None:
    """HDF5 with ACRONYM's names; what else is known of a grasp lies below ``grasps/qualities``."""
    h5py = extra("h5py", "HDF5")
    report.map("outcome to object_in_gripper")
    with h5py.File(path, "w") as file:
        for content in contents:
            _append(file, "grasps/transforms", content.poses.matrices)
            _append(file, f"grasps/qualities/flex/{HELD}", content.held(report).astype(np.int64))
            flex = {f"object_motion_during_{what}" for what in _FLEX}
            for name, values in content.qualities.items():
                if name != HELD:
                    folder = "grasps/qualities/flex" if name in flex else "grasps/qualities"
                    _append(file, f"{folder}/{name}", values)
            content.left(report, *content.qualities)
        file["object/scale"] = 1.0
        file["object/file"] = content.object_name or ""
        file["gripper/type"] = content.gripper_name or ""


def _append(file: Any, name: str, values: Any) -> None:
    """Add rows to an array of the file, which is made with the first ones."""
    if name not in file:
        file.create_dataset(name, data=values, maxshape=(None, *values.shape[1:]))
        return
    data = file[name]
    data.resize(len(data) + len(values), axis=0)
    data[-len(values) :] = values


def graspgen(path: Path, contents: Iterator[Content], report: Report) -> None:
    """GraspGen's training data: matrices and whether they held."""
    report.map("outcome to object_in_gripper")
    held: list[bool] = []
    with path.open("w", encoding="utf-8") as file:
        for content in contents:
            if not held:
                about = json.dumps({"file": content.object_name or "", "scale": 1.0})
                file.write(f'{{"object": {about}, "grasps": {{"transforms": [')
            for matrix in content.poses.matrices.tolist():
                file.write(f"{', ' if held else ''}{json.dumps(matrix, allow_nan=False)}")
                held.append(True)
            held[content.first :] = content.held(report).tolist()
            content.left(report, HELD)
        file.write(f'], "{HELD}": {json.dumps(held)}}}}}')
