"""Chooses the most efficient configuration from a pilot's statistics.

Minimises cost times error. The error is the larger of two, relative to path tracing alone: that of the mean
render and of a typical one (`Moments.variance`, `Moments.typical`): most renders lack the rarest outliers.
Costs are counted, not timed (see `COSTS`): equal seeds give equal decisions on all machines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..transport.plan import GUIDED, EmissionTables
from .configuration import Configuration, Decision, not_worth
from .moments import GROUPS, Moments

# Costs in units of a ray of a camera subpath (closest hit or shadow ray, including shading). Fitted; see
# experiments, "Costs".
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


# Factor by which light subpaths have to shorten the time, since predictions are inexact; see experiments,
# "Choice of strategies".
REQUIRED_GAIN = 1.1

# `confidence` counts resamplings in which the chosen candidate takes at most this multiple of the best time.
NEAR = 1.15

# Photon-guided BSDF sampling has to gain this factor in three quarters of the pilot's groups. It removes
# outliers only, at a cost; see experiments, "Photon-guided BSDF sampling".
GUIDE_GAIN = 3.0

# The same in scenes with near-specular lobes, where the trimmed error falls too (`pilot.LEAST_REDUCTION`).
NEAR_SPECULAR_GAIN = 1.0

# Bootstrap resamplings of a pilot's groups, see `confidence`.
RESAMPLINGS = 100

# relMSE per sample below which noise is invisible, and differences of candidates are the pilot's noise.
LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class Alternatives:
    """The ``candidates`` for a render with ``samples`` samples still to come.

    ``stratified``: whether its points are stratified, see `moments.Moments.variance`; ``guidable``: whether
    photon-guided BSDF sampling is possible; ``near_specular``: the scene has near-specular lobes.
    """

    candidates: list[Configuration]
    stratified: bool
    samples: float = math.inf
    guidable: bool = False
    near_specular: bool = False

    @property
    def guide_gain(self) -> float:
        """The gain from which on photon-guided BSDF sampling pays."""
        return NEAR_SPECULAR_GAIN if self.near_specular else GUIDE_GAIN


@dataclass(frozen=True)
class Prediction:
    """The predicted efficiency of a candidate.

    ``cost`` of a sample and ``error`` (path tracing alone: 1); ``variance``: relMSE per sample including the
    stratification gain, without SDS paths where s = 0 can be guided; ``gain``: see `guided_gain`;
    ``without_tables``: the figures do not include guided emission.
    """

    candidate: Configuration
    cost: float
    error: float
    variance: float
    gain: float = 1.0
    without_tables: bool = False

    @property
    def time(self) -> float:
        """Time to a given error (path tracing alone: 1)."""
        return self.cost * self.error

    @property
    def score(self) -> float:
        """The quantity that the choice minimises: `time`, with light subpaths times `REQUIRED_GAIN`."""
        return self.time * (REQUIRED_GAIN if self.candidate.light_paths else 1)

    def with_emission(self, tables: EmissionTables, without_tables: bool) -> Prediction:
        """The same with emission guided by ``tables``, if it has light subpaths."""
        if not self.candidate.light_paths:
            return self
        candidate = replace(self.candidate, emission=tables)
        return replace(self, candidate=candidate, without_tables=without_tables)

    def decided(self, mean: float) -> Decision:
        """The candidate's decision; ``mean`` of the image."""
        return Decision.of(self.candidate, cost=self.cost, variance=self.variance, mean=mean)


def choose(moments: Moments, alternatives: Alternatives) -> list[Prediction]:
    """Predictions for the candidates of finite variance, the best first.

    Preceded by the best one with photon-guided BSDF sampling, if that pays.
    """
    table = _unguided(moments, alternatives)
    guided = _guided(moments, alternatives, table)
    return [guided, *table] if guided and guided.gain >= alternatives.guide_gain else table


def guided_gain(moments: Moments, alternatives: Alternatives, table: list[Prediction]) -> float:
    """Factor by which guiding s = 0 shortens the time to equal error, outliers included; 0 if impossible.

    Lower quartile of the groups. ``table`` of `choose`.
    """
    guided = _guided(moments, alternatives, [row for row in table if not row.candidate.guided])
    return guided.gain if guided else 0.0


