"""The numbering of strategies: which (s, t) exist, and the film's layers."""

from __future__ import annotations

from . import stokes as stokes_layers

# Names of the layers of a denoised image.
DENOISED = ("denoised.R", "denoised.G", "denoised.B")


def strategies(depth: int):
    """All ``(k, s, t)`` with k = s + t - 1 edges, 1 <= k <= depth, in order: k + 2 of each length."""
    return [(k, s, k + 1 - s) for k in range(1, depth + 1) for s in range(k + 2)]


def strategy_count(depth: int) -> int:
    """How many strategies make the paths of up to ``depth`` edges."""
    return depth * (depth + 5) // 2


def image_count(depth: int, merges: bool) -> int:
    """How many strategies have images: those of `strategies`, and where there are ``merges`` all of these."""
    return strategy_count(depth) + merges


def strategy_index(s, t):
    """Place of the strategy (s, t) in `strategies`; integers or arrays of them."""
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
    """Names of the film's layers, in the order in which `Accumulator` keeps them.

    Those of ``stokes``, ``features``, those of ``denoise``, the variance of the pixels in the film's
    ``colours``, and technique images of paths of up to ``depth`` edges, with one of all ``merges`` if there
    are some.
    """
    names = [*(stokes_layers.NAMES if stokes else ()), *features, *(DENOISED if denoise else ())]
    names += [f"variance.{colour}" for colour in colours if variance]
    of_strategies = [f"s{s}t{t}" for _, s, t in strategies(depth)] + ["merged"] * merges
    return names + [
        f"{kind}.{strategy}.{channel}"
        for strategy in of_strategies
        for kind in ("weighted", "unweighted")
        for channel in "RGB"
    ]
