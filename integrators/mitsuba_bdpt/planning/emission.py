# pyright: strict, reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportUnknownArgumentType=false
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
"""Learns from a pilot where light subpaths should set out to: `emission_tables.EmissionTables`.

A contribution of the pilot with the weighted size v lies on a path whose emission is in some cell of the
tables, whichever strategy has made it; l is the share in the sum of its densities of those strategies whose
light subpath chooses that emission (t <= 1, inner). With r times as many emissions in the cell its second
moment is v^2 / (1 - l + r l), of the balance heuristic, so that the gain of any table is known from samples
without one. The best one, of those of mean 1 in each table, is the fixed point of r^2 <- r^2 sum of
v^2 l / (1 - l + r l)^2. (E. Veach 1997, section 9.2; of that kind are S. Grittmann et al. 2018, and P. Dutre
and Y. Willems 1995, who have no l.)

A table that noise has made destroys what points achieve, so one that half of a pilot has taught has to gain
on the other half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.emission_tables import EmissionTables
from ..sensors.records import Region
from ..transport.contribution import Contribution
from .configuration import Configuration
from .moments import HEARD_TILES, group

# Halves of a pilot, and classes of l / (1 - l), each four times the one before.
HALVES, CLASSES = 2, 8

# What l / (1 - l) is in the classes, about.
ODDS = 4.0 ** (np.arange(CLASSES) - (CLASSES - 1) / 2)

# Densities are this or more: 1 / 0.25 is the most by which a contribution can rise.
LEAST = (0.5, 0.25)

# What has to be left of the second moment of light-side strategies at most, the worst cells included or not.
PAYS = 0.9

# Cells that are left out of the second judgement: in `glass_caustics` second moments are outliers.
WORST = 0.02

# Tables of an emitter that has less than this part in what all save are left out: looking densities up takes
# time at every vertex. (In `ring_caustic` those of the sky have 0.004.)
PART = 0.01

# Steps towards the fixed point.
_STEPS = 16


class Listener:
    """Sums of what a pilot's contributions tell about their emissions, of ``cells`` cells of all tables."""

    def __init__(self, region: Region, cells: int):
        self._region, self.cells = region, cells
        self._sums = dr.zeros(mi.Float64, HALVES * HEARD_TILES**2 * cells * CLASSES)
        dr.make_opaque(self._sums)

    def hear(
        self, c: Contribution, position: mi.Point2f, lane: mi.UInt32, square: mi.Float64, active: mi.Bool
    ):
        """Add a contribution of this squared size to the ``position`` on the film, where ``active``."""
        hit, direct, light, inner = c.shares  # pyright: ignore[reportGeneralTypeIssues]
        odds = dr.log2((light + inner) / (hit + direct)) / 2 + CLASSES / 2
        kind = mi.UInt32(dr.clip(odds, 0, CLASSES - 1))
        uv = dr.clip(self._region.to_uv(position), 0, 1)
        xy = dr.minimum(mi.Point2u(uv * HEARD_TILES), HEARD_TILES - 1)
        part = (group(lane) % HALVES) * HEARD_TILES**2 + xy.y * HEARD_TILES + xy.x
        cell, known = c.emission  # pyright: ignore[reportGeneralTypeIssues]
        place = (part * self.cells + cell) * CLASSES + kind
        dr.scatter_reduce(dr.ReduceOp.Add, self._sums, square, place, active & known)

    def evaluated(self) -> np.ndarray:
        """Shape (`HALVES`, tiles, cells, `CLASSES`)."""
        return np.array(self._sums).reshape(HALVES, HEARD_TILES**2, self.cells, CLASSES)


@dataclass(frozen=True)
class Learnt:
    """What a pilot has taught: ``tables`` that gain, or None, and what they leave of second moments.

    ``left`` of those of strategies whose light subpath chooses the emission, ``whole`` of those of all.
    """

    tables: EmissionTables | None
    left: float = 1.0
    whole: float = 1.0


