"""Statistics of a sweep's rows: efficiencies, slopes, bias, costs.

Pure functions; a row is a dictionary. Efficiency = 1 / (seconds * error), with the errors of `estimates`.
Comparisons pair renders of equal seed, which ran consecutively. Raises `Unavailable`, with the reason,
for figures that cannot be computed.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import CommandError
from .agreement import FEWEST_RUNS, BiasCheck, Means, compare_means, missing_energy
from .estimates import (
    FEWEST_WITH_INTERVAL,
    Bound,
    RelativeError,
    bootstrap,
    bound_of_ratio,
    mean_differs,
    relative_error,
    seed_errors,
    unlike,
)
from .metrics import Estimate, values_of
from .record import Error, Row

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

ALONE_HERE = "fewer than two renders: seeds = 2 or more"
"""Why there is no figure, with the preset's key that mends it."""


class Unavailable(CommandError):
    """A figure that cannot be computed from the data; the text has the reason."""


def slope(samples: Iterable[float], errors: Iterable[Iterable[float]]) -> Estimate:
    """Exponent of error ~ samples^slope; -1 for squared errors of Monte Carlo.

    ``samples`` (n,) counts; ``errors``: for each count the errors of at least 2 independent runs; of a dict
    {spp: errors}, ``slope(runs.keys(), runs.values())``. Least squares of log(error) over log(samples), a
    point per run: sum (x - mean x) y / sum (x - mean x)^2.

    The 95 % interval is the `bootstrap`'s, of runs drawn with replacement within each count. Deviations from
    a count's mean are multiplied by sqrt(k / (k - 1)), k its number of runs: resampling k values has only
    (k - 1) / k of their variance. Source: B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993,
    sections 9 and 13.
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
    wide = [row.mean() + (row - row.mean()) * math.sqrt(len(row) / (len(row) - 1)) for row in y]

    def fitted(*rows: np.ndarray, axis: int = -1) -> Any:
        return sum(w * row.mean(axis) for w, row in zip(weight, rows, strict=True))

    return bootstrap(wide, fitted)


def bootstrap_median(values: Iterable[float]) -> Estimate:
    """Return the median of a few values and its 95 % bootstrap interval.

    It lies within the range of the n values, which contains the median with probability 1 - 2^(1 - n): 94 %
    for 5, 99.8 % for 10. Source: as `slope`, section 13.
    """
    return bootstrap([values_of("values", values, 2)], np.median)


@dataclass(frozen=True)
class Summary:
    """Median, extremes and 95 % interval of the median of ``count`` ratios.

    ``bound``: whether the true ratio is at least ("≥") or at most ("≤") that, or either ("~").
    """

    median: float
    low: float
    high: float
    smallest: float
    largest: float
    count: int
    bound: Bound = ""


def summary(values: Sequence[float]) -> Summary:
    """Return the `Summary` of at least two values."""
    middle = bootstrap_median(values)
    return Summary(middle.value, middle.low, middle.high, min(values), max(values), len(values))


def select(rows: Iterable[Row], **wanted: object) -> list[Row]:
    return [row for row in rows if wanted.items() <= row.items()]


def paired(ours: Sequence[Row], theirs: Sequence[Row]) -> list[tuple[Row, Row]]:
    """Return pairs of renders with equal seeds; raises `Unavailable` for less than two."""
    by_seed = {row["seed"]: row for row in theirs}
    pairs = [(row, by_seed[row["seed"]]) for row in ours if row["seed"] in by_seed]
    if len(pairs) < 2:
        raise Unavailable("fewer than two pairs of seeds")
    return pairs


def _ratios(
    ours: Sequence[Row], theirs: Sequence[Row], error: Error, differ: tuple[bool, bool]
) -> tuple[list[float], Bound]:
    """Return the ratio of efficiencies 1 / (seconds * error) of each pair, ours over theirs, and its bound.

    Also the ratio of errors at equal time, and of times at equal error, if errors fall as 1 / time, which
    `slope` tests. Raises `Unavailable` for errors of 0.
    """
    by_seed: list[dict[int, float]] = []
    bounds: list[Bound] = []
    for rows, differs in zip((ours, theirs), differ, strict=True):
        errors, bound = seed_errors(rows, error, differs)
        if min(errors) == 0:
            raise Unavailable(f"{rows[0]['method']} is exact here")
        by_seed.append({row["seed"]: x * row["seconds"] for row, x in zip(rows, errors, strict=True)})
        bounds.append(bound)
    ratios = [by_seed[1][b["seed"]] / by_seed[0][a["seed"]] for a, b in paired(ours, theirs)]
    return ratios, bound_of_ratio(bounds[1], bounds[0])


def efficiency(
    ours: Sequence[Row],
    theirs: Sequence[Row],
    error: Error = "rel_mse_trimmed",
    differ: tuple[bool, bool] = (False, False),
) -> Summary:
    """Return the summary of the ratios of efficiencies, ours over theirs, of pairs of seeds.

    ``differ``: whose means differ from the reference, see `estimates.seed_errors`. Raises `Unavailable` for
    fewer than two pairs, and for errors of 0.
    """
    if len(ours) < 2 or len(theirs) < 2:
        raise Unavailable(ALONE_HERE)
    ratios, bound = _ratios(ours, theirs, error, differ)
    return replace(summary(ratios), bound=bound)


def gap(rows: Sequence[Row], differs: bool = False) -> Summary:
    """Return the summary of raw over trimmed relMSE: large where few values carry most of the error."""
    if len(rows) < 2:
        raise Unavailable(ALONE_HERE)
    (raw, _), (trimmed, _) = (seed_errors(rows, error, differs) for error in ("rel_mse", "rel_mse_trimmed"))
    if min(*raw, *trimmed) == 0:
        raise Unavailable(f"{rows[0]['method']} is exact here")
    return summary([a / b for a, b in zip(raw, trimmed, strict=True)])


def widths(rows: Sequence[Row], methods: Sequence[str]) -> dict[str, float]:
    """Return the interval widths of median efficiency ratios (trimmed), by rival.

    Ratios of the first method over each other one.
    """
    ours = select(rows, method=methods[0])
    found: dict[str, float] = {}
    for name in methods[1:]:
        ratios, _ = _ratios(ours, select(rows, method=name), "rel_mse_trimmed", (False, False))
        middle = bootstrap_median(ratios)
        found[name] = middle.high - middle.low
    return found


def cost(ours: Sequence[Row], theirs: Sequence[Row]) -> Summary:
    """Return the summary of the ratio of seconds per sample, over pairs of seeds."""
    return summary([a["seconds"] / a["spp"] / (b["seconds"] / b["spp"]) for a, b in paired(ours, theirs)])


def convergence(
    rows: Sequence[Row], differs: Callable[[int], bool] = lambda budget: False, error: Error = "rel_mse"
) -> Estimate:
    """Return the slope of log(error) over log(samples), over all renders of a method.

    ``differs``: whether the mean differs from the reference at a budget. The interval is infinite where a
    budget has fewer than `FEWEST_WITH_INTERVAL` renders.
    """
    if not rows:
        raise Unavailable("not rendered")
    runs: dict[float, list[float]] = {}
    for budget in sorted({row["budget"] for row in rows}):
        at = select(rows, budget=budget)
        errors, _ = seed_errors(at, error, differs(budget))
        if len(at) >= 2 and min(errors) > 0:
            runs[float(np.median([row["spp"] for row in at]))] = errors
    if len(runs) < 2:
        raise Unavailable("fewer than two budgets with two renders")
    found = slope(list(runs), list(runs.values()))
    is_few = min(map(len, runs.values())) < FEWEST_WITH_INTERVAL
    return Estimate(found.value, -math.inf, math.inf) if is_few else found


def bias(rows: Sequence[Row], reference: Means) -> BiasCheck:
    """Return the bias check of a method in a scene against the reference.

    Uses the largest budget with enough renders.
    """
    budgets = {row["budget"]: select(rows, budget=row["budget"]) for row in rows}
    enough = [at for at in budgets.values() if len(at) >= FEWEST_RUNS]
    if not enough:
        raise Unavailable(f"fewer than {FEWEST_RUNS} renders of one budget")
    best = max(enough, key=lambda at: sum(row["spp"] for row in at))
    return compare_means(Means.of([row["tile_means"] for row in best]), reference)


def _paired_budgets(counts: Iterable[Counter[int]]) -> set[int]:
    """Return a scene's budgets of two renders each, of integrators with so many at any budget; else all."""
    found = list(counts)
    budgets = set[int]().union(*found)
    several = [of for of in found if max(of.values()) > 1]
    return {n for n in budgets if all(of[n] > 1 for of in several)} or budgets


