"""What pays: the candidate with the least cost times variance, from a pilot's moments, less what points take
off them.

Costs are counted, not timed: what the pilot's subpaths did times what that takes (`COSTS`), so that the same
seed leads to the same decision on every machine.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace

import numpy as np

from ..errors import UsageError
from ..settings import CONNECTIONS, LIGHT_PATHS, Settings
from ..transport.plan import Plan
from .moments import GROUPS, Moments
from .pilot import WEIGHTINGS
from .possible import unreachable_paths

# Share of a render's samples that its pilot may take, and bounds of their number; a render of less than
# `LEAST_SAMPLES` has none. A pilot's sample takes several times as long as one of path tracing alone,
# and recording it longer than all of a short pilot's samples (scripts/overhead.py): 2 % of a render of
# `CHEAP_SAMPLES` of path tracing alone. In between a pilot is asked where the scene alone does not tell what
# pays: it is asked once for all renders of a scene, and what it decides is faster than a guess even in the
# first (docs/skipping.md).
PILOT_SHARE = 1 / 1024
LEAST_LANES, MOST_LANES = 1 << 12, 1 << 15
LEAST_SAMPLES, CHEAP_SAMPLES = 1 << 14, 1 << 24

# The least number in scenes of many BSDFs (`bsdf.MANY`), where the pilot's kernel takes 1.5 seconds to
# compile: a preview of 256^2 pixels at 32 samples each takes no longer. (In a room of 27 materials a pilot
# changed the efficiency of 2^17 samples by 1.06 and of 2^19 by 0.88, once nothing had to be compiled.)
LEAST_OF_MANY = 1 << 22

# What a render is taken for whose number of samples is only a bound, see `expected_samples`.
PROVISIONAL_SAMPLES = 1 << 20

# Up to this ratio of its largest radiance to its mean a sky is even: a clear one without its sun has some
# ten, one with it thousands.
EVEN = 100

# kappa of s = 1 under a sky of a ratio up to `UNIFORM`, where s = 0 has hardly any noise of its own; 1 under
# other even ones. Efficiency over path with multijitter at 64 spp with 1, 1/2, 1/4: 1.03, 1.09, 1.04 in
# `open_sky`, 1.02, 1.00, 0.95 in `smallvcm_cornell_sky`, 0.62, 1.18, 1.83 in `furnace_white`. Error of
# plastic and metal on a floor under maps of the ratios 1.05, 5.9, 13, with 1/2 over that with 1: 0.84, 1.06,
# 1.06. From `UNIFORM_SAMPLES` on a pilot is asked whether another one gains `UNIFORM_GAIN` over it: with 24
# seeds 0.8 to 1.2 for 1/16 in `open_sky`, 0.8 to 1.0 in `smallvcm_cornell_sky`, 1.0 to 1.9 (renders: 2.3) in
# `furnace_white`.
SKY_DIRECT, UNIFORM, UNIFORM_SAMPLES, UNIFORM_GAIN = 1 / 2, 2, 1 << 20, 1.1

SERVED = tuple(round(1 / n) for n in LIGHT_PATHS if n)

# What takes how long, in units of a ray of a camera subpath (closest hit or shadow, with all that belongs to
# it). Fitted to candidates in 29 scenes on two cores (docs/choices.json): off by 6 % (root mean square) for
# the ratios of their times.
COSTS = {
    "light_path": 1.7,  # to start a light subpath
    "far": 2.0,  # beside it, to start one from infinity
    "light": 0.76,  # each of its rays
    "inner": 0.55,  # to look for connections at all, per sample
    "joined": 0.65,  # a connection that is drawn and tested
    "shadow_inner": 0.65,  # each that is tested, where all are
    "diverging": 0.5,  # a pair whose BSDFs are evaluated, where the lanes of a packet meet different ones
}

# What a render takes besides its samples, most of it to record its kernel, in the same unit: with path
# tracing alone, for light subpaths beside it, for connections. (Renders of 2 samples of 16^2 pixels in seven
# scenes: 8 to 13 ms, 8 to 17 ms, 0 to 2 ms, where a ray takes 34 to 53 ns on two cores.) Previews of 128^2 at
# 4 samples per pixel have 200,000 to 500,000 rays.
FIXED = {"start": 180e3, "light": 250e3, "inner": 20e3}

# Numbers of BSDFs from which on, and up to which, the lanes of a packet take turns in evaluating theirs.
FEW_BSDFS, MANY_BSDFS = 4, 16


# With stratified points a coefficient of s = 1 other than 1 (under a nearly uniform sky: other than
# `SKY_DIRECT`, and then `UNIFORM_GAIN`) has to gain this factor over path tracing alone: it evens out two
# strategies whose noise good points may take off anyway, and what a pilot of 4,096 samples finds of that is
# off by a fifth.
DIRECT_GAIN = 1.3

# Light subpaths have to gain this factor over path tracing alone: predictions are off by as much, and who
# renders a plain scene should not notice that they were an option.
LIGHT_GAIN = 1.15

# Twice as many light subpaths have to gain this factor over fewer: numbers that hardly differ lie on one flat
# line, along which pilots of other seeds wander, and what is cheap is less at the mercy of predictions. (Mean
# of 32 pilots' time times error over the best: `uplight_room` 1.18 to 1.02, small_casters/sun_sphere 1.23 to
# 1.10, small_casters/spot_sphere 1.24 to 1.30, elsewhere the same.)
MORE_GAIN = 1.02

# Among candidates whose times are within this factor of the best, that comes first whose kernel is the first
# of these: pilots of other numbers of samples take the same kernel, which need not be compiled again.
KERNEL_TIE = 1.05
KERNELS = ("none", "one")

# Bootstrap samples of a pilot's groups, see `certainty`.
RESAMPLINGS = 100

# Films of fewer pixels ask no pilot, which takes splats for as noisy as those of an image of many pixels, and
# have a light subpath for each camera subpath, since those that share one are correlated.
FEW_PIXELS = 64

# Contributions below a share of the image's mean play roulette before their ray is traced: below this one,
# and below this multiple of a sample's relative variance. It adds at most the share to the variance, in most
# scenes a tenth of that, but all of it in a furnace, where hardly anything else is noisy.
MOST_ROULETTE, ROULETTE_PER_VARIANCE = 0.1, 0.2

# Of a recorded number: what single precision still holds when it is multiplied.
MOST = 1e30

# Of a group's variance over the median of all groups': below it is noise, see `_robust_mean`.
LEAST_USUAL = 0.1

# Per sample, as relMSE: below it nobody sees noise, and candidates differ by that of the pilot.
LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class Decision:
    """How to render from the pass number ``first_pass`` on: the parameters ``light_paths`` and
    ``connections``, the coefficients kappa of t <= 1 (over its count) and s = 1, ``cost`` of a sample (path
    tracing alone: 1), its ``variance`` as in `Choice`, and the image's ``mean``, the scale of roulette."""

    first_pass: int
    light_paths: float
    connections: str
    kappa_light: float
    kappa_direct: float
    cost: float
    variance: float
    mean: float

    @property
    def threshold(self) -> float:
        """The size below which contributions play roulette."""
        return self.mean * min(MOST_ROULETTE, ROULETTE_PER_VARIANCE * self.variance)

    def record(self) -> dict:
        """As in ``statistics["decisions"]``."""
        return {
            "pass": self.first_pass,
            "light_paths": self.light_paths,
            "connections": self.connections,
            "coefficients": {"t<=1": self.kappa_light, "s=1": self.kappa_direct},
            "cost": self.cost,
            "variance": self.variance,
            "mean": self.mean,
        }

    def plan(self, full: Plan) -> Plan:
        """``full`` with what is not done left out."""
        light = self.light_paths > 0
        adopted = replace(
            full,
            splat=full.splat and light,
            endpoints=full.endpoints and light,
            arrival=full.arrival and light,
            connections=self.connections if full.connections != "none" and light else "none",
            kappa_light=self.kappa_light,
            kappa_direct=self.kappa_direct,
        )
        return replace(
            adopted, camera_paths_per_light_path=round(1 / self.light_paths) if adopted.light else 1
        )


