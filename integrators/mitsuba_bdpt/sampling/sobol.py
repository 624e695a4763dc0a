"""Owen-scrambled two-dimensional Sobol' points for use inside a symbolic Dr.Jit kernel.

Everything here is a pure function of 32-bit unsigned arrays: no tables, no memory access, no
state. A high-dimensional sample is made of pairs and single numbers, all with the same ``index`` and
each with its own ``seed`` (see `points`), in two ways: by *padding*, where each has a shuffle of its own,
and *jointly*, where up to five share one :func:`shuffled` index and differ by a linear map of its digits
(:func:`related`).

Why not what Mitsuba ships: ``mi.radical_inverse_2`` and ``mi.sobol_2`` do run in a kernel, but
their ``scramble`` argument is only xor-ed onto the digits (a random digital shift). That keeps
the net, but gives neither the O(n^-1.5 log n) root mean square error of Owen's scrambling, nor
the shuffled order that padding needs. ``mi.sample_tea_32`` would do as a hash of seeds; at its
default four rounds it costs several times what :func:`hash_u32` does.

Sources
-------
* Owen, "Randomly Permuted (t,m,s)-Nets and (t,s)-Sequences", 1995: nested uniform scrambling.
* Laine and Karras, "Stratified Sampling for Stochastic Transparency", EGSR 2011: a hash in which
  every bit depends on the lower bits only is a nested scramble of the reversed digits.
* Burley, "Practical Hash-based Owen Scrambling", JCGT 9(4), 2020: shuffling the index by the same
  hash, and padding.
* Vegdahl, "Building a Better LK Hash", 2021,
  https://psychopath.io/post/2021_01_30_building_a_better_lk_hash: the hash and its constants.
* Ahmed, "An Implementation Algorithm of 2D Sobol Sequence Fast, Elegant, and Compact", EGSR 2024:
  the second dimension in log2(32) = 5 steps.
* Niederreiter, "Random Number Generation and Quasi-Monte Carlo Methods", 1992, chapter 4: nets of
  several dimensions from one matrix per dimension; Owen, "Scrambled Net Variance for Integrals of
  Smooth Functions", 1997, eq. 3.6: the gain coefficients by which the maps of :func:`related` were chosen.
* Wellons, https://github.com/skeeto/hash-prospector: the integer mix of :func:`hash_u32`.

Digits
------
Binary digits are kept least significant bit first: bit k of a *digit word* is the coefficient of
2^-(k+1). In that form the digit word of the van der Corput point is the index itself, and the
hash applies as it stands, so that one bit reversal per stage is enough (four in a pair, of which
that of the index is common to all pairs of one index).

The Dr.Jit types are looked up when a function runs, hence under the variant then set; any JIT
variant will do (the scalar ones have no arrays and are not supported).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    UInt32Like = mi.UInt32 | int

__all__ = [
    "hash_u32",
    "mix",
    "pair_of",
    "related",
    "shuffled",
    "single_of",
    "split_index",
]

# Maps of digit words, each a product of x -> x ^ ((x >> shift) & mask), which is upper unitriangular over
# GF(2), so that every pair stays a (0,2)-sequence. Found by a beam search, bit after bit of the index: for
# all blocks of 2^m points, m = 2 to 20, least mean of 2^r - 1 over the elementary boxes of volume 2^-m in the
# four dimensions of two pairs (three with the fourth entry, of which the first coordinate counts), r what the
# rank of their digits' rows lacks: the other points of the block that share a point's box. It is 0 for
# nets, 1 for independent points, and 0.2 to 1.0 here. The beam was 6 wide, for each of 40 random sets of
# shifts from 1 to 8; a map was found after the other, each beside those before it.
MAPS = (
    (),
    ((7, 0x014C5DFE), (2, 0x144B3B33), (3, 0x08BA9CF1), (5, 0x0081BBDF)),
    ((8, 0x000FBA61), (5, 0x0475D6AA), (3, 0x0959A6D5), (6, 0x001BAFDF)),
    ((3, 0x0E5F1966), (2, 0x1B1CC95D), (7, 0x00325BAF), (6, 0x00E678E7)),
    ((3, 0x0ED7D18E), (7, 0x01CBBFBB), (5, 0x06E0A7F9), (2, 0x265C31E7)),
)


def hash_u32(x: UInt32Like, y: UInt32Like) -> mi.UInt32:
    """Hash of two 32-bit words, to make a seed out of, say, a pixel's seed and a dimension.

    ``x`` and ``y`` are arrays of equal width, or of width 1, or Python integers; the result has
    the broadcast width and covers all of [0, 2^32). For a fixed ``x`` it is a bijection of ``y``
    (different dimensions never share a seed) and for a fixed ``y`` one of ``x``. Not symmetric.
    """
    return mix(mix(mi.UInt32(x) + 0x9E3779B9) ^ (mi.UInt32(y) * 0x9E3779B1))


def shuffled(reversed_index: mi.UInt32, hashed: mi.UInt32) -> mi.UInt32:
    """Digit word of an index, whose bits are given in reverse order, after a nested shuffle.

    ``hashed`` is a seed that was hashed already (consecutive ones would be related), here and in
    :func:`pair_of` and :func:`single_of`; where a shuffle and a scramble have the same one, they are
    independent nevertheless. Indices are below 2^32, see :func:`split_index` for longer sequences.

    Over the seeds the points of two shuffles of an index are independent, as far as hashes go. Over the
    indices of one pair of seeds it is otherwise: neighbours in index are opposite in the first digit
    under every seed. A mean over products of functions of two padded pairs thus has more variance
    than with independent draws: 1.58 times for the product of one coordinate of each, at most 2 for any
    functions of one coordinate of each, and 4 for the product of the first digits of all four.
    """
    return dr.brev(_scramble(reversed_index, hashed))


def related(digits: mi.UInt32, number: int) -> mi.UInt32:
    """Digit word whose pair goes well with those of other numbers, 0 to 4, of the same ``digits``.

    Each pair by itself is what it would be without the map, and any two together are nearly a net in four
    dimensions. The mean over n points of a product of one coordinate of each pair has, on the average over
    the coordinates, at most 0.33 times the variance it has with independent draws at n = 64, 0.04 at
    256, where padded pairs have 1.58 times as much at any n. Below 64 some pairs have more than that: 2.5
    at n = 8, 1.4 at 16 and 32, and number 3 with 4 has 2.5, 4.7 and 9.2. Of number 3 all this is said of the
    first coordinate alone: it is for single numbers. Three pairs are not looked at together. Two draws of
    the same number and digits must not enter one product.
    """
    for shift, mask in MAPS[number]:
        digits = digits ^ ((digits >> shift) & mask)
    return digits


def pair_of(digits: mi.UInt32, hashed: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Both coordinates of the point of a digit word, Owen-scrambled, see :func:`shuffled` for ``hashed``.

    Multiples of 2^-24 in [0, 1), at most 1 - 2^-24, which float32 holds exactly. The points of every aligned
    block of 2^m indices, m <= 24, form a (0,m,2)-net (finer intervals than 2^-24 are cut off), whatever
    the seed, and over the seeds each point is uniform in the square. Means of functions of one pair
    converge an order faster than with independent draws.
    """
    seed_x, seed_y = _seeds(hashed)
    return _unit(_scramble(digits, seed_x)), _unit(_scramble(_second(digits), seed_y))


