"""Stored kernels: fitted on an object's trials or given by their components, usable on any object."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from graspdb.wire.base import GripperRef, Request, Response, Slug, Source

Alignment = Literal["gripper", "object", "edge", "surface-pair"]
"""Axes that translations are measured along; rotations are always in the gripper's frame."""
MAX_COMPONENTS = 32
MAX_FITTED = 16
MAX_SAMPLED, SAMPLED = 5_000, 900
"""Most displacements of a sampled kernel, and how many are drawn by default (the paper's number)."""

Six = Annotated[list[Annotated[float, Field(ge=-1e3, le=1e3)]], Field(min_length=6, max_length=6)]


class KernelComponent(Request):
    """A Gaussian over displacements (translation in metres first, then rotation vector in radians)."""

    weight: Annotated[float, Field(gt=0, le=1e12)] = 1.0
    """Its share of the mixture, relative to the others' weights."""
    mean: Six = [0.0] * 6
    """Its centre: metres along and radians about x, y, z of the frame of the kernel's alignment; of a sampled
    kernel a displacement."""
    covariance: Annotated[list[Six], Field(min_length=6, max_length=6)] | None = None
    """6x6 in the same frame, metres and radians; null in a sampled kernel, whose components all have its
    ``component_widths``."""


class KernelWindow(Request):
    """Displacements a fit looks at."""

    position_m: Annotated[float, Field(ge=1e-4, le=1.0)] = 0.03
    """Largest translation along any axis, metres."""
    rotation_deg: Annotated[float, Field(ge=0.1, le=90.0)] = 45.0
    """Largest angle of rotation, degrees."""


class KernelWidths(Request):
    """Standard deviations per axis."""

    sigma_position_m: Annotated[float, Field(ge=1e-5, le=1.0)] = 0.005
    """Standard deviation of position along each axis, metres."""
    sigma_rotation_deg: Annotated[float, Field(ge=0.1, le=40.0)] = 5.0
    """Standard deviation of rotation about each axis, degrees."""


class KernelCreate(Request):
    """A kernel to fit on an object's successes, or one given by its components.

    ``anisotropic``, fitted: ``components`` is how many Gaussians (1; a component off the jaw's plane of
    symmetry is a pair), or ``auto`` for as many as held-out displacements favour; ``window`` says which
    displacements count and ``component_widths`` are those of the sampled kernel it stands for. Given:
    ``components`` as a list; what the jaw's turn would change is averaged with its mirror image.

    ``sampled`` (eq 5): isotropic components of ``component_widths`` at displacements, drawn from those
    between the object's successes in the window (``components`` of them, 900 by default) or given. It costs
    as much more than one Gaussian as it has components, so what queries make of it is limited.

    ``probability``: a width for every axis of the gripper, chosen by the log loss of attempts in blocks of
    space left out. A query with it estimates ``success_probability`` by these widths; its density is the
    default one. Its axes are the gripper's or the ``object``'s. Given: one component, centred, without
    correlations.
    """

    object: Slug | None = None
    """Object whose successes it is fitted on; null for a kernel given by its components."""
    gripper: GripperRef | None = None
    """Gripper whose trials it is fitted on, by default the one they all name; or that a given kernel is
    for."""
    protocol: Slug | None = None
    """Protocol whose trials it is fitted on; by default the one they all name."""
    source: Source | None = None
    """Source whose trials it is fitted on; by default all of them."""
    kind: Literal["anisotropic", "sampled", "probability"] = "anisotropic"
    """What to make: ``anisotropic``, ``sampled``, or ``probability``, which predicts success."""
    alignment: Alignment = "gripper"
    """Whose axes translations are measured along; rotations are in the gripper's frame."""
    window: KernelWindow | None = None
    """Which displacements between successes count; by default 30 mm and 45 degrees."""
    component_widths: KernelWidths | None = None
    """Widths of a sampled kernel's components; by default 5 mm and 5 degrees."""
    components: (
        Annotated[int, Field(ge=1, le=MAX_SAMPLED)]
        | Literal["auto"]
        | Annotated[list[KernelComponent], Field(min_length=1, max_length=MAX_SAMPLED)]
        | None
    ) = None
    """How many to fit, ``auto`` for as many as held-out displacements favour, or the components themselves;
    by default 1, and 900 of a sampled kernel."""

    @model_validator(mode="after")
    def _one_way(self) -> KernelCreate:
        if self.kind == "probability":
            if self.window is not None or self.component_widths is not None:
                raise ValueError("widths that predict success take no window and no component_widths")
            if self.components not in (None, 1) and not isinstance(self.components, list):
                raise ValueError("a kernel that predicts success has one component")
        if isinstance(self.components, list):
            fitting = ["object", "protocol", "source", "window"]
            if self.kind == "anisotropic":
                fitting.append("component_widths")
            beside = [name for name in fitting if getattr(self, name) is not None]
            if beside:
                raise ValueError(
                    f"a kernel given by its components is fitted on nothing: {', '.join(beside)}"
                )
        elif self.object is None:
            raise ValueError("name the object to fit the kernel on, or give the components themselves")
        return self


