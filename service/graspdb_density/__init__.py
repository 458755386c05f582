"""Grasp densities: kernel density estimation on R^3 x SO(3). Arrays in, arrays out; no IO."""

from . import reference, se3
from .density import GraspDensity
from .kernels import HAAR_VOLUME, IsotropicKernel
from .maximum import Maximum, nearest
from .region import Region
from .success import SuccessEstimate, SuccessModel
from .weights import effective_sample_size, importance_weights, mixture_weights

__all__ = [
    "HAAR_VOLUME",
    "GraspDensity",
    "IsotropicKernel",
    "Maximum",
    "Region",
    "SuccessEstimate",
    "SuccessModel",
    "effective_sample_size",
    "importance_weights",
    "mixture_weights",
    "nearest",
    "reference",
    "se3",
]
