"""The measures of `measure.metrics` against values worked out by hand."""

import subprocess
import sys

import numpy as np
import pytest
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.measure import agreement, analysis, metrics
from mitsuba_bdpt.measure.agreement import Sample
from mitsuba_bdpt.measure.metrics import Estimate
from scipy import stats


def row(*values):
    """An image of one row of gray pixels."""
    return np.repeat(np.array(values, dtype=np.float64)[None, :, None], 3, axis=2)


def pixel(r, g, b):
    return np.array([[[r, g, b]]], dtype=np.float64)


def test_relative_errors_of_three_pixels():
    """Mean 2, so eps is 0.01 * 4 = 0.04; scaling both images changes nothing."""
    reference, image = row(0, 2, 4), row(0.2, 3, 2)
    for factor in (1, 1e3):
        found = metrics.rel_mse(factor * image, factor * reference)
        assert found == pytest.approx((1 + 1 / 4.04 + 4 / 16.04) / 3, rel=1e-12)
    assert metrics.rel_mse(reference, reference) == 0
    # Mean of (0, 3, 6) is 3; per channel it would be (0, 0.09, 0.36).
    assert metrics.rel_mse_epsilon(pixel(0, 3, 6)) == pytest.approx(0.09, rel=1e-12)


def test_trim_leaves_out_values():
    """Of 1000 pixels with 3000 values three are wrong, two of them in one pixel; reference 1, eps 0.01.

    Squares / 1.01: 100, 81, 64, and 2997 of 0.01. trim = 0.001 leaves out 3 values: 0.01 / 1.01 remains.
    trim = 2/3000 leaves out two: (64 + 2997 * 0.01) / 2998 / 1.01. Two *pixels* out would leave 0.01 too.
    """
    reference = np.ones((20, 50, 3))
    image = reference + 0.1
    image[3, 4, 0], image[3, 4, 2], image[7, 7, 1] = 11, 10, 9
    trimmed = metrics.rel_mse(image, reference, 0.001)
    assert trimmed == pytest.approx(0.01 / 1.01, rel=1e-9)
    two = metrics.rel_mse(image, reference, 2 / 3000)
    assert two == pytest.approx((64 + 2997 * 0.01) / 2998 / 1.01, rel=1e-9)
    assert metrics.rel_mse(image, reference) == pytest.approx((245 + 29.97) / 3000 / 1.01, rel=1e-9)


def test_tone_map():
    """x = 0.25 at one stop is 0.5: 1.055 * 0.5^(1/2.4) - 0.055 = 0.735357; 0.0005 becomes 12.92 * 0.001; what
    is outside [0, 1] after the exposure is clipped, so 0.6 is white. The exposure of 0.45 is one stop."""
    shown = metrics.tone_map(row(0.25, 0.0005, 0.6, -1), 1)
    assert shown == pytest.approx(row(0.735357, 0.01292, 1, 0), abs=1e-6)
    assert metrics.exposure_of(row(*[0.1] * 50, *[0.45] * 50)) == pytest.approx(1)


def pq(luminance):
    """Inverse EOTF of SMPTE ST 2084 for cd/m^2: ((c1 + c2 y^m1) / (1 + c3 y^m1))^m2, y = L / 10000."""
    y = (np.asarray(luminance) / 1e4) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * y) / (1 + 2392 / 128 * y)) ** (2523 / 32)


def test_delta_e_itp():
    """For grays L = M = S, so C_T = C_P = 0 and dE = 720 |PQ(Y) - PQ(Y')|.

    PQ(100) = 0.508078, PQ(0) = 7e-7: black and white are 365.816 apart.
    """
    assert pq(100.0) == pytest.approx(0.508078, abs=1e-6)
    assert metrics.delta_e_itp(pixel(0, 0, 0), pixel(1, 1, 1)) == pytest.approx(365.816, abs=0.01)
    expected = 720 * (pq(50.0) - pq(25.0))
    assert metrics.delta_e_itp(row(0.25), row(0.5)) == pytest.approx(expected, rel=1e-3)
    assert metrics.delta_e_itp(row(2, 3, 0.5), row(7, 1, 0.5)) == pytest.approx(0, abs=1e-9)  # above white


