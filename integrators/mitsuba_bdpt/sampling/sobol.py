"""Owen-scrambled two-dimensional Sobol' points inside symbolic Dr.Jit kernels.

All functions are pure functions of 32-bit unsigned arrays, without tables, memory access or state. A
high-dimensional sample consists of pairs and single numbers with the same ``index``, each with its own
``seed`` (see `points`): by *padding*, each with its own shuffle, or *jointly*, where up to five share one
:func:`shuffled` index and differ by a linear map of its digits (:func:`related`).

``mi.radical_inverse_2`` and ``mi.sobol_2`` also run in kernels, but their ``scramble`` is a random digital
shift: it gives neither the O(n^-1.5 log n) root mean square error of Owen scrambling nor the shuffled order
that padding needs. ``mi.sample_tea_32`` costs several times as much as :func:`hash_u32`.

Sources
-------
* Owen, "Randomly Permuted (t,m,s)-Nets and (t,s)-Sequences", 1995: nested uniform scrambling.
* Laine and Karras, "Stratified Sampling for Stochastic Transparency", EGSR 2011: a hash in which every bit
  depends only on lower bits is a nested scramble of the reversed digits.
* Burley, "Practical Hash-based Owen Scrambling", JCGT 9(4), 2020: shuffling the index by this hash; padding.
* Vegdahl, "Building a Better LK Hash", 2021, https://psychopath.io/post/2021_01_30_building_a_better_lk_hash:
  the hash and its constants.
* Ahmed, "An Implementation Algorithm of 2D Sobol Sequence Fast, Elegant, and Compact", EGSR 2024: the second
  dimension in log2(32) = 5 steps.
* Niederreiter, "Random Number Generation and Quasi-Monte Carlo Methods", 1992, chapter 4: nets of several
  dimensions from one matrix per dimension.
* Owen, "Scrambled Net Variance for Integrals of Smooth Functions", 1997, eq. 3.6: the gain coefficients that
  the maps of :func:`related` minimise.
* Wellons, https://github.com/skeeto/hash-prospector: the integer mix of :func:`hash_u32`.

Digits
------
Binary digits are stored least significant bit first: bit k of a *digit word* is the coefficient of 2^-(k+1).
The digit word of the van der Corput point is then the index itself, and the hash needs no bit reversal.

Dr.Jit types are resolved at call time, under the current variant, which must be a JIT variant.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    UInt32Like = mi.UInt32 | int

# Maps of digit words, each a product of x -> x ^ ((x >> shift) & mask): upper unitriangular over GF(2), so
# that every pair stays a (0,2)-sequence. Found by a beam search (width 6, 40 random sets of shifts from 1 to
# 8), bit by bit of the index and map by map. Objective: over blocks of 2^m points, m = 2 to 20, the least
# mean of 2^r - 1 over the elementary boxes of volume 2^-m in the four dimensions of two pairs (three with the
# fourth entry, which is for single numbers), r the rank deficiency of the digits' rows (2^r - 1 other points
# share the box). It is 0 for nets, 1 for independent points, and 0.2 to 1.0 here.
MAPS = (
    (),
    ((7, 0x014C5DFE), (2, 0x144B3B33), (3, 0x08BA9CF1), (5, 0x0081BBDF)),
    ((8, 0x000FBA61), (5, 0x0475D6AA), (3, 0x0959A6D5), (6, 0x001BAFDF)),
    ((3, 0x0E5F1966), (2, 0x1B1CC95D), (7, 0x00325BAF), (6, 0x00E678E7)),
    ((3, 0x0ED7D18E), (7, 0x01CBBFBB), (5, 0x06E0A7F9), (2, 0x265C31E7)),
)


def hash_u32(x: UInt32Like, y: UInt32Like) -> mi.UInt32:
    """Hash two 32-bit words to a seed.

    ``x`` and ``y`` are arrays of equal width or width 1, or Python integers; the result has the broadcast
    width. A bijection of ``y`` for fixed ``x`` (different dimensions never share a seed) and of ``x`` for
    fixed ``y``; not symmetric.
    """
    return mix(mix(mi.UInt32(x) + 0x9E3779B9) ^ (mi.UInt32(y) * 0x9E3779B1))


def shuffled(reversed_index: mi.UInt32, hashed: mi.UInt32) -> mi.UInt32:
    """Return the digit word of a bit-reversed index after a nested shuffle.

    ``hashed`` is an already hashed seed (consecutive seeds would be correlated), here and in :func:`pair_of`
    and :func:`single_of`. A shuffle and a scramble of the same seed are independent. Indices are below 2^32;
    see :func:`split_index` for longer sequences.

    Two shuffles are independent over seeds, but not over the indices of one pair of seeds: neighbouring
    indices always differ in the first digit. The mean of a product of functions of two padded pairs therefore
    has more variance than with independent draws: 1.58 times for one coordinate of each, at most 2 for any
    functions of one coordinate of each, 4 for the product of the first digits of all four.
    """
    return dr.brev(_scramble(reversed_index, hashed))


def related(digits: mi.UInt32, number: int) -> mi.UInt32:
    """Map a digit word so that pairs of different ``number`` are jointly stratified.

    ``number`` is 0 to 4. Each pair remains a (0,2)-sequence; any two together are nearly a net in four
    dimensions. For the mean of a product of one coordinate of each over n points, the variance over that of
    independent draws, averaged over the coordinates, is at most 0.33 at n = 64 and 0.04 at 256 (padded pairs:
    1.58 at any n); below 64 it reaches 2.5 at n = 8 and 1.4 at 16 and 32, and for numbers 3 and 4 together
    2.5, 4.7 and 9.2. Number 3 is optimised for its first coordinate only (single numbers). Three pairs
    together are not optimised. Two draws of the same number and digits must not enter one product.
    """
    for shift, mask in MAPS[number]:
        digits = digits ^ ((digits >> shift) & mask)
    return digits


def pair_of(digits: mi.UInt32, hashed: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Return both coordinates of the Owen-scrambled point of a digit word.

    ``hashed``: see :func:`shuffled`. Multiples of 2^-24 in [0, 1), exact in float32. Every aligned block of
    2^m indices, m <= 24, is a (0,m,2)-net for every seed; over seeds each point is uniform in the square.
    """
    seed_x, seed_y = _seeds(hashed)
    return _unit(_scramble(digits, seed_x)), _unit(_scramble(_second(digits), seed_y))


