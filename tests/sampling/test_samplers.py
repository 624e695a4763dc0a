"""Mitsuba's samplers in the scene: what they are used for, and that the image's mean does not depend on it.

The scene is the Cornell box seen through a lens, so that every number of `points.SAMPLER_TABLE` but time and
wavelength decides something. Statistics: the sample is the mean of a 16x16-pixel tile in one render, 24
renders a side with seeds of their own, Welch's t with Sidak's correction (see ``welch``) at 1e-3.
"""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.run import schedule
from mitsuba_bdpt.sampling.points import SAMPLER_TABLE, Points
from sampler_correlation import DEEP, FIRST, SAMPLERS, correlations, numbers, path_numbers
from welch import assert_agree, compare_images, tile_means

SIZE, TILES, RUNS, DEPTH = 64, 4, 24, 5

# Samples per pixel that a sampler makes of 5 and of 64: the next product of two like factors, square, square
# of a prime, power of four.
ROUNDED = {
    "independent": (5, 64),
    "stratified": (9, 64),
    "multijitter": (6, 64),
    "orthogonal": (9, 121),
    "ldsampler": (16, 64),
}


def box_parts(sampler, count, size):
    scene = mi.cornell_box()
    scene["sensor"] |= {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.5}
    scene["sensor"]["sampler"] = {"type": sampler, "sample_count": count}
    scene["sensor"]["film"].update(width=size, height=size, rfilter={"type": "box"})
    return scene


def box(sampler="independent", count=4, size=SIZE):
    return mi.load_dict(box_parts(sampler, count, size))


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": DEPTH, **parameters})


def image(integrator, scene, **keywords):
    return np.array(integrator.render(scene, **keywords), dtype=np.float64)


def renders(scene, integrator, first_seed, spp=0, runs=RUNS):
    """Tile means (green) of ``runs`` renders, (runs, tiles)."""
    return np.stack(
        [tile_means(integrator.render(scene, seed=first_seed + i, spp=spp), TILES)[:, 1] for i in range(runs)]
    )


@cache
def reference():
    """``path``'s renders of the box."""
    return renders(box(), mi.load_dict({"type": "path", "max_depth": DEPTH}), 0, 64)


@pytest.mark.parametrize("points", ["sobol", "independent"])
def test_other_points_do_not_ask_the_sampler(points):
    """Rationale: unless ``points=sampler``, a scene's sampler only says how many samples there are by
    default. Expected: with each sampler the same image up to rounding (1e-4: atomic sums have no order), of
    as many samples as asked for, and the sampler's own number with spp=0.
    """
    images = []
    for kind in SAMPLERS:
        scene, integrator = box(kind, 5, 16), bdpt(points=points)
        images.append(image(integrator, scene, spp=7))
        assert sum(integrator.statistics["passes"]) == 7
        integrator.render(scene)
        assert sum(integrator.statistics["passes"]) == ROUNDED[kind][0]
    for other in images[1:]:
        np.testing.assert_allclose(other, images[0], rtol=1e-4)


@pytest.mark.parametrize("points", ["sobol", "independent"])
def test_own_points_equal_path(points):
    """Expected: with few samples per pixel the mean of ``path``'s renders. Statistic: see the module."""
    assert_agree(
        compare_images(reference(), renders(box(), bdpt(points=points), 1000, 4), points), at_least=16
    )


@pytest.mark.parametrize("skip, count", [("auto", 4), ("none", 16)])
@pytest.mark.parametrize("kind", SAMPLERS)
def test_samplers_points_equal_path(kind, skip, count):
    """Rationale: a sampler that correlates two of the numbers it serves with biases the image, the more
    the fewer samples there are in a pixel. Expected: the mean of ``path``'s renders. Statistic: see the
    module.
    """
    ours = renders(box(kind, count), bdpt(points="sampler", skip=skip), 1000)
    assert_agree(compare_images(reference(), ours, f"{kind} {count} {skip}"), at_least=16)


