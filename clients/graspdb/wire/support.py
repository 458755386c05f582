"""How far answers are from what was tried, and who estimated them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from graspdb.wire.base import Response

Metres = Annotated[
    float,
    Field(
        description="Distance of the tool's origin from that of the nearest attempt, metres, object frame."
    ),
]
Degrees = Annotated[
    float,
    Field(
        description="Angle of the rotation from the nearest attempt, or from its twin of a symmetric jaw,"
        " degrees."
    ),
]
Widths = Annotated[
    float,
    Field(
        description="Position and rotation together, in standard deviations of the kernel that estimates"
        " success probabilities."
    ),
]
Trials = Annotated[
    float,
    Field(
        description="Trials that the estimate is worth, (sum k)^2 / sum k^2 over the attempts' kernels k: how"
        " many tell, not how far they are."
    ),
]
Enough = Annotated[
    bool,
    Field(
        description="Whether the nearest attempt is within the reach of the estimator; true, too, where the"
        " open gripper collides, which geometry tells alone. Where false, the success probability is null."
    ),
]


class NearestAttempt(Response):
    """How far the nearest attempt is: the one whose kernel is highest at the pose."""

    position_m: Metres
    rotation_deg: Degrees
    kernel_widths: Widths


class Support(Response):
    """What an answer rests on; ``nearest_attempt`` is null before any attempt."""

    nearest_attempt: NearestAttempt | None = None
    effective_trials: Trials
    enough: Enough
    reason: Annotated[str | None, Field(description="Why it is not enough, in words; null where it is.")] = (
        None
    )


class NearestAttemptColumns(Response):
    """:class:`NearestAttempt` of every pose; null before any attempt."""

    position_m: list[Metres | None]
    rotation_deg: list[Degrees | None]
    kernel_widths: list[Widths | None]


class SupportColumns(Response):
    """:class:`Support` of every pose; why it may not be enough is the answer's ``reach``."""

    nearest_attempt: NearestAttemptColumns
    effective_trials: list[Trials]
    enough: list[Enough]


class ReachInfo(Response):
    """How far from an attempt success probabilities are told; both limits hold of the nearest attempt.

    Validated on attempts that were predicted again with everything nearer left out: up to there they are
    predicted better than by the share of successes alone. Where too few attempts tell, up to how near
    19 of 20 attempts lie to another one.
    """

    position_widths: Annotated[
        float, Field(description="Limit of the translation, in standard deviations of the kernel.")
    ]
    rotation_widths: Annotated[
        float, Field(description="Limit of the rotation, in standard deviations of the kernel.")
    ]
    position_m: Annotated[
        float | None,
        Field(description="The same, metres; null where the kernel has a width for every axis."),
    ] = None
    rotation_deg: Annotated[
        float | None,
        Field(description="The same, degrees; null where the kernel has a width for every axis."),
    ] = None
    validated: Annotated[
        bool, Field(description="Whether left-out attempts are predicted better than by the share at all.")
    ]
    attempts: Annotated[int, Field(description="Attempts that there were when it was validated.")]
    rule: Annotated[str, Field(description="How the limits came about, in words.")]


class EstimatorInfo(Response):
    """Who answered: ``kernel``, density and regression by kernels."""

    name: Annotated[str, Field(description="Name of the estimator.")] = "kernel"
    state: Annotated[
        Literal["fitting", "ready"],
        Field(description="While an estimator is fitted, the kernel estimate answers."),
    ] = "ready"
