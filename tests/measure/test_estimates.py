"""The error of an integrator from few seeds and a noisy reference: images of known variance and bias."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from mitsuba_bdpt.measure import estimates, metrics
from mitsuba_bdpt.measure.agreement import Means, tile_columns
from mitsuba_bdpt.measure.analysis import Results
from mitsuba_bdpt.measure.reference import Reference
from support.measured import judged

SHAPE = (64, 64, 3)
TRUTH = np.random.default_rng(1).uniform(0.5, 2, SHAPE)


def noise(seed, sigma=0.1):
    """Gaussian noise relative to the truth."""
    return sigma * TRUTH * np.random.default_rng(seed).standard_normal(SHAPE)


def halves(sigma, truth=TRUTH):
    """A reference whose own standard error is ``sigma`` of the truth, with the means of 8 renders."""
    a, b = (truth + noise(seed, sigma * math.sqrt(2)) for seed in (901, 902))
    columns = [tile_columns(truth + noise(910 + i, sigma * math.sqrt(8))) for i in range(8)]
    return Reference((a + b) / 2, (a - b) / 2, Means.of(columns), {})


def rows_of(images, reference, method="bdpt"):
    """What a sweep stores of the images of one budget."""
    spread = metrics.spread(images, reference.image) if len(images) > 1 else [None]
    found = enumerate(zip(images, spread, strict=True), 1)
    return pd.DataFrame([judged(method, seed, x, reference, variance=v) for seed, (x, v) in found])


def results_of(reference, *rows):
    return Results(pd.concat(rows, ignore_index=True), {"box": reference.means})


def known(deviation, reference, trim=0.0):
    """The mean of squared deviations from the truth with the weights of relMSE."""
    return metrics.rel_mse(reference.image + deviation, reference.image, trim)


def cell(images, reference, error="rel_mse", method="bdpt"):
    return results_of(reference, rows_of(images, reference, method)).error("box", method, error)


@pytest.mark.parametrize("own", [0.01, 0.05, 0.07])
def test_the_variance_of_an_unbiased_integrator(own):
    """Renders of 10 % noise against references that carry 1 %, 20 % and 33 % of the error measured. The known
    variance within 4 %, three standard errors of sqrt(2 / 61,000) and 0.1 % of trimmed values; no bound; what
    has the reference in it (trimmed, squared bias) within its second order too, 9 times its relative
    variance, which the weights share: 4.4 % at most."""
    reference = halves(own)
    images = [TRUTH + noise(seed) for seed in range(5)]
    expected = known(0.1 * TRUTH, reference)
    raw, trimmed = (cell(images, reference, error) for error in ("rel_mse", "rel_mse_trimmed"))
    assert raw.bound == trimmed.bound == cell(images[:3], reference).bound == "" and raw.count == 5
    assert raw.total.value == pytest.approx(raw.variance.value)
    assert raw.variance.value == pytest.approx(expected, rel=0.04)
    deviations = [known(image - TRUTH, reference, metrics.TRIM) for image in images]
    assert trimmed.total.value == pytest.approx(np.mean(deviations), rel=0.04 + 9 * own**2)
    assert raw.total.low < expected < raw.total.high
    assert abs(raw.squared_bias.value) < (0.02 + 9 * own**2) * expected


@pytest.mark.parametrize("own", [0.01, 0.03])
@pytest.mark.parametrize("count", [3, 5, 12])
def test_variance_and_bias_apart(own, count):
    """A tenth of the light is missing everywhere. Variance and squared bias as known, within 4 % and, of the
    squared bias, 4 times the reference's relative variance over its root (the weights share the reference's
    noise): 3.6 % of it; their sum is the error, a lower bound; the bias check says what is missing from 8
    renders on."""
    reference = halves(own)
    images = [0.9 * TRUTH + noise(seed) for seed in range(count)]
    found = cell(images, reference)
    assert found.bound == "≥"
    assert found.variance.value == pytest.approx(known(0.1 * TRUTH, reference), rel=0.04)
    assert found.squared_bias.value == pytest.approx(known(0.1 * TRUTH, reference), rel=0.04 + 40 * own**2)
    assert found.total.value == pytest.approx(found.variance.value + found.squared_bias.value)
    assert found.squared_bias.low < found.squared_bias.value < found.squared_bias.high
    assert cell(images, reference, "rel_mse_trimmed").bound == "≥"
    results = results_of(reference, rows_of(images, reference))
    assert ("% of the energy is missing" in results.lacks("box", "bdpt")) == (count == 12)


def test_the_squared_bias_is_the_mean_of_products_of_pairs():
    reference = halves(0.03)
    weights = reference.image**2 + metrics.rel_mse_epsilon(reference.image)
    a, b = reference.image + reference.difference, reference.image - reference.difference
    images = [0.97 * TRUTH + noise(seed) for seed in range(4)]

    def products(some):
        pairs = [(x - a) * (y - b) for i, x in enumerate(some) for j, y in enumerate(some) if i != j]
        return float(np.mean(pairs / weights))

    found = estimates.squared_bias(rows_of(images, reference))
    assert found.value == pytest.approx(products(images), rel=1e-9)
    without = np.array([products(images[:i] + images[i + 1 :]) for i in range(4)])
    half = 3.182 * math.sqrt(3 / 4 * np.sum((without - without.mean()) ** 2))  # Student's t of 3 degrees
    assert found.high - found.value == pytest.approx(half, rel=1e-3)


def test_intervals_that_are_not_given_say_why():
    """By one render that decides, or the reference's noise, a third of the error, which all renders share."""
    images = [TRUTH + noise(seed) for seed in range(5)]
    assert cell(images, halves(0.07)).parts[1].endswith("(no interval: the reference is too noisy)")
    images[2][10, 20, 1] += 3000
    raw = cell(images, halves(0.01))
    assert f"{raw}".endswith("(no interval: one render decides)")


