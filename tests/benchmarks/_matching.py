"""How many grasps do kernels need? Isotropic, anisotropic and aligned ones under three rules of matching.

After the grids of docs/experiments.md, with ``graspdb-server serve`` and ``graspdb-simworker run`` running:
``python tests/benchmarks/_matching.py [OBJECT ...] [--learned 5000] [--judged 20000] [--draws 4000]``

Of an object's successes, in random order, the first are learned from and others, disjoint ones, are judged:
two copies of the object that have only them. Kernels are fitted on the first and scaled to the widths of the
isotropic kernel that they are compared with (15 mm and 15 degrees: their determinants). On the second, the
service's convergence report says at how many grasps a kernel and the isotropic one matched to it reach
s = 0.95 (eq 9). Draws are simulated as checks. The last column is the kernel's number over the other's.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb import Client
from graspdb.errors import ChecksNeeded, Conflict, NotFound
from graspdb.reports import Convergence
from graspdb.resources.objects import GraspObject
from graspdb.wire import StoredKernel

ALIGNED = {"cone": "object", "screwdriver": "object", "elongated-d": "edge", "mug": "edge"}
"""What the paper's hypothesis aligns with: a long object's own axis, else the nearest edge."""
WINDOWS = ((0.03, 45.0), (0.06, 60.0), (0.10, 60.0), (0.20, 60.0))
"""Displacements that shape a kernel, metres and degrees: the likeliest of these is taken."""
RULES = ("determinants", "success", "likelihood")
SIGMA_M, SIGMA_DEG = 0.015, 15.0

Floats = NDArray[np.float64]


def copied(db: Client, name: str, copy: str, poses: Floats) -> GraspObject:
    """An object with another's geometry whose trials are these successes."""
    try:
        return db.objects.get(copy)
    except NotFound:
        source = db.objects.get(name)
    made = db.objects.create(
        copy,
        mesh=source.download_mesh(),
        media_type="model/stl",
        convex_parts=source.download_convex_parts(),
        mass_kg=source.info.mass_kg,
        density_kg_m3=source.info.density_kg_m3,
        friction=source.info.friction,
    )
    made.trials.add(poses, True, gripper="pg70", protocol="wrench", source="simulation")
    return made.refresh()


def split(db: Client, name: str, learned: int, judged: int) -> tuple[GraspObject, GraspObject]:
    """Copies with disjoint successes: to learn from, and to judge by."""
    names = f"{name}-learned-{learned}", f"{name}-judged-{judged}"
    try:
        return db.objects.get(names[0]), db.objects.get(names[1])
    except NotFound:
        found = db.objects.get(name).trials.list(outcome="success").arrays().matrices
    order = np.random.default_rng(0).permutation(len(found))
    if len(order) < learned + judged:
        sys.exit(f"{name} has {len(order):,} successes: sweep more of its grid, or ask for fewer")
    parts = order[:learned], order[learned : learned + judged]
    first, second = (copied(db, name, n, found[part]) for n, part in zip(names, parts, strict=True))
    return first, second


def fitted(db: Client, learned: GraspObject, alignment: str) -> StoredKernel:
    """The likeliest kernel, given other blocks of space, of those fitted in each window."""
    found: list[tuple[float, StoredKernel]] = []
    for metres, degrees in WINDOWS:
        window = {"position_m": metres, "rotation_deg": degrees}
        try:
            kernel = db.kernels.fit(learned.id, alignment=alignment, window=window)
        except Conflict as error:
            print(f"window of {1e3 * metres:.0f} mm, {degrees:.0f} deg: {error}", file=sys.stderr)
            continue
        told = kernel.provenance
        # Judged on the same grasps, and on others for another window.
        gain = (told.log_likelihood or -math.inf) - (told.isotropic_log_likelihood or 0.0)
        print(f"window of {1e3 * metres:.0f} mm, {degrees:.0f} deg: {gain:+.3f} nats", file=sys.stderr)
        found.append((gain, kernel))
    return max(found, key=lambda pair: pair[0])[1]