@pytest.mark.parametrize("count", [4, 16, 64])
@pytest.mark.parametrize("kind", SAMPLERS)
def test_numbers_of_a_path_are_uncorrelated(kind, count):
    """Rationale: a correlation over all pixels of two numbers that serve one path is a bias.

    Expected: none of the 153 pairs of what ``points=sampler`` draws is above 0.025. Tolerance: those of
    independent numbers have a standard deviation of 2^-8.5 = 0.003 over 2^17 samples; where the samples of a
    pixel repeat each other (``ldsampler``), up to twice that.
    """
    overall, _ = correlations(path_numbers(kind, count))
    assert overall.max() < 0.025, np.unravel_index(overall.argmax(), overall.shape)


@pytest.mark.parametrize(
    "kind, count, draws, least",
    [
        ("stratified", 4, FIRST, 0.8),
        ("stratified", 16, DEEP, 0.8),
        ("multijitter", 4, FIRST, 0.15),
        ("ldsampler", 64, FIRST, 0.15),
    ],
)
def test_numbers_of_a_sequence_are_correlated(kind, count, draws, least):
    """Rationale: why a path takes each number from a sequence of its own, and why a sampler should not
    serve all bounces; and that the test above finds what it is there for.

    Expected: of the first numbers of one sequence, or those of 16 bounces, some pair has at least that
    correlation over all pixels.
    """
    overall, _ = correlations(numbers(kind, count, draws, 1 << 15))
    assert overall.max() > least


@pytest.mark.parametrize("kind", SAMPLERS)
def test_rounded_counts_are_honoured(kind):
    """Rationale: a stratified sampler that is cut short leaves strata empty. Expected: ``spp`` and the
    sampler's own sample_count are rounded as the sampler does, which the statistics report, and the image
    is normalised by what was traced: surroundings of radiance 1, seen directly, are 1 to 1e-5.
    """
    scene = {"type": "scene", "sky": {"type": "constant", "radiance": 1.0}}
    scene["sensor"] = box_parts(kind, 5, 16)["sensor"]
    scene = mi.load_dict(scene)
    integrator = bdpt(points="sampler", light_paths=0)
    for spp, count in ((5, ROUNDED[kind][0]), (0, ROUNDED[kind][0]), (64, ROUNDED[kind][1])):
        result = image(integrator, scene, spp=spp)
        assert sum(integrator.statistics["passes"]) == count
        np.testing.assert_allclose(result, 1, rtol=1e-5)


# Direct light by the camera subpath alone: all its numbers are the sampler's, and its noise has no outliers.
DIRECT = {"points": "sampler", "light_paths": 0, "skip": "none", "max_depth": 2}


def noise(scene, integrator, first_seed, runs=16):
    """Median over the lit pixels of the variance of the green channel, relative to its square."""
    images = np.stack([image(integrator, scene, seed=first_seed + i)[..., 1] for i in range(runs)])
    images = images[:, images.mean(0) > 0]
    return np.median(images.var(0, ddof=1) / images.mean(0) ** 2)


def test_passes_and_bands_keep_what_the_sampler_spreads(monkeypatch):
    """Rationale: passes and bands of rows must go on with one set of points per pixel, not begin others.

    ``multijitter`` with 16 samples, in passes of at most 5 (4, which divides 16) and bands of 32 rows.
    Expected: the noise of one launch within 15 % (4096 pixels, 16 renders: a standard deviation of some 3 %),
    which independent numbers exceed by half, and the mean of ``path``'s renders.
    """
    scene = box("multijitter", 16)
    whole = noise(scene, bdpt(**DIRECT), 0)
    independent = noise(scene, bdpt(**DIRECT | {"points": "independent"}), 1000)
    assert independent > 1.5 * whole

    monkeypatch.setattr(schedule, "LAUNCH_SAMPLES_SAMPLER", 2048)
    cut = bdpt(spp_per_pass=5, **DIRECT)
    assert noise(scene, cut, 2000) == pytest.approx(whole, rel=0.15)
    assert cut.statistics["passes"] == [4] * 4
    everything = bdpt(points="sampler", spp_per_pass=5)
    assert_agree(compare_images(reference(), renders(scene, everything, 3000, runs=12), "cut"), at_least=16)


