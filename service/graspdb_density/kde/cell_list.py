"""Kernels sorted by grid cell, in float32, and kept so while rows are added.

A `Cells` holds a few segments (see `_compiled.isotropic`): rows with the jaw's symmetry and rows without are
separate, because the inner loop differs, and each has a sorted main range and a shorter tail. New rows sort
into the tail only; when the tail outgrows a quarter of the main range, both are sorted together. So adding
rows costs the tail, not the whole, and the total over many additions stays proportional to n log n.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._compiled import isotropic as c
from .._compiled.threads import for_blocks
from ..se3 import Floats, Poses
from .rows import Rows

__all__ = ["Cells"]

#: Kernels in a block of the exact path: few enough to skip far blocks, enough to vectorise.
_BLOCK = 128
#: A tail is merged when it exceeds this share of its main range.
_TAIL_SHARE = 0.25
_TAIL_LEAST = 2048
#: Edges of the cells in scaled units. Finer cells visit fewer kernels out of reach but make more and shorter
#: runs, and a run costs about as much as 90 kernels to start. Half the default cut-off is within 7 % of the
#: best edge from 20,000 to 160,000 kernels on the shell of the benchmarks; along z a finer edge costs
#: nothing, since it only trims runs.
_EDGES = 4.0 / math.sqrt(2.0) / np.array([2.0, 2.0, 4.0])
#: From so many poses on it pays to put neighbours one after the other.
_SORTED_FROM = 256


class _Segment(NamedTuple):
    """One sorted range of kernels; ``header`` is its row of the table, places in the joined arrays apart."""

    data: NDArray[np.float32]
    rows: NDArray[np.int32]
    start: NDArray[np.int32]
    header: Floats
    boxes: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Cells:
    """Sorted kernels.

    Attributes
    ----------
    arrays
        What the compiled loops take.
    rows : (N,) int32
        Original row of every sorted kernel.
    """

    arrays: c.CellArrays
    rows: NDArray[np.int32]

    @classmethod
    def build(cls, rows: Rows, sigma_position_m: float) -> Cells:
        """Sort all rows; weights are of about 1, where float32 is fine enough."""
        scale = 1.0 / (sigma_position_m * math.sqrt(2.0))
        # The median keeps the bulk near the origin, where float32 is finest, whatever the outliers.
        centre = np.median(rows.poses.positions, axis=0)
        return cls._joined(_with_tails([], rows, 0, centre, scale), centre, scale)

    def extend(self, rows: Rows) -> Cells:
        """Add rows behind the present ones; shares nothing mutable with the old cells."""
        centre, scale = self.arrays.centre, self.arrays.scale
        segments = _with_tails(self._segments(), rows, len(self.rows), centre, scale)
        return self._joined(segments, centre, scale)

    @classmethod
    def _joined(cls, segments: list[_Segment], centre: Floats, scale: float) -> Cells:
        table = np.stack([s.header for s in segments])
        for column, lengths in (
            (c.OFFSET, [len(s.rows) for s in segments]),
            (c.STARTS, [len(s.start) for s in segments]),
        ):
            table[:, column] = np.cumsum([0, *lengths[:-1]])
        blocks = []
        for offset, segment in zip(table[:, c.OFFSET], segments, strict=True):
            first = np.arange(0, len(segment.rows), _BLOCK)
            last = np.minimum(first + _BLOCK, len(segment.rows))
            twins = np.full(len(first), segment.header[c.TWIN])
            blocks.append(np.stack([first + offset, last + offset, twins], axis=1))
        arrays = c.CellArrays(
            np.concatenate([s.data for s in segments], axis=1),
            np.concatenate([s.start for s in segments]),
            table,
            np.concatenate(blocks).astype(np.int64),
            np.concatenate([s.boxes for s in segments]),
            centre,
            scale,
        )
        return cls(arrays, np.concatenate([s.rows for s in segments]))

    def reweighted(self, twin_weights: Floats) -> Cells:
        """The same kernels with other weights (N,), in the order of rows; nothing is sorted again."""
        data = self.arrays.data.copy()
        data[7] = twin_weights[self.rows]
        return Cells(self.arrays._replace(data=data), self.rows)

    def _segments(self) -> list[_Segment]:
        """Views of the joined arrays."""
        offsets, starts = (self.arrays.table[1:, column].astype(int) for column in (c.OFFSET, c.STARTS))
        blocks = np.searchsorted(self.arrays.blocks[:, 0], offsets)
        return [
            _Segment(*parts)
            for parts in zip(
                np.split(self.arrays.data, offsets, axis=1),
                np.split(self.rows, offsets),
                np.split(self.arrays.start, starts),
                self.arrays.table,
                np.split(self.arrays.boxes, blocks),
                strict=True,
            )
        ]

    def poses(self, places: NDArray[np.integer]) -> Poses:
        """Some of the sorted kernels' poses, as precise as they are held."""
        arrays = self.arrays
        positions = arrays.data[:3, places].T.astype(np.float64) / arrays.scale + arrays.centre
        quaternions = arrays.data[3:7, places].T.astype(np.float64)
        return Poses(np.ascontiguousarray(positions), np.ascontiguousarray(quaternions))

    @property
    def symmetric(self) -> NDArray[np.bool_]:
        """Whether each sorted kernel's jaw is mirror-symmetric, (N,)."""
        table = self.arrays.table
        return np.repeat(table[:, c.TWIN] > 0.0, table[:, c.COUNT].astype(np.int64))

    def visiting_order(self, positions: Floats) -> NDArray[np.intp]:
        """An order in which neighbours follow each other, so that kernels stay in the processor's cache."""
        edge = self.arrays.table[0, c.EDGE] / self.arrays.scale
        cell = np.floor((positions - self.arrays.centre) / edge).clip(-1e5, 1e5).astype(np.int64) + 100_000
        return np.argsort((cell[:, 0] * 200_001 + cell[:, 1]) * 200_001 + cell[:, 2])

    def at_poses(
        self,
        loop: Callable[[Floats, Floats, Floats], None],
        poses: Poses,
        *,
        columns: tuple[int, ...] = (),
        order: NDArray[np.integer] | None = None,
        block: int,
        threads: int,
    ) -> Floats:
        """What a compiled loop over these cells gives at poses, (M, *columns).

        Parameters
        ----------
        loop : callable
            Takes positions, quaternions and where its answers go, a block of poses at a time.
        order : (M,) or None
            In which poses are taken. None: the one of `visiting_order`, where there are many.
        """
        p, q = poses
        if order is None:
            order = self.visiting_order(p) if len(p) >= _SORTED_FROM else np.arange(len(p))
        p, q = p[order], q[order]
        found = np.empty((len(p), *columns))

        def work(begin: int, end: int) -> None:
            loop(p[begin:end], q[begin:end], found[begin:end])

        for_blocks(work, len(p), block=block, threads=threads)
        result = np.empty_like(found)
        result[order] = found
        return result

    @property
    def nbytes(self) -> int:
        """Bytes held by the arrays."""
        a = self.arrays
        return sum(part.nbytes for part in (a.data, a.start, a.table, a.blocks, a.boxes, self.rows))


