"""Whether renders agree with others, or with a known value, by tests on the means of tiles over seeds.

`judged` asks that a difference of a given size would be seen in the image's mean, `family` that the tiles'
standard error is small over many pairs of scenes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mitsuba_bdpt.measure.agreement import SIGNIFICANCE, TILES, Difference, Sample, sidak, tile_means, welch
from scipy import stats

import mitsuba as mi  # isort: skip

from .case import Outcome

# What every comparison is made with.
WAYS = {"default parameters": {}, "all strategies": {"skip": "none"}}

# Chance that a right program fails one comparison, had the seeds not been fixed: the level of all its t-tests
# together, after Sidak's correction.
LEVEL = SIGNIFICANCE


def images(scene, integrator: dict, seeds, spp: int):
    """One image per seed, and how many of its samples had no finite value (0 where it is not counted)."""
    made = mi.load_dict(integrator)
    for seed in seeds:
        image = np.array(made.render(scene, seed=seed, spp=spp), dtype=np.float64)
        yield image, getattr(made, "statistics", {}).get("non_finite", 0)


def tiles(scene, integrator: dict, seeds, spp: int) -> np.ndarray:
    """Means of 4 x 4 tiles and of the image in the last column, over the colours, one row per seed."""
    rows = []
    for image, _ in images(scene, integrator, seeds, spp):
        image = image[..., :3]
        rows.append([*tile_means(image, TILES).mean(1), image.mean()])
    return np.array(rows)


def greens(scene, integrator: dict, seeds, spp: int) -> tuple[np.ndarray, int]:
    """Means of 4 x 4 tiles of the second colour, one row per seed, and samples without finite value."""
    rows, broken = [], 0
    for image, bad in images(scene, integrator, seeds, spp):
        rows.append(tile_means(image, TILES)[:, 1])
        broken += bad
    return np.stack(rows), broken


@dataclass(frozen=True)
class Judged(Outcome):
    """The outcome of a test, with its ``p`` and the largest relative error that it may overlook."""

    p: float = 1.0
    seen: float = 0.0


def smallest_seen(found: Difference, mean: float) -> float:
    """The relative error of the image's mean, in the last column, that is found with a chance of one half.

    At `LEVEL` after Sidak's correction for all columns.
    """
    level = -np.expm1(np.log1p(-LEVEL) / len(found.p))
    return float(stats.t.isf(level / 2, found.freedom[-1]) * found.error[-1] / abs(mean))


def judged(ours, theirs: Sample, reach: float, what: str) -> Judged:
    """Welch's test of the tiles of ``ours``, Sidak over them.

    ``reach``: the largest relative error of the image's mean that it may overlook (seen with a chance of one
    half), else it shows nothing.
    """
    ours = Sample.of(ours)
    found = welch(ours, theirs)
    p = sidak(found.p)
    mean, expected = ours.mean[-1], theirs.mean[-1]
    seen = smallest_seen(found, expected)
    ok = np.isfinite(ours.mean).all() and p >= LEVEL and seen <= reach
    text = f"mean {mean:.5g}, {what} {expected:.5g}; p = {p:.2g} over {len(found.p)} values; "
    return Judged(bool(ok), f"{text}sees errors of {100 * seen:.2g} %", p, seen)


def against(ours, theirs, reach: float, what: str = "`path`") -> Judged:
    """`judged` against other renders."""
    return judged(ours, Sample.of(theirs), reach, what)


def against_known(ours, expected, reach: float) -> Judged:
    """`judged` against a value that is known for all tiles, or values as of `tiles`."""
    return judged(ours, Sample.known(np.broadcast_to(expected, ours.shape[1])), reach, "known")


def family(pairs, most_error: float) -> Outcome:
    """t-tests of ``pairs`` of `Sample`s together; they show nothing where the noise is too large.

    That is where the mean standard error of a pair's differences is more than ``most_error`` of its mean.
    """
    p, gap, error = [], 0.0, 0.0
    for a, b in pairs:
        found = welch(a, b)
        p += found.p.tolist()
        scale = max(float(np.abs(b.mean).mean()), 1e-300)
        gap = max(gap, abs(float((a.mean - b.mean).mean())) / scale)
        error = max(error, float(found.error.mean()) / scale)
    of_all = sidak(p)
    text = f"p = {of_all:.2g} over {len(p)} comparisons, means {100 * gap:.2g} % apart at most, "
    text += f"standard error {100 * error:.2g} %"
    return Outcome(of_all >= LEVEL and error <= most_error, text)


def deviation(a: Sample, b: Sample) -> tuple[float, float]:
    """Root mean square of what the tiles of ``b`` are off, less noise, and that noise.

    Both over the mean of ``a``; the noise is the root mean square of their standard errors.
    """
    difference = welch(a, b)
    noise = (difference.error**2).mean()
    square = (difference.value**2).mean() - noise
    return tuple(float(np.sqrt(max(x, 0)) / a.mean.mean()) for x in (square, noise))


def worst(outcomes: dict[str, Judged]) -> Outcome:
    """Several tests, by what was tried, as one: expected if all are.

    Of those that are, only the one with the smallest p is told.
    """
    wrong = {name: outcome for name, outcome in outcomes.items() if not outcome.ok}
    if wrong:
        return together(wrong)
    least = min(outcomes, key=lambda name: outcomes[name].p)
    text = f"{len(outcomes)} comparisons, the smallest p: {least}: {outcomes[least].happened}; all see "
    return Outcome(True, f"{text}errors of {100 * max(outcome.seen for outcome in outcomes.values()):.2g} %")


def together(outcomes: dict[str, Outcome]) -> Outcome:
    """Several outcomes, by what was tried, as one: expected if all are."""
    texts = [f"{'' if o.ok else '**no**: '}{name}: {o.happened}" for name, o in outcomes.items()]
    return Outcome(all(o.ok for o in outcomes.values()), "; ".join(texts))
