"""Stored kernels: fitted on an object's trials or given by their components, usable on any object."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from graspdb.wire.base import Request, Response, Slug, Source

Alignment = Literal["gripper", "object", "edge", "surface-pair"]
"""Axes that translations are measured along; rotations are always in the gripper's frame."""
MAX_COMPONENTS = 32
MAX_FITTED = 16
MAX_SAMPLED, SAMPLED = 5_000, 900
"""Most displacements of a sampled kernel, and how many are drawn by default (the paper's number)."""

Six = Annotated[list[float], Field(min_length=6, max_length=6)]


class KernelComponent(Request):
    """A Gaussian over displacements (translation in metres first, then rotation vector in radians).

    Of a sampled kernel ``mean`` is a displacement; the width of all of its components is the kernel's
    ``component_widths``, and ``covariance`` is left out.
    """

    weight: Annotated[float, Field(gt=0, le=1e12)] = 1.0
    mean: Six = [0.0] * 6
    covariance: Annotated[list[Six], Field(min_length=6, max_length=6)] | None = None


class KernelWindow(Request):
    """Displacements a fit looks at: a cube of half edge ``position_m``, rotations up to ``rotation_deg``."""

    position_m: Annotated[float, Field(gt=0, le=1.0)] = 0.03
    rotation_deg: Annotated[float, Field(gt=0, le=90.0)] = 45.0


class KernelWidths(Request):
    """Standard deviations per axis."""

    sigma_position_m: Annotated[float, Field(gt=0, le=1.0)] = 0.005
    sigma_rotation_deg: Annotated[float, Field(gt=0, le=40.0)] = 5.0


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
    gripper: Slug | None = None
    protocol: Slug | None = None
    source: Source | None = None
    kind: Literal["anisotropic", "sampled", "probability"] = "anisotropic"
    alignment: Alignment = "gripper"
    window: KernelWindow | None = None
    component_widths: KernelWidths | None = None
    components: (
        Annotated[int, Field(ge=1, le=MAX_SAMPLED)]
        | Literal["auto"]
        | Annotated[list[KernelComponent], Field(min_length=1, max_length=MAX_SAMPLED)]
        | None
    ) = None

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
    """Where a kernel comes from; null where it does not apply.

    ``scale`` is the factor on the fitted shape's widths under which successes are likeliest, other blocks of
    space given; ``log_likelihood`` is that likelihood (nats of 1/(m^3 rad^3)), and
    ``isotropic_log_likelihood`` the isotropic kernel's on the same blocks. ``similarity`` is the
    Bhattacharyya coefficient of the unscaled shape and a sampled kernel of 900 displacements in the window.
    ``attempts`` chose the widths that predict success, and ``judged`` others tell how well they do: the log
    loss (nats an attempt) and Brier's skill, ``isotropic_*`` those of the best isotropic kernel.
    """

    origin: Literal["fitted", "given"]
    object: str | None = None
    revision: int | None = None
    protocol: str | None = None
    source: str | None = None
    successes: int | None = None
    displacements: int | None = None
    window: KernelWindow | None = None
    component_widths: KernelWidths | None = None
    scale: float | None = None
    log_likelihood: float | None = None
    isotropic_log_likelihood: float | None = None
    similarity: float | None = None
    likelihood_by_components: dict[str, float] | None = None
    attempts: int | None = None
    judged: int | None = None
    log_loss: float | None = None
    isotropic_log_loss: float | None = None
    brier_skill: float | None = None
    isotropic_brier_skill: float | None = None
    isotropic_widths: KernelWidths | None = None


class StoredKernel(Response):
    """A kernel as it is used: components over displacements, invariant under the jaw's turn.

    ``sigma_position_m`` and ``sigma_rotation_deg`` are those of the isotropic kernel with equal
    determinants; ``widths_m`` and ``widths_deg`` the standard deviations along and about x, y and z.
    """

    id: str
    kind: str
    alignment: str
    gripper: str | None
    sigma_position_m: float
    sigma_rotation_deg: float
    widths_m: tuple[float, float, float]
    widths_deg: tuple[float, float, float]
    components: list[KernelComponent]
    provenance: KernelProvenance
    created_at: datetime

    def __repr_args__(self) -> Any:
        """Short: components are long."""
        widths = ", ".join(f"{1e3 * w:.1f}" for w in self.widths_m)
        turns = ", ".join(f"{w:.1f}" for w in self.widths_deg)
        yield "id", self.id
        yield "alignment", self.alignment
        yield "widths", f"{widths} mm, {turns} deg"
        yield "components", len(self.components)
