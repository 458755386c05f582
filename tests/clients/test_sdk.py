"""The SDK against the real service."""

from __future__ import annotations

import importlib.util
import multiprocessing
import struct
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from graspdb import Client, Infeasible, wire
from graspdb.errors import (
    AmbiguousSelection,
    Conflict,
    GraspDBError,
    InvalidInput,
    LeaseLost,
    NotFound,
    Unreachable,
    error_for,
)
from graspdb.files.meshes import read_mesh
from graspdb.poses import as_poses, matrices
from graspdb.resources.objects import GraspObject
from graspdb.resources.trials import DoubtfulTrials

DOWN = [1.0, 0.0, 0.0, 0.0]
SIDE = [0.0, 0.5**0.5, 0.0, 0.5**0.5]
ABOVE, LEFT = [0.0, 0.0, 0.06], [-0.08, 0.0, 0.0]


def _box(lower: tuple[float, ...], upper: tuple[float, ...]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[lower, upper])


@pytest.fixture
def grasped(db: Client, fresh_id: str, clusters: Callable[..., np.ndarray]) -> GraspObject:
    """An object with successes from above and (fewer) from the side."""
    item = db.objects.create(fresh_id, mass_kg=0.2)
    item.trials.add(clusters([(ABOVE, DOWN)], 200), True, gripper="pg70", source="robot")
    item.trials.add(clusters([(LEFT, SIDE)], 100, seed=1), True, gripper="pg70", source="robot")
    return item.refresh()


def test_an_object_from_creation_to_deletion(db: Client, fresh_id: str) -> None:
    made = db.objects.create(fresh_id, name="Box", mass_kg=0.2, friction=0.5, metadata={"shelf": 3})
    assert fresh_id in [item.id for item in db.objects.list()]
    found = db.objects.get(fresh_id)
    assert (found.info.name, found.info.mass_kg, found.info.metadata) == ("Box", 0.2, {"shelf": 3})
    made.patch(name=None, mass_kg=0.3)
    assert (made.info.name, made.info.mass_kg, made.info.friction) == (None, 0.3, 0.5)
    with pytest.raises(Conflict):
        db.objects.create(fresh_id)
    made.delete()
    with pytest.raises(NotFound):
        db.objects.get(fresh_id)


def test_wrong_properties_are_named_before_anything_is_sent(db: Client, fresh_id: str) -> None:
    with pytest.raises(InvalidInput, match="mass_kg") as caught:
        db.objects.create(fresh_id, mass_kg=-1)
    assert [item.field for item in caught.value.fields] == ["mass_kg"]
    with pytest.raises(InvalidInput, match="id"):
        db.objects.create("no/slug")
    with pytest.raises(NotFound):
        db.objects.get("../grippers")


def test_a_mesh_is_scaled_beside_its_unit(db: Client, fresh_id: str) -> None:
    made = db.objects.create(fresh_id, mesh=_box((-1, -1, -1), (1, 1, 1)), unit="cm", scale=2.5)
    assert made.info.mesh is not None
    assert (made.info.mesh.unit, made.info.mesh.scale) == ("cm", 2.5)
    assert made.info.mesh.bounding_box.upper == pytest.approx((0.025, 0.025, 0.025))
    info = made.upload_mesh(_box((-1, -1, -1), (1, 1, 1)), scale=0.04)
    assert info.volume_m3 == pytest.approx(0.08**3, rel=1e-5)


@pytest.mark.parametrize("form", ["file", "bytes", "mesh", "scene"])
def test_a_mesh_comes_as_file_bytes_or_trimesh(db: Client, fresh_id: str, form: str, tmp_path: Path) -> None:
    box = _box((-20, -30, -50), (20, 30, 50))
    path = tmp_path / "box.stl"
    box.export(path)
    mesh = {"file": path, "bytes": path.read_bytes(), "mesh": box, "scene": trimesh.Scene(box)}[form]
    made = db.objects.create(fresh_id, mesh=mesh, unit="mm")
    assert made.info.mesh is not None
    assert made.info.mesh.watertight
    assert made.info.mesh.bounding_box.upper == pytest.approx((0.02, 0.03, 0.05))
    assert made.info.mesh.volume_m3 == pytest.approx(0.04 * 0.06 * 0.1, rel=1e-5)
    if form in {"file", "bytes"}:
        assert made.download_mesh() == path.read_bytes()
    assert "watertight" in made._repr_html_()


