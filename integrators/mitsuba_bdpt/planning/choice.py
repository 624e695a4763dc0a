"""Chooses the most efficient configuration from a pilot's statistics.

Minimises cost times the geometric mean of both `Moments.errors`: most renders lack the rarest outliers.
Costs are counted, not timed (see `COSTS`): equal seeds give equal decisions on all machines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..transport.plan import GUIDED_SAMPLES
from .configuration import CANDIDATES, PATH_TRACING, Configuration, not_worth
from .moments import GROUPS, Moments

if TYPE_CHECKING:
    from ..guided_emission import Learnt

# Costs in units of a ray of a camera subpath (closest hit or shadow ray, including shading). Fitted; see
# experiments, "Choice of strategies".
COSTS = {
    "light": 1.25,  # a ray of a light subpath
    "inner": 0.9,  # inner connections, per sample
    "evaluated": 0.33,  # an evaluated pair of vertices
    # With media instead: an evaluated pair of the lane of a packet with most, for which the others wait.
    "packets": 0.16,
    "several": 0.7,  # inner connections with several light subpaths, per sample
    "guided": 31.0,  # a vertex with photon-guided BSDF sampling, its samples included
}

# Cost of a render besides its samples, mainly recording of its kernel, in the same unit: path tracing alone,
# plus light subpaths, plus guiding. See experiments, "Choice of strategies".
FIXED = {"start": 180e3, "light": 250e3, "guided": 600e3}


def cost(candidate: Configuration, rays: Mapping[str, float], samples: float = math.inf) -> float:
    """Cost of a sample in a render of ``samples``; path tracing alone costs 1. ``rays``: see `Moments`."""
    total = camera = rays["camera"] + rays["shadow_s1"] + FIXED["start"] / samples
    if candidate.light_paths:
        total += FIXED["light"] / samples
        total += COSTS["light"] * (rays["light"] + rays["shadow_t1"]) * candidate.light_paths
    if candidate.connections != "none":
        kind = "packets" if "packets" in rays else "evaluated"
        total += COSTS["inner"] + COSTS[kind] * rays[kind]
        total += COSTS["several"] * (candidate.joined > 1)
    if candidate.guided:
        total += FIXED["guided"] / samples
        total += COSTS["guided"] * rays["guidable"]
    return total / camera


# Factor by which all but `PATH_TRACING` have to shorten the time, since predictions are inexact; see
# experiments, "Choice of strategies".
REQUIRED_GAIN = 1.1

# Tables of emission leave this power of `Learnt.whole`, which is that of all strategies together, without
# inner connections; see experiments, "Choice of strategies".
TABLES_ALONE = 0.7

# `confidence` counts resamplings in which the chosen candidate takes at most this multiple of the best time.
NEAR = 1.15

RESAMPLINGS = 100  # bootstrap resamplings of a pilot's groups, see `confidence`

# relMSE per sample below which noise is invisible, and differences of candidates are the pilot's noise.
LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class Prediction:
    """Predicted ``cost`` of a sample and ``error`` of a candidate (path tracing alone: 1).

    ``variance``: relMSE per sample, without SDS paths where s = 0 can be guided.
    """

    candidate: Configuration
    cost: float
    error: float
    variance: float

    @property
    def time(self) -> float:
        """Time to a given error (path tracing alone: 1)."""
        return self.cost * self.error


def choose(
    moments: Moments, candidates: list[Configuration], samples: float = math.inf, learnt: Learnt | None = None
) -> list[Prediction]:
    """Predictions for a render of ``samples`` samples with the tables ``learnt``, the best first.

    Of candidates of finite variance; of those with light subpaths with photon-guided BSDF sampling too, whose
    samples hardly add an error. Path tracing alone would guide more vertices than were counted.
    """
    rows: list[Prediction] = []
    guidable = any(moments.guidable)
    for way in candidates:
        # At least 0: an estimate may be negative, and one such group would make a candidate the best.
        of_groups = np.maximum(moments.errors[:, :, CANDIDATES.index(way)], 0)
        light = way.light_paths > 0
        if light and learnt and learnt.tables:
            of_groups = of_groups * learnt.whole ** (1 if way.connections != "none" else TABLES_ALONE)
        errors = np.maximum(of_groups.mean(axis=1), LEAST_VARIANCE)
        if not math.isfinite(errors[0]):
            continue
        for guided in (0, GUIDED_SAMPLES) if guidable and light else (0,):
            emission = learnt.tables if learnt and light else None
            candidate = replace(way, guided=guided, emission=emission)
            each = cost(candidate, moments.rays, samples)
            left = errors if guided else errors + moments.guidable
            rows.append(Prediction(candidate, each, float(left.prod()) ** 0.5, float(errors[0])))
    alone = [row.error for row in rows if not row.candidate.light_paths]
    unit = min(alone or [row.error for row in rows], default=1.0)
    rows = [replace(row, error=row.error / unit) for row in rows]
    return sorted(rows, key=lambda row: row.time * (REQUIRED_GAIN if row.candidate != PATH_TRACING else 1))


def confidence(moments: Moments, candidates: list[Configuration], *others: Any) -> float:
    """Confidence in the choice, from bootstrap resamplings of the pilot's groups; arguments as in `choose`.

    Share of `RESAMPLINGS` in which the candidate that `choose` puts first is within `NEAR` of the best.
    """
    best = choose(moments, candidates, *others)[0].candidate
    random = np.random.default_rng(len(candidates))
    agree = 0
    for _ in range(RESAMPLINGS):
        resampled = replace(moments, errors=moments.errors[:, random.integers(0, GROUPS, GROUPS)])
        times = {row.candidate: row.time for row in choose(resampled, candidates, *others)}
        agree += times.get(best, math.inf) <= NEAR * min(times.values())
    return agree / RESAMPLINGS


def why_not(row: Prediction, chosen: Prediction) -> str:
    """Why ``row`` of the table of `choose` is not ``chosen``, though it takes less time; else empty."""
    gain = chosen.time / row.time
    what = "light subpaths" if row.candidate.light_paths else "other weights"
    why = f"{what} have to gain {REQUIRED_GAIN:g}x over path tracing alone, and gain {gain:.2f}x"
    return why if gain > 1 else ""


def left_out(table: list[Prediction], guided: str = "guided s=0") -> list[dict[str, str]]:
    """What the best of `choose` leaves out, and why, as in ``statistics["skipped"]``.

    ``guided``: the class of strategies that the candidates with guided samples have.
    """
    skipped: list[dict[str, str]] = []
    uses: dict[str, Callable[[Configuration], bool]] = {
        "t<=1": lambda c: c.light_paths > 0,
        "inner": lambda c: c.connections != "none",
        guided: lambda c: c.guided > 0,
    }
    for name, has in uses.items():
        others = [row for row in table if has(row.candidate)]
        if others and not has(table[0].candidate):
            best = min(others, key=lambda row: row.time)
            ratio = best.time / table[0].time
            why = f"in the pilot, renders with it take at least {ratio:.2f} times as long for the same error"
            skipped.append(not_worth(name, why_not(best, table[0]) or why))
    return skipped
