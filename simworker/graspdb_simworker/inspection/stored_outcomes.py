"""A sample of what a service has stored of a sweep."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.resources.pages import answers
from graspdb.transport import Transport
from graspdb.wire import OUTCOME_CODES, SweepInfo


@dataclass(frozen=True)
class StoredOutcomes:
    """A sample of a sweep's stored outcomes, and how many of each outcome the sweep has.

    ``indices`` (n,) in its plan, ``positions`` (n, 3) and ``quaternions`` (n, 4) of the tool in the object
    frame, ``outcomes`` (n,) codes, ``successes`` (n,) of draws, None where nothing is drawn; within each
    outcome every pose of the sweep is as likely to be here.
    """

    indices: NDArray[np.int64]
    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    outcomes: NDArray[np.uint8]
    successes: NDArray[np.float64] | None
    counts: Mapping[int, int]


def sample_of(
    sweep: str,
    *,
    per_outcome: int,
    url: str,
    api_key: str | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[SweepInfo, StoredOutcomes]:
    """A sweep, and of each of its outcomes but collisions a random sample of ``per_outcome``, or all.

    ``progress`` is told how many of how many poses have been read. ValueError if nothing is simulated yet.
    """
    rng = np.random.default_rng(seed)
    # For each outcome the poses with the smallest of random keys, one drawn for each pose.
    kept = {name: np.empty((0, 10)) for name in OUTCOME_CODES if name != "collision"}
    counts = dict.fromkeys(OUTCOME_CODES, 0)
    with Transport(url, api_key=api_key, user_agent="graspdb-simworker") as transport:
        info = transport.model(SweepInfo, "GET", f"/sweeps/{sweep}")
        for page in answers(transport, f"/sweeps/{sweep}/outcomes", {"limit": 100_000}):
            outcomes = np.array(page["outcome"], dtype=object)
            columns = np.column_stack(
                [
                    rng.random(len(outcomes)),
                    np.reshape(page["position"], (-1, 3)),
                    np.reshape(page["quaternion_xyzw"], (-1, 4)),
                    page["pose_index"],
                    page.get("successes") or np.zeros(len(outcomes)),
                ]
            )
            for name, before in kept.items():
                rows = np.flatnonzero(outcomes == name)
                counts[name] += len(rows)
                both = np.concatenate([before, columns[rows]])
                kept[name] = both[np.argsort(both[:, 0])[:per_outcome]]
            counts["collision"] += int((outcomes == "collision").sum())
            progress(sum(counts.values()), info.poses)
    if not any(map(len, kept.values())):
        raise ValueError(f"sweep {sweep} has no outcome to verify yet")
    sample: NDArray[np.float64] = np.concatenate(list(kept.values()))
    codes = np.repeat([OUTCOME_CODES[name] for name in kept], [len(k) for k in kept.values()])
    by_code = {OUTCOME_CODES[name]: n for name, n in counts.items()}
    successes = None if info.randomise is None else sample[:, 9]
    return info, StoredOutcomes(
        sample[:, 8].astype(np.int64),
        sample[:, 1:4],
        sample[:, 4:8],
        codes.astype(np.uint8),
        successes,
        by_code,
    )
