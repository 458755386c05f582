"""A first start: what was compiled ahead is not compiled again, and what was not is not compiled unasked."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import httpx
import numpy as np
import pytest

from graspdb.processes import ChildProcess
from graspdb_density import se3

#: Longest that compiling everything may take on a busy machine, seconds.
PATIENCE_S = 1_500
SERVER = [sys.executable, "-c", "from graspdb_service.cli import main; main()"]
LOAD = """
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.runtime.warmup import NotCompiled, load
try:
    load(Compute(1))
except NotCompiled:
    print("not compiled")
"""


def environment(kept: Path) -> dict[str, str]:
    return os.environ | {"NUMBA_CACHE_DIR": str(kept)}


def compiled(kept: Path) -> set[tuple[str, int]]:
    """Files that Numba keeps, with when they were written."""
    return {(path.name, path.stat().st_mtime_ns) for path in kept.rglob("*.nb[ic]")}


def test_loading_compiles_nothing(tmp_path: Path) -> None:
    told = subprocess.run(
        [sys.executable, "-c", LOAD], env=environment(tmp_path), check=True, capture_output=True, text=True
    )
    assert told.stdout.strip() == "not compiled"
    assert not compiled(tmp_path)


@pytest.mark.long
@pytest.mark.timeout(2 * PATIENCE_S)
def test_what_was_compiled_ahead_is_not_compiled_again(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    subprocess.run([*SERVER, "warm-up"], env=environment(kept), check=True, timeout=PATIENCE_S)
    before = compiled(kept)
    assert before
    port, told = 8000 + os.getpid() % 20_000, tmp_path / "log"
    serve = [*SERVER, "serve", "--port", str(port), "--database-url", f"sqlite:///{tmp_path / 'new.sqlite'}"]
    with told.open("w") as log:
        process = ChildProcess(serve, env=environment(kept), stdout=log, stderr=log)
    transport = httpx.HTTPTransport(retries=10)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=120, transport=transport) as http:
            _ask(http)
    finally:
        process.terminate()
        process.wait(60)
    assert compiled(kept) == before
    assert "Compiled code is missing" not in told.read_text()


def _ask(http: httpx.Client) -> None:
    """What a first user asks, of other data than those that code was compiled with."""
    rng = np.random.default_rng(5)
    count = 400
    quaternions = se3.random_quaternions(count, rng)
    columns = {
        "position": (rng.normal(size=(count, 3)) * 0.03).tolist(),
        "quaternion_xyzw": quaternions.tolist(),
        "outcome": ["success" if won else "slipped" for won in rng.random(count) < 0.5],
    }
    http.post("/objects", json={"id": "thing"}).raise_for_status()
    body = {"columns": columns, "gripper": "panda"}
    http.post("/objects/thing/trials", json=body).raise_for_status()
    cone = {"approach": "0,0,-1", "approach_cone_deg": "70", "gripper": "panda"}
    for objective in ("density", "success_probability", "robust"):
        asked = cone | {"objective": objective, "count": "2"}
        if objective == "robust":
            asked["tool_noise_m"] = "0.003"
        http.get("/objects/thing/best-grasp", params=asked).raise_for_status()
    poses = {"position": [[0.0, 0.0, 0.01]], "quaternion_xyzw": [[0.0, 0.0, 0.0, 1.0]]}
    http.post("/objects/thing/likelihood", json={"poses": poses, "gripper": "panda"}).raise_for_status()
    http.post("/objects/thing/samples", json={"count": 5}).raise_for_status()
    http.get("/objects/thing/density").raise_for_status()
