"""``graspdb import``: what is stored, what is said before, what is refused and which flag mends it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh

import foreign_files as files
from graspdb import Client, interop
from graspdb.errors import Unreachable
from graspdb.poses import matrices
from graspdb.resources.objects import GraspObject
from graspdb.transport import Transport

Run = Callable[..., tuple[int, str, str]]
RADIUS_M, HEIGHT_M = 0.03, 0.2


def _can(db: Client, id: str, scale: float = 1.0) -> GraspObject:
    """A can that stands about the origin."""
    mesh = trimesh.creation.cylinder(RADIUS_M * scale, HEIGHT_M * scale)
    return db.objects.create(id, mesh=mesh)


def _about_the_can(count: int = 60) -> np.ndarray:
    """Tools (N, 4, 4) that reach for the can's axis from its sides, and close across it."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(-0.04, 0.04, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    approach = np.stack([-np.cos(angle), -np.sin(angle), 0 * angle], axis=1)
    closing = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    poses[:, :3, 2], poses[:, :3, 1] = approach, closing
    poses[:, :3, 0], poses[:, 2, 3] = np.cross(closing, approach), height
    return poses


def _from_above(count: int = 60) -> np.ndarray:
    """Tools (N, 4, 4) that reach for the can's top: level ones would be as good with their quaternions in
    the other order.
    """
    tools = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (count, 1, 1))
    tools[:, 2, 3] = HEIGHT_M / 2 - 0.015
    turn = np.linspace(0.1, 3, count)
    spin = np.tile(np.eye(4), (count, 1, 1))
    spin[:, 0, 0] = spin[:, 1, 1] = np.cos(turn)
    spin[:, 1, 0], spin[:, 0, 1] = np.sin(turn), -np.sin(turn)
    return np.asarray(spin @ tools)


def _panda_bases(db: Client, tools: np.ndarray) -> np.ndarray:
    way = db.grippers.get("panda").profile.base_to_tool
    assert way is not None
    fixed = np.eye(4)
    fixed[:3, 3] = way.position
    return np.asarray(tools @ np.linalg.inv(fixed))


@pytest.fixture
def acronym(db: Client, tmp_path: Path) -> str:
    """An ACRONYM file of the can's grasps, every third of which failed."""
    poses = files.turned(_panda_bases(db, _about_the_can()), files.TO_ZX)
    return files.acronym_h5(tmp_path / "can.h5", poses, [int(i % 3 > 0) for i in range(len(poses))])


def test_an_acronym_file_becomes_trials(db: Client, run: Run, fresh_id: str, acronym: str) -> None:
    can = _can(db, fresh_id)
    arguments = ("import", acronym, "--object", fresh_id, "--gripper", "panda", "--licence", "CC-BY-NC-4.0")
    code, out, err = run(*arguments)
    assert code == 0, err
    for told in ("acronym, 60 grasps", "gripper panda", "z approaches and x closes", "60 of 60 lie within"):
        assert told in out, out
    assert "60 of 60 closings meet the object" in out
    assert "Doubtful" not in out
    trials = can.trials.list().arrays()
    assert trials.matrices == pytest.approx(_about_the_can(), abs=1e-9)
    assert trials.outcome.tolist() == ["success" if i % 3 else "failure" for i in range(60)]
    (batch,) = can.batches
    assert batch.sources == ["import"]
    assert batch.grippers == ["panda"]
    assert batch.licence == "CC-BY-NC-4.0"
    assert batch.origin is not None
    assert (batch.origin.file, batch.origin.format) == ("can.h5", "acronym")
    shaken = [
        trial.qualities["object_motion_during_shaking_linear"] for trial in can.trials if trial.qualities
    ]
    assert shaken == pytest.approx(np.linspace(0, 1, 60))


def test_a_dry_run_stores_nothing_and_says_it_as_data(
    db: Client, run: Run, fresh_id: str, acronym: str
) -> None:
    can = _can(db, fresh_id)
    arguments = ("--json", "import", acronym, "--object", fresh_id, "--gripper", "panda", "--dry-run")
    code, out, err = run(*arguments)
    assert code == 0, err
    told = json.loads(out)
    assert told["report"]["grasps"] == 60
    assert told["report"]["outcomes"] == {"failure": 20, "success": 40}
    assert told["first_look"]["fingertips_in_box"] == 60
    assert told["first_look"]["refusals"] == []
    assert (told["inserted"], told["dry_run"]) == (0, True)
    assert can.refresh().info.trials == 0


