"""Error bars: the layers `variance.R` … and `statistics["error"]`."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.image.replicates import Replicates
from mitsuba_bdpt.run import schedule

from scenes import renders


def scene(rfilter="box", width=12, sampler="independent"):
    box = mi.cornell_box()
    film = {"type": "hdrfilm", "width": width, "height": 12, "rfilter": {"type": rfilter}}
    box["sensor"]["film"] = film | {"pixel_format": "rgb", "component_format": "float32"}
    box["sensor"]["sampler"] = {"type": sampler, "sample_count": 16}
    return mi.load_dict(box)


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": 4, "layers": "variance"} | parameters)


def test_weighted_variance_of_a_mean():
    """Images 1, 2, 4 of 1, 1, 2 samples have the weighted mean 11/4 and sum n (x - mean)^2 = 27/4, hence the
    variance 27/4 / (4 * 2) of four samples, and 27/4 / (5 * 2) if a fifth belongs to no replicate."""
    replicates, total, spp = Replicates(), 0.0, 0
    for x, n in ((1.0, 1), (2.0, 1), (4.0, 2)):
        total, spp = total + x * n, spp + n
        replicates.add([np.array([total])], spp, lambda sums, n: sums / n)
    assert replicates.halves[0].joined(replicates.halves[1]).mean[0] == pytest.approx(11 / 4)
    assert replicates.variance(4)[0] == pytest.approx(27 / 32)
    assert replicates.variance(5)[0] == pytest.approx(27 / 40)
    assert np.isinf(Replicates().variance(4, (2, 3))).all()


def replicates(images, n):
    """`Replicates` of these images (count, ...) of ``n`` samples each."""
    found = Replicates()
    for i, total in enumerate(np.cumsum(images * n, axis=0)):
        found.add([total], (i + 1) * n, lambda sums, spp: sums / spp)
    return found


def test_the_estimated_error_sees_fireflies():
    """relMSE is about 125^2 / 100, of which the estimate sees half, in the half that has it, times 8 / 4 for
    its mean; within 2 % (epsilon moves)."""
    images = np.ones((8, 100))
    images[3, 7] = 1000
    error = replicates(images, 4).error(32, 1.0)
    epsilon = 0.01 * (1 + 999 / 800) ** 2
    assert error == pytest.approx((999 / 8) ** 2 / (1 + epsilon) / 100, rel=0.02)


def test_the_estimated_error_of_a_black_image():
    """0, so that `target_error` stops, not 0 / 0."""
    assert replicates(np.zeros((8, 4)), 4).error(32, 1.0) == 0


@pytest.mark.parametrize(("shape", "most"), [(4.0, 1.03), (0.5, 2.0)])
def test_the_estimated_error_is_that_of_skewed_images(shape, most):
    """Pixels have a gamma distribution (mean 1, variance 1 / (2 ``shape``) of each of 8 replicates). The
    estimate is the relMSE in the mean where that is 1.6 % (second order: below 3 %), and up to twice where it
    is 12 %."""
    images = np.random.default_rng(1).gamma(2 * shape, 1 / (2 * shape), (8, 100_000))
    truth = ((images.mean(0) - 1) ** 2).mean() / 1.01
    assert 0.97 * truth < replicates(images, 4).error(32, 1.0) < most * truth


@pytest.mark.parametrize(
    ("rfilter", "parameters"),
    [
        ("box", {}),
        ("gaussian", {"skip": "none"}),
        pytest.param("box", {"points": "independent", "light_paths": 0}, marks=pytest.mark.slow),
    ],
)
def test_variance_is_the_spread_over_seeds(rfilter, parameters):
    """Splats included; relative to the pixels' squared mean, so that the few at the lamp's rim do not decide.
    Tolerance: 10 %: 32 seeds give each pixel's variance to 25 %, 144 pixels of correlated channels the mean
    to 3 %."""
    target = scene(rfilter)
    integrator = bdpt(**parameters)
    assert integrator.aov_names() == ["variance.R", "variance.G", "variance.B"]
    result = renders(target, integrator, 16, 32)
    images, estimates = result[..., :3], result[..., 3:]
    scale = images.mean(0) ** 2 + 0.01 * images.mean() ** 2
    expected = (images.var(0, ddof=1) / scale).mean()
    assert (estimates.mean(0) / scale).mean() == pytest.approx(expected, rel=0.1)


def test_error_is_the_relative_error_of_the_image():
    """Tolerance: 15 %: the estimate divides by the noisy mean (some 5 % at this error), the rest as above."""
    target, integrator = scene(), bdpt()
    errors, images = [], []
    for seed in range(32):
        images.append(np.array(integrator.render(target, seed=seed, spp=64), dtype=np.float64)[..., :3])
        errors.append(integrator.statistics["error"])
    reference = np.array(integrator.render(target, seed=99, spp=8192), dtype=np.float64)[..., :3]
    expected = [((x - reference) ** 2 / (reference**2 + 0.01 * reference.mean() ** 2)).mean() for x in images]
    assert np.mean(errors) == pytest.approx(np.mean(expected), rel=0.15)


def test_the_image_is_as_good_with_it():
    """Eight short point sequences instead of one: the same mean (2 %, four standard errors), and all samples
    count."""
    target = scene()
    integrator = bdpt()
    a = renders(target, integrator, 100, 8)[..., :3]
    assert sum(integrator.statistics["passes"]) == 100
    b = renders(target, bdpt(layers=""), 100, 8, 20)
    assert b.shape[-1] == 3 and "error" not in bdpt(layers="").statistics
    assert a.mean() == pytest.approx(b.mean(), rel=0.02)


def test_schedule_of_replicates():
    """Eight parts that differ by one sample at most, the first pass of all with one sample for the scale of
    roulette."""
    settings = bdpt().settings
    steps = schedule.schedule(19, 19, settings, True)
    assert sum(s.size for s in steps) == 19 and [s.of for s in steps if s.last] == [3, 3, 3, 2, 2, 2, 2, 2]
    assert (steps[0].size, steps[0].done, steps[1].size, steps[1].done) == (1, 0, 2, 1)
    assert all(s.done == 0 and s.size == s.of for s in steps[2:])
    assert [s.replicate for s in schedule.schedule(19, 19, bdpt(layers="").settings, True)] == [0, 0]


def test_interrupted_before_there_is_a_spread():
    target, integrator = scene(), bdpt(timeout=0.0)
    result = np.array(integrator.render(target, spp=16))
    assert np.isinf(result[..., 3:]).all() and np.isfinite(result[..., :3]).all()
    assert integrator.statistics["error"] == np.inf


def test_too_few_samples_are_refused():
    with pytest.raises(ValueError, match=r"layers=variance with spp=7 .* at least 8 samples per pixel"):
        bdpt().render(scene(), spp=7)


def test_beside_strategy_images():
    target, integrator = scene(), bdpt(layers="strategies,variance")
    names = integrator.aov_names()
    result = np.array(integrator.render(target, spp=32))
    layers = dict(zip(names, np.moveaxis(result[..., 3:], -1, 0), strict=True))
    assert names[:3] == ["variance.R", "variance.G", "variance.B"]
    total = sum(layer for name, layer in layers.items() if name.startswith("weighted") and name.endswith("R"))
    np.testing.assert_allclose(total, result[..., 0], rtol=1e-3, atol=1e-5)
    assert layers["variance.R"].mean() > 0
