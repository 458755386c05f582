"""Every format read to poses of the tool: against closed forms, and what is hostile in one line."""

from __future__ import annotations

import csv
import gzip
import itertools
import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import foreign_files as files
from graspdb import interop
from graspdb.files.trials import FileProblem
from graspdb.interop.formats import acronym, graspnet, messages
from graspdb.interop.frames import to_graspdb
from graspdb.interop.parsing import reader
from graspdb.poses import matrices
from graspdb.wire import CONVENTIONS, GripperProfile, JointValues
from graspdb.wire.frames import gripper_frames
from graspdb.wire.presets.grippers import PRESETS

TIP_OFFSET = 0.011
BASE_TO_TOOL = np.eye(4)
BASE_TO_TOOL[:3, 3] = [0.001, -0.002, 0.1034]
HELD = [1, 0, 1, 1, 0]


@pytest.fixture(scope="module")
def panda() -> GripperProfile:
    """A gripper whose base, tool and fingertips are three different places."""
    return GripperProfile.model_validate(
        {
            "max_opening_m": 0.08,
            "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.045},
            "tip_offset_m": TIP_OFFSET,
            "palm_size_m": [0.06, 0.2, 0.06],
            "base_to_tool": {"position": BASE_TO_TOOL[:3, 3].tolist(), "quaternion_xyzw": [0, 0, 0, 1]},
        }
    )


@pytest.fixture(scope="module")
def tools() -> np.ndarray:
    """Poses of the tool in the object's frame, (5, 4, 4)."""
    return _poses(np.random.default_rng(7), 5)


def _poses(rng: np.random.Generator, count: int) -> np.ndarray:
    turns, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    turns[:, :, 0] *= np.linalg.det(turns)[:, None]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, rng.uniform(-0.1, 0.1, (count, 3))
    return poses


def _bases(tools: np.ndarray) -> np.ndarray:
    return np.asarray(tools @ np.linalg.inv(BASE_TO_TOOL))


def _is(found: interop.FileGrasps, tools: np.ndarray, within: float = 1e-9) -> None:
    assert found.matrices == pytest.approx(tools, abs=within)


