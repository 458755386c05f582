"""What the worker says of grasps whose outcome mechanics knows: labels that theory forbids, by protocol,
fidelity and kind of grasp. All of them take some hours of one core, ``--protocols``, ``--fidelities`` and
``--kinds`` less. What is wrong goes to the standard error stream.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Collection
from pathlib import Path

from graspdb_simworker.simulation.labels import Outcome

sys.path.append(str(Path(__file__).parents[1] / "physics"))

import bench

SHARES = (0.4, 0.8, 1.25, 1.5)
"""Of the angle of friction, by which wedges lean: below 1 they are held."""
KINDS = {"boxes": bench.boxes, "cylinders": bench.cylinders, "balls": bench.balls}


def measure(protocol: str, fidelity: str, kinds: Collection[str]) -> None:
    """Print the rows of a protocol at a fidelity."""
    for name in (name for name in KINDS if name in kinds):
        started = time.process_time()
        found = [
            bench.row(case.rubbing(mu), protocol, fidelity)
            for mu in bench.FRICTIONS
            for case in KINDS[name]()
        ]
        rows = [row for row in found if row is not None]
        labels = [item for row in rows for item in zip(row.loads, row.held, strict=True)]
        print(
            f"| {protocol} | {fidelity} | {name} | {len(rows)} | {len(labels)}"
            f" | {sum(load <= bench.HOLDS and not held for load, held in labels)}"
            f" | {sum(load >= bench.FAILS and held for load, held in labels)}"
            f" | {sum(row.flips != 1 for row in rows)} | {time.process_time() - started:.0f} |",
            flush=True,
        )
        print(*(wrong for row in rows for wrong in row.wrong), sep="\n", file=sys.stderr, flush=True)
    if "wedges" in kinds:
        _measure_wedges(protocol, fidelity)


def _measure_wedges(protocol: str, fidelity: str) -> None:
    leans = [(mu, share) for mu in bench.FRICTIONS for share in SHARES]
    held = [bench.wedge_label(mu, s, protocol, fidelity).outcome is Outcome.SUCCESS for mu, s in leans]
    shares = [share for _, share in leans]
    print(
        f"| {protocol} | {fidelity} | wedges | {len(leans)} | {len(leans)}"
        f" | {sum(s < 1.0 and not h for s, h in zip(shares, held, strict=True))}"
        f" | {sum(s > 1.0 and h for s, h in zip(shares, held, strict=True))} | | |",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    for asked, known in (
        ("protocols", ("wrench", "lift", "shake")),
        ("fidelities", ("standard", "fine")),
        ("kinds", (*KINDS, "wedges")),
    ):
        parser.add_argument(f"--{asked}", nargs="+", choices=known, default=known)
    chosen = parser.parse_args()
    heads = ("protocol", "fidelity", "held", "grasps", "labels", "false failures", "false successes")
    print("|", " | ".join(heads), "| flip not once | s |")
    print("|---" * 9 + "|")
    for protocol in chosen.protocols:
        for fidelity in chosen.fidelities:
            measure(protocol, fidelity, chosen.kinds)


if __name__ == "__main__":
    main()
