"""Numbering of strategies (s, t), and the film's layers."""

from __future__ import annotations

from collections.abc import Iterable

from ..settings import Settings
from ..transport.path_layers import NAMES
from .colour import STOKES_NAMES
from .features import feature_names

DENOISED = ("denoised.R", "denoised.G", "denoised.B")  # layers of the denoised image

# Prefixes of the layers of light groups and of paths: the two partitions of an image.
GROUP, PATH = "groups.", "path."


def strategies(depth: int):
    """Return ``(k, s, t)`` with k = s + t - 1 edges in order, k + 2 of each 1 <= k <= depth."""
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


def partitions(settings: Settings, light_groups: Iterable[str]) -> list[list[str]]:
    """Return the layers of each partition of the image, a set of layers that add up to it."""
    of_groups = [f"{GROUP}{group}" for group in light_groups]
    of_paths = [f"{PATH}{name}" for name in NAMES] if settings.path_layers else []
    return [layers for layers in (of_groups, of_paths) if layers]


def film_layers(
    settings: Settings, colours: Iterable[str] = "RGB", light_groups: Iterable[str] = ()
) -> list[str]:
    """Return the names of the film's layers beside its ``colours`` and alpha, in order."""
    colours = list(colours)
    names = [*(STOKES_NAMES if settings.stokes else ()), *feature_names(settings.aovs)]
    names += DENOISED if settings.denoise else ()
    names += [f"variance.{colour}" for colour in colours if settings.variance]
    parts = [layer for layers in partitions(settings, light_groups) for layer in layers]
    names += [f"{layer}.{colour}" for layer in parts for colour in colours]
    of_strategies = [f"s{s}t{t}" for _, s, t in strategies(settings.strategy_depth)]
    of_strategies += ["merged"] * settings.merge_images
    return names + [
        f"{kind}.{strategy}.{channel}"
        for strategy in of_strategies
        for kind in ("weighted", "unweighted")
        for channel in "RGB"
    ]