@pytest.mark.parametrize("kind", SAMPLERS)
def test_seeds(kind):
    """Expected: the same seed gives the same image up to rounding (1e-4); the noise of different seeds is
    independent: two differences of two images each have the same sign in half of those of the 4096 pixels in
    which neither is 0, within five standard deviations.
    """
    scene, integrator = box(kind), bdpt(points="sampler")
    again, *images = (image(integrator, scene, seed=seed)[..., 1] for seed in (1, 1, 2, 3, 4))
    np.testing.assert_allclose(again, images[0], rtol=1e-4)
    product = (images[0] - images[1]) * (images[2] - images[3])
    same = product[product != 0] > 0
    assert same.size > 2048
    assert abs(same.mean() - 0.5) < 5 * 0.5 / np.sqrt(same.size)


@pytest.mark.parametrize("kind", SAMPLERS)
def test_replicates_of_the_variance_are_whole_sets(kind):
    """Rationale: ``variance`` renders 8 independent images; each must have a number of samples that the
    sampler can make. Expected: 20 samples become 8 times what the sampler makes of 3 (2.5 on average), or
    stay 20 where it makes 2 and 3; the estimate is the variance over renders within 20 % (256 pixels; mean
    of 8 estimates, 16 renders: a standard deviation of some 4 %). Statistic: ratio of medians over pixels.
    """
    scene, integrator = box(kind, size=16), bdpt(variance=True, **DIRECT)
    layers = [image(integrator, scene, seed=i, spp=20) for i in range(16)]
    expected = {"independent": 20, "stratified": 32, "multijitter": 20, "orthogonal": 32, "ldsampler": 32}
    assert sum(integrator.statistics["passes"]) == expected[kind]
    images, estimates = np.stack(layers)[..., 1], np.stack(layers)[..., 4]
    lit = images.mean(0) > 0
    ratio = estimates.mean(0)[lit] / images.var(0, ddof=1)[lit]
    assert np.median(ratio) == pytest.approx(1, rel=0.2)


def test_numbers_come_from_the_sampler():
    """Rationale: which dimensions are served is documented. Expected: row k of `points.SAMPLER_TABLE` is, for
    pixel p, the sampler's draw k of its sequence p + k; later vertices have other numbers.
    """
    count, pixels = 16, 4
    slots = Points.sequences(pixels) * count
    drawn = numbers("stratified", count, FIRST, slots, seed=3).reshape(slots, -1)
    sampler = mi.load_dict({"type": "stratified", "sample_count": count})
    sampler.set_samples_per_wavefront(count)
    sampler.seed(3, slots)
    points = Points("sampler", mi.UInt32(7), sampler, count)
    lane = dr.arange(mi.UInt32, count * pixels)
    streams = {side: points.stream(side, mi.UInt64(lane), lane) for side in ("camera", "light")}
    column = 0
    for row, (side, purpose, vertex, dims) in enumerate(SAMPLER_TABLE):
        draw = points.draw_1d if dims == 1 else points.draw_2d
        expected = drawn[row * count : (row + pixels) * count, column : column + dims]
        values = np.atleast_2d(np.array(draw(side, streams[side], purpose, vertex))).T
        np.testing.assert_array_equal(values, expected)
        later = np.atleast_2d(np.array(draw(side, streams[side], purpose, vertex + 1))).T
        assert not (later == expected).any()
        column += dims
    assert column == drawn.shape[1] == sum(FIRST)
