"""Trials that name answers, each with the grasp of the answer that it tried and what that promised."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson
from scipy.special import ndtri

from graspdb.wire import OUTCOME_CODES, Pose
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_service.storage import answers
from graspdb_service.storage.database import Database
from graspdb_service.storage.trials import rows
from graspdb_service.trial_columns import Bools, Floats, Ints, TrialColumns
from graspdb_service.usecases.trials.pose_frames import PoseFrame
from graspdb_service.usecases.trials.selection import Selected

_SUCCESS, _NO_ATTEMPT = OUTCOME_CODES["success"], OUTCOME_CODES["simulation_error"]
#: The newest trials that are judged.
_MOST = 50_000
_HALF_TURN = np.array([0.0, 0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class Promised:
    """Grasps of an answer (k,): success probabilities with their standard errors, and those of geometry
    alone; NaN where nothing is promised.
    """

    poses: Poses
    probability: Floats
    error: Floats
    prior: Floats


@dataclass(frozen=True, eq=False)
class TriedAnswers:
    """Trials (n,) that name answers: ``answer`` which, ``position_m`` and ``rotation`` (radians) how far the
    commanded pose is from the nearest grasp of it, infinite where it has none; the promises are that grasp's.
    """

    columns: TrialColumns
    held: Bools
    answer: Ints
    position_m: Floats
    rotation: Floats
    probability: Floats
    error: Floats
    prior: Floats

    @property
    def commanded(self) -> Poses:
        return Poses(self.columns.position, self.columns.quaternion_xyzw)

    @property
    def placed(self) -> Bools:
        """Which of them tell the achieved pose (n,)."""
        return ~np.isnan(self.columns.achieved[:, 0])


def tried_answers(database: Database, selected: Selected) -> TriedAnswers:
    """Trials of a selection that name answers, those withdrawn and no attempts apart."""
    with database.read() as tx:
        columns = rows.page(
            tx,
            selected.row.id,
            after_seq=0,
            limit=_MOST,
            provenance_ids=sorted(selected.provenances),
            withdrawn=False,
            answered=True,
        )
        columns = _attempts(columns)
        kept = {
            number: _promised(kind, orjson.loads(question), orjson.loads(result))
            for number, kind, question, result in answers.many(tx, set(columns.answer.tolist()))
        }
    count = len(columns)
    twins = selected.symmetric(columns.provenance)
    commanded = Poses(columns.position, columns.quaternion_xyzw)
    told = np.full((5, count), np.nan)
    told[:2] = np.inf
    for row, number in enumerate(columns.answer.tolist()):
        promised = kept.get(number)
        if promised is not None and len(promised.poses):
            told[:, row] = _nearest(commanded[row : row + 1], promised, twins=bool(twins[row]))
    return TriedAnswers(columns, columns.outcome == _SUCCESS, columns.answer, *told)


def angles(quaternions: Floats, quaternion: Floats, *, twins: bool) -> Floats:
    """Angles of rotations from another or, with ``twins``, from the nearer of it and its half turn."""
    angle = se3.angle_between(quaternions, quaternion)
    if not twins:
        return np.asarray(angle)
    return np.minimum(angle, se3.angle_between(quaternions, se3.multiply(quaternion, _HALF_TURN)))


def _attempts(columns: TrialColumns) -> TrialColumns:
    real = np.flatnonzero(columns.outcome != _NO_ATTEMPT)
    names = ("position", "quaternion_xyzw", "outcome", "provenance", "answer", "achieved")
    return TrialColumns(**{name: getattr(columns, name)[real] for name in names})


def _nearest(pose: Poses, promised: Promised, *, twins: bool) -> tuple[float, float, float, float, float]:
    """How far the grasp nearest to a pose is, 10 mm as far as 10 degrees, and what it promised."""
    metres = np.linalg.norm(promised.poses.positions - pose.positions, axis=1)
    radians = angles(promised.poses.quaternions_xyzw, pose.quaternions_xyzw, twins=twins)
    best = int(np.argmin(metres / 0.01 + radians / math.radians(10.0)))
    return (
        float(metres[best]),
        float(radians[best]),
        float(promised.probability[best]),
        float(promised.error[best]),
        float(promised.prior[best]),
    )


def _promised(kind: str, question: Mapping[str, Any], result: Mapping[str, Any]) -> Promised | None:
    """What an answer promised; draws promise no probability, but are grasps."""
    if kind == "best-grasp":
        grasps = result["grasps"]
        if not grasps:
            return None
        intervals = [grasp.get("interval") or {} for grasp in grasps]
        columns: dict[str, Any] = {
            name: [grasp.get(name) for grasp in grasps]
            for name in ("position", "quaternion_xyzw", "success_probability", "prior_success_probability")
        }
        columns |= {end: [item.get(end) for item in intervals] for end in ("low", "high", "level")}
        level = next((item["level"] for item in intervals if item), None)
    elif kind == "likelihood":
        interval = result.get("interval") or {}
        columns = {**question["poses"], **result, "low": interval.get("low"), "high": interval.get("high")}
        level = interval.get("level")
    else:
        columns, level = dict(result), None
    poses = Poses(_floats(columns["position"], 0), _floats(columns["quaternion_xyzw"], 0))
    told = result.get("tool_to_frame")
    if told is not None:
        poses = PoseFrame(fixed=Pose.model_construct(**told)).to_tool(poses)
    count = len(poses)
    low, high = (_floats(columns.get(end), count) for end in ("low", "high"))
    # The interval in standard errors, as if it were a normal distribution's.
    error = np.full(count, np.nan) if level is None else (high - low) / (2.0 * ndtri(0.5 * (1.0 + level)))
    names = ("success_probability", "prior_success_probability")
    probability, prior = (_floats(columns.get(name), count) for name in names)
    return Promised(poses, probability, error, prior)


def _floats(values: Any, count: int) -> Floats:
    """Numbers with NaN for null; all unknown where there are none."""
    return np.full(count, np.nan) if values is None else np.array(values, dtype=np.float64)
