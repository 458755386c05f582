"""Job protocol: whatever workers and users do, in any order, the service does as the model says."""

from __future__ import annotations

import struct
from collections.abc import Callable

import httpx
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test as run_machine

from graspdb_geometry import meshes
from graspdb_geometry.grids import PoseGrid
from graspdb_service.storage.database import Database
from job_protocol import GRID, MAX_ATTEMPTS, JobProtocol

Serve = Callable[..., str]

_FACES = (
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip


def box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> meshes.Part:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return corners * size + centre, np.array(_FACES)


def stl(*parts: meshes.Part) -> bytes:
    triangles = np.concatenate([vertices[faces] for vertices, faces in parts]).astype("<f4")
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in triangles)
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + body


CONVEX = box((0.04, 0.04, 0.1))
DUMBBELL = [box((0.04, 0.04, 0.04), (0, 0, z)) for z in (-0.05, 0.05)]
# A cavity so thin that it changes no measure, but its body is not convex any more.
_SLIT = box((0.004, 0.004, 1e-6), (0, 0, -0.05))
DENTED = [*DUMBBELL, (_SLIT[0], _SLIT[1][:, ::-1])]


@pytest.mark.parametrize(
    ("examples", "steps"),
    [(6, 30), pytest.param(150, 50, marks=[pytest.mark.long, pytest.mark.timeout(3600)])],
)
def test_the_job_protocol_against_a_model(database_url: str, serve: Serve, examples: int, steps: int) -> None:
    database = Database(database_url, pool_size=2)
    with httpx.Client(base_url=serve(database_url, max_attempts=MAX_ATTEMPTS), timeout=240) as http:
        grids = {}
        for name, mesh in (("convex", stl(CONVEX)), ("dented", stl(*DENTED))):
            assert http.post("/objects", json={"id": name, "mass_kg": 0.3}).status_code == 201
            put = http.put(f"/objects/{name}/mesh", content=mesh, headers={"Content-Type": "model/stl"})
            assert put.is_success, put.text
            bounds = put.json()["bounding_box"]
            grids[name] = PoseGrid(lower=bounds["lower"], upper=bounds["upper"], **GRID)
        given = {"http": http, "database": database, "grids": grids, "parts": meshes.parts_to_glb(DUMBBELL)}
        run_machine(
            type("Machine", (JobProtocol,), given),
            settings=settings(
                max_examples=examples,
                stateful_step_count=steps,
                deadline=None,
                suppress_health_check=list(HealthCheck),
                # A found example is short enough to be read; looking for a shorter one takes many minutes.
                phases=[Phase.generate],
            ),
        )
    database.dispose()
