"""What pays: the candidate with the least cost times variance, from a pilot's moments.

Costs are counted, not timed: what the pilot's subpaths did times what that takes (`COSTS`), so that the same
seed leads to the same decision on every machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from .pilot import WEIGHTINGS, Moments
from .plan import LIGHT_PATHS, Plan, Settings, lost_paths

# Share of a render's samples that its pilot may take, and bounds of their number. A pilot's sample takes
# three to seven times as long as one of path tracing alone.
PILOT_SHARE = 1 / 256
LEAST_LANES, MOST_LANES = 1 << 11, 1 << 15

SERVED = tuple(round(1 / n) for n in LIGHT_PATHS if n)

# What takes how long, in units of a ray of a camera subpath (closest hit or shadow, with all that belongs to
# it). Fitted to ten scenes on two cores: off by 17 % (root mean square) for the ratio of a candidate's time
# to that of path tracing alone.
COSTS = {
    "light_path": 1.0,  # to start a light subpath
    "light": 0.95,  # each of its rays
    "inner": 0.2,  # to look for connections at all, per sample
    "joined": 1.15,  # a connection that is drawn and tested
    "shadow_inner": 1.1,  # each that is tested, where all are
}


# Per sample, as relMSE: below it nobody sees noise, and candidates differ by that of the pilot.
LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class Decision:
    """How to render from the pass number ``first_pass`` on: the parameters ``light_paths`` and
    ``connections``, the coefficients kappa of t <= 1 (over its count) and s = 1, ``cost`` of a sample (path
    tracing alone: 1), ``variance`` of a sample as relMSE, and the image's ``mean``, the scale of roulette."""

    first_pass: int
    light_paths: float
    connections: str
    splat_coefficient: float
    direct_coefficient: float
    cost: float
    variance: float
    mean: float

    def record(self) -> dict:
        """As in ``statistics["decisions"]``."""
        return {
            "pass": self.first_pass,
            "light_paths": self.light_paths,
            "connections": self.connections,
            "coefficients": {"t=1": self.splat_coefficient, "s=1": self.direct_coefficient},
            "cost": self.cost,
            "variance": self.variance,
            "mean": self.mean,
        }


@dataclass(frozen=True)
class Candidate:
    """A way to render: ``weighting`` of `pilot.WEIGHTINGS`, ``served`` camera subpaths per light subpath,
    ``connections`` ``none``, ``one`` or ``all``."""

    weighting: int
    served: int
    connections: str

    @property
    def light_paths(self) -> float:
        return 1 / self.served if WEIGHTINGS[self.weighting].light else 0

    def plan(self, full: Plan) -> Plan:
        """``full`` with what this candidate does not do left out."""
        weighting = WEIGHTINGS[self.weighting]
        light = weighting.light > 0
        return replace(
            full,
            splat=full.splat and light,
            endpoints=full.endpoints and light,
            arrival=full.arrival and light,
            connections=self.connections,
            served=self.served,
            splat_coefficient=weighting.light * self.served if light else full.splat_coefficient,
            direct_coefficient=weighting.direct,
        )


def lanes(samples: int) -> int:
    """Samples of the pilot of a render of so many, 0 for none."""
    wanted = min(int(samples * PILOT_SHARE), MOST_LANES)
    return wanted if wanted >= LEAST_LANES else 0


def is_open(full: Plan, settings: Settings) -> bool:
    """Whether there is something to choose: nothing is given by hand, and light subpaths are possible."""
    return (
        full.light
        and settings.skip == "auto"
        and settings.light_paths == settings.connections == "auto"
        and not settings.strategy_images
    )


def candidates(world, full: Plan, settings: Settings) -> list[Candidate]:
    """All ways to render that lose no light which ``full`` finds."""
    found = []
    for number, weighting in enumerate(WEIGHTINGS):
        for served in SERVED if weighting.light else (1,):
            if weighting.light * served > 1:
                continue  # kappa beyond its count is of no use
            kinds = ("one", "all") if weighting.inner else ("none",)
            found += [Candidate(number, served, kind) for kind in kinds]
    lost = lost_paths(world, full, settings)
    # A sensor with area sees delta emitters by light subpaths alone.
    tied = world.emitters.unhittable and not world.camera.delta and (full.endpoints or full.arrival)
    return [
        c
        for c in found
        if (full.connections != "none" or c.connections == "none")
        and lost_paths(world, c.plan(full), settings) == lost
        and (c.light_paths or not tied)
    ]


def cost(candidate: Candidate, rays: dict) -> float:
    """Cost of a sample; path tracing alone is 1. ``rays`` per sample of the pilot, see `pilot.Moments`."""
    total = camera = rays["camera"] + rays["shadow_s1"]
    if candidate.light_paths:
        light = COSTS["light_path"] + COSTS["light"] * (rays["light"] + rays["shadow_t1"])
        total += light * candidate.light_paths
    if candidate.connections != "none":
        kind = "joined" if candidate.connections == "one" else "shadow_inner"
        total += COSTS["inner"] + COSTS[kind] * rays[kind]
    return total / camera


def choose(moments: Moments, possible: list[Candidate], first_pass: int) -> tuple[Decision, list]:
    """The best of the ``possible`` candidates; and (candidate, cost, variance) of all, the best first."""
    table = []
    for c in possible:
        variance = float(np.median(moments.variance(c.weighting, c.served, c.connections == "one")))
        if math.isfinite(variance):
            table.append((c, cost(c, moments.rays), max(variance, LEAST_VARIANCE)))
    table.sort(key=lambda row: row[1] * row[2])
    best = table[0]
    weighting = WEIGHTINGS[best[0].weighting]
    decision = Decision(
        first_pass=first_pass,
        light_paths=best[0].light_paths,
        connections=best[0].connections,
        splat_coefficient=weighting.light * best[0].served,
        direct_coefficient=weighting.direct,
        cost=best[1],
        variance=best[2],
        mean=moments.mean,
    )
    return decision, table