@dataclass(frozen=True)
class Results:
    """Rows of a sweep, tile means of its references by scene, and results of probes.

    ``aside``: integrators of which efficiencies are not compared; ``compared``: the budget of comparisons.
    """

    rows: list[Row]
    references: dict[str, Means]
    probes: dict[str, Any]
    aside: tuple[str, ...] = ()
    compared: int | None = None

    @cached_property
    def scenes(self) -> list[str]:
        """Scenes, in the order of the rows."""
        return list(dict.fromkeys(row["scene"] for row in self.rows))

    @cached_property
    def methods(self) -> list[str]:
        """Integrators; the others are compared with the first.

        In the order of the preset, as far as scenes show it: before those that follow them in a scene.
        """
        order: list[str] = [self.rows[0]["first"]]
        for scene in self.scenes:
            names = list(dict.fromkeys(row["method"] for row in self.rows if row["scene"] == scene))
            for i, name in enumerate(names):
                if name not in order:
                    following = [order.index(later) for later in names[i + 1 :] if later in order[1:]]
                    order.insert(min(following, default=len(order)), name)
        return order

    @cached_property
    def rivals(self) -> list[str]:
        """Integrators that the first is compared with at equal time.

        Mitsuba's path tracers first, then others.
        """
        others = [name for name in self.methods[1:] if name not in self.aside]
        return sorted(others, key=lambda name: name not in (*RIVALS, *MEDIA_RIVALS))

    @cached_property
    def at_equal_samples(self) -> list[str]:
        """Integrators with the samples of the first one, not its seconds."""
        found = {row["method"] for row in self.rows if row.get("match") == "spp"}
        return [name for name in self.methods[1:] if name in found]

    @cached_property
    def standard(self) -> list[str]:
        """Baselines of efficiencies by budget and of costs.

        `path`, `volpath` and `volpathmis`, by any name; other rivals if none of these was rendered.
        """
        tracers = RIVALS[0], *MEDIA_RIVALS
        return [rival for rival in self.rivals if self.kind(rival) in tracers] or self.rivals

    def kind(self, method: str) -> str:
        """Return the type of an integrator; of one without parameters, the first word of its name."""
        given = [row.get("parameters") for row in self.rows if row["method"] == method][:1]
        return json.loads(given[0])["type"] if given and given[0] else method.split()[0]

    def tracer(self, scene: str) -> str:
        """Return the type of the last of `standard` in a scene."""
        return self.kind((self.standard_in(scene) or RIVALS)[-1])

    def has_efficiency(self, scenes: Sequence[str]) -> bool:
        """Return whether the first integrator has an efficiency over a rival in one of the ``scenes``."""
        for scene in scenes:
            for rival in self.rivals:
                try:
                    self.efficiency(scene, rival)
                except Unavailable:
                    continue
                return True
        return False

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
        """The budget of comparisons: ``compared``, or the largest that every scene has, else the largest.

        Where a time limit left single renders at some budgets, only budgets with two renders of each
        integrator count.
        """
        counts: dict[str, dict[str, Counter[int]]] = {scene: {} for scene in self.scenes}
        for row in self.rows:
            counts[row["scene"]].setdefault(row["method"], Counter())[row["budget"]] += 1
        common = set[int].intersection(*(_paired_budgets(of.values()) for of in counts.values()))
        every = common or {row["budget"] for row in self.rows}
        if self.compared is None:
            return max(every)
        if self.compared not in every:
            known = ", ".join(map(str, sorted(every)))
            raise CommandError(
                f"spp={self.compared} must be one of {known}, of which all scenes have two renders of each "
                "integrator"
            )
        return self.compared

    def of(self, scene: str, method: str, budget: int | None = None) -> list[Row]:
        """Return the rows of an integrator in a scene."""
        rows = self._of.get((scene, method), [])
        return rows if budget is None else select(rows, budget=budget)

    def bias(self, scene: str, method: str) -> BiasCheck:
        """Return the bias check against the scene's reference."""
        if scene not in self.references:
            there = self.of(scene, method)
            raise Unavailable(FEW if there else "not rendered")
        return bias(self.of(scene, method), self.references[scene])

    def probed(self, name: str) -> dict[str, list[float]]:
        """Return a probe's results for the software of the rows."""
        probe, row = self.probes.get(name), self.rows[0]
        if probe is None:
            raise Unavailable("not measured")
        if probe["versions"] != json.loads(row["versions"]) | {"machine": row["machine"]}:
            raise Unavailable("measured of another version or on another machine")
        return probe["values"]

    def lacks(self, scene: str, method: str) -> str:
        """Describe the energy that an integrator lacks in a scene; empty if the bias check finds nothing."""
        try:
            check = self.bias(scene, method)
        except Unavailable:
            # Too few seeds for a check: only an image that is black where the reference is not fails.
            rows = self.of(scene, method) if scene in self.references else []
            return NOTHING if rows and not np.any([row["tile_means"] for row in rows]) else ""
        return "" if check.passed else missing(check)

    def surplus(self, scene: str, method: str) -> Estimate:
        """Return the relative difference of the mean from the reference's, with its 95 % interval.

        At the deciding budget, or the largest of two renders or more.
        """
        rows = self.of(scene, method)
        counts = Counter(row["budget"] for row in rows)
        several = [n for n, count in counts.items() if count > 1]
        if not several:
            raise Unavailable(ALONE_HERE)
        if scene not in self.references:
            raise Unavailable(FEW)
        budget = self.deciding if counts[self.deciding] > 1 else max(several)
        columns = [row["tile_means"] for row in select(rows, budget=budget)]
        share = missing_energy(Means.of(columns, fewest=2).whole, self.references[scene].whole)
        return Estimate(-share.value, -share.high, -share.low)

    def differs(self, scene: str, method: str, budget: int | None = None) -> bool:
        """Return whether the mean of an integrator differs from the reference.

        By the bias check, or by the renders of one budget alone, by default the deciding one.
        """
        rows, reference = self.of(scene, method, budget or self.deciding), self.references.get(scene)
        if reference is None or not rows:
            return False
        return bool(self.lacks(scene, method)) or mean_differs(rows, reference)

    def error(
        self, scene: str, method: str, error: Error = "rel_mse_trimmed", budget: int | None = None
    ) -> RelativeError:
        """Return the relMSE of an integrator at a budget, by default the deciding one."""
        rows = self.of(scene, method, budget or self.deciding)
        if not rows:
            raise Unavailable("not rendered")
        return relative_error(rows, error, self.differs(scene, method, budget))

    def convergence(self, scene: str, method: str) -> Estimate:
        """Return the `convergence` of an integrator in a scene."""
        return convergence(self.of(scene, method), lambda budget: self.differs(scene, method, budget))

    def gap(self, scene: str, method: str) -> Summary:
        """Return `gap` of an integrator at the deciding budget."""
        return gap(self.of(scene, method, self.deciding), self.differs(scene, method))

    def by_gap(self, method: str) -> list[str]:
        """Return the scenes by decreasing `gap`; those without one are last."""

        def size(scene: str) -> float:
            try:
                return self.gap(scene, method).median
            except Unavailable:
                return 0.0

        return sorted(self.scenes, key=size, reverse=True)

    def efficiency(
        self,
        scene: str,
        rival: str,
        error: Error = "rel_mse_trimmed",
        budget: int | None = None,
        first: str | None = None,
    ) -> Summary:
        """Return the efficiency of ``first`` over ``rival``, at the deciding budget by default.

        Where both means differ from the reference but not from each other, raw errors are variances: what
        both lack is no difference between them.
        """
        first, budget = first or self.methods[0], budget or self.deciding
        ours, theirs = self.of(scene, first, budget), self.of(scene, rival, budget)
        differ = self.differs(scene, first, budget), self.differs(scene, rival, budget)
        if error == "rel_mse" and all(differ) and not unlike(ours, theirs):
            differ = False, False
        return efficiency(ours, theirs, error, differ)

    def against_path(
        self, scene: str, error: Error = "rel_mse_trimmed", budget: int | None = None
    ) -> Summary:
        """Return the efficiency over the strongest of `standard` (smallest ratio).

        Considers integrators that pass the bias check, if any does.
        """
        rivals = self.standard_in(scene)
        if not rivals:
            raise Unavailable(f"{' or '.join(self.standard or RIVALS[:1])} was not rendered")
        fair = [rival for rival in rivals if not self.lacks(scene, rival)] or rivals
        found = [self.efficiency(scene, rival, error, budget) for rival in fair]
        return min(found, key=lambda ratio: ratio.median)

    def path_lacks(self, scene: str) -> str:
        """Describe the energy that the last of `standard` lacks in a scene, if all of them do."""
        found = [self.lacks(scene, rival) for rival in self.standard_in(scene)]
        return found[-1] if found and all(found) else ""


NOTHING = "all energy is missing"
FEW = f"the reference has fewer than {FEWEST_RUNS} renders"


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
