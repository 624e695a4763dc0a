"""How far Mitsuba's samplers are from independent between dimensions.

Each number that a sampler draws is uniform by itself, and the samples of a pixel are spread evenly in it.
What matters besides is how two numbers of the same sample, one deciding a light and one a direction, say,
depend on each other. Two figures, for n samples in each of many pixels, u and v two dimensions:

* over all pixels: the correlation of u and v. Unless it is 0, integrals over both come out wrong: the image
  is biased, however many pixels, seeds or images are averaged.
* within a pixel: the root of the mean square, over pixels, of the pixel's own correlation, times sqrt(n - 1),
  so that independent numbers have 1. Above it, the samples of a pixel repeat each other: noise that more
  samples of the pixel reduce slowly.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_bdpt.sampling.points import SAMPLER_TABLE, Points

SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
FIRST = tuple(dims for *_, dims in SAMPLER_TABLE)  # what points=sampler draws, in its order
DEEP = FIRST + (2, 2, 1) * 16  # as if the sampler served 16 more bounces: light, direction, lobe
SAMPLES = 1 << 17  # in all pixels together: a correlation of 0 is found as 0.003


def numbers(kind: str, count: int, draws, samples: int = SAMPLES, seed: int = 0) -> np.ndarray:
    """What a sampler draws, (pixels, samples of a pixel, dimensions).

    ``draws`` names the dimensions of one draw after the other, ``count`` the samples of a pixel before the
    sampler rounds it.
    """
    sampler = mi.load_dict({"type": kind, "sample_count": count})
    count = sampler.sample_count()
    pixels = samples // count
    sampler.set_samples_per_wavefront(count)
    sampler.seed(seed, pixels * count)
    drawn = [sampler.next_1d() if dims == 1 else sampler.next_2d() for dims in draws]
    dr.eval(drawn)
    columns = [np.atleast_2d(np.array(values)) for values in drawn]
    return np.concatenate(columns).T.reshape(pixels, count, -1)


def path_numbers(kind: str, count: int) -> np.ndarray:
    """As `numbers`, what the paths of ``points=sampler`` get: each row of the table from another sequence."""
    u = numbers(kind, count, FIRST)
    pixels = len(u) - Points.sequences(0)
    column, columns = 0, []
    for row, dims in enumerate(FIRST):
        columns.append(u[row : row + pixels, :, column : column + dims])
        column += dims
    return np.concatenate(columns, axis=2)


def correlations(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both figures of each pair of dimensions, see the module, as symmetric matrices with a diagonal of 0.

    ``u`` (pixels, samples, dimensions). Over all pixels the mean 1/2 and the variance 1/12 are known.
    """
    pixels, count, dims = u.shape
    overall, squares = np.zeros((dims, dims)), np.zeros((dims, dims))
    for part in np.array_split(u, -(-pixels // 1024)):
        z = (part - 0.5) * np.sqrt(12)
        overall += np.tensordot(z, z, axes=((0, 1), (0, 1))) / (pixels * count)
        z -= z.mean(1, keepdims=True)
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        squares += (np.matmul(z.transpose(0, 2, 1), z) ** 2).sum(0) / pixels
    within = np.sqrt(squares * (count - 1))
    for matrix in (overall, within):
        np.fill_diagonal(matrix, 0)
    return np.abs(overall), within
