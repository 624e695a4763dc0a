"""Argument checks for images and numbers, and estimates with an interval."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

import numpy as np

from ..errors import CommandError

# Default confidence of intervals.
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A value and its interval [low, high] at the stated confidence."""

    value: float
    low: float
    high: float


def floats(name, value, shape) -> np.ndarray:
    """Return ``value`` as finite float64, an axis per word of ``shape``, the last 3."""
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


def image_of(name, value) -> np.ndarray:
    return floats(name, value, ("height", "width", "3"))


def pair_of(image, reference):
    """Return both images, checked, as float64 of shape (height, width, 3)."""
    image, reference = image_of("image", image), image_of("reference", reference)
    if image.shape != reference.shape:
        raise CommandError(
            f"image has shape {image.shape} and reference {reference.shape}; render both at the same size."
        )
    return image, reference


def number_of(name, value, low=-math.inf, high=math.inf) -> float:
    """Return a finite float in the open interval (low, high)."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name}={value!r} must be a number.")
    if not (math.isfinite(value) and low < value < high):
        bounds = f"above {low:g}" if high == math.inf else f"between {low:g} and {high:g}, ends excluded"
        raise CommandError(
            f"{name}={value!r} must be finite" + (f" and {bounds}." if low > -math.inf else ".")
        )
    return float(value)


def values_of(name, values, at_least, low=-math.inf) -> np.ndarray:
    """Return a vector of at least ``at_least`` finite float64, each above ``low``."""
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
