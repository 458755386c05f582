"""Answers from the client's side: kept under names, given again, listed, deleted; trials that try them."""

from __future__ import annotations

import json
from collections.abc import Callable

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
