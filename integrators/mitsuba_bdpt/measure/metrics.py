"""Measures of error and colour difference, with formula and source.

Images are floats in linear sRGB of shape (height, width, 3); the arithmetic is float64. Invalid input (other
shapes, non-finite values, a black reference as divisor) raises ``ValueError`` or ``TypeError``. No function
prints, writes, or renders. colour-science and flip-evaluator are imported at first use, since they load
slowly.
"""

from __future__ import annotations

import functools
import importlib
import warnings

import numpy as np

from ..errors import CommandError
from .checks import image_of, number_of, pair_of

# Luminance of display white in cd/m^2, of standard-dynamic-range video: ITU-R BT.2035.
WHITE = 100.0

# Share of the worst values that the trimmed relMSE excludes.
TRIM = 0.001

# HDR-FLIP clamps luminances here (float32's epsilon), and aborts if all are below.
FLIP_DARKEST = 2.0**-23


def mse(image, reference) -> float:
    """Mean squared error: mean of (x - r)^2 over pixels and channels, in squared units of radiance."""
    image, reference = pair_of(image, reference)
    return float(np.mean((image - reference) ** 2))


def rel_mse_epsilon(reference) -> float:
    """The eps of `rel_mse`: 0.01 mean(r)^2 over pixels and channels, squared radiance.

    Bounds the weight of dark pixels: where r is a tenth of the mean, r^2 and eps are equal.
    """
    epsilon = 0.01 * float(image_of("reference", reference).mean()) ** 2
    if not epsilon > 0:
        raise CommandError("reference has mean 0, so nothing is relative to it; use mse.")
    return epsilon


def rel_mse(image, reference, trim=0.0) -> float:
    """Relative mean squared error: mean of (x - r)^2 / (r^2 + eps).

    Over pixels and channels; eps is `rel_mse_epsilon`. Source: F. Rousselle, C. Knaus, M. Zwicker, Adaptive
    Sampling and Reconstruction using Greedy Error Minimization, SIGGRAPH Asia 2011, there with a constant
    0.01; ours is invariant to scaling both images.

    ``trim``: share of the worst values that are excluded, round(trim * n) of n = 3 * height * width; 0.001
    for the *trimmed* relMSE. It excludes values, not pixels. Trimmed figures depend on the number of samples:
    state it with them.
    """
    error, kept = _relative_errors(image, reference, trim)
    return float(error[kept].mean())


def spread(images, reference, trim=0.0) -> list[float]:
    """Return `rel_mse` without bias for each of n independent ``images`` of one mean.

    The mean of (x - m)^2 n / (n - 1) / (r^2 + eps), m the mean of the n images and r the ``reference``, which
    only weighs pixels.
    """
    if len(images) < 2:
        raise CommandError(f"images has {len(images)} images; a spread takes 2 or more.")
    centre = np.mean(images, axis=0)
    scale = len(images) / (len(images) - 1)
    weights = 1 / np.sqrt(image_of("reference", reference) ** 2 + rel_mse_epsilon(reference))
    return [scale * _kept_mean((((image - centre) * weights) ** 2).ravel(), trim) for image in images]


def _kept_mean(errors, trim) -> float:
    """Return the mean of ``errors`` without the share ``trim`` of the largest."""
    return float(errors[_smallest(errors, trim)].mean())


def reference_rel_mse(difference, image, reference, trim=0.0) -> float:
    """Return what the reference's own error adds to `rel_mse`.

    ``difference``: an image of the reference's error, such as half the difference of its halves. Returns its
    relMSE over the values that the measurement keeps.
    """
    _, kept = _relative_errors(image, reference, trim)
    difference = image_of("difference", difference)
    own, _ = _relative_errors(image_of("reference", reference) + difference, reference, 0.0)
    return float(own[kept].mean())


def _relative_errors(image, reference, trim):
    """Return squared relative errors (n,), and the indices of those kept."""
    image, reference = pair_of(image, reference)
    error = ((image - reference) ** 2 / (reference**2 + rel_mse_epsilon(reference))).ravel()
    return error, _smallest(error, trim)


def _smallest(errors, trim):
    """Return the indices of ``errors`` without the share ``trim`` of the largest."""
    if trim != 0:
        trim = number_of("trim", trim, 0, 1)
    keep = len(errors) - round(trim * len(errors))
    if keep == 0:
        raise CommandError(f"trim={trim} leaves none of {len(errors)} values; choose a smaller share.")
    return np.argpartition(errors, keep - 1)[:keep]