def to_size(db: Client, fitted: StoredKernel) -> StoredKernel:
    """The same shape with the determinants of the isotropic kernel, both blocks for themselves."""
    factors = np.repeat([SIGMA_M / fitted.sigma_position_m, SIGMA_DEG / fitted.sigma_rotation_deg], 3)
    components = [
        {
            "weight": item.weight,
            "mean": (np.array(item.mean) * factors).tolist(),
            "covariance": (np.array(item.covariance) * np.outer(factors, factors)).tolist(),
        }
        for item in fitted.components
    ]
    return db.kernels.create(components, alignment=fitted.alignment, gripper=fitted.gripper)


@dataclass(frozen=True)
class Count:
    """A number with its interval; None where it can't be told."""

    value: float | None
    low: float | None
    high: float | None

    def __str__(self) -> str:
        return self.told("{:,.0f}".format)

    def told(self, form: Callable[[float], str]) -> str:
        """For a table."""
        if self.value is None:
            return "?"
        ends = ["?" if end is None else form(end) for end in (self.low, self.high)]
        return f"{form(self.value)} ({ends[0]} to {ends[1]})"


def needed(report: Convergence, place: int) -> Count:
    """Grasps at which a curve reaches the target."""
    found = report.raw.curves[place].verdict.needed
    return Count(found.value, found.low, found.high)


def checked(judged: GraspObject, kernel: str, draws: int) -> Convergence:
    """The report matched by success, with the simulations that it asks for made first."""
    try:
        return judged.reports.convergence(kernel=kernel, matching="success")
    except ChecksNeeded as error:
        calls = error.calls
    for call in calls:
        call.body["sample"]["count"] = draws
    for sweep in judged.reports.simulate(calls):
        sweep.wait()
    return judged.reports.convergence(kernel=kernel, matching="success")


def rows(db: Client, name: str, options: Any) -> None:
    """Print what is found of an object as it comes."""
    learned, judged = split(db, name, options.learned, options.judged)
    for told, alignment in (("gripper's axes", "gripper"), (f"{ALIGNED[name]}'s axes", ALIGNED[name])):
        kernel = to_size(db, fitted(db, learned, alignment))
        shape = "/".join(f"{1e3 * w:.0f}" for w in kernel.widths_m) + " mm, "
        shape += "/".join(f"{w:.0f}" for w in kernel.widths_deg) + " deg"
        for rule in RULES:
            if rule == "success":
                report = checked(judged, kernel.id, options.draws)
            else:
                report = judged.reports.convergence(kernel=kernel.id, matching=rule)
            found = report.raw.ratio
            ratio = None if found is None else Count(found.value, found.low, found.high)
            other = report.raw.curves[1].kernel
            width = f"{1e3 * other.sigma_position_m:.1f} mm, {other.sigma_rotation_deg:.1f} deg"
            cells = [name, f"{told}: {shape}", rule, str(needed(report, 0)), width, str(needed(report, 1))]
            if not report.raw.matched:
                cells.append("none matches: " + "; ".join(report.warnings))
            else:
                cells.append("?" if ratio is None else ratio.told("{:.2f}".format))
            print(f"| {' | '.join(cells)} |", flush=True)


def arguments() -> Any:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("objects", nargs="*", default=list(ALIGNED))
    parser.add_argument("--learned", type=int, default=5_000)
    parser.add_argument("--judged", type=int, default=20_000)
    parser.add_argument("--draws", type=int, default=4_000)
    return parser.parse_args()


def main() -> None:
    """Print the table's rows as they come."""
    options = arguments()
    columns = ["object", "kernel", "matched by", "needs", "isotropic", "needs", "ratio"]
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}", flush=True)
    with Client() as db:
        for name in options.objects:
            rows(db, name, options)


if __name__ == "__main__":
    main()