def learn(heard: np.ndarray, side: int, counts: Sequence[int]) -> Learnt:
    """What a pilot teaches that has ``heard`` this, see `moments.Moments`.

    Tables have ``side`` x ``side`` cells; ``counts`` of each emitter's.
    """
    heard = heard.reshape(HALVES, -1, side, side, CLASSES)
    if not heard.any() or not np.isfinite(heard).all():
        return Learnt(None)
    halves = [_fitted(half) for half in heard]
    judged: dict[float, Learnt] = {}
    for a in LEAST:
        found = [_left(heard[1 - i], a + (1 - a) * halves[i]) for i in range(HALVES)]
        left, whole = np.mean(found, axis=0)
        if left.max() < 1:
            judged[a] = Learnt(None, float(np.sqrt(left.prod())), float(np.sqrt(whole.prod())))
    best = min(judged.values(), key=lambda learnt: learnt.left, default=Learnt(None))
    if best.left >= PAYS:
        return best
    least = next(a for a, learnt in judged.items() if learnt is best)
    densities = least + (1 - least) * _fitted(heard.sum(axis=0))
    _leave_alone(densities, heard.sum(axis=0), counts)
    return replace(best, tables=EmissionTables.of(densities, least, best.left))


def _leave_alone(densities: np.ndarray, squares: np.ndarray, counts: Sequence[int]):
    """Turn tables of emitters that have little part in what is saved into those of none."""
    share = ODDS / (1 + ODDS)
    saved = squares * share * (1 - 1 / (1 - share + densities[..., None] * share))
    last = np.cumsum(counts)
    of_emitters = [saved[end - count : end].sum() for count, end in zip(counts, last, strict=True)]
    for count, end, own in zip(counts, last, of_emitters, strict=True):
        if own < PART * sum(of_emitters):
            densities[end - count : end] = 1


def left_out(chosen: Configuration, learnt: Learnt | None) -> list[dict[str, str]]:
    """Why what was ``learnt`` is not used by the ``chosen`` way, as in ``statistics["skipped"]``."""
    if learnt is None or chosen.emission is not None:
        return []
    why = f"in the pilot tables leave {learnt.left:.0%} of light subpaths' part of the squared error"
    why += (
        f", and less than {PAYS:.0%} would pay" if learnt.tables is None else "; path tracing alone is better"
    )
    return [{"class": "guided emission", "level": "not worth its cost here", "why": why}]


def left_by(tables: EmissionTables, heard: np.ndarray) -> float:
    """What ``tables`` leave of the second moment of light-side strategies in all that was ``heard``."""
    whole = heard.reshape(HALVES, -1, tables.side, tables.side, CLASSES).sum(axis=0)
    return float(np.sqrt(_left(whole, tables.densities())[0].prod()))


def _fitted(squares: np.ndarray) -> np.ndarray:
    """The best densities for these sums of v^2, shape (tables, side, side, `CLASSES`)."""
    squares = _blurred(squares)
    share = ODDS / (1 + ODDS)
    density = np.ones(squares.shape[:-1])
    for _ in range(_STEPS):
        total = 1 - share + density[..., None] * share
        density = density * np.sqrt((squares * share / total**2).sum(axis=-1))
        mean = density.mean(axis=(1, 2), keepdims=True)
        density = np.where(mean > 0, density / np.where(mean > 0, mean, 1), 1)
    return density


def _blurred(squares: np.ndarray) -> np.ndarray:
    """Each cell with its neighbours, as 1 : 2 : 1 in both directions: 4,096 samples are few for 256 cells."""
    for axis in (1, 2):
        pad = [(0, 0)] * squares.ndim
        pad[axis] = (1, 1)
        wide = np.pad(squares, pad, mode="edge")
        first, middle, last = (np.take(wide, range(i, i + squares.shape[axis]), axis) for i in range(3))
        squares = (first + 2 * middle + last) / 4
    return squares


def _left(squares: np.ndarray, density: np.ndarray) -> np.ndarray:
    """What is left of second moments, shape (2, 2).

    Of light-side strategies and of all; of all cells and without `WORST`.
    """
    share = ODDS / (1 + ODDS)
    after = squares / (1 - share + density[..., None] * share)
    light = [(values * share).sum(axis=-1).ravel() for values in (squares, after)]
    whole = [values.sum(axis=-1).ravel() for values in (squares, after)]
    kept = np.argsort(light[0])[: int(np.ceil(len(light[0]) * (1 - WORST)))]
    sums = np.array(
        [[[values[cells].sum() for cells in (slice(None), kept)] for values in of] for of in (light, whole)]
    )
    before, left = sums[:, 0], sums[:, 1]
    return np.where(before > 0, left / np.where(before > 0, before, 1), 1)
