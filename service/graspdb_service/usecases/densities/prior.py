"""Where an object can be grasped as far as its shape tells: a density before any success.

Its rows are grasps that close on pairs of surfaces and edges and on opposed points of the surface (both in
:mod:`graspdb_geometry.features`), half of either, at every angle about the
closing axis; those at which the open gripper collides, or closes on nothing, are left out. A kernel about
every row makes it a density over R^3 x SO(3) like any other: it integrates to 1, both twins of a symmetric
jaw, and what is drawn from it may be weighted by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graspdb.wire import KernelInfo
from graspdb.wire.queries import PreOpening
from graspdb_density import GraspDensity, IsotropicKernel, ModeSearch, se3
from graspdb_geometry.features.jaw_pairs import JawPairs
from graspdb_service.problems import ProblemError, conflict
from graspdb_service.usecases.densities.build import KernelChoice
from graspdb_service.usecases.geometry.collision import CollisionTest, Scenes
from graspdb_service.usecases.geometry.mesh_form import form_of
from graspdb_service.usecases.runtime.asked import asked
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.trials.selection import Selected

_POSITION_M, _ROTATION_DEG = 0.01, 15.0
#: Grasps looked at; more where too few of them are free, as on an object that hardly fits the jaw.
_LOOKED_AT, _MOST, _ENOUGH = 16_384, 131_072, 1_024
_MAX_BYTES = 128 * 2**20


@dataclass(frozen=True, eq=False)
class Prior:
    """The search in the density, and its kernel in words."""

    search: ModeSearch
    kernel: KernelInfo

    @property
    def density(self) -> GraspDensity:
        return self.search.centres


@dataclass(frozen=True, eq=False)
class _Made:
    """None where every grasp on a pair collides."""

    search: ModeSearch | None
    pairs: int

    @property
    def nbytes(self) -> int:
        return 4_096 + (0 if self.search is None else self.search.density.nbytes + self.search.nbytes)


class Priors:
    """The priors of one service process, by the content of geometry and gripper."""

    def __init__(self, compute: Compute, scenes: Scenes) -> None:
        self._compute = compute
        self._scenes = scenes
        self._cache: SingleFlightCache[tuple[object, ...], _Made]
        self._cache = SingleFlightCache(_MAX_BYTES, lambda made: made.nbytes)

    def get(self, selected: Selected, choice: KernelChoice, pre_opening_m: PreOpening = None) -> Prior:
        """The prior of an object for a gripper; ``choice`` may name other widths than 10 mm and 15 degrees,
        the jaw comes wide open or as far as ``pre_opening_m`` says.

        409 ``mesh-missing`` without geometry, ``gripper-unknown`` where none is named, ``no-surface-pairs``
        where the jaw finds nothing to close on, ``edges-unreachable`` where it can't come near.
        """
        metres = _POSITION_M if choice.sigma_position_m is None else choice.sigma_position_m
        degrees = _ROTATION_DEG if choice.sigma_rotation_deg is None else choice.sigma_rotation_deg
        kernel = IsotropicKernel(metres, math.radians(degrees))
        row = selected.row
        opposed = self._scenes.features.opposed(selected)
        test = self._scenes.require(selected, pre_opening_m)
        assert selected.profile is not None
        if not opposed:
            raise conflict(
                "no-surface-pairs",
                f"No two surfaces of object {row.slug!r} are opposed within"
                f" {1e3 * selected.profile.max_opening_m:.0f} mm, as far as the jaw opens: name a wider"
                " gripper",
            )
        form = None if row.mesh_info is None else form_of(row)
        jaw = (selected.profile.model_dump_json(), pre_opening_m)
        key = (row.mesh_sha256, form, row.parts_sha256, *jaw, kernel)
        symmetric = selected.jaw_symmetric

        def make(_: _Made | None) -> _Made:
            threads = self._compute.threads
            density = self._compute.run(lambda: density_on(opposed, test, kernel, symmetric, threads=threads))
            search = None if density is None else ModeSearch(density)
            return _Made(search, sum(len(pairs) for pairs in opposed))

        made = self._cache.get(key, lambda _: True, make)
        if made.search is None:
            raise conflict(
                "edges-unreachable",
                f"The open gripper collides wherever it could close on two surfaces or edges of {row.slug!r}:"
                " name another gripper, or sweep a grid",
            )
        on = f"{made.pairs:,} pairs of surfaces, edges and points"
        rule = f"edges: about {made.search.density.size:,} grasps on {on}"
        return Prior(
            made.search,
            KernelInfo(kind="isotropic", sigma_position_m=metres, sigma_rotation_deg=degrees, rule=rule),
        )

    def known(
        self, selected: Selected, choice: KernelChoice, pre_opening_m: PreOpening = None
    ) -> Prior | None:
        """As :meth:`get`, None where there is none or it can't be known."""
        try:
            return self.get(selected, choice, pre_opening_m)
        except ProblemError as problem:
            if problem.status != 409:
                raise
            return None


def density_on(
    opposed: Sequence[JawPairs],
    test: CollisionTest,
    kernel: IsotropicKernel,
    symmetric: bool,
    *,
    threads: int = 1,
) -> GraspDensity | None:
    """The density of grasps on pairs that the open gripper can take and hold something at, each kind of pairs
    alike; None without any.
    """
    count = _LOOKED_AT
    while True:
        found = [pairs.grasps(count // len(opposed)) for pairs in opposed]
        p, q, weights = (np.concatenate(column) for column in zip(*found, strict=True))
        poses = se3.Poses.of(p, q)
        asked().reached("looking at where the jaw fits", of=len(poses))
        held = test.holds(poses, threads=threads)
        if held.sum() >= _ENOUGH or count >= _MOST:
            break
        count = _MOST
    if not held.any():
        return None
    return GraspDensity.build(poses[held], kernel=kernel, weights=weights[held], symmetric=symmetric)
