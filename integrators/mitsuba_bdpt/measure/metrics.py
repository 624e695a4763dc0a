"""Measures of error, colour difference, bias and speed, each with its formula and its source.

Images are floats in linear sRGB of shape (height, width, 3), any float type; the arithmetic is float64.
What would make a number meaningless (another shape, NaN or infinite values, a black reference where one
divides by it) is refused with ``ValueError`` or ``TypeError``; nothing is replaced by 0. No function prints,
writes, or renders.

colour-science and flip-evaluator are imported when first used, since they take seconds to load.
"""

from __future__ import annotations

import functools
import math
import warnings
from dataclasses import dataclass
from numbers import Integral, Real
from typing import NamedTuple

import numpy as np
from scipy import stats

from ..errors import CommandError

# Confidence of an interval that is not asked for another.
CONFIDENCE = 0.95

# Resamples of a bootstrap. The ends of a 95 % interval then move by 1 % of its width from seed to seed.
RESAMPLES = 10_000

# What float32 arithmetic alone may do to a tile's mean, relative: differences below are no finding.
ROUNDING = 2e-5

# Tiles that are nonzero in fewer renders on both sides hold a few lumps, which are not normal.
NONZERO_SHARE = 0.9

# Renders that a bias check takes at least. Sidak asks for the far tail, where Welch's test fails too often
# for few of them. At a significance of 1e-3 over 48 values, normal and as noisy as those of 64 references,
# the chance of a false alarm is 4 % for 5 renders, 0.9 % for 8, 0.2 % for 12 and 16 (8000 simulated).
FEWEST_RUNS = 8

# Tiles of a bias check along an edge of the image, and the chance of a false alarm of a whole check.
TILES = 4
SIGNIFICANCE = 1e-3

# Luminance of display white in cd/m^2: that of standard-dynamic-range video, ITU-R BT.2035.
WHITE = 100.0

# Share of the worst values that the trimmed relMSE leaves out.
TRIM = 0.001

# Share of the measured error that the reference's own error may have.
REFERENCE_SHARE = 0.01

# HDR-FLIP clamps luminances here (float32's epsilon), and ends the process if all are below.
FLIP_DARKEST = 2.0**-23


@dataclass(frozen=True)
class Estimate:
    """A value and the interval [low, high] that holds the true one with the stated confidence."""

    value: float
    low: float
    high: float


class Measurement(NamedTuple):
    """Wall seconds of a render and its error (a squared one: relMSE or MSE)."""

    seconds: float
    error: float


def _floats(name, value, shape) -> np.ndarray:
    """``value`` as finite float64 with as many axes as ``shape`` has words, the last of length 3."""
    words = "(" + ", ".join(shape) + ")"
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise CommandError(f"{name} holds arrays of unlike shapes; give one of shape {words}.") from error
    if not np.issubdtype(array.dtype, np.floating):
        raise TypeError(
            f"{name} has values of type {array.dtype}; give linear radiance as floats of shape {words}."
        )
    if array.ndim != len(shape) or array.shape[-1] != 3 or array.size == 0:
        raise CommandError(
            f"{name} has shape {array.shape} and must have {words}; drop other channels with [..., :3]."
        )
    wrong = np.argwhere(~np.isfinite(array))
    if len(wrong):
        first = tuple(int(i) for i in wrong[0])
        raise CommandError(
            f"{name} holds {len(wrong)} values that are NaN or infinite, the first {array[first]} at index "
            f"{first}; find what made them in the renderer: no measure is defined for such an image."
        )
    return array.astype(np.float64)


def _image(name, value) -> np.ndarray:
    return _floats(name, value, ("height", "width", "3"))


def _pair(image, reference):
    """Both images, checked, as float64 of shape (height, width, 3)."""
    image, reference = _image("image", image), _image("reference", reference)
    if image.shape != reference.shape:
        raise CommandError(
            f"image has shape {image.shape} and reference {reference.shape}; render both at the same size."
        )
    return image, reference