def read_decisions(text: str) -> tuple[Decision, ...]:
    """The parameter ``decisions``: JSON as in ``statistics``, an empty list for a render without a pilot;
    raises ``ValueError`` saying what is wrong, and in which entry."""
    where, made = "", []
    try:
        entries = json.loads(text)
        if not isinstance(entries, list):
            raise TypeError("a list of decisions is needed")
        for number, entry in enumerate(entries):
            where = f"entry {number}"
            made.append(_read_decision(entry))
        where = ""
        passes = [decision.first_pass for decision in made]
        if passes != sorted(set(passes)):
            raise ValueError(f"passes {passes} must rise")
        return tuple(made)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        says = f"{where}: {error}" if where else error
        what = f"{where} lacks {error}" if isinstance(error, KeyError) else says
        raise UsageError(
            f"decisions={text!r} is not what json.dumps(integrator.statistics['decisions']) writes: {what}"
        ) from error


def _read_decision(entry: dict) -> Decision:
    if not isinstance(entry, dict) or not isinstance(entry.get("coefficients", {}), dict):
        raise TypeError(f"{entry!r} is no decision")
    light_paths, connections = _number(entry, "light_paths"), entry["connections"]
    if light_paths not in LIGHT_PATHS or connections not in CONNECTIONS[1:]:
        raise ValueError(f"light_paths={light_paths!r}, connections={connections!r}")
    if not light_paths and connections != "none":
        raise ValueError(f"connections={connections!r} without light paths")
    if unknown := set(entry) - {
        "pass",
        "light_paths",
        "connections",
        "coefficients",
        "cost",
        "variance",
        "mean",
    }:
        raise ValueError(f"{sorted(unknown)[0]} is no part of a decision")
    if isinstance(entry["pass"], bool) or not isinstance(entry["pass"], int):
        raise TypeError(f"pass={entry['pass']!r}")
    numbers = {
        "first_pass": entry["pass"],
        "kappa_light": _number(entry["coefficients"], "t<=1"),
        "kappa_direct": _number(entry["coefficients"], "s=1"),
        **{name: _number(entry, name) for name in ("cost", "variance", "mean")},
    }
    for name, value in numbers.items():
        least = 0 if name in ("first_pass", "variance", "mean") else 2.0**-20
        if not least <= value <= MOST:
            raise ValueError(f"{name}={value!r}")
    return Decision(light_paths=light_paths, connections=connections, **numbers)


