"""Whether renders agree with others, or with a known value, by tests on the means of tiles over seeds."""

from __future__ import annotations

import numpy as np
from metrics import Sample, sidak, tile_means, welch

import mitsuba as mi  # isort: skip

from .case import Outcome

# Chance that a right program fails one case, had the seeds not been fixed.
LEVEL = 1e-3


def tiles(scene, integrator: dict, seeds, spp: int) -> np.ndarray:
    """Means of 4 x 4 tiles and of the image in the last column, one row per seed."""
    made = mi.load_dict(integrator)
    rows = []
    for seed in seeds:
        image = np.array(made.render(scene, seed=seed, spp=spp), dtype=np.float64)[..., :3]
        rows.append([*tile_means(image, 4).mean(1), image.mean()])
    return np.array(rows)


def judged(ours, theirs: Sample, reach: float, what: str) -> Outcome:
    """Welch's test of the tiles of ``ours``, Sidak over them; ``reach``: the largest relative error of the
    image's mean that it may overlook (three standard errors of the difference), else it shows nothing."""
    ours = Sample.of(ours)
    found = welch(ours, theirs)
    p = sidak(found.p)
    mean, expected = ours.mean[-1], theirs.mean[-1]
    seen = 3 * found.error[-1] / abs(expected)
    ok = np.isfinite(ours.mean).all() and p >= LEVEL and seen <= reach
    return Outcome(
        bool(ok),
        f"mean {mean:.5g}, {what} {expected:.5g}; p = {p:.2g} over {len(found.p)} values; "
        f"sees errors of {100 * seen:.2g} %",
    )


def against(ours, theirs, reach: float, what: str = "`path`") -> Outcome:
    """`judged` against other renders."""
    return judged(ours, Sample.of(theirs), reach, what)


def against_known(ours, expected, reach: float) -> Outcome:
    """`judged` against a value that is known for all tiles, or values as of `tiles`."""
    return judged(ours, Sample.known(np.broadcast_to(expected, ours.shape[1])), reach, "known")


def together(outcomes: dict[str, Outcome]) -> Outcome:
    """Several outcomes, by what was tried, as one: expected if all are."""
    texts = [f"{'' if o.ok else '**no**: '}{name}: {o.happened}" for name, o in outcomes.items()]
    return Outcome(all(o.ok for o in outcomes.values()), "; ".join(texts))
