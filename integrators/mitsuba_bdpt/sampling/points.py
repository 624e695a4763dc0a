"""Random numbers of subpaths: the only source of them in a render.

Every draw names its purpose and its vertex, so that the point set can be exchanged (`settings.POINTS`):

* ``sobol``: Owen-scrambled Sobol' points for the purposes in `STRATIFIED`, in one sequence over all samples
  of the image in pixel order, so that each pixel, and each aligned power-of-two group of pixels, holds a net.
  Draws up to the second vertex of a subpath are joint points of several dimensions (`sobol.related`); later
  draws are joint per vertex.
* ``independent``: hashed numbers throughout.

All other numbers are hashes of seed, sample, vertex and purpose: no generator state is carried along a path.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import drjit as dr
import mitsuba as mi

from . import sobol


class Purpose(IntEnum):
    """The decision that a random number makes; with the vertex it names a dimension."""

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


_PURPOSES = 16  # dimensions reserved per vertex
_GROUP = 15  # dimension of the shuffle that joint draws share
_SPREAD = 0x9E3779B1  # odd, so that dimensions stay distinct
_SECOND = 0x85EBCA6B  # separates the second number of a pair from the first
_KEY = 0x27D4EB2F  # keeps the key of sample 0 nonzero

# Stratified draws and their number in `sobol.related`; None: a shuffle of its own. The light samples of the
# first and second vertex may share a number: no contribution depends on both.
_ALONE = dict.fromkeys((Purpose.ROULETTE, Purpose.CONNECTION, Purpose.FLIGHT))
_OF_BOTH: dict[Purpose, int | None] = {Purpose.BSDF: 2, Purpose.LOBE: 3} | _ALONE
_EMISSION = {Purpose.EMISSION_POINT: 0, Purpose.EMISSION_DIRECTION: 1}
STRATIFIED = {
    "camera": _OF_BOTH | {Purpose.FILM: 0, Purpose.APERTURE: 4, Purpose.EMITTER: 1},
    "light": _OF_BOTH | _EMISSION | dict.fromkeys((Purpose.TIME, Purpose.WAVELENGTH)),
}


@dataclass
class Stream:
    """Random numbers of one subpath, ``UInt32``, constant along the subpath.

    ``digits``: reversed index in the Sobol' sequence; ``seed`` of the sequence; ``key`` of hashes.
    """

    digits: mi.UInt32
    seed: mi.UInt32
    key: mi.UInt32


class Points:
    """Creates `Stream` objects and draws from them.

    ``kind``: one of `settings.POINTS`; ``seed`` of the render (``mi.UInt32``).
    """

    def __init__(self, kind: str, seed):
        self.kind = kind
        self.seed = seed

    def stream(self, side: str, index) -> Stream:
        """Return the stream of one subpath.

        ``side`` is ``camera`` or ``light``; ``index`` (``UInt64``) is the subpath's index in the image's
        sequence, unique over all passes.
        """
        side_seed = sobol.hash_u32(self.seed, mi.UInt32(1 if side == "light" else 2))
        low, seed = sobol.split_index(index, side_seed)
        # A bijection of the index: no two samples of a sequence of 2^32 share a key.
        return Stream(dr.brev(low), sobol.mix(seed), sobol.mix(low ^ _KEY))

    def draw_1d(self, side: str, stream: Stream, purpose: Purpose, vertex=0):
        """Return a number in [0, 1); ``vertex`` is a Python or Dr.Jit integer."""
        return self._draw(side, stream, purpose, vertex, 1)

    def draw_2d(self, side: str, stream: Stream, purpose: Purpose, vertex=0):
        """Return a point in [0, 1)^2; ``vertex`` is a Python or Dr.Jit integer."""
        return self._draw(side, stream, purpose, vertex, 2)

    def series(self, stream: Stream, purpose: Purpose, vertex, number=0) -> mi.UInt32:
        """Return the first word of series ``number`` of hashed numbers (`sequential`)."""
        word = sobol.mix(stream.key ^ _seed(stream, purpose, vertex))
        return word if isinstance(number, int) and number == 0 else sobol.mix(word + number)

    def _draw(self, side, stream, purpose, vertex, dims):
        # The seed enters the dimension's word, not the key: otherwise the hashed numbers of two dimensions
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
    # A light sample belongs to the group of the direction that led to its vertex.
    later = 1 if purpose is Purpose.EMITTER else 0
    group = mi.UInt32(vertex)
    group = dr.select(group <= 1 + later, 0, group - later)
    return sobol.related(sobol.shuffled(stream.digits, _seed(stream, _GROUP, group)), number)


def _hashed(word, dims):
    if dims == 1:
        return _to_unit(word)
    return mi.Point2f(_to_unit(word), _to_unit(sobol.mix(word ^ _SECOND)))


def sequential(word: mi.UInt32) -> tuple[mi.Float, mi.UInt32]:
    """Return a number in [0, 1) of a series, and the word of the next one.

    `Points.series` returns the first word.
    """
    return _to_unit(sobol.mix(word)), word + _SPREAD


def _to_unit(word):
    return mi.Float(mi.Int32(word >> 8)) * (2.0**-24)
