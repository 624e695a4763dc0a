"""Fits `EmissionTables` to a pilot.

docs/method/method.md, "Guided emission", derives the second moment under a table from samples without one,
and the fixed point that minimizes it; v, q, l, D and r are as there, alpha and beta are `Factor.kept` and
`scaled`. Tables of noise destroy the stratification gain: those of one half of a pilot have to gain on the
other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.records import Cell
from .tables import EmissionTables

HALVES, CLASSES = 2, 8  # halves of a pilot, and classes of l / (1 - l), a factor of four apart

# Columns of a cell: the classes, then the second moments without tables, times l and whole.
BEFORE = 2
COLUMNS = CLASSES + BEFORE

# Representative l / (1 - l), and l, of the classes.
ODDS = 4.0 ** (np.arange(CLASSES) - (CLASSES - 1) / 2)
_SHARES = ODDS / (1 + ODDS)

# Lower bounds of the relative density: 1 / 0.25 is the largest factor by which a contribution can grow.
LEAST = (0.5, 0.25)

# Most that may remain of second moments (times l): geometric mean of all cells and of all but `WORST`.
PAYS = 0.93

WORST = 0.02  # share of cells left out of the second judgement: outliers

# Emitters with less than this share of the total gain get no tables: lookups cost time at each vertex.
PART = 0.01

# Blurs of accumulated tables by their side: the first that pays, if the last pays. One half of a pilot
# judging tables of the other prefers smoother tables than the whole pilot does.
BLURS = {24: (1, 3), 16: (1, 2), 8: (1,), 4: (1,)}

_STEPS = 16  # iterations of the fixed point


class EmissionStatistics:
    """Accumulates emission statistics of a pilot, per film tile and cell of the tables.

    Per cell: v^2 / D by class, then v^2 without tables, times l and whole (`BEFORE`).
    """

    def __init__(self, tiles: int, cells: int):
        self._shape = HALVES, tiles, cells, COLUMNS
        self._sums = dr.zeros(mi.Float64, int(np.prod(self._shape)))
        dr.make_opaque(self._sums)

    def accumulate(
        self,
        shares: mi.Vector4f,
        cell: Cell,
        tile: mi.UInt32,
        half: mi.UInt32,
        square: mi.Float64,
        active: mi.Bool,
    ):
        """Accumulate a contribution with squared size ``square``.

        ``shares``: see `Contribution`. Ignores paths that no light subpath can sample.
        """
        hit, direct, light, inner = shares  # pyright: ignore[reportGeneralTypeIssues]
        share = (light + inner) / (hit + direct + light + inner)
        active = active & cell.known & (share > 0)
        rest = 1 - share + share * cell.factor.kept
        scaled = share * cell.factor.scaled
        odds = dr.log2(scaled / rest) / 2 + CLASSES / 2
        kind = mi.UInt32(dr.clip(odds, 0, CLASSES - 1))
        _, tiles, cells, _ = self._shape
        place = ((half * tiles + tile) * cells + cell.number) * COLUMNS
        even, of_table = square / (rest + scaled), square * (scaled / (rest + scaled))
        for column, value in ((kind, even), (CLASSES, of_table), (CLASSES + 1, square)):
            dr.scatter_reduce(dr.ReduceOp.Add, self._sums, value, place + column, active)

    def evaluated(self) -> np.ndarray:
        """Emission statistics of shape (`HALVES`, tiles, cells, `COLUMNS`)."""
        return np.array(self._sums).reshape(self._shape)


@dataclass(frozen=True)
class Learnt:
    """Fitted ``tables``, or None without gain, and the ratios of second moments with and without them.

    ``variance_ratio``: of strategies whose light subpath chooses the emission; ``whole``: of all strategies.
    """

    tables: EmissionTables | None
    variance_ratio: float = 1.0
    whole: float = 1.0


def learn(statistics: np.ndarray, side: int, counts: Sequence[int]) -> Learnt:
    """Fit tables to emission statistics of shape (`HALVES`, cells, `COLUMNS`).

    Tables have ``side`` x ``side`` cells; ``counts``: number of tables per emitter. Uses the first of `BLURS`
    that pays, if the last one pays.
    """
    statistics = statistics.reshape(HALVES, -1, side, side, COLUMNS)
    if not statistics.any() or not np.isfinite(statistics).all():
        return Learnt(None)
    ways = [_learnt(statistics, times, counts) for times in BLURS[side]]
    return ways[-1] if ways[-1].tables is None else next(way for way in ways if way.tables is not None)


def _learnt(statistics: np.ndarray, times: int, counts: Sequence[int]) -> Learnt:
    """Fit tables to statistics blurred ``times`` times."""
    halves = [_fitted(half, times) for half in statistics]
    guided = _worth_a_table(statistics, halves, counts)
    judged: dict[float, Learnt] = {}
    for a in LEAST:
        found = [_left(statistics[1 - i], a + (1 - a) * halves[i], guided) for i in range(HALVES)]
        left, whole = np.mean(found, axis=0)
        if left.max() < 1:
            judged[a] = Learnt(None, float(np.sqrt(left.prod())), float(np.sqrt(whole.prod())))
    best = min(judged.values(), key=lambda learnt: learnt.variance_ratio, default=Learnt(None))
    if best.variance_ratio >= PAYS:
        return best
    least = next(a for a, learnt in judged.items() if learnt is best)
    densities = least + (1 - least) * _fitted(statistics.sum(axis=0), times)
    densities[~guided] = 1
    return replace(best, tables=EmissionTables.of(densities, best.variance_ratio))


def _worth_a_table(statistics: np.ndarray, halves: list[np.ndarray], counts: Sequence[int]) -> np.ndarray:
    """Mask of the tables whose emitter contributes to the gain, cross-validated."""
    a = LEAST[-1]
    saved = sum(
        half[..., CLASSES] - _light_side(half, a + (1 - a) * taught)
        for half, taught in zip(statistics, halves[::-1], strict=True)
    )
    last = np.cumsum(counts)
    own = [max(saved[end - count : end].sum(), 0) for count, end in zip(counts, last, strict=True)]
    return np.repeat([one > 0 and one >= PART * sum(own) for one in own], counts)


def left_out(learnt: Learnt) -> list[dict[str, str]]:
    """Why what was ``learnt`` is not used, as in ``statistics["skipped"]``."""
    ratio = f"{learnt.variance_ratio:.0%}"
    why = f"in the pilot, tables leave {ratio} of the squared error of strategies with light subpaths"
    why += f"; they are used below {PAYS:.0%}" if learnt.tables is None else "; path tracing alone is better"
    return [{"class": "guided emission", "level": "not worth its cost here", "why": why}]


def _fitted(statistics: np.ndarray, times: int) -> np.ndarray:
    """The best densities for ``statistics`` blurred ``times`` times.

    Shape (tables, side, side, `COLUMNS`); 1 in tables without statistics.
    """
    squares = statistics[..., :CLASSES]
    for _ in range(times):
        squares = _blurred(squares)
    known = squares.any(axis=-1)  # under a sky 5 % of the cells
    table, squares = np.nonzero(known)[0], squares[known]
    density = np.ones(len(squares))
    for _ in range(_STEPS):
        density = density * np.sqrt((squares * _SHARES / _totals(density) ** 2).sum(axis=-1))
        mean = np.bincount(table, density, len(known)) / known[0].size
        density = density / np.where(mean > 0, mean, 1)[table]
    fitted = np.zeros(known.shape)
    fitted[known] = density
    fitted[~fitted.any(axis=(1, 2))] = 1
    return fitted


def _blurred(squares: np.ndarray) -> np.ndarray:
    """Blur each cell with its neighbours, 1 : 2 : 1 in both directions."""
    for axis in (1, 2):
        pad = [(0, 0)] * squares.ndim
        pad[axis] = (1, 1)
        wide = np.pad(squares, pad, mode="edge")
        first, middle, last = (np.take(wide, range(i, i + squares.shape[axis]), axis) for i in range(3))
        squares = (first + 2 * middle + last) / 4
    return squares


def _totals(density: np.ndarray) -> np.ndarray:
    """1 - l + l r of each cell and class."""
    return 1 - _SHARES + density[..., None] * _SHARES


def _light_side(statistics: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Second moments of the light-side strategies with these densities."""
    return (statistics[..., :CLASSES] * _SHARES / _totals(density)).sum(axis=-1)


def _left(statistics: np.ndarray, density: np.ndarray, guided: np.ndarray) -> np.ndarray:
    """Ratios of second moments with and without the tables that are ``guided``, shape (2, 2).

    Rows: times l, and whole; columns: of all cells, and of all but `WORST` of the nonempty ones.
    """
    whole = (statistics[..., :CLASSES] / _totals(density)).sum(axis=-1)
    before = [statistics[..., CLASSES + i] for i in range(BEFORE)]
    after = [
        np.where(guided[:, None, None], changed, same)
        for changed, same in zip((_light_side(statistics, density), whole), before, strict=True)
    ]
    some = np.flatnonzero(before[0])
    kept = some[np.argsort(before[0].ravel()[some])[: int(len(some) * (1 - WORST))]]
    sums = np.array([[[v.sum(), v.ravel()[kept].sum()] for v in of] for of in (before, after)])
    return np.where(sums[0] > 0, sums[1] / np.where(sums[0] > 0, sums[0], 1), 1)