def _number(name, value, low=-math.inf, high=math.inf) -> float:
    """A finite float in the open interval (low, high)."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name}={value!r} must be a number.")
    if not (math.isfinite(value) and low < value < high):
        bounds = f"above {low:g}" if high == math.inf else f"between {low:g} and {high:g}, ends excluded"
        raise CommandError(
            f"{name}={value!r} must be finite" + (f" and {bounds}." if low > -math.inf else ".")
        )
    return float(value)


def _values(name, values, at_least, low=-math.inf) -> np.ndarray:
    """A vector of at least so many finite float64, each above ``low``."""
    try:
        array = np.asarray(list(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}={values!r} must be a row of numbers.") from error
    if array.ndim != 1 or len(array) < at_least:
        raise CommandError(f"{name} has shape {array.shape}; give at least {at_least} numbers in one row.")
    if not (np.isfinite(array) & (array > low)).all():
        bound = f" and above {low:g}" if low > -math.inf else ""
        raise CommandError(f"{name}={array.tolist()} must be finite{bound}; leave out runs that failed.")
    return array


def mse(image, reference) -> float:
    """Mean squared error: mean of (x - r)^2 over pixels and channels, in squared units of radiance."""
    image, reference = _pair(image, reference)
    return float(np.mean((image - reference) ** 2))


def rel_mse_epsilon(reference) -> float:
    """The eps of `rel_mse`: 0.01 mean(r)^2 over pixels and channels, in squared units of radiance.

    It keeps dark pixels from deciding: where r is a tenth of the mean, r^2 and eps weigh the same.
    """
    epsilon = 0.01 * float(_image("reference", reference).mean()) ** 2
    if not epsilon > 0:
        raise CommandError("reference has mean 0, so nothing is relative to it; use mse.")
    return epsilon


def rel_mse(image, reference, trim=0.0) -> float:
    """Relative mean squared error: mean of (x - r)^2 / (r^2 + eps) over pixels and channels.

    eps is `rel_mse_epsilon`. Source: F. Rousselle, C. Knaus, M. Zwicker, Adaptive Sampling and
    Reconstruction using Greedy Error Minimization, SIGGRAPH Asia 2011, there with a constant 0.01; ours
    follows the image's brightness, so scaling both images changes nothing.

    ``trim``: share of the worst values left out, round(trim * n) of the n = 3 * height * width ones, 0.001
    for the *trimmed* relMSE. It leaves out values, not pixels: of a pixel it may take one channel. With less
    than 500 values 0.001 of them rounds to none. Trimmed figures depend on the budget (more samples have more
    rare values): state the samples with them.
    """
    error, kept = _relative_errors(image, reference, trim)
    return float(error[kept].mean())


def reference_rel_mse(difference, image, reference, trim=0.0) -> float:
    """What the reference's own error adds to ``rel_mse(image, reference, trim)``.

    ``difference``: an image of the reference's error, as half the difference of two halves of it. Its relMSE
    over the values that the measurement keeps: those that are trimmed are the image's worst, not the
    reference's.
    """
    _, kept = _relative_errors(image, reference, trim)
    difference = _image("difference", difference)
    own, _ = _relative_errors(_image("reference", reference) + difference, reference, 0.0)
    return float(own[kept].mean())


def _relative_errors(image, reference, trim):
    """Squared relative errors (n,), and the indices of those that are not trimmed."""
    image, reference = _pair(image, reference)
    if trim != 0:
        trim = _number("trim", trim, 0, 1)
    error = ((image - reference) ** 2 / (reference**2 + rel_mse_epsilon(reference))).ravel()
    keep = len(error) - round(trim * len(error))
    if keep == 0:
        raise CommandError(f"trim={trim} leaves none of {len(error)} values; choose a smaller share.")
    return error, np.argpartition(error, keep - 1)[:keep]


def mape(image, reference) -> float:
    """Mean absolute relative error: mean of |x - r| / (|r| + eps1) over pixels and channels; 1 is 100 %.

    eps1 = 0.01 mean(r): small against what is seen, so only pixels below a hundredth of the mean count
    less than their relative error, and 0 / 0 in black ones is 0.
    """
    image, reference = _pair(image, reference)
    epsilon = 0.01 * float(reference.mean())
    if not epsilon > 0:
        raise CommandError(f"reference has mean {reference.mean():g}, so nothing is relative to it; use mse.")
    return float(np.mean(np.abs(image - reference) / (np.abs(reference) + epsilon)))


def energy_in_black(image, reference) -> float:
    """Share of the image's energy where the reference is black: sum of x over those pixels / sum of x.

    Black are pixels in which all three channels of the reference are exactly 0. An image without energy has
    none there either: 0.
    """
    image, reference = _pair(image, reference)
    if image.min() < 0:
        raise CommandError(f"image holds negative values down to {image.min():g}; energies must not cancel.")
    total = image.sum()
    black = (reference == 0).all(axis=-1)
    return float(image[black].sum() / total) if total > 0 else 0.0


def tone_map(image, exposure=0.0) -> np.ndarray:
    """What a display shows: sRGB-encoded values in [0, 1], shape (height, width, 3).

    x = clip(image * 2^exposure, 0, 1) with ``exposure`` in stops, then the transfer function of
    IEC 61966-2-1: 12.92 x up to 0.0031308, above it 1.055 x^(1/2.4) - 0.055. Negative values (filters with
    negative lobes) become black, as on a display.
    """
    x = np.clip(_image("image", image) * 2.0 ** _number("exposure", exposure, -100, 100), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


@functools.cache
def _colour():
    """The package colour, without its notes on packages that it misses and that are not used here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour


