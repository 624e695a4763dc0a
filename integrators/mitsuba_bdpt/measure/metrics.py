"""Measures of error and colour difference, with formula and source.

Images are floats in linear sRGB of shape (height, width, 3); the arithmetic is float64. Invalid input (other
shapes, non-finite values, a black reference as divisor) raises ``ValueError`` or ``TypeError``.
colour-science and flip-evaluator are imported at first use, since they load slowly.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import CommandError

Image = ArrayLike
"""Floats in linear sRGB of shape (height, width, 3)."""

# Default confidence of intervals.
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A value and its interval [low, high] at the stated confidence."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if math.isinf(self.high):
            return f"{self.value:.2f} (too few renders for an interval)"
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})"


def image_of(name: str, value: Image) -> np.ndarray:
    """Return ``value`` as finite float64 of shape (height, width, 3)."""
    array, words = np.asarray(value), "(height, width, 3)"
    if not np.issubdtype(array.dtype, np.floating):
        raise TypeError(
            f"{name} has values of type {array.dtype}; give linear radiance as floats of shape {words}."
        )
    if array.ndim != 3 or array.shape[-1] != 3 or array.size == 0:
        raise CommandError(
            f"{name} has shape {array.shape} and must have {words}; drop other channels with [..., :3]."
        )
    wrong = np.argwhere(~np.isfinite(array))
    if len(wrong):
        raise CommandError(
            f"{name} holds {len(wrong)} values that are NaN or infinite, the first at index "
            f"{wrong[0].tolist()}; find what made them in the renderer: no measure is defined for them."
        )
    return array.astype(np.float64)


def pair_of(image: Image, reference: Image) -> tuple[np.ndarray, np.ndarray]:
    """Return both images, checked, as float64 of shape (height, width, 3)."""
    image, reference = image_of("image", image), image_of("reference", reference)
    if image.shape != reference.shape:
        raise CommandError(
            f"image has shape {image.shape} and reference {reference.shape}; render both at the same size."
        )
    return image, reference


# Luminance of display white in cd/m^2, of standard-dynamic-range video: ITU-R BT.2035.
WHITE = 100.0

# Share of the worst values that the trimmed relMSE excludes.
TRIM = 0.001

# HDR-FLIP clamps luminances here (float32's epsilon), and aborts if all are below.
FLIP_DARKEST = 2.0**-23


def mse(image: Image, reference: Image) -> float:
    """Mean squared error: mean of (x - r)^2 over pixels and channels, in squared units of radiance."""
    image, reference = pair_of(image, reference)
    return float(np.mean((image - reference) ** 2))


def rel_mse_epsilon(reference: Image) -> float:
    """The eps of `rel_mse`: 0.01 mean(r)^2 over pixels and channels, squared radiance.

    Bounds the weight of dark pixels: where r is a tenth of the mean, r^2 and eps are equal.
    """
    epsilon = 0.01 * float(image_of("reference", reference).mean()) ** 2
    if not epsilon > 0:
        raise CommandError("reference has mean 0, so nothing is relative to it; use mse.")
    return epsilon


def rel_mse(image: Image, reference: Image, trim: float = 0.0) -> float:
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


def spread(images: Sequence[np.ndarray], reference: Image) -> list[float]:
    """Return `rel_mse` without bias for each of n independent ``images`` of one mean.

    The mean of (x - m)^2 n / (n - 1) / (r^2 + eps), m the mean of the n images and r the ``reference``, which
    only weighs pixels. Their mean is the sample variance.
    """
    if len(images) < 2:
        raise CommandError(f"images has {len(images)} images; a spread takes 2 or more.")
    centre = np.mean(images, axis=0)
    scale = len(images) / (len(images) - 1)
    weights = 1 / np.sqrt(image_of("reference", reference) ** 2 + rel_mse_epsilon(reference))
    return [scale * float((((image - centre) * weights) ** 2).mean()) for image in images]


def reference_rel_mse(difference: Image, image: Image, reference: Image, trim: float = 0.0) -> float:
    """Return what the reference's own error adds to `rel_mse`.

    ``difference``: an image of the reference's error, such as half the difference of its halves. Returns its
    relMSE over the values that the measurement keeps.
    """
    _, kept = _relative_errors(image, reference, trim)
    difference = image_of("difference", difference)
    own, _ = _relative_errors(image_of("reference", reference) + difference, reference, 0.0)
    return float(own[kept].mean())


def _relative_errors(image: Image, reference: Image, trim: float) -> tuple[np.ndarray, np.ndarray]:
    """Return squared relative errors (n,), and the indices of those kept."""
    image, reference = pair_of(image, reference)
    error = ((image - reference) ** 2 / (reference**2 + rel_mse_epsilon(reference))).ravel()
    keep = len(error) - round(trim * len(error))
    return error, np.argpartition(error, keep - 1)[:keep]


def mape(image: Image, reference: Image) -> float:
    """Mean absolute relative error: mean of |x - r| / (|r| + eps1); 1 is 100 %.

    Over pixels and channels. eps1 = 0.01 mean(r) bounds the weight of pixels below a hundredth of the mean,
    and makes 0 / 0 in black ones 0.
    """
    image, reference = pair_of(image, reference)
    epsilon = 0.1 * math.sqrt(rel_mse_epsilon(reference))
    return float(np.mean(np.abs(image - reference) / (np.abs(reference) + epsilon)))


def tone_map(image: Image, exposure: float = 0.0) -> np.ndarray:
    """Return sRGB-encoded values in [0, 1] for display, shape (height, width, 3).

    x = clip(image * 2^exposure, 0, 1) with ``exposure`` in stops, then the transfer function of IEC
    61966-2-1: 12.92 x up to 0.0031308, above it 1.055 x^(1/2.4) - 0.055.
    """
    x: np.ndarray = np.clip(image_of("image", image) * 2.0**exposure, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def delta_e_itp(image: Image, reference: Image, exposure: float = 0.0, white: float = WHITE) -> float:
    """Mean Delta E ITP of both images as `tone_map` displays them; 1 is just visible.

    720 sqrt(dI^2 + (dC_T / 2)^2 + dC_P^2) in IC_TC_P of BT.2100 (PQ), linear BT.2020 in cd/m^2 with 1 at
    ``white``. Source: Recommendation ITU-R BT.2124.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about optional packages
        colour: Any = importlib.import_module("colour")
    encoded: list[np.ndarray] = []
    for x in pair_of(image, reference):
        linear = colour.RGB_to_RGB(tone_map(x, exposure), "sRGB", "ITU-R BT.2020", apply_cctf_decoding=True)
        encoded.append(colour.RGB_to_ICtCp(white * np.maximum(linear, 0)))
    difference: np.ndarray = colour.difference.delta_E_ITP(*encoded)
    return float(difference.mean())


def hdr_flip(image: Image, reference: Image) -> tuple[float, np.ndarray]:
    """Mean HDR-FLIP error in [0, 1] and the error map (height, width), float32.

    The largest LDR-FLIP error over exposures that follow from the reference, ACES tone mapping, 67 pixels per
    degree (a 0.7 m wide screen of 3840 pixels seen from 0.7 m). Not symmetric. Where more than half of the
    reference is black, exposures reach 24 stops beyond its highlights and any light in black counts nearly 1.
    Source: P. Andersson, J. Nilsson, P. Shirley, T. Akenine-Moller, Visualizing Errors in Rendered High
    Dynamic Range Images, Eurographics 2021.
    """
    flip_evaluator: Any = importlib.import_module("flip_evaluator")
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
