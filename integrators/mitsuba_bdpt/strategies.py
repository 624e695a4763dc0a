"""The numbering of strategies: which (s, t) exist, and the film's layers."""

from __future__ import annotations


def strategies(depth: int):
    """All ``(k, s, t)`` with k = s + t - 1 edges, 1 <= k <= depth, t >= 1, in order."""
    return [(k, s, k + 1 - s) for k in range(1, depth + 1) for s in range(k + 1)]


def strategy_count(depth: int) -> int:
    """How many strategies make the paths of up to ``depth`` edges."""
    return depth * (depth + 3) // 2


def strategy_index(s, t):
    """Place of the strategy (s, t) in `strategies`; integers or arrays of them."""
    k = s + t - 1
    return (k - 1) * (k + 2) // 2 + s


def layer_names(depth: int, variance: bool) -> list[str]:
    """Names of the film's layers, in the order in which `Accumulator` keeps them: the variance of the
    pixels, and technique images of paths of up to ``depth`` edges."""
    names = [f"variance.{channel}" for channel in "RGB"] if variance else []
    return names + [
        f"{kind}.s{s}t{t}.{channel}"
        for _, s, t in strategies(depth)
        for kind in ("weighted", "unweighted")
        for channel in "RGB"
    ]
