"""New balances of the light of an image, from its layers of light groups or paths."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import CommandError, UsageTypeError, did_you_mean
from ..image.layers import GROUP, PATH

Weight = float | Sequence[float]


# Names of the partitions of an image, by the prefix of their layers.
_KINDS = {GROUP: "light groups", PATH: "path layers"}

# Layers of one partition: channels by the name of the layer and the colour.
_Layers = dict[str, dict[str, np.ndarray]]


def mix(image: mi.Bitmap | Path | str, weights: Mapping[str, Weight]) -> mi.Bitmap:
    """Return the image with the light of each group, or of each path layer, multiplied by a weight.

    ``image``: rendered with ``light_groups`` or ``path_layers``, an EXR file or ``film.bitmap()``.
    ``weights`` by the name of the group or path layer, not of both kinds: a number, or one for each colour; 1
    for layers that are left out. ``groups.NAME`` and ``path.NAME`` are names too. The result has the layers'
    colours, and the image's alpha if it has one, in single precision. Raises ``CommandError``, and
    ``UsageTypeError`` for other types.
    """
    if not isinstance(image, (mi.Bitmap, Path, str)):
        raise UsageTypeError(f"image={type(image).__name__} must be an mi.Bitmap or the path of an EXR")
    if not isinstance(weights, Mapping):
        raise UsageTypeError(f"weights={type(weights).__name__} must be a dictionary, by names of layers")
    name = "the image" if isinstance(image, mi.Bitmap) else repr(str(image))
    channels = _channels(image)
    layers, own = _chosen(name, _partitions(channels), weights)
    colours = list(next(iter(layers.values())))
    if set(colours) == set("RGB"):  # files have them in another order
        colours = list("RGB")
    factors = {layer: np.ones(len(colours)) for layer in layers}
    for layer, weight in own.items():
        factors[layer] = _factors(layer, weight, colours)
    mixed = [np.zeros_like(values) for values in next(iter(layers.values())).values()]
    for layer, values in layers.items():
        for i, colour in enumerate(colours):
            factor = factors[layer][i]
            if factor > 0:  # infinite light of a layer may be switched off
                mixed[i] += factor * values[colour]
    has_alpha = "A" in channels
    try:
        with np.errstate(over="raise"):
            pixels = np.stack([*mixed, channels["A"]] if has_alpha else mixed, axis=-1).astype(np.float32)
    except FloatingPointError as error:
        layer = max(factors, key=lambda name: factors[name].max())
        raise CommandError(
            f"{layer}={own.get(layer, 1)!r}: the image exceeds 3.4e38, the largest number of single "
            "precision; give smaller weights"
        ) from error
    if colours != list("RGB"):
        return mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, colours + ["A"] * has_alpha)
    return mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGBA if has_alpha else mi.Bitmap.PixelFormat.RGB)


def _partitions(channels: Mapping[str, np.ndarray]) -> dict[str, _Layers]:
    """Return the layers of each partition of an image, by prefix: those with the image's colours."""
    image = {channel for channel in channels if "." not in channel} - {"A"}
    colours = set("RGB") if image in ({"Y"}, set("XYZ")) else image
    found: dict[str, _Layers] = {}
    for channel, values in channels.items():
        for prefix in _KINDS:
            if channel.startswith(prefix):
                layer, _, colour = channel.removeprefix(prefix).rpartition(".")
                found.setdefault(prefix, {}).setdefault(layer, {})[colour] = values
    for prefix, layers in found.items():
        found[prefix] = {name: layer for name, layer in layers.items() if name and set(layer) == colours}
    return {prefix: layers for prefix, layers in found.items() if layers}


def _chosen(
    image: str, partitions: dict[str, _Layers], weights: Mapping[str, Weight]
) -> tuple[_Layers, dict[str, Weight]]:
    """Return the partition to which all names of ``weights`` belong, and its weights by layer."""
    if not partitions:
        raise CommandError(
            f"{image} has no layers of light groups or paths; render it with light_groups=auto or "
            "path_layers=true"
        )
    chosen, own = next(iter(partitions)), {}
    for number, (name, weight) in enumerate(weights.items()):
        prefix, layer = _found(image, partitions, name)
        if number and prefix != chosen:
            raise CommandError(
                f"{next(iter(weights))!r} is one of the {_KINDS[chosen]} and {name!r} one of the "
                f"{_KINDS[prefix]}, which divide the same light; mix one kind at a time"
            )
        if layer in own:
            raise CommandError(f"{layer} has two weights; give it one")
        chosen, own[layer] = prefix, weight
    return partitions[chosen], own


def _found(image: str, partitions: dict[str, _Layers], name: str) -> tuple[str, str]:
    """Return the prefix of the partition and the layer of this ``name``."""
    fitting = [
        (prefix, layer)
        for prefix, layers in partitions.items()
        for layer in layers
        if name in (layer, prefix + layer)
    ]
    if len(fitting) > 1:
        either = " or ".join(prefix + layer for prefix, layer in fitting)
        raise CommandError(f"{image} has a light group and a path layer {name!r}; write {either}")
    if not fitting:
        there = "; ".join(
            f"{_KINDS[prefix].capitalize()}: {', '.join(layers)}" for prefix, layers in partitions.items()
        )
        names = [layer for layers in partitions.values() for layer in layers]
        raise CommandError(f"{image} has no layer {name!r}; {did_you_mean(str(name), names)}{there}")
    return fitting[0]


def _channels(image: mi.Bitmap | Path | str) -> dict[str, np.ndarray]:
    """Return the channels of an image in double precision, by name."""
    if not isinstance(image, mi.Bitmap):
        path = Path(image)
        if not path.is_file():
            raise CommandError(f"there is no image {str(path)!r}; give the EXR of a render")
        try:
            image = mi.Bitmap(str(path))
        except RuntimeError as error:
            raise CommandError(f"{str(path)!r} cannot be read ({error}); give the EXR of a render") from error
    pixels = np.array(image).astype(np.float64)
    pixels = pixels.reshape(*pixels.shape[:2], -1)  # one channel has no axis
    return {channel.name: pixels[..., i] for i, channel in enumerate(image.struct_())}


def _factors(layer: str, weight: Weight, colours: list[str]) -> np.ndarray:
    """Return a layer's weight of each colour."""
    try:
        values = np.atleast_1d(np.asarray(weight))
    except ValueError:  # a ragged list
        values = np.array([None])
    if values.dtype.kind not in "iuf":
        raise CommandError(f"{layer}={weight!r} must be a number, or {len(colours)} for {', '.join(colours)}")
    if values.shape not in ((1,), (len(colours),)):
        raise CommandError(
            f"{layer}={weight!r} has {values.size} numbers; give one, or {len(colours)} for "
            f"{', '.join(colours)}"
        )
    if not all(math.isfinite(value) and value >= 0 for value in values):
        raise CommandError(f"{layer}={weight!r} must be 0 or greater, and finite")
    return np.broadcast_to(values.astype(np.float64), len(colours))