def test_a_refused_mesh_leaves_no_object(db: Client, fresh_id: str, tmp_path: Path) -> None:
    broken = b"\0" * 80 + struct.pack("<I", 1) + struct.pack("<12fH", *[float("nan")] * 12, 0)
    with pytest.raises(InvalidInput):
        db.objects.create(fresh_id, mesh=broken)
    with pytest.raises(FileNotFoundError):
        db.objects.create(fresh_id, mesh=tmp_path / "nowhere.stl")
    with pytest.raises(ValueError, match=r"\.stl"):
        db.objects.create(fresh_id, mesh="mug.step")
    with pytest.raises(ValueError, match="media_type"):
        db.objects.create(fresh_id, mesh=b"v 0 0 0")
    with pytest.raises(NotFound):
        db.objects.get(fresh_id)


def test_convex_parts_from_meshes(db: Client, fresh_id: str) -> None:
    parts = [_box((0, 0, 0), (0.02, 0.02, 0.1)), _box((0, 0, 0.1), (0.06, 0.02, 0.12))]
    made = db.objects.create(fresh_id, mesh=trimesh.util.concatenate(parts), convex_parts=parts)
    assert made.info.convex_parts is not None
    assert made.info.convex_parts.parts == 2
    assert made.info.convex_parts.volume_m3 == pytest.approx(0.02 * 0.02 * 0.1 + 0.06 * 0.02 * 0.02, rel=1e-4)
    assert made.download_convex_parts()[:4] == b"glTF"


def test_parts_that_fill_a_room_are_taken_on_request_alone(db: Client, fresh_id: str) -> None:
    tube = trimesh.creation.annulus(r_min=0.03, r_max=0.035, height=0.1)
    made = db.objects.create(fresh_id, mesh=tube)
    with pytest.raises(InvalidInput, match="accept_deviation"):
        made.upload_convex_parts([tube.convex_hull])
    made.upload_convex_parts([tube.convex_hull], accept_deviation=True)
    assert made.info.convex_parts is not None
    assert made.info.convex_parts.deviates
    assert "mm off the mesh" in made.summary()["convex parts warning 1"]


def test_examples_come_with_mesh_parts_and_mass(db: Client) -> None:
    made = db.add_example("cone")
    assert made.info.mesh is not None
    assert made.info.convex_parts is not None
    assert made.info.mass_kg is not None
    with pytest.raises(Conflict):
        db.add_example("cone")
    with pytest.raises(ValueError, match="screwdriver"):
        db.add_example("teapot")
    made.delete()


def test_a_copy_takes_the_trials_along(db: Client, fresh_id: str) -> None:
    item = db.objects.create(fresh_id, mass_kg=0.1)
    item.trials.add([0, 0, 0.1, 0, 0, 0, 1], True)
    copy = item.copy(f"{fresh_id}-2", trials=True)
    assert (copy.info.trials, copy.info.mass_kg) == (1, 0.1)
    assert copy.summary()["copied from"] == f"{fresh_id}, revision 1"
    assert item.copy(f"{fresh_id}-3").info.trials == 0


def test_grippers(db: Client, fresh_id: str) -> None:
    assert {"pg70", "panda"} <= {g.id for g in db.grippers.list()}
    profile = db.grippers.get("pg70").profile.model_dump(exclude_none=True)
    made = db.grippers.create(fresh_id, **profile | {"force_n": 10.0})
    assert db.grippers.get(fresh_id).profile == made.profile
    corrected = db.grippers.update(fresh_id, **profile | {"force_n": 12.0})
    assert (corrected.version, corrected.changed) == (2, ["force_n"])
    assert [found.version for found in db.grippers.versions(fresh_id)] == [1, 2]
    assert db.grippers.get(f"{fresh_id}@1").profile == made.profile
    assert made.profile.force_n == 10.0
    with pytest.raises(InvalidInput, match="finger"):
        db.grippers.create("incomplete", max_opening_m=0.1, palm_size_m=(0.1, 0.1, 0.1))