def test_the_normaliser_is_not_of_the_renders_that_are_judged():
    """Both have the same relMSE, within a fifth (80 fireflies); by their own means they have not."""
    reference, rng = halves(0.01), np.random.default_rng(5)
    share, count = 0.001, 8
    even = [TRUTH + noise(seed, 0.3) for seed in range(count)]
    spiky = []
    for _ in range(count):
        found = rng.random(SHAPE) < share
        spiky.append(TRUTH * (1 + 0.3 * (found / share - 1) / math.sqrt((1 - share) / share)))
    errors = [
        estimates.relative_error(rows_of(images, reference), "rel_mse", False).total.value
        for images in (spiky, even)
    ]
    ratio = errors[0] / errors[1]
    assert ratio == pytest.approx(1, rel=0.2)
    flattered = [np.mean(metrics.spread(images, np.mean(images, axis=0))) for images in (spiky, even)]
    assert flattered[0] / flattered[1] < 0.6 * ratio


def test_rare_light_that_was_not_met_is_a_lower_bound():
    """A squared bias of 0.25 * 0.2^2 = 0.01 on a variance of 0.01; by the variance alone it is half."""
    reference = halves(0.01)
    dark = TRUTH.copy()
    dark[:32, :32] *= 0.8
    ours = [TRUTH + noise(seed, 0.02) for seed in range(5)]
    theirs = [dark + noise(100 + seed) for seed in range(5)]
    results = results_of(reference, rows_of(ours, reference), rows_of(theirs, reference, "path"))
    found = results.efficiency("box", "path", "rel_mse")
    assert found.bound == "≥" and found.median == pytest.approx(25 * 2, rel=0.05)
    assert f"{found}".startswith("≥ ")
    alone = replace(results, references={}).efficiency("box", "path", "rel_mse")
    assert alone.bound == "" and alone.median == pytest.approx(25, rel=0.05)


