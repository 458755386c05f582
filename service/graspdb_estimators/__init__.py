"""Estimators of success that are learned: trees on what the jaw closes on, stacked on the kernel estimate.

Arrays in, arrays out; no IO.
"""

from .boosted_trees import BoostedTrees
from .fitting import fit_stack
from .grasp_features import GraspFeatures
from .stack import LeftOut, Stack, Verdict
from .stacked_model import StackedModel
from .transfer import Lesson, Transfer, fit_transfer

__all__ = [
    "BoostedTrees",
    "GraspFeatures",
    "LeftOut",
    "Lesson",
    "Stack",
    "StackedModel",
    "Transfer",
    "Verdict",
    "fit_stack",
    "fit_transfer",
]
