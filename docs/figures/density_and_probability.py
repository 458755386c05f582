"""Draws density-and-probability.svg: a bar, tried often in one place and seldom in another, and what the
service says of it.

python docs/figures/density_and_probability.py URL
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from graspdb import Client
from graspdb.figures.canvas import Figure, new_figure, show_grid
from graspdb.figures.style import BLUE, GREY, ORANGE

HELD_WITHIN_M, CHANCE, STEP_M = 0.06, 0.9, 0.0025
DOWN = (1.0, 0.0, 0.0, 0.0)


def tried() -> tuple[np.ndarray, np.ndarray]:
    """Positions along a bar (N,), metres, and whether each attempt held: 9 of 10 on it, none beyond it."""
    rng = np.random.default_rng(4)
    often, seldom = rng.normal(-0.035, 0.012, 240), rng.normal(0.035, 0.012, 24)
    along = np.concatenate([often, seldom, rng.uniform(-0.11, 0.11, 120)])
    return along, (np.abs(along) < HELD_WITHIN_M) & (rng.random(len(along)) < CHANCE)


def poses(along: np.ndarray) -> np.ndarray:
    """Rows x y z qx qy qz qw (N, 7): from above, at these places along the bar."""
    still = np.zeros(len(along))
    return np.column_stack([along, still, still, np.tile(DOWN, (len(along), 1))])


def _runs(chosen: np.ndarray) -> Iterator[slice]:
    """Where (N,) is true without a gap."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]])))
    return (slice(int(first), int(last)) for first, last in ends.reshape(-1, 2))


def draw(db: Client, name: str) -> Figure:
    """The trials posted to a new object of this name, and what the service says along the bar."""
    bar = db.objects.create(name)
    along, held = tried()
    bar.trials.add(poses(along), held, gripper="panda", source="robot")
    asked = np.arange(-0.16, 0.16 + STEP_M / 2, STEP_M)
    found = bar.likelihood(poses(asked))
    assert found.density is not None
    assert found.success_probability is not None
    assert found.interval is not None
    figure = new_figure(7.2, 5.4)
    attempts, density, chance = figure.subplots(3, 1, sharex=True, height_ratios=(0.9, 1.3, 1.7))
    bins = np.linspace(-0.11, 0.11, 45)
    attempts.hist(
        [along[held] * 1e3, along[~held] * 1e3], bins=bins * 1e3, stacked=True, color=[BLUE, ORANGE]
    )
    attempts.legend(["held", "failed"], fontsize=8, loc="upper right", frameon=False)
    attempts.set(ylabel="attempts")
    density.plot(asked * 1e3, found.density / found.density.max(), color=BLUE)
    density.set(ylabel="density,\nof its highest", ylim=(0, 1.08))
    chance.fill_between(
        asked * 1e3,
        found.interval.low,
        found.interval.high,
        color=BLUE,
        alpha=0.2,
        linewidth=0,
        label="90 % interval",
    )
    chance.plot(asked * 1e3, found.success_probability, color=BLUE, label="success probability")
    truth = np.where(np.abs(asked) < HELD_WITHIN_M, CHANCE, 0.0)
    chance.plot(
        asked * 1e3, truth, color=GREY, linestyle="--", linewidth=1, label="the truth, which nobody knows"
    )
    for run in _runs(np.isnan(found.success_probability)):
        left, right = (asked[run.start] - STEP_M / 2) * 1e3, (asked[run.stop - 1] + STEP_M / 2) * 1e3
        chance.axvspan(left, right, color="0.9", linewidth=0, label="unknown" if run.start == 0 else None)
    chance.set(
        ylabel="success probability", xlabel="place along the bar, mm", ylim=(0, 1.05), xlim=(-160, 160)
    )
    chance.legend(fontsize=8, loc="lower center", framealpha=1)
    for axes in (attempts, density, chance):
        show_grid(axes)
    return figure


if __name__ == "__main__":
    with Client(sys.argv[1]) as client:
        target = Path(__file__).with_name("density-and-probability.svg")
        draw(client, "bar").savefig(target, format="svg", metadata={"Date": None})
