"""Statistics of a sweep's rows: efficiencies, slopes, bias, costs.

Pure functions; a row is a dictionary. Efficiency = 1 / (seconds * error). Comparisons pair renders of equal
seed, which ran consecutively. Unavailable figures raise `Refused` with the reason, or `Biased` with the
missing energy.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ..errors import CommandError
from .agreement import FEWEST_RUNS, BiasCheck, Means, compare_means
from .metrics import CONFIDENCE, Estimate, number_of, values_of
from .record import Error, Errors, Row

# Bootstrap resamples: the ends of a 95 % interval vary by 1 % of its width between seeds.
RESAMPLES = 10_000

# Largest share of the reference's own error in a measured error.
REFERENCE_SHARE = 0.01

# Error columns of a row, and the reference's own.
OWN: dict[
    Literal["rel_mse", "rel_mse_trimmed"], Literal["reference_rel_mse", "reference_rel_mse_trimmed"]
] = {"rel_mse": "reference_rel_mse", "rel_mse_trimmed": "reference_rel_mse_trimmed"}

# Names of the integrators that reports compare with, as in presets/benchmark.toml.
RIVALS = ("path", "path multijitter")
MEDIA_RIVALS = ("volpath", "volpathmis")  # in scenes with participating media
NONE = "bdpt skip=none"
IMPOSSIBLE = "bdpt skip=impossible"
INDEPENDENT = "bdpt points=independent"
ALONE = "bdpt light_paths=0"
UNAIMED = "bdpt guiding=photons"
MERGING = "bdpt merging"
LIGHT_TRACER = "ptracer"

# Samples per pixel of the first integrator at which efficiencies are compared, if available.
DECIDING = 64


class Refused(CommandError):
    """A figure that cannot be computed from the data; the text has the reason."""


class NotJudged(Refused):
    """The reference is too noisy for a figure: ``share`` of the error is its own."""

    def __init__(self, text: str, share: float):
        super().__init__(text)
        self.share = share


class Biased(Refused):
    """All rivals fail the bias check; ``lacks``: missing energy by integrator."""

    def __init__(self, lacks: dict[str, str]):
        several = "; ".join(f"{name}: {what}" for name, what in lacks.items())
        super().__init__(several if len(lacks) > 1 else next(iter(lacks.values())))
        self.lacks = lacks


def slope(
    samples: Iterable[float],
    errors: Iterable[Iterable[float]],
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Estimate:
    """Exponent of error ~ samples^slope; -1 for squared errors of Monte Carlo.

    ``samples`` (n,) counts; ``errors``: for each count the errors of at least 2 independent runs; of a dict
    {spp: errors}, ``slope(runs.keys(), runs.values())``. Least squares of log(error) over log(samples), a
    point per run: sum (x - mean x) y / sum (x - mean x)^2.

    The interval is from percentiles of `RESAMPLES` fits to runs drawn with replacement within each count.
    Deviations from a count's mean are multiplied by sqrt(k / (k - 1)), k its number of runs: resampling k
    values has only (k - 1) / k of their variance. Source: B. Efron, R. Tibshirani, An Introduction to the
    Bootstrap, 1993, sections 9 and 13.
    """
    x = np.log(values_of("samples", samples, 2, 0))
    y = [np.log(values_of(f"errors[{i}]", row, 2, 0)) for i, row in enumerate(errors)]
    if len(y) != len(x):
        raise CommandError(f"errors has {len(y)} rows for {len(x)} samples; give one row for each.")
    runs = np.array([len(row) for row in y])
    offset = x - np.average(x, weights=runs)
    if np.ptp(x) == 0:
        raise CommandError("samples are all the same; a slope needs at least two different counts.")
    weight = runs * offset / np.sum(runs * offset**2)
    rng = np.random.default_rng(seed)
    drawn = np.empty((RESAMPLES, len(y)))
    for i, row in enumerate(y):
        picked = row[rng.integers(len(row), size=(RESAMPLES, len(row)))].mean(1)
        drawn[:, i] = row.mean() + (picked - row.mean()) * math.sqrt(len(row) / (len(row) - 1))
    value = float(np.dot(weight, [row.mean() for row in y]))
    return _percentiles(value, drawn @ weight, confidence)


def _percentiles(value: float, drawn: np.ndarray, confidence: float) -> Estimate:
    tail = (1 - number_of("confidence", confidence, 0, 1)) / 2
    low, high = np.quantile(drawn, [tail, 1 - tail])
    return Estimate(value, float(low), float(high))


def bootstrap_median(values: Iterable[float], confidence: float = CONFIDENCE, seed: int = 0) -> Estimate:
    """Return the median of a few values and its bootstrap interval.

    Percentiles of `RESAMPLES` medians of values drawn with replacement. The interval lies within the range of
    the n values, which contains the median with probability 1 - 2^(1 - n): 94 % for 5, 99.8 % for 10. Source:
    as `slope`, section 13.
    """
    given = values_of("values", values, 2)
    rng = np.random.default_rng(seed)
    drawn = given[rng.integers(len(given), size=(RESAMPLES, len(given)))]
    return _percentiles(float(np.median(given)), np.median(drawn, axis=1), confidence)


@dataclass(frozen=True)
class Summary:
    """Median, extremes and 95 % interval of the median of ``count`` ratios."""

    median: float
    low: float
    high: float
    smallest: float
    largest: float
    count: int


def summary(values: Sequence[float]) -> Summary:
    """Return the `Summary` of at least two values."""
    middle = bootstrap_median(values)
    return Summary(middle.value, middle.low, middle.high, min(values), max(values), len(values))


def select(rows: Iterable[Row], **wanted: object) -> list[Row]:
    return [row for row in rows if wanted.items() <= row.items()]


def judged(own: float, measured: float) -> bool:
    """Return whether a reference of error ``own`` can judge the error ``measured``.

    Both are squared errors, which add, since those of image and reference are independent: at the limit the
    measured error is 1 % too large.
    """
    return own <= REFERENCE_SHARE * measured


def refused_share(share: float, digits: int) -> str:
    """Format a ``share`` above `REFERENCE_SHARE` in percent, never rounded down to it."""
    text, limit = f"{100 * share:.{digits}g}", 100 * REFERENCE_SHARE
    return f"{text} %" if float(text) > limit else f"just above {limit:g} %"


def _refusal(own: float, measured: float) -> str:
    """Return why a figure is refused, and the samples that the reference lacks."""
    times = math.ceil(round(10 * own / measured / REFERENCE_SHARE, 6)) / 10
    return (
        f"The reference carries {refused_share(own / measured, 3)} of the error measured with it ({own:.2e} "
        f"of {measured:.2e}) and may carry {100 * REFERENCE_SHARE:g} %: render it with at least {times:g} "
        "times the samples."
    )


def check_judged(rows: Sequence[Errors], error: Error) -> None:
    """Raise `Refused` if the reference is too noisy for the median error.

    Errors not in `OWN` need no reference.
    """
    if error == "spread" or error == "spread_trimmed":
        return
    measured, own = (float(np.median([row[key] for row in rows])) for key in (error, OWN[error]))
    if judged(own, measured):
        return
    if measured == 0:
        raise Refused("every value is exactly that of the reference, which has an error of its own")
    raise NotJudged(_refusal(own, measured), own / measured)


def unjudged(rows: Sequence[Row]) -> dict[tuple[str, int], NotJudged]:
    """Return integrators and budgets whose errors the reference cannot judge.

    With the exception, for the worse of raw and trimmed error.
    """
    found: dict[tuple[str, int], NotJudged] = {}
    for method, budget in dict.fromkeys((row["method"], row["budget"]) for row in rows):
        for error in OWN:
            try:
                check_judged(select(rows, method=method, budget=budget), error)
            except NotJudged as why:
                if (method, budget) not in found or found[method, budget].share < why.share:
                    found[method, budget] = why
            except Refused:  # an error of 0 cannot be judged
                continue
    return found


def paired(ours: Sequence[Row], theirs: Sequence[Row]) -> list[tuple[Row, Row]]:
    """Return pairs of renders with equal seeds; raises `Refused` for less than two."""
    by_seed = {row["seed"]: row for row in theirs}
    pairs = [(row, by_seed[row["seed"]]) for row in ours if row["seed"] in by_seed]
    if len(pairs) < 2:
        raise Refused("fewer than two pairs of seeds")
    return pairs


def speedup(ours: Mapping[str, Any], theirs: Mapping[str, Any], error: str) -> float:
    """Return the ratio of efficiencies 1 / (seconds * error) of two renders, ours over theirs.

    Also the ratio of errors at equal time, and of times at equal error, if errors fall as 1 / time, which
    `slope` tests.
    """
    return theirs["seconds"] * theirs[error] / (ours["seconds"] * ours[error])


def pair_ratios(ours: Sequence[Row], theirs: Sequence[Row], error: Error = "rel_mse_trimmed") -> list[float]:
    """Return `speedup` of each pair."""
    return [speedup(*pair, error) for pair in paired(ours, theirs)]


def efficiency(ours: Sequence[Row], theirs: Sequence[Row], error: Error = "rel_mse_trimmed") -> Summary:
    """Return the summary of `pair_ratios`.

    Raises `Refused` like `check_judged`, and for errors of 0.

    ``error``: one of `OWN`, or ``spread`` or ``spread_trimmed``: see `metrics.spread`.
    """
    if len(ours) < 2 or len(theirs) < 2:
        raise Refused("fewer than two renders")
    if any(row.get(error) is None for row in (*ours, *theirs)):
        raise Refused("not measured")
    for rows in (ours, theirs):
        if any(row[error] == 0 for row in rows):
            raise Refused(f"{rows[0]['method']} is exact here")
        check_judged(rows, error)
    return summary(pair_ratios(ours, theirs, error))


def gap(rows: Sequence[Row]) -> Summary:
    """Return the summary of raw over trimmed relMSE.

    Large where few values carry most of the error. Raises `Refused` like `efficiency`.
    """
    if len(rows) < 2:
        raise Refused("fewer than two renders")
    for error in OWN:
        if any(row[error] == 0 for row in rows):
            raise Refused(f"{rows[0]['method']} is exact here")
        check_judged(rows, error)
    return summary([row["rel_mse"] / row["rel_mse_trimmed"] for row in rows])


def widths(rows: Sequence[Row], methods: Sequence[str]) -> dict[str, float]:
    """Return the interval widths of median efficiency ratios (trimmed), by rival.

    Ratios of the first method over each other one, regardless of the reference.
    """
    ours = select(rows, method=methods[0])
    found = {name: bootstrap_median(pair_ratios(ours, select(rows, method=name))) for name in methods[1:]}
    return {name: middle.high - middle.low for name, middle in found.items()}


def cost(ours: Sequence[Row], theirs: Sequence[Row]) -> Summary:
    """Return the summary of the ratio of seconds per sample, over pairs of seeds."""
    return summary([a["seconds"] / a["spp"] / (b["seconds"] / b["spp"]) for a, b in paired(ours, theirs)])


def convergence(rows: Sequence[Row], error: Literal["rel_mse", "rel_mse_trimmed"] = "rel_mse") -> Estimate:
    """Return the slope of log(error) over log(samples), over all renders of a method.

    Excludes budgets whose error the reference cannot judge.
    """
    if not rows:
        raise Refused("not rendered")
    runs: dict[float, list[float]] = {}
    for budget in sorted({row["budget"] for row in rows}):
        at = select(rows, budget=budget)
        if len(at) >= 2 and all(row[error] > 0 for row in at):
            try:
                check_judged(at, error)
            except Refused:
                continue
            runs[float(np.median([row["spp"] for row in at]))] = [row[error] for row in at]
    if len(runs) < 2:
        raise Refused("fewer than two budgets with errors that the reference can judge")
    return slope(list(runs), list(runs.values()))


def bias(rows: Sequence[Row], reference: Means) -> BiasCheck:
    """Return the bias check of a method in a scene against the reference.

    Uses the largest budget with enough renders.
    """
    budgets = {row["budget"]: select(rows, budget=row["budget"]) for row in rows}
    enough = [at for at in budgets.values() if len(at) >= FEWEST_RUNS]
    if not enough:
        raise Refused(f"fewer than {FEWEST_RUNS} renders of one budget")
    best = max(enough, key=lambda at: sum(row["spp"] for row in at))
    return compare_means(Means.of([row["tile_means"] for row in best]), reference)


def geometric_mean(values: Iterable[float]) -> float:
    return math.exp(float(np.mean(np.log(list(values)))))


@dataclass(frozen=True)
class Results:
    """Rows of a sweep, tile means of its references by scene, and results of probes."""

    rows: list[Row]
    references: dict[str, Means]
    probes: dict[str, Any]

    @cached_property
    def scenes(self) -> list[str]:
        """Scenes, in the order of the rows."""
        return list(dict.fromkeys(row["scene"] for row in self.rows))

    @cached_property
    def methods(self) -> list[str]:
        """Integrators; the others are compared with the first."""
        return list(dict.fromkeys([self.rows[0]["first"], *(row["method"] for row in self.rows)]))

    @cached_property
    def rivals(self) -> list[str]:
        """Integrators that the first is compared with at equal time.

        Mitsuba's path tracers first, then others.
        """
        tracers = *RIVALS, *MEDIA_RIVALS
        known = {*tracers, NONE, IMPOSSIBLE, INDEPENDENT, ALONE, UNAIMED, MERGING, LIGHT_TRACER}
        others = self.methods[1:]
        return [name for name in tracers if name in others] + [name for name in others if name not in known]

    @cached_property
    def standard(self) -> list[str]:
        """Baselines of efficiencies by budget and of costs.

        `path` with each sampler, `volpath` and `volpathmis`; other rivals if none of these was rendered.
        """
        return [rival for rival in self.rivals if rival in (*RIVALS, *MEDIA_RIVALS)] or self.rivals

    def standard_in(self, scene: str) -> list[str]:
        """Return the `standard` integrators that were rendered in a scene."""
        return [rival for rival in self.standard if self.of(scene, rival)]

    @cached_property
    def _of(self) -> dict[tuple[str, str], list[Row]]:
        """Rows by scene and integrator."""
        found: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            found.setdefault((row["scene"], row["method"]), []).append(row)
        return found

    @cached_property
    def deciding(self) -> int:
        """The budget of comparisons: `DECIDING`, or the largest that every scene has."""
        budgets: dict[str, set[int]] = {scene: set() for scene in self.scenes}
        for row in self.rows:
            budgets[row["scene"]].add(row["budget"])
        common = set[int].intersection(*budgets.values())
        return DECIDING if DECIDING in common or not common else max(common)

    def of(self, scene: str, method: str, budget: int | None = None) -> list[Row]:
        """Return the rows of an integrator in a scene."""
        rows = self._of.get((scene, method), [])
        return rows if budget is None else select(rows, budget=budget)

    def bias(self, scene: str, method: str) -> BiasCheck:
        """Return the bias check against the scene's reference."""
        if scene not in self.references:
            there = self.of(scene, method)
            raise Refused("no bias check: the reference is a given image" if there else "not rendered")
        return bias(self.of(scene, method), self.references[scene])

    def probed(self, name: str) -> dict[str, list[float]]:
        """Return a probe's results for the software of the rows."""
        probe, row = self.probes.get(name), self.rows[0]
        if probe is None:
            raise Refused("not measured")
        if probe["versions"] != json.loads(row["versions"]) | {"machine": row["machine"]}:
            raise Refused("measured of another version or on another machine")
        return probe["values"]

    def gap(self, scene: str, method: str) -> Summary:
        """Return `gap` of an integrator at the deciding budget."""
        return gap(self.of(scene, method, self.deciding))

    def by_gap(self, method: str) -> list[str]:
        """Return the scenes by decreasing `gap`; those without one are last."""

        def size(scene: str) -> float:
            try:
                return self.gap(scene, method).median
            except Refused:
                return 0.0

        return sorted(self.scenes, key=size, reverse=True)

    def efficiency(
        self, scene: str, rival: str, error: Error = "rel_mse_trimmed", budget: int | None = None
    ) -> Summary:
        """Return the efficiency of the first integrator over ``rival``.

        At the deciding budget by default.
        """
        budget = budget or self.deciding
        return efficiency(self.of(scene, self.methods[0], budget), self.of(scene, rival, budget), error)

    def fair_efficiency(
        self, scene: str, rival: str, error: Error = "rel_mse_trimmed", budget: int | None = None
    ) -> Summary:
        """Like `efficiency`; raises `Biased` if ``rival`` fails the bias check.

        With too few seeds for a check, only an image that is black where the reference is not fails.
        """
        try:
            check = self.bias(scene, rival)
        except Refused:
            check = None
            rows = self.of(scene, rival)
            if rows and not np.any([row["tile_means"] for row in rows]):
                raise Biased({rival: NOTHING}) from None
        if check is not None and not check.passed:
            raise Biased({rival: missing(check)})
        return self.efficiency(scene, rival, error, budget)

    def against_path(
        self, scene: str, error: Error = "rel_mse_trimmed", budget: int | None = None
    ) -> Summary:
        """Return the efficiency over the strongest of `standard` (smallest ratio).

        Considers integrators that pass the bias check; raises `Biased` if none does.
        """
        found: list[Summary] = []
        biased: dict[str, str] = {}
        rivals = self.standard_in(scene)
        if not rivals:
            raise Refused(f"{' or '.join(self.standard or RIVALS[:1])} was not rendered")
        for rival in rivals:
            try:
                found.append(self.fair_efficiency(scene, rival, error, budget))
            except Biased as why:
                biased |= why.lacks
        if not found:
            raise Biased(biased)
        return min(found, key=lambda ratio: ratio.median)


NOTHING = "all energy is missing"


def missing(check: BiasCheck) -> str:
    """Describe the energy missing from an integrator that fails the bias check."""
    share = check.missing
    low, high = sorted((abs(100 * share.low), abs(100 * share.high)))
    if low > 99.95:
        return NOTHING
    if share.low <= 0 <= share.high:
        where = (
            "the whole image"
            if check.tile is None
            else f"the tile in row {check.tile[0]}, column {check.tile[1]}"
        )
        return f"wrong in {where} of 4 x 4, by {check.difference.value:.2g}"
    what = "of the energy is missing" if share.value > 0 else "too much energy"
    return f"{abs(100 * share.value):.2g} % {what} ({low:.2g} to {high:.2g})"
