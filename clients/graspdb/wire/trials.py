"""Grasp trials, one, many or in columns, and the batches they arrive in."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from graspdb.wire.base import (
    MANY,
    MAX_QUALITIES,
    AskedPosition,
    AskedRotation,
    GripperRef,
    Licence,
    Metadata,
    ObjectId,
    OneGripperVersion,
    Outcome,
    OutcomeCounts,
    Page,
    Pose,
    Position,
    Quality,
    QualityName,
    Quaternion,
    Request,
    Response,
    Slug,
    Source,
    StoredMetadata,
    StoredRevision,
    Text,
    Warnings,
    no_nul,
)
from graspdb.wire.frames.asking import ToldConvention, ToldFrame
from graspdb.wire.frames.gripper_frames import TOOL


def _outcome_of_bool(value: Any) -> Any:
    if value is True:
        return "success"
    return "failure" if value is False else value


OutcomeIn = Annotated[Outcome, BeforeValidator(_outcome_of_bool)]
"""An outcome's name; true and false mean success and failure."""
ProposalDensity = Annotated[float, Field(ge=1e-30, le=1e15)]
Width = Annotated[float, Field(ge=0, le=10)]
Attempts = Annotated[int, Field(ge=1, le=1_000_000)]
Successes = Annotated[int, Field(ge=0, le=1_000_000)]
EngineTold = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[a-z0-9_-]+( [\w.+-]+)?$")]
"""A physics engine, with its version where that is known, as in ``pybullet 3.2.7``."""
_Covariance = Annotated[float, Field(ge=-1e6, le=1e6)]
Row6 = tuple[_Covariance, _Covariance, _Covariance, _Covariance, _Covariance, _Covariance]
Matrix6 = tuple[Row6, Row6, Row6, Row6, Row6, Row6]

_QUALITIES = Field(max_length=MAX_QUALITIES, json_schema_extra={"additionalProperties": False})


class Origin(Request):
    """What a batch was read from."""

    file: Annotated[str, Field(min_length=1, max_length=255), AfterValidator(no_nul)] | None = None
    """Name of the file, without its folder; null for none."""
    format: Slug | None = None
    """The file's format, such as ``acronym``; null if unknown."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """SHA-256 of the file's bytes, in hexadecimal; null if unknown."""


class TrialDefaults(Request):
    """What may stand once beside ``trials`` or ``columns`` for every trial that does not say it itself."""

    gripper: GripperRef | None = None
    """Id of the gripper that grasped, in its newest version, or one version, as in ``panda@1``; null if
    unknown: the trial then fits every gripper."""
    source: Source | None = None
    """Who tried: ``simulation``, ``robot``, ``human`` or ``import``; null if unknown."""
    protocol: Slug | None = None
    """How the outcome was judged, in the user's words or as sweeps do; null if unknown."""
    engine: EngineTold | None = None
    """Physics engine that simulated it, best with its version, as in ``pybullet 3.2.7``; null if unknown, or
    none did."""
    proposal_density: ProposalDensity | None = None
    """Density that the pose was drawn with, 1/(m^3 rad^3), which weights the trial; null if unknown."""
    metadata: Metadata | None = None
    """Any JSON object of the user's; null for none."""
    answer: Slug | None = None
    """Id or name of the answer that was tried, one about this object; null for none."""


class BatchDefaults(TrialDefaults):
    """What stands once for a batch: what its trials may say themselves, and where they come from."""

    licence: Licence | None = None
    """Under which licence the trials may be used, best by its SPDX name, such as ``CC-BY-NC-4.0``; null if
    unknown."""
    citation: Text | None = None
    """What to cite for the trials; null for nothing."""
    origin: Origin | None = None
    """What the trials were read from; null if unknown."""


class TrialIn(Pose, TrialDefaults):
    """One attempt."""

    outcome: OutcomeIn
    """What became of it, by name; true and false mean success and failure. Of several ``attempts``: success
    from half of them on, else how most failed."""
    attempts: Attempts | None = None
    """How often this grasp was tried, where that was more than once: it counts as one attempt that succeeded
    by the share of its ``successes``; null: once."""
    successes: Successes | None = None
    """How many of its ``attempts`` succeeded; null: as the outcome says."""
    quality: Quality | None = None
    """Any score of the user's, without a unit; null for the batch's first of ``qualities``, or none."""
    qualities: Annotated[dict[QualityName, Quality | None], _QUALITIES] | None = None
    """Scores by name, without a unit; all trials of a batch have at most 32 names together; null for none."""
    width_m: Width | None = None
    """Distance between the fingers at the end, metres; null if unknown."""
    pose_covariance: Matrix6 | None = None
    """6x6, of the pose in the tool frame, translation in metres first, then rotation vector in radians; null
    if unknown."""
    measured_at: datetime | None = None
    """When it was tried; a time without a zone is UTC; null if unknown."""
    achieved_pose: Pose | None = None
    """Where the tool was after all, in the object frame, where the other pose is what was commanded:
    estimates take this one; null if unknown."""


