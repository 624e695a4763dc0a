"""How far Mitsuba's samplers are from independent between dimensions, and what error they leave.

    python scripts/sampler_correlation.py     # the source of docs/user/samplers.md, some minutes on two cores

Each number that a sampler draws is uniform by itself, and the samples of a pixel are spread evenly in it.
What matters besides is how two numbers of the same sample, one deciding a light and one a direction, say,
depend on each other. Two figures, for n samples in each of many pixels, u and v two dimensions:

* over all pixels: the correlation of u and v. Unless it is 0, integrals over both come out wrong: the image
  is biased, however many pixels, seeds or images are averaged.
* within a pixel: the root of the mean square, over pixels, of the pixel's own correlation, times sqrt(n - 1),
  so that independent numbers have 1. Above it, the samples of a pixel repeat each other: noise that more
  samples of the pixel reduce slowly.

The second table is the error of whole images by the points that made them.
"""

from __future__ import annotations

import argparse
import sys

import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure.metrics import TRIM, rel_mse
from repository import RESOLUTION, load_reference, load_scene

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
from mitsuba_bdpt.sampling.points import SAMPLER_TABLE, Points  # isort: skip

SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
COUNTS = (4, 16, 64)
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


def correlation_table() -> list[str]:
    """A line of Markdown per sampler and number of samples: the largest figure of all pairs of dimensions."""
    kinds = ("a path of `bdpt`", "the same from one sequence", "16 bounces from one sequence")
    lines = [
        "| sampler | samples per pixel | "
        + " | ".join(f"{kind}: {where}" for kind in kinds for where in ("over all pixels", "within a pixel"))
        + " |",
        "| --- |" + " --- |" * 7,
    ]
    for kind in SAMPLERS:
        for count in COUNTS:
            deep = numbers(kind, count, DEEP, SAMPLES // 4)
            drawn = path_numbers(kind, count), numbers(kind, count, FIRST), deep
            figures = [figure.max() for u in drawn for figure in correlations(u)]
            cells = " | ".join(f"{figure:.2f}" for figure in figures)
            lines.append(f"| `{kind}` | {drawn[0].shape[1]} | {cells} |")
    return lines


SCENES = {"cornell_box": 6, "many_lights": 6, "open_sky": 6}  # and the depth of their references
SEEDS = 5


def relative_error(name: str, depth: int, sampler: str, points: str, spp: int) -> float:
    """Median over seeds of relMSE without the worst 0.1 % of the values, times samples per pixel traced."""
    scene = load_scene(name, resolution=RESOLUTION, sampler=sampler, spp=spp)
    reference = load_reference(name, RESOLUTION, depth)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "points": points})
    errors = []
    for seed in range(SEEDS):
        image = np.array(integrator.render(scene, seed=seed), dtype=np.float64)
        errors.append(rel_mse(image, reference.image, TRIM) * sum(integrator.statistics["passes"]))
    return float(np.median(errors))


def error_table() -> list[str]:
    """A line of Markdown per kind of points: the error of each scene over that of independent numbers."""
    columns = [(name, depth, spp) for name, depth in SCENES.items() for spp in (16, 64)]
    lines = [
        f"| points | {' | '.join(f'`{name}`, {spp}' for name, _, spp in columns)} |",
        "| --- |" + " --- |" * len(columns),
    ]
    plain = [relative_error(name, depth, "independent", "independent", spp) for name, depth, spp in columns]
    rows = [("`sobol`", "independent", "sobol")]
    rows += [(f"`sampler`, `{kind}`", kind, "sampler") for kind in SAMPLERS if kind != "independent"]
    for label, kind, points in rows:
        cells = [
            f"{relative_error(name, depth, kind, points, spp) / base:.2f}"
            for (name, depth, spp), base in zip(columns, plain, strict=True)
        ]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return lines


def main(arguments=None) -> int:
    """Print both tables."""
    argparse.ArgumentParser(allow_abbrev=False, description=__doc__.split("\n\n")[0]).parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)  # samplers warn of each count that they round
    print("\n".join([*correlation_table(), "", *error_table()]))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
