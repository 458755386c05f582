"""Mixed traffic: clients that ask, post and delete, and simulated workers, each thinking between requests.

What is stored stays as much as it was: a client deletes the batch before the one that it has posted, and a
sweep's batch goes when the sweep is done. So memory that grows is memory that is lost.
"""

from __future__ import annotations

import asyncio
import base64
import json
import math
import random
import time
import uuid
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np

from graspdb.wire import OUTCOME_CODES

OBJECTS = [f"object-{n}" for n in range(10)]
SWEPT = "swept"
CHUNK, CHUNKS = 20, 100
#: A worker renews its leases so often at least, of those that jobs have by default.
_PACE_S = 20.0
#: The share of each kind among a client's requests.
MIX = {"best-grasp": 0.55, "likelihood": 0.2, "density": 0.1, "trials": 0.1, "objects": 0.05}


@dataclass
class Seen:
    """What was answered: times by kind, and what was no success."""

    seconds: dict[str, list[float]] = field(default_factory=dict)
    errors: Counter[str] = field(default_factory=Counter)

    @property
    def requests(self) -> int:
        return sum(len(each) for each in self.seconds.values()) + self.errors.total()

    def share(self, kind: str, share: float) -> float:
        """Seconds within which this share of a kind's requests was answered."""
        return float(np.quantile(self.seconds.get(kind) or [float("nan")], share))


def trials(count: int, rng: np.random.Generator) -> dict[str, Any]:
    turns = rng.normal((1, 0, 0, 0), 0.2, (count, 4))
    return {
        "columns": {
            "position": rng.normal(0, 0.02, (count, 3)).tolist(),
            "quaternion_xyzw": (turns / np.linalg.norm(turns, axis=1)[:, None]).tolist(),
            "outcome": (rng.random(count) < 0.6).tolist(),
        },
        "gripper": "pg70",
        "source": "robot",
        "protocol": "wrench",
    }


