"""What answers rest on: how far they are from what was tried, whose trials count, and who estimated them."""

from __future__ import annotations

from typing import Literal

from graspdb.wire.base import ChosenGripper, ChosenProtocol, Response, Triple


class NearestAttempt(Response):
    """How far the nearest attempt is: the one whose kernel is highest at the pose."""

    position_m: float
    """Distance of the tool's origin from that of the attempt, metres."""
    rotation_deg: float
    """Angle of the rotation from the attempt's, or from its twin's of a symmetric jaw, degrees."""
    kernel_widths: float
    """Position and rotation together, in standard deviations of the kernel that estimates success
    probabilities."""


class Support(Response):
    """What an answer rests on."""

    nearest_attempt: NearestAttempt | None = None
    """How far the nearest attempt is; null before any."""
    effective_trials: float
    """Trials that the estimate is worth, (sum k)^2 / sum k^2 over the attempts' kernels k: how many tell, not
    how far they are."""
    enough: bool
    """Whether the nearest attempt is within the reach of the estimator; true, too, where the open gripper
    collides, which geometry tells alone. Where false, the success probability is null."""
    reason: str | None = None
    """Why it is not enough, in words; null where it is."""


class NearestAttemptColumns(Response):
    """How far the nearest attempt of every pose is, in columns."""

    position_m: list[float | None]
    """Distance of each tool's origin from that of its attempt, metres; null before any attempt."""
    rotation_deg: list[float | None]
    """Angle of each rotation from its attempt's, or from its twin's of a symmetric jaw, degrees; null before
    any attempt."""
    kernel_widths: list[float | None]
    """Position and rotation together, in standard deviations of the kernel that estimates success
    probabilities; null before any attempt."""


class SupportColumns(Response):
    """What the answer to every pose rests on, in columns; why it may not be enough is ``reach``."""

    nearest_attempt: NearestAttemptColumns
    """How far the nearest attempt of every pose is."""
    effective_trials: list[float]
    """Trials that each estimate is worth, (sum k)^2 / sum k^2 over the attempts' kernels k."""
    enough: list[bool]
    """Whether each nearest attempt is within reach, or the open gripper collides there."""


class ReachInfo(Response):
    """How far from an attempt success probabilities are told; all limits hold of the nearest attempt.

    Validated on attempts that were predicted again with everything nearer left out: up to there they are
    predicted better than by the share of successes alone. Where too few attempts tell, up to how near
    19 of 20 attempts lie to another one. Along and about each axis no farther than attempts near one another
    lie apart: a tool that only ever turned about one axis tells nothing of the others.
    """

    position_widths: float
    """Limit of the translation, in standard deviations of the kernel."""
    rotation_widths: float
    """Limit of the rotation, in standard deviations of the kernel."""
    position_m: float | None = None
    """Limit of the translation, metres; null where the kernel has a width for every axis."""
    rotation_deg: float | None = None
    """Limit of the rotation, degrees; null where the kernel has a width for every axis."""
    along_m: list[float] | None = None
    """Limits of the translation along x, y and z of the attempt's gripper, or along the kernel's axes where
    it has its own, metres, (3,); null in answers of earlier versions."""
    about_deg: list[float] | None = None
    """Limits of the rotation about x, y and z of the attempt's gripper, degrees, (3,); null in answers of
    earlier versions."""
    validated: bool
    """Whether left-out attempts are predicted better than by the share at all."""
    attempts: int
    """How many attempts there were when it was validated."""
    rule: str
    """How the limits came about, in words."""


class OwnWidths(Response):
    """Widths of the kernel of success probabilities that attempts chose themselves, for they predict attempts
    whose block of space was left out better than the density's."""

    sigma_position_m: list[float]
    """Standard deviations along x, y and z of ``axes``, metres."""
    sigma_rotation_deg: list[float]
    """Standard deviations about x, y and z of the gripper, degrees."""
    axes: Literal["gripper", "object"]
    """Along whose axes positions are."""


class PriorEstimator(Response):
    """Who says how likely grasps succeed where no attempt is near."""

    name: Literal["edges", "transfer"]
    """``edges``: as many as of the object's attempts that closed on something (half before any), none where
    the jaw closes on nothing; ``transfer``: by what the jaw closes on, learned from attempts at other objects
    with the gripper."""
    objects: int | None = None
    """How many other objects it was learned from; null for edges."""
    attempts: int | None = None
    """How many attempts at them; null for edges."""
    skill: float | None = None
    """Its Brier skill on objects that were left out, whole: 1 perfect, 0 no better than knowing the share of
    their successes, which edges do not; null for edges."""