def test_what_both_lack_is_no_difference():
    """Raw the ratio of variances, 4; by the errors to the truth it would be (4 + 1) / (1 + 1)."""
    reference = halves(0.01)
    ours = rows_of([0.9 * TRUTH + noise(seed) for seed in range(8)], reference)
    theirs = rows_of([0.9 * TRUTH + noise(50 + seed, 0.2) for seed in range(8)], reference, "path")
    results = results_of(reference, ours, theirs)
    found = results.efficiency("box", "path", "rel_mse")
    assert found.bound == "" and found.median == pytest.approx(4, rel=0.05)
    assert results.efficiency("box", "path").bound == "~"


def test_each_seed_has_its_own_fireflies():
    reference = halves(0.01)
    images = [TRUTH + noise(seed) for seed in range(5)]
    images[2][10, 20, 1] += 300
    rows = rows_of(images, reference)
    values, bound = estimates.seed_errors(rows, "rel_mse", False)
    expected = known(0.1 * TRUTH, reference)
    assert bound == "" and np.mean(values) == pytest.approx(rows["variance"].mean())
    assert np.delete(values, 2) == pytest.approx(expected, rel=0.06)
    assert values[2] > 100 * expected and rows["variance"][0] > 2 * expected


def test_a_reference_noisier_than_the_renders():
    """Renders of 1 % noise, a reference of 10 %: the variance needs no reference."""
    reference = halves(0.1)
    images = [TRUTH + noise(seed, 0.01) for seed in range(5)]
    raw, trimmed = (cell(images, reference, error) for error in ("rel_mse", "rel_mse_trimmed"))
    assert raw.bound == "" and raw.total.value == pytest.approx(known(0.01 * TRUTH, reference), rel=0.04)
    assert trimmed.bound == "≤" and trimmed.total.value > 50 * raw.total.value
    two = cell(images[:2], reference)  # no bias can be seen
    assert two.bound == "≥" and two.total == two.variance and two.total.high == math.inf
    assert two.total.value == pytest.approx(known(0.01 * TRUTH, reference), rel=0.04)


def test_weights_share_the_noise_of_the_reference():
    """Gamma noise, 10 % in the renders. By a reference with an own relMSE of 0.1, three fifths of the error
    measured, more than twice the error remains; by one of 0.005 it is right within a tenth."""
    rng = np.random.default_rng(3)

    def gamma(variance):
        return TRUTH * rng.gamma(1 / variance, variance, SHAPE)

    images = [gamma(0.01) for _ in range(5)]
    for own, bound in ((0.1, "≤"), (0.005, "")):
        a, b = gamma(2 * own), gamma(2 * own)
        rows = rows_of(images, Reference((a + b) / 2, (a - b) / 2, None, {}))
        assert rows["reference_rel_mse"].sum() < 0.9 * rows["rel_mse"].sum()
        remains = float((rows["rel_mse"] - rows["reference_rel_mse"]).mean()) / known(
            0.1 * TRUTH, halves(0.01)
        )
        assert remains > 2 if bound else remains == pytest.approx(1, rel=0.1)
        assert estimates.relative_error(rows, "rel_mse_trimmed", False).bound == bound


@pytest.mark.parametrize("count", [1, 2])
def test_an_untested_error_has_the_bias(count):
    """Within 4 % of 61,000 values and 40 times the reference's relative variance."""
    reference = halves(0.01)
    images = [0.9 * TRUTH + noise(seed) for seed in range(count)]
    expected = 2 * known(0.1 * TRUTH, reference)
    found = cell(images, reference)
    assert found.bound == "" and found.total.value == pytest.approx(expected, rel=0.05)
    if count == 1:
        assert (found.total.low, found.total.high, found.variance) == (0, math.inf, None)
        assert f"{found}".endswith("(one render)")
    theirs = rows_of(images, reference, "path")
    values, _ = estimates.seed_errors(theirs, "rel_mse", False)
    assert list(values) == pytest.approx([expected] * count, rel=0.05)
    if count == 2:
        assert found.total.low < found.total.value < found.total.high < math.inf
        assert found.total.value == pytest.approx(found.variance.value + found.squared_bias.value)
        assert all(part.endswith("(too few renders for an interval)") for part in found.parts)
        ours = rows_of([TRUTH + noise(50 + seed) for seed in range(count)], reference)
        ratio = results_of(reference, ours, theirs).efficiency("box", "path", "rel_mse")
        assert ratio.bound == "" and ratio.median == pytest.approx(2, rel=0.08)


