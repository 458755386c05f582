"""T in frame F with convention C is T_tool composed by hand, to 1e-9, wherever poses are asked for."""

from __future__ import annotations

import asyncio
import base64
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspdb import AsyncClient, Client, wire
from graspdb.poses import Poses, as_poses, matrices
from graspdb.resources.objects import GraspObject
from graspdb.wire import CONVENTIONS
from graspdb.wire.frames.conventions import OWN_AXES, to_graspdb

Floats = NDArray[np.float64]
SHAPE: dict[str, Any] = {
    "max_opening_m": 0.08,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "tip_offset_m": 0.01,
    "palm_size_m": [0.05, 0.08, 0.05],
}
WORLD = matrices([0.5, -0.3, 0.8], [0.3, -0.2, 0.5, np.sqrt(1 - 0.38)])
TWIN = np.diag([-1.0, -1.0, 1.0, 1.0])

_numbers = st.floats(-1.0, 1.0, allow_nan=False)
quaternions = (
    st.tuples(_numbers, _numbers, _numbers, _numbers)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: (np.array(q) / np.linalg.norm(q)).tolist())
)
frames = st.tuples(st.tuples(_numbers, _numbers, _numbers).map(list), quaternions)


def _before_the_base(pose: Any) -> Any:
    """The tool's pose, or where it points back at the base its mirror image: no gripper grasps its wrist."""
    position, quaternion = pose
    ahead = np.dot(position, matrices(position, quaternion)[:3, 2])
    return pose if ahead >= 0 else ([-x for x in position], quaternion)


tools = frames.map(_before_the_base)


