"""The one place where random numbers come from.

Every draw names its purpose and the vertex it serves, so that the first dimensions can be taken
from a better point set than independent numbers:

* ``sobol``: Owen-scrambled Sobol' pairs, padded: one sequence over all samples of the image in
  pixel order (all samples of a pixel are neighbours in it, so each pixel holds a net, and so does
  each power-of-two group of pixels).
* ``sampler``: the scene's own sampler.
* ``independent``: PCG32 throughout.

The dimensions behind `STRATIFIED` always are independent: structure far down a path does not pay,
and Mitsuba's stratified samplers correlate pairs of dimensions (0.95 for ``stratified`` at 16
samples), which roulette and light choice would turn into visible structure.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import drjit as dr
import mitsuba as mi

from . import sobol

POINTS = ("sobol", "sampler", "independent")


class Purpose(IntEnum):
    """What a random number decides; together with the vertex it names a dimension."""

    FILM = 0
    APERTURE = 1
    TIME = 2
    WAVELENGTH = 3
    EMITTER = 4
    BSDF = 5
    LOBE = 6
    EMISSION_POINT = 7
    EMISSION_DIRECTION = 8
    ROULETTE = 9
    CONNECTION = 10
    LENS = 11


_PURPOSES = 16  # room per vertex in the numbering of dimensions

# Up to which vertex a purpose is stratified. Measured on a Cornell box: gains come from film,
# emission, first light sample and the first bounces; beyond the third there are none.
STRATIFIED = {
    "camera": {
        Purpose.FILM: 0,
        Purpose.APERTURE: 0,
        Purpose.EMITTER: 3,
        Purpose.BSDF: 3,
        Purpose.LOBE: 3,
    },
    "light": {
        Purpose.TIME: 0,
        Purpose.WAVELENGTH: 0,
        Purpose.EMISSION_POINT: 0,
        Purpose.EMISSION_DIRECTION: 0,
        Purpose.BSDF: 1,
        Purpose.LOBE: 1,
    },
}

# What the scene's sampler provides, in this order: (side, purpose, vertex, dimensions).
_SAMPLER_TABLE = (
    ("camera", Purpose.FILM, 0, 2),
    ("camera", Purpose.APERTURE, 0, 2),
    ("camera", Purpose.EMITTER, 1, 2),
    ("camera", Purpose.BSDF, 1, 2),
    ("camera", Purpose.LOBE, 1, 1),
    ("light", Purpose.TIME, 0, 1),
    ("light", Purpose.WAVELENGTH, 0, 1),
    ("light", Purpose.EMISSION_POINT, 0, 2),
    ("light", Purpose.EMISSION_DIRECTION, 0, 2),
    ("light", Purpose.BSDF, 1, 2),
    ("light", Purpose.LOBE, 1, 1),
)


@dataclass
class Stream:
    """State of one subpath's numbers: ``rng`` for independent ones, ``index`` and ``seed`` into the
    Sobol' sequence, ``first`` the scene sampler's numbers by (purpose, vertex)."""

    rng: object
    index: object
    seed: object
    first: dict


class Points:
    """Hands out `Stream` objects and draws from them.

    ``kind`` one of `POINTS`; ``seed`` the render's seed (``mi.UInt32``); ``sampler`` the scene's
    sampler, seeded for the pass (only for ``kind="sampler"``).
    """

    def __init__(self, kind: str, seed, sampler=None):
        self.kind = kind
        self.seed = seed
        self._table = None
        if kind == "sampler":
            self._table = [
                sampler.next_1d() if dims == 1 else sampler.next_2d() for _, _, _, dims in _SAMPLER_TABLE
            ]
            dr.eval(self._table)

    def stream(self, side: str, index, slot) -> Stream:
        """Numbers of one subpath.

        ``side`` is ``camera`` or ``light``; ``index`` (``UInt64``) the subpath's place in the image's
        sequence, unique over all passes; ``slot`` its place in this pass.
        """
        side_seed = sobol.hash_u32(self.seed, mi.UInt32(1 if side == "light" else 2))
        low, seed = sobol.split_index(index, side_seed)
        state = mi.sample_tea_64(low, seed)
        rng = mi.PCG32(1, state, mi.UInt64(low) << 32 | mi.UInt64(seed))
        first = {}
        if self._table is not None:
            for (owner, purpose, vertex, dims), values in zip(_SAMPLER_TABLE, self._table, strict=True):
                if owner == side:
                    kind = mi.Float if dims == 1 else mi.Point2f
                    first[f"{purpose.name}{vertex}"] = dr.gather(kind, values, slot)
        return Stream(rng, low, seed, first)

    def draw_1d(self, side: str, stream: Stream, purpose: Purpose, vertex=0):
        """One number in [0, 1) for ``purpose`` at ``vertex`` (a Python or Dr.Jit integer)."""
        return self._draw(side, stream, purpose, vertex, 1)

    def draw_2d(self, side: str, stream: Stream, purpose: Purpose, vertex=0):
        """A point in [0, 1)^2 for ``purpose`` at ``vertex`` (a Python or Dr.Jit integer)."""
        return self._draw(side, stream, purpose, vertex, 2)

    def _draw(self, side, stream, purpose, vertex, dims):
        independent = _independent(stream.rng, dims)
        limit = STRATIFIED[side].get(purpose)
        if limit is None or self.kind == "independent":
            return independent
        if self.kind == "sampler":
            for at in range(limit + 1):
                if (value := stream.first.get(f"{purpose.name}{at}")) is not None:
                    independent = _choose(vertex, at, at, value, independent)
            return independent
        dimension = sobol.hash_u32(stream.seed, mi.UInt32(int(purpose) + _PURPOSES * vertex))
        if dims == 1:
            value = sobol.scrambled_single(stream.index, dimension)
        else:
            value = mi.Point2f(*sobol.scrambled_pair(stream.index, dimension))
        return _choose(vertex, 0, limit, value, independent)


def _independent(rng, dims):
    if dims == 1:
        return rng.next_float32()
    return mi.Point2f(rng.next_float32(), rng.next_float32())


def _choose(vertex, first, last, inside, outside):
    """``inside`` where first <= vertex <= last."""
    if isinstance(vertex, int):
        return inside if first <= vertex <= last else outside
    return dr.select((vertex >= first) & (vertex <= last), inside, outside)
