"""The formats that are read, and which of them a file has."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from graspdb.interop.formats import acronym, graspnet, isaac, messages, rosbags, scenes, tables
from graspdb.interop.formats.source import BOM, SourceFile, Wishes
from graspdb.interop.grasps import Raw, Report, problem
from graspdb.interop.outcomes import Rule

TIPS = "tips"
"""Stands for a frame where a format says how far the fingertips lie ahead of its origin."""


@dataclass(frozen=True)
class Format:
    """A format: who reads it, and what its poses are of; None where the format does not say.

    ``reference`` is what the poses are in, ``rule`` how its score becomes an outcome where nobody says,
    ``also`` what else such a file is asked for.
    """

    name: str
    read: Callable[[SourceFile, Wishes, Report], Iterator[Raw]]
    frame: str | None
    convention: str | None
    unit: str = "m"
    reference: str = "object"
    rule: Rule | None = None
    assumed: str | None = None
    table: bool = False
    also: str = ""


_HDF5 = Format("acronym", acronym.read_hdf5, "base", "acronym")
_ACRONYM_JSON = Format("acronym", acronym.read_json, "base", "acronym")
_GRASPGEN = Format("graspgen", acronym.read_graspgen, "base", "graspgen")
_ISAAC = Format("isaac", isaac.read, None, None, rule=Rule(isaac.CONFIDENCE, 0.5))
_GRASPNET = Format(
    "graspnet", graspnet.read_array, TIPS, "graspnet", reference="camera",
    also="; its scores are no outcomes: --success-from score --success-above X, too; and of several objects"
    " it takes one: --only object_id=N",
)  # fmt: skip
_LABELS = Format("graspnet", graspnet.read_labels, TIPS, "graspnet")
_VGN = Format(
    "vgn", tables.read_vgn, TIPS, "vgn", reference="scene",
    also="; and of several scenes it takes one: --only scene_id=ID",
)  # fmt: skip
_MULTIGRIPPER = Format("multigrippergrasp", messages.read_multigripper, "base", None)
_MOVEIT = Format("moveit", messages.read_moveit, "flange", "graspdb")
_BAG_GRASPS = Format("rosbag", rosbags.read_grasps, "flange", "graspdb")
_BAG_POSES = Format("rosbag", rosbags.read_poses, None, None)
_GRASPIT = Format(
    "graspit", scenes.read_graspit, "base", "graspdb", "mm", assumed="the robot's axes are those of the base"
)
_UIBK = Format("uibk", scenes.read_uibk, "tool", "graspdb", "mm")
_CSV = Format("csv", tables.read_csv, "tool", "graspdb", table=True)
_JSONL = Format("jsonl", tables.read_json_lines, "tool", "graspdb", table=True)
_PARQUET = Format("parquet", tables.read_parquet, "tool", "graspdb", table=True)

FORMATS = (
    *(
        "acronym",
        "graspgen",
        "isaac",
        "graspnet",
        "vgn",
        "multigrippergrasp",
        "moveit",
        "rosbag",
        "graspit",
        "uibk",
    ),
    *("csv", "jsonl", "parquet"),
)
"""The formats that are read, by name."""


def recognised(source: SourceFile, name: str, topic: str | None = None) -> Format:
    """The format of a file: of this name, or by its content (``auto``), of a bag by that of its ``topic``;
    one line says why none.
    """
    if name not in ("auto", *FORMATS):
        raise ValueError(f"format is {name!r}; expected auto or one of {', '.join(FORMATS)}")
    binary = _bag(source, topic) if source.bag is not None else _binary(source)
    if binary is not None:
        found: Format | None = binary
    elif name in ("auto", "acronym"):
        found = _text(source) if name == "auto" or source.suffix == ".json" else None
        found = found or (_ACRONYM_JSON if name == "acronym" else None)
    else:
        found = None
    if name == "auto":
        if found is None:
            raise problem(
                source.name, f"has no format that is known: name it (--format), {', '.join(FORMATS)}"
            )
        return found
    if found is not None and found.name != name:
        raise problem(source.name, f"is {found.name}, not {name}")
    if found is None and name in ("parquet", "rosbag"):
        raise problem(source.name, f"is no {'Parquet' if name == 'parquet' else 'bag of ROS'}")
    return found or _BY_NAME[name]


_BY_NAME = {
    "graspgen": _GRASPGEN,
    "isaac": _ISAAC,
    "graspnet": _GRASPNET,
    "vgn": _VGN,
    "multigrippergrasp": _MULTIGRIPPER,
    "moveit": _MOVEIT,
    "graspit": _GRASPIT,
    "uibk": _UIBK,
    "csv": _CSV,
    "jsonl": _JSONL,
}


def _bag(source: SourceFile, topic: str | None) -> Format:
    return _BAG_GRASPS if rosbags.has_grasps(source, topic) else _BAG_POSES


def _binary(source: SourceFile) -> Format | None:
    head = source.head
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        return _HDF5
    if head.startswith(b"\x93NUMPY"):
        return _GRASPNET
    if head.startswith(b"PK\x03\x04"):
        return _LABELS
    if head.startswith(b"PAR1"):
        return _PARQUET
    if head.startswith((b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")):
        raise problem(source.name, "is pickled, which is never read: save arrays or a table")
    expected = {".h5": "HDF5", ".hdf5": "HDF5", ".npy": ".npy", ".npz": ".npz", ".parquet": "Parquet"}
    if source.suffix in expected:
        raise problem(source.name, f"is no {expected[source.suffix]}, or not whole")
    return None


def _text(source: SourceFile) -> Format | None:
    head = source.head.removeprefix(BOM).lstrip()
    if head.startswith(b"<"):
        if source.root_tag == "world":
            return _GRASPIT
        return _UIBK if source.root_tag in ("experiments", "experiment", "grasps") else None
    if source.suffix in (".csv", ".tsv", ".txt"):
        return _VGN if tables.vgn_like(source) else _CSV
    if source.suffix in (".jsonl", ".ndjson"):
        return _JSONL
    if source.suffix in (".yaml", ".yml"):
        return source.judged(_of_data)
    if head[:1] in (b"{", b"["):
        if tables.many_texts(source):
            return _JSONL
        return source.judged(_of_data) or _JSONL
    if b"isaac_grasp" in head:
        return _ISAAC
    return None


def _of_data(data: Any) -> Format | None:
    """The format of an outline, as soon as that is told."""
    if isinstance(data, list):
        data = data[0] if data else None
    if not isinstance(data, dict):
        return None
    if data.get("format") == "isaac_grasp":
        return _ISAAC
    grasps = data.get("grasps")
    if "grasp_pose" in data or (isinstance(grasps, list) and grasps and "grasp_pose" in (grasps[0] or ())):
        return _MOVEIT
    if isinstance(grasps, dict) and "transforms" in grasps:
        return _GRASPGEN
    if "transforms" in data:
        return _ACRONYM_JSON
    if isinstance(data.get("pose"), list) and ("gripper" in data or "object_ID" in data):
        return _MULTIGRIPPER
    if isinstance(grasps, dict) and any(
        "body" in g and "pose" in g for g in grasps.values() if isinstance(g, dict)
    ):
        return _MULTIGRIPPER
    if isinstance(grasps, dict) and any("orientation" in g for g in grasps.values() if isinstance(g, dict)):
        return _ISAAC
    return None
