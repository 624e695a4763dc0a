"""Limits of what a film's sums may take."""

from __future__ import annotations

import math
import os

import mitsuba as mi

from ..errors import UsageError
from .channels import Channels
from .layers import image_count

# Of one array.
MOST_NUMBERS = 1 << 32

# What strategy images may take, in bytes, before the render is refused.
STRATEGY_MEMORY = 2 << 30

# Bytes of a number in the sums of a pass, in single or in double precision; and in those of all passes, of
# which there are two while the former are added, in double precision.
SINGLE, DOUBLE, ALL = 4, 8, 2 * 8


def check_film(film, channels: Channels, variance: bool):
    """Raise `UsageError` if the film is larger than the machine, or than Dr.Jit can count."""
    width, height = (int(x) for x in film.crop_size())
    numbers = width * height * max(channels.camera, channels.light)
    per_pixel = channels.camera * (SINGLE + ALL) + channels.light * (DOUBLE + ALL)
    if variance:  # sums at the last replicate; means and squares of two halves
        per_pixel += DOUBLE * (channels.camera + channels.light) + 2 * 2 * DOUBLE * channels.colours
    needed, there = width * height * per_pixel, available()
    if needed > there or numbers >= MOST_NUMBERS:
        raise UsageError(
            f"the film of {width} x {height} takes {needed / 2**30:.3g} GiB and {numbers} numbers; "
            f"there are {there / 2**30:.3g} GiB, and Dr.Jit counts to {MOST_NUMBERS}; render crop windows"
        )


def check_strategies(film, depth: int, merges: bool):
    """Raise `UsageError` if strategy images take more than `STRATEGY_MEMORY`.

    They are those of paths of up to ``depth`` edges, and of ``merges`` if there are some.
    """
    width, height = (int(x) for x in film.crop_size())
    # Six channels of each: three weighted, three not.
    needed = image_count(depth, merges) * width * height * 6 * (DOUBLE + ALL)
    if needed > STRATEGY_MEMORY:
        raise UsageError(
            f"strategy_images at {width}x{height} with max_depth={depth} needs about "
            f"{needed / 2**30:.1f} GiB, more than {STRATEGY_MEMORY / 2**30:.0f} GiB; use a smaller "
            "film or max_depth"
        )


def available() -> float:
    """What the machine has, in bytes."""
    if (mi.variant() or "").startswith("cuda"):
        return math.inf  # what a GPU has is not known here
    if not hasattr(os, "sysconf"):
        return math.inf  # Windows: Dr.Jit says it
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