def poses(count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    told = trials(count, rng)["columns"]
    columns = zip(told["position"], told["quaternion_xyzw"], strict=True)
    return [{"position": position, "quaternion_xyzw": turn} for position, turn in columns]


def _sweep(rng: np.random.Generator) -> bytes:
    wish = {"poses": poses(CHUNK * CHUNKS, rng), "gripper": "pg70", "chunk_poses": CHUNK}
    return json.dumps(wish).encode()


class Traffic:
    """Actors of one service, with ``think_s`` seconds between an answer and the next request, on average."""

    def __init__(self, url: str, *, clients: int, workers: int, think_s: float) -> None:
        self._url, self._think_s = url, think_s
        self._clients, self._workers = clients, workers
        self.seen = Seen()
        self._end = 0.0
        # Written beforehand: meanwhile no answer could be noted.
        self._sweeps = [_sweep(np.random.default_rng()) for _ in range(4 if workers else 0)]

    async def run(self, seconds: float) -> Seen:
        self._end = time.monotonic() + seconds
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=self._clients + self._workers)
        async with AsyncExitStack() as stack:
            http = await stack.enter_async_context(
                httpx.AsyncClient(base_url=self._url, timeout=120, limits=limits, trust_env=False)
            )
            actors: list[Awaitable[None]] = [self._client(http, number) for number in range(self._clients)]
            actors += [self._worker(http, number) for number in range(self._workers)]
            actors += [self._planner(http) for _ in range(2) if self._workers]
            await asyncio.gather(*actors)
        return self.seen

    async def _ask(
        self,
        http: httpx.AsyncClient,
        kind: str,
        method: str,
        path: str,
        *,
        longest_s: float = math.inf,
        **sent: Any,
    ) -> Any:
        """A request, noted; the answer's JSON, or None for an error. Then time to think, ``longest_s`` at
        most.
        """
        started = time.monotonic()
        try:
            answer = await http.request(method, path, **sent)
        except httpx.TransportError as error:
            self.seen.errors[f"{kind}: {error!r}"] += 1
            return None
        if answer.is_success:
            self.seen.seconds.setdefault(kind, []).append(time.monotonic() - started)
        else:
            self.seen.errors[f"{kind}: {answer.status_code} {answer.text[:120]}"] += 1
        await self._think(longest_s)
        return answer.json() if answer.is_success and answer.content else None

    async def _think(self, longest_s: float) -> None:
        pause = random.expovariate(1.0 / self._think_s) if self._think_s else 0.0
        await asyncio.sleep(max(0.0, min(pause, longest_s, self._end - time.monotonic())))

    async def _client(self, http: httpx.AsyncClient, number: int) -> None:
        rng = np.random.default_rng(number)
        await asyncio.sleep(float(rng.uniform(0, self._think_s)))
        before: str | None = None
        while time.monotonic() < self._end:
            at = f"/objects/{OBJECTS[rng.integers(len(OBJECTS))]}"
            kind = str(rng.choice(list(MIX), p=list(MIX.values())))
            if kind == "best-grasp":
                low = rng.uniform(-0.03, 0.0, 3)
                box = {"box_min": ",".join(map(str, low)), "box_max": ",".join(map(str, low + 0.04))}
                await self._ask(http, kind, "GET", f"{at}/best-grasp", params=box)
            elif kind == "likelihood":
                await self._ask(http, kind, "POST", f"{at}/likelihood", json={"poses": poses(50, rng)})
            elif kind == "trials":
                key = {"Idempotency-Key": str(uuid.uuid4())}
                made = await self._ask(http, kind, "POST", f"{at}/trials", json=trials(20, rng), headers=key)
                if before is not None:
                    await self._ask(http, "delete", "DELETE", before)
                before = None if made is None else f"{at}/batches/{made['batch']}"
            else:
                await self._ask(http, kind, "GET", f"{at}/density" if kind == "density" else "/objects")

    async def _worker(self, http: httpx.AsyncClient, number: int) -> None:
        """Claims, simulates nothing for a while, and hands in outcomes and rows. Like a real worker it never
        thinks so long that its lease ends.
        """
        wish = {"worker": f"load-{number}", "capabilities": ["simulate"], "limit": 1}
        while time.monotonic() < self._end:
            found = await self._ask(http, "claim", "POST", "/jobs/claim", json=wish, longest_s=_PACE_S)
            for job in (found or {}).get("jobs", ()):
                lease = {"lease_id": job["lease_id"]}
                index = list(range(job["payload"]["start"], job["payload"]["stop"]))
                codes = [OUTCOME_CODES["success" if n % 2 else "slipped"] for n in index]
                rows = {"pose_index": index, "width_m": [0.04] * len(index), "quality": [None] * len(index)}
                result = {"outcomes": base64.b64encode(bytes(codes)).decode(), "rows": rows}
                path = f"/jobs/{job['id']}"
                await self._ask(http, "renew", "PUT", f"{path}/lease", params=lease, longest_s=_PACE_S)
                await self._ask(http, "result", "PUT", f"{path}/result", params=lease, json=result)
            if not (found or {}).get("jobs"):
                await asyncio.sleep(max(0.0, min(0.5, self._end - time.monotonic())))

    async def _planner(self, http: httpx.AsyncClient) -> None:
        """Keeps workers busy: a sweep after the other, each deleted when it is done."""
        typed = {"Content-Type": "application/json"}
        while time.monotonic() < self._end:
            wish = random.choice(self._sweeps)
            path = f"/objects/{SWEPT}/sweeps"
            sweep = await self._ask(http, "sweep", "POST", path, content=wish, headers=typed)
            while sweep is not None and sweep["state"] in ("queued", "running"):
                if time.monotonic() > self._end:
                    return
                await asyncio.sleep(1.0)
                sweep = await self._ask(http, "sweep", "GET", f"/sweeps/{sweep['id']}")
            if sweep is not None and sweep.get("batch"):
                await self._ask(http, "delete", "DELETE", f"/objects/{SWEPT}/batches/{sweep['batch']}")


def prepare(url: str, mesh: Callable[[], bytes]) -> None:
    """The objects that are asked about, each with 2,000 trials, and one that is swept."""
    rng = np.random.default_rng(0)
    with httpx.Client(base_url=url, timeout=240, trust_env=False) as http:
        for name in (*OBJECTS, SWEPT):
            http.post("/objects", json={"id": name, "mass_kg": 0.2}).raise_for_status()
            if name == SWEPT:
                stl = {"Content-Type": "model/stl"}
                http.put(f"/objects/{name}/mesh", content=mesh(), headers=stl).raise_for_status()
            else:
                http.post(f"/objects/{name}/trials", json=trials(2_000, rng)).raise_for_status()
                http.get(f"/objects/{name}/best-grasp").raise_for_status()
