"""What queries answer, as NumPy arrays and poses that a robot program can use at once."""

from __future__ import annotations

import copy
import html
import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from graspdb import wire
from graspdb.options import known_keywords
from graspdb.poses import Poses, as_poses, matrices
from graspdb.resources.pictures.asking import PictureOptions, with_picture

Floats = NDArray[np.float64]
Reporter = Callable[..., Any]
"""Posts a trial of a grasp: takes the grasp, its outcome, and what else ``trials.add`` takes."""
Drawer = Callable[..., bytes]
"""Has a picture of a grasp drawn: takes the grasp and what else ``GraspObject.picture`` takes."""


def to_pandas(columns: Mapping[str, Any]) -> Any:
    """A DataFrame of equally long columns."""
    try:
        pandas = importlib.import_module("pandas")
    except ImportError as error:
        raise ImportError("to_pandas() needs pandas: pip install 'graspdb[pandas]'") from error
    return pandas.DataFrame(dict(columns))


def pose_columns(poses: Any) -> dict[str, Floats]:
    """Seven columns x, y, z, qx, qy, qz, qw of anything with ``position`` and ``quaternion_xyzw``."""
    rows = Poses(poses.position, poses.quaternion_xyzw).rows
    return {name: rows[:, i] for i, name in enumerate(("x", "y", "z", "qx", "qy", "qz", "qw"))}