def test_trials_round_trip_in_order(db: Client, fresh_id: str, clusters: Callable[..., np.ndarray]) -> None:
    item = db.objects.create(fresh_id)
    poses = clusters([(ABOVE, DOWN), (LEFT, SIDE)], 600)
    outcomes = np.where(np.arange(1200) % 3 == 0, "success", "slipped")
    receipt = item.trials.add(
        matrices(*as_poses(poses)),
        outcomes,
        gripper="panda",
        source="simulation",
        quality=np.linspace(0, 1, 1200),
        width_m=0.04,
        metadata={"run": 7},
    )
    assert receipt.inserted == 1200
    stored = item.trials.list().arrays()  # more than one page
    assert np.allclose(stored.position, poses[:, :3], atol=1e-12)
    assert np.allclose(np.abs(np.sum(stored.quaternion_xyzw * poses[:, 3:], axis=1)), 1)
    assert stored.outcome.tolist() == outcomes.tolist()
    assert int(stored.success.sum()) == 400
    first = stored.trials[0]
    assert (first.gripper, first.source, first.width_m, first.metadata) == (
        "panda",
        "simulation",
        0.04,
        {"run": 7},
    )
    assert stored.trials[-1].quality == 1.0
    assert len(list(item.trials.list(outcome="success"))) == 400
    assert item.refresh().info.outcomes == {"success": 400, "slipped": 800}


def test_a_big_upload_goes_in_batches_and_repeats_safely(
    db: Client, fresh_id: str, clusters: Callable[..., np.ndarray]
) -> None:
    item = db.objects.create(fresh_id)
    poses = clusters([(ABOVE, DOWN)], 25)
    seen = []
    send = {
        "chunk": 10,
        "idempotency_key": "upload",
        "progress": lambda done, total: seen.append((done, total)),
    }
    receipt = item.trials.add(poses, False, **send)
    assert (receipt.inserted, len(receipt.batches)) == (25, 3)
    assert seen == [(10, 25), (20, 25), (25, 25)]
    assert item.trials.add(poses, False, **send) == receipt
    assert item.refresh().info.outcomes == {"failure": 25}
    assert [b.inserted for b in item.batches.list()] == [10, 10, 5]
    with pytest.raises(ValueError, match="3 batches"):
        _ = receipt.batch
    item.batches.delete(receipt.batches[1])
    assert item.refresh().info.trials == 15
    assert {b.batch for b in item.batches} == set(receipt.batches) - {receipt.batches[1]}
    with pytest.raises(Conflict):  # the deleted batch's key does not bring it back
        item.trials.add(poses, False, **send)


def test_doubtful_trials_are_warned_of_and_counted_from_the_first(
    db: Client, fresh_id: str, clusters: Callable[..., np.ndarray]
) -> None:
    item = db.objects.create(fresh_id)
    poses, east = clusters([(ABOVE, DOWN)], 20), np.eye(7)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert item.trials.add(poses, True).findings == ()
    with pytest.warns(DoubtfulTrials, match="posted before") as told:
        receipt = item.trials.add(np.concatenate([poses[:5] + 0.001 * east, poses[5:]]), True, chunk=10)
    assert told[0].filename == __file__
    assert [(f.code, f.count, f.first_indices[0]) for f in receipt.findings] == [
        ("posted-before", 5, 5),
        ("posted-before", 10, 10),
    ]
    upload_mesh = trimesh.creation.box((0.04, 0.06, 0.1))
    item.upload_mesh(upload_mesh)
    far = poses + 50.0 * east
    with pytest.raises(InvalidInput, match="accept_implausible"):
        item.trials.add(far, True)
    with pytest.warns(DoubtfulTrials, match="ten times its size"):
        item.trials.add(far, True, accept_implausible=True)


