"""Tables of the densities of emitters' light subpaths.

Emission maps two primary numbers to a direction (light from infinity: to a point on a disk). A table over
their unit square has in each cell the density relative to unguided emission; its mean is 1.
`emitters.group.Group.place` defines the squares of an emitter. An environment has one for each of
`infinite.SKY_BINS`^2 bins of directions. The choice of the emitter and points on surfaces are not guided.

Every strategy looks up the cell of a path's emission; within rounding of a cell's edge one strategy may get
the neighbour's density (1e-6 to 1e-4 of all paths).
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.emitters import Emitters
from ..emitters.records import Cell, Place
from ..emitters.tables import BELOW_ONE, cell_at

# Candidate cells per side, and the most cells of all tables: 24 x 24 still fits an environment and a sun (17
# tables).
SIDES = (24, 16, 8, 4)
MOST_CELLS = 9792

# Densities are quantized to 1/16 of a power of two, so that the order of summation does not change them.
_STEPS, _OFFSET = 16, 128


@dataclass(frozen=True)
class EmissionTables:
    """Density of emission relative to unguided emission, per cell and table.

    ``side``: cells per side; ``levels``: one byte per cell, table by table, compressed to text; ``left``:
    predicted share of the light subpaths' squared error that remains.
    """

    side: int
    left: float
    levels: str

    @staticmethod
    def of(densities: np.ndarray, left: float) -> EmissionTables:
        """Quantize ``densities``, shape (tables, side, side), all above 0."""
        levels = np.round(np.log2(densities) * _STEPS) + _OFFSET
        made = base64.b64encode(zlib.compress(np.clip(levels, 0, 255).astype(np.uint8).tobytes()))
        return EmissionTables(densities.shape[-1], float(f"{left:.3g}"), made.decode())

    def densities(self) -> np.ndarray:
        """Densities, shape (tables, side, side); the mean of each table is 1."""
        levels = np.frombuffer(zlib.decompress(base64.b64decode(self.levels)), np.uint8).reshape(
            -1, self.side, self.side
        )
        values = np.exp2((levels.astype(float) - _OFFSET) / _STEPS)
        return values / values.mean(axis=(1, 2), keepdims=True)

    def guided(self, emitters: Emitters) -> Emitters:
        """Return a copy of ``emitters`` that these tables guide."""
        densities = self.densities()
        first = _first_tables(emitters.tables, (densities != 1).any(axis=(1, 2)))
        return emitters.with_guide(EmissionGuide(self, first), [number > 0 for number in first])


def side_of(tables: int) -> int:
    """Cells per side of ``tables`` tables; 0 if these are too many."""
    return next((side for side in SIDES if tables * side**2 <= MOST_CELLS), 0) if tables else 0


def why_not(emitters: Emitters) -> str:
    """Why the emission of these ``emitters`` cannot be guided; empty if it can."""
    tables = sum(emitters.tables)
    if not tables:
        return "no emitter's directions can be guided: projectors and directionalarea have their own"
    if not side_of(tables):
        return f"{tables} tables would be needed, and {MOST_CELLS // SIDES[-1] ** 2} are the most"
    return ""


def _first_tables(counts: Sequence[int], used: np.ndarray) -> list[int]:
    """Index of each emitter's first table, from 1; 0 for emitters without, or with no ``used`` one."""
    last = np.cumsum(counts).tolist()
    pairs = zip(counts, last, strict=True)
    return [1 + end - own if used[end - own : end].any() else 0 for own, end in pairs]


