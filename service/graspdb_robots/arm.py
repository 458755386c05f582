"""A robot's arm as arrays: the chain of joints from its root to its flange, and solids on its links."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinkSolid:
    """A convex solid of a link: the hull of points, and all within a distance of it.

    Attributes
    ----------
    link
        Name of the link.
    joint
        How many of the chain's joints move it: 0 for what stands with the root.
    points : (V, 3) metres, in the frame of the last of these joints
    radius_m
        The solid reaches so far beyond the points' hull.
    """

    link: str
    joint: int
    points: Floats
    radius_m: float = 0.0


@dataclass(frozen=True, eq=False)
class Arm:
    """A chain of n joints, turning or sliding, from a robot's root link to its flange.

    Joints of the robot that are not between the two stay where they are at zero, or at their limit nearest to
    it.

    Attributes
    ----------
    joints
        Names (n) from the root on.
    sliding : (n,) bool
        Of which joints the value is a length.
    lower, upper : (n,) radians or metres
        Limits; infinite for a joint that turns on without end.
    placements : (n, 4, 4)
        Frame of each joint at zero in that of the joint before it, of the first in the root link's.
    axes : (n, 3)
        Unit axis of each joint in its own frame.
    flange : (4, 4)
        The flange link in the frame of the last joint.
    solids
        What may collide, without what hangs at the flange.
    pairs : (P, 2)
        Indices of solids that are tested against each other.
    links
        Names of the links from the root to the flange that are in the chain.
    untested
        Names of links that have a shape which could not be read: they are not tested for collisions.
    """

    joints: tuple[str, ...]
    sliding: NDArray[np.bool_]
    lower: Floats
    upper: Floats
    placements: Floats
    axes: Floats
    flange: Floats
    solids: tuple[LinkSolid, ...] = ()
    pairs: NDArray[np.int64] = None  # type: ignore[assignment]
    links: tuple[str, ...] = ()
    untested: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.pairs is None:
            object.__setattr__(self, "pairs", np.zeros((0, 2), dtype=np.int64))

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps, nearly."""
        return 4096 + sum(solid.points.nbytes for solid in self.solids)

    @property
    def middle(self) -> Floats:
        """Joints (n,) in the middle of their limits; 0 for those without."""
        ends = np.isfinite(self.lower) & np.isfinite(self.upper)
        return np.where(ends, np.where(ends, self.lower, 0) / 2 + np.where(ends, self.upper, 0) / 2, 0.0)

    def range_of(self, turn: float = np.pi) -> tuple[Floats, Floats]:
        """Limits (n,), and ``turn`` to either side for joints without."""
        lower = np.where(np.isfinite(self.lower), self.lower, -turn)
        return lower, np.where(np.isfinite(self.upper), self.upper, turn)

    def to_bytes(self) -> bytes:
        """All of it, for :meth:`from_bytes`."""
        stream = io.BytesIO()
        corners = [solid.points for solid in self.solids]
        np.savez_compressed(
            stream,
            joints=np.array(self.joints, dtype=np.str_),
            sliding=self.sliding,
            lower=self.lower,
            upper=self.upper,
            placements=self.placements,
            axes=self.axes,
            flange=self.flange,
            pairs=self.pairs,
            links=np.array(self.links, dtype=np.str_),
            untested=np.array(self.untested, dtype=np.str_),
            solid_links=np.array([solid.link for solid in self.solids], dtype=np.str_),
            solid_joints=np.array([solid.joint for solid in self.solids], dtype=np.int64),
            solid_radii=np.array([solid.radius_m for solid in self.solids]),
            solid_sizes=np.array([len(points) for points in corners], dtype=np.int64),
            solid_points=np.concatenate(corners) if corners else np.zeros((0, 3)),
        )
        return stream.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> Arm:
        """What :meth:`to_bytes` made."""
        with np.load(io.BytesIO(content), allow_pickle=False) as found:
            values = dict(found)
        parts = np.split(values["solid_points"], np.cumsum(values["solid_sizes"])[:-1])
        rows = zip(values["solid_links"], values["solid_joints"], values["solid_radii"], parts, strict=False)
        return cls(
            joints=tuple(map(str, values["joints"])),
            solids=tuple(LinkSolid(str(link), int(at), points, float(r)) for link, at, r, points in rows),
            links=tuple(map(str, values["links"])),
            untested=tuple(map(str, values["untested"])),
            **{
                name: values[name]
                for name in ("sliding", "lower", "upper", "placements", "axes", "flange", "pairs")
            },
        )
