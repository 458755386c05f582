"""Trials that come, or are wanted, in another frame of their gripper than the tool, in which all are kept."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graspdb.wire import Convention, GripperProfile
from graspdb.wire.base import MAX_COORDINATE_M, Quadruple
from graspdb.wire.frames.gripper_frames import TOOL
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_service.problems import ProblemError, conflict, invalid
from graspdb_service.storage import grippers
from graspdb_service.storage.database import Tx
from graspdb_service.trial_columns import Floats, Ints, Provenance, TrialBatch, TrialColumns, TrialPage
from graspdb_service.usecases.trials.pose_frames import PoseFrame, pose_frame, with_near


@dataclass(frozen=True)
class AskedFrame:
    """The frame of each trial's own gripper that poses are of, None for the tool's, and whose axes; ``near``
    is the rotation of it that the nearer of two twins is told to.
    """

    frame: str | None = None
    convention: Convention | None = None
    near: Quadruple | None = None

    @property
    def is_tool(self) -> bool:
        """Whether poses are as they are kept."""
        tools = self.frame in (None, TOOL) and self.convention in (None, "graspdb")
        return tools and self.near is None

    @property
    def needs_gripper(self) -> bool:
        """Whether it is another frame for every gripper."""
        return self.frame not in (None, TOOL)

    def told(self) -> dict[str, str]:
        """What an answer says of its poses."""
        return {"frame": self.frame or TOOL, "convention": self.convention or "graspdb"}


def into_tool(tx: Tx, batch: TrialBatch, asked: AskedFrame) -> tuple[TrialBatch, list[int]]:
    """Trials of a request, each brought to the tool frame of its gripper, which is the version that it stands
    for now; 422 for trials that name no gripper, or none there is. Also those places of its provenances whose
    frame is turned against the tool, where a convention says other axes than its own.
    """
    if asked.is_tool:
        return batch, []
    frames, named = [], []
    for place, item in enumerate(batch.provenances):
        if item.gripper is None and asked.needs_gripper:
            row = int(np.flatnonzero(batch.columns.provenance == place)[0])
            told = f"frame={asked.frame} is one of a gripper: say which grasped"
            raise ProblemError(
                422,
                "invalid-request",
                "Trials name no gripper",
                errors=[(batch.field_of(row, "gripper"), told)],
            )
        found = None if item.gripper is None else grippers.find(tx, item.gripper)
        if item.gripper is not None and found is None:
            raise unknown_grippers(batch, [item.gripper])
        profile = None if found is None else GripperProfile.model_validate(found.profile)
        frames.append(pose_frame(asked.frame, asked.convention, profile, item.gripper))
        # Another version may come in before they are stored; these poses are of this one's frames.
        named.append(item if found is None else item._replace(gripper=found.versioned))
    columns = _moved(batch.columns, enumerate(frames), back=True)
    far = np.flatnonzero((np.abs(columns.position) > MAX_COORDINATE_M).any(axis=1))
    if len(far):
        told = f"its tool is more than {MAX_COORDINATE_M:g} m from the origin: look at the gripper's frames"
        raise invalid(batch.field_of(int(far[0]), "position"), told)
    turned = [place for place, frame in enumerate(frames) if frame.turned]
    return replace(batch, columns=columns, provenances=named), turned


def unknown_grippers(batch: TrialBatch, names: Sequence[str]) -> ProblemError:
    """422 for trials of grippers there are not."""
    return ProblemError(
        422,
        "unknown-gripper",
        f"There is no gripper {', '.join(map(repr, names))}:"
        " GET /grippers lists them, POST /grippers makes one",
        errors=[(batch.field_of_gripper(name), f"there is no gripper {name!r}") for name in names],
    )


def frames_of(
    tx: Tx, provenances: Mapping[int, Provenance], wanted: Collection[int], asked: AskedFrame
) -> dict[int, PoseFrame]:
    """The asked frame of each of these provenances' grippers; 409 where one names none."""
    if asked.is_tool:
        return {}
    frames = {}
    for number in sorted(wanted):
        gripper = provenances[number].gripper
        if gripper is None and asked.needs_gripper:
            raise conflict(
                "gripper-unknown",
                f"Some of these trials name no gripper, so where its frame {asked.frame!r} was is not known:"
                " choose those of one (gripper=)",
            )
        row = None if gripper is None else grippers.find(tx, gripper)
        profile = None if row is None else GripperProfile.model_validate(row.profile)
        found = pose_frame(asked.frame, asked.convention, profile, gripper)
        # Trials that name no gripper are taken as a symmetric jaw's everywhere.
        frames[number] = with_near(found, asked.near, symmetric=profile is None or profile.symmetric)
    return frames