def test_a_trial_is_withdrawn_and_corrected(db: Client, fresh_id: str) -> None:
    item = db.objects.create(fresh_id)
    item.trials.add([[*ABOVE, *DOWN], [*ABOVE[:2], 0.2, *DOWN]], True)
    item.trials.withdraw(1, reason="slipped before")
    assert item.trials.get(1).history[0].reason == "slipped before"
    assert item.refresh().info.outcomes == {"success": 1}
    assert [trial.seq for trial in item.trials.list(withdrawn=False)] == [2]
    found = item.trials.correct(2, outcome="dropped", metadata={"by": "me"})
    assert (found.outcome, found.metadata) == ("dropped", {"by": "me"})
    assert not item.trials.correct(1, withdrawn=False).withdrawn
    assert item.refresh().info.outcomes == {"success": 1, "dropped": 1}
    with pytest.raises(NotFound):
        item.trials.withdraw(3)


def test_one_pose_is_a_trial_too(db: Client, fresh_id: str) -> None:
    item = db.objects.create(fresh_id)
    item.trials.add(matrices(ABOVE, DOWN), True)
    item.trials.add([*ABOVE, *DOWN], "missed")
    assert [t.outcome for t in item.trials] == ["success", "missed"]


@pytest.mark.parametrize(
    ("poses", "outcomes", "options", "reason"),
    [
        (np.zeros((2, 7)), [True, False], {}, "unit quaternion"),
        (np.eye(4)[None], [True, False], {}, r"expected \(1,\)"),
        (np.eye(4)[None], ["perfect"], {}, "'perfect'"),
        (np.eye(4)[None], [1.5], {}, "1.5"),
        (np.eye(4)[None], True, {"quality": [1, 2]}, "quality"),
        (np.eye(4)[None], True, {"pose_covariance": np.eye(3)}, "pose_covariance"),
        (np.eye(4)[None], True, {"metadata": [{}, {}]}, "metadata"),
        (np.eye(4)[None], True, {"chunk": 0}, "chunk"),
    ],
)
def test_wrong_trials_are_refused_before_anything_is_sent(
    db: Client, fresh_id: str, poses: np.ndarray, outcomes: object, options: dict[str, object], reason: str
) -> None:
    item = db.objects.create(fresh_id)
    with pytest.raises(ValueError, match=reason):
        item.trials.add(poses, outcomes, **options)
    assert item.refresh().info.revision == db.objects.get(fresh_id).info.revision
    assert item.info.trials == 0


def test_the_service_names_the_trial_and_later_chunks_say_where_they_start(db: Client, fresh_id: str) -> None:
    item = db.objects.create(fresh_id)
    good = {"position": ABOVE, "quaternion_xyzw": DOWN, "outcome": "success"}
    with pytest.raises(InvalidInput, match="colour") as caught:
        item.trials.add_records([good, good, good | {"colour": "red"}], chunk=2)
    assert "trials 2 to 2" in caught.value.__notes__[0]
    assert item.refresh().info.trials == 2


def test_best_grasp_within_constraints(grasped: GraspObject) -> None:
    best = grasped.best_grasp()
    assert np.allclose(best.position, ABOVE, atol=0.005)
    assert best.relative == pytest.approx(1, abs=1e-3)
    assert np.allclose(best.approach, [0, 0, -1], atol=0.1)
    assert best.matrix[:3, 3].tolist() == best.position.tolist()
    assert np.exp(best.log_density) == pytest.approx(best.density, rel=1e-6)
    for constraint in (
        {"box": ([-0.2, -0.1, -0.05], [-0.05, 0.1, 0.03])},
        {"sphere": [*LEFT, 0.03]},
        {"approach": (1, 0, 0), "approach_cone_deg": 30},
        {"above_plane": (0, 0, -1, -0.02)},
    ):
        aside = grasped.best_grasp(**constraint)
        assert np.allclose(aside.position, LEFT, atol=0.006), constraint
        assert 0.2 < aside.relative < 0.8


