"""``symmetry=auto`` from Python and from the command line."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from graspdb import AsyncClient, Client
from graspdb.errors import Conflict


@pytest.fixture
def cone(db: Client, fresh_id: str, tmp_path: Path) -> str:
    """A cone that was tried from +x alone, its mesh standing on z."""
    file = tmp_path / "cone.stl"
    file.write_bytes(trimesh.creation.cone(radius=0.02, height=0.1, sections=48).export(file_type="stl"))
    thing = db.objects.create(fresh_id, mesh=file, unit="m", mass_kg=0.1)
    thing.trials.add(grasps(200, 1, 0.0), np.arange(200) % 4 > 0)
    return fresh_id


def grasps(count: int, seed: int, azimuth: float) -> np.ndarray:
    """(N, 7) towards the z axis from about one azimuth."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec([0.0, 0.0, azimuth])
    inwards = Rotation.from_matrix(np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))
    turned = turn * inwards * Rotation.from_rotvec(rng.normal(0.0, 0.1, (count, 3)))
    position = turn.apply(rng.normal(0.0, 0.005, (count, 3))) + np.array([0.0, 0.0, 0.03])
    return np.concatenate([position, turned.as_quat()], axis=1)


def test_every_question_takes_it(db: Client, cone: str) -> None:
    thing, away = db.objects.get(cone), grasps(10, 2, 2.5)
    assert np.isnan(thing.likelihood(away).success_probability).all()
    told = thing.likelihood(away, symmetry="auto")
    assert told.success_probability == pytest.approx(np.full(10, 0.75), abs=0.25)
    assert told.symmetry is not None
    assert told.symmetry.axes[0].turns is None
    best = thing.best_grasps(count=1, objective="success_probability", candidates=away, symmetry="auto")
    assert best.symmetry is not None
    assert best.symmetry.applied
    assert best[0].success_probability > 0.4
    drawn = thing.samples(5, seed=1, symmetry="auto")
    assert drawn.symmetry is not None
    assert thing.samples(5, seed=1).symmetry is None
    assert thing.proposals(5, strategy="uncertainty", symmetry="auto").symmetry is not None


def test_the_asynchronous_client_takes_it_too(service_url: str, cone: str) -> None:
    async def ask() -> bool:
        async with AsyncClient(service_url) as db:
            thing = await db.objects.get(cone)
            told = await thing.likelihood(grasps(3, 3, 1.0), symmetry="auto")
            return told.symmetry is not None and told.symmetry.applied

    assert asyncio.run(ask())


def test_the_command_line_takes_it(run: Callable[..., tuple[int, str, str]], cone: str) -> None:
    code, out, err = run(
        "--json", "best-grasp", cone, "--objective", "success_probability", "--symmetry", "auto"
    )
    assert code == 0, err
    assert '"every_axis": false' in out.replace('":false', '": false')


def test_what_has_no_mesh_is_a_conflict(db: Client, fresh_id: str) -> None:
    thing = db.objects.create(fresh_id)
    thing.trials.add(grasps(20, 1, 0.0), np.arange(20) % 2 > 0)
    with pytest.raises(Conflict, match="no mesh"):
        thing.likelihood(grasps(2, 1, 0.0), symmetry="auto")
