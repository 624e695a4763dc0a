"""The relMSE of an integrator, from renders of few seeds and a noisy reference.

The estimators, and when an error is a bound: docs/development/measuring.md, *How errors are estimated*. The
raw relMSE is the variance (`metrics.spread`) where the mean of the renders agrees with the reference, else
variance + squared bias, the measured error less the reference's own. Weights come from the reference alone.
Intervals are Student's over seeds; the noise of the reference's image is not in them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy import stats

from .agreement import FEWEST_RUNS, SIGNIFICANCE, Means, missing_energy, sidak, welch
from .metrics import CONFIDENCE, Estimate

Error = Literal["rel_mse", "rel_mse_trimmed"]
"""Columns of measured errors; ``reference_`` and the name: what the reference's own error adds to them."""

KINDS: dict[Error, str] = {"rel_mse_trimmed": "trimmed", "rel_mse": "raw"}

Bound = Literal["", "≥", "≤", "~"]
"""Exact, at least, at most, or neither bound."""

SUBTRACTED = 0.9  # largest share of the reference's own error in a measured one that is subtracted
SHIFTED = 0.1  # largest share of an error by which the reference's noise in its weights may shift it
SHARE_OF_BIAS = 0.2  # largest share of the reference's own error for which the squared bias has an interval
RESAMPLES = 10_000  # of the bootstrap: ends of a 95 % interval vary by 1 % of its width between seeds
FEWEST_WITH_INTERVAL = 5  # renders for which a 95 % interval is given
WIDE = 1e3  # ratio of the ends of an interval from which on it is not given

# Fewest renders of a test for a differing mean; below `FEWEST_RUNS` the squared bias must be this share of
# the error too: tiles of few, rare bright values differ too often, others hardly ever.
FEWEST_TESTED = 3
MATERIAL = 0.05


def has_interval(found: Estimate, count: int) -> bool:
    """Return whether a positive error has an interval no wider than `WIDE`."""
    return count >= FEWEST_WITH_INTERVAL and found.high <= WIDE * found.low


def with_interval(found: Estimate, count: int, is_positive: bool = True) -> str:
    """Format an error of ``count`` renders (its interval), or why there is none."""
    low, high = (f"{end:.2e}" if end > 0 or is_positive else "0" for end in (found.low, found.high))
    if count < FEWEST_WITH_INTERVAL:
        interval = "one render" if count == 1 else "too few renders for an interval"
    elif is_positive and not has_interval(found, count):
        interval = "no interval: one render decides"
    elif math.isinf(found.high):
        interval = "no interval: the reference is too noisy"
    elif is_positive:
        interval = f"{low}–{high}"
    else:
        interval = "0" if high == "0" else f"{low} to {high}"
    return f"{found.value:.2e} ({interval})"


@dataclass(frozen=True)
class RelativeError:
    """relMSE of an integrator at one budget: mean over ``count`` seeds.

    ``bound``: "≥" where the mean of the renders differs from the reference, "≤" where the reference is too
    noisy. ``variance`` and ``squared_bias``: parts of the raw error of two renders or more.
    """

    total: Estimate
    bound: Bound
    count: int
    variance: Estimate | None = None
    squared_bias: Estimate | None = None

    def __str__(self) -> str:
        return f"{self.bound} {with_interval(self.total, self.count)}".lstrip()

    @property
    def parts(self) -> list[str]:
        """Variance and squared bias, or why there are none."""
        if self.variance is None or self.squared_bias is None:
            return ["one render" if self.count == 1 else "images are missing, or samples differ"] * 2
        bias = with_interval(self.squared_bias, self.count, is_positive=False)
        return [with_interval(self.variance, self.count), bias]


def seed_errors(rows: pd.DataFrame, error: Error, differs: bool) -> tuple[pd.Series, Bound]:
    """Return an estimate of the relMSE from each row, and its bound.

    Their mean is unbiased. ``differs``: whether the mean of the renders differs from the reference. If not,
    raw errors are scaled to the mean of `metrics.spread`, whose values each have a part of all seeds'
    fireflies.
    """
    measured, own = rows[error], rows[f"reference_{error}"]
    found = measured - own
    is_noisy = _is_noisy(rows, error)
    if error == "rel_mse" and _has_variance(rows):
        spread = rows["variance"]
        if _is_variance(rows, differs):
            scaled = not is_noisy and found.min() > 0
            return found * (spread.mean() / found.mean()) if scaled else spread, ""
        if is_noisy and len(rows) < FEWEST_TESTED:
            return spread, "≥"
    if is_noisy:
        return measured, "~" if differs else "≤"
    return found, "≥" if differs else ""


def _has_variance(rows: pd.DataFrame) -> bool:
    return "variance" in rows and bool(rows["variance"].notna().all())


def _is_variance(rows: pd.DataFrame, differs: bool) -> bool:
    """Return whether the raw relMSE is the variance alone: no bias was found."""
    return not differs and len(rows) >= FEWEST_TESTED and _has_variance(rows)


def _is_noisy(rows: pd.DataFrame, error: Error) -> bool:
    """Return whether the reference is too noisy to subtract its own error."""
    measured, own = rows[error], rows[f"reference_{error}"]
    found, shift = measured - own, 6 * rows["reference_rel_mse"].mean() ** 2  # to lowest order
    is_noisy = own.sum() > SUBTRACTED * measured.sum() or found.min() <= 0 or shift > SHIFTED * found.mean()
    return bool(own.any() and is_noisy)