@pytest.mark.parametrize(
    ("flags", "told", "mend"),
    [
        (("--unit", "mm"), "no fingertip comes near|few grasps fit", "--unit m"),
        (("--scale", "10"), "no fingertip comes near|few grasps fit", "--unit m"),
        (("--frame", "tool"), "no fingertip comes near|few grasps fit", "--frame base"),
        (("--convention", "graspnet"), "no fingertip comes near|few grasps fit", "--convention acronym"),
        (("--convention", "graspdb"), "few grasps fit", "--convention acronym"),
        # Given with w first: turned about the can's own axis it is as it was.
        (
            ("--object-pose", "0,0,0,0.70710678,0,0,0.70710678"),
            "few grasps fit",
            "--object-pose=0,0,0,0,0,0.707106781,0.707106781",
        ),
        # Of quite another place: no reading fits.
        (("--object-pose", "0.06,0.05,0,0,0,0.6,0.8"), "hardly a grasp", "--object-pose"),
    ],
)
def test_what_cannot_be_right_is_refused_with_the_flag_that_mends_it(
    db: Client, run: Run, fresh_id: str, acronym: str, flags: tuple[str, ...], told: str, mend: str
) -> None:
    can = _can(db, fresh_id)
    code, out, err = run("import", acronym, "--object", fresh_id, "--gripper", "panda", *flags)
    assert code == 1, out
    assert any(part in err for part in told.split("|")), err
    assert mend in err, err
    assert can.refresh().info.trials == 0, out


def test_what_is_doubted_afterwards_is_mended_by_flags(
    db: Client, run: Run, fresh_id: str, acronym: str
) -> None:
    """The service speaks of poses that are sent; here there is a file."""
    can = _can(db, fresh_id)
    arguments = (
        "--object",
        fresh_id,
        "--gripper",
        "panda",
        "--convention",
        "graspdb",
        "--accept-implausible",
    )
    code, out, err = run("import", acronym, *arguments)
    assert code == 0, err
    (batch,) = can.batches
    assert "Doubtful (another-closing-axis)" in out
    assert (
        f"If so, graspdb batches delete {fresh_id} {batch.batch}, and import again with the --convention"
        in out
    )
    assert "Turn the poses" not in out


def test_quaternions_in_the_other_order_are_seen(db: Client, run: Run, fresh_id: str, tmp_path: Path) -> None:
    can = _can(db, fresh_id)
    tools = _from_above()
    bases = _panda_bases(db, tools)
    turns = np.array([files.quaternion(pose[:3, :3])[[3, 0, 1, 2]] for pose in bases])
    columns = {"position": bases[:, :3, 3].tolist(), "q": turns.tolist(), "outcome": [True] * len(tools)}
    pq.write_table(pa.table(columns), tmp_path / "t.parquet")
    arguments = ("import", str(tmp_path / "t.parquet"), "--object", fresh_id, "--gripper", "panda")
    arguments += ("--frame", "base")
    code, _, err = run(*arguments)
    assert code == 1
    assert "quaternions fit the other order better" in err
    assert "--quaternion-order wxyz" in err
    code, _, err = run(*arguments, "--quaternion-order", "wxyz")
    assert code == 0, err
    assert can.trials.list().arrays().matrices == pytest.approx(tools, abs=1e-9)


def test_a_can_a_metre_tall_is_refused_with_the_scale_of_its_mesh(
    db: Client, run: Run, fresh_id: str, tmp_path: Path
) -> None:
    _can(db, fresh_id, scale=20)
    poses = files.turned(_panda_bases(db, _about_the_can()), files.TO_ZX)
    volume = float(trimesh.creation.cylinder(RADIUS_M, HEIGHT_M).volume)
    for number, more in enumerate([{}, {"volume": volume}]):
        path = files.acronym_h5(tmp_path / f"{number}.h5", poses, [1] * 60, scale=0.05, **more)
        arguments = ("import", path, "--object", fresh_id, "--gripper", "panda")
        code, out, err = run(*arguments)
        assert code == 1, out
        assert "--scale 0.05" in err, err
    code, out, err = run(*arguments, "--accept-implausible")
    assert code == 0, err
    assert "60 trials stored" in out