def spreads(values):
    """The column `variance` of renders (n, pixels)."""
    n = len(values)
    return pd.DataFrame({"variance": n / (n - 1) * ((values - values.mean(0)) ** 2).mean(1)})


@pytest.mark.parametrize(
    ("kind", "least", "most"),
    [("normal", 0.92, 1), ("few pixels", 0.92, 1), ("lognormal", 0.86, 1), ("rare", 0.0, 0.6)],
)
@pytest.mark.parametrize("count", [3, 5, 8])
def test_the_interval_of_the_variance(kind, least, most, count):
    """Renders of 768 values whose variance is known: normal; a hundredth of them with most of the noise;
    lognormal of deviation 1; spikes met once in ten thousand values with four fifths of the variance. The
    known variance in 95 % of 300 intervals, at least 92 % (2.4 standard errors of 1.3 %), of lognormal values
    a little less, as bootstraps of few heavy-tailed values; hardly where spikes are mostly not met, as the
    docstring says."""
    rng, pixels, held = np.random.default_rng(3), 768, 0
    sigma = np.where(np.arange(pixels) % 100 == 0, 10.0, 0.3)
    p = 1e-4
    for _ in range(300):
        normal = rng.standard_normal((count, pixels))
        images, true = {
            "normal": (normal, 1.0),
            "few pixels": (sigma * normal, float(np.mean(sigma**2))),
            "lognormal": (np.exp(normal), math.e * (math.e - 1)),
            "rare": ((rng.random(normal.shape) < p) / math.sqrt(p) + 0.5 * normal, 1 - p + 0.25),
        }[kind]
        found = estimates.variance(spreads(images))
        held += found.low < true < found.high
    assert least <= held / 300 <= most


def test_the_interval_of_the_variance_is_that_without_each_render():
    reference = halves(0.01)
    images = [TRUTH + noise(seed) for seed in range(5)]
    found = cell(images, reference)
    assert found.total == found.variance
    without = np.log(
        [np.mean(metrics.spread(images[:i] + images[i + 1 :], reference.image)) for i in range(5)]
    )
    half = 2.7764 * math.sqrt(4 / 5 * np.sum((without - without.mean()) ** 2))  # Student's t of 4 degrees
    assert math.log(found.variance.high / found.variance.value) == pytest.approx(half, rel=1e-3)


def test_intervals_hold_the_mean():
    """In 95 % of 400 intervals, at least 92 % (three standard errors of 1.1 %); with a tail in fewer."""
    rng = np.random.default_rng(7)

    def held(sigma):
        found = [estimates.mean_of(np.exp(rng.normal(0, sigma, 5))) for _ in range(400)]
        assert all(0 < one.low <= one.value <= one.high for one in found)
        return np.mean([one.low < math.exp(sigma**2 / 2) < one.high for one in found])

    assert held(0.3) > 0.92
    assert 0.6 < held(1.5) < 0.92
    exact = estimates.mean_of([0.0, 0.0, 0.0])
    assert exact.low == exact.value == exact.high == 0


def test_bounds_of_ratios():
    ratios = ("", "", ""), ("≥", "", "≥"), ("", "≥", "≤"), ("≥", "≥", "~"), ("≤", "", "≤"), ("≥", "≤", "≥")
    for over, under, ratio in (*ratios, ("", "≤", "≥")):
        assert estimates.bound_of_ratio(over, under) == ratio
