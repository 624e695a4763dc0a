"""The Owen-scrambled Sobol' points. All points are functions of fixed integers; the bounds of statistics say
how rarely a good generator falls outside."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.sampling import sobol
from scipy import stats

LAST = 0xFFFFFFFF
SEEDS = [0, 1, 2, 12345, 0x80000000, LAST]


def scrambled_pair(index, seed, coordinates=sobol.pair_of):
    """A pair with a shuffle and scrambles of its own, from one seed."""
    hashed = sobol.mix(mi.UInt32(seed) + 0x9E3779B9)
    return coordinates(sobol.shuffled(dr.brev(mi.UInt32(index)), hashed), hashed)


def pair(index, seed, coordinates=sobol.pair_of) -> np.ndarray:
    """(..., 2)"""
    index, seed = np.broadcast_arrays(np.asarray(index, np.uint32), np.asarray(seed, np.uint32))
    points = scrambled_pair(mi.UInt32(index.ravel()), mi.UInt32(seed.ravel()), coordinates)
    points = (points,) if coordinates is sobol.single_of else points
    return np.stack([np.float64(p.numpy()).reshape(index.shape) for p in points], axis=-1)


def test_unscrambled_equals_scipy():
    """Exactly (Joe and Kuo). SciPy walks in Gray code order: its point i is the point i xor (i >> 1)."""
    n = 4096
    i = np.arange(n)
    digits = mi.UInt32(np.uint32(i ^ (i >> 1)))
    ours = np.stack([sobol._unit(d).numpy() for d in (digits, sobol._second(digits))], axis=1)
    assert np.array_equal(ours, stats.qmc.Sobol(d=2, scramble=False).random(n))


def test_second_dimension_all_digits():
    """Digit k of the point 2^j is C(j, k) mod 2."""
    got = sobol._second(mi.UInt32(np.uint32(1) << np.arange(32, dtype=np.uint32))).numpy()
    want = [sum(1 << k for k in range(32) if (j & k) == k) for j in range(32)]
    assert got.tolist() == want


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("m", range(11))
def test_aligned_blocks_are_nets(m, seed):
    """Exactly one of 2^m points in each elementary interval of area 2^-m: the (0,m,2)-net property, which
    nested scrambling and shuffling keep."""
    n = 1 << m
    for block in (0, 1, 5, (LAST >> m) - 1, LAST >> m):
        p = pair(block * n + np.arange(n), seed)
        for k in range(m + 1):
            cell = np.int64(p[:, 0] * 2**k) * 2 ** (m - k) + np.int64(p[:, 1] * 2 ** (m - k))
            assert np.array_equal(np.sort(cell), np.arange(n)), (m, k, block)
        assert np.array_equal(pair(block * n + np.arange(n), seed, sobol.single_of), p[:, :1])


@pytest.mark.parametrize("index", [0, 1, 2, 7, 1000, 1 << 20, LAST])
def test_point_is_uniform_over_scrambles(index):
    """A point over 4096 consecutive or hashed seeds. Chi-square over 16 x 16 cells, Kolmogorov-Smirnov along
    each axis and for the digits below the first eight, which the cells do not see; p > 1e-4 in some seventy
    statistics."""
    pixel, dim = np.divmod(np.arange(4096, dtype=np.uint32), 16)
    hashed = sobol.hash_u32(mi.UInt32(pixel), mi.UInt32(dim)).numpy()
    for seeds in (np.arange(4096), hashed):
        p = pair(index, seeds)
        cells = np.bincount(np.int64(p[:, 0] * 16) * 16 + np.int64(p[:, 1] * 16), minlength=256)
        assert stats.chisquare(cells).pvalue > 1e-4
        for x in (p[:, 0], p[:, 1], p[:, 0] * 256 % 1, p[:, 1] * 256 % 1):
            assert stats.kstest(x, "uniform").pvalue > 1e-4
        # |r| of n independent pairs is about N(0, 1/n): 4 sigma, once in 16000.
        assert abs(np.corrcoef(p.T)[0, 1]) < 4 / np.sqrt(4096)


def second(digits: np.ndarray) -> np.ndarray:
    """Digit k of the second coordinate sums C(j, k) times digit j, mod 2."""
    out = np.zeros_like(digits)
    for k in range(16):
        for j in range(k, 16):
            if (j & k) == k:
                out ^= ((digits >> j) & 1) << k
    return out


def sign_kernel(difference: np.ndarray, k: int) -> np.ndarray:
    """E[s s'] over nested uniform scrambles, s = 1 or -1 by digit k, for two points whose unscrambled digits
    have the xor ``difference``: as they were if digits 0 to k - 1 agree, else independent."""
    agree = (difference & ((1 << k) - 1)) == 0
    return agree * (1 - 2 * ((difference >> k) & 1))


def test_digits_vary_as_in_nested_uniform_scrambling():
    """Product of digit k of x and digit j of y over 2^m points: exact variance if the trees of x, y and the
    shuffle are independent, from the digits alone. Over 8000 hashed seeds the relative deviation is 1.6 %
    (square of a near normal): 10 % is 6 sigma."""
    seeds = sobol.hash_u32(dr.arange(mi.UInt32, 8000), 3).numpy()
    p = pair(np.arange(32)[:, None], seeds[None, :])
    for m in range(1, 6):
        d = np.arange(1 << m)
        for k in range(4):
            for j in range(4):
                x, y = p[: 1 << m, :, 0] * 2**k % 1, p[: 1 << m, :, 1] * 2**j % 1
                variance = (np.where((x < 0.5) == (y < 0.5), 1, -1).mean(0) ** 2).mean()
                want = (sign_kernel(d, k) * sign_kernel(second(d), j)).mean()
                assert variance == pytest.approx(want, rel=0.1, abs=1e-12), (m, k, j)


NUMBERS = range(len(sobol.MAPS))


def joint(index, group, number) -> np.ndarray:
    """Points of a draw of this number, with a scramble of its own."""
    index, group = np.broadcast_arrays(np.asarray(index, np.uint32), np.asarray(group, np.uint32))
    reverse = dr.brev(mi.UInt32(index.ravel()))
    digits = sobol.related(sobol.shuffled(reverse, sobol.hash_u32(mi.UInt32(group.ravel()), 3)), number)
    points = sobol.pair_of(digits, sobol.hash_u32(mi.UInt32(group.ravel()), 7 + number))
    return np.stack([np.float64(p.numpy()).reshape(index.shape) for p in points], axis=-1)


@pytest.mark.parametrize("number", NUMBERS)
def test_joint_pairs_are_nets(number):
    for m in range(9):
        p = joint(np.arange(1 << m) + (5 << m), 12345, number)
        for k in range(m + 1):
            cells = np.floor(p * [1 << k, 1 << (m - k)]).astype(int)
            assert len(set(map(tuple, cells))) == 1 << m


def test_range():
    seeds = np.arange(1 << 18)
    for index in (0, LAST):
        p = pair(index, seeds)
        assert p.min() >= 0 and p.max() < 1
        assert np.array_equal(p * 2**24, np.floor(p * 2**24))
    assert sobol._unit(mi.UInt32(LAST)).numpy()[0] == 1 - 2.0**-24
    assert sobol._unit(mi.UInt32(0)).numpy()[0] == 0


def test_hash_u32():
    """A bijection in each argument, and seeds of two dimensions have in common what chance makes."""
    n = 1 << 16
    i = np.arange(n, dtype=np.uint32)
    x, y = i >> 8, i & 255
    h = sobol.hash_u32(mi.UInt32(x), mi.UInt32(y)).numpy()
    # Birthday: 2^31 pairs of 32-bit values, half a collision expected; 5 is 2e-5 rare.
    assert len(np.unique(h)) > n - 5
    assert len(np.unique(sobol.hash_u32(mi.UInt32(i), 7).numpy())) == n
    assert len(np.unique(sobol.hash_u32(7, mi.UInt32(i)).numpy())) == n

    # Seeds of two dimensions over 2^20 pixels have 2^8 in common by chance, deviation 16: 6 sigma.
    # 2584 and 4181 (Fibonacci) nearly cancel the golden ratio: a linear hash would share a third.
    pixels = dr.arange(mi.UInt32, 1 << 20)
    sets = [np.sort(sobol.hash_u32(pixels, dim).numpy()) for dim in (0, 2584, 4181)]
    for other in sets[1:]:
        common = np.intersect1d(sets[0], other, assume_unique=True)
        assert len(common) < 256 + 6 * 16


def test_split_index():
    index = np.uint64([0, 5, LAST, 1 << 32, (1 << 32) + 5, (7 << 32) + LAST])
    low, seed = sobol.split_index(mi.UInt64(index), 9)
    assert type(low) is mi.UInt32 and type(seed) is mi.UInt32
    assert low.numpy().tolist() == [0, 5, LAST, 0, 5, LAST]
    seed = seed.numpy()
    assert seed[:3].tolist() == [9, 9, 9]
    assert seed[3] == seed[4] and len({9, int(seed[3]), int(seed[5])}) == 3

    # A block across no boundary of 2^32 is still a net.
    low, seed = sobol.split_index(mi.UInt64(np.arange(256, dtype=np.uint64) + (3 << 40)), 1)
    x, y = scrambled_pair(low, seed)
    cell = np.int64(x.numpy() * 16) * 16 + np.int64(y.numpy() * 16)
    assert np.array_equal(np.sort(cell), np.arange(256))