class TrialsIn(BatchDefaults):
    """Trials in a list, and what holds for all of them."""

    trials: Annotated[list[TrialIn], Field(min_length=1), MANY]
    """The trials, stored as one batch."""


class TrialColumns(Request):
    """Trials as columns of equal length: position (N, 3), quaternion_xyzw (N, 4), outcome (N,), ..."""

    position: Annotated[list[Position], Field(min_length=1), MANY]
    """Origins of the tool frame in the object frame, one x, y, z a trial, metres."""
    quaternion_xyzw: Annotated[list[Quaternion], Field(min_length=1), MANY]
    """Rotations of the tool frame in the object frame, one unit quaternion x, y, z, w a trial."""
    outcome: Annotated[list[OutcomeIn], Field(min_length=1), MANY]
    """What became of each, by name; true and false mean success and failure. Of several ``attempts``: success
    from half of them on, else how most failed."""
    attempts: Annotated[list[Attempts | None], MANY] | None = None
    """How often each grasp was tried, where that was more than once: it counts as one attempt that succeeded
    by the share of its ``successes``; null: once."""
    successes: Annotated[list[Successes | None], MANY] | None = None
    """How many of its ``attempts`` succeeded, of each; null: as the outcome says."""
    gripper: Annotated[list[GripperRef | None], MANY] | None = None
    """Id of the gripper of each, or one version of it; null if unknown."""
    source: Annotated[list[Source | None], MANY] | None = None
    """Who tried each; null if unknown."""
    protocol: Annotated[list[Slug | None], MANY] | None = None
    """How each outcome was judged; null if unknown."""
    engine: Annotated[list[EngineTold | None], MANY] | None = None
    """Physics engine that simulated each, best with its version; null if unknown, or none did."""
    proposal_density: Annotated[list[ProposalDensity | None], MANY] | None = None
    """Density that each pose was drawn with, 1/(m^3 rad^3); null if unknown."""
    quality: Annotated[list[Quality | None], MANY] | None = None
    """Any score of each, without a unit; null for the first of ``qualities``, or none."""
    qualities: Annotated[dict[QualityName, Annotated[list[Quality | None], MANY]], _QUALITIES] | None = None
    """Scores by name, a list with one value a trial each; the first name's also stand for ``quality`` where
    that is null; null for none."""
    width_m: Annotated[list[Width | None], MANY] | None = None
    """Distance between the fingers at the end of each, metres; null if unknown."""
    pose_covariance: Annotated[list[Matrix6 | None], MANY] | None = None
    """6x6 of each pose in the tool frame, translation in metres first, then rotation vector in radians; null
    if unknown."""
    measured_at: Annotated[list[datetime | None], MANY] | None = None
    """When each was tried; a time without a zone is UTC; null if unknown."""
    metadata: Annotated[list[Metadata | None], MANY] | None = None
    """Any JSON object of the user's of each; null for none."""
    answer: Annotated[list[Slug | None], MANY] | None = None
    """Id or name of the answer that each tried; null for none."""
    achieved_pose: Annotated[list[Pose | None], MANY] | None = None
    """Where the tool was after all in each, in the object frame: estimates take this pose; null if
    unknown."""


class TrialColumnsIn(BatchDefaults):
    """Trials in columns, and what holds for all of them."""

    columns: TrialColumns
    """The trials' columns, stored as one batch."""


class AchievedPose(Response):
    """The pose that a trial achieved."""

    position: AskedPosition
    quaternion_xyzw: AskedRotation


class TrialOut(Response):
    """A stored trial."""

    seq: int
    """Numbers the object's trials in commit order."""
    revision: StoredRevision
    batch: str
    """Id of the batch that it arrived in."""
    position: AskedPosition
    quaternion_xyzw: AskedRotation
    outcome: Outcome
    """What became of it, by name; of several ``attempts``: success from half of them on, else how most
    failed."""
    attempts: int | None = None
    """How often this grasp was tried, or simulated under what was drawn; null: once."""
    successes: int | None = None
    """How many of its ``attempts`` succeeded; null where it was tried once."""
    gripper: str | None = None
    """Id of the gripper that grasped; null if unknown."""
    gripper_version: OneGripperVersion = None
    source: str | None = None
    """Who tried: ``simulation``, ``robot``, ``human`` or ``import``; null if unknown."""
    protocol: str | None = None
    """How the outcome was judged; null if unknown."""
    engine: str | None = None
    """Physics engine that simulated it, with its version where that is known, as in ``pybullet 3.2.7``; null
    if unknown, or none did."""
    proposal_density: float | None = None
    """Density that the pose was drawn with, 1/(m^3 rad^3); null if unknown."""
    quality: float | None = None
    """Any score of the user's, of a sweep the protocol's margin, without a unit; where only ``qualities``
    were given, the first that the batch named; null for none."""
    qualities: dict[str, float] | None = None
    """Scores by name, without a unit; null for none."""
    width_m: float | None = None
    """Distance between the fingers at the end, metres; null if unknown."""
    pose_covariance: list[list[float]] | None = None
    """6x6, along and about the axes of the frame that the pose is of, translation in metres first, then
    rotation vector in radians; null if unknown."""
    measured_at: datetime | None = None
    """When it was tried, UTC; null if unknown."""
    metadata: StoredMetadata | None = None
    """The user's own JSON object; null where there is none."""
    sweep: str | None = None
    """Id of the sweep that simulated it; null for a posted trial."""
    pose_index: int | None = None
    """Its index in that sweep's plan; null for a posted trial."""
    answer: str | None = None
    """Id of the answer that it tried; null where it names none."""
    achieved_pose: AchievedPose | None = None
    """Where the frame was after all, in the object frame: estimates take this pose; null if unknown."""
    withdrawn: bool = False
    """Whether it is kept, but out of every count and estimate."""