def test_best_grasps_are_distinct_and_best_first(grasped: GraspObject) -> None:
    found = grasped.best_grasps(count=2, min_separation_m=0.05)
    assert len(found) == 2
    assert found[0].density > found[1].density
    assert np.allclose(found[1].position, LEFT, atol=0.006)
    assert found.matrices.shape == (2, 4, 4)
    assert found[:1][0] is found[0]


def test_the_world_frame(grasped: GraspObject) -> None:
    # Turned by a quarter about z, half a metre ahead: what was x is now y.
    half = 0.5**0.5
    pose = [0.5, 0, 0.1, 0, 0, half, half]
    best = grasped.best_grasp(object_pose=pose, approach=(0, 1, 0), approach_cone_deg=30)
    assert np.allclose(best.position, LEFT, atol=0.006)
    assert np.allclose(best.world, matrices(pose[:3], pose[3:]) @ best.matrix, atol=1e-6)
    same = grasped.best_grasp(
        object_pose=matrices(pose[:3], pose[3:]), frame="object", approach=(1, 0, 0), approach_cone_deg=30
    )
    assert np.allclose(same.position, best.position, atol=1e-4)
    # What was measured in millimetres lies half a kilometre away.
    (far,) = grasped.best_grasp(object_pose=[500, 0, 100, 0, 0, half, half]).warnings
    assert "By object_pose the object lies 510 m" in far
    assert best.warnings == ()


def test_candidates_exclusions_and_half_spaces_as_arrays(grasped: GraspObject) -> None:
    poses = np.array([[*LEFT, *grasped.best_grasp(sphere=[*LEFT, 0.03]).quaternion_xyzw], [*ABOVE, *DOWN]])
    ranked = grasped.best_grasps(count=2, candidates=poses)
    assert [grasp.candidate for grasp in ranked] == [1, 0]
    assert ranked[0].score == pytest.approx(ranked[0].density)
    assert ranked.ranking is not None
    assert ranked.ranking.objective == "density"
    aside = grasped.best_grasp(exclude=poses[1:], min_separation_m=0.05, min_separation_deg=180)
    assert np.linalg.norm(aside.position - ABOVE) > 0.05
    lower = grasped.best_grasp(half_spaces=np.array([[0, 0, -1, -0.02]]))
    assert lower.position[2] <= 0.02 + 1e-6
    robust = grasped.best_grasps(count=1, objective="robust", robust_of="density", tool_noise_m=0.005)
    assert robust.ranking is not None
    assert "right" in str(robust.ranking.tool_noise)
    with pytest.raises(ValueError, match="half_spaces"):
        grasped.best_grasp(half_spaces=[[0, 0, 1]])
    with pytest.raises(InvalidInput, match="objective=robust"):
        grasped.best_grasp(tool_noise_m=0.005)


def test_proposals_go_back_with_their_density(grasped: GraspObject) -> None:
    drawn = grasped.proposals(20, seed=1)
    assert np.array_equal(drawn.poses, grasped.samples(20, seed=1).poses)
    assert drawn.criterion == "draws from the density of successes"
    assert grasped.samples(2).criterion is None
    assert (drawn.proposal_density > 0).all()


def test_no_grasp_raises_and_names_the_nearest(db: Client, grasped: GraspObject, fresh_id: str) -> None:
    with pytest.raises(Infeasible) as caught:
        grasped.best_grasp(box=([1, 1, 1], [2, 2, 2]))
    assert caught.value.nearest is not None
    assert caught.value.conflict == ("box_min",)
    corner = caught.value.relax["box_min"]
    assert grasped.best_grasp(box=(corner, [2, 2, 2])).density > 0
    assert "box_min excludes all that was tried" in str(caught.value)
    empty = db.objects.create(f"{fresh_id}-empty")
    with pytest.raises(Infeasible, match="no successful trial"):
        empty.best_grasp()
    with pytest.raises(InvalidInput, match="approach_cone_deg"):
        grasped.best_grasp(approach=(0, 0, 1), approach_cone_deg=500)
    with pytest.raises(ValueError, match="box"):
        grasped.best_grasp(box=([0, 0], [1, 1]))
    with pytest.raises(TypeError, match="best_grasps"):
        grasped.best_grasp(count=2)


