"""What is written is read back exactly, and what a format cannot say is reported."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb import interop
from graspdb.interop.grasps import FileGrasps
from graspdb.resources.results import PoseArrays
from graspdb.wire import OUTCOMES, GripperProfile

ENDS = {
    "acronym": ".h5",
    "graspgen": ".json",
    "isaac": ".yaml",
    "moveit": ".json",
    "rosbag": "",
    "csv": ".csv",
    "jsonl": ".jsonl",
    "parquet": ".parquet",
}
TABLES = ("csv", "jsonl", "parquet")
#: What has to be said to read what these formats leave open.
SAID: dict[str, dict[str, Any]] = {
    "isaac": {"frame": "base", "convention": "graspdb"},
    "moveit": {"frame": "base", "success_from": "grasp_quality", "success_above": 0.5},
}
SAID["rosbag"] = SAID["moveit"]
#: What has one score, which is then success, unless told otherwise.
MOVEITS = ("moveit", "rosbag")


@pytest.fixture(scope="module")
def gripper() -> GripperProfile:
    """A gripper whose base is turned against its tool."""
    return GripperProfile.model_validate(
        {
            "max_opening_m": 0.08,
            "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.045},
            "palm_size_m": [0.06, 0.2, 0.06],
            "base_to_tool": {"position": [0.01, -0.02, 0.1], "quaternion_xyzw": [0.1, 0.2, 0.3, 0.927361849]},
        }
    )


def _grasps(seed: int, outcomes: list[str]) -> FileGrasps:
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(len(outcomes), 4))
    return FileGrasps(
        rng.uniform(-0.3, 0.3, (len(outcomes), 3)),
        turns / np.linalg.norm(turns, axis=1, keepdims=True),
        np.array([OUTCOMES.index(name) for name in outcomes], dtype=np.uint8),  # type: ignore[arg-type]
        {"force": rng.normal(size=len(outcomes)), "quality": rng.normal(size=len(outcomes))},
        {
            "width_m": [0.01 * i for i in range(len(outcomes))],
            "measured_at": [datetime(2026, 1, 2, 3, i, tzinfo=UTC) for i in range(len(outcomes))],
        },
    )


def _written(folder: Path, grasps: FileGrasps, format: str, gripper: GripperProfile) -> FileGrasps:
    """The same grasps, through a file of this format."""
    path = folder / f"{len(list(folder.iterdir()))}{ENDS[format]}"
    frame = "base" if format in MOVEITS else None
    qualities = {} if format in MOVEITS else None
    report = interop.write(path, grasps, format=format, frame=frame, gripper=gripper, qualities=qualities)
    assert report.grasps == len(grasps)
    return interop.read(path, gripper=gripper, **SAID.get(format, {}))


@settings(max_examples=2, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    outcomes=st.lists(st.sampled_from(["success", "failure"]), min_size=1, max_size=6),
)
@pytest.mark.parametrize(("first", "second"), list(itertools.product(ENDS, ENDS)))
def test_poses_and_success_go_through_every_pair(
    tmp_path_factory: pytest.TempPathFactory,
    gripper: GripperProfile,
    first: str,
    second: str,
    seed: int,
    outcomes: list[str],
) -> None:
    folder, grasps = tmp_path_factory.mktemp("pair"), _grasps(seed, outcomes)
    for format in (first, second):
        found = _written(folder, grasps, format, gripper)
        assert found.matrices == pytest.approx(grasps.matrices, abs=1e-9)
        assert found.outcomes.tolist() == outcomes
        grasps = found


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31), outcomes=st.lists(st.sampled_from(OUTCOMES), min_size=1, max_size=6))
@pytest.mark.parametrize(("first", "second"), list(itertools.product(TABLES, TABLES)))
def test_tables_keep_all(
    tmp_path_factory: pytest.TempPathFactory,
    gripper: GripperProfile,
    first: str,
    second: str,
    seed: int,
    outcomes: list[str],
) -> None:
    folder, grasps = tmp_path_factory.mktemp("table"), _grasps(seed, outcomes)
    found = _written(folder, _written(folder, grasps, first, gripper), second, gripper)
    assert found.position.tolist() == grasps.position.tolist()
    assert found.outcomes.tolist() == outcomes
    for name, values in grasps.qualities.items():
        assert found.qualities[name].tolist() == values.tolist()
    assert found.more["width_m"] == grasps.more["width_m"]
    times = [x if isinstance(x, datetime) else datetime.fromisoformat(x) for x in found.more["measured_at"]]
    assert times == grasps.more["measured_at"]


#: Formats that have the joints' values of each grasp.
POSTURES = ("isaac", "moveit", "rosbag", "csv", "jsonl")


@settings(max_examples=2, deadline=None)
@given(postures=st.lists(st.lists(st.floats(0.001, 0.04), min_size=4, max_size=4), min_size=1, max_size=4))
@pytest.mark.parametrize(("first", "second"), list(itertools.product(POSTURES, POSTURES)))
def test_postures_go_through_every_pair_that_has_them(
    tmp_path_factory: pytest.TempPathFactory,
    gripper: GripperProfile,
    first: str,
    second: str,
    postures: list[list[float]],
) -> None:
    ends = {"open": 0.04, "closed": 0.0}
    handed = GripperProfile.model_validate(gripper.model_dump() | {"joints": {"left": ends, "right": ends}})
    bare = _grasps(7, ["success"] * len(postures))
    told = [
        {"joints": {"left": a, "right": b}, "joints_before": {"left": c, "right": d}}
        for a, b, c, d in postures
    ]
    grasps = FileGrasps(bare.position, bare.quaternion_xyzw, bare.codes, bare.qualities, {"metadata": told})
    folder = tmp_path_factory.mktemp("postures")
    for format in (first, second):
        grasps = _written(folder, grasps, format, handed)
        for there, wanted in zip(grasps.more["metadata"], told, strict=True):
            for kind, values in wanted.items():
                assert there[kind] == pytest.approx(values, abs=1e-9)


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**31), convention=st.sampled_from(["graspdb", "acronym", "graspnet", "-z/x"]))
@pytest.mark.parametrize("format", TABLES)
def test_tables_say_of_which_frame_their_poses_are(
    tmp_path_factory: pytest.TempPathFactory, gripper: GripperProfile, format: str, seed: int, convention: str
) -> None:
    grasps = _grasps(seed, ["success", "slipped", "failure"])
    path = tmp_path_factory.mktemp("t") / f"g{ENDS[format]}"
    report = interop.write(path, grasps, frame="base", convention=convention, gripper=gripper)
    assert not report.dropped
    back = interop.read(path, gripper=gripper)
    assert back.matrices == pytest.approx(grasps.matrices, abs=1e-9)
    assert back.report is not None
    assert (back.report.frame, back.report.convention) == ("base", convention)
    with pytest.raises(ValueError, match="gripper"):
        interop.read(path)
    # What somebody says counts more, and it is told that the file says otherwise.
    said = interop.read(path, gripper=gripper, frame="tool").report
    assert said is not None
    assert any("though the file says base" in line for line in said.assumed)


def test_a_table_of_several_frames_is_refused(tmp_path: Path, gripper: GripperProfile) -> None:
    grasps = _grasps(1, ["success"])
    lines = []
    for frame in ("base", "tool"):
        interop.write(tmp_path / "one.csv", grasps, frame=frame, convention="acronym", gripper=gripper)
        lines += (tmp_path / "one.csv").read_text().splitlines()[bool(lines) :]
    (tmp_path / "both.csv").write_text("\n".join(lines))
    with pytest.raises(ValueError, match="several frames"):
        interop.read(tmp_path / "both.csv", gripper=gripper)


def test_acronym_keeps_numbers_by_name(tmp_path: Path, gripper: GripperProfile) -> None:
    grasps = _grasps(3, ["success", "failure"])
    found = _written(tmp_path, grasps, "acronym", gripper)
    assert found.qualities["force"] == pytest.approx(grasps.qualities["force"], abs=0)


@pytest.mark.parametrize(
    ("format", "dropped"),
    [
        ("graspgen", ("why a grasp failed (slipped)", "force, quality, width_m, measured_at")),
        ("acronym", ("why a grasp failed (slipped)", "width_m, measured_at")),
        ("isaac", ("why a grasp failed (slipped)", "joints' values", "force, quality")),
        ("moveit", ("postures", "quality, width_m, measured_at")),
        ("rosbag", ("postures", "quality, width_m, measured_at")),
    ],
)
def test_what_a_format_cannot_say_is_reported(
    tmp_path: Path, gripper: GripperProfile, format: str, dropped: tuple[str, ...]
) -> None:
    grasps = _grasps(3, ["success", "slipped"])
    report = interop.write(
        tmp_path / f"a{ENDS[format]}", grasps, format=format, frame="base", gripper=gripper
    )
    for told in dropped:
        assert any(told in line for line in report.dropped), report.dropped


def test_a_density_is_no_confidence(tmp_path: Path, gripper: GripperProfile) -> None:
    grasps = _grasps(1, ["success", "failure"])
    report = interop.write(
        tmp_path / "a.yaml", grasps, format="isaac", gripper=gripper, qualities={"density": [3e5, 1e4]}
    )
    assert "success to confidence 1, failure to 0" in report.mapped
    told = {"success_probability": [0.8, 0.3]}
    interop.write(tmp_path / "a.yaml", grasps, format="isaac", gripper=gripper, qualities=told)
    found = interop.read(tmp_path / "a.yaml", gripper=gripper, frame="base", convention="graspdb")
    assert found.qualities["confidence"].tolist() == [0.8, 0.3]


def test_what_cannot_be_written_leaves_no_file(tmp_path: Path, gripper: GripperProfile) -> None:
    grasps = _grasps(1, ["success"])
    for options, match in (
        ({"format": "stl"}, "expected one of"),
        ({"format": "moveit"}, "no frame flange"),
        ({"outcomes": ["perhaps"]}, "outcome 'perhaps'"),
        ({"qualities": {"a": [1.0, 2.0]}}, "quality 'a' has shape"),
        ({"frame": "wrist"}, "has no frame 'wrist'"),
    ):
        with pytest.raises(ValueError, match=match):
            interop.write(tmp_path / "a.csv", grasps, gripper=gripper, **options)
    with pytest.raises(ValueError, match="name it"):
        interop.write(tmp_path / "a.yaml", grasps, gripper=gripper)
    assert list(tmp_path.iterdir()) == []


def test_a_bag_has_poses_for_every_viewer_and_is_never_written_over(
    tmp_path: Path, gripper: GripperProfile
) -> None:
    grasps, bag = _grasps(5, ["success", "failure", "success"]), tmp_path / "bag"
    interop.write(bag, grasps, format="rosbag", frame="base", gripper=gripper, qualities={})
    told: dict[str, Any] = {"frame": "base", "convention": "graspdb", "outcome": "success"}
    # A bag says of plain poses neither frame nor axes, as isaac_grasp doesn't.
    with pytest.raises(ValueError, match="--frame and --convention"):
        interop.read(bag, gripper=gripper, only={"topic": "/grasps/poses"})
    poses = interop.read(bag, gripper=gripper, only={"topic": "/grasps/poses"}, **told)
    assert poses.matrices == pytest.approx(grasps.matrices, abs=1e-9)
    beside = interop.read(next(bag.glob("*.db3")), gripper=gripper, **SAID["rosbag"])
    assert beside.outcomes.tolist() == ["success", "failure", "success"]
    with pytest.raises(ValueError, match=r"has no topic .* /grasps/poses"):
        interop.read(bag, gripper=gripper, only={"topic": "/tf"}, **told)
    with pytest.raises(ValueError, match="exists already"):
        interop.write(bag, grasps, format="rosbag", frame="base", gripper=gripper)


def test_bags_that_are_none_are_told_in_a_line(tmp_path: Path, gripper: GripperProfile) -> None:
    bag = tmp_path / "bag"
    interop.write(bag, _grasps(5, ["success"] * 50), format="rosbag", frame="base", gripper=gripper)
    (data,) = bag.glob("*.db3")
    data.write_bytes(data.read_bytes()[: data.stat().st_size // 2])
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "metadata.yaml").write_text("a: [")
    for name in ("bag", "old.bag", "empty"):
        with pytest.raises(ValueError, match="is no whole bag") as caught:
            interop.read(tmp_path / name, gripper=gripper, **SAID["rosbag"])
        assert "\n" not in str(caught.value)


def test_poses_are_written_with_the_frame_that_they_say(tmp_path: Path, gripper: GripperProfile) -> None:
    tools = _grasps(0, ["success"] * 3).poses
    there = tools.followed_by(gripper.in_tool("base", "graspnet"))
    framed = PoseArrays(there.position, there.quaternion_xyzw, frame="base", convention="graspnet")
    for grasps, times in ((framed, 1), ([framed, framed], 2)):
        interop.write(tmp_path / "t.jsonl", grasps, gripper=gripper)
        read = interop.read(tmp_path / "t.jsonl", outcome="success")
        assert read.matrices == pytest.approx(np.tile(tools.matrices, (times, 1, 1)), abs=1e-9)
    with pytest.raises(ValueError, match="several frames"):
        interop.write(tmp_path / "t.jsonl", [framed, PoseArrays(*tools)], gripper=gripper)
