"""Numbering of strategies (s, t), and the film's layers."""

from __future__ import annotations

from .colour import STOKES_NAMES

# Layers of the denoised image.
DENOISED = ("denoised.R", "denoised.G", "denoised.B")


def strategies(depth: int):
    """Return all ``(k, s, t)`` with k = s + t - 1 edges, 1 <= k <= depth, in order.

    There are k + 2 of each length k.
    """
    return [(k, s, k + 1 - s) for k in range(1, depth + 1) for s in range(k + 2)]


def strategy_count(depth: int) -> int:
    """Return the number of strategies for paths of up to ``depth`` edges."""
    return depth * (depth + 5) // 2


def image_count(depth: int, merges: bool) -> int:
    """Return the number of strategy images: `strategies`, and one of all ``merges``."""
    return strategy_count(depth) + merges


def strategy_index(s, t):
    """Return the index of (s, t) in `strategies`; integers or arrays."""
    k = s + t - 1
    return (k - 1) * (k + 4) // 2 + s


def layer_names(
    depth: int,
    variance: bool,
    features=(),
    colours=("R", "G", "B"),
    merges: bool = False,
    denoise: bool = False,
    stokes: bool = False,
) -> list[str]:
    """Return the names of the film's layers, in the order of `Accumulator`.

    Layers of ``stokes``, ``features``, ``denoise``, the variance of ``colours``, and strategy images of paths
    of up to ``depth`` edges, with one of all ``merges`` if true.
    """
    names = [*(STOKES_NAMES if stokes else ()), *features, *(DENOISED if denoise else ())]
    names += [f"variance.{colour}" for colour in colours if variance]
    of_strategies = [f"s{s}t{t}" for _, s, t in strategies(depth)] + ["merged"] * merges
    return names + [
        f"{kind}.{strategy}.{channel}"
        for strategy in of_strategies
        for kind in ("weighted", "unweighted")
        for channel in "RGB"
    ]