def _number(entry: dict, name: str) -> float:
    """A number of JSON: neither a boolean, which Python takes for one, nor text that holds one."""
    value = entry[name]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name}={value!r} must be a number")
    return float(value)


@dataclass(frozen=True)
class Candidate:
    """A way to render: ``weighting`` of `pilot.WEIGHTINGS`, ``camera_paths_per_light_path`` (S),
    ``connections`` ``none`` or ``one``; also ``all``, which no pilot chooses (`candidates`)."""

    weighting: int
    camera_paths_per_light_path: int
    connections: str

    @property
    def light_paths(self) -> float:
        """As the parameter."""
        return 1 / self.camera_paths_per_light_path if WEIGHTINGS[self.weighting].light else 0

    @property
    def direct(self) -> float:
        """kappa of s = 1."""
        return WEIGHTINGS[self.weighting].direct

    @property
    def combination(self) -> str:
        """See `pilot.Weighting.combination`."""
        return WEIGHTINGS[self.weighting].combination

    def decided(self, first_pass: int, cost: float, variance: float, mean: float) -> Decision:
        """The decision for this candidate."""
        weighting = WEIGHTINGS[self.weighting]
        # Six digits: further ones depend on the order in which the pilot's lanes were added up.
        numbers = {"cost": cost, "variance": variance, "mean": mean}
        return Decision(
            first_pass=first_pass,
            light_paths=float(self.light_paths),
            connections=self.connections,
            kappa_light=weighting.light * self.camera_paths_per_light_path if weighting.light else 1.0,
            kappa_direct=float(self.direct),
            **{name: float(f"{number:.6g}") for name, number in numbers.items()},
        )


