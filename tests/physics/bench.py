"""The grasps that theory speaks of, at loads around the limit, and what the worker says of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import closed_forms
from closed_forms import Case

from graspdb_simworker.simulation.labels import Label, Outcome
from graspdb_simworker.simulation.lifting import LIFT, MOTIONS, SHAKE

FRICTIONS = (0.1, 0.2, 0.4, 0.7, 1.0)
LOADS = (0.4, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.5)
"""Shares of the limit: at most the second must hold, and from the sixth on none may."""
HOLDS, FAILS = 0.8, 1.25
_UNMOVED = 1.0 - LIFT.allowed.translation_m / SHAKE.allowed.translation_m
"""Quality of ``shake`` from which on an object moved by 1 mm at most, as ``lift`` allows; turned by 3.6
degrees."""
_STEADY = 0.8
"""Where tilting takes this share of what lifts a patch's edge off, its pressure is not uniform any more."""


def boxes() -> Iterator[Case]:
    """Boxes and plates, held in the middle and beside it."""
    for size in ((0.06, 0.02, 0.02), (0.1, 0.02, 0.03), (0.2, 0.03, 0.04), (0.12, 0.004, 0.08)):
        for x, z in ((0.0, 0.0), (0.005, 0.0), (0.01, 0.0), (0.02, 0.0), (0.0, 0.01), (0.01, 0.01)):
            yield closed_forms.box(size, x, z)


def cylinders() -> Iterator[Case]:
    """Cylinders by their ends, and across."""
    for radius, x in ((0.008, 0.0), (0.02, 0.0), (0.02, 0.005)):
        yield closed_forms.cylinder_by_its_ends(radius, 0.03, x)
    for axis in "xz":
        for radius, length in ((0.015, 0.08), (0.008, 0.07), (0.025, 0.05)):
            for off in (0.0, 0.005, 0.01):
                yield closed_forms.cylinder_by_its_side(radius, length, axis, off)


def balls() -> Iterator[Case]:
    for radius in (0.01, 0.02, 0.03):
        yield closed_forms.sphere(radius)


@dataclass(frozen=True)
class Row:
    """What was said of one grasp: the load over the limit, and the label."""

    case: Case
    protocol: str
    limit_kg: float
    loads: tuple[float, ...]
    labels: tuple[Label, ...]

    @property
    def held(self) -> tuple[bool, ...]:
        """Which succeeded; ``shake`` lets objects slide, so here also: and did not."""
        least = _UNMOVED if self.protocol == "shake" else -math.inf
        return tuple(label.outcome is Outcome.SUCCESS and label.quality >= least for label in self.labels)

    @property
    def wrong(self) -> list[str]:
        """Labels that theory forbids, in words."""
        said = zip(self.loads, self.labels, self.held, strict=True)
        return [
            f"{self.case.name}, friction {self.case.friction:g}, {load:g} of {self.limit_kg:.3g} kg: {label}"
            for load, label, held in said
            if (load <= HOLDS and not held) or (load >= FAILS and held)
        ]

    @property
    def flips(self) -> int:
        """How often the label changes with the load: once, if it does as it should."""
        return sum(one != two for one, two in zip(self.held, self.held[1:], strict=False))


def asked(case: Case, protocol: str) -> float | None:
    """The limit in kilograms; None where theory does not speak of the case."""
    if protocol == "wrench":
        return closed_forms.wrench_limit(case.friction)
    motion = MOTIONS[protocol]
    limit = closed_forms.carried_limit(case, motion)
    tilt = closed_forms.tilt_ratio(case, closed_forms.loads_of(case, limit, motion))
    return limit if tilt < _STEADY else None


def row(
    case: Case, protocol: str, fidelity: str, loads: Sequence[float] = LOADS, engine: str = "pybullet"
) -> Row | None:
    """Simulate a case at loads over its limit; None where theory does not speak of it."""
    limit = asked(case, protocol)
    if limit is None:
        return None
    labels = [
        closed_forms.simulate(
            case.part,
            case.position,
            load * limit,
            case.friction,
            protocol=protocol,
            fidelity=fidelity,
            engine=engine,
        )
        for load in loads
    ]
    return Row(case, protocol, limit, tuple(loads), tuple(labels))


def wedge_label(friction: float, share: float, protocol: str, fidelity: str) -> Label:
    """Of a light wedge whose sides lean by ``share`` of the angle of friction."""
    half_angle = share * math.atan(friction)
    part = closed_forms.wedge(half_angle)
    return closed_forms.simulate(part, (0.0, 0.0, 0.0), 0.02, friction, protocol=protocol, fidelity=fidelity)


def tips_label(
    friction: float, share: float, radius: float, engine: str, fidelity: str = "standard"
) -> Label:
    """Of a light cylinder on the fingers' tips, touched leaning by ``share`` of the angle of friction; by
    ``wrench``."""
    part, where = closed_forms.cylinder_on_the_tips(radius, share * math.atan(friction))
    return closed_forms.simulate(part, where, 0.05, friction, fidelity=fidelity, engine=engine)