def table_html(title: str, rows: Mapping[str, Any]) -> str:
    """A two-column table for a notebook."""
    cells = "".join(
        f"<tr><th style='text-align:left'>{html.escape(str(key))}</th>"
        f"<td style='text-align:left'>{html.escape(str(value))}</td></tr>"
        for key, value in rows.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{cells}</table>"


def _vector(values: Any, digits: int = 4) -> str:
    return "[" + ", ".join(f"{float(v):.{digits}f}" for v in values) + "]"


def chance(probability: float, low: float, high: float, trials: float) -> str:
    """A success probability in words; unknown where it is NaN."""
    if not np.isfinite(probability):
        return f"unknown, {trials:.1f} trials"
    return f"{probability:.2f} ({low:.2f} to {high:.2f}), {trials:.1f} trials"


def distance(nearest: wire.NearestAttempt) -> str:
    """How far an attempt is, in words."""
    return (
        f"{1e3 * nearest.position_m:.1f} mm and {nearest.rotation_deg:.0f}° away"
        f" ({nearest.kernel_widths:.1f} kernel widths)"
    )


def reach_told(reach: wire.RobotReach) -> str:
    """Why a robot's arm takes none of the grasps, in words."""
    told = {
        "too_far": f"out of the arm's reach by {reach.off_m:.2f} m",
        "joint_limit": f"only beyond a joint's limit, {reach.off_m:.2f} m off within them",
        "singular": "no straight approach and lift lead there",
    }.get(reach.reason, f"{reach.link} would collide with {reach.other}")
    if reach.nearest_base_pose is not None:
        at = " ".join(f"{number:+.2f}" for number in reach.nearest_base_pose.position)
        told += f"; with its root at {at} m (world) the arm takes one"
    return f"the nearest of {reach.tested} grasps tested is {told}" if reach.link is None else told


@dataclass(frozen=True, eq=False, repr=False)
class Grasp:
    """A grasp: the pose of the tool frame in the object frame, metres and unit xyzw, and what is known of it.

    - ``frame``, ``convention``: the frame of the gripper that the pose is of instead, and whose axes it has,
      where the question asked for another; ``tool_to_frame`` is that one's pose in the tool frame, (4, 4).
    - ``world``: the same grasp in the world frame, (4, 4); None unless the query gave the object's pose.
    - ``score``: what it was ranked by; ``Grasps.ranking`` says what that is.
    - ``density``, ``log_density``: in 1/(m^3 rad^3), and its natural logarithm.
    - ``relative``: density over the density's global maximum: 1 at the best grasp there is.
    - ``success_probability``, ``interval``, ``effective_trials``: the estimate, its interval and the trials
      it rests on; None where the service gives none, as too far from every attempt.
    - ``support``: how far the nearest attempt is, whether that is near ``enough`` for a success probability,
      and the ``reason`` where it is not.
    - ``prior_success_probability``: what mesh and gripper alone tell where it is not.
    - ``collision_free``: None until mesh and gripper are known.
    - ``prior``: chosen by the object's edges before any success; its density is that of the edges.
    - ``candidate``: its place among the candidates that were given.
    - ``simulated``: outcome of the grasp simulated anew at the fine step, where that was asked for.
    - ``width_m``: opening of the jaw once both fingers touch the object, metres.
    - ``opening_m``: opening to command before the approach, at which collisions were tested, metres.
    - ``nearest_trials``: ``seq`` of the trials nearest to it.
    - ``active_constraints``: those that hold it where it is.
    - ``joints``: of a robot that was named, ``pregrasp``, ``grasp`` and ``lift``, lists in the order of its
      joints, radians and metres; ``joint_margin`` is the least distance of any to its limit on the way, and
      ``manipulability`` Yoshikawa's measure at the grasp.
    - ``gripper``, ``protocol``: those of the trials that it was chosen from, None where they are of none.
    - ``answer``: id of the answer that it is of, for the trial that tries it; None where it is not kept.
    - ``warnings``: what to mind of that answer; printing the grasp says them, too.
    """

    position: Floats
    quaternion_xyzw: Floats
    density: float
    log_density: float
    relative: float
    world: Floats | None = None
    success_probability: float | None = None
    interval: wire.Interval | None = None
    effective_trials: float | None = None
    support: wire.Support | None = None
    prior_success_probability: float | None = None
    collision_free: bool | None = None
    width_m: float | None = None
    opening_m: float | None = None
    nearest_trials: tuple[int, ...] = ()
    active_constraints: tuple[str, ...] = ()
    joints: wire.GraspJoints | None = None
    joint_margin: float | None = None
    manipulability: float | None = None
    score: float | None = None
    candidate: int | None = None
    simulated: str | None = None
    prior: bool = False
    gripper: str | None = None
    protocol: str | None = None
    answer: str | None = None
    frame: str = "tool"
    convention: str = "graspdb"
    tool_to_frame: Floats | None = None
    warnings: tuple[str, ...] = ()
    raw: wire.Grasp | None = field(default=None)
    reporter: Reporter | None = field(default=None)
    drawer: Drawer | None = field(default=None)

    @classmethod
    def from_wire(
        cls,
        grasp: wire.Grasp,
        answer: wire.BestGrasps,
        reporter: Reporter | None = None,
        drawer: Drawer | None = None,
    ) -> Grasp:
        """From the service's answer that it is of; ``reporter`` posts what became of it."""
        fields = {name: getattr(grasp, name) for name in wire.Grasp.model_fields}
        world = grasp.world
        fields |= {
            "position": np.array(grasp.position),
            "quaternion_xyzw": np.array(grasp.quaternion_xyzw),
            "world": None if world is None else matrices(world.position, world.quaternion_xyzw),
            "nearest_trials": tuple(grasp.nearest_trials),
            "active_constraints": tuple(grasp.active_constraints),
        }
        fixed = answer.tool_to_frame
        fields |= {
            "frame": answer.frame,
            "convention": answer.convention,
            "tool_to_frame": None if fixed is None else matrices(fixed.position, fixed.quaternion_xyzw),
            "warnings": tuple(answer.warnings),
        }
        if answer.selection is not None:
            fields |= {"gripper": answer.selection.gripper, "protocol": answer.selection.protocol}
        return cls(**fields, answer=answer.answer, raw=grasp, reporter=reporter, drawer=drawer)

    def report(
        self, outcome: bool | str, *, achieved_pose: Any | None = None, source: str = "robot", **trial: Any
    ) -> Any:
        """Post what became of the grasp: a trial that names the answer, with its gripper and protocol.

        ``achieved_pose`` is where the grasp's ``frame`` was after all, (4, 4) or x y z qx qy qz qw in the
        object frame;
        what else is known of the trial as ``trials.add`` takes it (``width_m``, ...). The receipt.

        It waits for the service, also in an asynchronous program: there call ``trials.add`` with ``answer``.
        """
        if self.reporter is None:
            raise ValueError("this grasp is of no object's answer: use trials.add(grasp, outcome, ...)")
        achieved = {} if achieved_pose is None else {"achieved_poses": achieved_pose}
        return self.reporter(self, outcome, source=source, **achieved, **trial)

    def picture(self, **options: Unpack[PictureOptions]) -> bytes:
        """A picture (PNG) of the gripper at the grasp, drawn by the service: see :class:`PictureOptions`.

        It waits for the service, also in an asynchronous program: there call the object's ``picture``.
        """
        if self.drawer is None:
            raise ValueError("this grasp is of no object's answer: use the object's picture(grasp)")
        return self.drawer(self, **known_keywords(PictureOptions, options, "picture"))

    def __getstate__(self) -> dict[str, Any]:
        """A connection goes to no other process."""
        return {**vars(self), "reporter": None, "drawer": None}

    @property
    def matrix(self) -> Floats:
        """(4, 4) homogeneous matrix: the grasp's ``frame`` in the object frame, metres."""
        return matrices(self.position, self.quaternion_xyzw)

    @property
    def tool_matrix(self) -> Floats:
        """(4, 4) homogeneous matrix: the tool frame in the object frame, metres, whatever ``frame`` is."""
        return self._of_tool(self.matrix)

    @property
    def tool_world(self) -> Floats | None:
        """(4, 4) the tool frame in the world frame, whatever ``frame`` is; None as ``world``."""
        return None if self.world is None else self._of_tool(self.world)

    @property
    def approach(self) -> Floats:
        """(3,) direction in which the tool moves to the object: the tool's z axis, object frame."""
        return self.tool_matrix[:3, 2]

    @property
    def closing(self) -> Floats:
        """(3,) direction in which the fingers close: the tool's y axis, object frame."""
        return self.tool_matrix[:3, 1]

    def _of_tool(self, matrix: Floats) -> Floats:
        return matrix if self.tool_to_frame is None else matrix @ np.linalg.inv(self.tool_to_frame)

    def _told_frame(self) -> str:
        """What the pose is of, in words."""
        axes = "" if self.convention == "graspdb" else f", axes as {self.convention}"
        return f"{self.frame}{axes}"

    def chance(self) -> str:
        """The success probability in words: never without its interval and the trials it rests on."""
        if self.success_probability is None or self.interval is None or self.effective_trials is None:
            reason = None if self.support is None else self.support.reason
            return "unknown" if reason is None else f"unknown: {reason}"
        low, high = self.interval.low, self.interval.high
        return chance(self.success_probability, low, high, self.effective_trials)

    def summary(self) -> dict[str, str]:
        """What a person wants to know of it, in words."""
        rows = {
            "pose of": f"{self._told_frame()}, in the object frame",
            "position [m]": _vector(self.position),
            "quaternion xyzw": _vector(self.quaternion_xyzw),
            "approach": _vector(self.approach, 2),
        }
        if self.world is not None and self.tool_world is not None:
            world = as_poses(self.world)
            rows |= {
                "position in the world [m]": _vector(world.position[0]),
                "quaternion in the world xyzw": _vector(world.quaternion_xyzw[0]),
                "approach in the world": _vector(self.tool_world[:3, 2], 2),
            }
        rows |= {
            "density [1/(m³ rad³)]": f"{self.density:.4g}",
            "relative": f"{self.relative:.3f}",
        }
        if self.prior:
            rows["chosen by"] = "the object's edges: nothing has succeeded yet"
        if self.success_probability is not None or self.support is not None:
            rows["success probability"] = self.chance()
        if self.prior_success_probability is not None:
            rows["expected untried"] = f"{self.prior_success_probability:.2f}"
        if self.support is not None:
            rows["effective trials"] = f"{self.support.effective_trials:.1f}"
        if self.support is not None and self.support.nearest_attempt is not None:
            rows["nearest attempt"] = distance(self.support.nearest_attempt)
        if self.collision_free is not None:
            rows["collision-free"] = "yes" if self.collision_free else "no"
        if self.simulated is not None:
            rows["simulated"] = self.simulated
        if self.width_m is not None:
            rows["width [m]"] = f"{self.width_m:.4f}"
        if self.opening_m is not None:
            rows["opening to command [m]"] = f"{self.opening_m:.4f}"
        if self.joints is not None:
            for name, joints in self.joints:
                if joints is not None:
                    rows[f"joints, {name}"] = " ".join(f"{value:+.4f}" for value in joints)
            margin = "none has a limit" if self.joint_margin is None else f"{self.joint_margin:.3f} rad or m"
            rows["nearest joint limit"] = margin
            rows["manipulability"] = f"{self.manipulability:.3g}"
        if self.active_constraints:
            rows["held by"] = ", ".join(self.active_constraints)
        if self.answer is not None:
            rows["answer"] = self.answer
        return rows

    def __repr__(self) -> str:
        return self.line() + _mind(self.warnings)

    def line(self) -> str:
        """What it is in one line."""
        world = "" if self.world is None else f"world position={_vector(self.world[:3, 3])}, "
        return (
            f"Grasp(position={_vector(self.position)}, quaternion_xyzw={_vector(self.quaternion_xyzw)} "
            f"of the {self._told_frame()} in the object frame, {world}"
            f"density={self.density:.4g}, relative={self.relative:.3f}{', prior=True' if self.prior else ''})"
        )

    def _repr_html_(self) -> str:
        mind = {"mind": "; ".join(self.warnings)} if self.warnings else {}
        drawer = None if self.drawer is None else partial(self.drawer, self)
        return with_picture(table_html("Grasp", self.summary() | mind), drawer)


class Grasps(Sequence[Grasp]):
    """Distinct grasps, best first.

    ``status`` is ``ok``, or ``fewer`` if less than the asked number exist, or ``infeasible`` or
    ``no_successes`` if there is none; ``nearest`` is then the closest grasp outside the constraints,
    ``conflict`` names the fewest constraints found that exclude each other, ``relax`` a value of each that
    would do.
    ``ranking`` says what they are ranked by, ``reach`` how far from an attempt success probabilities are
    told, ``selection`` whose trials count. ``answer`` is the id that the service keeps them under, None where
    it does not; ``newer_revision`` the object's revision now, where a name keeps them of an older one;
    ``stale``: the database did not answer, so they are from what the service had read before. ``frame`` and
    ``convention`` say what the poses are of, as each grasp does, ``reference`` what the constraints were in.
    Where they were simulated before they were answered (``verify=True``), those that held come first.
    """

    def __init__(
        self, answer: wire.BestGrasps, reporter: Reporter | None = None, drawer: Drawer | None = None
    ) -> None:
        self.status = answer.status
        self.revision = answer.revision
        self.kernel = answer.kernel
        self.ranking = answer.ranking
        self.reach = answer.reach if isinstance(answer.reach, wire.ReachInfo) else None
        self.robot_reach = answer.reach if isinstance(answer.reach, wire.RobotReach) else None
        self.estimator = answer.estimator
        self.warnings = list(answer.warnings)
        self.selection = answer.selection
        self.calibration = answer.calibration
        self.symmetry = answer.symmetry
        self.answer = answer.answer
        self.newer_revision = answer.newer_revision
        self.stale = answer.stale
        self.frame, self.convention = answer.frame, answer.convention
        self.reference = answer.reference
        nearest = answer.nearest
        self.nearest = None if nearest is None else Grasp.from_wire(nearest, answer, reporter, drawer)
        self.conflict = tuple(answer.conflict)
        self.relax = dict(answer.relax)
        self._grasps = tuple(Grasp.from_wire(grasp, answer, reporter, drawer) for grasp in answer.grasps)

    @overload
    def __getitem__(self, index: int) -> Grasp: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Grasp, ...]: ...
    def __getitem__(self, index: int | slice) -> Grasp | tuple[Grasp, ...]:
        return self._grasps[index]

    def __len__(self) -> int:
        return len(self._grasps)

    def __iter__(self) -> Iterator[Grasp]:
        return iter(self._grasps)

    def why_none(self) -> str:
        """Why there is no grasp, in words: what excludes what, what would do, and the nearest outside."""
        told = ""
        if self.conflict:
            what = "all that was tried" if len(self.conflict) == 1 else "each other"
            exclude = "excludes" if len(self.conflict) == 1 else "exclude"
            told += f": {' and '.join(self.conflict)} {exclude} {what}"
        if self.robot_reach is not None:
            told += f"; {reach_told(self.robot_reach)}"
        if self.relax:
            values = [
                f"{name}={','.join(f'{number:g}' for number in np.atleast_1d(value))}"
                if not isinstance(value, bool)
                else f"{name}={str(value).lower()}"
                for name, value in self.relax.items()
            ]
            told += f"; {' or '.join(values)} would do"
        if self.nearest is not None:
            at, along = (
                " ".join(f"{number:+.3f}" for number in vector)
                for vector in (self.nearest.tool_matrix[:3, 3], self.nearest.approach)
            )
            told += f"; the nearest grasp outside is at {at} m and approaches along {along} (object's frame)"
        return told

    def simulated(self, outcomes: Sequence[str]) -> Grasps:
        """The same grasps with what became of each in simulation; those that held come first."""
        told = [replace(grasp, simulated=o) for grasp, o in zip(self._grasps, outcomes, strict=True)]
        answer = copy.copy(self)
        answer._grasps = tuple(sorted(told, key=lambda grasp: grasp.simulated != "success"))
        return answer

    @property
    def matrices(self) -> Floats:
        """(N, 4, 4) poses of ``frame``, by default the tool's, in the object frame."""
        return np.array([grasp.matrix for grasp in self._grasps]).reshape(-1, 4, 4)

    @property
    def worlds(self) -> Floats | None:
        """(N, 4, 4) poses of ``frame`` in the world frame; None unless the query gave the object's pose."""
        worlds = [grasp.world for grasp in self._grasps if grasp.world is not None]
        return np.array(worlds) if worlds else None

    def columns(self) -> dict[str, Any]:
        """Equally long columns by name: the pose in the object frame, ``world_x`` to ``world_qw`` that in the
        world frame where the query gave the object's pose, then scores; ``low`` and ``high`` are the ends of
        the success probability's interval.
        """
        poses = Poses(
            np.array([g.position for g in self]).reshape(-1, 3),
            np.array([g.quaternion_xyzw for g in self]).reshape(-1, 4),
        )
        columns: dict[str, Any] = dict(pose_columns(poses))
        worlds = self.worlds
        if worlds is not None:
            columns |= {f"world_{name}": x for name, x in pose_columns(as_poses(worlds)).items()}
        names = ["score", "density", "log_density", "relative", "success_probability", "effective_trials"]
        names += [
            "prior_success_probability",
            "collision_free",
            "width_m",
            "opening_m",
            "candidate",
            "simulated",
        ]
        columns |= {name: [getattr(grasp, name) for grasp in self] for name in names}
        for end in ("low", "high"):
            columns[end] = [g.interval and getattr(g.interval, end) for g in self]
        columns["enough"] = [None if g.support is None else g.support.enough for g in self]
        return columns

    def to_pandas(self) -> Any:
        """A DataFrame with a row a grasp (extra ``pandas``): see :meth:`columns`."""
        return to_pandas(self.columns())

    def __repr__(self) -> str:
        lines = "".join(f"\n  {grasp.line()}," for grasp in self._grasps)
        told = (
            f"Grasps(status={self.status!r}, [{lines}\n])" if lines else f"Grasps(status={self.status!r}, [])"
        )
        return told + _mind(self.warnings)