@dataclass(frozen=True)
class Choice:
    """A candidate with the ``cost`` of a sample (path tracing alone: 1) and its ``variance`` as relMSE,
    before what points take off that of all candidates."""

    candidate: Candidate
    cost: float
    variance: float

    @property
    def time(self) -> float:
        """To a certain error, in a unit of its own."""
        return self.cost * self.variance


def expected_samples(settings: Settings, left: int, done: int = 0) -> int:
    """Samples still to come of a render with ``left`` more at most. Under ``timeout`` and ``target_error``
    nobody knows: as many as are ``done``, or `PROVISIONAL_SAMPLES`. (A pilot that takes half of the render
    would be as bad as one that sees rare paths which the render does not meet.)"""
    open_end = settings.target_error > 0 or 0 <= settings.timeout < math.inf
    return min(left, max(PROVISIONAL_SAMPLES, done)) if open_end else left


def least_samples(traits) -> int:
    """How many samples a render needs for a pilot; `bsdf.Traits` of its scene."""
    return LEAST_OF_MANY if traits.asked.many else LEAST_SAMPLES


def lanes(samples: int) -> int:
    """Samples of the pilot of a render of so many, which are enough for one."""
    return min(max(int(samples * PILOT_SHARE), LEAST_LANES), MOST_LANES)


def first_plan(full: Plan, settings: Settings, pixels: int) -> Plan:
    """What a render begins with: ``full``, with a light subpath for each camera subpath on films of few
    pixels, unless parameters say how many."""
    return (
        replace(full, camera_paths_per_light_path=1) if _is_auto(settings) and pixels < FEW_PIXELS else full
    )


def is_open(full: Plan, settings: Settings) -> bool:
    """Whether there is something to choose: nothing is given by hand, and light subpaths are possible."""
    return full.light and not is_by_hand(settings)


def is_by_hand(settings: Settings) -> bool:
    """Whether parameters say what is done. (Strategy images want all strategies.)"""
    return not _is_auto(settings) or settings.decisions is not None or settings.strategy_images


def _is_auto(settings: Settings) -> bool:
    return settings.skip == settings.light_paths == settings.connections == "auto"


def by_scene(prepared, full: Plan, settings: Settings, samples: int) -> Decision | None:
    """The decision for a render of so many ``samples`` for which the scene alone suffices, because a pilot
    would take too much of it: under an even sky, path tracing alone. (Camera subpaths meet such a sky
    wherever its light enters, caustics included, and light subpaths hardly find the way in.)"""
    contrast = prepared.emitters.contrast
    most = UNIFORM_SAMPLES if contrast <= UNIFORM else CHEAP_SAMPLES
    if samples >= most or not contrast <= EVEN:  # also if it is no number
        return None
    if all(candidate.light_paths for candidate in candidates(prepared, full, settings)):
        return None
    return Decision(0, 0.0, "none", 1.0, SKY_DIRECT if contrast <= UNIFORM else 1.0, 1.0, 0.0, 0.0)


BY_SCENE = [
    {
        "class": name,
        "level": "not worth its cost here",
        "why": "all light comes from an even sky, and the render is too short to ask a pilot",
    }
    for name in ("t<=1", "inner")
]