def delta_e_2000(image, reference, exposure=0.0) -> float:
    """Mean over pixels of CIEDE2000 between both images as `tone_map` shows them; 1 is just visible.

    sRGB to XYZ to L*a*b* under D65, k_L = k_C = k_H = 1. Source: CIE 142-2001; G. Sharma, W. Wu,
    E. Dalal, The CIEDE2000 color-difference formula, 2005.
    """
    colour = _colour()
    labs = [colour.XYZ_to_Lab(colour.sRGB_to_XYZ(tone_map(x, exposure))) for x in _pair(image, reference)]
    return float(np.mean(colour.delta_E(*labs, method="CIE 2000")))


def delta_e_itp(image, reference, exposure=0.0, white=WHITE) -> float:
    """Mean over pixels of Delta E ITP between both images as `tone_map` shows them; 1 is just visible.

    720 sqrt(dI^2 + (dC_T / 2)^2 + dC_P^2) in IC_TC_P of BT.2100 (PQ), linear BT.2020 in cd/m^2 with 1 at
    ``white``. Source: Recommendation ITU-R BT.2124. It tells dark differences better than `delta_e_2000`.
    """
    colour = _colour()
    white = _number("white", white, 0)
    encoded = []
    for x in _pair(image, reference):
        linear = colour.RGB_to_RGB(tone_map(x, exposure), "sRGB", "ITU-R BT.2020", apply_cctf_decoding=True)
        encoded.append(colour.RGB_to_ICtCp(white * np.maximum(linear, 0)))
    return float(np.mean(colour.difference.delta_E_ITP(*encoded)))


