"""Whether poses make more sense in another convention: another unit, quaternion order or tool axis.

Only grasps that succeeded, or all where too few did, are asked, for a grasp that held says where the object
was. A convention is doubted where the one that was said makes sense of few grasps and another of most.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from graspdb_geometry.plausibility.doubt import Doubt, FloatArray, IntArray, Target
from graspdb_geometry.plausibility.meetings import collides, encloses, sample
from graspdb_geometry.poses import ToolPoses

#: Fewer poses than this tell nothing of a convention.
FEWEST = 10
#: Poses that each convention is tried on.
_TRIED = 192
#: The share of grasps that another convention explains where it is named, at least; the stated one then
#: explains no more than half as many.
_MOST = 0.7
#: Shares this near to one another are about the same.
_AS_GOOD = 0.05
#: How far a stated approach may point at the object, as a mean cosine, and still be doubted.
_ASIDE = 0.3

#: Poses of one object spread over more than this only where the unit is another: a gripper's reach.
_WIDEST_M = 2.0
#: Units that files come in, the usual one first, and metres per unit.
_UNITS = {"millimetres": 0.001, "centimetres": 0.01}
#: Where no object tells its size, grasps lie about this far from their middle.
_USUAL_M = 0.15
#: By their median they lie no nearer than this part of the usual distance, about a known object and another.
_NARROW, _NARROW_UNKNOWN = 5.0, 20.0

#: Nearer than this the poses may be of a robot's world, in metres: they are in another unit only if they lie
#: around the object, spread by more than this share of their distance.
_WORLD_M, _AROUND = 10.0, 0.2
#: In whatever unit they are, grasps of one object are spread by more than this.
_CLOSEST_M = 0.0005

_CLOSING_X = "z, closing along x"

#: Directions to the object that agree more than this with one another tell nothing of an axis: in a single
#: cluster any axis may point there.
_ALIKE = 0.9
#: A cloud is flat where its third extent is less than this share of its second: on a ring, such as a rim,
#: closing axes point inward and the approach does not.
_FLAT = 0.3
#: Votes times their mean cosine squared from which an axis points there by no chance: by Hoeffding's
#: inequality votes that are drawn do so for one of seven axes in one of 10,000 batches, 2 ln(70,000).
_VOTES = 22.0


def unit(positions: FloatArray, target: Target | None) -> Doubt | None:
    """Positions (n, 3) that look like another unit's than metres.

    Against a known object: most lie farther off than its grasps can, and in another unit about as far as they
    do. Without one: they lie metres from one another, or, where they are few, from the origin.
    """
    if not len(positions):
        return None
    if target is not None:
        centre, usual = target.centre, (target.object_size_m + target.reach_m) / 2
        widest, narrow = target.object_size_m + target.reach_m, _NARROW
    else:
        centre = np.median(positions, axis=0) if len(positions) >= FEWEST else np.zeros(3)
        usual, widest, narrow = _USUAL_M, _WIDEST_M, _NARROW_UNKNOWN
    distance = np.linalg.norm(positions - centre, axis=1)
    median = float(np.median(distance))
    if median <= widest:
        return None
    spread = float(np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))
    if median < _WORLD_M and (len(positions) < FEWEST or spread < _AROUND * median):
        return None
    for name, metres in _UNITS.items():
        if len(positions) >= FEWEST and metres * spread < _CLOSEST_M:
            continue
        # Not in the object's middle all of them: whatever is scaled down enough lies there.
        if usual / narrow <= metres * median <= 4.0 * usual:
            return Doubt(f"looks-like-{name}", np.flatnonzero(distance > widest), len(positions))
    return None


def rotations(poses: ToolPoses, held: IntArray, target: Target | None) -> Doubt | None:
    """Quaternions that look like w x y z, or tools that look as if another axis approached.

    Parameters
    ----------
    poses : (n), checked
    held : (k,) int
        Which of them succeeded.
    target : Target or None
        With a solid and a shape each convention is judged by how many grasps close on the object without
        colliding; where none explains them, with a box alone or without a target, by where the axes point.
    """
    positions, quaternions = (np.asarray(part) for part in poses)
    count = len(positions)
    asked = held if len(held) >= FEWEST else np.arange(count)
    if len(asked) < FEWEST:
        return None
    asked = asked[sample(len(asked), _TRIED)]
    x, q = positions[asked], quaternions[asked]
    name: str | None = None
    if target is not None and target.solid is not None:
        name = _by_closing(x, q, target)
        if name == "z":
            return None
    if name is None:
        name = _by_direction(x, q, target)
    if name is None or name == "z":
        return None
    rows = np.arange(count)
    if name == "wxyz":
        return Doubt("looks-like-wxyz", rows, len(asked))
    if name == _CLOSING_X:
        return Doubt("another-closing-axis", rows, len(asked), "x")
    return Doubt("another-approach-axis", rows, len(asked), name)


def _conventions(quaternions: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Each convention's name and the rotations (n, 4) meant by it; first the stated one, under ``z``."""
    yield "z", quaternions
    yield "wxyz", np.roll(quaternions, -1, axis=1)
    for name, axis in _AXES.items():
        # The closing axis may be either of the other two; its sign makes no difference to a jaw.
        for closing in _AXES.values():
            if abs(axis @ closing) < 0.5 and closing.sum() > 0 and not (name == "z" and closing[1]):
                turn = Rotation.from_matrix(np.stack([np.cross(closing, axis), closing, axis], axis=1))
                label = name if name != "z" else _CLOSING_X
                yield label, (Rotation.from_quat(quaternions) * turn).as_quat()