def single_of(digits: mi.UInt32, hashed: mi.UInt32) -> mi.Float:
    """Return the first coordinate of :func:`pair_of`."""
    return _unit(_scramble(digits, _seeds(hashed)[0]))


def split_index(index64: mi.UInt64 | int, seed: UInt32Like) -> tuple[mi.UInt32, mi.UInt32]:
    """Split a 64-bit index into a 32-bit ``(index, seed)``.

    The high word is folded into the seed: each run of 2^32 points is an independent sequence. The seed is
    unchanged while the high word is 0.
    """
    index64 = mi.UInt64(index64)
    high = mi.UInt32(index64 >> 32)
    # mix(0) == 0, and mix is a bijection: no two high words share a seed.
    return mi.UInt32(index64), mi.UInt32(seed) ^ mix(high)


def mix(x: mi.UInt32) -> mi.UInt32:
    """Bijective 32-bit mix with 0 -> 0 (hash-prospector, bias 0.107)."""
    x = (x ^ (x >> 16)) * 0x21F0AAAD
    x = (x ^ (x >> 15)) * 0xD35A2D97
    return x ^ (x >> 15)


def _seeds(hashed: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Seeds of the scrambles of the two coordinates, from the seed of the shuffle.

    Low bits decide the leading digits: with shifts of 11 and 22 the low ten bits of the three seeds are
    exactly independent and uniform over uniform seeds. Tests check that scrambles are independent of the
    shuffle, which uses the high digits of its index first.
    """
    return (hashed ^ (hashed >> 11)) * 0x2C1B3C6D, (hashed ^ (hashed >> 22)) * 0x297A2D39


def _scramble(digits: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Owen-scramble a digit word: flip each bit by a hash of the lower bits and seed.

    On a reversed index it is a nested uniform shuffle of aligned power-of-two blocks. Vegdahl's form of the
    Laine-Karras hash: sums, products and ``x ^= x * even`` are bijections that carry to higher bits only.
    """
    digits = digits ^ (digits * 0x3D20ADEA)
    digits = (digits + seed) * ((seed >> 16) | 1)
    digits = digits ^ (digits * 0x05526C56)
    return digits ^ (digits * 0x53A22864)


def _second(digits: mi.UInt32) -> mi.UInt32:
    """Digit word of the second Sobol' coordinate from that of the first (= the index).

    Digit k is the sum mod 2 of C(j, k) times digit j of the index; C(j, k) is odd exactly when the bits of k
    are among those of j (Lucas). The sum over supersets factors into one step per bit of the positions
    (Ahmed's doubling of the Pascal matrix).
    """
    digits = digits ^ (digits >> 16)
    digits = digits ^ ((digits >> 8) & 0x00FF00FF)
    digits = digits ^ ((digits >> 4) & 0x0F0F0F0F)
    digits = digits ^ ((digits >> 2) & 0x33333333)
    return digits ^ ((digits >> 1) & 0x55555555)


def _unit(digits: mi.UInt32) -> mi.Float:
    """Convert the first 24 digits to a float in [0, 1).

    A signed integer in between avoids the slower unsigned conversion.
    """
    return mi.Float(mi.Int32(dr.brev(digits) >> 8)) * (2.0**-24)