def _with_tails(
    segments: list[_Segment], rows: Rows, first: int, centre: Floats, scale: float
) -> list[_Segment]:
    """Segments with further rows, numbered from ``first`` on, in the tails."""
    found: list[_Segment] = []
    for twin, chosen in ((True, rows.symmetric), (False, ~rows.symmetric)):
        tail = [s for s in segments if s.header[c.TWIN] == twin]
        if not chosen.any():
            found += tail
            continue
        some = rows[chosen]
        p, q = some.poses
        data = np.concatenate([((p - centre) * scale).T, q.T, some.twin_weights[None, :]]).astype(np.float32)
        if tail:
            grown = sum(len(s.rows) for s in tail[1:]) + len(some)
            if grown <= max(_TAIL_LEAST, _TAIL_SHARE * len(tail[0].rows)):
                found.append(tail.pop(0))
        places = (first + np.flatnonzero(chosen)).astype(np.int32)
        found.append(
            _sort(
                np.concatenate([*(s.data for s in tail), data], axis=1),
                np.concatenate([*(s.rows for s in tail), places]),
                twin,
                centre * scale,
            )
        )
    return found


def _sort(data: NDArray[np.float32], rows: NDArray[np.int32], twin: bool, anchor: Floats) -> _Segment:
    """Sort rows by cells of a lattice through the object's origin, which lies at ``-anchor``.

    So which kernels a query visits does not depend on how rows are split into segments: a density that was
    extended cuts off what a rebuilt one does.
    """
    positions = data[:3]
    count = data.shape[1]
    low, high = positions.min(axis=1).astype(np.float64), positions.max(axis=1).astype(np.float64)
    edges, most = _EDGES, max(65_536, 8 * count)
    origin, size = _lattice(low, high, edges, anchor)
    # Far outliers go to the border cells instead of stretching the grid; a spread that is too wide even so
    # gets larger cells.
    if np.prod(size.astype(np.float64)) > most:
        bottom = np.quantile(positions, 0.005, axis=1).astype(np.float64)
        top = np.quantile(positions, 0.995, axis=1).astype(np.float64)
        origin, size = _lattice(bottom, top, edges, anchor)
        while np.prod(size.astype(np.float64)) > most:
            edges = edges * 1.25
            origin, size = _lattice(bottom, top, edges, anchor)
    cell = np.floor((positions - origin[:, None].astype(np.float32)) / edges[:, None].astype(np.float32))
    index = np.clip(cell, 0, (size - 1)[:, None]).astype(np.int64)
    key = (index[0] * size[1] + index[1]) * size[2] + index[2]
    order = np.argsort(key, kind="stable")
    start = np.zeros(int(np.prod(size)) + 1, dtype=np.int32)
    np.cumsum(np.bincount(key, minlength=len(start) - 1), out=start[1:])
    header = np.zeros(c.COLUMNS)
    header[c.COUNT], header[c.NX : c.NZ + 1] = count, size
    header[c.OX : c.OZ + 1] = origin
    header[c.EDGE], header[c.EDGE_Z], header[c.TWIN] = edges[0], edges[2], float(twin)
    header[c.LOW : c.LOW + 3], header[c.HIGH : c.HIGH + 3] = low, high
    ordered = np.ascontiguousarray(data[:, order])
    first = np.arange(0, count, _BLOCK)
    boxes = np.concatenate(
        [np.minimum.reduceat(ordered[:3], first, axis=1), np.maximum.reduceat(ordered[:3], first, axis=1)]
    ).T
    return _Segment(ordered, rows[order], start, header, np.ascontiguousarray(boxes))


def _lattice(low: Floats, high: Floats, edges: Floats, anchor: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Corner of the lattice's cell that holds ``low``, and how many cells reach to ``high``."""
    first = np.floor((low + anchor) / edges)
    return first * edges - anchor, (np.floor((high + anchor) / edges) - first).astype(np.int64) + 1
