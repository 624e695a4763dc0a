"""A scene with a number that is not finite compared with its *twin*, in which the same number is 0.

Same seed, same random numbers, so that the images are the same up to the order of sums, whatever is in them.
"""

import internals
import numpy as np
from mitsuba_bdpt.planning import budget
from warned import Warned

from .compare import WAYS
from .rooms import SIZE

# Of the brightest value: sums in single precision, in the order in which threads come to them.
ROUNDING = 1e-5

# Each way to render with its samples per pixel: by default so many that a pilot is asked.
EVERYTHING, DEFAULTS = (WAYS[name] | {"max_depth": 4} for name in ("all strategies", "defaults"))
SPP, PILOTED = 16, budget.LEAST_SAMPLES // SIZE**2
RENDERS = {"all strategies": (EVERYTHING, SPP), "defaults": (DEFAULTS, PILOTED)}


def rendered(scene, parameters, spp, **decisions):
    """Image, statistics and warnings of a render; ``decisions`` of another one in place of its own."""
    bdpt = internals.bdpt(**parameters, **decisions)
    with Warned() as warnings:
        image = np.array(bdpt.render(scene, spp=spp, seed=1), dtype=np.float64)
    return image, bdpt.statistics, warnings


def decided(statistics) -> list[dict]:
    """The decisions, without what they cost: rays are traced for NaN and infinity, but not for 0."""
    return [{name: x for name, x in d.items() if name != "cost"} for d in statistics["decisions"]]


def compare_with_twin(make, bad, parameters, spp=SPP, count=None) -> None:
    """Assert that ``make(bad)`` renders as ``make(0.0)`` does, and warns once of non-finite values.

    It counts ``count`` values (some, if None), the twin none. A pilot decides where there are `PILOTED`
    samples, and finds the same mean; the twin renders by its decision, in which rays that are traced for the
    bad number alone count (so does the threshold of roulette).
    """
    image, statistics, warnings = rendered(make(bad), parameters, spp)
    twin, of_twin, quiet = rendered(make(0.0), parameters, spp)
    assert bool(statistics["decisions"]) == (spp >= PILOTED)
    if statistics["decisions"] != of_twin["decisions"]:
        assert [made["mean"] for made in statistics["decisions"]] == [d["mean"] for d in of_twin["decisions"]]
        twin, *_ = rendered(make(0.0), parameters, spp, decisions=statistics["decisions"])
    found = statistics["non_finite"]
    off = np.abs(image - twin).max() / np.abs(twin).max()  # an image of features may be all that there is
    print(f"{found} counted, off by {off:.1g}")
    assert np.isfinite(image).all()
    assert off <= ROUNDING
    assert found == count if count is not None else found > 0
    assert len(warnings) == 1
    assert f": {found} of the image" in warnings[0]
    assert of_twin["non_finite"] == 0
    assert not quiet