class KernelProvenance(Response):
    """Where a kernel comes from, and how well it does on what it has not seen."""

    origin: Literal["fitted", "given"]
    """Whether it was fitted on trials or given by its components."""
    object: str | None = None
    """Object that it was fitted on; null for a given kernel."""
    revision: int | None = None
    """Revision of the object that it was fitted on; null for a given kernel."""
    protocol: str | None = None
    """Protocol of the trials that it was fitted on; null where none was chosen."""
    source: str | None = None
    """Source of the trials that it was fitted on; null where none was chosen."""
    successes: int | None = None
    """How many successes it was fitted on; null for a given kernel."""
    displacements: int | None = None
    """How many displacements between successes it was fitted on; null where none were."""
    window: KernelWindow | None = None
    """Which displacements counted; null where none were fitted."""
    component_widths: KernelWidths | None = None
    """Widths of a sampled kernel's components; null for other kinds."""
    scale: float | None = None
    """Factor on the fitted shape's widths under which successes are likeliest, other blocks of space given;
    null where it was not fitted."""
    log_likelihood: float | None = None
    """That likelihood, mean natural logarithm of 1/(m^3 rad^3); null where it was not judged."""
    isotropic_log_likelihood: float | None = None
    """The same of the isotropic kernel on the same blocks; null where it was not judged."""
    similarity: float | None = None
    """Bhattacharyya coefficient of the unscaled shape and a sampled kernel of 900 displacements in the
    window; null where it was not computed."""
    likelihood_by_components: dict[str, float] | None = None
    """Held-out log likelihood by the number of components; null where the number was given."""
    attempts: int | None = None
    """How many attempts chose widths that predict success; null for other kinds."""
    judged: int | None = None
    """How many other attempts tell how well they predict; null for other kinds."""
    log_loss: float | None = None
    """Log loss of the predictions, nats an attempt; null for other kinds."""
    isotropic_log_loss: float | None = None
    """Log loss of the best isotropic kernel's predictions, nats an attempt; null for other kinds."""
    brier_skill: float | None = None
    """Brier's skill of the predictions: 1 perfect, 0 no better than the base rate; null for other kinds."""
    isotropic_brier_skill: float | None = None
    """Brier's skill of the best isotropic kernel; null for other kinds."""
    isotropic_widths: KernelWidths | None = None
    """Widths of the best isotropic kernel; null for other kinds."""


class StoredKernel(Response):
    """A kernel as it is used: components over displacements, invariant under the jaw's turn."""

    id: str
    """Id of the kernel, by which queries name it."""
    kind: str
    """What it is: ``anisotropic``, ``sampled`` or ``probability``."""
    alignment: str
    """Whose axes translations are measured along: ``gripper``, ``object``, ``edge`` or ``surface-pair``."""
    gripper: str | None
    """Gripper that it is for, one version of it as in ``panda@1`` where it is of that alone; null where it is
    for any."""
    sigma_position_m: float
    """Standard deviation per axis in position of the isotropic kernel with equal determinant, metres."""
    sigma_rotation_deg: float
    """Standard deviation per axis in rotation of the isotropic kernel with equal determinant, degrees."""
    widths_m: tuple[float, float, float]
    """Standard deviations along x, y, z of the frame of the alignment, metres."""
    widths_deg: tuple[float, float, float]
    """Standard deviations about x, y, z of the gripper's frame, degrees."""
    components: list[KernelComponent]
    """The Gaussians that it is made of."""
    provenance: KernelProvenance
    """Where it comes from, and how well it does on what it has not seen."""
    created_at: datetime
    """When it was stored, UTC."""

    def __repr_args__(self) -> Any:
        """Short: components are long."""
        widths = ", ".join(f"{1e3 * w:.1f}" for w in self.widths_m)
        turns = ", ".join(f"{w:.1f}" for w in self.widths_deg)
        yield "id", self.id
        yield "alignment", self.alignment
        yield "widths", f"{widths} mm, {turns} deg"
        yield "components", len(self.components)