def test_likelihood_in_arrays(grasped: GraspObject, clusters: Callable[..., np.ndarray]) -> None:
    poses = clusters([(ABOVE, DOWN), ([0.5, 0.5, 0.5], DOWN)], 5)
    found = grasped.likelihood(poses, chunk=3)
    assert len(found) == 10
    assert found.density.shape == found.log_density.shape == found.relative.shape == (10,)
    assert (found.relative[:5] > 0.05).all()
    assert (found.relative[5:] < 1e-6).all()
    best = grasped.best_grasp()
    assert found.relative == pytest.approx(found.density / (best.density / best.relative), rel=1e-3)
    whole = grasped.likelihood(poses)
    assert np.allclose(whole.density, found.density, rtol=1e-6)
    turned = matrices(*as_poses(poses)) @ np.diag([-1.0, -1.0, 1.0, 1.0])  # the jaw's half turn
    assert np.allclose(grasped.likelihood(turned).density, whole.density, rtol=1e-4)
    assert grasped.likelihood(best).relative == pytest.approx([best.relative], rel=1e-3)
    only = grasped.likelihood(poses, include=["relative"])
    assert only.density is None
    assert np.allclose(only.relative, whole.relative)


def test_density_samples_and_kernel_widths(grasped: GraspObject) -> None:
    density = grasped.density()
    assert density.size == 300
    assert density.outcomes == {"success": 300}
    narrow = grasped.density(sigma_position_m=0.002, sigma_rotation_deg=4)
    assert narrow.kernel.sigma_position_m == 0.002
    drawn = grasped.samples(500, seed=3)
    again = grasped.samples(500, seed=3)
    assert np.array_equal(drawn.poses, again.poses)
    assert np.isclose((drawn.position[:, 2] > 0.02).mean(), 2 / 3, atol=0.1)
    assert drawn.matrices.shape == (500, 4, 4)
    density_there = grasped.likelihood(drawn).density
    assert np.allclose(drawn.proposal_density, density_there, rtol=1e-3)


@pytest.mark.usefixtures("worker")
def test_a_sweep_simulates_every_pose_it_was_given(db: Client, fresh_id: str) -> None:
    box = _box((-0.015, -0.02, -0.05), (0.015, 0.02, 0.05))
    item = db.objects.create(fresh_id, mesh=box, convex_parts=[box], mass_kg=0.1, friction=0.6)
    poses = [[0, 0, 0.05, *DOWN], [0, 0, 0, *DOWN], [0, 0, 0.3, *DOWN], [0, 0, 0.3, *DOWN]]
    seen: list[wire.SweepInfo] = []
    sweep = item.sweep(poses=poses, purpose="check").wait(progress=seen.append, timeout=120)
    assert sweep.state == "done"
    assert seen[-1].poses_done == 4
    found = sweep.outcomes()
    assert found.pose_index.tolist() == [0, 1, 2, 3]
    assert np.allclose(found.position, np.array(poses)[:, :3])
    assert found.outcome[1] == "collision"
    assert found.outcome[2:].tolist() == ["missed", "missed"]
    assert item.refresh().info.trials == 0  # a check enters nothing
    assert sweep.id in [s.id for s in db.sweeps.list(object=item.id)]
    assert db.workers()
    drawn = item.sweep(poses=poses, proposal_density=[4, 1, np.nan, np.nan]).wait(timeout=120)
    # Only what met physics has a row.
    assert {trial.pose_index: trial.proposal_density for trial in item.trials.list()} == {0: 4.0}
    item.batches.delete(drawn.info.batch)
    collected = item.sweep(max_poses=2_000, seed=1, chunk_poses=500).wait(timeout=120)
    assert collected.info.poses_done == 2_000
    outcomes = collected.outcomes()
    assert len(outcomes) == 2_000
    assert item.refresh().info.trials == 2_000
    assert item.info.outcomes.get("success", 0) == int(outcomes.success.sum())