class Cells:
    """Numbers the cells of all tables of ``emitters``, for a pilot.

    ``emitters``: the copy that it renders; ``count``: number of cells.
    """

    def __init__(self, emitters: Emitters):
        self.emitters = emitters.with_guide()
        tables = sum(emitters.tables)
        self.side = side_of(tables)
        self.count = tables * self.side**2
        self._first = mi.UInt32(_first_tables(emitters.tables, np.ones(tables, bool)))
        dr.make_opaque(self._first)

    def at(self, index: mi.UInt32, p, d, cos, active: mi.Bool) -> Cell:
        """Cells of emissions of the emitters ``index`` that pass ``p`` along ``d``.

        ``cos`` with the geometric normal.
        """
        first = dr.gather(mi.UInt32, self._first, index, active)
        place, factor = self.emitters.place(index, p, d, cos, self.side, active)
        table = dr.select(first > 0, first - 1 + place.bin, 0)
        return Cell(table * self.side**2 + cell_at(place.u, self.side), first > 0, factor)

    def of_hit(self, si, previous, active: mi.Bool) -> Cell:
        """Cell of the emission from the emitter point hit at ``si`` to ``previous``."""
        return self.at(*self.emitters.emission_of_hit(si, previous, active))


class EmissionGuide:
    """`EmissionTables` that a kernel can index.

    ``first``: see `_first_tables`; table 0 is uniform, for unguided emitters.
    """

    def __init__(self, tables: EmissionTables, first: list[int]):
        self.side, self._first = tables.side, mi.UInt32(first)
        densities = np.concatenate([np.ones((1, self.side, self.side)), tables.densities()])
        rows = densities.mean(axis=2)
        within = np.cumsum(densities, axis=2) / (rows[:, :, None] * self.side)
        below = np.cumsum(rows, axis=1) / self.side
        # Lists, not NumPy: Dr.Jit borrows an array's memory, and its alignment is part of the kernel.
        self._densities, self._within, self._below = (
            mi.Float(values.astype(np.float32).ravel().tolist()) for values in (densities, within, below)
        )
        dr.make_opaque(self._first, self._densities, self._within, self._below)

    def is_guided(self, index: mi.UInt32, active) -> mi.Bool:
        return dr.gather(mi.UInt32, self._first, index, active) > 0

    def _table(self, index: mi.UInt32, which: mi.UInt32, active) -> mi.UInt32:
        first = dr.gather(mi.UInt32, self._first, index, active)
        return dr.select(first > 0, first + which, 0)

    def density(self, index: mi.UInt32, place: Place, active) -> mi.Float:
        """Density of emission at ``place`` relative to unguided emission."""
        table = self._table(index, place.bin, active)
        return dr.gather(
            mi.Float, self._densities, table * self.side**2 + cell_at(place.u, self.side), active
        )

    def warp(self, index: mi.UInt32, which: mi.UInt32, u: mi.Point2f, active) -> tuple[mi.Point2f, mi.Float]:
        """Map uniform numbers to those of a table; also returns their relative density.

        ``which``: table of the emitter ``index``. The map is monotonic per dimension, which preserves
        stratification.
        """
        table = self._table(index, which, active)
        row, y = _found(self._below, table * self.side, self.side, u.y, active)
        row += table * self.side
        column, x = _found(self._within, row * self.side, self.side, u.x, active)
        density = dr.gather(mi.Float, self._densities, row * self.side + column, active)
        return mi.Point2f(x, y), density


def _found(sums: mi.Float, begin: mi.UInt32, side: int, u: mi.Float, active) -> tuple[mi.UInt32, mi.Float]:
    """Cell of a row with cumulative ``sums`` that contains ``u``; the warped number."""
    at = mi.UInt32(0)
    cells = side  # number of candidate cells from ``at`` on
    while cells > 1:
        step = cells // 2
        beyond = dr.gather(mi.Float, sums, begin + at + (step - 1), active) <= u
        at = dr.select(beyond, at + step, at)
        cells -= step
    low = dr.select(at > 0, dr.gather(mi.Float, sums, begin + dr.maximum(at, 1) - 1, active), 0)
    high = dr.gather(mi.Float, sums, begin + at, active)
    inside = dr.clip((u - low) / (high - low), 0, BELOW_ONE)
    return at, dr.minimum((mi.Float(at) + inside) / side, BELOW_ONE)