def hdr_flip(image, reference):
    """Mean HDR-FLIP error in [0, 1] and the error map (height, width), float32.

    The largest LDR-FLIP error over a range of exposures that is chosen from the reference, ACES tone
    mapping, 67 pixels per degree (a 0.7 m wide screen of 3840 pixels seen from 0.7 m). Not symmetric: the
    reference decides the exposures. Where more than half of it is black, these reach 24 stops beyond its
    highlights and any light in black counts nearly 1. Source: P. Andersson, J. Nilsson, P. Shirley,
    T. Akenine-Moller, Visualizing Errors in Rendered High Dynamic Range Images, Eurographics 2021.
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise CommandError("hdr_flip needs flip-evaluator: pip install 'mitsuba-bdpt[measure]'.") from error
    pair = _pair(image, reference)
    for name, x in zip(("image", "reference"), pair, strict=True):
        if x.min() < 0 or x.max() > np.finfo(np.float32).max:
            raise CommandError(
                f"{name} holds values from {x.min():g} to {x.max():g}; HDR-FLIP needs 0 to 3e38."
            )
    image, reference = (x.astype(np.float32) for x in pair)
    brightest = float((reference @ np.array([0.2126, 0.7152, 0.0722], np.float32)).max())
    if brightest < 2 * FLIP_DARKEST:
        raise CommandError(
            f"reference has luminances up to {brightest:g} only, and HDR-FLIP cannot expose less than "
            f"{2 * FLIP_DARKEST:.1g}; scale both images by the same factor, or use mse if it is black."
        )
    error_map, mean, _ = flip_evaluator.evaluate(reference, image, "HDR", applyMagma=False)
    return float(mean), np.asarray(error_map).reshape(reference.shape[:2])


def tile_means(image, tiles: int) -> np.ndarray:
    """Means over ``tiles`` x ``tiles`` tiles of an image (height, width, channels), flattened to
    (tiles * tiles, channels), row by row. The size must be divisible by ``tiles``."""
    image = np.asarray(image, dtype=np.float64)
    h, w, c = image.shape
    if not isinstance(tiles, Integral) or tiles < 1 or h % tiles or w % tiles:
        raise CommandError(f"tiles={tiles!r} must be an integer that divides height {h} and width {w}.")
    parts = image.reshape(tiles, h // tiles, tiles, w // tiles, c)
    return parts.mean(axis=(1, 3)).reshape(tiles * tiles, c)


@dataclass(frozen=True)
class Sample:
    """Means (m,) of m quantities, their standard errors (m,), the errors' degrees of freedom, and the share
    of the renders in which each is nonzero (m,)."""

    mean: np.ndarray
    error: np.ndarray
    freedom: float
    nonzero: np.ndarray

    @staticmethod
    def of(values) -> Sample:
        """From ``values`` (renders, m)."""
        values = np.asarray(values, dtype=np.float64)
        error = values.std(0, ddof=1) / np.sqrt(len(values))
        return Sample(values.mean(0), error, len(values) - 1.0, (values != 0).mean(0))

    def joined(self, other: Sample) -> Sample:
        """What `of` gives for the renders of both."""
        a, b = self.freedom + 1, other.freedom + 1
        mean = (a * self.mean + b * other.mean) / (a + b)
        squares = sum((n - 1) * n * s.error**2 for n, s in ((a, self), (b, other)))
        squares = squares + a * b / (a + b) * (self.mean - other.mean) ** 2
        error = np.sqrt(squares / ((a + b) * (a + b - 1)))
        return Sample(mean, error, a + b - 1, (a * self.nonzero + b * other.nonzero) / (a + b))

    @staticmethod
    def known(mean, error=0.0) -> Sample:
        """Values (m,) whose standard errors are known rather than estimated."""
        mean = np.asarray(mean, dtype=np.float64)
        return Sample(mean, np.broadcast_to(error, mean.shape), np.inf, np.ones_like(mean))


def satterthwaite(variance_a, freedom_a, variance_b, freedom_b):
    """Degrees of freedom of a sum of two estimated variances, 1 / (c^2 / n_a + (1 - c)^2 / n_b) with
    c = a / (a + b), and 1 where both are 0. Source: B. L. Welch, Biometrika 34, 1947."""
    total = np.asarray(variance_a + variance_b, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = variance_a / total
        freedom = 1 / (share**2 / freedom_a + (1 - share) ** 2 / freedom_b)
    return np.where(total > 0, freedom, 1.0)


class Difference(NamedTuple):
    """Of m quantities, each (m,): mean a - mean b, its standard error and degrees of freedom, the p-value,
    and whether that one is uniform if nothing differs (not where rounding or a few lumps decide)."""

    value: np.ndarray
    error: np.ndarray
    freedom: np.ndarray
    p: np.ndarray
    continuous: np.ndarray


def welch(a: Sample, b: Sample) -> Difference:
    """Welch's unequal-variances t-test of each quantity; Student's where one side is known exactly.

    Two-sided: t = |a - b| / hypot(error_a, error_b). Differences within `ROUNDING` of the larger mean count
    as none. Where both sides are nonzero in less than `NONZERO_SHARE` of the renders it does not apply, and
    p is 1.
    """
    error = np.hypot(a.error, b.error)
    gap = np.abs(a.mean - b.mean)
    floor = ROUNDING * np.maximum(np.abs(a.mean), np.abs(b.mean))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(error > 0, np.maximum(gap - floor, 0) / error, np.where(gap > floor, np.inf, 0))
    freedom = satterthwaite(a.error**2, a.freedom, b.error**2, b.freedom)
    applies = np.maximum(a.nonzero, b.nonzero) >= NONZERO_SHARE
    p = np.where(applies, 2 * stats.t.sf(t, freedom), 1.0)
    return Difference(a.mean - b.mean, error, freedom, p, applies & (error > 10 * floor))


def sidak(p) -> float:
    """Chance that the smallest of so many independent p-values is as small as it is."""
    p = np.asarray(p, dtype=np.float64)
    return float(-np.expm1(len(p) * np.log1p(-min(p.min(), 1 - 1e-16))))


@dataclass(frozen=True)
class BiasCheck:
    """What `bias_check` finds.

    ``passed``: no difference at the significance asked for; ``p``: the smallest p-value; ``family_p``: the
    same after Sidak's correction for all ``comparisons``; ``tile``: (row, column) of the worst tile, None
    for the image as a whole; ``channel`` of it; ``difference``: image - reference there, in radiance, with
    an interval that holds the differences of all comparisons at once with confidence 1 - significance;
    ``missing``: the share of the energy that is missing, 1 - mean(image) / mean(reference) over the whole
    image, with its 95 % interval.
    """

    passed: bool
    p: float
    family_p: float
    comparisons: int
    tile: tuple[int, int] | None
    channel: int
    difference: Estimate
    missing: Estimate


def tile_columns(image, tiles=TILES) -> np.ndarray:
    """What a bias check compares, (3 tiles^2 + 3,): `tile_means` by row, column and channel, then the mean
    of the whole image by channel."""
    return np.concatenate([tile_means(image, tiles).ravel(), tile_means(image, 1).ravel()])


@dataclass(frozen=True)
class Means:
    """`tile_columns` of renders as a sample, and the mean of the whole image over its channels as another.

    All that `compare_means` needs of a set of renders; small enough to keep beside a reference or in a table.
    """

    columns: Sample
    whole: Sample

    @staticmethod
    def of(columns, name="columns") -> Means:
        """From ``columns`` (renders, 3 tiles^2 + 3), renders with seeds of their own."""
        columns = np.asarray(columns, dtype=np.float64)
        if len(columns) < FEWEST_RUNS:
            raise CommandError(
                f"{name} has {len(columns)} renders, too few for the test's level; give {FEWEST_RUNS} or "
                "more."
            )
        return Means(Sample.of(columns), Sample.of(columns[:, -3:].mean(1, keepdims=True)))

    def joined(self, other: Means) -> Means:
        """What `of` gives for the renders of both."""
        return Means(self.columns.joined(other.columns), self.whole.joined(other.whole))

    @staticmethod
    def known(image, tiles=TILES) -> Means:
        """Of an image without error."""
        columns = tile_columns(image, tiles)
        return Means(Sample.known(columns), Sample.known(columns[-3:].mean(keepdims=True)))

    @property
    def tiles(self) -> int:
        """Tiles along an edge of the image."""
        return math.isqrt(len(self.columns.mean) // 3 - 1)


def _means_of_runs(name, runs, tiles):
    """`Means` of ``runs`` (seeds, height, width, 3), and the shape of one."""
    runs = _floats(name, runs, ("seeds", "height", "width", "3"))
    return Means.of([tile_columns(run, tiles) for run in runs], name), runs.shape[1:]


def _means_of_reference(reference, standard_error, tiles):
    """As `_means_of_runs`, from one image and the standard error of its values (height, width, 3).

    Pixels are taken for independent, the channels of a pixel for fully correlated.
    """
    reference = _image("references", reference)
    standard_error = _image("standard_error", standard_error)
    if standard_error.shape != reference.shape or standard_error.min() < 0:
        raise CommandError(
            f"standard_error has shape {standard_error.shape} and values from {standard_error.min():g}; it "
            f"must have the reference's shape {reference.shape} and no negative values."
        )
    pixels = reference.shape[0] * reference.shape[1]
    area = np.full(3 * tiles * tiles + 3, pixels / tiles**2)
    area[-3:] = pixels
    errors = np.sqrt(tile_columns(standard_error**2, tiles) / area)
    columns = tile_columns(reference, tiles)
    whole = Sample.known(columns[-3:].mean(keepdims=True), errors[-3:].mean(keepdims=True))
    return Means(Sample.known(columns, errors), whole), reference.shape


def _student(value, error, freedom, confidence) -> Estimate:
    """``value`` with Student's interval for its standard error."""
    half = stats.t.isf((1 - confidence) / 2, freedom) * error
    return Estimate(float(value), float(value - half), float(value + half))


