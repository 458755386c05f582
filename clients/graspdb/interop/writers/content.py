"""What is written: poses in the frame and axes that a format wants, and what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.interop.grasps import Floats, Report
from graspdb.poses import Poses
from graspdb.wire import GripperProfile

#: Qualities that are probabilities, the first that is there is a confidence.
_PROBABILITIES = ("confidence", "success_probability")


@dataclass(frozen=True)
class Content:
    """N poses (metres) of ``frame`` with the axes of ``convention``, and of each ``outcomes`` by name,
    ``qualities`` and ``more`` columns; None where there are none. ``approach`` (3,) is the unit vector of the
    approach in those axes.
    """

    poses: Poses
    frame: str
    convention: str
    approach: Floats
    outcomes: NDArray[np.str_] | None = None
    qualities: Mapping[str, Floats] = field(default_factory=dict)
    more: Mapping[str, list[Any]] = field(default_factory=dict)
    gripper: GripperProfile | None = None
    gripper_name: str | None = None
    object_name: str | None = None

    def __len__(self) -> int:
        return len(self.poses.position)

    def held(self, report: Report) -> NDArray[np.bool_]:
        """(N,) whether each is a success, said of outcomes that are only that much in the format."""
        if self.outcomes is None:
            report.assume("every grasp counts as a success: no outcome is known")
            return np.ones(len(self), dtype=bool)
        kinds = sorted(set(self.outcomes.tolist()) - {"success", "failure"})
        if kinds:
            report.drop(f"why a grasp failed ({', '.join(kinds)}): all are failures")
        return np.asarray(self.outcomes == "success")

    def confidence(self, report: Report) -> Floats:
        """(N,) a probability of each, NaN where there is none: a quality that is one, else 1 for a success
        and 0 for a failure; ValueError where neither is known.
        """
        for name in _PROBABILITIES:
            values = self.qualities.get(name)
            if values is not None and np.all(np.isnan(values) | ((values >= 0) & (values <= 1))):
                report.map(f"{name} to confidence")
                return values
        if self.outcomes is None:
            raise ValueError(
                "a confidence is a probability, and neither a success probability nor an outcome of the"
                " grasps is known"
            )
        report.map("success to confidence 1, failure to 0")
        return self.held(report).astype(np.float64)

    def left(self, report: Report, *written: str) -> None:
        """Say which qualities and columns the format has no place for."""
        names = [name for name in (*self.qualities, *self.more) if name not in written]
        if names:
            report.drop(", ".join(names))

    def joints(self, at: str) -> dict[str, float]:
        """Values of the gripper's joints by name, ``open`` or ``closed``; none where its profile has none."""
        known = {} if self.gripper is None else self.gripper.joints
        return {name: float(getattr(values, at)) for name, values in known.items()}