class EstimatorInfo(Response):
    """Who answered: ``kernel``, density and regression by kernels; ``stack``, success probabilities learned
    from what the jaw closes on and stacked on those; ``transfer``, the same learned from other objects, for
    one with few attempts. Densities are by kernels always.
    """

    name: str = "kernel"
    """Name of the estimator of success probabilities."""
    state: Literal["fitting", "ready"] = "ready"
    """``ready``; or ``fitting``, while the kernel estimate answers in its place."""
    recalibrated: bool = False
    """Whether probabilities were set right by attempts that were predicted without their block of space."""
    attempts: int | None = None
    """How many attempts it was learned from; null where nothing was learned."""
    skill: float | None = None
    """Its Brier skill on attempts whose block of space was left out: 1 perfect, 0 no better than always
    saying their share of successes; null where nothing was learned."""
    kernel_skill: float | None = None
    """The same of the plain kernel estimate; null where nothing was learned."""
    objects: int | None = None
    """How many other objects ``transfer`` was learned from; its skills are of objects that were left out,
    whole, but for some first attempts. Null for others."""
    widths: OwnWidths | None = None
    """The widths of the kernel, where attempts chose them; null where it has the density's."""
    prior: PriorEstimator | None = None
    """Who tells ``prior_success_probability``; null where it was not asked for or nobody can."""


class SelectedSource(Response):
    """Trials of one source in a selection."""

    trials: int
    """How many attempts it has in the selection, collisions and packed outcomes included."""
    successes: int
    """How many of them succeeded."""
    share_of_weight: float
    """Its successes' share of all weight in the density, 0 to 1."""
    weights: str
    """How its successes are weighed, in words."""
    source_weight: float = 1.0
    """How much its trials count by ``source_weight``, relative to the source that counts most; 0 leaves it
    out."""


class SelectionInfo(Response):
    """Which trials count, and how much those of each source."""

    gripper: ChosenGripper
    protocol: ChosenProtocol
    sources: dict[str, SelectedSource]
    """The sources of the trials by their name, ``unspecified`` for trials that name none; those that a weight
    was asked for, too."""


class SymmetryAxis(Response):
    """An axis of symmetry of an object, in the frame of its mesh."""

    origin: Triple
    """A point of it, object frame, metres: the centroid of the surface."""
    direction: Triple
    """Unit vector along it, object frame, either way."""
    turns: int | None = None
    """By how many equal turns the object comes to lie on itself; null for any turn: an axis of revolution."""


class SymmetryPlane(Response):
    """A mirror plane of an object, in the frame of its mesh: n.x = d."""

    normal: Triple
    """Unit vector across it, n, object frame, either way."""
    offset_m: float
    """How far it is from the origin along the normal, d, metres."""


class SymmetryInfo(Response):
    """Which symmetries of the object share its attempts."""

    axes: list[SymmetryAxis]
    """The axes that the mesh has, one of revolution first."""
    planes: list[SymmetryPlane]
    """The mirror planes that the mesh has; beside an axis of revolution only the one across it: every plane
    through the axis is one, too."""
    every_axis: bool = False
    """Whether every line through the centre is an axis: the object is a ball, of which one axis is used."""
    tolerance_m: float
    """Up to where the mesh must lie on itself again, for all but a hundredth of its surface, metres."""
    applied: bool
    """Whether attempts tell of where the symmetries take them."""
    tested: bool = False
    """Whether there are enough attempts to tell that outcomes do not contradict it."""
    places: int = 0
    """At how many places attempts were compared with those that symmetries take there."""
    against: int = 0
    """At how many of them outcomes differ by more than one in twenty would by chance."""
    reason: str
    """The same in words."""


class CalibrationInfo(Response):
    """How simulated success probabilities were corrected for real trials."""

    source: str
    """The source of real trials that they are calibrated for."""
    applied: bool
    """Whether they are corrected: only where the correction predicts left-out real trials better. Where
    false they are as simulated; the interval is wider by the doubt about the correction either way."""
    judged: Literal["better", "worse", "undecided"]
    """Whether the correction predicts real trials in left-out blocks of space better than no correction."""
    trials: int
    """How many real trials within the reach of simulation it is learned from."""
    effective_trials: float
    """As how many independent ones they count: those of one spot are not independent."""
    blocks: int
    """How many blocks of space they lie in."""
    shift: float
    """Added to the logit of the probability, where applied."""
    slope: float
    """What the logit is multiplied by, where applied."""
    informative: bool
    """Whether what is answered predicts real trials better than their share of successes alone."""
    reason: str
    """The same in words."""