def test_files_are_one_import_and_pieces_are_batches(
    db: Client, run: Run, fresh_id: str, tmp_path: Path
) -> None:
    can = _can(db, fresh_id)
    tools = _about_the_can(7)
    worlds = [
        files.graspit_world(tmp_path / f"{i}.xml", np.eye(4), base)
        for i, base in enumerate(_panda_bases(db, tools))
    ]
    arguments = ("import", *worlds, "--object", fresh_id, "--gripper", "panda", "--outcome", "success")
    code, out, err = run(*arguments, "--chunk", "3")
    assert code == 0, err
    assert "7 files: graspit, 7 grasps" in out
    assert [batch.inserted for batch in can.batches] == [3, 3, 1]
    assert can.trials.list().arrays().matrices == pytest.approx(tools, abs=1e-9)


def test_the_same_import_again_stores_nothing_twice(
    db: Client, run: Run, fresh_id: str, acronym: str
) -> None:
    can = _can(db, fresh_id)
    arguments = ("import", acronym, "--object", fresh_id, "--gripper", "panda")
    assert run(*arguments, "--chunk", "25")[0] == 0
    # Said at more length, it is the same.
    code, out, err = run(*arguments, "--chunk", "25", "--format", "acronym", "--frame", "base")
    assert code == 0, err
    assert "0 trials stored, 60 were already stored, in batch" in out
    for other in (("--chunk", "30"), ("--chunk", "25", "--licence", "BSD")):
        code, _, err = run(*arguments, *other)
        assert code == 1
        assert "imported before" in err
        assert "store all anew with --again" in " ".join(err.split())
    assert can.refresh().info.trials == 60
    # Read otherwise it is another import.
    assert run(*arguments, "--unit", "m", "--scale", "1.001")[0] == 0
    code, out, err = run(*arguments, "--chunk", "25", "--again")
    assert code == 0, err
    assert "60 trials stored, in batch" in out
    assert can.refresh().info.trials == 180


def test_a_named_key_holds_whatever_the_chunk_is(db: Client, run: Run, fresh_id: str, acronym: str) -> None:
    can = _can(db, fresh_id)
    arguments = ("import", acronym, "--object", fresh_id, "--gripper", "panda", "--idempotency-key", "mine")
    assert run(*arguments)[0] == 0
    code, _, err = run(*arguments, "--chunk", "7")
    assert code == 1
    assert "with another body" in err
    assert can.refresh().info.trials == 60


def test_an_import_that_is_broken_off_says_what_is_stored_and_goes_on(
    db: Client, run: Run, fresh_id: str, acronym: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    can = _can(db, fresh_id)
    arguments = ("import", acronym, "--object", fresh_id, "--gripper", "panda", "--chunk", "20")
    sent = Transport.model
    broken: list[BaseException] = [KeyboardInterrupt(), Unreachable("no answer")]
    posted: list[str] = []

    def breaks(self: Transport, model: Any, method: str, path: str, **options: Any) -> Any:
        answer = sent(self, model, method, path, **options)
        if method == "POST" and path.endswith("/trials"):
            posted.append(path)
            if len(posted) in (2, 4):
                raise broken.pop(0)
        return answer

    monkeypatch.setattr(Transport, "model", breaks)
    for code, of in ((130, "the second answer, by Ctrl-C"), (1, "the second answer, that was lost")):
        ended, _, err = run(*arguments)
        told = " ".join(err.split())
        assert ended == code, (of, err)
        assert f"The 20 trials before are stored, in batches {next(iter(can.batches)).batch}." in told
        assert "Whether trials 20 to 39 are stored, too, is not known." in told
        assert "run the same import again" in told
    code, out, err = run(*arguments)
    assert code == 0, err
    assert "20 trials stored, 40 were already stored" in out
    assert can.refresh().info.trials == 60


def test_a_file_that_ends_badly_stores_nothing(db: Client, run: Run, fresh_id: str, tmp_path: Path) -> None:
    can = _can(db, fresh_id)
    row = {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1], "outcome": True}
    lines = [json.dumps(row)] * 50 + [json.dumps({**row, "position": [0, 0, None]})]
    (tmp_path / "t.jsonl").write_text("\n".join(lines))
    arguments = ("import", str(tmp_path / "t.jsonl"), "--object", fresh_id, "--gripper", "panda")
    code, _, err = run(*arguments, "--chunk", "10", "--accept-implausible")
    assert code == 1
    assert "grasp 50 (the first is 0) has a position that is not finite" in err
    assert can.refresh().info.trials == 0