def _guided(moments: Moments, alternatives: Alternatives, table: list[Prediction]) -> Prediction | None:
    """The best prediction with light subpaths, with photon-guided BSDF sampling; None if impossible.

    Path tracing alone would guide more vertices than the pilot measures, those that light tracing samples.
    The number of light subpaths and the coefficients do not depend on guiding: its outliers would hide the
    differences of the candidates.
    """
    lit = next((row for row in table if row.candidate.light_paths), None)
    if not alternatives.guidable or lit is None or not moments.sds.size:
        return None
    candidate = replace(lit.candidate, guided=GUIDED)
    each = cost(candidate, moments.rays, alternatives.samples)
    others = _by_group(moments.variance(alternatives.stratified), [table[0].candidate, lit.candidate])
    best, variance = np.maximum(others, LEAST_VARIANCE).T
    best = np.minimum(best, variance * table[0].error / lit.error)  # not what light subpaths do without it
    unguided, guided = moments.sds.T
    # Not the ratio of means: a few vertices may hold all of the variance.
    gains = table[0].cost * (best + unguided) / (each * (variance + guided))
    return replace(lit, candidate=candidate, cost=each, gain=float(np.quantile(gains, 1 / 4)))


def _unguided(moments: Moments, alternatives: Alternatives) -> list[Prediction]:
    """Predictions for the candidates of finite variance, the best first."""
    variances = moments.variance(alternatives.stratified), moments.typical(alternatives.stratified)
    both = [_by_group(values, alternatives.candidates).mean(axis=0) for values in variances]
    possible = np.flatnonzero(np.isfinite(both[0])).tolist()
    if not possible:
        return []
    candidates = [alternatives.candidates[i] for i in possible]
    both = np.maximum(np.stack(both)[:, possible], LEAST_VARIANCE)
    costs = np.array([cost(candidate, moments.rays, alternatives.samples) for candidate in candidates])
    light = np.array([candidate.light_paths > 0 for candidate in candidates])
    errors = _errors(both, costs, light)
    rows = zip(candidates, costs.tolist(), errors.tolist(), both[0].tolist(), strict=True)
    return sorted((Prediction(*row) for row in rows), key=lambda row: row.score)


def _errors(both: np.ndarray, costs: np.ndarray, light: np.ndarray) -> np.ndarray:
    """The larger error of each candidate, relative to path tracing alone; ``both`` errors, shape (2, n).

    Of candidates with ``light`` subpaths, which are ranked by the ratios to the least errors among them, the
    best has that error: where path tracing alone has next to no chance, its ratios would not tell them apart.
    """
    if light.all() or not light.any():
        return (both / both.min(axis=1, keepdims=True)).max(axis=0)
    alone = both[:, ~light][:, [both[:, ~light].prod(axis=0).argmin()]]
    errors = (both / alone).max(axis=0)
    ranks = (both[:, light] / both[:, light].min(axis=1, keepdims=True)).max(axis=0)
    best = (costs[light] * ranks).argmin()
    errors[light] = ranks * (errors[light][best] / ranks[best])
    return errors


def _by_group(variances: np.ndarray, candidates: list[Configuration]) -> np.ndarray:
    """Those of ``candidates`` of all ``variances`` by group of the pilot, shape (`GROUPS`, candidates).

    At least 0: an estimate may be negative, and one such group would make a candidate the best.
    """
    return np.maximum(variances[:, [candidate.number for candidate in candidates]], 0)


def confidence(moments: Moments, alternatives: Alternatives) -> float:
    """Confidence in the choice, from bootstrap resamplings of the pilot's groups.

    Share of `RESAMPLINGS` in which the candidate that `choose` puts first is within `NEAR` of the best.
    """
    best = _unguided(moments, alternatives)[0].candidate
    random = np.random.default_rng(len(alternatives.candidates))
    agree = 0
    for _ in range(RESAMPLINGS):
        table = _unguided(moments.of(random.integers(0, GROUPS, GROUPS)), alternatives)
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
    if chosen.candidate.guided and not row.candidate.guided:
        return "without guided s=0 it has the outliers of SDS paths, which are in no figure here"
    return f"light subpaths have to gain {REQUIRED_GAIN:g}x over path tracing alone, and gain {gain:.2f}x"


def left_out(
    table: list[Prediction], guided: float = 0.0, least: float = GUIDE_GAIN, name: str = "guided s=0"
) -> list[dict[str, str]]:
    """What the best of `choose` leaves out, and why, as in ``statistics["skipped"]``.

    ``guided``: the `guided_gain` of the class ``name``, which needs ``least``.
    """
    skipped: list[dict[str, str]] = []
    if guided and not table[0].candidate.guided:
        why = (
            f"guiding gains {guided:.2f}x or more in three quarters of the pilot's parts, outliers "
            f"included, and has to gain {least:g}x"
        )
        skipped.append(not_worth(name, why))
    without: dict[str, Callable[[Configuration], bool]] = {
        "t<=1": lambda c: not c.light_paths,
        "inner": lambda c: c.connections == "none",
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
