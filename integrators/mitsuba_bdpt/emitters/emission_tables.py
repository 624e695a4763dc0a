"""Guided emission: tables of the densities with which emitters' light subpaths set out.

Emission draws its directions (light from infinity: its points on a disk) from two primary numbers. A table
over their square says how many times as dense as the emitter itself one is in each cell; its mean is 1. What
the square of an emitter means is known to the emitter's group, see `group.Group.place`. A sky has a table for
each of `SKY_BINS` bins of directions. The choice of the emitter is not guided, nor are points on surfaces.

Everything that makes a path has to know the cell of its emission: one that lies within rounding of an edge of
its cell may get the neighbour's density from one strategy (1e-6 to 1e-4 of all paths).
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import asdict, dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

# Cells of a table in each direction, and of all tables together at most; else tables are smaller. (Those of a
# sky and a sun, 17, still have 24 x 24.)
SIDES = (24, 16, 8, 4)
MOST_CELLS = 9792

# Bins of directions in each of two dimensions for which light from a sky has tables of its own.
SKY_BINS = 4

# Densities are kept to 1 / 16 of a power of two: how lanes are added up does not change them.
_STEPS, _OFFSET = 16, 128

# Share of the directions of a curved area light that are not by its table but by the cosine.
PLAIN = 0.25

# The largest number below 1.
_BELOW_ONE = 1 - 2**-24


@dataclass(frozen=True)
class EmissionTables:
    """How many times as dense as by itself emission is in each cell of each table.

    ``levels``: a byte for each cell, table by table, of ``side`` x ``side`` cells, packed as text; ``left``:
    what is predicted to be left of the squared error of light subpaths.
    """

    side: int
    left: float
    levels: str

    @staticmethod
    def of(densities: np.ndarray, left: float) -> EmissionTables:
        """Those of ``densities``, shape (tables, side, side), all above 0."""
        levels = np.round(np.log2(densities) * _STEPS) + _OFFSET
        made = base64.b64encode(zlib.compress(np.clip(levels, 0, 255).astype(np.uint8).tobytes()))
        return EmissionTables(densities.shape[-1], float(f"{left:.3g}"), made.decode())

    def densities(self) -> np.ndarray:
        """Shape (tables, side, side); the mean of each table is 1."""
        levels = np.frombuffer(_unpacked(self.levels), np.uint8).reshape(-1, self.side, self.side)
        values = np.exp2((levels.astype(float) - _OFFSET) / _STEPS)
        return values / values.mean(axis=(1, 2), keepdims=True)

    def record(self) -> dict[str, int | float | str]:
        """As JSON holds them."""
        return asdict(self)

    @staticmethod
    def read(record: Any) -> EmissionTables:
        """What was `record`-ed; raises ``ValueError`` or ``TypeError`` for anything else."""
        if not isinstance(record, dict) or set(record) != {"side", "left", "levels"}:
            raise TypeError(f"emission={record!r} is no table of emission")
        side, left, levels = (record[name] for name in ("side", "left", "levels"))
        if side not in SIDES or not isinstance(side, int):
            raise ValueError(f"emission: side={side!r}")
        if isinstance(left, bool) or not isinstance(left, (int, float)) or not 0 < left <= 1:
            raise ValueError(f"emission: left={left!r}")
        try:
            cells = len(_unpacked(levels))
        except (zlib.error, TypeError, ValueError) as error:
            raise ValueError(f"emission: levels: {error}") from error
        if not 0 < cells <= MOST_CELLS or cells % side**2:
            raise ValueError(f"emission: levels holds {cells} cells")
        return EmissionTables(side, float(left), levels)


def _unpacked(levels: str) -> bytes:
    return zlib.decompressobj().decompress(base64.b64decode(levels, validate=True), MOST_CELLS + 1)


def side_of(tables: int) -> int:
    """Cells in each direction of each of so many tables; 0 if these are too many."""
    return next((side for side in SIDES if tables * side**2 <= MOST_CELLS), 0) if tables else 0


@dataclass
class Place:
    """Where an emission lies: in which of its emitter's tables (``bin``), and where in the square (``u``)."""

    bin: mi.UInt32
    u: mi.Point2f