def test_a_frame_id_of_the_object_or_its_frames_places_the_poses(
    db: Client, run: Run, fresh_id: str, tmp_path: Path
) -> None:
    tools = _about_the_can(5)
    marker = np.eye(4)
    marker[:3, :3], marker[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.1, 0.0, 0.02]
    mesh = trimesh.creation.cylinder(RADIUS_M, HEIGHT_M)
    can = db.objects.create(fresh_id, mesh=mesh, frames={"marker": marker})
    told = ("--object", fresh_id, "--gripper", "panda", "--frame", "tool", "--outcome", "success")
    seen = np.linalg.inv(marker) @ tools
    for name, poses in {fresh_id: tools, "marker": seen}.items():
        path = files.moveit(tmp_path / f"{name}.json", poses, [1] * 5, frame_id=name)
        code, out, err = run("import", path, *told)
        assert code == 0, err
        assert f"poses in {name}, which is the object's" in out
    found = can.trials.list().arrays().matrices
    assert found == pytest.approx(np.concatenate([tools, tools]), abs=1e-9)
    path = files.moveit(tmp_path / "other.json", tools, [1] * 5, frame_id="camera")
    code, _, err = run("import", path, *told)
    assert code == 1
    assert "poses in camera" in err
    assert "--object-pose" in err


def test_without_a_mesh_there_is_nothing_to_compare(
    db: Client, run: Run, fresh_id: str, acronym: str
) -> None:
    db.objects.create(fresh_id)
    code, out, err = run("import", acronym, "--object", fresh_id, "--gripper", "panda", "--dry-run")
    assert code == 0, err
    assert "the object has no mesh" in out


def test_what_the_sdk_read_goes_where_trials_go(db: Client, fresh_id: str, acronym: str) -> None:
    can = _can(db, fresh_id)
    read = interop.read(acronym, gripper=db.grippers.get("panda"))
    receipt = can.trials.add(read, read.outcomes, gripper="panda", source="import")
    assert receipt.inserted == 60
    assert can.trials.list().arrays().matrices == pytest.approx(read.matrices, abs=1e-9)


