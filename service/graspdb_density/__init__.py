"""Grasp densities: kernel density estimation on R^3 x SO(3). Arrays in, arrays out; no IO."""

from . import se3
from .bandwidth.selection import DEFAULT_KERNEL, WidthChoice, choose_widths, widths_prefix
from .kde.importance_weights import effective_sample_size, importance_weights
from .kde.isotropic import GraspDensity
from .kde.mixture import MixtureDensity
from .kde.sample_kernel import SampledKernel
from .kernels.diagonal import DiagonalKernel
from .kernels.gaussian_mixture import AnisotropicKernel
from .kernels.isotropic import HAAR_VOLUME, IsotropicKernel
from .search.mode_search import ModeSearch
from .search.pose_noise import PoseNoise, expected, nearly_expected
from .search.region import Region
from .search.scored_poses import Maximum, Separation
from .success.kernel_regression import NearestAttempts, SuccessEstimate, SuccessModel
from .success.reach import Reach, validate_reach

__all__ = [
    "DEFAULT_KERNEL",
    "HAAR_VOLUME",
    "AnisotropicKernel",
    "DiagonalKernel",
    "GraspDensity",
    "IsotropicKernel",
    "Maximum",
    "MixtureDensity",
    "ModeSearch",
    "NearestAttempts",
    "PoseNoise",
    "Reach",
    "Region",
    "SampledKernel",
    "Separation",
    "SuccessEstimate",
    "SuccessModel",
    "WidthChoice",
    "choose_widths",
    "effective_sample_size",
    "expected",
    "importance_weights",
    "nearly_expected",
    "se3",
    "validate_reach",
    "widths_prefix",
]
