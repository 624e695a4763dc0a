"""The relMSE of an integrator at one budget, from the renders of several seeds and a noisy reference.

Of K independent renders x_i of one budget, with expected image u, the truth I, and independent halves A and B
of the reference R = (A + B) / 2; all means are over pixels and channels with the weights 1 / (R^2 + eps) of
`metrics.rel_mse`. The weights come from the reference alone, the same for all integrators, never from the
renders that are judged: these divide their own fireflies by themselves.

* Variance, E (x_i - u)^2: `metrics.spread`, the sample variance. No reference is in it.
* Variance + squared bias, E (x_i - I)^2: the products (x_i - A)(x_i - B) = (x_i - R)^2 - ((A - B) / 2)^2, the
  measured error less the reference's own. Its expectation is free of the reference's noise.
* Squared bias, (u - I)^2: their difference, which is the mean of (x_i - A)(x_j - B) over pairs i != j.

The raw relMSE is the variance where the mean of the renders agrees with the reference. Where it differs, it
is variance + squared bias and a lower bound: the integrator is biased, or has not met rare light, whose
variance the renders do not show. Of fewer than `FEWEST_TESTED` renders the mean cannot be tested: the raw
relMSE is variance + squared bias, or, where the reference is too noisy, the variance as a lower bound. The
trimmed relMSE is of the products, of the values that the trimmed measured error keeps. Intervals are
Student's over seeds; the noise of the reference's image in the weights is not in them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from .agreement import FEWEST_RUNS, SIGNIFICANCE, Means, missing_energy, sidak, welch
from .metrics import CONFIDENCE, Estimate, values_of
from .record import Error, Errors, Row

Bound = Literal["", "≥", "≤", "~"]
"""Exact, at least, at most, or neither bound."""

# Error columns of a row, and the reference's own.
OWN: dict[Error, Literal["reference_rel_mse", "reference_rel_mse_trimmed"]] = {
    "rel_mse": "reference_rel_mse",
    "rel_mse_trimmed": "reference_rel_mse_trimmed",
}

# Above this share of the measured error the reference's own error is not subtracted: the difference would be
# mostly noise.
SUBTRACTED = 0.9

# Bootstrap resamples: the ends of a 95 % interval vary by 1 % of its width between seeds.
RESAMPLES = 10_000

# Fewest renders for which a 95 % interval is given; a range of fewer has their number beside it.
FEWEST_WITH_INTERVAL = 5

# Fewest renders of a test for a differing mean; below `FEWEST_RUNS` the squared bias must be this share of
# the error too: tiles of few, rare bright values differ too often, others hardly ever.
FEWEST_TESTED = 3
MATERIAL = 0.05


@dataclass(frozen=True)
class RelativeError:
    """relMSE of an integrator at one budget: the mean over ``count`` seeds with a 95 % interval.

    ``bound``: "≥" where the mean of the renders differs from the reference, "≤" where the reference is too
    noisy. ``variance`` and ``squared_bias`` are parts of the raw error; None of a single render, or without
    the renders' variance. Of two renders their intervals are infinite.
    """

    total: Estimate
    bound: Bound
    count: int
    variance: Estimate | None = None
    squared_bias: Estimate | None = None


def seed_errors(rows: Sequence[Errors], error: Error, differs: bool) -> tuple[list[float], Bound]:
    """Return an estimate of the relMSE from each row, whose mean is unbiased, and its bound.

    ``differs``: whether the mean of the renders differs from the reference. If not, raw errors are scaled to
    the mean of `metrics.spread`, whose own values are not of one seed: each has a part of the others'
    fireflies.
    """
    measured = _column(rows, error)
    found = measured - _column(rows, OWN[error])
    is_noisy = _is_noisy(rows, error)
    if error == "rel_mse" and _has_variance(rows):
        spread = _column(rows, "variance")
        if _is_variance(rows, differs):
            scaled = not is_noisy and found.min() > 0
            return (found * (spread.mean() / found.mean()) if scaled else spread).tolist(), ""
        if is_noisy and len(rows) < FEWEST_TESTED:
            return spread.tolist(), "≥"
    if is_noisy:
        return measured.tolist(), "~" if differs else "≤"
    return found.tolist(), "≥" if differs else ""


def _column(rows: Sequence[Errors], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows], dtype=np.float64)


def _has_variance(rows: Sequence[Errors]) -> bool:
    return all(row.get("variance") is not None for row in rows)


def _is_variance(rows: Sequence[Errors], differs: bool) -> bool:
    """Return whether the raw relMSE is the variance alone: the mean was tested, and agrees."""
    return not differs and len(rows) >= FEWEST_TESTED and _has_variance(rows)


def _is_noisy(rows: Sequence[Errors], error: Error) -> bool:
    """Return whether the reference is too noisy to subtract its own error."""
    measured, own = _column(rows, error), _column(rows, OWN[error])
    return bool(own.any()) and bool(own.sum() > SUBTRACTED * measured.sum() or (measured - own).min() <= 0)


def relative_error(rows: Sequence[Errors], error: Error, differs: bool) -> RelativeError:
    """Return the relMSE of the ``rows`` of an integrator at one budget."""
    values, bound = seed_errors(rows, error, differs)
    total = mean_of(values)
    if error != "rel_mse" or not _has_variance(rows):
        return RelativeError(total, bound, len(rows))
    spread = variance(rows)
    is_variance = _is_variance(rows, differs) or (_is_noisy(rows, error) and len(rows) < FEWEST_TESTED)
    return RelativeError(spread if is_variance else total, bound, len(rows), spread, squared_bias(rows))


def mean_of(values: Sequence[float]) -> Estimate:
    """Return the mean of positive values with Student's 95 % interval of its logarithm.

    The standard error is the jackknife's. From 0 to infinity for a single value. The interval of few values
    with a long tail is too narrow: a rare value was not met.
    """
    given = values_of("values", values, 1)
    value, n = float(given.mean()), len(given)
    if n == 1:
        return Estimate(value, 0.0, math.inf)
    return _of_logarithm(value, (given.sum() - given) / (n - 1))


def _of_logarithm(value: float, without: np.ndarray) -> Estimate:
    """Return Student's interval of the logarithm of ``value``, of the estimates ``without`` each of n."""
    if without.min() <= 0:
        half = _half_width(without)
        return Estimate(value, max(value - half, 0.0), value + half)
    factor = math.exp(min(_half_width(np.log(without)), 700.0))
    return Estimate(value, value / factor, value * factor)