def test_columns_go_as_json_where_arrow_is_not_installed(
    db: Client, fresh_id: str, acronym: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    can = _can(db, fresh_id)
    tools = _about_the_can(4)
    columns = {
        "position": tools[:, :3, 3],
        "quaternion_xyzw": np.array([files.quaternion(pose[:3, :3]) for pose in tools]),
        "outcome": np.array(["success"] * 4),
        "quality": np.array([1.0, np.nan, 2.0, 3.0]),
    }
    for there in (True, False):
        monkeypatch.setattr("graspdb.files.arrow.available", lambda there=there: there)
        assert can.trials.add_columns([columns], 4, gripper="panda").inserted == 4
    stored = list(can.trials)
    assert [trial.quality for trial in stored] == [1.0, None, 2.0, 3.0] * 2
    assert stored[0].quaternion_xyzw == stored[4].quaternion_xyzw


def test_unusable_grasps_are_left_out_before_the_first_look(
    db: Client, run: Run, fresh_id: str, tmp_path: Path
) -> None:
    """Also rows of nothing but zeros, as arrays that are too long are filled with."""
    can = _can(db, fresh_id)
    poses = files.turned(_panda_bases(db, _about_the_can()), files.TO_ZX)
    poses[3], poses[7, 0, 3], poses[9, :3, :3] = 0.0, np.nan, np.inf
    path = files.acronym_h5(tmp_path / "padded.h5", poses, [1] * len(poses))
    arguments = ("import", path, "--object", fresh_id, "--gripper", "panda")
    code, _, err = run(*arguments)
    assert code == 1
    assert "the last row of its matrix" in err
    code, out, err = run(*arguments, "--drop-unusable")
    assert code == 0, err
    assert "left out: 2 grasps: has a position that is not finite" in out
    assert "left out: 1 grasps: has a rotation that is not finite" in out
    assert can.refresh().info.trials == 57


def test_the_fewest_flags_that_mend_are_told(db: Client, run: Run, fresh_id: str, tmp_path: Path) -> None:
    """Poses of the tool in a file of the base's: other axes would fit a round can as well."""
    can = _can(db, fresh_id)
    path = files.acronym_h5(tmp_path / "tools.h5", files.turned(_about_the_can(), files.TO_ZX), [1] * 60)
    arguments = ("import", path, "--object", fresh_id, "--gripper", "panda")
    code, _, err = run(*arguments)
    assert code == 1
    assert "with --frame tool " in err
    assert "--convention" not in err
    code, _, err = run(*arguments, "--frame", "tool")
    assert code == 0, err
    assert can.trials.list().arrays().matrices == pytest.approx(_about_the_can(), abs=1e-9)


def test_grasps_of_another_object_get_no_other_axes(
    db: Client, run: Run, fresh_id: str, tmp_path: Path
) -> None:
    """A format that says what approaches is not read with what does by chance."""
    db.objects.create(fresh_id, mesh=trimesh.creation.annulus(0.07, 0.1, 0.02))
    path = files.acronym_h5(
        tmp_path / "can.h5", files.turned(_panda_bases(db, _about_the_can()), files.TO_ZX), [1] * 60
    )
    code, out, err = run("import", path, "--object", fresh_id, "--gripper", "panda", "--dry-run")
    assert "--object" in err + out
    assert "--convention" not in err
    assert code == 1 or "doubtful: " in out


def test_a_scene_is_no_object_in_another_unit(db: Client, run: Run, fresh_id: str, tmp_path: Path) -> None:
    """Far smaller, any grasps would be in a can's middle."""
    _can(db, fresh_id)
    rng = np.random.default_rng(5)
    poses = _about_the_can()
    poses[:, :3, 3] += rng.uniform([0.1, -0.4, -0.1], [0.9, 0.4, 0.7], (len(poses), 3))
    rows = [",".join(map(str, [*pose[:3, 3], *files.quaternion(pose[:3, :3]), 1])) for pose in poses]
    (tmp_path / "scene.csv").write_text("\n".join(["x,y,z,qx,qy,qz,qw,success", *rows]))
    code, _, err = run("import", str(tmp_path / "scene.csv"), "--object", fresh_id, "--gripper", "panda")
    assert code == 1
    assert "with --unit" not in err


@pytest.mark.parametrize("format", ["moveit", "isaac"])
def test_keys_may_hold_the_numbers_of_a_quaternion_in_the_other_order(
    db: Client, run: Run, fresh_id: str, tmp_path: Path, format: str
) -> None:
    can = _can(db, fresh_id)
    tools = _from_above()
    wrong = [np.roll(files.quaternion(pose[:3, :3]), 1 if format == "moveit" else -1) for pose in tools]
    poses = matrices(tools[:, :3, 3], np.array(wrong))
    if format == "moveit":
        path, order = files.moveit(tmp_path / "a.yaml", poses, [1.0] * 60), "wxyz"
    else:
        path, order = files.isaac(tmp_path / "a.yaml", poses, [1.0] * 60), "xyzw"
    arguments = ("import", path, "--object", fresh_id, "--gripper", "panda", "--frame", "tool")
    arguments += ("--convention", "graspdb", "--outcome", "success")
    code, _, err = run(*arguments)
    assert code == 1
    assert f"with --quaternion-order {order} " in err
    code, _, err = run(*arguments, "--quaternion-order", order)
    assert code == 0, err
    assert can.trials.list().arrays().matrices == pytest.approx(tools, abs=1e-9)


def test_what_only_would_choose_is_there(tmp_path: Path, db: Client) -> None:
    rows = np.zeros((4, 17))
    rows[:, [4, 8, 12]], rows[:, 16] = 1.0, [5, 5, 7, 7]
    np.save(tmp_path / "a.npy", rows)
    panda = db.grippers.get("panda")
    with pytest.raises(ValueError, match="has no grasps of object 9; there are 5, 7"):
        interop.read(
            tmp_path / "a.npy",
            gripper=panda,
            object_pose=np.eye(4),
            only={"object_id": "9"},
            outcome="success",
        )