@dataclass
class Factor:
    """By what a table changes the density of an emission: to ``kept`` + ``scaled`` r times its own."""

    scaled: mi.Float
    kept: mi.Float

    @staticmethod
    def whole() -> Factor:
        """All of it is by the table."""
        return Factor(mi.Float(1), mi.Float(0))


@dataclass
class Cell:
    """Where an emission lies among all tables.

    ``number`` of its cell, whether its emitter has a table (``known``), and the `Factor`.
    """

    number: mi.UInt32
    known: mi.Bool
    factor: Factor


def cell_at(u: mi.Point2f, side: int) -> mi.UInt32:
    """The number of the cell at ``u`` in a table of ``side`` x ``side``."""
    at = mi.Point2u(dr.clip(u, 0, _BELOW_ONE) * side)
    return mi.UInt32(dr.minimum(at.y, side - 1) * side + dr.minimum(at.x, side - 1))


class EmissionGuide:
    """`EmissionTables` that a kernel can index.

    ``first`` table of each emitter, from 1 on: table 0 is that of emitters that are not guided, uniform.
    """

    def __init__(self, tables: EmissionTables, first: mi.UInt32):
        self.side, self._first = tables.side, first
        densities = np.concatenate([np.ones((1, self.side, self.side)), tables.densities()])
        rows = densities.mean(axis=2)
        within = np.cumsum(densities, axis=2) / (rows[:, :, None] * self.side)
        below = np.cumsum(rows, axis=1) / self.side
        # Lists, not NumPy: Dr.Jit borrows an array's memory, and its alignment is part of the kernel.
        self._densities, self._within, self._below = (
            mi.Float(values.astype(np.float32).ravel().tolist()) for values in (densities, within, below)
        )
        dr.make_opaque(self._densities, self._within, self._below)

    def is_guided(self, index: mi.UInt32, active) -> mi.Bool:
        """Mask: the emitter of this ``index`` has tables."""
        return dr.gather(mi.UInt32, self._first, index, active) > 0

    def _table(self, index: mi.UInt32, which: mi.UInt32, active) -> mi.UInt32:
        first = dr.gather(mi.UInt32, self._first, index, active)
        return dr.select(first > 0, first + which, 0)

    def density(self, index: mi.UInt32, place: Place, active) -> mi.Float:
        """How many times as dense as by itself the emission of the emitter ``index`` is at ``place``."""
        table = self._table(index, place.bin, active)
        return dr.gather(
            mi.Float, self._densities, table * self.side**2 + cell_at(place.u, self.side), active
        )

    def warp(self, index: mi.UInt32, which: mi.UInt32, u: mi.Point2f, active) -> tuple[mi.Point2f, mi.Float]:
        """Primary numbers as the table ``which`` of the emitter ``index`` distributes them, for uniform ones.

        Also their density. Neighbours stay neighbours: points that are well distributed stay so.
        """
        table = self._table(index, which, active)
        row, y = _found(self._below, table * self.side, self.side, u.y, active)
        row += table * self.side
        column, x = _found(self._within, row * self.side, self.side, u.x, active)
        density = dr.gather(mi.Float, self._densities, row * self.side + column, active)
        return mi.Point2f(x, y), density


def _found(sums: mi.Float, begin: mi.UInt32, side: int, u: mi.Float, active) -> tuple[mi.UInt32, mi.Float]:
    """The cell of a row of cells with these ``sums`` in which ``u`` lies, and the number there in [0, 1)."""
    at = mi.UInt32(0)
    cells = side  # in which it may lie, from ``at`` on
    while cells > 1:
        step = cells // 2
        beyond = dr.gather(mi.Float, sums, begin + at + (step - 1), active) <= u
        at = dr.select(beyond, at + step, at)
        cells -= step
    low = dr.select(at > 0, dr.gather(mi.Float, sums, begin + dr.maximum(at, 1) - 1, active), 0)
    high = dr.gather(mi.Float, sums, begin + at, active)
    inside = dr.clip((u - low) / (high - low), 0, _BELOW_ONE)
    return at, dr.minimum((mi.Float(at) + inside) / side, _BELOW_ONE)
