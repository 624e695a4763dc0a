"""Statistics of a sweep's rows: efficiencies, slopes, bias, costs.

Rows are a frame with the columns of rows.parquet. Efficiency = 1 / (seconds * error), with the errors of
`estimates`. Comparisons pair renders of equal seed, which ran consecutively.
"""

from __future__ import annotations

import json
import math
from collections.abc import Hashable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from ..errors import CommandError
from .agreement import FEWEST_RUNS, BiasCheck, Means, compare_means, missing_energy
from .estimates import (
    FEWEST_TESTED,
    FEWEST_WITH_INTERVAL,
    Bound,
    Error,
    RelativeError,
    bootstrap,
    bound_of_ratio,
    compared,
    mean_differs,
    means_of,
    relative_error,
    seed_errors,
)
from .metrics import Estimate
from .tables import ratio

# Names of the integrators that reports compare with, as in presets/benchmark.toml.
RIVALS = ("path", "path multijitter")
MEDIA_RIVALS = ("volpath", "volpathmis")  # in scenes with participating media
NONE = "bdpt skip=none"
INDEPENDENT = "bdpt points=independent"
LIGHT_TRACER = "ptracer"

ALONE_HERE = "fewer than two renders: seeds = 2 or more"  # with the preset's key that mends it


class Unavailable(CommandError):
    """A figure that cannot be computed from the data; the text has the reason."""


def slope(samples: Iterable[float], errors: Iterable[ArrayLike]) -> Estimate:
    """Exponent of error ~ samples^slope; -1 for squared errors of Monte Carlo.

    ``errors``: of at least 2 independent runs for each of ``samples`` (n,). Least squares of logarithms, with
    the `bootstrap`'s interval of runs drawn within each count, whose deviations are times sqrt(k / (k - 1)):
    k resampled values have (k - 1) / k of the variance. Source: B. Efron, R. Tibshirani, An Introduction to
    the Bootstrap, 1993, sections 9 and 13.
    """
    x, y = np.log([*samples]), [np.log(row) for row in errors]
    runs = np.array([len(row) for row in y])
    offset = x - np.average(x, weights=runs)
    weight = runs * offset / np.sum(runs * offset**2)
    wide = [row.mean() + (row - row.mean()) * math.sqrt(len(row) / (len(row) - 1)) for row in y]

    def fitted(*rows: np.ndarray, axis: int = -1) -> Any:
        return sum(w * row.mean(axis) for w, row in zip(weight, rows, strict=True))

    return bootstrap(wide, fitted)


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

    def __str__(self) -> str:
        few = f"; n = {self.count}" if self.count < FEWEST_WITH_INTERVAL else ""
        ends = f"{ratio(self.smallest)[:-1]}–{ratio(self.largest)[:-1]}{few}"
        return f"{self.bound} {ratio(self.median)} ({ends})".lstrip()


def summary(values: Sequence[float] | pd.Series) -> Summary:
    """Return the `Summary` of at least two values, with the `bootstrap`'s interval.

    The range of n values contains the median with probability 1 - 2^(1 - n). Source: as `slope`, section 13.
    """
    middle = bootstrap([np.asarray(values)], np.median)
    ends = float(min(values)), float(max(values))
    return Summary(middle.value, middle.low, middle.high, *ends, len(values))


def _ratios(over: pd.Series, under: pd.Series) -> pd.Series:
    """Return the ratios of values by seed, of seeds that both have; at least two."""
    found = (over.reindex(under.index) / under).dropna()
    if len(found) < 2:
        raise Unavailable("fewer than two pairs of seeds")
    return found


def _errors(rows: pd.DataFrame, kind: Error, differs: bool) -> tuple[pd.Series, Bound]:
    """Return the errors of at least two renders by seed, above 0, and their bound."""
    if len(rows) < 2:
        raise Unavailable(ALONE_HERE)
    errors, bound = seed_errors(rows, kind, differs)
    if errors.min() == 0:
        raise Unavailable(f"{rows['method'].iloc[0]} is exact here")
    return errors.set_axis(rows["seed"]), bound


def cost(ours: pd.DataFrame, theirs: pd.DataFrame) -> Summary:
    """Return the summary of the ratio of seconds per sample, over pairs of seeds."""
    sides = ((rows["seconds"] / rows["spp"]).set_axis(rows["seed"]) for rows in (ours, theirs))
    return summary(_ratios(*sides))


