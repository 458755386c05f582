"""The first look at a file's grasps: whether they can be grasps of the object, and which flag mends them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.files.trials import METRES
from graspdb.interop.formats.known import TIPS
from graspdb.interop.frames import approach_of, frames_of, to_graspdb, to_tool
from graspdb.interop.grasps import Floats, Raw, Report
from graspdb.interop.placing import Placing
from graspdb.poses import Poses, matrices
from graspdb.wire import GripperProfile, ObjectInfo

NEAR_M = 0.01
"""Fingertips this far outside the object's box still count as within: jaws close about what sticks out."""
_REACH_M = 0.05
"""Fingertips that stay farther off than this never come near."""
_ROOM_M = 10.0
"""An object whose pose is farther off than this was told in millimetres."""
_FEW = 12
"""Of fewer grasps no share is compared."""
_NOTHING = 0.05
"""Where no more of the closings, or of the fingertips, meet the object, nothing fits it."""
_FAR_WORSE = 0.6
"""Grasps that fit so much less often than they would otherwise are taken for a mistake."""
_CRAMMED = 0.05
"""A share of the object's size."""
_SHRUNK = 0.15
"""As such a share, what grasps extend over at least where another unit makes them fit."""
_ALIKE = 0.03
"""Shares of grasps that fit differ by no more than this by chance."""
_DOUBTED = 0.5
"""Where the jaw meets the object less often, it may be another one."""
_OR_ELSE = "; or it is another object (--object) or gripper (--gripper)"
_CLOSINGS = 128
_FACES = 50_000_000
"""Triangles times grasps that closings are looked at for."""
#: What of a file's grasps is looked at.
_ARRAYS = ("position", "quaternion", "rotation", "ahead_m", "object_position", "object_quaternion")
#: Where along the fingers, as shares of their length from the tips back, the jaw's lines of closing are.
_DEPTHS = (0.05, 0.2, 0.4, 0.6)
#: Approach and closing along every pair of axes that differ for a jaw, those of known conventions first.
_AXES = (
    *("graspdb", "acronym", "graspnet", "z/y", "-z/x", "-z/y", "x/z", "-x/y", "-x/z"),
    *("y/x", "y/z", "-y/x", "-y/z"),
)


@dataclass(frozen=True)
class Target:
    """What grasps are looked at against: the object's box (3,) and (3,), the gripper, and triangles
    (F, 3, 3); metres.
    """

    lower: Floats
    upper: Floats
    gripper: GripperProfile
    triangles: Floats
    volume_m3: float | None


@dataclass
class FirstLook:
    """What the first look saw of ``looked_at`` grasps.

    ``fingertips_in_box`` of them have the middle between their fingertips in the object's box or a centimetre
    about it; of ``closings_looked_at``, ``closings_meet`` close on the object; None where that can't be told.
    ``refusals`` say what can't be right and what mends it, ``doubts`` what may not be.
    """

    looked_at: int = 0
    fingertips_in_box: int | None = None
    closings_meet: int | None = None
    closings_looked_at: int = 0
    refusals: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """In words."""
        told = []
        if self.fingertips_in_box is None:
            told.append("the object has no mesh: nothing to compare the grasps with")
        else:
            told.append(
                f"between the fingertips, {self.fingertips_in_box:,} of {self.looked_at:,} lie within the"
                " object's box"
            )
            told.append(f"{self.closings_meet:,} of {self.closings_looked_at:,} closings meet the object")
        return told


def target_of(info: ObjectInfo, gripper: GripperProfile, triangles: Floats | None) -> Target | None:
    """What is known of an object, its triangles (F, 3, 3) in metres, and a gripper; None without a mesh."""
    if info.mesh is None or triangles is None:
        return None
    lower, upper = np.array(info.mesh.bounding_box.lower), np.array(info.mesh.bounding_box.upper)
    return Target(lower, upper, gripper, triangles, info.mesh.volume_m3)


