"""What is decided under an even sky without a pilot."""

from __future__ import annotations

from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import Plan
from .budget import CHEAP_SAMPLES, EVEN
from .candidates import candidates
from .configuration import Configuration, Decision

# kappa of s = 1 under a sky of a ratio up to `UNIFORM`, where s = 0 has hardly any noise of its own; 1 under
# other even ones. Efficiency over path with multijitter at 64 spp with 1, 1/2, 1/4: 1.03, 1.09, 1.04 in
# `open_sky`, 1.02, 1.00, 0.95 in `smallvcm_cornell_sky`, 0.62, 1.18, 1.83 in `furnace_white`. Error of
# plastic and metal on a floor under maps of the ratios 1.05, 5.9, 13, with 1/2 over that with 1: 0.84, 1.06,
# 1.06. From `UNIFORM_SAMPLES` on a pilot chooses: with 24 seeds 1/16 gains 0.8 to 1.2 over 1/2 in `open_sky`,
# 0.8 to 1.0 in `smallvcm_cornell_sky`, 1.0 to 1.9 (renders: 2.3) in `furnace_white`.
SKY_DIRECT, UNIFORM, UNIFORM_SAMPLES = 1 / 2, 2, 1 << 20

# Multiple of the least length of a render with a pilot at which such a gain pays for the pilot.
UNIFORM_TIMES = 10


def decision(
    prepared: PreparedScene, full: Plan, settings: Settings, samples: int, least: int
) -> Decision | None:
    """The decision for a render of so many ``samples`` for which the scene alone suffices.

    A pilot, which renders of ``least`` samples ask elsewhere, would take too much of it: under an even sky,
    path tracing alone. (Camera subpaths meet such a sky wherever its light enters, caustics included, and
    light subpaths hardly find the way in.)
    """
    contrast = prepared.emitters.contrast
    most = max(UNIFORM_TIMES * least, UNIFORM_SAMPLES if contrast <= UNIFORM else CHEAP_SAMPLES)
    if samples >= most or not contrast <= EVEN:  # also if it is no number
        return None
    if all(candidate.light_paths for candidate in candidates(prepared, full, settings)):
        return None
    alone = Configuration(0.0, "none", 1.0, SKY_DIRECT if contrast <= UNIFORM else 1.0)
    return Decision.of(alone, first_pass=0, cost=1.0, variance=0.0, mean=0.0)


# As in ``statistics["skipped"]``.
LEFT_OUT = [
    {
        "class": name,
        "level": "not worth its cost here",
        "why": "all light comes from an even sky, and the render is too short to ask a pilot",
    }
    for name in ("t<=1", "inner")
]