@pytest.mark.usefixtures("worker")
def test_best_grasps_are_simulated_before_they_are_answered(db: Client, fresh_id: str) -> None:
    box = _box((-0.015, -0.02, -0.05), (0.015, 0.02, 0.05))
    item = db.objects.create(fresh_id, mesh=box, convex_parts=[box], mass_kg=0.1, friction=0.6)
    # The second claims to have held, but there is nothing between its fingers.
    poses = [[0, 0, 0.05, *DOWN], [0, 0, 0.3, *DOWN], [0, 0, 0.301, *DOWN]]
    item.trials.add(poses, ["success"] * 3, gripper="pg70", source="robot")
    found = item.best_grasps(count=2, verify=True, min_separation_m=0.1, verify_timeout_s=120)
    assert [grasp.simulated for grasp in found] == ["success", "missed"]
    assert np.isclose(found[0].position[2], 0.05, atol=0.01)
    assert found[0].density < found[1].density  # what held goes first
    assert item.refresh().info.trials == 3
    assert item.best_grasp().simulated is None


def test_a_long_sweep_goes_on_after_a_timeout_and_can_be_cancelled(db: Client, fresh_id: str) -> None:
    box = _box((-0.015, -0.02, -0.05), (0.015, 0.02, 0.05))
    item = db.objects.create(fresh_id, mesh=box, convex_parts=[box], mass_kg=0.1)
    sweep = item.sweep()  # millions of poses: far from done soon, even with a worker
    with pytest.raises(TimeoutError, match=sweep.id):
        sweep.wait(timeout=0.1)
    assert sweep.cancel().state == "cancelled"
    assert sweep.wait().finished
    with pytest.raises(ValueError, match="one of the three"):
        item.sweep(max_poses=10, sample=5)


def test_info_ready_and_unreachable(db: Client) -> None:
    assert db.ready()
    assert "version" in db.info()
    with Client("http://127.0.0.1:9", retries=0) as nobody:
        assert not nobody.ready()
        with pytest.raises(Unreachable, match="graspdb-server serve"):
            nobody.info()


def test_to_pandas_says_what_it_needs(grasped: GraspObject) -> None:
    listing = grasped.trials.list(outcome="success")
    if importlib.util.find_spec("pandas") is None:
        with pytest.raises(ImportError, match=r"graspdb\[pandas\]"):
            listing.to_pandas()
    else:
        assert len(listing.to_pandas()) == 300


def test_objects_and_grasps_are_drawn(db: Client, fresh_id: str, clusters: Callable[..., np.ndarray]) -> None:
    item = db.objects.create(fresh_id, mesh=_box((-0.02, -0.02, -0.05), (0.02, 0.02, 0.05)))
    item.trials.add(clusters([([0, 0, 0.045], [1, 0, 0, 0])], 20), True, gripper="panda")
    small = {"width": 32, "height": 24}
    best = item.best_grasp(frame="base")
    # In whatever frame it is told, the same grasp is drawn.
    drawn = best.picture(**small)
    assert drawn[:4] == b"\x89PNG"
    assert item.picture(best.tool_matrix, gripper="panda", **small) == drawn
    assert item.picture(**small) != drawn
    assert all("<img" in shown._repr_html_() for shown in (item, best, best))
    with pytest.raises(ValueError, match="shows one grasp"):
        item.picture(clusters([([0, 0, 0], [1, 0, 0, 0])], 2))
    with pytest.raises(InvalidInput, match="opens"):
        best.picture(opening_m=0.5)


