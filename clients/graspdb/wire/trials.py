"""Grasp trials, one, many or in columns, and the batches they arrive in."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from graspdb.wire.base import (
    Metadata,
    Outcome,
    Pose,
    Position,
    Quadruple,
    Quaternion,
    Request,
    Response,
    Slug,
    Source,
    Triple,
)


def _outcome_of_bool(value: Any) -> Any:
    if value is True:
        return "success"
    return "failure" if value is False else value


OutcomeIn = Annotated[Outcome, BeforeValidator(_outcome_of_bool)]
"""An outcome's name; true and false mean success and failure."""
ProposalDensity = Annotated[float, Field(gt=0, le=1e15)]
Quality = Annotated[float, Field(ge=-1e9, le=1e9)]
Width = Annotated[float, Field(ge=0, le=10)]
Row6 = tuple[float, float, float, float, float, float]
Matrix6 = tuple[Row6, Row6, Row6, Row6, Row6, Row6]


class TrialDefaults(Request):
    """What may stand once beside ``trials`` or ``columns`` for every trial that does not say it itself."""

    gripper: Slug | None = None
    source: Source | None = None
    protocol: Slug | None = None
    proposal_density: ProposalDensity | None = None
    metadata: Metadata | None = None


class TrialIn(Pose, TrialDefaults):
    """One attempt.

    ``proposal_density`` is in 1/(m^3 rad^3); ``pose_covariance`` 6x6, translation first, tool frame.
    """

    outcome: OutcomeIn
    quality: Quality | None = None
    width_m: Width | None = None
    pose_covariance: Matrix6 | None = None
    measured_at: datetime | None = None


class TrialsIn(TrialDefaults):
    trials: Annotated[list[TrialIn], Field(min_length=1)]


class TrialColumns(Request):
    """Trials as columns of equal length: position (N, 3), quaternion_xyzw (N, 4), outcome (N,), ..."""

    position: list[Position]
    quaternion_xyzw: list[Quaternion]
    outcome: list[OutcomeIn]
    gripper: list[Slug | None] | None = None
    source: list[Source | None] | None = None
    protocol: list[Slug | None] | None = None
    proposal_density: list[ProposalDensity | None] | None = None
    quality: list[Quality | None] | None = None
    width_m: list[Width | None] | None = None
    pose_covariance: list[Matrix6 | None] | None = None
    measured_at: list[datetime | None] | None = None
    metadata: list[Metadata | None] | None = None


class TrialColumnsIn(TrialDefaults):
    columns: TrialColumns


class TrialOut(Response):
    """A stored trial. ``seq`` numbers an object's trials in commit order; ``revision`` stored it."""

    seq: int
    revision: int
    batch: str
    position: Triple
    quaternion_xyzw: Quadruple
    outcome: Outcome
    gripper: str | None = None
    source: str | None = None
    protocol: str | None = None
    proposal_density: float | None = None
    quality: float | None = None
    width_m: float | None = None
    pose_covariance: list[list[float]] | None = None
    measured_at: datetime | None = None
    metadata: Metadata | None = None
    sweep: str | None = None
    pose_index: int | None = None


class BatchReceipt(Response):
    batch: str
    inserted: int
    revision: int


class BatchInfo(Response):
    """A batch: the trials of one POST, or all one sweep wrote (``packed`` counts its packed outcomes)."""

    batch: str
    object: str
    revision: int
    inserted: int
    packed: int = 0
    sweep: str | None = None
    metadata: Metadata | None = None
    outcomes: dict[str, int] = Field(default_factory=dict)
    created_at: datetime