def warnings_of(frames: Iterable[PoseFrame]) -> list[str]:
    """What frames warn of, each once."""
    return list(dict.fromkeys(warning for frame in frames for warning in frame.warnings))


def out_of_tool(tx: Tx, page: TrialPage, asked: AskedFrame) -> TrialPage:
    """Stored trials with the poses of the asked frame of each one's gripper."""
    if asked.is_tool:
        return page
    wanted = np.unique(page.columns.provenance).tolist()
    frames = frames_of(tx, page.provenances, wanted, asked)
    columns = _moved(page.columns, frames.items(), back=False)
    return replace(page, columns=columns, warnings=warnings_of(frames.values()))


def _moved(columns: TrialColumns, frames: Iterable[tuple[int, PoseFrame]], *, back: bool) -> TrialColumns:
    """Trials with their poses moved as the frame of each one's provenance says; ``back``: to the tool."""
    position, quaternion = columns.position.copy(), columns.quaternion_xyzw.copy()
    achieved, covariance = columns.achieved.copy(), list(columns.pose_covariance)
    move = PoseFrame.to_tool if back else PoseFrame.from_tool
    for frame, rows in _rows(columns, frames):
        commanded = Poses(columns.position[rows], columns.quaternion_xyzw[rows])
        position[rows], quaternion[rows] = move(frame, commanded)
        if len(achieved):
            known = rows[~np.isnan(achieved[rows, 0])]
            p, q = move(frame, Poses(achieved[known, :3], achieved[known, 3:]))
            achieved[known] = np.concatenate([p, q], axis=1)
        if covariance and frame.fixed is not None:
            fixed = Poses(np.array(frame.fixed.position), np.array(frame.fixed.quaternion_xyzw))
            adjoint = se3.adjoint(fixed if back else se3.inverse(fixed))
            for row in rows.tolist():
                covariance[row] = _turned(covariance[row], adjoint)
    return replace(
        columns,
        position=position,
        quaternion_xyzw=quaternion,
        achieved=achieved,
        pose_covariance=covariance,
    )


def _rows(columns: TrialColumns, frames: Iterable[tuple[int, PoseFrame]]) -> Iterator[tuple[PoseFrame, Ints]]:
    """Frames with the rows that go by them: twins apart, whose achieved pose and covariance are the twin's,
    too.
    """
    for number, frame in frames:
        rows = np.flatnonzero(columns.provenance == number)
        nearer = frame.exchanged(Poses(columns.position[rows], columns.quaternion_xyzw[rows]))
        yield replace(frame, near=None), rows[~nearer]
        if nearer.any():
            yield frame.twin, rows[nearer]


def _turned(covariance: Any, adjoint: Floats) -> Any:
    """The covariance of a pose about another frame of the same body; JSON text stays text."""
    if covariance is None:
        return None
    text = isinstance(covariance, str)
    matrix = np.array(json.loads(covariance) if text else covariance, dtype=np.float64)
    turned = (adjoint @ matrix @ adjoint.T).tolist()
    return json.dumps(turned) if text else turned