def _half_width(without: np.ndarray) -> float:
    """Half of Student's interval, by the jackknife: of the estimates ``without`` each of n values."""
    n = len(without)
    return float(stats.t.isf((1 - CONFIDENCE) / 2, n - 1) * math.sqrt(n - 1) * without.std())


def bootstrap(samples: Sequence[np.ndarray], statistic: Callable[..., Any]) -> Estimate:
    """Return a statistic of independent ``samples``, and its 95 % interval: percentiles of resamples."""
    how = {"n_resamples": RESAMPLES, "confidence_level": CONFIDENCE, "method": "percentile", "rng": 0}
    low, high = stats.bootstrap(samples, statistic, **how).confidence_interval
    return Estimate(float(statistic(*samples)), float(low), float(high))


def variance(rows: Sequence[Errors]) -> Estimate:
    """Return the variance relative to the reference, with a 95 % interval over seeds.

    Student's interval of the logarithm, whose standard error is the jackknife's; from 0 to infinity for two
    renders, whose only difference shows no spread. Too narrow where the renders missed rare bright values.
    """
    without = _variance_without(rows)
    value = float(_column(rows, "variance").mean())
    if without is None:
        return Estimate(value, 0.0, math.inf)
    return _of_logarithm(value, without)


def _variance_without(rows: Sequence[Errors]) -> np.ndarray | None:
    """Return the variances without each of the ``rows``; None for fewer than 3."""
    n = len(rows)
    if n < 3:
        return None
    # The sum of squares about the mean falls by that row's `metrics.spread`.
    spread = _column(rows, "variance")
    return ((n - 1) / n * spread.sum() - spread) / (n - 2)


def squared_bias(rows: Sequence[Errors]) -> Estimate | None:
    """Return the squared bias relative to the reference, raw, with a 95 % interval over seeds.

    None for a single render; infinite interval for two. Value and interval may be negative.
    """
    n = len(rows)
    if n < 2 or not _has_variance(rows):
        return None
    total = _column(rows, "rel_mse") - _column(rows, "reference_rel_mse")
    value, variances = float(total.mean() - _column(rows, "variance").mean()), _variance_without(rows)
    if variances is None:
        return Estimate(value, -math.inf, math.inf)
    without = (total.sum() - total) / (n - 1) - variances
    half = _half_width(without)
    return Estimate(value, value - half, value + half)


def mean_differs(rows: Sequence[Row], reference: Means) -> bool:
    """Return whether the mean of renders of one budget differs from the reference.

    By tiles and by the squared bias: Welch's test alone rejects too often where few pixels hold the light.
    Elsewhere it hardly ever rejects few renders, for which 95 % intervals of energy and squared bias suffice.
    """
    found, are_few = squared_bias(rows), len(rows) < FEWEST_RUNS
    if not compared(rows, reference) and not (are_few and _intervals_leave_out_zero(rows, reference, found)):
        return False
    share = MATERIAL if are_few else 0.0
    return found is None or found.value > share * float(np.mean([row["rel_mse"] for row in rows]))


def _intervals_leave_out_zero(rows: Sequence[Row], reference: Means, bias: Estimate | None) -> bool:
    """Return whether the intervals of the squared ``bias`` and of the missing energy leave out 0."""
    if bias is None or bias.low <= 0:
        return False
    columns = [row["tile_means"] for row in rows]
    energy = missing_energy(Means.of(columns, fewest=FEWEST_TESTED).whole, reference.whole)
    return not energy.low <= 0 <= energy.high


def compared(rows: Sequence[Row], other: Means) -> bool:
    """Return whether the tile means differ significantly; False for too few renders."""
    if len(rows) < FEWEST_TESTED:
        return False
    means = Means.of([row["tile_means"] for row in rows], fewest=FEWEST_TESTED)
    return sidak(welch(means.columns, other.columns).p) < SIGNIFICANCE


def unlike(rows: Sequence[Row], others: Sequence[Row]) -> bool:
    """Return whether the means of two integrators' renders differ; True for too few renders."""
    if min(len(rows), len(others)) < FEWEST_TESTED:
        return True
    return compared(rows, Means.of([row["tile_means"] for row in others], fewest=FEWEST_TESTED))


def bound_of_ratio(over: Bound, under: Bound) -> Bound:
    """Return the bound of a ratio of two errors with the bounds ``over`` and ``under``."""
    turned: dict[Bound, Bound] = {"": "", "≥": "≤", "≤": "≥", "~": "~"}
    other = turned[under]
    return "~" if over and other and over != other else over or other
