"""What a robot's program does with the SDK, with nothing but the bare install.

Run by the interpreters that its users have, against the service at the address given.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from graspdb import AsyncClient, Client, Infeasible

TRIALS = 60


def _refusal(kind: type[Exception], ask: Callable[[], Any]) -> str:
    try:
        ask()
    except kind as error:
        return str(error)
    raise AssertionError(f"no {kind.__name__}")


def main(url: str, slug: str) -> None:
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (TRIALS, 1, 1))
    poses[:, :3, 3] = rng.normal((0.0, 0.0, 0.1), 0.003, size=(TRIALS, 3))
    flex = rng.random(TRIALS)
    outcomes = flex > 0.3
    with Client(url) as db:
        thing = db.objects.create(slug, mass_kg=0.3)
        receipt = thing.trials.add(
            poses,
            outcomes,
            gripper="panda",
            source="robot",
            qualities={"flex": flex},
            metadata=[{"i": i} for i in range(TRIALS)],
            licence="CC-BY-4.0",
        )
        assert receipt.inserted == TRIALS
        stored = thing.trials.list().arrays()
        np.testing.assert_array_equal(stored.matrices, poses)
        np.testing.assert_array_equal(stored.qualities["flex"], flex)
        np.testing.assert_array_equal(stored.success, outcomes)
        best = thing.best_grasp(
            box=([-0.1, -0.1, 0.0], [0.1, 0.1, 0.2]), approach=(0, 0, 1), approach_cone_deg=45
        )
        assert np.linalg.norm(best.matrix[:3, 3] - [0.0, 0.0, 0.1]) < 0.01
        told = thing.likelihood(poses)
        assert told.density.shape == (TRIALS,)
        far = ([5.0, 5.0, 5.0], [5.1, 5.1, 5.1])
        assert _refusal(Infeasible, lambda: thing.best_grasp(box=far))
        three = ["success", "success", "none such"]
        assert "none such" in _refusal(ValueError, lambda: thing.trials.add(poses[:3], three))

    async def asked() -> float:
        async with AsyncClient(url) as db:
            return (await (await db.objects.get(slug)).best_grasp()).density

    assert asyncio.run(asked()) > 0
    command = [str(Path(sys.executable).with_name("graspdb")), "--url", url, "--json"]
    batches = json.loads(
        subprocess.run([*command, "batches", "list", slug], check=True, capture_output=True).stdout
    )
    assert batches[0]["licence"] == "CC-BY-4.0"
    with Client(url) as db:
        db.objects.get(slug).delete()
    sys.stdout.write(f"Python {sys.version.split()[0]}, NumPy {np.__version__}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