def _mind(warnings: Iterable[str]) -> str:
    return "".join(f"\n  mind: {warning}" for warning in warnings)


_COLUMNS = (
    "density",
    "log_density",
    "relative",
    "success_probability",
    "effective_trials",
    "prior_success_probability",
)


class Columns:
    """What can be read as a table."""

    def _columns(self) -> dict[str, Any]:
        raise NotImplementedError

    def columns(self) -> dict[str, Any]:
        """Equally long columns by name."""
        return self._columns()

    def to_pandas(self) -> Any:
        """A DataFrame with a row a pose (extra ``pandas``)."""
        return to_pandas(self._columns())


@dataclass(frozen=True, eq=False)
class IntervalArrays:
    """Bounds (N,) that hold the success probability with the given level; NaN where unknown."""

    level: float
    low: Floats
    high: Floats


@dataclass(frozen=True, eq=False)
class NearestAttemptArrays:
    """How far the nearest attempt is: metres, degrees, standard deviations of the kernel, each (N,); NaN
    before any attempt.
    """

    position_m: Floats
    rotation_deg: Floats
    kernel_widths: Floats


@dataclass(frozen=True, eq=False)
class SupportArrays:
    """What answers rest on: the nearest attempt, the effective trials (N,), and whether it is near ``enough``
    (N,) for a success probability.
    """

    nearest_attempt: NearestAttemptArrays
    effective_trials: Floats
    enough: NDArray[np.bool_]

    @classmethod
    def from_wire(cls, parts: Sequence[wire.SupportColumns]) -> SupportArrays:
        """From the answers to consecutive parts of the poses."""
        nearest = [part.nearest_attempt for part in parts]
        names = ("position_m", "rotation_deg", "kernel_widths")
        distances = {
            name: np.array([x for part in nearest for x in getattr(part, name)], dtype=np.float64)
            for name in names
        }
        return cls(
            nearest_attempt=NearestAttemptArrays(**distances),
            effective_trials=np.array([x for part in parts for x in part.effective_trials], dtype=np.float64),
            enough=np.array([x for part in parts for x in part.enough], dtype=np.bool_),
        )

    def columns(self) -> dict[str, Any]:
        """Equally long columns by name, the effective trials left out."""
        nearest = self.nearest_attempt
        return {
            "nearest_position_m": nearest.position_m,
            "nearest_rotation_deg": nearest.rotation_deg,
            "nearest_kernel_widths": nearest.kernel_widths,
            "enough": self.enough,
        }