@pytest.fixture(scope="module")
def db(serve_module: Callable[..., str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with Client(
        serve_module(
            f"sqlite:///{tmp_path_factory.mktemp('everywhere')}/graspdb.sqlite", max_mesh_seconds=120
        )
    ) as client:
        yield client


@pytest.fixture(scope="module")
def thing(db: Client) -> GraspObject:
    """An object grasped with a gripper that nobody named, so that each new one may be asked of."""
    rng = np.random.default_rng(0)
    item = db.objects.create("thing")
    poses = np.tile([0.0, 0.0, 0.06, 1.0, 0.0, 0.0, 0.0], (60, 1))
    poses[:, :3] += rng.normal(scale=0.004, size=(60, 3))
    item.trials.add(poses, np.arange(60) % 5 > 0, source="robot")
    return item


class Expected:
    """A gripper of made-up frames, and what poses of its tool are in one of them."""

    def __init__(self, tool: Any, other: Any, frame: str, convention: str, near: Sequence[float]) -> None:
        in_base = {"base": np.eye(4), "tool": matrices(*tool), "own": matrices(*other)}
        self.fixed = np.linalg.inv(in_base["tool"]) @ in_base[frame]
        if convention not in OWN_AXES:
            self.fixed[:3, :3] = np.array(to_graspdb(convention)).T  # type: ignore[arg-type]
        self.near = matrices([0, 0, 0], near)[:3, :3]
        self.told: dict[str, Any] = {"frame": frame, "convention": convention}
        self.asked = {**self.told, "near": list(near)}
        self.profile = {"base_to_tool": _pose(tool), "frames": {"own": _pose(other)}, **SHAPE}

    def of(self, tool: Floats, reference: Floats | None = None) -> Floats:
        """Poses (n, 4, 4) of the tool in the frame, each of the twin that is nearer in the reference."""
        both = np.array([tool @ self.fixed, tool @ TWIN @ self.fixed])
        turned = both if reference is None else reference @ both
        # The trace of a rotation falls with its angle.
        traces = np.einsum("knij,ij->kn", turned[:, :, :3, :3], self.near)
        return both[np.argmax(traces, axis=0), np.arange(len(tool))]

    def same(self, found: Any, tool: Floats, reference: Floats | None = None) -> None:
        np.testing.assert_allclose(_matrices(found), self.of(tool, reference), atol=1e-9)


def _pose(pose: Any) -> dict[str, Any]:
    return {"position": pose[0], "quaternion_xyzw": pose[1]}


def _matrices(found: Any) -> Floats:
    if isinstance(found, np.ndarray):
        return found
    many = found if isinstance(found, list) else [found]
    columns = (np.array([getattr(item, name) for item in many]) for name in ("position", "quaternion_xyzw"))
    return matrices(*columns)


def _text(near: Sequence[float]) -> str:
    return ",".join(str(float(x)) for x in near)


CASES = {
    "tool": tools,
    "other": frames,
    "frame": st.sampled_from(["tool", "base", "own"]),
    "convention": st.sampled_from(CONVENTIONS),
    "near": quaternions,
}
EVERYWHERE = settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@given(**CASES)
@EVERYWHERE
def test_answers_are_of_the_frame(
    db: Client, thing: GraspObject, tool: Any, other: Any, frame: str, convention: str, near: list[float]
) -> None:
    expected = Expected(tool, other, frame, convention, near)
    gripper = db.grippers.create(f"g-{uuid.uuid4().hex[:8]}", **expected.profile).id
    chosen: dict[str, Any] = {"gripper": gripper, "prior": False}

    async def asynchronous() -> Any:
        async with AsyncClient(db.url) as client:
            item = await client.objects.get(thing.id)
            return (
                await item.best_grasps(count=2, **chosen, **expected.asked),
                await item.samples(9, seed=1, gripper=gripper, **expected.asked),
                await item.proposals(9, seed=1, gripper=gripper, **expected.asked),
            )

    # Best grasps, in the object's frame and in the world's.
    plain = thing.best_grasps(count=2, object_pose=WORLD, **chosen)
    told = thing.best_grasps(count=2, object_pose=WORLD, **chosen, **expected.asked)
    assert told.worlds is not None
    expected.same(told.matrices, plain.matrices, WORLD)
    np.testing.assert_allclose(told.worlds, WORLD @ told.matrices, atol=1e-9)
    assert (told[0].frame, told[0].convention) == (frame, convention)
    asked_again = db.answers.get(told.answer or "", now=True).result
    np.testing.assert_allclose(asked_again.matrices, told.matrices, atol=0)
    best, drawn, proposed = asyncio.run(asynchronous())
    expected.same(best.matrices, plain.matrices)

    # Draws; and these kept, and sent back.
    samples = thing.samples(9, seed=1, gripper=gripper)
    proposals = thing.proposals(9, seed=1, gripper=gripper)
    for found, by_tool in ((drawn, samples), (proposed, proposals)):
        expected.same(found.matrices, by_tool.matrices)
        np.testing.assert_array_equal(found.proposal_density, by_tool.proposal_density)
        kept = db.answers.get(found.answer)
        np.testing.assert_array_equal(kept.result.matrices, found.matrices)
        assert kept.question["near"] == pytest.approx(near)

    # Poses that come in: likelihoods by either method, candidates and exclusions.
    likely = thing.likelihood(samples, gripper=gripper).log_density
    np.testing.assert_allclose(thing.likelihood(drawn, gripper=gripper).log_density, likely, rtol=1e-6)
    first = {"position": drawn.position[0], "quaternion_xyzw": drawn.quaternion_xyzw[0]}
    params = {name: _text(values) for name, values in first.items()} | expected.told | {"gripper": gripper}
    one = httpx.get(f"{db.url}/objects/{thing.id}/likelihood", params=params)
    np.testing.assert_allclose(one.json()["log_density"], likely[:1], rtol=1e-6)
    ranked = thing.best_grasps(candidates=drawn, exclude=drawn.matrices[3:5], **expected.asked, **chosen)
    plainly = thing.best_grasps(candidates=samples, exclude=samples.matrices[3:5], **chosen)
    assert [grasp.candidate for grasp in ranked] == [grasp.candidate for grasp in plainly]
    expected.same(ranked.matrices, plainly.matrices)


@pytest.mark.filterwarnings("ignore::graspdb.resources.trials.DoubtfulTrials")
@pytest.mark.filterwarnings("ignore::graspdb.resources.trials.DoubtfulTrials")
@given(**CASES)
@EVERYWHERE
def test_trials_are_of_the_frame(
    db: Client, tool: Any, other: Any, frame: str, convention: str, near: list[float]
) -> None:
    expected = Expected(tool, other, frame, convention, near)
    id = uuid.uuid4().hex[:8]
    gripper = db.grippers.create(f"g-{id}", **expected.profile)
    item = db.objects.create(f"o-{id}")
    rng = np.random.default_rng(1)
    tools = matrices(
        rng.normal(size=(4, 3)), (q := rng.normal(size=(4, 4))) / np.linalg.norm(q, axis=1)[:, None]
    )
    covariance = np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-6
    sent: dict[str, Any] = {"gripper": gripper.id, "pose_covariance": covariance}
    given = tools @ expected.fixed
    item.trials.add(given[:3], [True, False, True], achieved_poses=given[:3], **sent, **expected.told)
    records = [{"matrix": given[3].tolist(), "outcome": True}]
    item.trials.add_records(records, gripper=gripper.id, **expected.told)

    by_tool = item.trials.list().arrays()
    np.testing.assert_allclose(by_tool.matrices, tools, atol=1e-9)
    told = item.trials.list(**expected.asked).arrays()
    expected.same(told.matrices, tools)
    np.testing.assert_allclose(told.achieved.matrices[:3], told.matrices[:3], atol=1e-9)
    for row, trial in enumerate(told.trials[:3]):
        # As it came, about the frame's axes, or about those of its twin.
        back = np.linalg.inv(told.matrices[row]) @ given[row]
        np.testing.assert_allclose(trial.pose_covariance, _adjoint(back, covariance), atol=1e-9)
    by_http = {**expected.told, "near": _text(near)}
    for accept in ("application/json", "application/x-ndjson"):
        answer = httpx.get(f"{db.url}/objects/{item.id}/trials", params=by_http, headers={"Accept": accept})
        assert answer.status_code == 200
    one = item.trials.get(2, **expected.asked)
    corrected = item.trials.correct(2, outcome="slipped", **expected.asked)
    for trial in (one, corrected):
        expected.same(trial, tools[1:2])
        assert (trial.frame, trial.convention) == (frame, convention)


def _adjoint(pose: Floats, covariance: Floats) -> Floats:
    """A covariance about a frame as one about its parent, by the cross product matrix."""
    rotation, (x, y, z) = pose[:3, :3], pose[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.block([[rotation, cross @ rotation], [np.zeros((3, 3)), rotation]])
    return np.asarray(matrix @ covariance @ matrix.T)


@pytest.fixture(scope="module")
def swept(db: Client) -> tuple[Any, Floats, Any]:
    """A check of a few poses of a gripper with frames of its own, simulated by nobody, and its gripper."""
    tool, other = ([0.01, 0, 0.12], [0, 0, 0.6, 0.8]), ([0.05, 0.02, 0.03], [0.5, 0.5, -0.5, 0.5])
    gripper = {"base_to_tool": _pose(tool), "frames": {"own": _pose(other)}, **SHAPE}
    db.grippers.create("swept", **gripper)
    box = trimesh.creation.box([0.04, 0.05, 0.08])
    item = db.objects.create("swept", mesh=box, mass_kg=0.1)
    item.upload_convex_parts([box])
    rng = np.random.default_rng(2)
    poses = Poses(
        rng.normal(size=(5, 3)) * 0.05, (q := rng.normal(size=(5, 4))) / np.linalg.norm(q, axis=1)[:, None]
    )
    sweep = item.sweep(
        poses=poses.matrices @ Expected(tool, other, "own", "graspdb", [0, 0, 0, 1]).fixed,
        frame="own",
        gripper="swept",
    )
    claim = {"worker": "nobody", "capabilities": ["simulate"], "limit": 1}
    (job,) = httpx.post(f"{db.url}/jobs/claim", json=claim).json()["jobs"]
    result = {
        "outcomes": base64.b64encode(bytes([wire.OUTCOME_CODES["collision"]] * 5)).decode(),
        "rows": {"pose_index": [], "width_m": [], "quality": []},
    }
    place = f"{db.url}/jobs/{job['id']}/result"
    done = httpx.put(place, params={"lease_id": job["lease_id"]}, json=result)
    assert done.status_code == 200, done.text
    return sweep.refresh(), poses.matrices, (tool, other)


@given(
    frame=st.sampled_from(["tool", "base", "own"]), convention=st.sampled_from(CONVENTIONS), near=quaternions
)
@EVERYWHERE
def test_outcomes_of_a_sweep_are_of_the_frame(
    db: Client, swept: tuple[Any, Floats, Any], frame: str, convention: str, near: list[float]
) -> None:
    sweep, poses, gripper = swept
    expected = Expected(*gripper, frame, convention, near)
    found = sweep.outcomes(**expected.asked)
    assert len(found) == 5
    expected.same(found.matrices, poses[found.pose_index])
    page = httpx.get(f"{db.url}/sweeps/{sweep.id}/outcomes", params={**expected.told, "near": _text(near)})
    told = page.json()
    fixed = told["tool_to_frame"]
    by_hand = np.eye(4) if fixed is None else matrices(fixed["position"], fixed["quaternion_xyzw"])
    np.testing.assert_allclose(by_hand, expected.fixed, atol=1e-9)
    assert as_poses(found).position.tolist() == told["position"]


def test_a_turned_frame_is_warned_of_wherever_other_axes_are_said(
    db: Client, swept: tuple[Any, Floats, Any]
) -> None:
    item, sweep = db.objects.get("swept"), swept[0]
    turned = {"frame": "own", "convention": "acronym"}
    pose = [0, 0, 0.05, 1, 0, 0, 0]
    with pytest.warns(match="turned against the tool"):
        receipt = item.trials.add(pose, True, gripper="swept", accept_implausible=True, **turned)
    assert "turned-frame" in [finding.code for finding in receipt.findings]
    assert "turned-frame" in [finding.code for finding in item.batches.get(receipt.batch).findings]
    assert "turned-frame" in [finding.code for finding in item.density().findings]
    assert any("turned" in warning for warning in item.trials.get(1, **turned).warnings)
    # Where a convention leaves a frame its axes, or the tool is meant, there is nothing to mistake.
    plain = ({"frame": "own"}, {"convention": "acronym"}, {"frame": "own", "convention": "moveit"})
    for place in (f"objects/{item.id}/trials", f"sweeps/{sweep.id}/outcomes"):
        for params, said in ((turned, True), *((others, False) for others in plain)):
            warnings = httpx.get(f"{db.url}/{place}", params=params).json()["warnings"]
            assert any("turned" in warning for warning in warnings) is said, (place, params)
    planned = item.sweep(poses=pose, gripper="swept", **turned)
    assert any("turned" in warning for warning in planned.info.warnings)
    planned.cancel()
    item.batches.delete(receipt.batch)


@pytest.mark.filterwarnings("ignore::graspdb.resources.trials.DoubtfulTrials")
def test_a_jaw_that_is_not_symmetric_has_no_twins_and_says_so(db: Client) -> None:
    db.grippers.create("hooked", symmetric=False, **SHAPE)
    item = db.objects.create("hooked")
    poses = np.tile([0.0, 0.0, 0.06, 1.0, 0.0, 0.0, 0.0], (20, 1))
    item.trials.add(poses, True, gripper="hooked")
    near = "0,1,0,0"
    for kind in ("samples", "proposals"):
        told = httpx.post(
            f"{db.url}/objects/hooked/{kind}", json={"count": 2, "seed": 1, "near": [0, 1, 0, 0]}
        ).json()
        plain = httpx.post(f"{db.url}/objects/hooked/{kind}", json={"count": 2, "seed": 1}).json()
        assert told["position"] == plain["position"]
        assert told["quaternion_xyzw"] == plain["quaternion_xyzw"]
        assert any("symmetric jaw" in warning for warning in told["warnings"])
    told = httpx.get(f"{db.url}/objects/hooked/trials", params={"near": near}).json()
    assert any("symmetric jaw" in warning for warning in told["warnings"])
    for wrong in ("1,0,0", "1,0,0,1", "a,b,c,d", "nan,0,0,1"):
        refused = httpx.get(f"{db.url}/objects/hooked/trials", params={"near": wrong})
        assert refused.status_code == 422, wrong
        assert [error["field"] for error in refused.json()["errors"]] == ["near"]