def single_of(digits: mi.UInt32, hashed: mi.UInt32) -> mi.Float:
    """First coordinate of :func:`pair_of`."""
    return _unit(_scramble(digits, _seeds(hashed)[0]))


def split_index(index64: mi.UInt64 | int, seed: UInt32Like) -> tuple[mi.UInt32, mi.UInt32]:
    """Split a 64-bit index into a 32-bit ``(index, seed)`` for the functions above.

    The low word is the index and the high word is folded into the seed: each run of 2^32 points
    is a sequence of its own, independent of the others. While the high word is 0 the seed is
    returned as it came, so that short sequences do not depend on which form of index was used.
    """
    index64 = mi.UInt64(index64)
    high = mi.UInt32(index64 >> 32)
    # mix(0) == 0, and mix is a bijection: no two high words share a seed.
    return mi.UInt32(index64), mi.UInt32(seed) ^ mix(high)


def mix(x: mi.UInt32) -> mi.UInt32:
    """Bijective 32-bit mix with 0 -> 0 (hash-prospector, two multiplications, bias 0.107)."""
    x = (x ^ (x >> 16)) * 0x21F0AAAD
    x = (x ^ (x >> 15)) * 0xD35A2D97
    return x ^ (x >> 15)


def _seeds(hashed: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Seeds of the permutation trees of the two coordinates, from one that is also that of the shuffle.

    The low bits decide the leading digits: with shifts of 11 and 22 the low ten bits of the three are exactly
    independent and uniform over uniform seeds. That trees are independent of the shuffle, which uses the
    high digits of its index first, is tested.
    """
    return (hashed ^ (hashed >> 11)) * 0x2C1B3C6D, (hashed ^ (hashed >> 22)) * 0x297A2D39


def _scramble(digits: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Owen-scramble a digit word: bit k changes as a hash of bits 0 to k - 1 and ``seed`` says.

    On a reversed index it is a nested uniform shuffle: aligned power-of-two blocks go to such blocks.

    Vegdahl's form of the Laine-Karras hash. Sums, products and ``x ^= x * even`` all carry from
    lower bits to higher ones only, and each is a bijection.
    """
    digits = digits ^ (digits * 0x3D20ADEA)
    digits = (digits + seed) * ((seed >> 16) | 1)
    digits = digits ^ (digits * 0x05526C56)
    return digits ^ (digits * 0x53A22864)


def _second(digits: mi.UInt32) -> mi.UInt32:
    """Digit word of the second Sobol' coordinate from that of the first (= the index).

    Digit k is the sum mod 2 of C(j, k) times digit j of the index, and C(j, k) is odd exactly
    when the bits of k are among those of j (Lucas). The sum over supersets factors into one step
    per bit of the positions, which is Ahmed's doubling of the Pascal matrix.
    """
    digits = digits ^ (digits >> 16)
    digits = digits ^ ((digits >> 8) & 0x00FF00FF)
    digits = digits ^ ((digits >> 4) & 0x0F0F0F0F)
    digits = digits ^ ((digits >> 2) & 0x33333333)
    return digits ^ ((digits >> 1) & 0x55555555)


def _unit(digits: mi.UInt32) -> mi.Float:
    """Digit word to a float in [0, 1), of the first 24 digits.

    The detour by a signed integer saves the longer conversion from unsigned; 24 bits fit either.
    """
    return mi.Float(mi.Int32(dr.brev(digits) >> 8)) * (2.0**-24)
