"""What a parallel jaw closes on, in numbers from which outcomes can be learned: width, travel, what either
finger touches and how it lies there, and where the centre of mass is beside it.

The numbers are the same for both twins of a grasp (the jaw turned half about its approach) and for its mirror
image across the plane that the fingers close in: mechanics does not tell these apart. So the finger that
touches more comes first, and the centre of mass lies to the side of positive x.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from graspdb_geometry._compiled import closing, tree
from graspdb_geometry.collision import in_blocks
from graspdb_geometry.grippers import GripperShape
from graspdb_geometry.poses import PoseArrays, checked

__all__ = ["DECREASING", "FEATURES", "INCREASING", "ClosingGeometry"]

FloatArray = npt.NDArray[np.float64]

_FINGER = (
    *(f"{name}_{depth}" for depth in ("near", "deep") for name in ("lines", "x", "z", "nx", "ny", "nz")),
    *("x_least", "x_greatest", "z_least", "z_greatest", "travel", "behind"),
)
_PLACE = {name: number for number, name in enumerate(_FINGER)}
#: What is mirrored with x.
_ALONG_X = [_PLACE[name] for name in ("x_near", "nx_near", "x_deep", "nx_deep")]
_X_LIMITS = [_PLACE["x_least"], _PLACE["x_greatest"]]

#: Names of the columns: of the finger that touches more, of the other, and of both.
FEATURES: tuple[str, ...] = (
    *(f"first_{name}" for name in _FINGER),
    *(f"second_{name}" for name in _FINGER),
    *("width", "off_centre", "lines", "chord"),
    *("mass_x", "mass_y", "mass_z", "lever_x", "lever_z", "lever", "middle_x", "middle_z"),
    *("apart_x", "apart_z", "first_aligned", "second_aligned", "least_aligned"),
    *("least_normal", "least_lines", "reach_z"),
)
#: By the mechanics of two fingers with friction a grasp holds no worse, all else alike, the more normals lie
#: along the line between both contacts and the more of the pads touches; and no better the farther the centre
#: of mass is from the axis that it may turn about.
INCREASING, DECREASING = ("least_aligned", "least_lines"), ("lever",)


class ClosingGeometry:
    """An object for jaws to close on: its triangles and its centre of mass; immutable, thread-safe.

    Parameters
    ----------
    corners : (F, 3, 3) float
        Triangles, metres, object frame, counterclockwise seen from outside.
    centre_of_mass : (3,) float
        Metres, object frame.

    Raises
    ------
    ValueError
        Without triangles.
    """

    _LEAF = 4

    def __init__(self, corners: npt.ArrayLike, centre_of_mass: npt.ArrayLike) -> None:
        points = np.asarray(corners, dtype=np.float64)
        if points.ndim != 3 or points.shape[1:] != (3, 3) or not len(points):
            raise ValueError("corners must be (F, 3, 3) with at least one triangle")
        self._centre = np.asarray(centre_of_mass, dtype=np.float64)
        nodes, links, order = tree.build(points, self._LEAF)
        self._tree = (nodes, links, points[order])

    @property
    def corners(self) -> FloatArray:
        """Its triangles (F, 3, 3), metres, object frame, in no order."""
        return self._tree[2]

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps."""
        return sum(array.nbytes for array in self._tree)

    def features(self, poses: PoseArrays, shape: GripperShape, threads: int = 1) -> FloatArray:
        """The numbers of each pose, (n, len(FEATURES)): metres, cosines and counts of lines between the pads;
        NaN where nothing is between the open fingers. Whether the gripper collides is not asked.

        Parameters
        ----------
        poses : (n)
            Of the tool in the object frame.
        shape : GripperShape
            Fingers whose tips move on arcs are taken as far ahead as they ever are.
        """
        p, q = checked(poses)
        half, centre = shape.swept()
        column = np.ascontiguousarray(np.stack([centre, half]))
        met = np.empty((len(p), 2 * closing.OF_A_FINGER + 4))

        def run(block: slice) -> None:
            closing.fingers(p[block], q[block], column, self._tree, met[block])

        in_blocks(run, len(p), threads)
        mass = Rotation.from_quat(q).inv().apply(self._centre - p) if len(p) else np.empty((0, 3))
        return _canonical(met, mass, tip=float(centre[2] + half[2]))


def _canonical(met: FloatArray, mass: FloatArray, tip: float) -> FloatArray:
    """Features (n, F) of what the fingers meet, and the centre of mass (n, 3) in the tool frame."""
    size = closing.OF_A_FINGER
    sides = met[:, : 2 * size].reshape(-1, 2, size).copy()
    lines = sides[:, :, _PLACE["lines_deep"]]
    travel = sides[:, :, _PLACE["travel"]]
    swap = (lines[:, 1] > lines[:, 0]) | ((lines[:, 1] == lines[:, 0]) & (travel[:, 1] < travel[:, 0]))
    sides[swap] = sides[swap, ::-1]
    # The finger at -y comes first as it is: turned half about z, x and y change their signs.
    sign = np.where(swap, -1.0, 1.0)
    # Where nothing is met no finger comes first.
    mass_x, mass_y = mass[:, 0] * sign, np.where(np.isnan(travel[:, 0]), np.nan, mass[:, 1] * sign)
    mirror = np.where(mass_x < 0.0, -1.0, 1.0) * sign
    sides[:, :, _ALONG_X] *= mirror[:, None, None]
    limits = sides[:, :, _X_LIMITS] * mirror[:, None, None]
    sides[:, :, _X_LIMITS] = np.where(mirror[:, None, None] < 0.0, limits[:, :, ::-1], limits)
    first, second = sides[:, 0].T, sides[:, 1].T
    at = _PLACE
    width, off, count, chord = met[:, 2 * size :].T
    x, z = (np.stack([first[at[f"{name}_deep"]], second[at[f"{name}_deep"]]]) for name in ("x", "z"))
    apart = np.stack([x[0] - x[1], width, z[0] - z[1]])
    with np.errstate(invalid="ignore", divide="ignore"):
        apart_by = apart / np.linalg.norm(apart, axis=0)
    aligned = []
    for finger, way in ((first, 1.0), (second, -1.0)):
        n = np.stack([finger[at[f"{name}_deep"]] for name in ("nx", "ny", "nz")])
        aligned.append(way * (n[0] * apart_by[0] + n[2] * apart_by[2]) + n[1] * apart_by[1])
    normal, touched = (np.minimum(first[at[name]], second[at[name]]) for name in ("ny_deep", "lines_deep"))
    middle_x, middle_z = x.mean(axis=0), z.mean(axis=0)
    lever_x, lever_z = np.abs(mass_x) - middle_x, mass[:, 2] - middle_z
    rest = (
        width, np.abs(off), count, chord, np.abs(mass_x), mass_y, mass[:, 2],
        lever_x, lever_z, np.hypot(lever_x, lever_z), middle_x, middle_z,
        apart[0], apart[2], *aligned, np.minimum(*aligned), normal, touched,
        tip - np.maximum(first[at["z_greatest"]], second[at["z_greatest"]]),
    )  # fmt: skip
    return np.concatenate([sides.reshape(len(met), -1), np.stack(rest, axis=1)], axis=1)
