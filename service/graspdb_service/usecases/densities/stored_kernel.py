"""Stored kernels as the maths takes them, and the axes of an object they may be aligned with."""

from __future__ import annotations

import math

import numpy as np

from graspdb.wire import KernelInfo, KernelWidths
from graspdb_density import AnisotropicKernel, DiagonalKernel, IsotropicKernel, SampledKernel, se3
from graspdb_density.kernels.gaussian_mixture import mirror
from graspdb_service.problems import conflict
from graspdb_service.storage.kernels import KernelRow
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.geometry.features import Axes, Features
from graspdb_service.usecases.trials.selection import Selected


def load(row: KernelRow) -> AnisotropicKernel:
    """The kernel of a stored row, which was checked when it came."""
    return AnisotropicKernel(
        _all(row, "weight"),
        _all(row, "mean"),
        _all(row, "covariance"),
        "gripper" if row.alignment == "gripper" else "fixed",
    )


def owner(row: KernelRow) -> str | None:
    """The id of the object that a kernel was fitted on; None where it was given."""
    slug: str | None = row.provenance.get("object")
    return slug


def _all(row: KernelRow, name: str) -> Floats:
    """What all components have of this name."""
    return np.array([item[name] for item in row.components])


def load_sampled(row: KernelRow) -> SampledKernel:
    """The kernel of a stored row of the kind ``sampled``, which was checked when it came."""
    means = _all(row, "mean")
    displacements = se3.Poses.of(means[:, :3], se3.from_rotation_vector(means[:, 3:]))
    return SampledKernel(displacements, _component(row), _all(row, "weight"))


def _component(row: KernelRow) -> IsotropicKernel:
    return isotropic(KernelWidths.model_validate(row.provenance["component_widths"]))


def isotropic(widths: KernelWidths | KernelInfo) -> IsotropicKernel:
    """The isotropic kernel of these widths."""
    return IsotropicKernel(widths.sigma_position_m, math.radians(widths.sigma_rotation_deg))


def isotropic_info(kernel: IsotropicKernel, rule: str) -> KernelInfo:
    """What a query says of an isotropic kernel; ``rule`` chose its widths."""
    degrees = math.degrees(kernel.sigma_rotation)
    return KernelInfo(
        kind="isotropic", sigma_position_m=kernel.sigma_position_m, sigma_rotation_deg=degrees, rule=rule
    )


def axes(alignment: str, selected: Selected, features: Features) -> Axes:
    """The axes that translations are along on an object; 409 where its geometry has none to tell."""
    if alignment == "gripper":
        return None
    if alignment == "object":
        return principal_axes(selected.row)
    return features.frames(alignment, selected)


def axes_at(found: Axes, poses: se3.Poses) -> Floats | None:
    """Those of grasps (n,): (3, 3) or (n, 3, 3), the gripper's where one has none of its own."""
    if not callable(found):
        return found
    own = found(*poses)
    known = np.asarray(np.isfinite(own).all(axis=(1, 2)), dtype=bool)
    return np.where(known[:, None, None], own, se3.to_matrix(poses.quaternions_xyzw))


def covariance_of(row: KernelRow) -> Floats:
    """(6, 6) of a kernel's displacements, the spread of its components' means included."""
    if row.kind != "sampled":
        return load(row).overall_covariance
    means, weights = _all(row, "mean"), _all(row, "weight")
    # With the mirror images, as it is used.
    both = np.concatenate([means, means * mirror("gripper")])
    share = np.concatenate([weights, weights]) / (2.0 * weights.sum())
    off = both - share @ both
    component = _component(row)
    own = [component.sigma_position_m**2] * 3 + [component.sigma_rotation**2] * 3
    return np.asarray(np.einsum("c,ci,cj->ij", share, off, off) + np.diag(own), dtype=np.float64)


def load_success_kernel(row: KernelRow, along: Axes) -> DiagonalKernel:
    """One that predicts success, along the object's axes (3, 3) or, without, the gripper's."""
    assert not callable(along)
    return DiagonalKernel.of(np.sqrt(np.diag(covariance_of(row))), along)


def info_of(row: KernelRow, plain: KernelInfo | None = None) -> KernelInfo:
    """What a query says of the kernel it used.

    ``plain`` is the isotropic one that the density has where the stored one is for probabilities only.
    """
    covariance = covariance_of(row)
    widths = np.sqrt(np.diag(covariance))
    # Of the isotropic kernel whose position and rotation blocks have the same determinants.
    position, rotation = (
        float(np.linalg.det(block) ** (1.0 / 6.0)) for block in (covariance[:3, :3], covariance[3:, 3:])
    )
    fitted = row.provenance.get("object")
    origin = f"fitted on {fitted!r}" if fitted else "given by its components"
    rule = f"stored kernel, {origin}; success_probability uses the isotropic kernel of equal determinants"
    if row.kind == "probability":
        rule = f"success_probability by the stored kernel's widths, {origin}"
        if plain is not None:
            position, rotation = plain.sigma_position_m, math.radians(plain.sigma_rotation_deg)
            rule += f"; the density's isotropic kernel by {plain.rule}"
    return KernelInfo(
        kind=row.kind,
        id=row.id,
        alignment=row.alignment,
        sigma_position_m=position,
        sigma_rotation_deg=math.degrees(rotation),
        widths_m=_triple(widths[:3]),
        widths_deg=_triple(np.degrees(widths[3:])),
        rule=rule,
    )


def principal_axes(row: ObjectRow) -> Floats:
    """The object's principal axes as columns (3, 3), right-handed, the longest way first.

    An axis has no sign of its own: the largest component of the first two is made positive. 409
    ``mesh-missing`` without a closed mesh.
    """
    inertia = None if row.mesh_info is None else row.mesh_info.get("inertia_m5")
    if inertia is None:
        why = "has no mesh" if row.mesh_info is None else "has a mesh that is not watertight"
        raise conflict(
            "mesh-missing",
            f"Object {row.slug!r} {why}, so its principal axes are not known:"
            f" PUT /objects/{row.slug}/mesh with a closed mesh, or use alignment=gripper",
        )
    _, axes = np.linalg.eigh(np.array(inertia, dtype=np.float64))
    for column in (0, 1):
        axes[:, column] *= np.sign(axes[np.argmax(np.abs(axes[:, column])), column])
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return np.asarray(axes, dtype=np.float64)


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
