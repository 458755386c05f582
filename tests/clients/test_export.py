"""``graspdb export``: trials, samples and best grasps in formats of the field, and back by ``import``."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graspdb import Client, interop
from graspdb.resources.objects import GraspObject

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def tried(db: Client, fresh_id: str, clusters: Callable[..., np.ndarray]) -> GraspObject:
    """An object with a hundred trials of a panda, of which seventy held."""
    item = db.objects.create(fresh_id)
    poses = clusters([([0.0, 0.0, 0.05], [1.0, 0.0, 0.0, 0.0])], 100)
    outcomes = ["success"] * 70 + ["slipped"] * 30
    item.trials.add(poses, outcomes, gripper="panda", source="robot", quality=np.arange(100.0))
    return item


@pytest.mark.parametrize("name", ["t.csv", "t.jsonl", "t.parquet", "t.h5"])
def test_trials_go_out_and_come_back(
    db: Client, run: Run, tried: GraspObject, tmp_path: Path, name: str
) -> None:
    path = str(tmp_path / name)
    code, out, err = run("export", tried.id, "--what", "trials", "-o", path)
    assert code == 0, err
    assert "100 grasps written" in out
    assert ("why a grasp failed (slipped)" in out) == (name == "t.h5")
    other = db.objects.create(f"{tried.id}-back")
    code, _, err = run("import", path, "--object", other.id, "--gripper", "panda", "--source", "robot")
    assert code == 0, err
    before, after = tried.trials.list().arrays(), other.trials.list().arrays()
    assert after.matrices == pytest.approx(before.matrices, abs=1e-9)
    if name == "t.h5":
        assert after.success.tolist() == before.success.tolist()
    else:
        assert after.outcome.tolist() == before.outcome.tolist()
        assert [t.quality for t in other.trials] == [t.quality for t in tried.trials]
    other.delete()


def test_best_grasps_and_samples_have_probabilities_for_confidences(
    db: Client, run: Run, tried: GraspObject, tmp_path: Path
) -> None:
    for what in ("best",):
        path = str(tmp_path / f"{what}.yaml")
        arguments = (
            "--json",
            "export",
            tried.id,
            "--what",
            what,
            "--count",
            "5",
            "--format",
            "isaac",
            "-o",
            path,
        )
        code, out, err = run(*arguments)
        assert code == 0, err
        report = json.loads(out)
        assert report["frame"] == "base"
        assert "success_probability to confidence" in report["mapped"]
        read = interop.read(path, gripper=db.grippers.get("panda"), frame="base", convention="graspdb")
        assert 1 <= len(read) <= 5
        assert np.linalg.norm(read.position - [0, 0, 0.05], axis=1).max() < 0.1


def test_a_count_and_filters_choose_trials(run: Run, tried: GraspObject, tmp_path: Path) -> None:
    path = str(tmp_path / "t.jsonl")
    arguments = ("export", tried.id, "--what", "trials", "--outcome", "slipped", "--count", "7", "-o", path)
    code, _, err = run(*arguments)
    assert code == 0, err
    rows = [json.loads(line) for line in Path(path).read_text().splitlines()]
    assert [row["outcome"] for row in rows] == ["slipped"] * 7
    assert rows[0]["quality"] == 70


def test_what_cannot_be_written_says_what_to_give(run: Run, tried: GraspObject, tmp_path: Path) -> None:
    code, _, err = run("export", tried.id, "-o", str(tmp_path / "a.yaml"))
    assert code == 1
    assert "--format" in err
    code, _, err = run("export", tried.id, "--what", "all", "-o", str(tmp_path / "a.csv"))
    assert code == 2
    code, _, err = run("export", tried.id, "--frame", "wrist", "-o", str(tmp_path / "a.csv"))
    assert code == 1
    assert "--frame" in err


def test_moveit_is_of_the_flange_where_the_gripper_has_one(
    run: Run, tried: GraspObject, tmp_path: Path
) -> None:
    path = str(tmp_path / "a.yaml")
    code, out, err = run("export", tried.id, "--format", "moveit", "--what", "trials", "-o", path)
    assert code == 0, err
    assert "poses of flange" in out


def test_of_two_twins_that_nearer_to_a_turn_is_written(
    db: Client, run: Run, tried: GraspObject, tmp_path: Path
) -> None:
    """In the frame that is written, which for isaac is the base."""
    gripper = db.grippers.get("panda")
    for what in ("best", "samples"):
        turns = {}
        for near in ("0,0,0,1", "0,0,1,0"):
            path = str(tmp_path / f"{what}-{near}.yaml")
            arguments = (
                ("--what", what, "--count", "3", "--seed", "1") if what == "samples" else ("--count", "3")
            )
            code, _, err = run(
                *("export", tried.id, *arguments, "--format", "isaac", "-o", path),
                *("--gripper", "panda", "--near", near),
            )
            assert code == 0, err
            read = interop.read(path, gripper=gripper, frame="base", convention="graspdb")
            # The Panda's base is turned as its tool is.
            turns[near] = read.quaternion_xyzw
            wanted = np.array([float(x) for x in near.split(",")])
            twins = turns[near][:, [1, 0, 3, 2]] * [1, -1, 1, -1]
            assert np.all(np.abs(turns[near] @ wanted) >= np.abs(twins @ wanted) - 1e-9)
        first, second = turns.values()
        assert not np.allclose(np.abs(np.sum(first * second, axis=1)), 1.0)
    code, _, err = run(
        "export", tried.id, "--what", "trials", "-o", str(tmp_path / "t.csv"), "--near", "0,0,0,1"
    )
    assert code == 2
    assert "as they were posted" in err