def test_hdr_flip():
    """The values of a fixed pair are those of the package's own command `flip` 1.7; the reference decides the
    exposures, so the order matters, and scaling both images changes nothing."""
    for factor in (1, 1e3):
        half, whole = row(0.5 * factor), row(factor)
        assert metrics.hdr_flip(half, whole) == pytest.approx(0.232887, abs=1e-4)
        assert metrics.hdr_flip(whole, half) == pytest.approx(0.144833, abs=1e-4)
        assert metrics.hdr_flip(whole, whole) == 0


def test_hdr_flip_refuses_what_ends_the_process():
    code = """
import numpy as np
from mitsuba_bdpt.measure import metrics
dark, gray = np.zeros((4, 4, 3)), np.ones((4, 4, 3))
for image, reference in ((gray, dark), (gray, 2.3e-7 * gray), (-gray, gray), (1e39 * gray, gray)):
    try:
        metrics.hdr_flip(image, reference)
    except ValueError:
        continue
    raise SystemExit("not refused")
metrics.hdr_flip(gray, 2.5e-7 * gray)
metrics.hdr_flip(dark, gray)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("measure", [metrics.rel_mse, metrics.delta_e_itp, metrics.hdr_flip])
def test_bad_images_are_refused(measure):
    good, bad = np.ones((2, 4, 3)), np.ones((2, 4, 3))
    bad[1, 2, 0] = np.nan
    for pair, why in (
        ((bad, good), r"image holds 1 values that are NaN or infinite, the first at index \[1, 2, 0\]; find"),
        ((good, -np.inf * good), "reference holds 24 values that are NaN or infinite"),
        ((np.ones((4, 2, 3)), good), r"image has shape \(4, 2, 3\) and reference \(2, 4, 3\); render"),
        ((good, np.ones((4, 3))), r"reference has shape \(4, 3\)"),
    ):
        with pytest.raises(CommandError, match=why):
            measure(*pair)
    with pytest.raises(CommandError, match="reference has mean 0"):
        metrics.rel_mse(good, 0 * good)
    with pytest.raises(CommandError, match="1 images"):
        metrics.spread([good], good)


def test_what_the_reference_adds():
    """Relative errors of the image 1, 0, 9, 0 (over r^2 + eps = 1.01), of the reference 0.01, 0.04, 0.09 and
    0.16: all of them, mean 0.075 / 1.01; without the image's worst quarter 0.07 / 1.01.
    """
    reference, image = row(1, 1, 1, 1), row(2, 1, 4, 1)
    difference = row(0.1, -0.2, 0.3, 0.4)
    assert metrics.reference_rel_mse(difference, image, reference) == pytest.approx(0.075 / 1.01)
    assert metrics.reference_rel_mse(difference, image, reference, 0.25) == pytest.approx(0.07 / 1.01)


def test_tile_means():
    """Values 0 to 15 in 4 x 4: the upper left tile holds 0, 1, 4, 5, mean 2.5; then 4.5, 10.5, 12.5."""
    image = np.arange(16.0).reshape(4, 4)[..., None] * [1, 2, 3]
    expected = np.array([2.5, 4.5, 10.5, 12.5])[:, None] * [1, 2, 3]
    assert agreement.tile_means(image, 2) == pytest.approx(expected)
    for tiles in (3, 0, 2.0):
        with pytest.raises(ValueError, match=f"tiles={tiles}.*divides height 4 and width 4"):
            agreement.tile_means(image, tiles)


def test_welch_against_a_known_value():
    """It is Student's test, as SciPy's."""
    values = np.array([1.0, 2, 3])
    found = agreement.welch(Sample.of(values[:, None]), Sample.known([5.0]))
    assert found.freedom[0] == pytest.approx(2)
    assert found.p[0] == pytest.approx(stats.ttest_1samp(values, 5).pvalue, rel=1e-3)


def test_welch_leaves_out_rounding_and_lumps():
    """Without noise only differences above 2e-5 count; tiles nonzero in 8 of 10 renders do not."""
    exact = agreement.welch(Sample.known([1.0, 1.0]), Sample.known([1 + 1e-5, 1 + 3e-5]))
    assert exact.p.tolist() == [1, 0] and not exact.continuous.any()
    lumps = np.zeros((10, 2))
    lumps[:8, 0] = lumps[:9, 1] = 1 + np.arange(9)[:, None][:8, 0].mean()
    noise = np.random.default_rng(0).normal(0, 0.1, lumps.shape) * (lumps > 0)
    found = agreement.welch(Sample.of(lumps + noise), Sample.of(0 * lumps))
    assert found.p[0] == 1 and found.p[1] < 1e-3
    assert found.continuous.tolist() == [False, True]


def renders(seed, count=16, shape=(8, 8, 3), mean=1.0):
    """Renders whose values are uniform in mean * [0.5, 1.5]: variance mean^2 / 12."""
    return mean * np.random.default_rng(seed).uniform(0.5, 1.5, (count, *shape))


def means_of(runs, tiles=agreement.TILES):
    return agreement.Means.of([agreement.tile_columns(run, tiles) for run in runs])


def bias_check(images, references, tiles=agreement.TILES, significance=agreement.SIGNIFICANCE):
    return agreement.compare_means(means_of(images, tiles), means_of(references, tiles), significance)


def test_bias_check_passes_what_agrees():
    """No bias: passes; 4 * 4 * 3 tiles and 3 channels of the image make 51 comparisons."""
    check = bias_check(renders(1), renders(2, 32))
    assert check.passed
    assert check.family_p == pytest.approx(1 - (1 - check.p) ** 51)
    assert check.difference.low < 0 < check.difference.high
    assert check.missing.low < 0 < check.missing.high
    # The interval at 95 %: error sqrt((1/16 + 1/32) / 12 / 192) = 0.0064, times 2.
    assert check.missing.high - check.missing.low == pytest.approx(4 * 0.0064, rel=0.4)


def test_bias_check_finds_a_tile():
    """The tile in row 2, column 1 lacks 0.3 in channel 1: it is named, and the missing energy is 0.3 /
    (16 tiles * 3 channels) = 0.6 %. p and interval are those of SciPy's Welch test of the tile's means."""
    images, references = renders(1), renders(2, 24)
    images[:, 4:6, 2:4, 1] *= 0.7
    check = bias_check(images, references)
    assert not check.passed and check.tile == (2, 1)
    means = [x[:, 4:6, 2:4, 1].mean((1, 2)) for x in (images, references)]
    test = stats.ttest_ind(*means, equal_var=False)
    assert check.p == pytest.approx(test.pvalue, rel=1e-2)
    interval = test.confidence_interval((1 - 1e-3) ** (1 / 51))
    expected = (means[0].mean() - means[1].mean(), interval.low, interval.high)
    found = check.difference
    assert (found.value, found.low, found.high) == pytest.approx(expected, rel=1e-9)
    whole = 1 - images.mean() / references.mean()
    assert check.missing.value == pytest.approx(whole, rel=1e-9) and abs(whole - 0.006) < 0.02


def test_bias_check_finds_what_is_common_to_all_tiles():
    """2 % everywhere: in a tile of 4 pixels it is 0.02 / sqrt(2 / 12 / 4 / 16) = 0.4 standard errors,
    in the image of 1024 pixels 6.3. The missing energy is 2 % within its interval."""
    shape = (32, 32, 3)
    check = bias_check(renders(3, shape=shape, mean=0.98), renders(4, shape=shape), tiles=16)
    assert not check.passed and check.tile is None
    assert check.missing.low < 0.02 < check.missing.high and check.missing.low > 0.01


def test_bias_check_of_a_black_image():
    check = bias_check(np.zeros((8, 8, 8, 3)), renders(1))
    assert not check.passed and check.p < 1e-12
    assert (check.missing.value, check.missing.low, check.missing.high) == (1, 1, 1)


def test_bias_check_names_the_largest_of_certain_differences():
    """Without noise every difference has p = 0: the tile that is off by 0.5 is named, not the first."""
    image = np.ones((4, 4, 3))
    image[0, 0], image[2:, 2:, 2] = 1.125, 1.5
    check = agreement.compare_means(means_of([image] * 8, 2), agreement.Means.known(np.ones((4, 4, 3)), 2))
    assert check.p == 0 and check.tile == (1, 1)
    assert check.difference == Estimate(0.5, 0.5, 0.5)


def test_missing_energy():
    """Means 3 +- 0.1 and 4 +- 0.2, freedom 8 and 10: 1 - 3/4. Variances (0.1 / 4)^2 = 0.000625 and
    (3 * 0.2 / 16)^2 = 0.00140625, t at 97.5 % of 8 and 10 degrees 2.30600 and 2.22814, so
    +- sqrt(2.30600^2 * 0.000625 + 2.22814^2 * 0.00140625) = 0.101513."""
    one = np.ones(1)
    found = agreement.missing_energy(Sample(3 * one, 0.1 * one, 8, one), Sample(4 * one, 0.2 * one, 10, one))
    assert found.value == pytest.approx(0.25)
    assert (found.low, found.high) == pytest.approx((0.25 - 0.101513, 0.25 + 0.101513), abs=2e-5)


def test_bias_check_keeps_its_level():
    """False alarms at a significance of 5 %, 300 families of 16 renders and 16 references with no bias. 15;
    Welch's test in the far tail allows twice that. More than 40 have a binomial chance of 4 % if the level is
    10 %, and fewer than 4 one of 2e-4 if it is 5 %."""
    failed = 0
    for seed in range(300):
        runs = renders(seed, 32, (4, 4, 3))
        failed += not bias_check(runs[:16], runs[16:], 2, 0.05).passed
    assert 4 <= failed <= 40


def test_bias_check_refuses():
    good = renders(1)
    with pytest.raises(ValueError, match="7 renders are too few.*give 8 or more"):
        bias_check(good, good[:7])
    with pytest.raises(ValueError, match="references have mean 0"):
        bias_check(good, 0 * good)


def test_slope():
    """x = log 2 * (0, 1, 3), two runs at the first count and the last, four in the middle.

    In units of log 2: mean x = 1.25, offsets -1.25, -0.25, 1.75, sum of squares 9.5. Mean logs 0, -2, -3:
    (2 * 0 + 4 * 0.25 * 2 - 2 * 1.75 * 3) / 9.5 = -8.5 / 9.5.
    """
    errors = {1: [0.5, 2], 2: [0.25, 0.25, 0.125, 0.5], 8: [0.125, 0.125]}
    found = analysis.slope(errors.keys(), errors.values())
    assert found.value == pytest.approx(-8.5 / 9.5, rel=1e-12)
    assert found.low < found.value < found.high


def test_slope_interval_covers():
    """The 95 % interval holds -1 in 90 to 99.5 % of 200 series of 5 runs at 4 counts (log-normal errors).

    Without the factor sqrt(k / (k - 1)) it is 0.89 of the width; the width is tested against the exact
    standard error, 0.3 / sqrt(5 * sum of squared offsets), within 10 % on average.
    """
    rng = np.random.default_rng(2)
    samples = np.array([4, 16, 64, 256])
    hits, widths = 0, []
    for _ in range(200):
        errors = np.exp(rng.normal(0, 0.3, (4, 5))) / samples[:, None]
        found = analysis.slope(samples, errors)
        hits += found.low <= -1 <= found.high
        widths.append((found.high - found.low) ** 2)
    offsets = np.log(samples) - np.log(samples).mean()
    exact = 2 * 1.96 * 0.3 / np.sqrt(5 * np.sum(offsets**2))
    assert 180 <= hits <= 199
    assert np.sqrt(np.mean(widths)) == pytest.approx(exact, rel=0.05)


def test_bootstrap_of_the_median():
    """Of 3, 1, 2 the median of a resample is 1 if two or three of it are 1: 3 * (1/9) * (2/3) + 1/27 =
    7/27 = 26 %, above the tail of 2.5 %, so the interval is [1, 3]."""
    assert analysis.summary([3, 1, 2]) == analysis.Summary(2, 1, 3, 1, 3, 3)
