"""Selections and constraints of the SDK's questions, and grasps chosen before any success."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh

from graspdb import Client, Infeasible, wire
from graspdb.errors import AmbiguousSelection, Conflict, InvalidInput
from graspdb.reports import Reports
from graspdb.resources.objects import GraspObject
from graspdb.resources.selection import Bounds, Constraints, Selection, TrialSelection

Run = Callable[..., tuple[int, str, str]]
DOWN = [1.0, 0.0, 0.0, 0.0]


@pytest.fixture
def grasped(db: Client, fresh_id: str, clusters: Callable[..., np.ndarray]) -> GraspObject:
    """An object with 200 successes from above by one gripper, and 40 by another."""
    item = db.objects.create(fresh_id)
    poses = clusters([([0.0, 0.0, 0.06], DOWN)], 240)
    item.trials.add(poses[:200], True, gripper="pg70", source="robot")
    item.trials.add(poses[200:], True, gripper="panda", source="human")
    return item.refresh()


@pytest.fixture
def untried(db: Client, fresh_id: str) -> GraspObject:
    """An object with a mesh and no trial."""
    return db.objects.create(fresh_id, mesh=trimesh.creation.box([0.03, 0.05, 0.12]))


def test_keywords_are_what_the_service_takes() -> None:
    assert set(Selection.__optional_keys__) == set(wire.Selection.model_fields)
    assert set(TrialSelection.__optional_keys__) < set(Selection.__optional_keys__)
    corners = set(Constraints.__optional_keys__) - {"box"} | {"box_min", "box_max"}
    # A belief goes in as the object's pose.
    assert corners == set(wire.BestGraspRequest.model_fields) - {"count", "object_belief"}
    # Each is told of where it is declared.
    told = " ".join(inspect.getdoc(kind) or "" for kind in (TrialSelection, Selection, Constraints))
    assert all(name in told for name in Constraints.__optional_keys__)
    bounds = set(Bounds.__optional_keys__) - {"box"} | {"box_min", "box_max"}
    assert bounds == set(wire.queries.PostedBounds.model_fields)


def test_a_wrong_keyword_is_a_type_error_that_names_it(db: Client, fresh_id: str) -> None:
    item = db.objects.create(fresh_id)
    calls: list[Callable[..., Any]] = [
        item.density, item.best_grasp, item.best_grasps, item.samples, item.proposals,
        lambda **given: item.likelihood(np.eye(4), **given),
        *(getattr(item.reports, name) for name, _ in inspect.getmembers(Reports, inspect.isfunction)
          if not name.startswith("_") and name != "simulate"),
    ]  # fmt: skip
    assert len(calls) >= 12
    for call in calls:
        with pytest.raises(TypeError, match="'griper'"):
            call(griper="pg70")
    with pytest.raises(TypeError, match="did you mean 'approach_cone_deg'"):
        item.best_grasp(approach_cone=30)  # type: ignore[call-arg]


def test_selections_choose_trials_and_kernels_everywhere(grasped: GraspObject) -> None:
    spec = {"kind": "isotropic", "sigma_position_m": 0.011, "sigma_rotation_deg": 12}
    for kernel in (spec, wire.KernelSpec.model_validate(spec)):
        density = grasped.density(gripper="pg70", kernel=kernel)
        assert (density.size, density.kernel.sigma_position_m) == (200, 0.011)
        drawn = grasped.samples(10, seed=1, gripper="pg70", kernel=kernel)
        there = grasped.likelihood(drawn, gripper="pg70", kernel=kernel)
        assert np.allclose(there.density, drawn.proposal_density, rtol=1e-2)
    assert grasped.density(gripper="panda", source="human").size == 40
    with pytest.raises(ValueError, match="twice"):
        grasped.density(gripper="pg70", kernel=spec, sigma_position_m=0.02)
    with pytest.raises(ValueError, match="cutoff"):
        grasped.density(gripper="pg70", kernel={**spec, "cutoff": 5})
    with pytest.raises(InvalidInput, match="sigma_position_m"):
        grasped.density(gripper="pg70", kernel={"sigma_position_m": -1})
    report = grasped.reports.projection(gripper="pg70", kernel=spec)
    assert report.raw.kernel.sigma_position_m == 0.011


def test_poses_of_an_answer_are_asked_about_with_its_gripper(grasped: GraspObject) -> None:
    best, drawn = grasped.best_grasp(gripper="panda"), grasped.samples(3, seed=1, gripper="panda")
    assert (best.gripper, drawn.gripper) == ("panda", "panda")
    for poses in (best, [best, best], drawn):
        alone, told = grasped.likelihood(poses), grasped.likelihood(poses, gripper="panda")
        assert alone.density == pytest.approx(told.density)
    assert grasped.best_grasp(candidates=[best]).density == pytest.approx(best.density)
    # What is named counts; of two that are not of one gripper nothing is guessed, nor of bare numbers.
    other = grasped.likelihood(best, gripper="pg70")
    assert other.selection is not None
    assert other.selection.gripper == "pg70"
    for mixed in ([best, grasped.best_grasp(gripper="pg70")], best.matrix):
        with pytest.raises(AmbiguousSelection):
            grasped.likelihood(mixed)


def test_grasps_before_any_success_say_so(untried: GraspObject, run: Run) -> None:
    with pytest.raises(Infeasible, match="name a gripper"):
        untried.best_grasp()
    with pytest.raises(Infeasible, match="no successful trial"):
        untried.best_grasp(gripper="pg70", prior=False)
    with pytest.raises(Conflict, match="gripper"):
        untried.best_grasp(prior=True)
    best = untried.best_grasp(gripper="pg70", approach=(0, 0, -1), approach_cone_deg=30)
    assert best.prior
    assert best.collision_free
    assert best.success_probability is None
    assert best.approach[2] < -0.86
    assert "prior=True" in repr(best)
    assert "edges" in best.summary()["chosen by"]
    drawn = untried.proposals(100, strategy="edges", gripper="pg70", seed=1)
    assert "opposed" in (drawn.criterion or "")
    assert best.density > np.median(drawn.proposal_density)
    within = {"box": ([-0.3, -0.3, 0.0], [0.3, 0.3, 0.3]), "approach": (0, 0, -1), "approach_cone_deg": 30}
    sought = untried.proposals(5, strategy="expected_improvement", gripper="pg70", seed=1, **within)
    assert sought.prior
    assert sought.expected_gain is not None
    assert (sought.expected_gain > 0).all()
    assert drawn.expected_gain is None
    assert (sought.matrices[:, 2, 2] < -0.7).all()
    assert (sought.position[:, 2] > -0.02).all()
    with pytest.raises(InvalidInput, match="approach"):
        untried.proposals(5, strategy="edges", gripper="pg70", **within)
    receipt = untried.trials.add(
        drawn.poses, True, gripper="pg70", source="robot", proposal_density=drawn.proposal_density
    )
    assert receipt.inserted == 100
    assert not untried.best_grasp().prior
    untried.batches.delete(receipt.batch)

    code, out, _ = run("--json", "best-grasp", untried.id, "--gripper", "pg70")
    assert (code, json.loads(out)["grasps"][0]["prior"]) == (0, True)
    command = ("proposals", untried.id, "--strategy", "expected_improvement", "--gripper", "pg70")
    code, out, _ = run(*command, "--approach", "0,0,-1", "--approach-cone-deg", "30", "--seed", "1")
    assert code == 0
    assert "expected gain" in out
    code, out, _ = run("--json", "best-grasp", untried.id, "--no-prior")
    assert (code, json.loads(out)["grasps"]) == (1, [])