def candidates(prepared, full: Plan, settings: Settings) -> list[Candidate]:
    """All ways to render that lose no light which ``full`` finds, with one inner connection or none. (All of
    them gain 1.02 at most in the scenes of docs/choices.json, 1.13 in one of a small caustic, and one pilot
    of 32 chose them where they take 2.1 times as long.)"""

    def lost_without_arrival(plan):
        """A small lens is a poor finder of what t = 0 alone finds: it does not stand for connections."""
        return unreachable_paths(prepared, replace(plan, arrival=False), settings)

    found = []
    lost = lost_without_arrival(full)
    # A sensor with area sees delta emitters by light subpaths alone.
    tied = prepared.emitters.unhittable and not prepared.camera.delta and (full.endpoints or full.arrival)
    for number, weighting in enumerate(WEIGHTINGS):
        if weighting.inner and full.connections == "none" or tied and not weighting.light:
            continue
        connections = "one" if weighting.inner else "none"
        example = Candidate(number, 1, connections).decided(0, 1, 0, 0)
        if lost_without_arrival(example.plan(full)) != lost:
            continue
        most = 1 / weighting.light if weighting.light else 1  # a coefficient beyond the count is of no use
        found += [Candidate(number, served, connections) for served in SERVED if served <= most]
    return found


def cost(candidate: Candidate, rays: dict, samples: float = math.inf) -> float:
    """Cost of a sample in a render of so many ``samples``, what is `FIXED` included; path tracing alone is 1.
    ``rays`` per sample of the pilot, see `moments.Moments`."""
    total = camera = rays["camera"] + rays["shadow_s1"] + FIXED["start"] / samples
    if candidate.light_paths:
        total += FIXED["light"] / samples
        light = COSTS["light_path"] + COSTS["far"] * rays["far"]
        light += COSTS["light"] * (rays["light"] + rays["shadow_t1"])
        total += light * candidate.light_paths
    if candidate.connections != "none":
        total += FIXED["inner"] / samples
        kind = "joined" if candidate.connections == "one" else "shadow_inner"
        total += COSTS["inner"] + COSTS[kind] * rays[kind]
        part = (rays["bsdfs"] - FEW_BSDFS) / (MANY_BSDFS - FEW_BSDFS)
        total += COSTS["diverging"] * min(max(part, 0), 1) * rays["evaluated"]
    return total / camera


def choose(
    moments: Moments, possible: list[Candidate], stratified: bool, samples: float = math.inf
) -> list[Choice]:
    """The ``possible`` candidates for a render of so many ``samples``, the best first; ``stratified``:
    whether points will be better than independent ones, see `moments.Moments.variance` and `DIRECT_GAIN`."""
    drawn = moments.variance(_trimmed_mean(moments.draw), stratified)
    every = moments.variance(0, stratified)
    parts = np.stack(
        [(drawn if c.connections == "one" else every)[:, :, c.weighting] for c in possible], axis=1
    )
    variances = parts[:, :, 0] + parts[:, :, 1] * [c.camera_paths_per_light_path for c in possible]
    variances = _robust_mean(variances)
    table = [
        Choice(c, cost(c, moments.rays, samples), max(v, LEAST_VARIANCE))
        for c, v in zip(possible, variances.tolist(), strict=True)
        if math.isfinite(v)
    ]
    if stratified:
        table = _without_doubtful(table, moments.rays["evenness"] * UNIFORM >= 1)
    table.sort(key=lambda row: row.time * MORE_GAIN ** -math.log2(row.candidate.camera_paths_per_light_path))
    least = min((row.time for row in table), default=0.0)
    tied = [row for row in table if row.candidate.light_paths and row.time <= KERNEL_TIE * least]
    if tied:
        _put_first(table, min(tied, key=lambda row: KERNELS.index(row.candidate.connections)))
    # Path tracing alone before what is hardly better.
    alone = next((row for row in table if not row.candidate.light_paths), None)
    if alone is not None and alone.time <= LIGHT_GAIN * least:
        _put_first(table, alone)
    return table


