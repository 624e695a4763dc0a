"""Whether renders agree with others, or with a known value, by tests on the means of tiles over seeds."""

from __future__ import annotations

import numpy as np
from mitsuba_bdpt.measure.agreement import SIGNIFICANCE, TILES, Difference, Sample, sidak, tile_means, welch
from scipy import stats

import mitsuba as mi  # isort: skip

# What every comparison is made with.
WAYS = {"defaults": {}, "all strategies": {"skip": "none"}}

# Chance that a right program fails one comparison, had the seeds not been fixed: the level of all its t-tests
# together, after Sidak's correction.
LEVEL = SIGNIFICANCE


def tiles(scene, integrator: dict, seeds, spp: int, sound=False) -> np.ndarray:
    """Means of 4 x 4 tiles and of the image in the last column, over the colours, one row per seed.

    ``sound``: no sample may have a non-finite value.
    """
    made, rows = mi.load_dict({"type": "bdpt"} | integrator), []
    for seed in seeds:
        image = np.array(made.render(scene, seed=seed, spp=spp), dtype=np.float64)[..., :3]
        rows.append([*tile_means(image, TILES).mean(1), image.mean()])
        assert not (sound and getattr(made, "statistics", {}).get("non_finite"))
    return np.array(rows)


def smallest_seen(found: Difference, mean: float) -> float:
    """The relative error of the image's mean, in the last column, that is found with a chance of one half."""
    level = -np.expm1(np.log1p(-LEVEL) / len(found.p))
    return float(stats.t.isf(level / 2, found.freedom[-1]) * found.error[-1] / abs(mean))


def agree(ours, expected, reach: float) -> None:
    """Welch's test of `tiles` with others or, Student's, with known values, Sidak over them.

    Fails too if an error ``reach`` of the image's mean would be overlooked every other time.
    """
    ours = Sample.of(ours)
    known = Sample.known(np.broadcast_to(expected, ours.mean.shape)) if np.ndim(expected) < 2 else None
    expected = known or Sample.of(expected)
    found, mean = welch(ours, expected), expected.mean[-1]
    p, seen = sidak(found.p), smallest_seen(found, mean)
    print(f"mean {ours.mean[-1]:.5g}, expected {mean:.5g}: p = {p:.2g}, sees errors of {100 * seen:.2g} %")
    assert np.isfinite(ours.mean).all()
    assert p >= LEVEL
    assert seen <= reach


def family(pairs, most_error: float) -> None:
    """t-tests of ``pairs`` of `Sample`s together, whose mean standard errors are ``most_error`` at most."""
    p, gap, error = [], 0.0, 0.0
    for a, b in pairs:
        found = welch(a, b)
        p += found.p.tolist()
        scale = max(float(np.abs(b.mean).mean()), 1e-300)
        gap = max(gap, abs(float((a.mean - b.mean).mean())) / scale)
        error = max(error, float(found.error.mean()) / scale)
    print(
        f"p = {sidak(p):.2g} over {len(p)} comparisons, means {100 * gap:.2g} % apart at most, "
        f"standard error {100 * error:.2g} %"
    )
    assert sidak(p) >= LEVEL
    assert error <= most_error