@dataclass(frozen=True, eq=False, repr=False)
class LikelihoodArrays(Columns):
    """Answers for N poses, in their order; a column not asked for or not known is None.

    ``density`` in 1/(m^3 rad^3); ``log_density`` natural, minus infinity where the density is exactly
    zero; ``relative`` to the density's global maximum. ``success_probability`` and ``interval`` are NaN where
    ``support.enough`` is False; ``reach`` says how far from an attempt they are told, and why no farther.
    ``answer`` is the id that the service keeps them under, None where it does not; ``newer_revision`` the
    object's revision now, where a name keeps them of an older one; ``stale``: the database did not answer, so
    they are from what the service had read before.
    ``selection`` says whose trials count, and each source's share of the density's weight. ``opening_m`` is
    the opening to command, at which collisions were tested, where ``pre_opening_m`` asked for it, metres.
    """

    revision: int
    kernel: wire.KernelInfo
    density: Floats | None = None
    log_density: Floats | None = None
    relative: Floats | None = None
    success_probability: Floats | None = None
    interval: IntervalArrays | None = None
    effective_trials: Floats | None = None
    collision_free: NDArray[np.bool_] | None = None
    opening_m: Floats | None = None
    support: SupportArrays | None = None
    prior_success_probability: Floats | None = None
    reach: wire.ReachInfo | None = None
    estimator: wire.EstimatorInfo | None = None
    warnings: Sequence[str] = ()
    answer: str | None = None
    newer_revision: int | None = None
    stale: bool = False
    selection: wire.SelectionInfo | None = None
    calibration: wire.CalibrationInfo | None = None
    symmetry: wire.SymmetryInfo | None = None

    @classmethod
    def from_wire(cls, answers: Sequence[wire.Likelihoods]) -> LikelihoodArrays:
        """From the answers to consecutive parts of the poses."""
        free, openings = _joined(answers, "collision_free"), _joined(answers, "opening_m")
        # NumPy makes NaN of nulls; the log of an exact zero is another null.
        joined = {name: _joined(answers, name) for name in _COLUMNS}
        columns = {name: None if x is None else np.array(x, dtype=float) for name, x in joined.items()}
        if (log_density := columns["log_density"]) is not None:
            log_density[np.isnan(log_density)] = -np.inf
        intervals = [a.interval for a in answers if a.interval is not None and a.interval.low]
        interval = None
        if intervals:
            ends = ([x for i in intervals for x in getattr(i, end)] for end in ("low", "high"))
            interval = IntervalArrays(intervals[0].level, *(np.array(end, dtype=float) for end in ends))
        support = [a.support for a in answers if a.support is not None]
        return cls(
            revision=answers[-1].revision,
            kernel=answers[-1].kernel,
            support=SupportArrays.from_wire(support) if len(support) == len(answers) else None,
            reach=answers[-1].reach,
            estimator=answers[-1].estimator,
            warnings=answers[-1].warnings,
            selection=answers[-1].selection,
            calibration=answers[-1].calibration,
            symmetry=answers[-1].symmetry,
            interval=interval,
            answer=answers[0].answer if len(answers) == 1 else None,
            newer_revision=answers[-1].newer_revision,
            stale=any(a.stale for a in answers),
            collision_free=None if free is None or None in free else np.array(free, dtype=np.bool_),
            opening_m=None if openings is None else np.array(openings, dtype=float),
            **columns,
        )

    def _columns(self) -> dict[str, Any]:
        names = [
            name for name in (*_COLUMNS, "collision_free", "opening_m") if getattr(self, name) is not None
        ]
        columns = {name: getattr(self, name) for name in names}
        if self.interval is not None:
            columns |= {"low": self.interval.low, "high": self.interval.high}
        if self.support is not None:
            columns |= self.support.columns()
        return columns

    def __len__(self) -> int:
        return next((len(column) for column in self._columns().values()), 0)

    def __repr__(self) -> str:
        return f"LikelihoodArrays({len(self)} poses: {', '.join(self._columns())}; revision {self.revision})"


