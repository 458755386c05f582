"""Rows of the tables in docs/experiments.md, from what ``graspdb --json sweeps list`` prints:

``graspdb --json sweeps list | python tests/benchmarks/_grid_table.py``
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Any

CAUSES = (
    "success",
    "collision",
    "missed",
    "slipped",
    "wrench_insufficient",
    "timeout",
    "simulation_error",
)
PAPER = {
    "cone": (166_690, 3_331_043),
    "screwdriver": (159_947, 1_574_709),
    "mug": (19_051, 4_127_861),
    "elongated-d": (2_898, 99_764),
}
"""Successes and failures of table I."""


def rows(text: str) -> list[Mapping[str, Any]]:
    """Sweeps from JSON: a list, an object with ``items``, or one object a line."""
    try:
        found = json.loads(text)
    except json.JSONDecodeError:
        return [json.loads(line) for line in text.splitlines() if line.strip()]
    if isinstance(found, dict):
        return list(found.get("items", [found]))
    return list(found)


def causes_row(sweep: Mapping[str, Any]) -> str:
    """What became of every simulated pose."""
    counts = sweep["outcomes"]
    cells = [f"{sweep['poses_done']:,}", *(f"{counts.get(cause, 0):,}" for cause in CAUSES)]
    return f"| {sweep['object']} | {' | '.join(cells)} |"


def rates_row(sweep: Mapping[str, Any]) -> str:
    """Successes by each counting rule; both twins of a pose are counted."""
    counts = sweep["outcomes"]
    attempts = sum(counts.values())
    won, collided = counts.get("success", 0), counts.get("collision", 0)
    twins = 2
    paper_won, paper_lost = PAPER[sweep["object"]]
    cells = [
        f"{twins * won:,}",
        f"{twins * (attempts - won):,}",
        f"{won / attempts:.2%}",
        f"{won / (attempts - collided):.2%}",
        f"{won / (attempts - won):.2%}",
        f"{paper_won:,}",
        f"{paper_lost:,}",
        f"{paper_won / paper_lost:.2%}",
    ]
    return f"| {sweep['object']} | {' | '.join(cells)} |"


def main() -> None:
    """Print both tables' rows of the sweeps that have outcomes, finished or not."""
    sweeps = [sweep for sweep in rows(sys.stdin.read()) if sweep["outcomes"]]
    for sweep in sweeps:
        if sweep["state"] != "done":
            done = f"{sweep['chunks_done']} of {sweep['chunks']} chunks"
            print(f"{sweep['object']} is {sweep['state']}: {done}", file=sys.stderr)
    for row in (causes_row, rates_row):
        print("\n".join(row(sweep) for sweep in sweeps), end="\n\n")


if __name__ == "__main__":
    main()
