"""Compiling ahead: a service of its own, in an empty folder, is asked each kind of question once,
but for one report.

Numba compiles a function when it is first called and keeps it on disk. What no question here leads to is
compiled when somebody asks it, so whatever is compiled belongs into one of these.
"""

from __future__ import annotations

import asyncio
import math
import struct
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
from numpy.typing import NDArray

from graspdb_service.settings import Settings

if TYPE_CHECKING:
    from fastapi import FastAPI

Floats = NDArray[np.float64]

_SLUG, _GRIPPER = "ahead", "pg70"
_TRIALS, _SIDES, _RADIUS_M, _HEIGHT_M = 400, 24, 0.02, 0.1
#: Seconds that a report may take.
_PATIENCE_S = 600.0
_WIDTHS: dict[str, Any] = {"sigma_position_m": 0.01, "sigma_rotation_deg": 15.0}
#: An anisotropic kernel's one component: millimetres along the tool's axes, radians about them.
_COVARIANCE = np.diag(np.square([0.02, 0.006, 0.01, 0.1, 0.3, 0.1])).tolist()
#: Tool z along the object's -x.
_FACING = [0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)]
_NOISE: dict[str, Any] = {"pose_noise_m": 0.002, "pose_noise_deg": 2.0, "tool_noise_m": 0.001}
_WORKSPACE: dict[str, Any] = {
    "box_min": [-0.2, -0.2, -0.05],
    "box_max": [0.2, 0.2, 0.2],
    "half_spaces": [[0.0, 0.0, 1.0, -0.05]],
    "sphere": [0.0, 0.0, 0.0, 0.5],
    "approach": [-1.0, 0.0, 0.0],
    "approach_cone_deg": 80.0,
    "closing": [0.0, 1.0, 0.0],
    "closing_cone_deg": 80.0,
    "count": 3,
}


def compile_ahead() -> float:
    """Have Numba compile and keep what questions lead to; the seconds it took.

    Raises
    ------
    httpx.HTTPStatusError
        A question was refused: this installation does not work.
    """
    from graspdb_service.app import create_app  # extra: service
    from graspdb_service.usecases.runtime.warmup import warm_up  # extra: service

    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        settings = Settings(database_url=f"sqlite:///{Path(folder) / 'ahead.sqlite'}", auth="off")
        app = create_app(settings)
        # First what a start loads: until it is there, each start compiles anew.
        warm_up(app.state.context.compute)
        asyncio.run(_asked(app))
    return time.monotonic() - started


async def _asked(app: FastAPI) -> None:
    here = httpx.ASGITransport(app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=here, base_url="http://127.0.0.1", timeout=None) as http,
    ):
        await _ask_everything(http)


async def _ask_everything(http: httpx.AsyncClient) -> None:
    await _tell(http)
    for path, body in _questions():
        (await http.post(path, json=body)).raise_for_status()
    for path, asked in _reports():
        await _report(http, path, asked)
    for kind in ("anisotropic", "sampled"):
        await _with_kernel(http, kind)


async def _tell(http: httpx.AsyncClient) -> None:
    """An object that can be turned about its axis, its mesh, and attempts from one side."""
    (await http.post("/objects", json={"id": _SLUG})).raise_for_status()
    headers = {"Content-Type": "model/stl"}
    (await http.put(f"/objects/{_SLUG}/mesh?unit=m", content=_cone(), headers=headers)).raise_for_status()
    rng = np.random.default_rng(0)
    for source in ("simulation", "robot"):
        await _post(http, rng, source)


async def _post(http: httpx.AsyncClient, rng: np.random.Generator, source: str) -> None:
    azimuth, miss = rng.uniform(-0.8, 0.8, _TRIALS), rng.uniform(-0.025, 0.025, _TRIALS)
    out = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(_TRIALS)], axis=1)
    along = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(_TRIALS)], axis=1)
    position = out * rng.normal(0.0, 0.004, (_TRIALS, 1)) + along * miss[:, None]
    position[:, 2] = rng.normal(0.02, 0.006, _TRIALS)
    # Tool z inwards, y across, x up.
    about = 0.5 * azimuth
    zero = np.zeros(_TRIALS)
    turned = np.stack([zero, zero, np.sin(about), np.cos(about)], axis=1)
    quaternion = _times(turned, np.array(_FACING)) + rng.normal(0.0, 0.05, (_TRIALS, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    won = rng.random(_TRIALS) < np.where(np.abs(miss) < 0.012, 0.95, 0.05)
    columns = {
        "position": position.tolist(),
        "quaternion_xyzw": quaternion.tolist(),
        "outcome": ["success" if held else "missed" for held in won],
    }
    body = {"columns": columns, "gripper": _GRIPPER, "source": source}
    (await http.post(f"/objects/{_SLUG}/trials", json=body)).raise_for_status()


def _times(a: Floats, b: Floats) -> Floats:
    x, y, z, w = a.T
    i, j, k, r = b
    parts = [w * i + x * r + y * k - z * j, w * j - x * k + y * r + z * i]
    parts += [w * k + x * j - y * i + z * r, w * r - x * i - y * j - z * k]
    return np.stack(parts, axis=1)


def _cone() -> bytes:
    """A cone about z, binary STL, metres."""
    angle = np.linspace(0.0, 2.0 * math.pi, _SIDES + 1)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1) * _RADIUS_M
    top, bottom = np.array([0.0, 0.0, _HEIGHT_M]), np.zeros(3)
    faces = [(ring[i], ring[i + 1], top) for i in range(_SIDES)]
    faces += [(ring[i + 1], ring[i], bottom) for i in range(_SIDES)]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *np.concatenate(face), 0) for face in faces)
    return b"\0" * 80 + struct.pack("<I", len(faces)) + rows