def test_conventions_are_the_rotations_that_the_facts_give() -> None:
    assert to_graspdb("graspnet").tolist() == [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    assert to_graspdb("acronym").tolist() == [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    for axes in (*CONVENTIONS, "-z/x", "y/-x"):
        turn = to_graspdb(axes)
        assert turn @ turn.T == pytest.approx(np.eye(3))
        assert np.linalg.det(turn) == pytest.approx(1)
    for wrong in ("z/z", "up", ""):
        with pytest.raises(ValueError, match="convention"):
            to_graspdb(wrong)


@pytest.mark.parametrize(
    "write", [files.acronym_h5, files.acronym_json, files.graspgen], ids=["h5", "json", "graspgen"]
)
def test_acronym_and_graspgen_are_bases_that_close_along_x(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray, write: Callable[..., str]
) -> None:
    name = "a.h5" if write is files.acronym_h5 else "a.json"
    found = interop.read(
        write(tmp_path / name, files.turned(_bases(tools), files.TO_ZX), HELD), gripper=panda
    )
    _is(found, tools)
    assert found.outcomes.tolist() == ["success" if x else "failure" for x in HELD]
    assert found.report is not None
    assert found.report.object_scale == 0.5
    assert found.report.frame == "base"
    if write is not files.graspgen:
        assert found.qualities["object_motion_during_closing_linear"].shape == (5,)


@pytest.mark.parametrize("write", [files.acronym_json, files.graspgen], ids=["acronym", "graspgen"])
def test_a_base_that_closes_along_x_itself_is_the_files_own(
    tmp_path: Path, tools: np.ndarray, write: Callable[..., str]
) -> None:
    preset = PRESETS["robotiq-2f-85"].profile
    assert preset.base_to_tool is not None
    way = matrices(preset.base_to_tool.position, preset.base_to_tool.quaternion_xyzw)
    path = write(tmp_path / "a.json", tools @ np.linalg.inv(way), HELD)
    # One meaning, however it is said: z approaches and x closes, which this base does itself.
    for convention in (None, "acronym", "graspgen", "z/x", "graspdb"):
        _is(interop.read(path, gripper=preset, convention=convention), tools)
    for axes in ("acronym", "graspgen"):
        own = preset.in_tool("base")
        assert gripper_frames.same(preset.in_tool("base", axes), own)  # type: ignore[arg-type]


def test_a_file_is_recognised_by_its_content(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    path = Path(files.acronym_h5(tmp_path / "a.h5", tools, HELD))
    other = path.rename(tmp_path / "grasps")
    assert interop.read(other, gripper=panda).report.format == "acronym"  # type: ignore[union-attr]
    with pytest.raises(FileProblem, match="is acronym, not vgn"):
        interop.read(other, gripper=panda, format="vgn")
    with pytest.raises(ValueError, match="expected auto or one of"):
        interop.read(other, gripper=panda, format="stl")


def test_isaac_needs_frame_and_convention_and_says_so(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    scores = [0.9, 0.5, 0.51, 1.0, 0.0]
    path = files.isaac(tmp_path / "a.yaml", _bases(tools), scores, object_frame="/World/mug")
    with pytest.raises(FileProblem, match="give --frame and --convention"):
        interop.read(path, gripper=panda)
    with pytest.raises(FileProblem, match="what its axes are: give --convention"):
        interop.read(path, gripper=panda, frame="base")
    found = interop.read(path, gripper=panda, frame="base", convention="graspdb")
    _is(found, tools)
    assert found.outcomes.tolist() == ["success", "failure", "success", "success", "failure"]
    assert found.qualities["confidence"].tolist() == scores
    assert any("0.5" in line for line in found.report.assumed)  # type: ignore[union-attr]
    strict = interop.read(
        path, gripper=panda, frame="base", convention="graspdb", success_from="confidence", success_above=0.8
    )
    assert strict.outcomes.tolist() == ["success", "failure", "failure", "success", "failure"]


def test_isaac_with_older_keys_and_those_of_graspdatagen(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    header = {
        "format_version": "1.0",
        "object_frame_link": "/World/mug",
        "gripper_frame_link": "base_link",
        "object_file": "mug.obj",
        "object_file_scale": 2.0,
        "gripper_file": "bots/panda.usd",
        "open_limit": "upper",
        "finger_colliders": ["left", "right"],
        "approach_axis": 2,
        "bite_point": [0.0, 0.0, 0.1],
    }
    poses = files.turned(tools, files.TO_ZX)
    path = files.isaac(tmp_path / "a.yaml", poses, HELD, **header)
    found = interop.read(path, gripper=panda, frame="tool", convention="z/x")
    _is(found, tools)
    assert found.report.object_scale == 2.0  # type: ignore[union-attr]
    with pytest.raises(FileProblem, match="approach_axis 2 says that z approaches"):
        interop.read(path, gripper=panda, frame="tool", convention="graspnet")


def test_graspnet_is_placed_by_its_fingertips_and_needs_the_objects_pose(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    depth = 0.03
    camera = _poses(np.random.default_rng(3), 1)[0]
    anchors = tools.copy()
    # The fingertips lie the profile's offset ahead of the tool, and the depth ahead of the anchor.
    anchors[:, :3, 3] += (TIP_OFFSET - depth) * tools[:, :3, 2]
    rows = files.graspnet_rows(files.turned(camera @ anchors, files.TO_XY), [0.9, 0.1, 0.5, 0.8, 0.2], depth)
    np.save(tmp_path / "a.npy", rows)
    rule: dict[str, Any] = {"success_from": "score", "success_above": 0.45}
    # All that such a file is asked for is said at once.
    with pytest.raises(FileProblem, match=r"--object-pose.*--success-from score.*--only object_id"):
        interop.read(tmp_path / "a.npy", gripper=panda, **rule)
    with pytest.raises(FileProblem, match="--success-from"):
        interop.read(tmp_path / "a.npy", gripper=panda, object_pose=camera)
    found = interop.read(tmp_path / "a.npy", gripper=panda, object_pose=camera, **rule)
    _is(found, tools)
    assert found.qualities["score"].tolist() == [0.9, 0.1, 0.5, 0.8, 0.2]
    assert found.outcomes.tolist() == ["success", "failure", "success", "success", "failure"]
    rows[2:, 16] = 9
    np.save(tmp_path / "b.npy", rows)
    with pytest.raises(FileProblem, match="--only object_id="):
        interop.read(tmp_path / "b.npy", gripper=panda, object_pose=camera, **rule)
    assert (
        len(interop.read(tmp_path / "b.npy", gripper=panda, object_pose=camera, only="object_id=9", **rule))
        == 3
    )


def test_graspnet_labels_without_what_nothing_holds(tmp_path: Path, panda: GripperProfile) -> None:
    rng = np.random.default_rng(1)
    shape = (2, 300, 12, 4)
    scores = np.full(shape, -1.0, dtype=np.float32)
    chosen = [(0, 0, 0, 0), (0, 17, 3, 1), (1, 299, 11, 3)]
    for place, friction in zip(chosen, (0.2, 0.4, 0.8), strict=True):
        scores[place] = friction
    offsets = rng.uniform(0.01, 0.06, (*shape, 3)).astype(np.float32)
    collision = np.zeros(shape, dtype=bool)
    collision[chosen[0]] = True
    points = rng.uniform(-0.05, 0.05, (2, 3)).astype(np.float32)
    np.savez_compressed(
        tmp_path / "000_labels.npz", points=points, offsets=offsets, collision=collision, scores=scores
    )
    found = interop.read(tmp_path / "000_labels.npz", gripper=panda)
    assert found.outcomes.tolist() == ["collision", "success", "failure"]
    assert found.qualities["friction"] == pytest.approx([0.2, 0.4, 0.8])
    for row, (point, view, turn, depth) in enumerate(chosen):
        angle, ahead, _ = offsets[point, view, turn, depth].astype(float)
        golden, z = (np.sqrt(5) - 1) / 2, (2 * view + 1) / 300 - 1
        around = 2 * np.pi * view * golden
        approach = -np.array([np.sqrt(1 - z * z) * np.cos(around), np.sqrt(1 - z * z) * np.sin(around), z])
        level = np.array([-approach[1], approach[0], 0]) / np.hypot(*approach[:2])
        closing = np.cos(angle) * level + np.sin(angle) * np.cross(approach, level)
        tip = found.matrices[row] @ [0, 0, TIP_OFFSET, 1]
        assert tip[:3] == pytest.approx(points[point] + ahead * approach, abs=1e-6)
        assert found.matrices[row][:3, 2] == pytest.approx(approach, abs=1e-6)
        assert found.matrices[row][:3, 1] == pytest.approx(closing, abs=1e-6)


def test_views_lie_on_the_sphere() -> None:
    assert np.linalg.norm(graspnet.views(300), axis=1) == pytest.approx(np.ones(300))


def test_vgn_is_a_scenes(tmp_path: Path, panda: GripperProfile, tools: np.ndarray) -> None:
    scene = _poses(np.random.default_rng(5), 1)[0]
    roots = tools.copy()
    roots[:, :3, 3] += (TIP_OFFSET - 0.05) * tools[:, :3, 2]
    path = files.vgn(tmp_path / "grasps.csv", scene @ roots, HELD, ["a", "a", "b", "b", "b"])
    with pytest.raises(FileProblem, match="scene's frame: give the object's pose"):
        interop.read(path, gripper=panda)
    with pytest.raises(FileProblem, match="several scenes"):
        interop.read(path, gripper=panda, object_pose=scene)
    found = interop.read(path, gripper=panda, object_pose=scene, only={"scene_id": "b"})
    _is(found, tools[2:])
    assert found.outcomes.tolist() == ["success", "success", "failure"]
    assert found.more["width_m"] == [0.05] * 3


def test_multigrippergrasp_has_w_first_and_needs_its_axes(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    poses = files.turned(_bases(tools), files.TO_XY)
    path = files.multigripper(tmp_path / "a.json", poses, HELD)
    with pytest.raises(FileProblem, match="give --convention"):
        interop.read(path, gripper=panda)
    found = interop.read(path, gripper=panda, convention="x/y")
    _is(found, tools)
    assert found.outcomes.tolist() == ["success" if x else "failure" for x in HELD]
    assert found.qualities["result_time"].tolist() == [1.5] * 5
    hand = files.multigripper(tmp_path / "b.json", poses, HELD, gripper="Allegro")
    with pytest.raises(FileProblem, match="a hand; GraspDB knows parallel jaws"):
        interop.read(hand, gripper=panda, convention="x/y")


def test_what_graspit_planned_has_w_last_and_no_outcomes(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    rows = [[*pose[:3, 3].tolist(), *files.quaternion(pose[:3, :3]).tolist()] for pose in _bases(tools)]
    grasps = {
        str(i): {"body": "Can" if i < 3 else "Mug", "pose": row, "epsilon": 0.01 * i, "dofs": [1.0]}
        for i, row in enumerate(rows)
    }
    path = files.written(tmp_path / "a.json", {"total_plans": {"0": 5}, "grasps": grasps})
    rule: dict[str, Any] = {"success_from": "epsilon", "success_above": 0.005}
    with pytest.raises(FileProblem, match="--only body="):
        interop.read(path, gripper=panda, convention="graspdb", **rule)
    found = interop.read(path, gripper=panda, convention="graspdb", only="body=Can", **rule)
    _is(found, tools[:3])
    assert found.outcomes.tolist() == ["failure", "success", "success"]


@pytest.mark.parametrize("name", ["a.yaml", "a.json"])
def test_moveit_is_of_the_link_that_somebody_names(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray, name: str
) -> None:
    path = files.moveit(tmp_path / name, _bases(tools), [0.1, 0.9, 0.3, 0.7, 0.5])
    rule: dict[str, Any] = {"success_from": "grasp_quality", "success_above": 0.4}
    with pytest.raises(FileProblem, match="no frame flange"):
        interop.read(path, gripper=panda, **rule)
    with pytest.raises(FileProblem, match="what became of it"):
        interop.read(path, gripper=panda, frame="base")
    found = interop.read(path, gripper=panda, frame="base", **rule)
    _is(found, tools)
    assert found.outcomes.tolist() == ["failure", "success", "failure", "success", "success"]
    camera = _poses(np.random.default_rng(9), 1)[0]
    seen = files.moveit(tmp_path / f"seen-{name}", camera @ _bases(tools), [1] * 5, frame_id="camera_link")
    with pytest.raises(FileProblem, match=r"poses in camera_link: give the object's pose"):
        interop.read(seen, gripper=panda, frame="base", outcome="success")
    _is(interop.read(seen, gripper=panda, frame="base", outcome="success", object_pose=camera), tools)


def test_graspit_worlds_are_robots_in_millimetres(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    body = _poses(np.random.default_rng(2), 1)[0]
    path = files.graspit_world(tmp_path / "world.xml", body, body @ _bases(tools)[0])
    found = interop.read(path, gripper=panda, outcome="success")
    _is(found, tools[:1])
    assert any("mm" in line for line in found.report.assumed)  # type: ignore[union-attr]


def test_uibk_is_the_tool_in_millimetres_with_causes_of_failure(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    outcomes = ["0.75", "OBJECTSLIPPED", "OBJECTMISSED", "COLLISIONINITIALLY", "INVKINFAILURE"]
    found = interop.read(files.uibk(tmp_path / "a.xml", tools, outcomes))
    _is(found, tools)
    assert found.outcomes.tolist() == ["success", "slipped", "missed", "collision", "failure"]
    assert found.qualities["quality"][0] == 0.75
    assert np.isnan(found.qualities["quality"][1:]).all()
    _is(interop.read(files.uibk(tmp_path / "b.xml", tools, outcomes, unit=1.0), unit="m"), tools)


def _table(path: Path, columns: dict[str, Any]) -> str:
    """The same columns as CSV, JSON Lines or Parquet, by the name's end."""
    if path.suffix == ".parquet":
        pq.write_table(pa.table(columns), path)
    elif path.suffix == ".jsonl":
        rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    else:
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))
    return str(path)


TABLES = ["t.csv", "t.jsonl", "t.parquet"]


@pytest.mark.parametrize("name", TABLES)
def test_tables_with_columns_of_any_name(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray, name: str
) -> None:
    poses = files.turned(_bases(tools), files.TO_ZX)
    turns = np.array([files.quaternion(pose[:3, :3]) for pose in poses])
    columns = {
        **{f"tx{i}": (1000 * poses[:, i, 3]).tolist() for i in range(3)},
        **{letter: turns[:, i].tolist() for i, letter in enumerate("bcda")},
        "ok": [True, False, True, True, False],
        "peak force": [1.0, 2.0, 3.0, 4.0, 5.0],
        "left": ["x"] * 5,
    }
    found = interop.read(
        _table(tmp_path / name, columns),
        gripper=panda,
        frame="base",
        convention="acronym",
        unit="mm",
        columns="position=tx0:tx1:tx2,quaternion_wxyz=a:b:c:d,outcome=ok,quality.force=peak force",
    )
    _is(found, tools)
    assert found.outcomes.tolist() == ["success", "failure", "success", "success", "failure"]
    assert found.qualities["force"].tolist() == [1, 2, 3, 4, 5]
    assert any("left" in line for line in found.report.dropped)  # type: ignore[union-attr]


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_matrices_with_a_score(tmp_path: Path, tools: np.ndarray, name: str) -> None:
    flat = {f"m{i}{j}": tools[:, i, j].tolist() for i, j in itertools.product(range(4), range(4))}
    rule: dict[str, Any] = {"success_from": "score", "success_below": 0.5}
    path = _table(tmp_path / name, {**flat, "score": [0.1, 0.9, 0.2, 0.3, 0.8]})
    found = interop.read(path, **rule)
    _is(found, tools)
    assert found.outcomes.tolist() == ["success", "failure", "success", "success", "failure"]
    if name != "t.csv":
        nested = {"T": tools.tolist(), "score": [0.1, 0.9, 0.2, 0.3, 0.8]}
        _is(interop.read(_table(tmp_path / f"n-{name}", nested), columns={"matrix": "T"}, **rule), tools)


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_ours_and_either_order(tmp_path: Path, tools: np.ndarray, name: str) -> None:
    turns = np.array([files.quaternion(pose[:3, :3]) for pose in tools])
    for order, label in (("xyzw", "quaternion_xyzw"), ("wxyz", "quaternion_wxyz"), ("wxyz", "q")):
        values = turns if order == "xyzw" else turns[:, [3, 0, 1, 2]]
        columns = {
            "position": tools[:, :3, 3].tolist(),
            label: values.tolist(),
            "outcome": ["slipped", "success", "missed", "dropped", "collision"],
        }
        path = _table(tmp_path / f"{label}-{name}", columns)
        found = interop.read(path, quaternion_order=order if label == "q" else None)
        _is(found, tools)
        assert found.outcomes.tolist() == columns["outcome"]


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**31), st.sampled_from(["base", "tool"]), st.sampled_from([*CONVENTIONS, "-x/z", "y/-z"])
)
def test_a_pose_of_any_frame_and_convention_comes_back(
    tmp_path_factory: pytest.TempPathFactory, panda: GripperProfile, seed: int, frame: str, convention: str
) -> None:
    tools = _poses(np.random.default_rng(seed), 3)
    poses = tools if frame == "tool" else _bases(tools)
    poses = files.turned(poses, to_graspdb(convention).T)
    path = tmp_path_factory.mktemp("any") / "t.jsonl"
    _table(path, {"matrix": poses.tolist(), "outcome": [True] * 3})
    _is(interop.read(path, gripper=panda, frame=frame, convention=convention), tools)


# -- hostile files -------------------------------------------------------------------------------------------


def _refused(path: Path | str, match: str, **options: Any) -> None:
    with pytest.raises(FileProblem, match=match) as caught:
        interop.read(path, **options)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_nothing_is_unpickled(tmp_path: Path, panda: GripperProfile) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return (pytest.fail, ("it was run",))

    np.save(tmp_path / "a.npy", np.array([Bomb()], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "b.npz", points=np.array([Bomb()], dtype=object), offsets=1, scores=1)
    np.savez(tmp_path / "c.npz", pred_grasps_cam=np.array({}, dtype=object), scores=1)
    (tmp_path / "d.pkl").write_bytes(pickle.dumps([1, 2, 3]))
    np.save(tmp_path / "e.npy", np.array([{"qpos": {}}], dtype=object), allow_pickle=True)
    identity = {"object_pose": np.eye(4), "gripper": panda, "outcome": "success"}
    _refused(tmp_path / "a.npy", "never read", **identity)
    _refused(tmp_path / "b.npz", "never read", **identity)
    _refused(tmp_path / "c.npz", "contact_graspnet", **identity)
    _refused(tmp_path / "d.pkl", "pickled")
    _refused(tmp_path / "e.npy", "a hand of many joints", **identity)


def test_xml_without_entities(tmp_path: Path, panda: GripperProfile) -> None:
    bomb = '<?xml version="1.0"?><!DOCTYPE w [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><world>&b;</world>'
    (tmp_path / "a.xml").write_text(bomb)
    _refused(tmp_path / "a.xml", "declares types or entities")
    (tmp_path / "b.xml").write_text("<world><graspableBody>")
    _refused(tmp_path / "b.xml", "no whole XML", gripper=panda)
    (tmp_path / "c.xml").write_text("<a>" * 500 + "</a>" * 500)
    _refused(tmp_path / "c.xml", "too deeply")
    (tmp_path / "d.xml").write_text("<svg/>")
    _refused(tmp_path / "d.xml", "no format that is known")


def test_yaml_is_plain_data_of_a_bounded_size(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    frame: dict[str, Any] = {"frame": "tool", "convention": "graspdb"}
    (tmp_path / "a.yaml").write_text(
        "format: isaac_grasp\ngrasps: !!python/object/apply:os.system ['true']\n"
    )
    _refused(tmp_path / "a.yaml", "plain data", **frame)
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    (tmp_path / "b.yaml").write_text("\n".join(lines))
    _refused(tmp_path / "b.yaml", "aliases", **frame)
    (tmp_path / "c.yaml").write_text("[" * 5_000)
    _refused(tmp_path / "c.yaml", "too deeply|no YAML", **frame)
    # Writers share what is alike: that is no bomb.
    text = Path(files.isaac(tmp_path / "d.yaml", tools, HELD)).read_text()
    shared = text.replace("pregrasp_cspace_position:\n", "pregrasp_cspace_position: &j\n", 1)
    shared = shared.replace(
        "    pregrasp_cspace_position:\n      panda_finger_joint1: 0.04\n",
        "    pregrasp_cspace_position: *j\n",
    )
    (tmp_path / "d.yaml").write_text(shared)
    assert "*j" in shared
    _is(interop.read(tmp_path / "d.yaml", **frame), tools)


def test_hdf5_stays_in_its_file(tmp_path: Path, panda: GripperProfile, tools: np.ndarray) -> None:
    good = Path(files.acronym_h5(tmp_path / "good.h5", tools, HELD))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["grasps/transforms"] = h5py.ExternalLink(str(good), "/grasps/transforms")
    _refused(tmp_path / "a.h5", "is a link, which is not followed", gripper=panda)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        layout = h5py.VirtualLayout(shape=(5, 4, 4), dtype="f8")
        layout[:] = h5py.VirtualSource(str(good), "grasps/transforms", shape=(5, 4, 4))
        file.create_virtual_dataset("grasps/transforms", layout)
    _refused(tmp_path / "b.h5", "another file", gripper=panda)
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["grasps/transforms"] = np.zeros((5, 3, 4))
    _refused(tmp_path / "c.h5", "N x 4 x 4", gripper=panda)
    content = good.read_bytes()
    for size in (9, 600, len(content) // 2):
        (tmp_path / "d.h5").write_bytes(content[:size])
        _refused(tmp_path / "d.h5", "HDF5|no grasps", gripper=panda)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("a.json", '{"transforms": [[1, 2], [3]], "quality_flex_object_in_gripper": [1, 0]}', "4 x 4"),
        ("a.json", '{"transforms": [[[NaN]]]}', "NaN and Infinity are no JSON numbers"),
        ("a.json", "[" * 100_000, "too deeply|no JSON"),
        ("a.json", '{"grasps": {"transforms": []}}', "what became of it|no grasp"),
        ("a.json", '{"a": ', "no JSON"),
        ("a.jsonl", '{"position": [0, 0, 0]}\n', "which columns are the pose"),
        ("a.jsonl", '{"x": 1}\n{"x": ', "line 2 is no JSON"),
        ("a.jsonl", '{"position": [0, 0], "quaternion_xyzw": [0, 0, 0, 1], "outcome": 1}\n', "3 numbers"),
        (
            "a.csv",
            "x,y,z,qx,qy,qz,qw,outcome\n0,0,0,0,0,0,1,maybe\n",
            r"grasp 0 \(the first is 0\): outcome is 'maybe'",
        ),
        ("a.csv", "x,y,z,qx,qy,qz,qw,outcome\n0,0,0,0,0,0,1\n", "line 2 has 7 cells"),
        (
            "a.csv",
            "x,y,z,qx,qy,qz,qw,outcome\n0,0,nan,0,0,0,1,1\n",
            r"grasp 0 \(the first is 0\) has a position that is not finite",
        ),
        (
            "a.csv",
            "x,y,z,qx,qy,qz,qw,outcome\n0,0,,0,0,0,1,1\n",
            r"grasp 0 \(the first is 0\) has a position that is not finite",
        ),
        ("a.csv", "x,y,z,qx,qy,qz,qw,outcome\n0,0,a,0,0,0,1,1\n", r"grasp 0 \(the first is 0\): z is 'a'"),
        ("a.csv", "x,y,z,qx,qy,qz,qw,outcome\n0,0,0,0,0,0,2,1\n", "unit quaternion"),
        ("a.csv", "x,y,z,qx,qy,qz,qw,outcome\n5000,0,0,0,0,0,1,1\n", "--unit"),
        ("a.csv", "x,y,z,qx,qy,qz,qw,outcome\n", "no rows"),
        ("a.csv", "x,x,z\n1,2,3\n", "twice"),
        ("a.parquet", "PAR1 but no more", "Parquet"),
        ("a.npy", "\x93", r"\.npy"),
        ("a.bin", "\x00\x01", "no format that is known"),
        ("a.csv", "", "is empty"),
    ],
)
def test_what_is_wrong_is_one_line(
    tmp_path: Path, panda: GripperProfile, name: str, content: str, match: str
) -> None:
    (tmp_path / name).write_text(content, encoding="latin1")
    _refused(tmp_path / name, match, gripper=panda)


def test_what_is_truncated_or_of_wrong_shape_in_archives(tmp_path: Path, panda: GripperProfile) -> None:
    np.savez(
        tmp_path / "a.npz",
        points=np.zeros((2, 3)),
        offsets=np.zeros((2, 5)),
        scores=np.zeros((2, 300, 12, 4)),
    )
    _refused(tmp_path / "a.npz", "offsets must be N x 300 x 12 x 4 x 3", gripper=panda)
    content = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "b.npz").write_bytes(content[: len(content) // 2])
    _refused(tmp_path / "b.npz", "npz", gripper=panda)
    with zipfile.ZipFile(tmp_path / "c.npz", "w") as archive:
        archive.writestr("x.txt", "no array")
    _refused(tmp_path / "c.npz", "GraspNet's labels are", gripper=panda)
    np.save(tmp_path / "d.npy", np.zeros((3, 7)))
    _refused(tmp_path / "d.npy", "N x 17", gripper=panda, object_pose=np.eye(4))


def test_a_gripper_without_the_way_to_its_tool_is_refused(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    path = files.acronym_h5(tmp_path / "a.h5", tools, HELD)
    bare = GripperProfile.model_validate(panda.model_dump(exclude={"base_to_tool", "frames"}))
    with pytest.raises(ValueError, match="base_to_tool"):
        interop.read(path, gripper=bare)
    with pytest.raises(ValueError, match="has no frame 'wrist'"):
        interop.read(path, gripper=panda, frame="wrist")
    with pytest.raises(ValueError, match="need the gripper's profile"):
        interop.read(path)


def test_a_table_says_how_it_is_to_be_written(tmp_path: Path) -> None:
    head, path = "x,y,z,qx,qy,qz,qw,outcome\n", tmp_path / "t.csv"
    path.write_text(head + "0,0,0,0,0,0,1,OK\n")
    _refused(path, "success, collision, .* yes, .* failed")
    path.write_text(head.replace(",", ";") + "0,1;0;0;0;0;0;1;success\n")
    _refused(path, "written with a point")
    path.write_text(head + "0,0,0,0,0,0,1,gegl\u00fcckt\n", encoding="latin-1")
    _refused(path, "Windows-1252: save it as UTF-8")
    path.write_text(head + "0,0,0,0,0,0,1,success\n", encoding="utf-16")
    _refused(path, "UTF-16: save it as UTF-8")


@pytest.mark.parametrize("name", TABLES)
def test_a_table_may_have_the_objects_pose_at_each_grasp(
    tmp_path: Path, tools: np.ndarray, name: str
) -> None:
    """As a robot's log has it: both poses in the robot's base, the object now here, now there."""
    turns = Rotation.random(len(tools), random_state=4)
    places = np.random.default_rng(4).uniform(-0.5, 0.5, (len(tools), 3))
    there = np.tile(np.eye(4), (len(tools), 1, 1))
    there[:, :3, :3], there[:, :3, 3] = turns.as_matrix(), places
    rows = there @ tools
    columns: dict[str, Any] = {f"T_{i}{j}": rows[:, i, j] for i in range(4) for j in range(4)}
    columns |= {f"o{letter}": 1000 * places[:, place] for place, letter in enumerate("xyz")}
    columns |= {f"oq{letter}": turns.as_quat()[:, place] for place, letter in enumerate("xyzw")}
    columns |= {f"T_{i}3": 1000 * rows[:, i, 3] for i in range(3)} | {"ok": np.ones(len(tools), dtype=int)}
    path = _table(tmp_path / name, {key: values.tolist() for key, values in columns.items()})
    said = "matrix=T,object_position=ox:oy:oz,object_quaternion_wxyz=oqw:oqx:oqy:oqz,outcome=ok"
    found = interop.read(path, columns=said, unit="mm")
    assert found.matrices == pytest.approx(tools, abs=1e-9)
    assert found.report is not None
    assert any("the object's pose at each grasp" in line for line in found.report.recognised)
    with pytest.raises(ValueError, match="give one of them"):
        interop.read(path, columns=said, unit="mm", object_pose=np.eye(4))
    with pytest.raises(ValueError, match="name both"):
        interop.read(path, columns="matrix=T,object_position=ox:oy:oz,outcome=ok")


def test_unusable_grasps_are_left_out_where_that_is_asked_for(tmp_path: Path) -> None:
    header = "x,y,z,qx,qy,qz,qw,outcome\n"
    rows = ["0,0,0.1,0,0,0,1,1", "nan,0,0,0,0,0,1,1", "0,0,0,0,0,0,2,0", ",0,0,0,0,0,1,0", "0,0,0.2,0,0,0,1,"]
    (tmp_path / "log.csv").write_text(header + "\n".join([*rows, "0,0,0.3,0,0,0,1,0"]))
    _refused(tmp_path / "log.csv", "--drop-unusable leaves such grasps out")
    found = interop.read(tmp_path / "log.csv", drop_unusable=True)
    assert found.position[:, 2].tolist() == [0.1, 0.3]
    assert found.outcomes.tolist() == ["success", "failure"]
    assert found.report is not None
    assert found.report.left_out == {
        "has a position that is not finite": 2,
        "must have a unit quaternion, within 0.001": 1,
        "has no outcome": 1,
    }
    (tmp_path / "word.csv").write_text(header + "0,0,0,0,0,0,1,perhaps")
    with pytest.raises(ValueError, match="Outcomes are"):
        interop.read(tmp_path / "word.csv", drop_unusable=True)


def test_a_column_named_frame_may_count_a_videos(tmp_path: Path) -> None:
    rows = ["x,y,z,qx,qy,qz,qw,outcome,frame", "0,0,0,0,0,0,1,1,17", "0,0,0,0,0,0,1,1,18"]
    (tmp_path / "video.csv").write_text("\n".join(rows))
    report = interop.read(tmp_path / "video.csv").report
    assert report is not None
    assert (report.frame, report.dropped[0].split(" (")[0]) == ("tool", "columns frame")
    (tmp_path / "video.csv").write_text("\n".join(rows).replace(",17", ",img_17").replace(",18", ",img_18"))
    with pytest.raises(ValueError, match="img_17"):
        interop.read(tmp_path / "video.csv")
    told = interop.read(tmp_path / "video.csv", frame="tool").report
    assert told is not None
    assert told.dropped[0].startswith("columns frame")


def test_rows_of_a_frame_below_rows_of_none_are_refused(tmp_path: Path) -> None:
    """As two of our own tables are, one after the other: that of the tool says no frame."""
    row = {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1], "outcome": True}
    rows = [row, {**row, "frame": "base", "convention": "graspdb"}]
    (tmp_path / "both.jsonl").write_text("\n".join(map(json.dumps, rows)))
    pq.write_table(
        pa.Table.from_pylist([{"frame": None, "convention": None, **row}, rows[1]]), tmp_path / "both.parquet"
    )
    for name in ("both.jsonl", "both.parquet"):
        _refused(tmp_path / name, "several frames")
        assert len(interop.read(tmp_path / name, frame="tool", convention="graspdb")) == 2


def test_half_a_rule_is_none(tmp_path: Path, panda: GripperProfile, tools: np.ndarray) -> None:
    path = files.acronym_h5(tmp_path / "a.h5", tools, HELD)
    for half in (
        {"success_from": "x"},
        {"success_above": 1.0},
        {"success_from": "x", "success_above": 1, "success_below": 2},
    ):
        with pytest.raises(ValueError, match="--success-from QUALITY"):
            interop.read(path, gripper=panda, **half)
    with pytest.raises(FileProblem, match="has no quality 'x'; there are object_in_gripper"):
        interop.read(path, gripper=panda, success_from="x", success_above=1)


def test_large_json_is_read_by_pieces(
    tmp_path: Path, panda: GripperProfile, monkeypatch: pytest.MonkeyPatch, tools: np.ndarray
) -> None:
    """Columns lie in a file of their own, entries come one at a time: both in runs, exact and in order."""
    for module in (acronym, messages):
        monkeypatch.setattr(module, "CHUNK", 2)
    monkeypatch.setattr(reader, "_IN_MEMORY_BYTES", 64)
    monkeypatch.setattr(reader, "_NUMBERS", 3)
    frame: dict[str, Any] = {"frame": "tool", "convention": "graspdb"}
    confidences = np.linspace(0, 1, len(tools)).tolist()
    held = [int(x > 0.5) for x in confidences]
    for path in (
        files.graspgen(tmp_path / "a.json", tools, held),
        files.isaac(tmp_path / "b.yaml", tools, confidences),
        files.multigripper(tmp_path / "c.json", tools, held),
    ):
        found = interop.read(path, gripper=panda, **frame)
        assert found.matrices == pytest.approx(tools, abs=1e-9)
        assert found.outcomes.tolist() == [["failure", "success"][x] for x in held]


def test_joints_values_are_kept_and_tell_the_opening(
    tmp_path: Path, panda: GripperProfile, tools: np.ndarray
) -> None:
    path = files.isaac(tmp_path / "a.yaml", tools, [1.0] * len(tools))
    frame: dict[str, Any] = {"frame": "base", "convention": "graspdb"}
    sliding = panda.model_copy(update={"joints": {"panda_finger_joint1": JointValues(open=0.04, closed=0.0)}})
    found = interop.read(path, gripper=sliding, **frame)
    assert found.more["metadata"][0] == {
        "joints": {"panda_finger_joint1": 0.01},
        "joints_before": {"panda_finger_joint1": 0.04},
    }
    assert found.more["width_m"] == pytest.approx([0.02] * len(tools))
    interop.write(tmp_path / "b.yaml", found, format="isaac", gripper=sliding)
    again = interop.read(tmp_path / "b.yaml", gripper=sliding, **frame)
    assert again.more["metadata"] == found.more["metadata"]
    # Closed, as it is written where no width is known, is what the jaw is told: its width stays unknown.
    for name in ("c.yaml", "c.json"):
        kind = "isaac" if name == "c.yaml" else "moveit"
        interop.write(
            tmp_path / name, tools, outcomes=[True] * len(tools), format=kind, gripper=sliding, frame="base"
        )
        closed = interop.read(tmp_path / name, format=kind, gripper=sliding, outcome="success", **frame)
        assert "width_m" not in closed.more
        assert any("closed is a command, not a width" in told for told in closed.report.dropped)
    # Where the profile has no joints, or swinging ones, an opening is not made up.
    swinging = panda.model_copy(update={"joints": {"panda_finger_joint1": JointValues(open=0.0, closed=0.8)}})
    for gripper in (panda, swinging):
        unknown = interop.read(path, gripper=gripper, **frame)
        assert "width_m" not in unknown.more
        assert any("how far the jaw is open" in told for told in unknown.report.dropped)


def test_a_merge_key_and_a_name_twice_lose_no_grasp(tmp_path: Path, panda: GripperProfile) -> None:
    pose = "position: [0, 0, 1e-05], orientation: {w: 1, xyz: [0, 0, 0]}"
    (tmp_path / "a.yaml").write_text(
        "base: &base {confidence: 0.9}\nformat: isaac_grasp\ngrasps:\n"
        f"  a: {{<<: *base, {pose}}}\n  a: {{confidence: 0, {pose}}}\n"
    )
    found = interop.read(tmp_path / "a.yaml", gripper=panda, frame="tool", convention="graspdb")
    assert found.outcomes.tolist() == ["success", "failure"]
    assert found.position[:, 2].tolist() == [1e-05, 1e-05]


def test_what_is_compressed_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.json.gz").write_bytes(gzip.compress(b"{}"))
    _refused(tmp_path / "a.json.gz", "gzip")