@dataclass(frozen=True, eq=False)
class Results:
    """Rows of a sweep, and tile means of its references by scene.

    ``aside``: integrators of which efficiencies are not compared; ``compared``: the budget of comparisons.
    """

    rows: pd.DataFrame
    references: dict[str, Means]
    aside: Sequence[str] = ()
    compared: int | None = None

    @cached_property
    def scenes(self) -> list[str]:
        return list(self.rows["scene"].unique())

    @cached_property
    def methods(self) -> list[str]:
        """Integrators, the compared one first, others as scenes have them."""
        return list(dict.fromkeys([self.rows["first"].iloc[0], *self.rows["method"]]))

    @cached_property
    def rivals(self) -> list[str]:
        """Integrators that the first is compared with, Mitsuba's path tracers first."""
        others = [name for name in self.methods[1:] if name not in self.aside]
        return sorted(others, key=lambda name: name not in (*RIVALS, *MEDIA_RIVALS))

    @cached_property
    def at_equal_samples(self) -> list[str]:
        """Integrators with the samples of the first one, not its seconds."""
        found = set(self.rows["method"][self.rows["match"] == "spp"]) if "match" in self.rows else ()
        return [name for name in self.methods[1:] if name in found]

    @cached_property
    def standard(self) -> list[str]:
        """`path`, `volpath` and `volpathmis`, by any name; without them all rivals."""
        tracers = RIVALS[0], *MEDIA_RIVALS
        return [rival for rival in self.rivals if self.kind(rival) in tracers] or self.rivals

    def kind(self, method: str) -> str:
        """Return the type of an integrator, by default the first word of its name."""
        rows = self.rows[self.rows["method"] == method]
        has_parameters = "parameters" in rows and len(rows)
        return json.loads(rows["parameters"].iloc[0])["type"] if has_parameters else method.split()[0]

    def has_efficiency(self, scenes: Sequence[str]) -> bool:
        """Return whether `efficiency` is available in one of the ``scenes``."""
        for scene, rival in product(scenes, self.rivals):
            with suppress(Unavailable):
                return bool(self.efficiency(scene, rival))
        return False

    def present(self, scene: str, methods: Sequence[str], *budget: int) -> list[str]:
        """Return those of the ``methods`` that were rendered in a scene."""
        return [name for name in methods if len(self.of(scene, name, *budget))]

    @cached_property
    def _groups(self) -> dict[Any, pd.DataFrame]:
        """Rows by scene and integrator, and by budget too."""
        keys = ["scene", "method", "budget"]
        return dict(iter(self.rows.groupby(keys[:2]))) | dict(iter(self.rows.groupby(keys)))

    def of(self, scene: str, method: str, *budget: Hashable) -> pd.DataFrame:
        """Return the rows of an integrator in a scene, of all budgets or of one."""
        return self._groups.get((scene, method, *budget), self.rows[:0])

    @cached_property
    def deciding(self) -> int:
        """The budget of comparisons: ``compared``, or the largest that all scenes have.

        Where a time limit left single renders at some budgets, only budgets with two renders of each
        integrator count, of those with so many at any budget. Without a common one, the largest.
        """
        every: set[int] = set(self.rows["budget"])
        common = every
        for _, rows in self.rows.groupby("scene"):
            counts = pd.crosstab(rows["method"], rows["budget"])
            paired = (counts[counts.max(axis=1) > 1] > 1).all()
            common = common & {*(counts.columns[paired] if paired.any() else counts.columns)}
        common = common or every
        if self.compared is not None and self.compared not in common:
            known = ", ".join(map(str, sorted(common)))
            raise CommandError(
                f"spp={self.compared} must be one of {known}, of which all scenes have two renders of each "
                "integrator"
            )
        return int(self.compared or max(common))

    def bias(self, scene: str, method: str) -> BiasCheck:
        """Return the bias check at the budget with most samples and enough renders."""
        rows = self.of(scene, method)
        if scene not in self.references:
            raise Unavailable(FEW if len(rows) else "not rendered")
        samples = rows.groupby("budget", sort=False)["spp"].agg(["size", "sum"])
        enough = samples["sum"][samples["size"] >= FEWEST_RUNS]
        if enough.empty:
            raise Unavailable(f"fewer than {FEWEST_RUNS} renders of one budget")
        return compare_means(means_of(self.of(scene, method, enough.idxmax())), self.references[scene])

    @cache  # noqa: B019
    def lacks(self, scene: str, method: str) -> str:
        """Describe the energy that an integrator lacks; empty if its bias check passes."""
        try:
            check = self.bias(scene, method)
        except Unavailable:
            # Too few seeds for a check: only an image that is black where the reference is not fails.
            rows = self.of(scene, method)
            is_black = scene in self.references and len(rows) and not np.any([*rows["tile_means"]])
            return NOTHING if is_black else ""
        return "" if check.passed else lacking(check)

    def missing(self, scene: str, method: str) -> Estimate:
        """Return the missing share of the energy.

        At the deciding budget, else at the largest with two renders.
        """
        counts = self.of(scene, method)["budget"].value_counts()
        several = counts.index[counts > 1]
        if not len(several):
            raise Unavailable(ALONE_HERE)
        if scene not in self.references:
            raise Unavailable(FEW)
        rows = self.of(scene, method, self.deciding if self.deciding in several else max(several))
        return missing_energy(means_of(rows, 2).whole, self.references[scene].whole)

    @cache  # noqa: B019
    def differs(self, scene: str, method: str, budget: int | None = None) -> bool:
        """Return whether the mean at a budget differs from the reference."""
        rows, reference = self.of(scene, method, budget or self.deciding), self.references.get(scene)
        if reference is None or rows.empty:
            return False
        return bool(self.lacks(scene, method)) or mean_differs(rows, reference)

    def error(
        self, scene: str, method: str, error: Error = "rel_mse_trimmed", budget: int | None = None
    ) -> RelativeError:
        """Return the relMSE of an integrator at a budget, by default the deciding one."""
        rows = self.of(scene, method, budget or self.deciding)
        if rows.empty:
            raise Unavailable("not rendered")
        return relative_error(rows, error, self.differs(scene, method, budget))

    def convergence(self, scene: str, method: str) -> Estimate:
        """Return the `slope` of the raw error, without interval for few renders."""
        rows = self.of(scene, method)
        if rows.empty:
            raise Unavailable("not rendered")
        runs: dict[float, np.ndarray] = {}
        for budget, at in rows.groupby("budget"):
            errors, _ = seed_errors(at, "rel_mse", self.differs(scene, method, budget))
            if len(at) >= 2 and errors.min() > 0:
                runs[float(at["spp"].median())] = errors.to_numpy()
        if len(runs) < 2:
            raise Unavailable("fewer than two budgets with two renders")
        found = slope(runs, runs.values())
        is_few = min(map(len, runs.values())) < FEWEST_WITH_INTERVAL
        return Estimate(found.value, -math.inf, math.inf) if is_few else found

    @cache  # noqa: B019
    def efficiency(
        self,
        scene: str,
        rival: str,
        error: Error = "rel_mse_trimmed",
        budget: int | None = None,
        first: str | None = None,
    ) -> Summary:
        """Return the ratios of efficiencies 1 / (seconds * error) over ``rival``, by seed.

        Of ``first``, by default the first integrator, at the deciding budget by default. Where both means
        differ from the reference but not from each other, raw errors are variances.
        """
        first, budget = first or self.methods[0], budget or self.deciding
        ours, theirs = self.of(scene, first, budget), self.of(scene, rival, budget)
        differ = [self.differs(scene, name, budget) for name in (first, rival)]
        if error == "rel_mse" and all(differ) and min(len(ours), len(theirs)) >= FEWEST_TESTED:
            differ = [compared(ours, means_of(theirs))] * 2
        (own, under), (other, over) = (
            _errors(rows, error, one) for rows, one in zip((ours, theirs), differ, strict=True)
        )
        seconds, their_seconds = (rows.set_index("seed")["seconds"] for rows in (ours, theirs))
        found = summary(_ratios(other * their_seconds, own * seconds))
        return replace(found, bound=bound_of_ratio(over, under))

    def against_path(
        self, scene: str, error: Error = "rel_mse_trimmed", budget: int | None = None
    ) -> Summary:
        """Return the smallest efficiency over `standard`.

        Only over those that pass the bias check, if any does.
        """
        rivals = self.present(scene, self.standard)
        if not rivals:
            raise Unavailable(f"{' or '.join(self.standard or RIVALS[:1])} was not rendered")
        fair = [rival for rival in rivals if not self.lacks(scene, rival)] or rivals
        found = [self.efficiency(scene, rival, error, budget) for rival in fair]
        return min(found, key=lambda ratio: ratio.median)

    def path_lacks(self, scene: str) -> str:
        """Describe the energy that all of `standard` lack, by the last; else empty."""
        rivals = self.present(scene, self.standard)
        found = [self.lacks(scene, rival) for rival in rivals]
        return f"{self.kind(rivals[-1])}: {found[-1]}" if found and all(found) else ""


NOTHING = "all energy is missing"
FEW = f"the reference has fewer than {FEWEST_RUNS} renders"


def lacking(check: BiasCheck) -> str:
    """Describe the energy missing from an integrator that fails the bias check."""
    share = check.missing
    low, high = sorted((abs(100 * share.low), abs(100 * share.high)))
    if low > 99.95:
        return NOTHING
    if share.low <= 0 <= share.high:
        tile = check.tile and f"the tile in row {check.tile[0]}, column {check.tile[1]}"
        where = tile or "the whole image"
        return f"wrong in {where} of 4 x 4, by {check.difference.value:.2g}"
    what = "of the energy is missing" if share.value > 0 else "too much energy"
    return f"{abs(100 * share.value):.2g} % {what} ({low:.2g} to {high:.2g})"
