"""What questions about grasps are answered from."""

from __future__ import annotations

from dataclasses import dataclass

from graspdb_service.usecases.cells.robots import Robots
from graspdb_service.usecases.densities.cache import Densities
from graspdb_service.usecases.densities.evidence.collisions import CollisionEvidence
from graspdb_service.usecases.densities.evidence.symmetries import Symmetries
from graspdb_service.usecases.densities.prior import Priors
from graspdb_service.usecases.densities.success_models import Successes
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.runtime.runtime import Runtime


@dataclass(kw_only=True)
class Estimators(Runtime):
    """The estimates of one service process: densities, success probabilities, and what geometry tells."""

    densities: Densities
    scenes: Scenes
    robots: Robots
    evidence: CollisionEvidence
    symmetries: Symmetries
    priors: Priors
    successes: Successes