class TrialPatch(Request):
    """What to correct of a trial; what is left out stays, and so does what is null, metadata apart."""

    outcome: OutcomeIn | None = None
    """What became of it after all; null leaves it."""
    metadata: Metadata | None = None
    """Replaces the trial's own; null: only the batch's, if any."""
    withdrawn: bool | None = None
    """True takes it out of every count and estimate, false takes it back in; null leaves it."""
    reason: Text | None = None
    """Why, for the history; null for no reason given."""


class TrialChange(Response):
    """A change of a trial."""

    revision: int
    """The object's revision that made the change."""
    before: dict[str, Any]
    """The values that it replaced: of ``outcome``, ``metadata`` and ``withdrawn``."""
    reason: str | None = None
    """Why, where somebody said so; null otherwise."""
    changed_at: datetime
    """When it was changed, UTC."""


class TrialInfo(TrialOut):
    """A stored trial and what it was before."""

    history: list[TrialChange] = Field(default_factory=list)
    """Its corrections and withdrawals, oldest first."""
    frame: ToldFrame = TOOL
    convention: ToldConvention = "graspdb"
    warnings: Warnings = Field(default_factory=list)


class Finding(Response):
    """Something doubtful about trials that were posted: they are stored, but look at them."""

    code: str
    """What it is, stable, such as ``closes-on-nothing``."""
    count: int
    """How many of the examined trials it concerns."""
    examined: int
    """How many trials were looked at: a sample where looking is costly."""
    first_indices: list[int] = Field(default_factory=list)
    """The first such trials: their places in the batch from 0, in a density their ``seq``."""
    message: str
    """What was seen, for a person."""
    remedy: str
    """What to check or to do."""
    batches: list[str] = Field(default_factory=list)
    """Ids of earlier batches that hold the same rows, where the code says so."""


class BatchReceipt(Response):
    """What was stored."""

    batch: str
    """Id of the batch, which deletes it as one."""
    inserted: int
    """How many trials were stored."""
    revision: StoredRevision
    findings: list[Finding] = Field(default_factory=list)
    """What is doubtful about the trials; empty where nothing is."""


class BatchInfo(Response):
    """A batch: the trials of one POST, or all one sweep wrote."""

    batch: str
    """Id of the batch."""
    object: ObjectId
    revision: StoredRevision
    inserted: int
    """How many trials it holds as rows."""
    packed: int = 0
    """How many outcomes of a sweep it holds packed, without rows."""
    withdrawn: int = 0
    """How many of its trials are withdrawn: they are in no count by outcome."""
    sweep: str | None = None
    """Id of the sweep that wrote it; null for posted trials."""
    key: str | None = None
    """Name of the API key that posted it, or asked for its sweep; null where keys were off."""
    metadata: StoredMetadata | None = None
    """What was posted with it as metadata of all; null where nothing was."""
    licence: str | None = None
    """Under which licence its trials may be used; null if unknown."""
    citation: str | None = None
    """What to cite for its trials; null for nothing."""
    origin: Origin | None = None
    """What its trials were read from; null if unknown."""
    qualities: list[str] = Field(default_factory=list)
    """Names of the qualities that its trials have, in the order in which they were given."""
    outcomes: OutcomeCounts = Field(default_factory=dict)
    grippers: list[str] = Field(default_factory=list)
    """Ids of the grippers that its trials name."""
    gripper_versions: list[str] = Field(default_factory=list)
    """The same with their versions, as in ``panda@1``."""
    sources: list[str] = Field(default_factory=list)
    """Sources that its trials name."""
    protocols: list[str] = Field(default_factory=list)
    """Protocols that its trials name."""
    engines: list[str] = Field(default_factory=list)
    """Physics engines that simulated its trials, with their versions as far as these are known; none where
    that is not known."""
    findings: list[Finding] = Field(default_factory=list)
    """What was doubtful about its trials when they came."""
    created_at: datetime
    """When it was stored, UTC."""


class TrialsPage(Page[TrialOut]):
    """A page of trials, with what their poses are of."""

    frame: ToldFrame = TOOL
    convention: ToldConvention = "graspdb"
    warnings: Warnings = Field(default_factory=list)