_AXES: dict[str, FloatArray] = {
    "z": np.array([0.0, 0.0, 1.0]),
    "-z": np.array([0.0, 0.0, -1.0]),
    "x": np.array([1.0, 0.0, 0.0]),
    "-x": np.array([-1.0, 0.0, 0.0]),
    "y": np.array([0.0, 1.0, 0.0]),
    "-y": np.array([0.0, -1.0, 0.0]),
}


def _by_closing(positions: FloatArray, quaternions: FloatArray, target: Target) -> str | None:
    """The convention under which most grasps close on the object; None where none explains them."""
    assert target.solid is not None
    assert target.shape is not None
    best, most, stated = "z", 0.0, 0.0
    for name, turned in _conventions(quaternions):
        poses = ToolPoses(positions, turned)
        holds = encloses(poses, target.solid, target.shape)
        if holds.mean() > most:
            holds &= ~collides(poses, target.solid, target.shape)
        share = float(holds.mean())
        if name == "z":
            stated = share
            if share > 0.5:
                return name
        # About as good as one nearer to what was stated tells nothing: a jaw about an object's middle may
        # close on it from behind as well.
        if share > most + (0.0 if best == "z" else _AS_GOOD):
            best, most = name, share
    if most < _MOST:
        return None
    return best if stated <= most / 2 else "z"


def _by_direction(positions: FloatArray, quaternions: FloatArray, target: Target | None) -> str | None:
    """The axis that points at the object, or at the middle of the grasps, where the stated one does not."""
    centre = positions.mean(axis=0) if target is None else target.centre
    towards = centre - positions
    distance = np.linalg.norm(towards, axis=1)
    if not distance.sum() > 0.0 or np.linalg.norm(towards.sum(axis=0)) > _ALIKE * distance.sum():
        return None
    extents = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    flat = extents[2] < _FLAT * extents[1]
    axes = Rotation.from_quat(quaternions).as_matrix()
    turned = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    directions = {name: axes @ axis for name, axis in _AXES.items()}
    if _points(towards, directions.pop("z")) > _ASIDE:
        return None
    if flat:
        directions = {"-z": directions["-z"]}
    directions["wxyz"] = turned[:, :, 2]
    # An axis that stays as it is while the object is grasped all along it points at the middle from most
    # places, too: one that approaches turns with where it comes from.
    around = towards - towards.mean(axis=0)
    found = {name: min(_points(towards, axis), _points(around, axis)) for name, axis in directions.items()}
    name = max(found, key=lambda item: found[item])
    # Distant grasps weigh more: so many equal votes are these.
    votes = distance.sum() ** 2 / np.sum(distance**2)
    return name if found[name] >= _MOST and votes * found[name] ** 2 >= _VOTES else None


def _points(towards: FloatArray, axis: FloatArray) -> float:
    """The mean cosine between directions (n, 3) and axes (n, 3), distant grasps weighing more: their
    direction is known better.
    """
    length = float(np.linalg.norm(towards, axis=1).sum())
    return float(np.einsum("ni,ni->", towards, axis)) / length if length > 0.0 else 0.0


def stragglers(positions: FloatArray) -> Doubt | None:
    """Positions (n, 3) metres away from the others, where no object tells how far is too far."""
    if len(positions) < FEWEST:
        return None
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    far = np.flatnonzero(distance > _WIDEST_M + 10.0 * float(np.median(distance)))
    return Doubt("far-from-the-rest", far, len(positions)) if len(far) else None
