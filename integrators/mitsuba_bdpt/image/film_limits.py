"""Limits of what a film's sums may take."""

from __future__ import annotations

import mitsuba as mi

from ..errors import UsageError
from ..host import memory
from .accumulator import Channels
from .layers import image_count

# Of one array.
MOST_NUMBERS = 1 << 32

# What strategy images may take, in bytes, before the render is refused.
STRATEGY_MEMORY = 2 << 30

# Bytes of a number in the sums of a pass, in single or in double precision; and in those of all passes, of
# which there are two while the former are added, in double precision.
SINGLE, DOUBLE, ALL = 4, 8, 2 * 8

# Bytes of a number of the film while the image is made of the sums: two in double, three in single precision.
OF_IMAGE = 2 * DOUBLE + 3 * SINGLE

# Images in double precision while the variance is computed: two of two halves, and six of both.
OF_VARIANCE = 2 * 2 + 6


def check_film(film, channels: Channels, variance: bool):
    """Raise `UsageError` if the film takes more memory than there is, or more numbers than Dr.Jit counts."""
    width, height = (int(x) for x in film.crop_size())
    numbers = width * height * max(channels.camera, channels.light)
    per_pixel = channels.camera * (SINGLE + ALL) + channels.light * (DOUBLE + ALL)
    of_film = channels.camera + channels.stokes
    if variance:  # and sums at the last replicate
        of_film += channels.colours
        per_pixel += DOUBLE * (channels.camera + channels.light + OF_VARIANCE * channels.colours)
    needed, there = width * height * (per_pixel + OF_IMAGE * of_film), memory.available()
    # What a GPU has is not known here.
    on_gpu = (mi.variant() or "").startswith("cuda")
    if needed > there.bytes and not on_gpu:
        raise UsageError(
            f"the film of {width} x {height} pixels takes about {needed / 2**30:.3g} GiB of memory; there "
            f"are {there.bytes / 2**30:.3g} GiB ({there.limit}); render a smaller film, or crop windows "
            "one by one"
        )
    if numbers >= MOST_NUMBERS:
        raise UsageError(
            f"the film of {width} x {height} pixels takes {numbers} numbers, and Dr.Jit counts to "
            f"{MOST_NUMBERS}; render crop windows one by one"
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
