"""What the service's tests share: made-up grasps around an object, and posting them."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import se3
from graspdb_geometry.collision import Scene

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]

DOWN = (1.0, 0.0, 0.0, 0.0)
"""Tool z along the object's -z."""
SIDE = (0.0, 0.5**0.5, 0.0, 0.5**0.5)
"""Tool z along the object's +x."""


def _clusters(
    centres: list[tuple[tuple[float, float, float], tuple[float, float, float, float]]],
    count: int,
    *,
    seed: int = 0,
    sigma_m: float = 0.01,
    sigma_rad: float = 0.15,
) -> Poses:
    """``count`` poses (n, 3), (n, 4) about each centre, normal in position and rotation vector."""
    rng = np.random.default_rng(seed)
    positions, quaternions = [], []
    for position, quaternion in centres:
        positions.append(np.array(position) + rng.normal(size=(count, 3)) * sigma_m)
        turns = se3.from_rotation_vector(rng.normal(size=(count, 3)) * sigma_rad)
        quaternions.append(se3.multiply(np.array(quaternion), turns))
    return np.concatenate(positions), se3.normalise(np.concatenate(quaternions))


@pytest.fixture(scope="session")
def clusters() -> Callable[..., Poses]:
    return _clusters


@pytest.fixture(scope="session")
def two_clusters() -> Poses:
    """300 grasps from above around (0, 0, 60) mm and 200 from the side around (-80, 0, 0) mm."""
    top, side = (
        _clusters([((0, 0, 0.06), DOWN)], 300, seed=1),
        _clusters([((-0.08, 0, 0), SIDE)], 200, seed=2),
    )
    return np.concatenate([top[0], side[0]]), np.concatenate([top[1], side[1]])


@pytest.fixture(scope="session")
def post() -> Callable[..., dict[str, Any]]:
    """``post(http, slug, (positions, quaternions), outcome, **beside)`` stores trials: the receipt."""

    def post(
        http: httpx.Client, slug: str, poses: Poses, outcome: str | list[str] = "success", **more: Any
    ) -> dict[str, Any]:
        count = len(poses[0])
        columns: dict[str, Any] = {
            "position": poses[0].tolist(),
            "quaternion_xyzw": poses[1].tolist(),
            "outcome": [outcome] * count if isinstance(outcome, str) else outcome,
        }
        beside = {}
        for name, value in more.items():
            if isinstance(value, (list, np.ndarray)):
                columns[name] = [None if v is None or v != v else v for v in list(value)]
            else:
                beside[name] = value
        answer = http.post(f"/objects/{slug}/trials", json={"columns": columns, **beside})
        assert answer.status_code == 201, answer.text
        receipt: dict[str, Any] = answer.json()
        return receipt

    return post


@pytest.fixture(scope="session")
def make_object() -> Callable[..., str]:
    """``make_object(http, slug)`` registers an object and returns its slug."""

    def make(http: httpx.Client, slug: str = "thing", **properties: Any) -> str:
        answer = http.post("/objects", json={"id": slug, **properties})
        assert answer.status_code == 201, answer.text
        return slug

    return make


@pytest.fixture(scope="session")
def put_box() -> Callable[..., Scene]:
    """``put_box(http, slug, size)`` gives an object a box about its origin as its mesh: its geometry."""

    def put(http: httpx.Client, slug: str, size: tuple[float, float, float] = (0.04, 0.06, 0.1)) -> Scene:
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
        faces = np.array(
            [
                (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
                (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
            ]
        )  # fmt: skip
        triangles = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[f].ravel(), 0) for f in faces)
        answer = http.put(
            f"/objects/{slug}/mesh?unit=m",
            content=b"\0" * 80 + struct.pack("<I", len(faces)) + triangles,
            headers={"Content-Type": "model/stl"},
        )
        assert answer.status_code in (200, 201), answer.text
        return Scene([(corners, faces)])

    return put
