"""What can be asked about grasping an object: its density, how likely grasps are, which is best, draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from graspdb import wire
from graspdb.errors import Infeasible
from graspdb.options import known_keywords
from graspdb.poses import as_poses, as_vector7, pose_frame, pose_trials
from graspdb.resources.answers import report_grasp
from graspdb.resources.pages import Resource, segment, validate
from graspdb.resources.pictures.asking import PictureOptions, picture
from graspdb.resources.results import Grasp, Grasps, LikelihoodArrays, SampledPoses
from graspdb.resources.selection import (
    Constraints,
    DrawSelection,
    LikelihoodSelection,
    ProposalSelection,
    Selection,
    best_grasp_request,
    bounded,
    names,
    near_of,
    query,
)
from graspdb.resources.sweeps import SweepOptions, create_sweep
from graspdb.transport import Transport

QUERY_POSES = 100_000
"""Poses a likelihood request: some 15 MB of JSON, well under the service's default body limit."""


class GraspQueries(Resource):
    """The questions about one object; all take the trials and kernel of a density, see :class:`Selection`.

    All poses are of the tool frame, or of ``frame`` of the gripper where that is given, in the object frame,
    in metres, quaternions xyzw.
    """

    def __init__(self, transport: Transport, info: wire.ObjectInfo) -> None:
        super().__init__(transport, f"/objects/{segment(info.id)}")
        self.info = info

    @property
    def id(self) -> str:
        """The object's identifier."""
        return self.info.id

    def density(self, **selection: Unpack[Selection]) -> wire.DensityInfo:
        """The grasp density: kernel, widths and how they were chosen, counts, effective sample size."""
        params = query(known_keywords(Selection, selection, "density"))
        return self._transport.model(wire.DensityInfo, "GET", f"{self._path}/density", params=params)

    def likelihood(
        self,
        poses: ArrayLike | Any,
        *,
        include: Sequence[str] | None = None,
        chunk: int = QUERY_POSES,
        name: str | None = None,
        timeout_s: float | None = None,
        **selection: Unpack[LikelihoodSelection],
    ) -> LikelihoodArrays:
        """How likely these grasps are, as NumPy arrays in the poses' order.

        ``poses`` are (N, 4, 4), (N, 7) rows x y z qx qy qz qw, one pose, a grasp or samples, sent ``chunk`` a
        request; where no gripper or protocol is named, grasps and samples are asked about with those that
        they are of. ``include`` are the columns to compute: ``density``, ``log_density``, ``relative``,
        ``success_probability``, ``interval``, ``effective_trials``, ``collision_free``, ``support``,
        ``prior_success_probability``; by default all. ``name`` keeps the answer of at most 1,000 poses, and
        ``timeout_s`` bounds the time for every request, as in :class:`Constraints`.
        """
        options = known_keywords(LikelihoodSelection, selection, "likelihood")
        given = as_poses(poses)
        options |= pose_frame(poses, options.get("frame"), options.get("convention"))
        options |= pose_trials(poses, options)
        options |= {
            "include": None if include is None else names(include),
            "name": name,
            "timeout_s": timeout_s,
        }
        # Checked once with a single pose: the arrays are checked already, and a model of a million is slow.
        probe = validate(wire.LikelihoodRequest, {**options, "poses": given.columns(slice(1))})
        request = probe.model_dump(mode="json", exclude_unset=True)
        path, answers = f"{self._path}/likelihood", list[wire.Likelihoods]()
        for attempt in range(3):
            answers = []
            for start in range(0, len(given.position), chunk):
                body = {**request, "poses": given.columns(slice(start, start + chunk))}
                answers.append(self._transport.model(wire.Likelihoods, "POST", path, body=body))
                if answers[-1].revision != answers[0].revision and attempt < 2:
                    break  # new trials came in between: one answer must rest on one revision
            else:
                break
        return LikelihoodArrays.from_wire(answers)

    def best_grasp(
        self,
        *,
        verify: bool = False,
        verify_timeout_s: float = 300.0,
        **constraints: Unpack[Constraints],
    ) -> Grasp:
        """The best grasp within constraints; takes what :meth:`best_grasps` does, without ``count``.

        Infeasible if nothing admissible lies within reach of what was tried, or nothing has succeeded yet.
        """
        if "count" in constraints:
            raise TypeError("best_grasp() gives one grasp; use best_grasps(count=...)")
        known_keywords(Constraints, constraints, "best_grasp")
        return self.best_grasps(count=1, verify=verify, verify_timeout_s=verify_timeout_s, **constraints)[0]

    def best_grasps(
        self,
        *,
        count: int = 5,
        verify: bool = False,
        verify_timeout_s: float = 300.0,
        **constraints: Unpack[Constraints],
    ) -> Grasps:
        """At most ``count`` distinct grasps within :class:`Constraints`, best first, or Infeasible.

        ``verify`` has a worker simulate the grasps at the fine step before they are answered:
        ``grasp.simulated`` is what became of each, and those that held come first. The outcomes are stored as
        a check. With the gripper and protocol of the trials, where they say; else ``pg70`` and ``wrench``.
        The jaw opens wide in it, so ``pre_opening_m`` is refused beside it (ValueError). TimeoutError if that
        takes longer than ``verify_timeout_s``; it says so where no worker has come.
        """
        given = known_keywords(Constraints, constraints, "best_grasps")
        if verify and given.get("pre_opening_m") is not None:
            raise ValueError("verify simulates with the jaw wide open: leave it out, or pre_opening_m")
        request = best_grasp_request(count, given)
        answer = self._transport.model(wire.BestGrasps, "POST", f"{self._path}/best-grasp", body=request)
        grasps = Grasps(
            answer,
            partial(report_grasp, self._transport, self.id),
            partial(picture, self._transport, self.id),
        )
        if len(grasps):
            return self._simulated(grasps, given, verify_timeout_s) if verify else grasps
        if grasps.status == "no_successes":
            way_out = "; with a mesh, name a gripper (gripper=) to choose by its edges"
            if given.get("objective") == "success_probability":
                # Nor do other objects tell how likely one is.
                way_out += ", and leave objective out"
            raise Infeasible(
                f"{self.id} has no successful trial yet, so there is no grasp to choose from"
                f"{'' if given.get('prior') is False else way_out}"
            )
        raise Infeasible(
            f"no grasp of {self.id} fulfils the constraints within reach of what was tried"
            f"{grasps.why_none()}",
            nearest=grasps.nearest,
            conflict=grasps.conflict,
            relax=grasps.relax,
            reach=grasps.robot_reach,
        )

    def _simulated(self, grasps: Grasps, given: dict[str, Any], timeout_s: float) -> Grasps:
        """The grasps with their outcomes in simulation, by the gripper and protocol of their trials."""
        chosen = self.density(**{name: given.get(name) for name in ("gripper", "protocol", "source")})
        protocol = chosen.protocol if wire.sweeps.is_simulated(chosen.protocol) else None
        plan: SweepOptions = {"poses": list(grasps), "gripper": chosen.gripper, "protocol": protocol}
        plan |= {"fidelity": "fine", "purpose": "check"}
        sweep = create_sweep(self._transport, self._path, plan)
        try:
            sweep.wait(timeout=timeout_s)
        except TimeoutError as error:
            hint = sweep.hint()
            raise TimeoutError(f"{error}{'' if hint is None else f': {hint}'}") from None
        outcomes = sweep.outcomes()
        return grasps.simulated(outcomes.outcome[np.argsort(outcomes.pose_index)].tolist())

    def picture(self, grasp: ArrayLike | Any | None = None, **options: Unpack[PictureOptions]) -> bytes:
        """A picture (PNG) of the object, and of the gripper at a grasp where one is given.

        ``grasp`` is a grasp, a matrix (4, 4) or a row x y z qx qy qz qw; see :class:`PictureOptions`.
        Conflict where the object has no mesh; the service needs the extra ``pictures``.
        """
        known = known_keywords(PictureOptions, options, "picture")
        return picture(self._transport, self.id, grasp, **known)

    def samples(
        self,
        count: int = 100,
        *,
        seed: int | None = None,
        name: str | None = None,
        timeout_s: float | None = None,
        **selection: Unpack[DrawSelection],
    ) -> SampledPoses:
        """Poses drawn from the density; the same seed and revision give the same poses.

        ``name`` keeps the answer, as in :class:`Constraints`; of at most 1,000 poses.
        """
        fields = _drawn(known_keywords(DrawSelection, selection, "samples"))
        fields |= {"count": count, "seed": seed, "name": name, "timeout_s": timeout_s}
        request = validate(wire.SamplesRequest, fields)
        answer = self._transport.model(wire.Samples, "POST", f"{self._path}/samples", body=request)
        return SampledPoses.from_wire(answer)

    def reach(
        self,
        poses: ArrayLike | Any,
        *,
        robot: str,
        object_pose: ArrayLike | Any,
        robot_base_pose: ArrayLike | Any | None = None,
        bases: ArrayLike | Any | None = None,
        gripper: str | None = None,
        scene: str | None = None,
        obstacles: Mapping[str, Any] | None = None,
        pregrasp_distance_m: float | None = None,
        lift_m: float | None = None,
        timeout_s: float | None = None,
    ) -> wire.ReachMap:
        """Which of at most 1,000 poses of the tool a robot's arm takes where it stands, and why not others.

        ``bases`` are other poses of the robot's root in the world: ``base_share`` is the share of poses that
        the arm takes from each. All else is as for the best grasp (:class:`Constraints`), ``obstacles`` in
        the world.
        """
        fields = {
            "gripper": gripper,
            "scene": scene,
            "obstacles": obstacles,
            "pregrasp_distance_m": pregrasp_distance_m,
            "lift_m": lift_m,
            "timeout_s": timeout_s,
            "poses": as_poses(poses).columns(),
            "robot": robot,
            "object_pose": as_vector7(object_pose, "object_pose"),
            "bases": None if bases is None else as_poses(bases).rows.tolist(),
        }
        if robot_base_pose is not None:
            fields["robot_base_pose"] = as_vector7(robot_base_pose, "robot_base_pose")
        request = validate(wire.ReachRequest, fields)
        return self._transport.model(wire.ReachMap, "POST", f"{self._path}/reach", body=request)

    def proposals(
        self,
        count: int = 100,
        *,
        strategy: str = "density",
        seed: int | None = None,
        pre_opening_m: float | str | None = None,
        name: str | None = None,
        timeout_s: float | None = None,
        **selection: Unpack[ProposalSelection],
    ) -> SampledPoses:
        """Grasps to try next; send ``proposal_density`` back with their trials.

        ``density`` draws where successes lie, ``uncertainty`` where one more trial teaches most. ``edges``
        needs no trial, but a mesh and a ``gripper``: it draws about grasps that close on opposed surfaces,
        edges or points; some of what it draws collides. ``expected_improvement`` draws about the grasps that
        are expected to raise the success probability of the best grasp within :class:`Bounds` most
        (``expected_gain``), before any trial as well where mesh and gripper are known; give it those that
        you ask for the best grasp with, the noise of the execution above all. All three start from poses at
        which the gripper is free, as far open as ``pre_opening_m`` says (see :class:`Constraints`). ``name``
        keeps the answer, as for :meth:`samples`.
        """
        given = known_keywords(ProposalSelection, selection, "proposals")
        fields = bounded(_drawn({name: value for name, value in given.items() if value is not None}))
        fields |= {"count": count, "seed": seed, "strategy": strategy, "pre_opening_m": pre_opening_m}
        fields |= {"name": name, "timeout_s": timeout_s}
        request = validate(wire.ProposalsRequest, fields)
        answer = self._transport.model(wire.Proposals, "POST", f"{self._path}/proposals", body=request)
        return SampledPoses.from_wire(answer)


def _drawn(selection: dict[str, Any]) -> dict[str, Any]:
    """A selection to draw from as its request takes it."""
    near = selection.get("near")
    return selection if near is None else selection | {"near": near_of(near)}