def first_look(raw: Raw, placing: Placing, target: Target | None, report: Report) -> FirstLook:
    """Look at some grasps of a file as they are placed, and as other flags would place them."""
    seen = FirstLook(looked_at=len(raw))
    if target is None or not len(raw):
        return seen
    now = _Placed(raw, placing, target)
    seen.fingertips_in_box = int(now.inside.sum())
    closed = now.closings()[0]
    seen.closings_meet, seen.closings_looked_at = int(closed.sum()), len(closed)
    best, flags = now, ""
    if now.score() <= _FAR_WORSE:
        best, flags = _better(now, _others(raw, placing, target, report), target)
    mends = f"; with {flags} {_share(best)}" if best.score() >= 0.5 else ""
    nearest = float(now.distance.min())
    if nearest > _REACH_M:
        seen.refusals.append(
            f"no fingertip comes near the object: the nearest stays {_length(nearest)} outside its box"
            + (mends or ": check --frame, --convention, --unit and --scale, and the object's mesh")
        )
    elif len(raw) >= _FEW and best.score() >= 0.5 and now.score() <= _FAR_WORSE * best.score():
        what = (
            "quaternions fit the other order better" if "quaternion" in flags else "few grasps fit the object"
        )
        seen.refusals.append(f"{what}: {_share(now)}{mends}{_OR_ELSE}")
    elif len(raw) >= _FEW and now.met() <= _NOTHING:
        seen.refusals.append(
            f"hardly a grasp is of the object: {'; '.join(seen.lines())}, and no other frame, axes, unit or"
            " order of quaternions that was tried fits better: check the object (--object), its mesh, the"
            " gripper (--gripper) and, where it is given, --object-pose"
        )
    elif len(raw) >= _FEW and now.met() < _DOUBTED:
        seen.doubts.append(f"the jaw meets the object in {_closed(now)} only{_OR_ELSE}")
    seen.refusals += _of_size(now, target, report)
    return seen


def _better(now: _Placed, others: Iterable[tuple[str, Placing]], target: Target) -> tuple[_Placed, str]:
    """The placing that fits better with the fewest flags, and these; where several fit alike, all of them."""
    found = []
    for flags, placing in others:
        placed = _Placed(now.raw, placing, target)
        if placed.spread_out() and (not flags.startswith("--unit") or placed.extended()):
            found.append((placed, flags))
    top = max((placed.score() for placed, _ in found), default=0.0)
    good = [item for item in found if item[0].score() >= top - _ALIKE]
    if top <= now.score() or not good:
        return now, ""
    fewest = min(_count(flags) for _, flags in good)
    likely = sorted((x for x in good if _count(x[1]) == fewest), key=lambda item: -item[0].score())
    return likely[0][0], " or ".join(flags for _, flags in likely[:3])


def _count(flags: str) -> int:
    return flags.count("--")


def _of_size(now: _Placed, target: Target, report: Report) -> Iterator[str]:
    """What the object's size says: a mesh that is another factor larger than the one that was grasped."""
    size = target.upper - target.lower
    volume, known = target.volume_m3, report.object_volume_m3
    mend = "upload it at the size that was grasped (graspdb objects set-mesh"
    mend += (
        f" --scale {report.object_scale:.9g})" if report.object_scale is not None else " --unit or --scale)"
    )
    if volume is not None and known is not None:
        factor = float(np.cbrt(volume / known))
        if not 0.5 <= factor <= 2.0:
            yield (
                f"the object's mesh, {_size(size)}, is {factor:.3g} times as large as the file's object:"
                f" {mend}"
            )
            return
    spread = np.ptp(np.quantile(now.tips, (0.05, 0.95), axis=0), axis=0)
    if (
        len(now.tips) >= 50
        and np.linalg.norm(size) > 5 * np.linalg.norm(spread)
        and np.linalg.norm(size) > 0.5
    ):
        yield (
            f"the object's mesh is {_size(size)}, and all grasps lie within {_size(spread)} of it: {mend}, or"
            " say how the positions are scaled (--scale, --unit)"
        )


