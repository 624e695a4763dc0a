"""The one place where random numbers come from.

Every draw names its purpose and the vertex it serves, so that the point set can be exchanged:

* ``sobol``: Owen-scrambled Sobol' pairs for the purposes in `STRATIFIED` at every vertex: one
  sequence over all samples of the image in pixel order (all samples of a pixel are neighbours
  in it, so each pixel holds a net, and so does each power-of-two group of pixels). Draws of a subpath on
  which one contribution depends together, up to the second vertex, are joint points of several
  dimensions (`sobol.related`); further ones are joined vertex by vertex.
* ``independent``: hashed numbers throughout.

All else is hashed: a number is a function of seed, sample, vertex and purpose, so that no
generator's state is carried along a path.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import drjit as dr
import mitsuba as mi

from . import sobol


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
    FLIGHT = 12
    CHANNEL = 13
    TRACKING = 14


_PURPOSES = 16  # room per vertex in the numbering of dimensions
_GROUP = 15  # the place in it of what joint draws share
_SPREAD = 0x9E3779B1  # odd, so that dimensions stay distinct; spreads them over all bits
_SECOND = 0x85EBCA6B  # tells the second number of a pair from the first
_KEY = 0x27D4EB2F  # keeps the key of sample 0 from being 0

# Stratified draws, with their number in `sobol.related`; those with None have a shuffle of their own. The
# light samples of the first and second vertex may share a number: no contribution depends on both. Roulette
# and the draw of connections gain nothing on a Cornell box, joined or not, and a factor of 4 in a closed room
# where they are all the noise there is.
STRATIFIED = {
    "camera": {
        Purpose.FILM: 0,
        Purpose.APERTURE: 4,
        Purpose.EMITTER: 1,
        Purpose.BSDF: 2,
        Purpose.LOBE: 3,
        Purpose.ROULETTE: None,
        Purpose.CONNECTION: None,
        Purpose.FLIGHT: None,
    },
    "light": {
        Purpose.TIME: None,
        Purpose.WAVELENGTH: None,
        Purpose.EMISSION_POINT: 0,
        Purpose.EMISSION_DIRECTION: 1,
        Purpose.BSDF: 2,
        Purpose.LOBE: 3,
        Purpose.ROULETTE: None,
        Purpose.CONNECTION: None,
        Purpose.FLIGHT: None,
    },
}


@dataclass
class Stream:
    """The random numbers of one subpath; ``UInt32``, unchanged along the subpath.

    ``digits`` is its place in the Sobol' sequence (reversed index), ``seed`` the sequence's, ``key`` that of
    the hashed numbers.
    """

    digits: mi.UInt32
    seed: mi.UInt32
    key: mi.UInt32


class Points:
    """Hands out `Stream` objects and draws from them.

    ``kind`` one of `settings.POINTS`; ``seed`` the render's seed (``mi.UInt32``).
    """

    def __init__(self, kind: str, seed):
        self.kind = kind
        self.seed = seed

    def stream(self, side: str, index) -> Stream:
        """Numbers of one subpath.

        ``side`` is ``camera`` or ``light``; ``index`` (``UInt64``) the subpath's place in the image's
        sequence, unique over all passes.
        """
        side_seed = sobol.hash_u32(self.seed, mi.UInt32(1 if side == "light" else 2))
        low, seed = sobol.split_index(index, side_seed)
        # A bijection of the index: no two of 2^32 samples of a sequence share their numbers.
        return Stream(dr.brev(low), sobol.mix(seed), sobol.mix(low ^ _KEY))

    def draw_1d(self, side: str, stream: Stream, purpose: Purpose, vertex=0):
        """One number in [0, 1) for ``purpose`` at ``vertex`` (a Python or Dr.Jit integer)."""
        return self._draw(side, stream, purpose, vertex, 1)

    def draw_2d(self, side: str, stream: Stream, purpose: Purpose, vertex=0):
        """A point in [0, 1)^2 for ``purpose`` at ``vertex`` (a Python or Dr.Jit integer)."""
        return self._draw(side, stream, purpose, vertex, 2)

    def series(self, stream: Stream, purpose: Purpose, vertex, number=0) -> mi.UInt32:
        """The first word of a series of hashed numbers, for `sequential`; the ``number``-th of several."""
        word = sobol.mix(stream.key ^ _seed(stream, purpose, vertex))
        return word if isinstance(number, int) and number == 0 else sobol.mix(word + number)

    def _draw(self, side, stream, purpose, vertex, dims):
        # The seed is in the dimension's word, not in the key: else the hashed numbers of two dimensions
        # would be the same pairs for every seed, in another order.
        seed = _seed(stream, purpose, vertex)
        if self.kind == "sobol" and purpose in STRATIFIED[side]:
            digits = _digits(stream, purpose, vertex, STRATIFIED[side][purpose], seed)
            if dims == 1:
                return sobol.single_of(digits, seed)
            return mi.Point2f(*sobol.pair_of(digits, seed))
        return _hashed(sobol.mix(stream.key ^ seed), dims)


def _seed(stream, purpose, vertex):
    """Seed of a dimension."""
    return sobol.mix(stream.seed ^ (mi.UInt32(int(purpose)) + _PURPOSES * vertex) * _SPREAD)


def _digits(stream, purpose, vertex, number, seed):
    """Digit word of a stratified draw, see `STRATIFIED`."""
    if number is None:
        return sobol.shuffled(stream.digits, seed)
    # The light sample goes with the direction that led to its vertex.
    later = 1 if purpose is Purpose.EMITTER else 0
    group = mi.UInt32(vertex)
    group = dr.select(group <= 1 + later, 0, group - later)
    return sobol.related(sobol.shuffled(stream.digits, _seed(stream, _GROUP, group)), number)


def _hashed(word, dims):
    if dims == 1:
        return _to_unit(word)
    return mi.Point2f(_to_unit(word), _to_unit(sobol.mix(word ^ _SECOND)))


def sequential(word: mi.UInt32) -> tuple[mi.Float, mi.UInt32]:
    """One number in [0, 1) of a series, and the word of the next one; `Points.series` has the first."""
    return _to_unit(sobol.mix(word)), word + _SPREAD


def _to_unit(word):
    return mi.Float(mi.Int32(word >> 8)) * (2.0**-24)
