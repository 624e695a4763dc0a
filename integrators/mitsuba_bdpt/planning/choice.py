"""Chooses the most efficient configuration from a pilot's statistics.

Minimises cost times error. The error is the geometric mean of that of the mean render and of a typical one
(`Moments.variance`, `Moments.typical`): most renders lack the rarest outliers.
Costs are counted, not timed (see `COSTS`): equal seeds give equal decisions on all machines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..transport.plan import GUIDED
from .configuration import PATH_TRACING, Configuration, Decision, not_worth
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
    """Cost of a sample in a render of ``samples`` samples; path tracing alone costs 1.

    Includes `FIXED`. ``rays`` per sample of the pilot, see `moments.Moments`.
    """
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

# Bootstrap resamplings of a pilot's groups, see `confidence`.
RESAMPLINGS = 100

# relMSE per sample below which noise is invisible, and differences of candidates are the pilot's noise.
LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class Alternatives:
    """The ``candidates`` for a render with ``samples`` samples still to come.

    ``learnt``: tables of emission, with which light subpaths are traced.
    """

    candidates: list[Configuration]
    samples: float = math.inf
    learnt: Any = None  # a `guided_emission.Learnt`


@dataclass(frozen=True)
class Prediction:
    """The predicted efficiency of a candidate, guided emission included.

    ``cost`` of a sample and ``error`` (path tracing alone: 1); ``variance``: relMSE per sample, without
    SDS paths where s = 0 can be guided.
    """

    candidate: Configuration
    cost: float
    error: float
    variance: float

    @property
    def time(self) -> float:
        """Time to a given error (path tracing alone: 1)."""
        return self.cost * self.error

    @property
    def score(self) -> float:
        """The quantity that the choice minimises: `time`, but for `PATH_TRACING` times `REQUIRED_GAIN`."""
        return self.time * (REQUIRED_GAIN if self.candidate != PATH_TRACING else 1)

    def decided(self, mean: float) -> Decision:
        """The candidate's decision; ``mean`` of the image."""
        return Decision.of(self.candidate, cost=self.cost, variance=self.variance, mean=mean)


def choose(moments: Moments, alternatives: Alternatives) -> list[Prediction]:
    """Predictions for the candidates of finite variance, the best first.

    Those with light subpaths with photon-guided BSDF sampling too, whose samples hardly add an error; path
    tracing alone would guide more vertices than were counted.
    """
    candidates, learnt = alternatives.candidates, alternatives.learnt
    both = (
        np.maximum(_by_group(values, candidates, learnt).mean(axis=0), LEAST_VARIANCE)
        for values in (moments.variance, moments.typical)
    )
    rows: list[Prediction] = []
    mean, typical = moments.guidable
    for candidate, v, t in zip(candidates, *(values.tolist() for values in both), strict=True):
        if not math.isfinite(v):
            continue
        candidate = _with_tables(candidate, learnt)
        each = cost(candidate, moments.rays, alternatives.samples)
        rows.append(Prediction(candidate, each, ((v + mean) * (t + typical)) ** 0.5, v))
        if mean and candidate.light_paths:
            candidate = replace(candidate, guided=GUIDED)
            each = cost(candidate, moments.rays, alternatives.samples)
            rows.append(Prediction(candidate, each, (v * t) ** 0.5, v))
    alone = [row.error for row in rows if not row.candidate.light_paths]
    unit = min(alone or [row.error for row in rows], default=1.0)
    return sorted((replace(row, error=row.error / unit) for row in rows), key=lambda row: row.score)


def _with_tables(candidate: Configuration, learnt: Learnt | None) -> Configuration:
    """The candidate with tables of emission, if there are any and it has light subpaths."""
    return replace(candidate, emission=learnt.tables) if learnt and candidate.light_paths else candidate


def _by_group(variances: np.ndarray, candidates: list[Configuration], learnt: Learnt | None) -> np.ndarray:
    """Those of ``candidates`` of all ``variances`` by group of the pilot, shape (`GROUPS`, candidates).

    At least 0: an estimate may be negative, and one such group would make a candidate the best. Times what
    tables of emission leave.
    """
    found = np.maximum(variances[:, [candidate.number for candidate in candidates]], 0)
    if learnt is None or learnt.tables is None:
        return found
    powers = [(1 if c.connections != "none" else TABLES_ALONE) if c.light_paths else 0 for c in candidates]
    return found * learnt.whole ** np.array(powers)


def confidence(moments: Moments, alternatives: Alternatives) -> float:
    """Confidence in the choice, from bootstrap resamplings of the pilot's groups.

    Share of `RESAMPLINGS` in which the candidate that `choose` puts first is within `NEAR` of the best.
    """
    best = choose(moments, alternatives)[0].candidate
    random = np.random.default_rng(len(alternatives.candidates))
    agree = 0
    for _ in range(RESAMPLINGS):
        table = choose(moments.of(random.integers(0, GROUPS, GROUPS)), alternatives)
        times = {row.candidate: row.time for row in table}
        agree += times.get(best, math.inf) <= NEAR * min(times.values())
    return agree / RESAMPLINGS


def why_not(row: Prediction, chosen: Prediction) -> str:
    """Why ``row`` of the table of `choose` is not ``chosen``.

    Empty if it would not take less time.
    """
    gain = chosen.time / row.time
    if gain <= 1:
        return ""
    what = "light subpaths" if row.candidate.light_paths else "other weights"
    return f"{what} have to gain {REQUIRED_GAIN:g}x over path tracing alone, and gain {gain:.2f}x"


def left_out(table: list[Prediction], guided: str = "guided s=0") -> list[dict[str, str]]:
    """What the best of `choose` leaves out, and why, as in ``statistics["skipped"]``.

    ``guided``: the class of strategies that the candidates with guided samples have.
    """
    skipped: list[dict[str, str]] = []
    without: dict[str, Callable[[Configuration], bool]] = {
        "t<=1": lambda c: not c.light_paths,
        "inner": lambda c: c.connections == "none",
        guided: lambda c: not c.guided,
    }
    for name, lacks in without.items():
        others = [row for row in table if not lacks(row.candidate)]
        if others and lacks(table[0].candidate):
            best = min(others, key=lambda row: row.time)
            ratio = best.time / table[0].time
            why = f"in the pilot, renders with it take at least {ratio:.2f} times as long for the same error"
            why = why_not(best, table[0]) or why
            skipped.append(not_worth(name, why))
    return skipped
