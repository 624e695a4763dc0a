"""Limits on the memory of a film's sums."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..errors import UsageError
from ..host import memory
from .accumulator import COPIES_MEMORY, Channels
from .layers import image_count
from .taps import is_wide

MOST_NUMBERS = 1 << 32  # of one array

# Bytes that are not compared with the machine's: Mitsuba alone takes more, and to find these takes 1 ms.
SMALL = 1 << 26

STRATEGY_MEMORY = 2 << 30  # bytes that strategy images may take

# Bytes per number in the sums of a pass (single, double), and in the total (double, held twice while adding).
SINGLE, DOUBLE, ALL = 4, 8, 2 * 8

# Images in double precision for the variance: two in each half, and eight while it is computed, those of
# differences of sums included.
OF_VARIANCE = 2 * 2 + 8


def check_film(film, channels: Channels, variance: bool):
    """Raise `UsageError` if a film of several passes exceeds the memory or Dr.Jit's array size."""
    width, height = (int(x) for x in film.crop_size())
    light = channels.light * channels.splats
    numbers = width * height * max(channels.camera, light)
    per_pixel = channels.camera * (SINGLE + ALL) + light * (DOUBLE + ALL)
    of_film = channels.camera + channels.stokes
    if variance:  # and the sums at the last replicate
        of_film += channels.colours
        per_pixel += DOUBLE * (channels.camera + light + OF_VARIANCE * channels.colours)
    needed = width * height * (per_pixel + SINGLE * of_film)
    wide = is_wide(film.rfilter())
    copied = [channels.camera * SINGLE] if channels.partitions or wide else []
    copied += [light * DOUBLE] if wide else []
    copies = (width * height * per_copy * dr.thread_count() for per_copy in copied)
    needed += sum(size for size in copies if size <= COPIES_MEMORY)  # others are not made: `reduce_mode`
    on_gpu = (mi.variant() or "").startswith("cuda")  # whose memory is not known
    if needed > SMALL and not on_gpu and needed > (there := memory.available()).bytes:
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
    """Raise `UsageError` if images of paths of up to ``depth`` edges exceed `STRATEGY_MEMORY`."""
    width, height = (int(x) for x in film.crop_size())
    # Six channels of each: three weighted, three unweighted.
    needed = image_count(depth, merges) * width * height * 6 * (DOUBLE + ALL)
    if needed > STRATEGY_MEMORY:
        raise UsageError(
            f"layers=strategies at {width}x{height} with max_depth={depth} needs about "
            f"{needed / 2**30:.1f} GiB, more than {STRATEGY_MEMORY / 2**30:.0f} GiB; use a smaller "
            "film or max_depth"
        )
