"""Measures of error and colour difference, with formula and source.

Images are finite floats in linear sRGB of shape (height, width, 3), else ``CommandError``; the arithmetic is
float64.
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

Image = ArrayLike  # floats in linear sRGB of shape (height, width, 3)

CONFIDENCE = 0.95  # of intervals
TRIM = 0.001  # share of the worst values that the trimmed relMSE excludes
WHITE = 100.0  # cd/m^2 of display white, of standard-dynamic-range video: ITU-R BT.2035
FLIP_DARKEST = 2.0**-23  # HDR-FLIP clamps luminances here (float32's epsilon), and aborts if all are below
LUMINANCE = 0.2126, 0.7152, 0.0722


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
    """Return ``value``, an image, as finite float64."""
    array = np.asarray(value, np.float64)
    if array.ndim != 3 or array.shape[-1] != 3 or array.size == 0:
        raise CommandError(f"{name} has shape {array.shape} and must have (height, width, 3)")
    if len(wrong := np.argwhere(~np.isfinite(array))):
        raise CommandError(
            f"{name} holds {len(wrong)} values that are NaN or infinite, the first at index "
            f"{wrong[0].tolist()}; find what made them in the renderer: no measure is defined for them."
        )
    return array


def pair_of(image: Image, reference: Image) -> tuple[np.ndarray, np.ndarray]:
    """Return both images, checked, as float64 of one shape."""
    image, reference = image_of("image", image), image_of("reference", reference)
    if image.shape != reference.shape:
        raise CommandError(
            f"image has shape {image.shape} and reference {reference.shape}; render both at the same size."
        )
    return image, reference


def rel_mse_epsilon(reference: Image) -> float:
    """The eps of `rel_mse`: 0.01 mean(r)^2 over pixels and channels, squared radiance.

    Bounds the weight of dark pixels: where r is a tenth of the mean, r^2 and eps are equal.
    """
    epsilon = 0.01 * float(image_of("reference", reference).mean()) ** 2
    if not epsilon > 0:
        raise CommandError("reference has mean 0, so nothing is relative to it.")
    return epsilon


def relative_errors(image: Image, reference: Image) -> np.ndarray:
    """Return (x - r)^2 / (r^2 + eps), (height, width, 3); eps: `rel_mse_epsilon`."""
    image, reference = pair_of(image, reference)
    return (image - reference) ** 2 / (reference**2 + rel_mse_epsilon(reference))


def rel_mse(image: Image, reference: Image, trim: float = 0.0) -> float:
    """Relative mean squared error: mean of `relative_errors` over pixels and channels.

    Source: F. Rousselle, C. Knaus, M. Zwicker, Adaptive Sampling and Reconstruction using Greedy Error
    Minimization, SIGGRAPH Asia 2011, there with a constant 0.01; ours is invariant to scaling both images.

    ``trim``: share of the worst values that are excluded, round(trim * n) of n = 3 * height * width; 0.001
    for the *trimmed* relMSE. It excludes values, not pixels. Trimmed figures depend on the number of samples:
    state it with them.
    """
    error = relative_errors(image, reference).ravel()
    return float(error[_kept(error, trim)].mean())


def reference_rel_mse(difference: Image, image: Image, reference: Image, trim: float = 0.0) -> float:
    """Return what the reference's own error adds to `rel_mse`.

    ``difference``: an image of that error. Returns its relMSE over the values that the measurement keeps.
    """
    kept = _kept(relative_errors(image, reference).ravel(), trim)
    reference = image_of("reference", reference)
    own = relative_errors(reference + image_of("difference", difference), reference)
    return float(own.ravel()[kept].mean())


def _kept(error: np.ndarray, trim: float) -> np.ndarray:
    """Return the indices of the errors (n,) without a share of the worst."""
    keep = len(error) - round(trim * len(error))
    return np.argpartition(error, keep - 1)[:keep]


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


def exposure_of(image: np.ndarray) -> float:
    """Return the stops at which 95 % of the pixels are darker than 0.9."""
    return math.log2(0.9 / max(float(np.quantile(image.max(axis=-1), 0.95)), 1e-9))


def tone_map(image: Image, exposure: float = 0.0) -> np.ndarray:
    """Return sRGB-encoded values in [0, 1] for display, shape (height, width, 3).

    x = clip(image * 2^exposure, 0, 1) with ``exposure`` in stops, then the transfer function of IEC
    61966-2-1: 12.92 x up to 0.0031308, above it 1.055 x^(1/2.4) - 0.055.
    """
    x: np.ndarray = np.clip(image_of("image", image) * 2.0**exposure, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def delta_e_itp(image: Image, reference: Image) -> float:
    """Mean Delta E ITP of both images, clipped to [0, 1]; 1 is just visible.

    720 sqrt(dI^2 + (dC_T / 2)^2 + dC_P^2) in IC_TC_P of BT.2100 (PQ), linear BT.2020 in cd/m^2 with 1 at
    `WHITE`. Source: Recommendation ITU-R BT.2124.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about optional packages
        colour: Any = importlib.import_module("colour")  # loads slowly
    encoded: list[np.ndarray] = []
    for x in pair_of(image, reference):
        linear = colour.RGB_to_RGB(np.clip(x, 0, 1), "sRGB", "ITU-R BT.2020")
        encoded.append(colour.RGB_to_ICtCp(WHITE * np.maximum(linear, 0)))
    difference: np.ndarray = colour.difference.delta_E_ITP(*encoded)
    return float(difference.mean())


def hdr_flip(image: Image, reference: Image) -> float:
    """Mean HDR-FLIP error in [0, 1].

    The largest LDR-FLIP error over exposures that follow from the reference, ACES tone mapping, 67 pixels per
    degree (a 0.7 m wide screen of 3840 pixels seen from 0.7 m). Not symmetric. Where more than half of the
    reference is black, exposures reach 24 stops beyond its highlights and any light in black counts nearly 1.
    Source: P. Andersson, J. Nilsson, P. Shirley, T. Akenine-Moller, Visualizing Errors in Rendered High
    Dynamic Range Images, Eurographics 2021.
    """
    flip_evaluator: Any = importlib.import_module("flip_evaluator")  # loads slowly
    pair = pair_of(image, reference)
    for name, x in zip(("image", "reference"), pair, strict=True):
        if x.min() < 0 or x.max() > np.finfo(np.float32).max:
            raise CommandError(
                f"{name} holds values from {x.min():g} to {x.max():g}; HDR-FLIP needs 0 to 3e38."
            )
    image, reference = (x.astype(np.float32) for x in pair)
    brightest = float((reference @ np.array(LUMINANCE, np.float32)).max())
    if brightest < 2 * FLIP_DARKEST:
        raise CommandError(
            f"reference has luminances up to {brightest:g} only, and HDR-FLIP cannot expose less than "
            f"{2 * FLIP_DARKEST:.1g}; scale both images by the same factor."
        )
    return float(flip_evaluator.evaluate(reference, image, "HDR", applyMagma=False)[1])
