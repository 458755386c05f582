"""Verifying labels at a finer step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from graspdb.examples import example
from graspdb.wire import SimulatePayload
from graspdb_simworker.inspection import agreement
from graspdb_simworker.simulation.labels import Outcome


def test_labels_hold_at_a_finer_step(payload_of: Callable[..., SimulatePayload]) -> None:
    seen: list[tuple[int, int]] = []
    found = agreement.verify(
        payload_of("mug", stop=3_000),
        example("mug").parts,
        count=60,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen[-1] == (seen[-1][1], seen[-1][1])
    assert {s.outcome for s in found.strata} >= {Outcome.SUCCESS, Outcome.SLIPPED}
    assert 50 <= found.checked <= 66
    for stratum in found.strata:
        assert 0 < stratum.checked <= stratum.available
        assert stratum.same <= stratum.agree <= stratum.checked
    assert found.agreement >= 0.93
    assert 0.85 < found.lower < found.agreement
    assert found.same <= found.agreement


def test_disagreement_counts_by_the_share_of_its_outcome() -> None:
    before = np.array([1] * 40 + [4] * 10, dtype=np.uint8)
    after = before.copy()
    after[40:45] = Outcome.SUCCESS  # half the slipped ones are successes after all
    after[45:48] = Outcome.MISSED  # and some fail otherwise
    found = agreement._agreement({1: 900.0, 4: 100.0}, before, after, np.random.default_rng(0))
    assert found.agreement == pytest.approx(0.9 + 0.1 * 0.5)
    assert found.same == pytest.approx(0.9 + 0.1 * 0.2)
    # Forty of forty and five of ten, weighed: some percent lower at 95 %.
    assert 0.88 < found.lower < 0.94
