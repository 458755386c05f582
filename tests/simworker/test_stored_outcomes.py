"""What a service has stored of a sweep, simulated again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import httpx
import numpy as np
import pytest

from graspdb.examples import example
from graspdb.transport import Transport
from graspdb_simworker.inspection import agreement, inputs, stored_outcomes
from graspdb_simworker.loop import Worker
from graspdb_simworker.simulation.labels import Outcome


@pytest.fixture
def swept(serve: Callable[..., str], sqlite_url: str) -> Iterator[tuple[str, str]]:
    """Address of a service and a finished sweep of the mug on it."""
    url = serve(sqlite_url, retry_after_s=0.2)
    mug = example("mug")
    with httpx.Client(base_url=url, timeout=30.0) as http:
        http.post("/objects", json={"id": "mug", "mass_kg": mug.mass_kg, "friction": mug.friction})
        for path, body, media in (
            ("mesh", mug.stl(), "model/stl"),
            ("convex-parts", mug.parts_glb(), "model/gltf-binary"),
        ):
            http.put(f"/objects/mug/{path}", content=body, headers={"Content-Type": media}).raise_for_status()
        plan = {"grid": {"max_poses": 1500, "seed": 4}, "chunk_poses": 500}
        answer = http.post("/objects/mug/sweeps", json=plan)
        assert answer.status_code == 202, answer.text
        with Transport(url, retries=0) as transport:
            worker = Worker(transport, name="verified", exit_when_idle=True)
            worker.run()
        assert (worker.tally.jobs, worker.tally.failures) == (3, 0)
        yield url, answer.json()["id"]


def test_stored_outcomes_are_verified(swept: tuple[str, str]) -> None:
    url, sweep = swept
    info, stored = stored_outcomes.sample_of(sweep, per_outcome=40, url=url)
    assert (info.protocol, info.state) == ("wrench", "done")
    assert sum(stored.counts.values()) == 1500
    assert {name for name, n in info.outcomes.items() if n} == {
        Outcome(code).name.lower() for code, n in stored.counts.items() if n
    }
    for kind in np.unique(stored.outcomes):
        assert (stored.outcomes == kind).sum() == min(40, stored.counts[int(kind)])
    payload, parts = inputs.load("mug", "pg70", protocol=info.protocol, url=url)
    found = agreement.verify_stored(payload, parts, stored, count=24)
    assert 0 < found.checked <= 30
    assert found.agreement > 0.8
    # Geometry alone decided most misses: they are not among what is compared.
    missed = [s for s in found.strata if s.outcome is Outcome.MISSED]
    assert all(s.available < stored.counts[Outcome.MISSED] for s in missed)
    # A wrong label does not go unnoticed.
    lie = replace(
        stored,
        outcomes=np.full_like(stored.outcomes, Outcome.SUCCESS),
        counts={Outcome.SUCCESS: len(stored.outcomes)},
    )
    assert agreement.verify_stored(payload, parts, lie, count=24).agreement < 0.7

    # The same worker does the other protocol.
    rim = {"position": [0.0, 0.028, 0.035], "quaternion_xyzw": [1.0, 0.0, 0.0, 0.0]}
    with httpx.Client(base_url=url, timeout=30.0) as http:
        lift = http.post("/objects/mug/sweeps", json={"poses": [rim], "protocol": "lift"}).json()
        with Transport(url, retries=0) as transport:
            Worker(transport, name="lifter", exit_when_idle=True).run()
        (trial,) = http.get("/objects/mug/trials", params={"batch": lift["batch"]}).json()["items"]
    assert (trial["outcome"], trial["protocol"]) == ("success", "lift")
    assert 0.8 < trial["quality"] <= 1.0

    # And simulates poses several times, which are drawn again the same.
    above = {**rim, "position": [0.0, 0.0, 0.1]}
    asked = {"draws": 3, "pose_noise_m": 1e-4, "pose_noise_deg": 0.1}
    with httpx.Client(base_url=url, timeout=30.0) as http:
        drawn = http.post("/objects/mug/sweeps", json={"poses": [rim, above], "randomise": asked}).json()
        with Transport(url, retries=0) as transport:
            Worker(transport, name="drawer", exit_when_idle=True).run()
        page = http.get(f"/sweeps/{drawn['id']}/outcomes").json()
    assert (page["outcome"], page["successes"]) == (["success", "missed"], [3, 0])
    info, stored = stored_outcomes.sample_of(drawn["id"], per_outcome=10, url=url)
    assert info.randomise is not None
    again = agreement.verify_stored(
        payload.model_copy(update={"randomise": info.randomise}), parts, stored, count=10
    )
    assert (again.checked, again.agreement, again.successes_apart) == (1, 1.0, 0.0)
