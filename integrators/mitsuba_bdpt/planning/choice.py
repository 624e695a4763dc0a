"""Chooses the most efficient configuration from a pilot's statistics.

The least cost times variance wins, after what stratified points take off the variances. Costs are counted,
not timed (see `COSTS`), so that the same seed leads to the same decision on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..emitters.emission_tables import EmissionTables
from ..transport.plan import GUIDED
from .configuration import WEIGHTINGS, Configuration, Decision
from .moments import GROUPS, Moments

# What takes how long, in units of a ray of a camera subpath (closest hit or shadow, with all that belongs to
# it). Fitted to candidates in 29 scenes on two cores (docs/reports/choices.json): off by 6 % (root mean
# square) for the ratios of their times.
COSTS = {
    "light_path": 1.7,  # to start a light subpath
    "far": 2.0,  # beside it, to start one from infinity
    "light": 0.76,  # each of its rays
    "light_in_media": 1.2,  # the same in a scene with media
    "inner": 0.55,  # to look for connections at all, per sample
    "joined": 0.65,  # a connection that is drawn and tested
    "shadow_inner": 0.65,  # each that is tested, where all are
    # In a scene with media, a pair that is evaluated by the lane of a packet that has most of them: others
    # wait for it, and long subpaths differ. (Six scenes: 0.13 to 0.28.)
    "packets": 0.18,
    "guide": 3.0,  # a vertex where s = 0 is guided
    "aimed": 7.0,  # each guided sample of it
    "diverging": 0.5,  # a pair whose BSDFs are evaluated, where the lanes of a packet meet different ones
}

# What a render takes besides its samples, most of it to record its kernel, in the same unit: with path
# tracing alone, for light subpaths beside it, for connections. (Renders of 2 samples of 16^2 pixels in seven
# scenes: 8 to 13 ms, 8 to 17 ms, 0 to 2 ms, where a ray takes 34 to 53 ns on two cores.) Previews of 128^2 at
# 4 samples per pixel have 200,000 to 500,000 rays.
FIXED = {"start": 180e3, "light": 250e3, "inner": 20e3, "guided": 600e3}

# Numbers of kinds of BSDFs from which on, and up to which, the lanes of a packet take turns in evaluating
# theirs. (BSDFs of one kind share their functions. By the number of BSDFs, a connection seemed to cost 1.3
# times what it does in a room of 12 BSDFs of 5 kinds, and path tracing alone was chosen there.)
FEW_KINDS, MANY_KINDS = 2, 16


def cost(candidate: Configuration, rays: Mapping[str, float], samples: float = math.inf) -> float:
    """Cost of a sample in a render of so many ``samples``; that of path tracing alone is 1.

    What is `FIXED` is included. ``rays`` per sample of the pilot, see `moments.Moments`.
    """
    total = camera = rays["camera"] + rays["shadow_s1"] + FIXED["start"] / samples
    if candidate.light_paths:
        total += FIXED["light"] / samples
        light = COSTS["light_path"] + COSTS["far"] * rays["far"]
        each = COSTS["light_in_media" if rays.get("media") else "light"]
        light += each * (rays["light"] + rays["shadow_t1"])
        total += light * candidate.light_paths
    if candidate.connections != "none":
        total += FIXED["inner"] / samples
        kind = "joined" if candidate.connections == "one" else "shadow_inner"
        total += COSTS["inner"] + COSTS[kind] * rays[kind]
        total += COSTS["packets"] * rays.get("packets", 0)
        part = (rays["kinds"] - FEW_KINDS) / (MANY_KINDS - FEW_KINDS)
        total += COSTS["diverging"] * min(max(part, 0), 1) * rays["evaluated"]
    if candidate.guided:
        total += FIXED["guided"] / samples
        total += (COSTS["guide"] + COSTS["aimed"] * candidate.guided) * rays["aimed"]
    return total / camera


# A candidate whose sample costs c times as much has to gain c^CAUTION: predictions are off by some 10 %, and
# where candidates hardly differ pilots of other seeds choose something else (docs/development/experiments.md,
# "Choice of strategies").
CAUTION = 0.3

# In the resamplings that `certainty` counts the chosen candidate takes at most so many times as long as the
# best.
NEAR = 1.15

# Photon-guided BSDF sampling (s = 0) with one sample has to gain this factor in three quarters of the pilot's
# groups. It removes outliers alone: where 2 is predicted, raw error times time falls by 1.4 to 2.8, and
# trimmed error times time rises by 1.2 to 1.6. (Of eight pilots in seven scenes at 4 to 256 samples per pixel
# of 128^2 none predicts 2.3 to 3.5; see docs/method/skipping.md.)
GUIDE_GAIN = 2.5

# A larger number of guided samples has to gain this factor over a smaller one: what guiding cannot help is in
# no prediction of it.
MORE_GUIDED_GAIN = 1.3

# Bootstrap samples of a pilot's groups, see `certainty`.
RESAMPLINGS = 100

# Per sample, as relMSE: below it nobody sees noise, and candidates differ by that of the pilot.
LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class Alternatives:
    """What a render may do: the ``candidates``, for so many ``samples`` that are still to come.

    ``stratified``: whether its points will be better than independent ones, see `moments.Moments.variance`;
    ``guidable``: whether s = 0 can be guided."""

    candidates: list[Configuration]
    stratified: bool
    samples: float = math.inf
    guidable: bool = False


@dataclass(frozen=True)
class Prediction:
    """The predicted efficiency of a candidate.

    ``cost`` of a sample (path tracing alone: 1); its ``variance`` as relMSE, before what points take off that
    of all candidates, without isolated light where s = 0 can be guided; ``gain``: see `guided_gain`;
    ``without_tables``: not of the tables that guide emission.
    """

    candidate: Configuration
    cost: float
    variance: float
    gain: float = 1.0
    without_tables: bool = False

    @property
    def time(self) -> float:
        """To a certain error, in a unit of its own."""
        return self.cost * self.variance

    @property
    def score(self) -> float:
        """What is least in the choice: the time, and `CAUTION` about what costs more."""
        return self.time * self.cost**CAUTION

    def with_emission(self, tables: EmissionTables, without_tables: bool) -> Prediction:
        """The same with light subpaths that ``tables`` guide, if there are some."""
        if not self.candidate.light_paths:
            return self
        candidate = replace(self.candidate, emission=tables)
        return replace(self, candidate=candidate, without_tables=without_tables)

    def decided(self, first_pass: int, mean: float) -> Decision:
        """The decision for the candidate from the pass ``first_pass`` on; ``mean`` of the image."""
        return Decision.of(self.candidate, first_pass, cost=self.cost, variance=self.variance, mean=mean)


def choose(moments: Moments, alternatives: Alternatives) -> list[Prediction]:
    """Predictions for the candidates, the best first; without those that lose light.

    Before them the best of them with s = 0 guided, if that pays.
    """
    table = _unguided(moments, alternatives)
    if guided := _guided(moments, alternatives, table):
        gain, row = guided[0]
        pays = gain >= GUIDE_GAIN
        for more in guided[1:]:
            if more[0] >= MORE_GUIDED_GAIN * gain:
                gain, row = more
        if pays:
            table.insert(0, row)
    return table


def guided_gain(moments: Moments, alternatives: Alternatives, table: list[Prediction]) -> float:
    """Factor by which guiding s = 0 shortens the time to the same error; 0 where that is impossible.

    Outliers included. The lower quartile of the pilot's groups, for the smallest number of guided samples:
    errors that guiding does not reduce are in no prediction of it. ``table`` of `choose`.
    """
    found = _guided(moments, alternatives, [row for row in table if not row.candidate.guided])
    return found[0][0] if found else 0.0


def _guided(
    moments: Moments, alternatives: Alternatives, table: list[Prediction]
) -> list[tuple[float, Prediction]]:
    """The best way with light subpaths and each number of guided samples, after its gain, see `guided_gain`.

    Path tracing alone would guide more than the pilot has seen: what light tracing joins. The number of light
    subpaths and their coefficients are chosen before and do not depend on it: outliers would hide how other
    candidates differ.
    """
    lit = next((row for row in table if row.candidate.light_paths), None)
    if not alternatives.guidable or lit is None or not moments.isolated.size:
        return []
    alone, *guided = moments.isolated.T
    others = _by_group(moments, [table[0].candidate, lit.candidate], alternatives.stratified)
    best, variance = np.maximum(others, LEAST_VARIANCE).T  # an estimate of little variance may be negative
    before = table[0].cost * (best + alone)
    found: list[tuple[float, Prediction]] = []
    for samples, isolated in zip(GUIDED, guided, strict=True):
        candidate = replace(lit.candidate, guided=samples)
        each = cost(candidate, moments.rays, alternatives.samples)
        # Not of the means: a few vertices may have all of the variance, and means of few groups swing.
        gain = float(np.quantile(before / (each * (variance + isolated)), 1 / 4))
        found.append((gain, replace(lit, candidate=candidate, cost=each, gain=gain)))
    return found


def _unguided(moments: Moments, alternatives: Alternatives) -> list[Prediction]:
    """Predictions for the candidates of finite variance, the best first."""
    candidates = alternatives.candidates
    variances = _by_group(moments, candidates, alternatives.stratified).mean(axis=0)
    table = [
        Prediction(c, cost(c, moments.rays, alternatives.samples), max(v, LEAST_VARIANCE))
        for c, v in zip(candidates, variances.tolist(), strict=True)
        if math.isfinite(v)
    ]
    return sorted(table, key=lambda row: row.score)


def _by_group(moments: Moments, candidates: list[Configuration], stratified: bool) -> np.ndarray:
    """Variance of each candidate in each group of the pilot, shape (`GROUPS`, candidates)."""
    drawn = moments.variance(moments.draw, stratified)
    every = moments.variance(0, stratified)
    columns = [
        (drawn if c.connections == "one" else every)[:, :, WEIGHTINGS.index(c.weighting)] for c in candidates
    ]
    parts = np.stack(columns, axis=1)
    return parts[:, :, 0] + parts[:, :, 1] * [c.camera_paths_per_light_path for c in candidates]


def certainty(moments: Moments, alternatives: Alternatives) -> float:
    """How sure the choice is: a share of bootstrap samples of the pilot.

    In what share of `RESAMPLINGS` of its independent groups the candidate that `choose` puts first is within
    `NEAR` of the best.
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
    """Why ``row`` of the table of `choose` is not the ``chosen``.

    Empty if it would not take less time.
    """
    gain = chosen.time / row.time
    if gain <= 1:
        return ""
    if chosen.candidate.guided and not row.candidate.guided:
        return "without guided s=0 it has the outliers of SDS paths, which are in no figure here"
    more = row.cost / chosen.cost
    needed = f"{more**CAUTION:.2f}x"
    return f"a sample of it costs {more:.2f} times as much: it has to gain {needed}, and gains {gain:.2f}x"


def left_out(table: list[Prediction], guided: float = 0.0, name: str = "guided s=0") -> list[dict[str, str]]:
    """What the best of `choose` does without, and why, as in ``statistics["skipped"]``.

    ``guided``: its `guided_gain`, of what has this ``name``.
    """
    skipped: list[dict[str, str]] = []
    if guided and not table[0].candidate.guided:
        why = (
            f"guiding gains {guided:.2f}x or more in three quarters of the pilot's parts, outliers "
            f"included, and has to gain {GUIDE_GAIN:g}x"
        )
        skipped.append({"class": name, "level": "not worth its cost here", "why": why})
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
            skipped.append({"class": name, "level": "not worth its cost here", "why": why})
    return skipped