def _joined(answers: Sequence[wire.Likelihoods], name: str) -> list[Any] | None:
    columns = [getattr(answer, name) for answer in answers]
    if any(column is None for column in columns):
        return None
    joined = [value for column in columns for value in column]
    # A column of nothing but nulls says that the service does not know; minus infinity is no such null, nor
    # is a probability where no attempt is near enough.
    known = name == "log_density" or (name == "success_probability" and answers[-1].reach is not None)
    return None if not known and all(v is None for v in joined) else joined


@dataclass(frozen=True, eq=False, repr=False)
class PoseArrays(Columns):
    """N tool frames in the object frame: ``position`` (N, 3) metres, ``quaternion_xyzw`` (N, 4).

    ``frame`` and ``convention`` say what they are of where another frame of the gripper was asked for.
    """

    position: Floats
    quaternion_xyzw: Floats
    frame: str = field(default="tool", kw_only=True)
    convention: str = field(default="graspdb", kw_only=True)

    @property
    def matrices(self) -> Floats:
        """(N, 4, 4) poses of ``frame``, by default the tool's, in the object frame."""
        return matrices(self.position, self.quaternion_xyzw)

    @property
    def poses(self) -> Floats:
        """(N, 7) rows x y z qx qy qz qw."""
        return Poses(self.position, self.quaternion_xyzw).rows

    def _columns(self) -> dict[str, Any]:
        return dict(pose_columns(self))

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True, eq=False, repr=False)
class TriedPoses(PoseArrays):
    """Poses with the ``outcome`` (N,) of each, by name."""

    outcome: NDArray[np.str_]

    @property
    def success(self) -> NDArray[np.bool_]:
        """(N,) True where the grasp held."""
        return np.asarray(self.outcome == "success")