class _Placed:
    """Grasps as one placing has them."""

    def __init__(self, raw: Raw, placing: Placing, target: Target) -> None:
        self.raw, self._target = raw, target
        gripper = target.gripper
        poses = placing.place(raw)
        self.position, self.quaternion = poses
        approach = approach_of(poses)
        self.tips = self.position + gripper.tip_offset_m * approach
        palm = self.tips - gripper.finger.length_m * approach
        self.distance = _outside(self.tips, target)
        self.inside = self.distance <= NEAR_M
        centre = (target.lower + target.upper) / 2
        inward = np.linalg.norm(palm - centre, axis=1) >= np.linalg.norm(self.tips - centre, axis=1)
        self.fits = self.inside & inward
        self._closed: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None

    def spread_out(self) -> bool:
        """Whether they are not all crammed into the object's middle, where a far too small unit puts any."""
        centre = (self._target.lower + self._target.upper) / 2
        apart = np.median(np.linalg.norm(self.position - centre, axis=1))
        return bool(apart >= _CRAMMED * self._size())

    def extended(self) -> bool:
        """Whether they extend over some of the object; those of a whole scene shrink into its middle, too."""
        across = np.linalg.norm(np.ptp(np.quantile(self.position, (0.05, 0.95), axis=0), axis=0))
        return len(self.position) < _FEW or bool(across >= _SHRUNK * self._size())

    def _size(self) -> float:
        return float(np.linalg.norm(self._target.upper - self._target.lower))

    def closings(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Of some grasps, evenly chosen, whether the jaw meets the object when it closes, and whether its
        fingers and palm were clear of it before.
        """
        triangles = self._target.triangles
        if self._closed is None:
            most = int(min(_CLOSINGS, max(8, _FACES // max(1, len(triangles)))))
            some = np.unique(np.linspace(0, len(self.tips) - 1, most).astype(int))
            poses = matrices(self.position[some], self.quaternion[some])
            closed = np.array([_closing(pose, triangles, self._target.gripper) for pose in poses])
            self._closed = closed[:, 0], closed[:, 1]
        return self._closed

    def met(self) -> float:
        """The share of grasps that close on the object."""
        return float(self.closings()[0].mean())

    def score(self) -> float:
        """The share of grasps that look like grasps of the object."""
        fitting = float(self.fits.mean())
        # Where hardly a fingertip is at the object, hardly a jaw closes on it.
        closed = self.closings() if fitting >= 0.3 else None
        return fitting if closed is None else float((closed[0] & closed[1]).mean())


def _outside(points: Floats, target: Target) -> Floats:
    """How far points (N, 3) lie outside the object's box; 0 within."""
    beyond = np.maximum(np.maximum(target.lower - points, points - target.upper), 0.0)
    return np.asarray(np.linalg.norm(beyond, axis=1))


def _closing(pose: Floats, triangles: Floats, gripper: GripperProfile) -> tuple[bool, bool]:
    """Whether a line between the open fingers, at any of some depths, crosses a triangle (F, 3, 3); and
    whether none crosses lines along the fingers, in their middle and near their sides, nor along the palm.
    """
    local = (triangles - pose[:3, 3]) @ pose[:3, :3]
    half, length, tip = gripper.max_opening_m / 2, gripper.finger.length_m, gripper.tip_offset_m
    out = half + gripper.finger.thickness_m / 2
    beside = (0.4 * gripper.finger.width_m, 0.4 * gripper.palm_size_m[0])
    widest = max(beside)
    low, high = local.min(axis=1), local.max(axis=1)
    near = np.all((low <= [widest, out, tip]) & (high >= [-widest, -out, tip - length]), axis=1)
    if not near.any():
        return False, True
    local = local[near]
    met = any(
        bool(np.any(np.abs(_crossings(local, 1, 0.0, tip - depth * length)) <= half)) for depth in _DEPTHS
    )
    for aside in (-1.0, 0.0, 1.0):
        for side in (-out, out):
            at = _crossings(local, 2, aside * beside[0], side)
            if np.any((at <= tip) & (at >= tip - length)):
                return met, False
        if np.any(np.abs(_crossings(local, 1, aside * beside[1], tip - length)) <= out):
            return met, False
    return met, True


def _crossings(triangles: Floats, along: int, first: float, second: float) -> Floats:
    """Where triangles (F, 3, 3) cross a line along an axis, the other two coordinates being these."""
    u, v = (triangles[:, :, axis] for axis in range(3) if axis != along)
    u, v, w = u - first, v - second, triangles[:, :, along]
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    seen = np.abs(area) > 1e-18
    area = np.where(seen, area, 1.0)
    # Barycentric coordinates of the line's point, seen along the line.
    b = (u[:, 2] * v[:, 0] - u[:, 0] * v[:, 2]) / area
    c = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / area
    crossed = (b >= 0) & (c >= 0) & (b + c <= 1) & seen
    at = w[:, 0] + b * (w[:, 1] - w[:, 0]) + c * (w[:, 2] - w[:, 0])
    return np.asarray(at[crossed])


def _others(raw: Raw, placing: Placing, target: Target, report: Report) -> Iterator[tuple[str, Placing]]:
    """What other flags would make of the same grasps, the likelier ones first."""
    if raw.quaternion is not None and raw.order is not None:
        other = "wxyz" if raw.order == "xyzw" else "xyzw"
        yield f"--quaternion-order {other}", replace(placing, swapped=True)
    if raw.object_quaternion is not None:
        named = "wxyz" if raw.object_order == "xyzw" else "xyzw"
        told = f"--columns ...,object_quaternion_{named}=..."
        yield told, replace(placing, object_swapped=True)
        if raw.order is not None:
            other = "wxyz" if raw.order == "xyzw" else "xyzw"
            both = replace(placing, swapped=True, object_swapped=True)
            yield f"--quaternion-order {other} {told}", both
    if placing.frame != TIPS:
        yield from _turned(placing, target)
    for unit, metres in METRES.items():
        if not np.isclose(metres, placing.factor):
            yield f"--unit {unit}", replace(placing, factor=metres)
    scale = report.object_scale
    if scale is not None and not np.isclose(scale, 1.0):
        yield f"--scale {scale:.9g}", replace(placing, factor=placing.factor * scale)
    if placing.into_object is not None:
        yield from _object_elsewhere(placing)


def _object_elsewhere(placing: Placing) -> Iterator[tuple[str, Placing]]:
    """The object's pose as others write it: w first, the other way round, in millimetres."""
    into = Poses.of(np.asarray(placing.into_object)[None])
    given = Poses.of(np.asarray(np.linalg.inv(into.matrices), dtype=np.float64))
    others = [
        (given.position, np.roll(given.quaternion_xyzw, -1, axis=1)),
        (into.position, into.quaternion_xyzw),
    ]
    if np.linalg.norm(given.position) > _ROOM_M:
        others.append((given.position / 1000.0, given.quaternion_xyzw))
    for position, quaternion in others:
        pose = Poses(position, quaternion)
        row = ",".join(f"{number + 0.0:.9g}" for number in np.round(pose.rows[0], 9))
        yield f"--object-pose={row}", replace(placing, into_object=np.linalg.inv(pose.matrices[0]))


def _turned(placing: Placing, target: Target) -> Iterator[tuple[str, Placing]]:
    """Other frames of the gripper, and other axes."""
    frames = [placing.frame]
    if "tool" in frames_of(target.gripper):
        frames += [name for name in ("base", "tool", "flange") if name in frames_of(target.gripper)]
    seen: list[Floats] = [placing.fixed]
    for frame in dict.fromkeys(frames):
        for convention in (placing.convention, *_AXES):
            # A format that says itself what approaches is written with that; the closing is mistaken.
            other = convention != placing.convention
            if (
                placing.axes_told
                and other
                and (frame != placing.frame or not _same_approach(convention, placing.convention))
            ):
                continue
            fixed = to_tool(frame, convention, target.gripper)
            if any(np.allclose(fixed, other) for other in seen):
                continue
            seen.append(fixed)
            flags = [f"--frame {frame}"] if frame != placing.frame else []
            if convention != placing.convention:
                flags.append(f"--convention {convention}")
            yield " ".join(flags), replace(placing, frame=frame, convention=convention, fixed=fixed)


def _same_approach(one: str, other: str) -> bool:
    return np.allclose(to_graspdb(one)[:, 2], to_graspdb(other)[:, 2])


def _closed(placed: _Placed) -> str:
    met = placed.closings()[0]
    return f"{int(met.sum()):,} of {len(met):,} closings"


def _share(placed: _Placed) -> str:
    closed = placed.closings() if placed.fits.mean() >= 0.3 else None
    if closed is not None:
        good = closed[0] & closed[1]
        return f"{int(good.sum()):,} of {len(good):,} close on it, fingers and palm clear of it"
    return f"{int(placed.fits.sum()):,} of {len(placed.fits):,} have their fingertips there and point at it"


def _length(metres: float) -> str:
    return f"{metres * 1000:.0f} mm" if metres < 1 else f"{metres:.3g} m"


def _size(edges: Floats) -> str:
    return " x ".join(_length(float(edge)) for edge in edges)


def gathered(raws: Sequence[Raw], most: int) -> Raw:
    """Of the first runs of some files, at most so many grasps, evenly chosen."""
    alike = [raw for raw in raws if (raw.quaternion is None) == (raws[0].quaternion is None) and len(raw)]
    parts = [_evenly(raw, max(1, most // max(1, len(alike)))) for raw in alike[:most]]
    if len(parts) < 2:
        return parts[0] if parts else raws[0]

    def joined(name: str) -> Any:
        values = [getattr(part, name) for part in parts]
        return None if any(value is None for value in values) else np.concatenate(values)

    arrays = {name: joined(name) for name in _ARRAYS}
    return Raw(0, order=parts[0].order, **arrays)


def _evenly(raw: Raw, most: int) -> Raw:
    if len(raw) <= most:
        return raw
    chosen = np.zeros(len(raw), dtype=bool)
    chosen[np.unique(np.linspace(0, len(raw) - 1, most).astype(int))] = True
    return raw.part(chosen)
