"""Grasp densities: kernel density estimation on R^3 x SO(3). Arrays in, arrays out; no IO."""

from . import reference, se3
from .analytic import AnalyticKernel
from .anisotropic import AnisotropicKernel
from .density import GraspDensity
from .kernels import HAAR_VOLUME, IsotropicKernel
from .maximum import Maximum, nearest
from .mixture import MixtureDensity
from .region import Region
from .sampled import SampledKernel
from .scored import PoseNoise, expected, search_scored
from .success import SuccessEstimate, SuccessModel
from .weights import effective_sample_size, importance_weights, mixture_weights
from .widths import DEFAULT_KERNEL, WidthChoice, choose_widths, widths_prefix

__all__ = [
    "DEFAULT_KERNEL",
    "HAAR_VOLUME",
    "AnalyticKernel",
    "AnisotropicKernel",
    "GraspDensity",
    "IsotropicKernel",
    "Maximum",
    "MixtureDensity",
    "PoseNoise",
    "Region",
    "SampledKernel",
    "SuccessEstimate",
    "SuccessModel",
    "WidthChoice",
    "choose_widths",
    "effective_sample_size",
    "expected",
    "importance_weights",
    "mixture_weights",
    "nearest",
    "reference",
    "se3",
    "search_scored",
    "widths_prefix",
]