@dataclass(frozen=True, eq=False, repr=False)
class SampledPoses(PoseArrays):
    """N poses drawn from a density; ``proposal_density`` (N,) in 1/(m^3 rad^3) goes back with the trials.

    ``criterion`` says how proposals were drawn; None for plain samples. ``support`` says how far each is from
    what was tried; None where that was not looked up. ``prior``: geometry drew them, no trial. ``selection``
    says whose trials count. ``answer`` is the id that the service keeps them under, None where it does not;
    ``newer_revision`` the object's revision now, where a name keeps them of an older one; ``stale``: the
    database did not answer, so they are from what the service had read before. ``opening_m`` (N,) is the
    opening to command at each proposal, metres, where ``pre_opening_m`` asked for it; ``symmetry`` says which
    symmetries share attempts, where that was asked; ``expected_gain`` (N,) by how much each is expected to
    raise the success probability of the best grasp, where that chose them.
    """

    proposal_density: Floats
    seed: int
    revision: int
    kernel: wire.KernelInfo
    criterion: str | None = None
    support: SupportArrays | None = None
    prior: bool = False
    answer: str | None = None
    newer_revision: int | None = None
    stale: bool = False
    selection: wire.SelectionInfo | None = None
    opening_m: Floats | None = None
    symmetry: wire.SymmetryInfo | None = None
    expected_gain: Floats | None = None

    @classmethod
    def from_wire(cls, answer: wire.Samples) -> SampledPoses:
        """From the service's answer."""
        openings, gains = (
            (answer.opening_m, answer.expected_gain) if isinstance(answer, wire.Proposals) else (None, None)
        )
        return cls(
            position=np.array(answer.position, dtype=np.float64).reshape(-1, 3),
            quaternion_xyzw=np.array(answer.quaternion_xyzw, dtype=np.float64).reshape(-1, 4),
            proposal_density=np.array(answer.proposal_density, dtype=np.float64),
            frame=answer.frame,
            convention=answer.convention,
            seed=answer.seed,
            revision=answer.revision,
            kernel=answer.kernel,
            criterion=answer.criterion if isinstance(answer, wire.Proposals) else None,
            support=None if answer.support is None else SupportArrays.from_wire([answer.support]),
            prior=answer.prior,
            answer=answer.answer,
            newer_revision=answer.newer_revision,
            stale=answer.stale,
            selection=answer.selection,
            symmetry=answer.symmetry,
            opening_m=None if openings is None else np.array(openings, dtype=np.float64),
            expected_gain=None if gains is None else np.array(gains, dtype=np.float64),
        )

    @property
    def gripper(self) -> str | None:
        """The gripper of the trials that they are drawn from, None where they are of none."""
        return None if self.selection is None else self.selection.gripper

    @property
    def protocol(self) -> str | None:
        """The protocol of these trials, None where they are of none."""
        return None if self.selection is None else self.selection.protocol

    def _columns(self) -> dict[str, Any]:
        columns = {**pose_columns(self), "proposal_density": self.proposal_density}
        if self.opening_m is not None:
            columns["opening_m"] = self.opening_m
        if self.expected_gain is not None:
            columns["expected_gain"] = self.expected_gain
        return columns if self.support is None else columns | self.support.columns()

    def __repr__(self) -> str:
        told = f"{len(self)} poses of the {self.frame} in the object frame"
        return f"SampledPoses({told}, seed={self.seed}, revision={self.revision})"