def _questions() -> Iterator[tuple[str, dict[str, Any]]]:
    poses = {"position": [[0.0, 0.0, 0.02], [0.5, 0.0, 0.0]], "quaternion_xyzw": [_FACING] * 2}
    best, gripper = f"/objects/{_SLUG}/best-grasp", {"gripper": _GRIPPER}
    box = {"size_m": [0.05, 0.05, 0.05], "position": [0.3, 0.0, 0.0]}
    # The first best grasp of all is what a first start waits for.
    yield best, gripper
    yield best, gripper | _WORKSPACE
    yield best, gripper | _WORKSPACE | {"collision_free": True, "max_width_m": 0.06}
    yield best, gripper | _WORKSPACE | {"obstacles": {"boxes": [box]}, "pregrasp_distance_m": 0.05}
    few = gripper | {"candidates": poses}
    yield best, few | {"exclude": poses}
    for symmetry in ("off", "auto"):
        for objective in ("density", "success_probability"):
            yield best, few | _WIDTHS | {"objective": objective, "symmetry": symmetry}
        yield f"/objects/{_SLUG}/likelihood", gripper | {"poses": poses, "symmetry": symmetry}
    for averaged in ("density", "success_probability"):
        yield best, few | _NOISE | {"objective": "robust", "robust_of": averaged}
    yield best, gripper | {"pre_opening_m": "auto"}
    yield best, gripper | {"objective": "success_probability", "symmetry": "off"}
    yield f"/objects/{_SLUG}/samples", gripper | {"count": 10}
    yield f"/objects/{_SLUG}/proposals", {"count": 3}


def _reports() -> Iterator[tuple[str, dict[str, Any]]]:
    gripper = {"gripper": _GRIPPER}
    yield "projection", gripper
    yield "convergence", gripper
    for method in ("empirical", "density"):
        yield "anisotropy", gripper | {"method": method}
    yield "anisotropy", gripper | {"alignment": "surface-pair"}
    yield "anisotropy", gripper | {"alignment": "edge"}
    # Not kernel-similarity, which sums for half a minute and has two functions of its own.
    for name in ("calibration", "bandwidth", "sources"):
        yield name, gripper


async def _report(http: httpx.AsyncClient, name: str, asked: dict[str, Any]) -> None:
    answer = await http.get(f"/objects/{_SLUG}/reports/{name}", params=asked)
    answer.raise_for_status()
    if answer.status_code != 202:
        return
    run, deadline = answer.json(), time.monotonic() + _PATIENCE_S
    while run["state"] in ("queued", "running") and time.monotonic() < deadline:
        await asyncio.sleep(0.1)
        run = (await http.get(f"/report-runs/{run['id']}")).raise_for_status().json()


async def _with_kernel(http: httpx.AsyncClient, kind: str) -> None:
    components = [{"covariance": _COVARIANCE}]
    if kind == "sampled":
        components = [{"mean": [0.001 * i, 0.0, 0.0, 0.0, 0.0, 0.01 * i], "weight": 1.0} for i in range(3)]
    body: dict[str, Any] = {"kind": kind, "gripper": _GRIPPER, "components": components}
    if kind == "sampled":
        body["component_widths"] = _WIDTHS
    made = (await http.post("/kernels", json=body)).raise_for_status().json()
    asked = {"gripper": _GRIPPER, "kernel": made["id"]}
    (await http.post(f"/objects/{_SLUG}/best-grasp", json=asked)).raise_for_status()
    (await http.post(f"/objects/{_SLUG}/samples", json=asked | {"count": 3})).raise_for_status()
    await _report(http, "projection", asked)
