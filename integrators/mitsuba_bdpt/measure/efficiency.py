"""Efficiency, speed-up, slopes of errors, bootstrap medians, limits of references."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..errors import CommandError
from .checks import CONFIDENCE, Estimate, number_of, values_of

# Bootstrap resamples: the ends of a 95 % interval vary by 1 % of its width between seeds.
RESAMPLES = 10_000

# Largest share of the reference's own error in a measured error.
REFERENCE_SHARE = 0.01


class Measurement(NamedTuple):
    """Wall seconds of a render and its squared error (relMSE or MSE)."""

    seconds: float
    error: float


def efficiency(seconds, error) -> float:
    """1 / (seconds * error): constant, as a squared error falls as 1 / time."""
    return 1 / (number_of("seconds", seconds, 0) * number_of("error", error, 0))


def equal_time_speedup(ours, other) -> float:
    """Return the ratio of errors, other over ours, at our time.

    Both are (seconds, error), as `Measurement`. With error ~ 1 / time the other's error after our time is
    e_other t_other / t_ours, so the result is (e_other t_other / t_ours) / e_ours.
    """
    ours, other = _measurement("ours", ours), _measurement("other", other)
    return other.error * other.seconds / ours.seconds / ours.error


def equal_error_speedup(ours, other) -> float:
    """Return the ratio of times, other over ours, at our error.

    Both are (seconds, error), as `Measurement`. With error ~ 1 / time the other reaches our error after
    t_other e_other / e_ours, so the result is (t_other e_other / e_ours) / t_ours, equal to
    `equal_time_speedup`. `slope` tests the assumption.
    """
    ours, other = _measurement("ours", ours), _measurement("other", other)
    return other.seconds * other.error / ours.error / ours.seconds


def _measurement(name, pair) -> Measurement:
    try:
        seconds, error = pair
    except (TypeError, ValueError) as failure:
        raise TypeError(f"{name}={pair!r} must be a pair (seconds, error).") from failure
    return Measurement(number_of(f"{name}.seconds", seconds, 0), number_of(f"{name}.error", error, 0))


def slope(samples, errors, confidence=CONFIDENCE, seed=0) -> Estimate:
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
    errors = list(errors)
    if len(errors) != len(x):
        raise CommandError(f"errors has {len(errors)} rows for {len(x)} samples; give one row for each.")
    y = [np.log(values_of(f"errors[{i}]", row, 2, 0)) for i, row in enumerate(errors)]
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


def _percentiles(value, drawn, confidence) -> Estimate:
    tail = (1 - number_of("confidence", confidence, 0, 1)) / 2
    low, high = np.quantile(drawn, [tail, 1 - tail])
    return Estimate(value, float(low), float(high))


def bootstrap_median(values, confidence=CONFIDENCE, seed=0) -> Estimate:
    """Return the median of a few values and its bootstrap interval.

    Percentiles of `RESAMPLES` medians of values drawn with replacement. The interval lies within the range of
    the n values, which contains the median with probability 1 - 2^(1 - n): 94 % for 5, 99.8 % for 10. Source:
    as `slope`, section 13.
    """
    values = values_of("values", values, 2)
    rng = np.random.default_rng(seed)
    drawn = values[rng.integers(len(values), size=(RESAMPLES, len(values)))]
    return _percentiles(float(np.median(values)), np.median(drawn, axis=1), confidence)


def _reference_share(own_error, measured_error) -> float:
    if own_error != 0:
        own_error = number_of("own_error", own_error, 0)
    return own_error / number_of("measured_error", measured_error, 0)


def reference_good_enough(own_error, measured_error) -> bool:
    """Return whether a reference's error is within `REFERENCE_SHARE` of the measured.

    Both in the same measure (relMSE or MSE). The errors of image and reference are independent, so their
    squares add: at the limit, the measured error is 1 % too large.
    """
    return _reference_share(own_error, measured_error) <= REFERENCE_SHARE


def refused_share(share: float, digits: int) -> str:
    """Format a ``share`` above `REFERENCE_SHARE` in percent, never rounded down to it."""
    text, limit = f"{100 * share:.{digits}g}", 100 * REFERENCE_SHARE
    return f"{text} %" if float(text) > limit else f"just above {limit:g} %"


def reference_refusal(own_error, measured_error) -> str:
    """Return why a figure is refused, and the samples that the reference lacks."""
    share = _reference_share(own_error, measured_error)
    if share <= REFERENCE_SHARE:
        raise CommandError(
            f"own_error={own_error!r} is good enough for {measured_error!r}; nothing to refuse."
        )
    times = math.ceil(round(10 * share / REFERENCE_SHARE, 6)) / 10
    return (
        f"The reference carries {refused_share(share, 3)} of the error measured with it ({own_error:.2e} of "
        f"{measured_error:.2e}) and may carry {100 * REFERENCE_SHARE:g} %: render it with at least "
        f"{times:g} times the samples."
    )