def missing_energy(image: Sample, reference: Sample) -> Estimate:
    """1 - mean(image) / mean(reference) with its 95 % interval, from samples of both means (m = 1).

    Variance of the ratio to first order: v_x / r^2 + x^2 v_r / r^4, Student's t with the degrees of freedom
    of `satterthwaite`.
    """
    x, r = float(image.mean[0]), float(reference.mean[0])
    if not r > 0:
        raise CommandError(f"references have mean {r:g}; no share of it can be missing.")
    parts = float(image.error[0] / r) ** 2, float(x * reference.error[0] / r**2) ** 2
    freedom = satterthwaite(parts[0], image.freedom, parts[1], reference.freedom)
    return _student(1 - x / r, math.sqrt(sum(parts)), freedom, CONFIDENCE)


def bias_check(images, references, tiles=TILES, significance=SIGNIFICANCE, standard_error=None) -> BiasCheck:
    """Whether the renders agree with the reference within their noise.

    `welch` over the means of ``tiles`` x ``tiles`` tiles and of the whole image, channel by channel, with
    Sidak's correction: with no bias it fails with a chance of ``significance``, up to 2.5 times that for 12
    seeds and 9 times for 8 (see `FEWEST_RUNS`); take 16.

    ``images`` (seeds, height, width, 3), seeds all different; ``references`` either the same, or one image
    (height, width, 3) with ``standard_error`` of the same shape. The latter takes pixels for independent,
    which they are not under filters wider than a pixel or when light paths are shared: then give runs.

    It finds bias of a few standard errors of a tile; what it does not find may be hidden by noise (see the
    width of the intervals). An integrator whose energy sits in events rarer than the samples fails too:
    what it misses in practice and what it can never find look the same.
    """
    ours, shape = _means_of_runs("images", images, tiles)
    if np.ndim(references) == 3:
        if standard_error is None:
            raise CommandError("standard_error=None: with one reference, give it as an image of its shape.")
        theirs, their_shape = _means_of_reference(references, standard_error, tiles)
    else:
        if standard_error is not None:
            raise CommandError("standard_error must be None with several references: their spread gives it.")
        theirs, their_shape = _means_of_runs("references", references, tiles)
    if shape != their_shape:
        raise CommandError(
            f"images have shape {shape} and references {their_shape}; render both at one size."
        )
    return compare_means(ours, theirs, significance)