@dataclass(frozen=True, eq=False, repr=False)
class TrialArrays(TriedPoses):
    """Stored trials as columns, ``seq`` (N,) their numbers in commit order."""

    seq: NDArray[np.int64]
    trials: tuple[wire.TrialOut, ...]

    @property
    def achieved(self) -> Poses:
        """Where the tool was after all, NaN where that is unknown: the other poses are then what was
        commanded.
        """
        known = [trial.achieved_pose for trial in self.trials]
        rows = [[np.nan] * 7 if p is None else [*p.position, *p.quaternion_xyzw] for p in known]
        table = np.array(rows, dtype=np.float64).reshape(-1, 7)
        return Poses(table[:, :3], table[:, 3:])

    @property
    def qualities(self) -> dict[str, Floats]:
        """Scores by name, (N,) each, NaN where a trial has none."""
        names = dict.fromkeys(name for trial in self.trials for name in trial.qualities or ())
        return {
            name: np.array([(trial.qualities or {}).get(name, np.nan) for trial in self.trials])
            for name in names
        }

    @classmethod
    def of(
        cls, trials: Sequence[wire.TrialOut], frame: str | None = None, convention: str | None = None
    ) -> TrialArrays:
        """The columns of these trials, whose poses are of this frame."""
        return cls(
            frame=frame or "tool",
            convention=convention or "graspdb",
            seq=np.array([t.seq for t in trials], dtype=np.int64),
            position=np.array([t.position for t in trials], dtype=np.float64).reshape(-1, 3),
            quaternion_xyzw=np.array([t.quaternion_xyzw for t in trials], dtype=np.float64).reshape(-1, 4),
            outcome=np.array([t.outcome for t in trials], dtype=np.str_),
            trials=tuple(trials),
        )

    def _columns(self) -> dict[str, Any]:
        names = ["gripper", "source", "protocol", "engine", "batch", "sweep", "pose_index", "quality"]
        names += ["width_m", "proposal_density", "measured_at", "revision", "withdrawn", "answer"]
        names += ["attempts", "successes"]
        columns = {"seq": self.seq, **pose_columns(self), "outcome": self.outcome}
        columns |= {f"achieved_{name}": x for name, x in pose_columns(self.achieved).items()}
        columns |= {f"qualities.{name}": x for name, x in self.qualities.items()}
        return columns | {name: [getattr(t, name) for t in self.trials] for name in names}

    def __repr__(self) -> str:
        return f"TrialArrays({len(self)} trials, {int(self.success.sum())} successes)"
