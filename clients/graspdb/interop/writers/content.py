"""What is written: poses in the frame and axes that a format wants, and what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.interop import joints
from graspdb.interop.grasps import Floats, Report
from graspdb.poses import Poses
from graspdb.wire import GripperProfile

#: Qualities that are probabilities, the first that is there is a confidence.
_PROBABILITIES = ("confidence", "success_probability")


@dataclass(frozen=True)
class Content:
    """A run of N poses (metres) of ``frame`` with the axes of ``convention``, and of each ``outcomes`` by
    name, ``qualities`` and ``more`` columns; None where there are none. ``approach`` (3,) is the unit vector
    of the approach in those axes, ``first`` the number of the run's first grasp; all runs of a file have the
    same columns.
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
    first: int = 0

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

    def score(self) -> str | None:
        """The name of the first quality that any grasp has; None for none."""
        return next((name for name, values in self.qualities.items() if not np.isnan(values).all()), None)

    def left(self, report: Report, *written: str, postures: bool = False) -> None:
        """Say which qualities and columns the format has no place for; ``postures`` are written from the
        metadata.
        """
        filled = [name for name, values in self.qualities.items() if not np.isnan(values).all()]
        filled += [name for name, values in self.more.items() if any(value is not None for value in values)]
        names = [name for name in filled if name not in written]
        if postures and "metadata" in names:
            entries = (entry for entry in self.more["metadata"] if isinstance(entry, dict))
            if not any(entry.keys() - set(joints.KINDS) for entry in entries):
                names.remove("metadata")
        if postures and "width_m" in names and joints.values_at(self.gripper, 0.0) is not None:
            names.remove("width_m")
        if names:
            report.drop(", ".join(names))

    def joints(self, at: str) -> dict[str, float]:
        """Values of the gripper's joints by name, ``open`` or ``closed``; none where its profile has none."""
        known = {} if self.gripper is None else self.gripper.joints
        return {name: float(getattr(values, at)) for name, values in known.items()}

    def postures(self, report: Report) -> list[tuple[dict[str, float], dict[str, float]]]:
        """Of each grasp the joints' values by name in it, and before the jaw closes: its own where it has
        any, else by its width, else those of the closed and of the open jaw.
        """
        closed, opened = self.joints("closed"), self.joints("open")
        entries = self.more.get("metadata", [None] * len(self))
        widths = self.more.get("width_m", [None] * len(self))
        found = []
        for entry, width in zip(entries, widths, strict=True):
            own = entry if isinstance(entry, dict) else {}
            at, before = (self._named(own.get(kind), report) for kind in joints.KINDS)
            if at is None and width is not None and width == width:
                at = joints.values_at(self.gripper, width)
                if at is not None:
                    report.map("width_m to the joints' values in the grasp, by the gripper's profile")
            if at is None and closed:
                report.assume("joints are closed in the grasp, whatever the object's width")
            found.append((closed if at is None else at, opened if before is None else before))
        return found

    def _named(self, posture: Any, report: Report) -> dict[str, float] | None:
        """A grasp's own posture by joints' names; None for none."""
        names = [] if self.gripper is None else list(self.gripper.joints)
        if isinstance(posture, list) and len(posture) == len(names):
            posture = dict(zip(names, posture, strict=True))
        if isinstance(posture, list):
            report.drop("joints' values that have no names")
        numeric = isinstance(posture, dict) and all(isinstance(x, (int, float)) for x in posture.values())
        return {str(name): float(x) for name, x in posture.items()} if numeric else None
