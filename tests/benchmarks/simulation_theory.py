"""What the worker says of grasps whose outcome mechanics knows: labels that theory forbids, by protocol,
fidelity and kind of grasp. Takes two hours of one core. The labels themselves go to the standard error
stream.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from graspdb_simworker.simulation.labels import Outcome

sys.path.append(str(Path(__file__).parents[1] / "physics"))

import bench

SHARES = (0.4, 0.8, 1.25, 1.5)
"""Of the angle of friction, by which wedges lean: below 1 they are held."""


def measure(protocol: str, fidelity: str) -> None:
    """Print the rows of a protocol at a fidelity."""
    for name, cases in (
        ("boxes, plates", bench.boxes),
        ("cylinders", bench.cylinders),
        ("balls", bench.balls),
    ):
        started = time.process_time()
        found = [
            bench.row(case.rubbing(mu), protocol, fidelity) for mu in bench.FRICTIONS for case in cases()
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
    leans = [(mu, share) for mu in bench.FRICTIONS for share in SHARES]
    held = [bench.wedge_label(mu, s, protocol, fidelity).outcome is Outcome.SUCCESS for mu, s in leans]
    shares = [share for _, share in leans]
    print(
        f"| {protocol} | {fidelity} | wedges | {len(leans)} | {len(leans)}"
        f" | {sum(s < 1.0 and not h for s, h in zip(shares, held, strict=True))}"
        f" | {sum(s > 1.0 and h for s, h in zip(shares, held, strict=True))} | | |"
    )


def main() -> None:
    heads = ("protocol", "fidelity", "held", "grasps", "labels", "false failures", "false successes")
    print("|", " | ".join(heads), "| flip not once | s |")
    print("|---" * 9 + "|")
    for protocol in ("wrench", "lift", "shake"):
        for fidelity in ("standard", "fine"):
            measure(protocol, fidelity)


if __name__ == "__main__":
    main()