def compare_means(ours: Means, theirs: Means, significance=SIGNIFICANCE) -> BiasCheck:
    """`bias_check` of what was kept of the renders on both sides."""
    significance = _number("significance", significance, 0, 1)
    if ours.tiles != theirs.tiles:
        raise CommandError(
            f"ours has {ours.tiles} tiles along an edge and theirs {theirs.tiles}; take the same."
        )
    tiles = ours.tiles
    found = welch(ours.columns, theirs.columns)
    worst = int(np.lexsort((-np.abs(found.value), found.p))[0])
    tile, channel = divmod(worst, 3)
    family = sidak(found.p)
    each = -np.expm1(np.log1p(-significance) / len(found.p))
    return BiasCheck(
        passed=family >= significance,
        p=float(found.p[worst]),
        family_p=family,
        comparisons=len(found.p),
        tile=divmod(tile, tiles) if tile < tiles**2 else None,
        channel=channel,
        difference=_student(found.value[worst], found.error[worst], found.freedom[worst], 1 - each),
        missing=missing_energy(ours.whole, theirs.whole),
    )


def efficiency(seconds, error) -> float:
    """1 / (seconds * error): the same however long one renders, as a squared error falls with 1 / time."""
    return 1 / (_number("seconds", seconds, 0) * _number("error", error, 0))


def equal_time_speedup(ours, other) -> float:
    """How many times smaller our error is when the other renders as long as we did.

    Both are (seconds, error), as `Measurement`. With error ~ 1 / time the other's error after our time is
    e_other t_other / t_ours, so the result is (e_other t_other / t_ours) / e_ours.
    """
    ours, other = _measurement("ours", ours), _measurement("other", other)
    return other.error * other.seconds / ours.seconds / ours.error


def equal_error_speedup(ours, other) -> float:
    """How many times sooner we reach our error than the other reaches it.

    Both are (seconds, error), as `Measurement`. With error ~ 1 / time the other reaches it after
    t_other e_other / e_ours, so the result is (t_other e_other / e_ours) / t_ours. Under that assumption this
    and `equal_time_speedup` are one number, the ratio of efficiencies; `slope` tests the assumption.
    """
    ours, other = _measurement("ours", ours), _measurement("other", other)
    return other.seconds * other.error / ours.error / ours.seconds


