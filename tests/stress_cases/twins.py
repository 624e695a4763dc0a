"""A scene with a number that is not finite compared with its *twin*, in which the same number is 0.

Same seed, same random numbers, so that the images are the same up to the order of sums, whatever is in them.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from mitsuba_bdpt.planning import budget
from mitsuba_bdpt.planning.configuration import Decision

from .agreement import WAYS
from .case import Outcome
from .poisons import SIZE
from .warned import Warned

# Of the brightest value: sums in single precision, in the order in which threads come to them.
ROUNDING = 1e-5

EVERYTHING, DEFAULTS = (WAYS[name] | {"max_depth": 4} for name in ("all strategies", "default parameters"))

# Each way to render with its samples per pixel: by default so many that a pilot is asked.
PILOTED = budget.LEAST_SAMPLES // SIZE**2
SPP = 16
RENDERS = {"all strategies": (EVERYTHING, SPP), "default parameters": (DEFAULTS, PILOTED)}


def rendered(scene, parameters, spp, seed=1, decisions=None):
    """Image, statistics and warnings of a render; ``decisions`` of another one in place of its own."""
    bdpt = mi.load_dict({"type": "bdpt", **parameters})
    if decisions is not None:
        bdpt.settings = bdpt.settings.varied(decisions=tuple(map(Decision.read, decisions)))
    with Warned() as warnings:
        image = np.array(bdpt.render(scene, spp=spp, seed=seed), dtype=np.float64)
    return image, bdpt.statistics, warnings


def decided(statistics) -> list[dict]:
    """The decisions, without what they cost: rays are traced for NaN and infinity, but not for 0."""
    return [{name: x for name, x in d.items() if name != "cost"} for d in statistics["decisions"]]


def means(statistics) -> list[float]:
    """Of the image, as the pilots found them."""
    return [made["mean"] for made in statistics["decisions"]]


def compared(make, bad, parameters, count=None, spp=16) -> Outcome:
    """Whether ``make(bad)`` renders as ``make(0.0)`` does, and only the bad one is counted and told.

    It counts ``count`` values (some, if None) and says so once, the twin none; with `PILOTED` samples also
    whether a pilot was asked.
    """
    image, statistics, warnings = rendered(make(bad), parameters, spp)
    twin, of_twin, quiet = rendered(make(0.0), parameters, spp)
    same = decided(statistics) == decided(of_twin)
    if not same and means(statistics) == means(of_twin):
        # Rays that are traced for the bad number alone turned the scale: the twin does the same.
        twin, replayed, _ = rendered(make(0.0), parameters, spp, decisions=statistics["decisions"])
        same = decided(replayed) == decided(statistics)
    found = statistics["non_finite"]
    # An image of features may be all that there is.
    off = np.abs(image - twin).max() / np.abs(twin).max()
    counted = found == count if count is not None else found > 0
    ok = bool(np.isfinite(image).all()) and off <= ROUNDING and counted
    ok &= len(warnings) == 1 and f": {found} of the image" in warnings[0]
    ok &= of_twin["non_finite"] == 0 and not quiet and same
    exactly = f", exactly {count} expected" if count is not None else ""
    piloted, asked = spp >= PILOTED, bool(statistics["decisions"]) and statistics["seconds"]["pilot"] > 0
    text = f"{found} counted{exactly}, off by {off:.1g}, {len(warnings)} warning"
    text += ", decided by a pilot" if asked else ""
    return Outcome(bool(ok and asked == piloted), text)


def both_ways(make, bad, said, more=None) -> dict[str, Outcome]:
    """`compared` by all `RENDERS`, with ``more`` parameters; what was tried is ``said``."""
    return {
        f"{said}, {way}": compared(make, bad, parameters | (more or {}), spp=spp)
        for way, (parameters, spp) in RENDERS.items()
    }


TWIN = (
    "the image of its twin, in which that is 0, to 1e-5 of its maximum (same random numbers; only the order "
    "of sums differs); counted; one warning"
)
PILOT_TOO = TWIN + (
    "; by default with so many samples that a pilot decides, which finds the same mean (and decides the "
    "same, unless rays traced for the bad number alone turn the scale; then the twin does as it says)"
)
