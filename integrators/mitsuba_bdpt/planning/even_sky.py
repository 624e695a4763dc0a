"""Decisions under an even sky, without a pilot."""

from __future__ import annotations

from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import Plan
from .budget import CHEAP_SAMPLES, EVEN
from .candidates import candidates
from .configuration import Configuration, Decision

# kappa of s = 1 under a sky of a ratio up to `UNIFORM`, where s = 0 has little noise (1 under other even
# skies). From `UNIFORM_SAMPLES` on a pilot chooses. See experiments, "Choice of strategies".
SKY_DIRECT, UNIFORM, UNIFORM_SAMPLES = 1 / 2, 2, 1 << 20

# Multiple of the least length of a render with a pilot from which on that gain pays for the pilot.
UNIFORM_TIMES = 10


def decision(
    prepared: PreparedScene, full: Plan, settings: Settings, samples: int, least: int
) -> Decision | None:
    """Decision for a render of ``samples`` samples that needs no pilot, or None.

    Path tracing alone under an even sky in a render too short for a pilot (``least`` samples elsewhere):
    camera subpaths hit such a sky wherever its light enters, caustics included, and light subpaths rarely
    find the way in.
    """
    contrast = prepared.emitters.contrast
    most = max(UNIFORM_TIMES * least, UNIFORM_SAMPLES if contrast <= UNIFORM else CHEAP_SAMPLES)
    if samples >= most or not contrast <= EVEN:  # also if it is NaN
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