def _measurement(name, pair) -> Measurement:
    try:
        seconds, error = pair
    except (TypeError, ValueError) as failure:
        raise TypeError(f"{name}={pair!r} must be a pair (seconds, error).") from failure
    return Measurement(_number(f"{name}.seconds", seconds, 0), _number(f"{name}.error", error, 0))


def slope(samples, errors, confidence=CONFIDENCE, seed=0) -> Estimate:
    """Exponent of error ~ samples^slope: -1 for the squared error of independent samples.

    ``samples`` (n,) counts; ``errors``: for each count the errors of several independent runs (at least 2);
    of a dict {spp: errors}, ``slope(runs.keys(), runs.values())``. Least squares of log(error) over
    log(samples), a point per run: sum (x - mean x) y / sum (x - mean x)^2.

    The interval is the bootstrap's, percentiles of `RESAMPLES` fits to runs drawn with replacement within
    each count. Deviations from a count's mean are multiplied by sqrt(k / (k - 1)), k its number of runs:
    resampling k values shows only (k - 1) / k of their variance. Source: B. Efron, R. Tibshirani, An
    Introduction to the Bootstrap, 1993, sections 9 and 13.
    """
    x = np.log(_values("samples", samples, 2, 0))
    errors = list(errors)
    if len(errors) != len(x):
        raise CommandError(f"errors has {len(errors)} rows for {len(x)} samples; give one row for each.")
    y = [np.log(_values(f"errors[{i}]", row, 2, 0)) for i, row in enumerate(errors)]
    runs = np.array([len(row) for row in y])
    offset = x - np.average(x, weights=runs)
    if np.ptp(x) == 0:
        raise CommandError("samples are all the same; a slope needs at least two different counts.")
    weight = runs * offset / np.sum(runs * offset**2)
    rng = np.random.default_rng(seed)
    drawn = np.empty((RESAMPLES, len(y)))
    for i, row in enumerate(y):
        picked = row[rng.integers(len(row), size=(RESAMPLES, len(row)))].mean(1)
        drawn[:, i] = row.mean() + (picked - row.mean()) * math.sqrt(len(row) / (len(row) - 1))
    value = float(np.dot(weight, [row.mean() for row in y]))
    return _percentiles(value, drawn @ weight, confidence)


def _percentiles(value, drawn, confidence) -> Estimate:
    tail = (1 - _number("confidence", confidence, 0, 1)) / 2
    low, high = np.quantile(drawn, [tail, 1 - tail])
    return Estimate(value, float(low), float(high))


def bootstrap_median(values, confidence=CONFIDENCE, seed=0) -> Estimate:
    """Median of a handful of values and its bootstrap interval: percentiles of `RESAMPLES` medians of
    values drawn with replacement.

    The interval cannot leave the range of the values, which with n of them holds the median with chance
    1 - 2^(1 - n): 94 % for 5, 97 % for 6, 99.8 % for 10. Source: as `slope`, section 13.
    """
    values = _values("values", values, 2)
    rng = np.random.default_rng(seed)
    drawn = values[rng.integers(len(values), size=(RESAMPLES, len(values)))]
    return _percentiles(float(np.median(values)), np.median(drawn, axis=1), confidence)


def _reference_share(own_error, measured_error) -> float:
    if own_error != 0:
        own_error = _number("own_error", own_error, 0)
    return own_error / _number("measured_error", measured_error, 0)


def reference_good_enough(own_error, measured_error) -> bool:
    """Whether the reference's own squared error is at most `REFERENCE_SHARE` of the error measured with it.

    Both in the same measure (relMSE or MSE). The errors of image and reference are independent, so their
    squares add: a reference at the limit makes what is measured too large by 1 %.
    """
    return _reference_share(own_error, measured_error) <= REFERENCE_SHARE


def reference_refusal(own_error, measured_error) -> str:
    """The sentence that says why a figure is refused and how many more samples the reference needs."""
    share = _reference_share(own_error, measured_error)
    if share <= REFERENCE_SHARE:
        raise CommandError(
            f"own_error={own_error!r} is good enough for {measured_error!r}; nothing to refuse."
        )
    times = math.ceil(round(10 * share / REFERENCE_SHARE, 6)) / 10
    return (
        f"The reference carries {100 * share:.3g} % of the error measured with it ({own_error:.2e} of "
        f"{measured_error:.2e}) and may carry {100 * REFERENCE_SHARE:g} %: render it with at least "
        f"{times:g} times the samples."
    )
