"""Kernels sorted by grid cell, in float32, and kept so while rows are added.

A `Cells` holds a few segments (see `compiled`): rows with the jaw's symmetry and rows without are separate,
because the inner loop differs, and each has a sorted main range and a shorter tail. New rows sort into the
tail only; when the tail outgrows a quarter of the main range, both are sorted together. So adding rows costs
the tail, not the whole, and the total over many additions stays proportional to n log n.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .._compiled import isotropic as c
from ..se3 import Floats
from .rows import Rows

__all__ = ["Cells"]

#: Kernels in a block of the exact path: few enough to skip far blocks, enough to vectorise.
_BLOCK = 128
#: A tail is merged when it exceeds this share of its main range.
_TAIL_SHARE = 0.25
_TAIL_LEAST = 2048


@dataclass(frozen=True, slots=True)
class _Segment:
    """One sorted range of kernels."""

    data: NDArray[np.float32]
    rows: NDArray[np.int32]
    start: NDArray[np.int32]
    header: Floats
    boxes: NDArray[np.float32]
    twin: bool

    @property
    def size(self) -> int:
        return int(self.data.shape[1])


@dataclass(frozen=True, slots=True)
class Cells:
    """Sorted kernels, ready for the compiled loops.

    Attributes
    ----------
    data : (8, N) float32, start : (cells,) int32, table : (S, COLUMNS), blocks : (B, 3) int64, boxes : (B, 6)
    float32
        As `compiled` takes them.
    rows : (N,) int32
        Original row of every sorted kernel.
    centre : (3,) metres
    scale : 1 / (sigma sqrt 2), 1/m
    """

    data: NDArray[np.float32]
    start: NDArray[np.int32]
    table: Floats
    blocks: NDArray[np.int64]
    boxes: NDArray[np.float32]
    rows: NDArray[np.int32]
    centre: Floats
    scale: float
    segments: tuple[_Segment, ...]

    @classmethod
    def build(
        cls,
        rows: Rows,
        sigma_position_m: float,
    ) -> Cells:
        """Sort all rows; weights are of about 1, where float32 is fine enough."""
        scale = 1.0 / (sigma_position_m * math.sqrt(2.0))
        # The median keeps the bulk near the origin, where float32 is finest, whatever the outliers.
        centre = np.median(rows.poses.positions, axis=0)
        places = np.arange(len(rows), dtype=np.int32)
        segments = tuple(
            _sort(
                _soa(rows[chosen], flag, centre, scale),
                places[chosen],
                flag,
                centre * scale,
            )
            for flag, chosen in ((True, rows.symmetric), (False, ~rows.symmetric))
            if chosen.any()
        )
        return cls._assemble(segments, centre, scale)

    def extend(self, rows: Rows) -> Cells:
        """Add rows behind the present ones; shares nothing mutable with the old cells."""
        first = self.data.shape[1]
        places = np.arange(first, first + len(rows), dtype=np.int32)
        segments: list[_Segment] = []
        for flag, chosen in ((True, rows.symmetric), (False, ~rows.symmetric)):
            present = [s for s in self.segments if s.twin == flag]
            if not chosen.any():
                segments += present
                continue
            data = _soa(rows[chosen], flag, self.centre, self.scale)
            tail = present[1:]
            joined = sum(s.size for s in tail) + data.shape[1]
            if present and joined > max(_TAIL_LEAST, _TAIL_SHARE * present[0].size):
                tail, present = present, []
            segments += present[:1]
            segments.append(
                _sort(
                    np.concatenate([*(s.data for s in tail), data], axis=1),
                    np.concatenate([*(s.rows for s in tail), places[chosen]]),
                    flag,
                    self.centre * self.scale,
                )
            )
        return self._assemble(tuple(segments), self.centre, self.scale)

    @classmethod
    def _assemble(cls, segments: tuple[_Segment, ...], centre: Floats, scale: float) -> Cells:
        table = np.zeros((len(segments), c.COLUMNS))
        blocks = []
        offset = starts = 0
        for i, segment in enumerate(segments):
            table[i] = segment.header
            table[i, c.OFFSET], table[i, c.COUNT], table[i, c.STARTS] = offset, segment.size, starts
            first = np.arange(0, segment.size, _BLOCK)
            last = np.minimum(first + _BLOCK, segment.size)
            blocks.append(
                np.stack([first + offset, last + offset, np.full(len(first), segment.twin)], axis=1)
            )
            offset += segment.size
            starts += len(segment.start)
        data = np.concatenate([s.data for s in segments], axis=1)
        start = np.concatenate([s.start for s in segments])
        # The segments keep views of the joined arrays, so that nothing is held twice.
        kept, offset, starts = [], 0, 0
        for segment in segments:
            kept.append(
                _Segment(
                    data[:, offset : offset + segment.size],
                    segment.rows,
                    start[starts : starts + len(segment.start)],
                    segment.header,
                    segment.boxes,
                    segment.twin,
                )
            )
            offset += segment.size
            starts += len(segment.start)
        return cls(
            data=data,
            start=start,
            table=table,
            blocks=np.concatenate(blocks).astype(np.int64),
            boxes=np.concatenate([s.boxes for s in segments]),
            rows=np.concatenate([s.rows for s in segments]),
            centre=centre,
            scale=scale,
            segments=tuple(kept),
        )

    @property
    def arrays(self) -> c.CellArrays:
        """What the compiled loops take."""
        return c.CellArrays(
            self.data, self.start, self.table, self.blocks, self.boxes, self.centre, self.scale
        )

    def visiting_order(self, positions: Floats) -> NDArray[np.intp]:
        """An order in which neighbours follow each other, so that kernels stay in the processor's cache."""
        edge = self.table[0, c.EDGE] / self.scale
        cell = np.floor((positions - self.centre) / edge).clip(-1e5, 1e5).astype(np.int64) + 100_000
        return np.argsort((cell[:, 0] * 200_001 + cell[:, 1]) * 200_001 + cell[:, 2])

    @property
    def nbytes(self) -> int:
        """Bytes held by the arrays."""
        rows = sum(s.rows.nbytes + s.boxes.nbytes for s in self.segments)
        return int(
            self.data.nbytes
            + self.start.nbytes
            + self.rows.nbytes
            + self.boxes.nbytes
            + self.blocks.nbytes
            + rows
        )