def relative_error(rows: pd.DataFrame, error: Error, differs: bool) -> RelativeError:
    """Return the relMSE of the ``rows`` of an integrator at one budget."""
    values, bound = seed_errors(rows, error, differs)
    total = mean_of(values)
    if error != "rel_mse" or not _has_variance(rows):
        return RelativeError(total, bound, len(rows))
    spread = variance(rows)
    is_variance = _is_variance(rows, differs) or (_is_noisy(rows, error) and len(rows) < FEWEST_TESTED)
    return RelativeError(spread if is_variance else total, bound, len(rows), spread, squared_bias(rows))


def mean_of(values: Sequence[float] | pd.Series) -> Estimate:
    """Return the mean of positive values with a 95 % interval.

    Student's, of the logarithm, by the jackknife: too narrow for few values with a long tail, from 0 to
    infinity for a single one.
    """
    given = pd.Series(values)
    without = (given.sum() - given) / (len(given) - 1) if len(given) > 1 else None
    return _of_logarithm(float(given.mean()), without)


def _of_logarithm(value: float, without: pd.Series | None) -> Estimate:
    """Return ``value`` with Student's interval of its logarithm.

    ``without``: the estimates without each of n values.
    """
    if without is None:
        return Estimate(value, 0.0, math.inf)
    if without.min() <= 0:
        half = _half_width(without)
        return Estimate(value, max(value - half, 0.0), value + half)
    factor = math.exp(min(_half_width(np.log(without)), 700.0))
    return Estimate(value, value / factor, value * factor)


def _half_width(without: pd.Series) -> float:
    """Return half of Student's interval, of n jackknife estimates."""
    n = len(without)
    return float(stats.t.isf((1 - CONFIDENCE) / 2, n - 1) * math.sqrt(n - 1) * without.std(ddof=0))


def bootstrap(samples: Sequence[np.ndarray], statistic: Callable[..., Any]) -> Estimate:
    """Return a statistic of independent ``samples`` with its percentile 95 % interval."""
    how = {"n_resamples": RESAMPLES, "confidence_level": CONFIDENCE, "method": "percentile", "rng": 0}
    low, high = stats.bootstrap(samples, statistic, **how).confidence_interval
    return Estimate(float(statistic(*samples)), float(low), float(high))


def variance(rows: pd.DataFrame) -> Estimate:
    """Return the variance relative to the reference, with an interval like `mean_of`."""
    return _of_logarithm(float(rows["variance"].mean()), _variance_without(rows))


def _variance_without(rows: pd.DataFrame) -> pd.Series | None:
    """Return the variances without each of the ``rows``; None for fewer than 3."""
    n, spread = len(rows), rows["variance"]
    if n < 3:
        return None
    # The sum of squares about the mean falls by that row's `metrics.spread`.
    return ((n - 1) / n * spread.sum() - spread) / (n - 2)


def squared_bias(rows: pd.DataFrame) -> Estimate | None:
    """Return the raw squared bias relative to the reference, with a 95 % interval.

    Both may be negative. None for a single render; infinite interval for two, and where the noise of the
    reference, which all seeds share, is more than `SHARE_OF_BIAS` of the measured error.
    """
    n = len(rows)
    if n < 2 or not _has_variance(rows):
        return None
    total = rows["rel_mse"] - rows["reference_rel_mse"]
    value, variances = float(total.mean() - rows["variance"].mean()), _variance_without(rows)
    if variances is None or rows["reference_rel_mse"].sum() > SHARE_OF_BIAS * rows["rel_mse"].sum():
        return Estimate(value, -math.inf, math.inf)
    without = (total.sum() - total) / (n - 1) - variances
    half = _half_width(without)
    return Estimate(value, value - half, value + half)


def mean_differs(rows: pd.DataFrame, reference: Means) -> bool:
    """Return whether the mean of renders of one budget differs from the reference.

    By tiles and by the squared bias: Welch's test alone rejects too often where few pixels hold the light,
    else hardly ever with few renders, for which 95 % intervals of energy and squared bias suffice.
    """
    found, are_few = squared_bias(rows), len(rows) < FEWEST_RUNS
    is_significant = compared(rows, reference)
    if not is_significant and are_few and found is not None and found.low > 0:
        energy = missing_energy(means_of(rows).whole, reference.whole)
        is_significant = not energy.low <= 0 <= energy.high
    share = MATERIAL if are_few else 0.0
    return is_significant and (found is None or bool(found.value > share * rows["rel_mse"].mean()))


def means_of(rows: pd.DataFrame, fewest: int = FEWEST_TESTED) -> Means:
    """Return the means of the renders of the ``rows``, at least ``fewest``."""
    return Means.of(np.stack([*rows["tile_means"]]), fewest=fewest)


def compared(rows: pd.DataFrame, other: Means) -> bool:
    """Return whether the tile means differ significantly; False for too few renders."""
    if len(rows) < FEWEST_TESTED:
        return False
    return sidak(welch(means_of(rows).columns, other.columns).p) < SIGNIFICANCE


def bound_of_ratio(over: Bound, under: Bound) -> Bound:
    """Return the bound of a ratio of two errors with these bounds."""
    turned: dict[Bound, Bound] = {"≥": "≤", "≤": "≥"}
    other = turned.get(under, under)
    return "~" if over and other and over != other else over or other
