"""Numbering of strategies (s, t), and the film's layers."""

from __future__ import annotations

from collections.abc import Iterable

from ..settings import Settings
from .colour import STOKES_NAMES
from .features import feature_names

# Layers of the denoised image.
DENOISED = ("denoised.R", "denoised.G", "denoised.B")

# Prefix of the layers of light groups.
GROUP = "groups."


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


def film_layers(
    settings: Settings, colours: Iterable[str] = "RGB", light_groups: Iterable[str] = ()
) -> list[str]:
    """Return the names of the film's layers beside its ``colours`` and alpha, in order."""
    colours = list(colours)
    names = [*(STOKES_NAMES if settings.stokes else ()), *feature_names(settings.aovs)]
    names += DENOISED if settings.denoise else ()
    names += [f"variance.{colour}" for colour in colours if settings.variance]
    names += [f"{GROUP}{group}.{colour}" for group in light_groups for colour in colours]
    of_strategies = [f"s{s}t{t}" for _, s, t in strategies(settings.strategy_depth)]
    of_strategies += ["merged"] * settings.merge_images
    return names + [
        f"{kind}.{strategy}.{channel}"
        for strategy in of_strategies
        for kind in ("weighted", "unweighted")
        for channel in "RGB"
    ]