def mape(image, reference) -> float:
    """Mean absolute relative error: mean of |x - r| / (|r| + eps1); 1 is 100 %.

    Over pixels and channels. eps1 = 0.01 mean(r) bounds the weight of pixels below a hundredth of the mean,
    and makes 0 / 0 in black ones 0.
    """
    image, reference = pair_of(image, reference)
    epsilon = 0.01 * float(reference.mean())
    if not epsilon > 0:
        raise CommandError(f"reference has mean {reference.mean():g}, so nothing is relative to it; use mse.")
    return float(np.mean(np.abs(image - reference) / (np.abs(reference) + epsilon)))


# Relative to the mean: negative values up to this are rounding (`volpath` in grids).
ROUNDED = 1e-5


def energy_in_black(image, reference) -> float:
    """Share of the image's energy in pixels that are black in the reference.

    All three channels of the reference are exactly 0 there. 0 for an image without energy. Negative values
    beyond rounding raise ``CommandError``.
    """
    image, reference = pair_of(image, reference)
    if image.min() < -ROUNDED * image.mean():
        raise CommandError(f"image holds negative values down to {image.min():g}; energies must not cancel.")
    total = image.sum()
    black = (reference == 0).all(axis=-1)
    return float(image[black].sum() / total) if total > 0 else 0.0


def tone_map(image, exposure=0.0) -> np.ndarray:
    """Return sRGB-encoded values in [0, 1] for display, shape (height, width, 3).

    x = clip(image * 2^exposure, 0, 1) with ``exposure`` in stops, then the transfer function of IEC
    61966-2-1: 12.92 x up to 0.0031308, above it 1.055 x^(1/2.4) - 0.055.
    """
    x = np.clip(image_of("image", image) * 2.0 ** number_of("exposure", exposure, -100, 100), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


@functools.cache
def _of_the_extra(module: str, needed_by: str):
    """Import a module of the extra ``[measure]``; raise ``CommandError`` without it.

    Suppresses warnings at import about optional packages.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return importlib.import_module(module)
        except ImportError as error:
            install = "pip install 'mitsuba-bdpt[measure]'"
            raise CommandError(f"{needed_by} needs the module {module}: {install}") from error


def delta_e_2000(image, reference, exposure=0.0) -> float:
    """Mean CIEDE2000 of both images as `tone_map` displays them; 1 is just visible.

    sRGB to XYZ to L*a*b* under D65, k_L = k_C = k_H = 1. Source: CIE 142-2001; G. Sharma, W. Wu, E. Dalal,
    The CIEDE2000 color-difference formula, 2005.
    """
    colour = _of_the_extra("colour", "delta_e_2000")
    labs = [colour.XYZ_to_Lab(colour.sRGB_to_XYZ(tone_map(x, exposure))) for x in pair_of(image, reference)]
    return float(np.mean(colour.delta_E(*labs, method="CIE 2000")))


def delta_e_itp(image, reference, exposure=0.0, white=WHITE) -> float:
    """Mean Delta E ITP of both images as `tone_map` displays them; 1 is just visible.

    720 sqrt(dI^2 + (dC_T / 2)^2 + dC_P^2) in IC_TC_P of BT.2100 (PQ), linear BT.2020 in cd/m^2 with 1 at
    ``white``. Source: Recommendation ITU-R BT.2124. More accurate than `delta_e_2000` in dark regions.
    """
    colour = _of_the_extra("colour", "delta_e_itp")
    white = number_of("white", white, 0)
    encoded = []
    for x in pair_of(image, reference):
        linear = colour.RGB_to_RGB(tone_map(x, exposure), "sRGB", "ITU-R BT.2020", apply_cctf_decoding=True)
        encoded.append(colour.RGB_to_ICtCp(white * np.maximum(linear, 0)))
    return float(np.mean(colour.difference.delta_E_ITP(*encoded)))


def hdr_flip(image, reference):
    """Mean HDR-FLIP error in [0, 1] and the error map (height, width), float32.

    The largest LDR-FLIP error over exposures that follow from the reference, ACES tone mapping, 67 pixels per
    degree (a 0.7 m wide screen of 3840 pixels seen from 0.7 m). Not symmetric. Where more than half of the
    reference is black, exposures reach 24 stops beyond its highlights and any light in black counts nearly 1.
    Source: P. Andersson, J. Nilsson, P. Shirley, T. Akenine-Moller, Visualizing Errors in Rendered High
    Dynamic Range Images, Eurographics 2021.
    """
    flip_evaluator = _of_the_extra("flip_evaluator", "hdr_flip")
    pair = pair_of(image, reference)
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
