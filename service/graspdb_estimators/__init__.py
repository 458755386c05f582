"""Estimators of success that are learned: trees on what the jaw closes on, stacked on the kernel estimate.

Arrays in, arrays out; no IO.
"""

from .boosted_trees import BoostedTrees
from .grasp_features import GraspFeatures
from .stack import Stack, Verdict, fit_stack
from .stacked_model import StackedModel

__all__ = [
    "BoostedTrees",
    "GraspFeatures",
    "Stack",
    "StackedModel",
    "Verdict",
    "fit_stack",
]