def _without_doubtful(table: list[Choice], uniform: bool) -> list[Choice]:
    """Without the coefficients of s = 1 that gain too little over the usual one, see `DIRECT_GAIN`, under a
    nearly ``uniform`` sky or another one."""
    usual, gain = (SKY_DIRECT, UNIFORM_GAIN) if uniform else (1, DIRECT_GAIN)

    def is_usual(candidate):
        return bool(candidate.light_paths) or candidate.direct == usual

    alone = (row.variance for row in table if not row.candidate.light_paths and is_usual(row.candidate))
    most = min(alone, default=math.inf) / gain
    return [row for row in table if is_usual(row.candidate) or row.variance <= most]


def _put_first(table: list, row):
    table.remove(row)
    table.insert(0, row)


def certainty(
    moments: Moments, possible: list[Candidate], stratified: bool, samples: float = math.inf
) -> float:
    """In what share of `RESAMPLINGS` of the pilot's independent groups the candidate that `choose` puts first
    is within `LIGHT_GAIN` of the best."""
    best = choose(moments, possible, stratified, samples)[0].candidate
    random = np.random.default_rng(len(possible))
    agree = 0
    for _ in range(RESAMPLINGS):
        table = choose(moments.of(random.integers(0, GROUPS, GROUPS)), possible, stratified, samples)
        times = {row.candidate: row.time for row in table}
        agree += times.get(best, math.inf) <= LIGHT_GAIN * min(times.values())
    return agree / RESAMPLINGS


def _trimmed_mean(draw):
    """What the draw of a connection adds: the mean of the groups but for the largest quarter. Few samples
    show its outliers (the unshadowed 1 / dist^2), but not yet those of all else, beside which they are small:
    in `ajar_door`, 60 % of the variance in 2^11 samples, 10 % in 2^17."""
    calm = np.sort(draw, axis=0)[: len(draw) * 3 // 4].mean(axis=0)
    return np.broadcast_to(calm, draw.shape)


def _robust_mean(values):
    """Mean over the groups (rows), of which the worst quarter counts as much as the next one: each is scaled
    down until the candidate (column) that suffers least there does so. An outlier that no candidate does
    anything about would hide how they differ; what only some suffer from, such as path tracing from a
    caustic, has to count."""
    finite = np.isfinite(values).all(axis=0)
    if not finite.any():
        return values.mean(axis=0)
    values = np.where(finite, values, np.inf)  # losing light in one group is losing light
    usual = values[:, finite] / np.maximum(np.median(values[:, finite], axis=0), LEAST_VARIANCE)
    usual = np.maximum(usual, LEAST_USUAL)  # an estimate of little variance may be negative
    least = usual.min(axis=1)
    most = np.sort(least)[len(least) * 3 // 4 - 1]
    scale = np.where(least > most, most / np.where(least > most, least, 1), 1)
    return (values * scale[:, None]).mean(axis=0)


def replayed(decision: Decision) -> list[dict]:
    """What a replayed decision leaves out, as in ``statistics["skipped"]``."""
    names = ["t<=1"] * (not decision.light_paths) + ["inner"] * (decision.connections == "none")
    return [{"class": name, "level": "by hand", "why": "decisions"} for name in names]


def left_out(table: list[Choice]) -> list[dict]:
    """What the best of `choose` does without, and why, as in ``statistics["skipped"]``."""
    skipped = []
    without = {"t<=1": lambda c: not c.light_paths, "inner": lambda c: c.connections == "none"}
    for name, lacks in without.items():
        others = [row for row in table if not lacks(row.candidate)]
        if others and lacks(table[0].candidate):
            ratio = min(row.time for row in others) / table[0].time
            why = f"in the pilot, renders with it take at least {ratio:.2f} times as long for the same error"
            if ratio < 1:
                why = f"in the pilot it gains {1 / ratio:.2f}x at most, and a prediction is off by as much"
            skipped.append({"class": name, "level": "not worth its cost here", "why": why})
    return skipped