def test_everything_shows_itself_in_words(db: Client, grasped: GraspObject) -> None:
    best = grasped.best_grasps(count=2)
    assert "trials=300" in repr(grasped)
    assert repr(best[0]).startswith("Grasp(position=[")
    shown = best[0]._repr_html_()
    assert "density" in shown
    assert shown.count("object frame") == 1, "what the pose is of is said once"
    assert "<img" not in shown, "without a mesh there is nothing to draw"
    assert "300 trials" in repr(grasped.trials.list().arrays())
    assert db.url in repr(db)


def test_errors_have_the_class_that_their_problem_names(db: Client) -> None:
    thing = db.objects.create("two-grippers")
    for gripper in ("pg70", "panda"):
        thing.trials.add([0, 0, 0, 0, 0, 0, 1], True, gripper=gripper)
    with pytest.raises(AmbiguousSelection, match="panda"):
        thing.density()
    problem = wire.Problem(type="urn:graspdb:problem:lease-lost", title="Another's", status=409)
    assert isinstance(error_for(problem), LeaseLost)


def test_what_numpy_and_pandas_hand_over_is_taken(db: Client, fresh_id: str) -> None:
    item = db.objects.create(fresh_id)
    poses = np.tile([0, 0, 0.1, 1.0, 0, 0, 0], (3, 1))
    item.trials.add(
        poses,
        [True, False, True],
        quality=np.ma.masked_array([0.1, 0.2, 0.3], mask=[False, True, False]),
        measured_at=np.array(["2024-01-01", "NaT", "2024-01-02T03:04:05"], "M8[s]"),
        metadata={"run": np.int64(3), "day": datetime(2024, 1, 1, tzinfo=UTC), "joints": np.arange(2.0)},
    )
    first, second, third = item.trials.list()
    assert (first.quality, second.quality, third.quality) == (0.1, None, 0.3)
    assert second.measured_at is None
    assert third.measured_at == datetime(2024, 1, 2, 3, 4, 5, tzinfo=UTC)
    assert first.metadata == {"run": 3, "day": "2024-01-01T00:00:00+00:00", "joints": [0.0, 1.0]}
    stamps = pd.Series(pd.to_datetime(["2024-01-01T01:00+01:00", None, "2024-01-02T00:00+00:00"], utc=True))
    item.trials.add(poses, True, measured_at=stamps)
    assert [trial.measured_at for trial in item.trials.list()][3:] == [
        datetime(2024, 1, 1, tzinfo=UTC), None, datetime(2024, 1, 2, tzinfo=UTC)
    ]  # fmt: skip
    with pytest.raises(ValueError, match="outcome 1 is masked"):
        item.trials.add(poses, np.ma.masked_array([True, False, True], mask=[False, True, False]))


@pytest.mark.parametrize("content", [b"solid\nfacet", b"SOLID x\n", b"\xef\xbb\xbfsolid x\n"])
def test_bytes_of_an_ascii_stl_are_known(content: bytes) -> None:
    assert read_mesh(content, None) == (content, "model/stl")


def test_a_client_made_before_a_fork_gets_its_own_answers(db: Client, fresh_id: str) -> None:
    """Four children ask at once with the client of their parent, which has a connection open."""
    ids = [f"{fresh_id}-{number}" for number in range(4)]
    for name in ids:
        db.objects.create(name)
    fork = multiprocessing.get_context("fork")
    barrier, wrong = fork.Barrier(len(ids)), fork.SimpleQueue()

    def ask(name: str) -> None:
        barrier.wait(60)
        for _ in range(50):
            try:
                found = db.objects.get(name).info.id
            except (GraspDBError, ValueError) as error:
                found = repr(error)
            if found != name:
                wrong.put((name, found))

    children = [fork.Process(target=ask, args=(name,)) for name in ids]
    for child in children:
        child.start()
    for child in children:
        child.join(120)
    assert [child.exitcode for child in children] == [0] * len(ids)
    assert wrong.empty()
    assert db.objects.get(ids[0]).info.id == ids[0]
