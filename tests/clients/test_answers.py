"""Answers from the client's side: kept under names, given again, listed, deleted; trials that try them."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graspdb import Client
from graspdb.errors import Conflict, InvalidInput, NotFound
from graspdb.resources.objects import GraspObject
from graspdb.resources.results import Grasps, LikelihoodArrays, SampledPoses

Run = Callable[..., tuple[int, str, str]]
DOWN = [1.0, 0.0, 0.0, 0.0]


@pytest.fixture
def tried(db: Client, fresh_id: str, clusters: Callable[..., np.ndarray]) -> GraspObject:
    """An object with 120 successes and 60 failures."""
    item = db.objects.create(fresh_id)
    poses = clusters([([0.0, 0.0, 0.06], DOWN)], 180)
    item.trials.add(poses, [i % 3 != 0 for i in range(180)], gripper="pg70", protocol="lift", source="robot")
    return item.refresh()


def test_answers_are_given_again(db: Client, tried: GraspObject) -> None:
    name = f"bin-{tried.id}"
    best = tried.best_grasp(name=name)
    assert best.answer is not None
    tried.trials.add(best, False, gripper="pg70", protocol="lift", source="robot")
    kept = db.answers.get(name)
    assert (kept.id, kept.names, kept.kind) == (best.answer, (name,), "best-grasp")
    assert (kept.revision, kept.object_revision, kept.gripper) == (1, 2, "pg70")
    assert isinstance(kept.result, Grasps)
    assert kept.result[0].raw == best.raw
    assert "(the object is at 2)" in kept.summary()["revision"]
    again = tried.best_grasps(count=1, name=name)
    assert (again.revision, again.newer_revision) == (1, 2)
    today = db.answers.get(best.answer, now=True)
    assert today.revision == 2
    assert today.id == tried.best_grasp().answer
    drawn, likely = tried.samples(5), tried.likelihood(best)
    for found, kind in (
        (drawn, SampledPoses),
        (likely, LikelihoodArrays),
        (tried.proposals(3), SampledPoses),
    ):
        assert found.answer is not None
        assert isinstance(db.answers.get(found.answer).result, kind)
    assert np.array_equal(db.answers.get(drawn.answer or "").result.columns()["x"], drawn.poses[:, 0])
    kinds = [item.kind for item in tried.answers()]
    assert set(kinds) == {"best-grasp", "likelihood", "samples", "proposals"}
    assert [item.answer for item in tried.answers(name=name)] == [best.answer]
    assert tried.likelihood(drawn.poses.repeat(300, axis=0)).answer is None
    with pytest.raises(InvalidInput, match=r"1,000"):
        tried.samples(1_001, name="many")
    with pytest.raises(Conflict, match="another question"):
        tried.samples(3, name=name)
    db.answers.delete(name)
    with pytest.raises(NotFound, match="name="):
        db.answers.get(name)


def test_answers_on_the_command_line(tried: GraspObject, run: Run) -> None:
    name = f"cell-{tried.id}"
    code, out, _ = run("best-grasp", tried.id, "--name", name)
    assert code == 0
    assert "answer" in out
    code, out, _ = run("--json", "answers", "get", name)
    answer = json.loads(out)
    assert (code, answer["names"]) == (0, [name])
    tried.trials.add(answer["result"]["grasps"][0]["position"] + DOWN, False, gripper="pg70", protocol="lift")
    code, out, err = run("best-grasp", tried.id, "--name", name)
    assert "revision 1" in err
    assert "leave --name out" in err
    code, out, _ = run("answers", "get", name)
    assert (code, "quaternion" in out) == (0, True)
    code, out, _ = run("answers", "get", name, "--now", "--csv")
    assert out.startswith("x,y,z,")
    code, out, _ = run("answers", "list", tried.id)
    assert answer["answer"] in out
    code, _, err = run("best-grasp", tried.id, "--count", "2", "--name", name)
    assert code == 1
    assert f"graspdb answers delete {name}" in err
    assert run("answers", "delete", name, "--yes")[0] == 0
    code, _, err = run("answers", "get", name)
    assert code == 1
    assert "--name" in err


def test_a_grasp_reports_what_became_of_it(db: Client, tried: GraspObject) -> None:
    best = tried.best_grasp()
    achieved = best.matrix
    achieved[0, 3] += 0.002
    receipt = best.report(False, achieved_pose=achieved, width_m=0.03)
    (trial,) = tried.trials.list(batch=receipt.batch)
    assert (trial.answer, trial.gripper, trial.protocol, trial.source) == (
        best.answer,
        "pg70",
        "lift",
        "robot",
    )
    assert trial.achieved_pose is not None
    assert np.allclose(trial.achieved_pose.position, achieved[:3, 3])
    assert np.allclose(trial.position, best.position)
    again = db.answers.get(best.answer or "")
    assert again.trials == 1
    assert isinstance(again.result, Grasps)
    again.result[0].report("success", protocol=None)
    assert pickle.loads(pickle.dumps(best)).answer == best.answer
    with pytest.raises(Conflict, match="stays with"):
        db.answers.delete(again.id)


def test_achieved_poses_in_arrays_and_files(tried: GraspObject, run: Run, tmp_path: Path) -> None:
    drawn = tried.samples(3)
    moved = drawn.matrices
    moved[:, 0, 3] += 0.001
    one = tried.trials.add(drawn, True, answer=drawn.answer, achieved_poses=moved)
    two = tried.trials.add(
        drawn, [True, False, True], answer=[drawn.answer, None, None], achieved_poses=[None, moved[1], None]
    )
    with pytest.raises(ValueError, match="achieved_poses has 2 poses for 3"):
        tried.trials.add(drawn, True, achieved_poses=moved[:2])
    found = tried.trials.list(batch=one.batch).arrays()
    assert np.allclose(found.achieved.position, moved[:, :3, 3])
    assert [t.answer for t in found.trials] == [drawn.answer] * 3
    other = tried.trials.list(batch=two.batch).arrays()
    assert np.isnan(other.achieved.position[:, 0]).tolist() == [True, False, True]
    assert {"achieved_x", "achieved_qw", "answer"} <= set(other.columns())
    file = tmp_path / "tried.csv"
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    rows = [[*pose, "success", *(["" for _ in pose] if i else pose)] for i, pose in enumerate(drawn.poses)]
    header = [*names, "outcome", *(f"achieved_{name}" for name in names)]
    file.write_text("\n".join(",".join(map(str, row)) for row in [header, *rows]))
    code, out, _ = run("--json", "trials", "add", tried.id, str(file), "--answer", drawn.answer or "")
    assert code == 0
    stored = tried.trials.list(batch=json.loads(out)["batches"][0]).arrays()
    assert [t.answer for t in stored.trials] == [drawn.answer] * 3
    assert np.isnan(stored.achieved.position[:, 0]).tolist() == [False, True, True]
    code, _, err = run("trials", "add", tried.id, str(file), "--answer", "nothing")
    assert code == 1
    assert "no answer about this object" in err


def test_the_promises_report(tried: GraspObject, run: Run, tmp_path: Path) -> None:
    for _ in range(2):
        tried.best_grasp().report(True)
    report = tried.reports.promises()
    assert report.verdict == "undecided"
    assert report.difference.low is not None
    assert "too little" in report.text
    figure = tmp_path / "promises.svg"
    code, out, err = run("report", tried.id, "promises", "--figure", str(figure))
    assert code == 0
    assert "answers tried" in out
    assert "Only what promised" in err
    assert figure.read_text().startswith("<?xml")