def _soa(rows: Rows, twin: bool, centre: Floats, scale: float) -> NDArray[np.float32]:
    """Scaled float32 columns (8, n) of rows that all have a twin or have none."""
    p, q = rows.poses
    return np.concatenate([((p - centre) * scale).T, q.T, rows.twin_weights[None, :]]).astype(np.float32)


def _edges() -> tuple[float, float]:
    """Edge lengths (x and y, z) of the cells in scaled units.

    Finer cells visit fewer kernels out of reach but make more and shorter runs, and a run costs about as much
    as 90 kernels to start. Half the default cut-off is within 7 % of the best edge from 20,000 to 160,000
    kernels on the shell of the benchmarks; along z a finer edge costs nothing, since it only trims runs.
    """
    edge = 4.0 / math.sqrt(2.0) / 2.0
    return edge, edge / 2.0


def _sort(data: NDArray[np.float32], rows: NDArray[np.int32], twin: bool, anchor: Floats) -> _Segment:
    """Sort rows by cells of a lattice through the object's origin, which lies at ``-anchor``.

    So which kernels a query visits does not depend on how rows are split into segments: a density that was
    extended cuts off what a rebuilt one does.
    """
    positions = data[:3]
    count = data.shape[1]
    low, high = positions.min(axis=1).astype(np.float64), positions.max(axis=1).astype(np.float64)
    edge, edge_z = _edges()
    edges = np.array([edge, edge, edge_z])
    most = max(65_536, 8 * count)
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
    header[c.NX : c.NZ + 1] = size
    header[c.OX : c.OZ + 1] = origin
    header[c.EDGE], header[c.EDGE_Z], header[c.TWIN] = edges[0], edges[2], float(twin)
    header[c.LOW : c.LOW + 3], header[c.HIGH : c.HIGH + 3] = low, high
    ordered = np.ascontiguousarray(data[:, order])
    first = np.arange(0, count, _BLOCK)
    boxes = np.concatenate(
        [np.minimum.reduceat(ordered[:3], first, axis=1), np.maximum.reduceat(ordered[:3], first, axis=1)]
    ).T
    return _Segment(ordered, rows[order], start, header, np.ascontiguousarray(boxes), twin)


def _lattice(low: Floats, high: Floats, edges: Floats, anchor: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Corner of the lattice's cell that holds ``low``, and how many cells reach to ``high``."""
    first = np.floor((low + anchor) / edges)
    return first * edges - anchor, (np.floor((high + anchor) / edges) - first).astype(np.int64) + 1
