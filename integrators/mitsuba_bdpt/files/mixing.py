"""New balances of the light of an image, from its layers of light groups or paths."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..emitters.light_groups import NO_LAMP, REST, called, is_pattern, matches
from ..errors import CommandError, UsageTypeError, did_you_mean, listed
from ..host.jit import two_threads
from ..image.layers import GROUP, PATH
from .images import STATISTICS, attribute
from .whole import utf8

Weight = float | Sequence[float]


# Names of the partitions of an image, by the prefix of their layers.
_KINDS = {GROUP: "light groups", PATH: "path layers"}

# Attribute of the header of a mixed EXR: its weights by layer, as JSON.
WEIGHTS = "bdptMix"

# Layers of one partition: channels by the name of the layer and the colour.
_Layers = dict[str, dict[str, np.ndarray]]


@dataclass(frozen=True)
class _Image:
    """Layers of an image with a ``name`` for messages, by the prefix of their partition.

    ``lamps``: of each light group the ids of each emitter, if the file has them.
    """

    name: str
    partitions: dict[str, _Layers]
    lamps: dict[str, list[list[str]]] = field(default_factory=dict)


def mix(image: mi.Bitmap | Path | str, weights: Mapping[str, Weight]) -> mi.Bitmap:
    """Return the image with the light of each group, or of each path layer, multiplied by a weight.

    ``image``: rendered with ``light_groups`` or ``path_layers``, an EXR file or ``film.bitmap()``.
    ``weights`` by the name of the group or path layer, not of both kinds: a number, or one for each colour; 1
    for layers that are left out. ``groups.NAME`` and ``path.NAME`` are names too, and in a file that the
    command has rendered ids of emitters, if their group has no other; in names ``*`` and ``?`` stand for any
    characters; a pattern that matches no layer is a warning. The result has the
    layers' colours, the image's alpha if it has one, in single precision, and the weights as JSON in the
    metadata ``bdptMix``. Raises ``CommandError``, and ``UsageTypeError`` for other types.
    """
    if not isinstance(image, (mi.Bitmap, Path, str)):
        raise UsageTypeError(f"image={type(image).__name__} must be an mi.Bitmap or the path of an EXR")
    if not isinstance(weights, Mapping):
        raise UsageTypeError(f"weights={type(weights).__name__} must be a dictionary, by names of layers")
    channels = _channels(image)
    read = _read(image, channels)
    prefix, own = _chosen(read, weights)
    layers = read.partitions[prefix]
    colours = list(next(iter(layers.values())))
    if set(colours) == set("RGB"):  # files have them in another order
        colours = list("RGB")
    given = {argument: _factors(argument, weight, colours) for argument, weight in weights.items()}
    factors = {layer: np.ones(len(colours)) for layer in layers}
    factors |= {layer: given[argument] for layer, argument in own.items()}
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
        argument = own.get(layer, layer)
        raise CommandError(
            f"{argument}={_shown(weights.get(argument, 1))}: the image exceeds 3.4e38, the largest number of "
            "single precision; give smaller weights"
        ) from error
    kind, names = mi.Bitmap.PixelFormat.RGBA if has_alpha else mi.Bitmap.PixelFormat.RGB, []
    if colours != list("RGB"):
        kind, names = mi.Bitmap.PixelFormat.MultiChannel, colours + ["A"] * has_alpha
    result = mi.Bitmap(pixels, kind, names)
    result.metadata()[WEIGHTS] = json.dumps({prefix + layer: list(factors[layer]) for layer in own})
    return result


def described(path: Path) -> str:
    """Describe the layers of an EXR that can be mixed, a line for each; raises like `mix`."""
    image = _read(path, _channels(path))
    lamps = {group: listed(list(map(called, lamps)), 20) for group, lamps in image.lamps.items()}
    return "\n".join(
        f"{prefix}{layer}" + (f": {lamps[layer] or NO_LAMP}" if prefix == GROUP and layer in lamps else "")
        for prefix, layers in image.partitions.items()
        for layer in layers
    )


def _read(image: mi.Bitmap | Path | str, channels: Mapping[str, np.ndarray]) -> _Image:
    """Return the layers among the ``channels`` of an image; raises ``CommandError`` if there are none."""
    if isinstance(image, mi.Bitmap):
        name, is_mix, lamps = "the image", WEIGHTS in image.metadata(), {}
    else:
        name, is_mix = repr(str(image)), attribute(Path(image), WEIGHTS) is not None
        lamps = json.loads(attribute(Path(image), STATISTICS) or "{}").get("light_groups", {})
    if is_mix:
        raise CommandError(f"{name} is a mix, which has no layers; mix the render that it was made of")
    return _Image(name, _partitions(name, channels), lamps)


def _partitions(image_name: str, channels: Mapping[str, np.ndarray]) -> dict[str, _Layers]:
    """Return the layers of each partition of an image, by prefix: those with the image's colours."""
    image = {channel for channel in channels if "." not in channel} - {"A"}
    depth = {"Z"}  # no colour, but where bands or layers have that name
    colours = set("RGB") if image - depth == {"Y"} or image == set("XYZ") else image
    found: dict[str, _Layers] = {}
    for channel, values in channels.items():
        for prefix in _KINDS:
            if channel.startswith(prefix):
                layer, _, colour = channel.removeprefix(prefix).rpartition(".")
                found.setdefault(prefix, {}).setdefault(layer, {})[colour] = values
    for prefix, layers in found.items():
        found[prefix] = {
            name: layer for name, layer in layers.items() if name and colours - depth <= set(layer) <= colours
        }
    found = {prefix: layers for prefix, layers in found.items() if layers}
    if not found and all(re.fullmatch(r"ch\d+", channel) for channel in channels):
        raise CommandError(
            f"{image_name} has no names of channels, so that its layers are unknown; pass film().bitmap() "
            "after the render, or the EXR, not a bitmap of the tensor"
        )
    if not found:
        raise CommandError(
            f"{image_name} has no layers of light groups or paths; render it with light_groups=auto or "
            "path_layers=true"
        )
    return found


def _chosen(image: _Image, weights: Mapping[str, Weight]) -> tuple[str, dict[str, str]]:
    """Return the prefix of the partition to which all names of ``weights`` belong, and the name by layer.

    Exact names win over patterns. Warns of patterns without a layer, unless all names are such.
    """
    every = {name: _found(image, name) for name in weights}
    found = {name: of_name for name, of_name in every.items() if of_name is not None}
    for name in (name for name in every if name not in found):
        text = _missing(image, name)
        if not found:
            raise CommandError(text)
        mi.Log(mi.LogLevel.Warn, f"bdpt: {name!r} changes nothing: {text}")
    chosen = next((prefix for prefix, _ in found.values()), next(iter(image.partitions)))
    for name, (prefix, _) in found.items():
        if prefix != chosen:
            raise CommandError(
                f"{next(iter(weights))!r} is one of the {_KINDS[chosen]} and {name!r} one of the "
                f"{_KINDS[prefix]}, which divide the same light; mix one kind at a time"
            )
    own: dict[str, str] = {}
    for name in sorted(found, key=is_pattern):
        for layer in found[name][1]:
            other = own.setdefault(layer, name)
            if other != name and is_pattern(other) == is_pattern(name):
                raise CommandError(f"{layer} has two weights, by {other!r} and {name!r}; give it one")
    return chosen, own


def _found(image: _Image, name: str) -> tuple[str, list[str]] | None:
    """Return the prefix of the partition and the layers of this ``name``, id or pattern.

    None for a pattern without a layer.
    """

    def fitting(fits: Callable[[str, str], bool]) -> dict[str, list[str]]:
        text = name if isinstance(name, str) else ""
        found = {
            prefix: [layer for layer in layers if fits(layer, text.removeprefix(prefix))]
            for prefix, layers in image.partitions.items()
        }
        return {prefix: layers for prefix, layers in found.items() if layers}

    found = fitting(str.__eq__)
    if not found and isinstance(name, str):
        found = fitting(matches)
        groups = found.get(GROUP, [])
        groups = [*groups, *_of_lamps(image, name.removeprefix(GROUP), groups)]
        found |= {GROUP: groups} if groups else {}
    if len(found) > 1:
        either = " or ".join(prefix + name for prefix in found)
        if is_pattern(name):
            raise CommandError(f"{name!r} matches light groups and path layers; write {either}")
        raise CommandError(f"{image.name} has a light group and a path layer {name!r}; write {either}")
    if not found and not (isinstance(name, str) and is_pattern(name)):
        raise CommandError(_missing(image, name))
    return next(iter(found.items()), None)


def _of_lamps(image: _Image, name: str, named: Sequence[str]) -> list[str]:
    """Return the light groups whose emitters have ids that fit ``name``, beside those ``named`` by it.

    Raises ``CommandError`` if such a group has other emitters too.
    """
    layers: list[str] = []
    for group, lamps in image.lamps.items():
        if group in named:
            continue
        own = [ids for ids in lamps if any(matches(one, name) for one in ids)]
        if 0 < len(own) < len(lamps):
            others = listed([called(ids) for ids in lamps if ids not in own], 5)
            raise CommandError(
                f"{name!r} fits the lamp {called(own[0])!r} of the group {group}, which has {others} too: "
                f"{group}=X changes all of these; to change it alone, render it with a group of its own"
            )
        layers += [group] if own else []
    return layers


def _missing(image: _Image, name: str) -> str:
    """Return a message that no layer has this ``name``."""
    there = "; ".join(
        f"{_KINDS[prefix].capitalize()}: {', '.join(layers)}" for prefix, layers in image.partitions.items()
    )
    names = [layer for layers in image.partitions.values() for layer in layers]
    names += [one for lamps in image.lamps.values() for ids in lamps for one in ids]
    question = did_you_mean(str(name), names, parts=True)
    rest = ""
    if REST in image.lamps:
        rest = f"; {REST} has the light of {listed(list(map(called, image.lamps[REST])), 5)}"
    elif REST in image.partitions.get(GROUP, ()):
        rest = f"; the light of emitters in no other group is in {REST}"
    return f"{image.name} has no layer {name!r}; {question}{there}{rest}"


def _channels(image: mi.Bitmap | Path | str) -> dict[str, np.ndarray]:
    """Return the channels of an image in double precision, by name."""
    if not isinstance(image, mi.Bitmap):
        path = Path(image)
        if not path.is_file():
            raise CommandError(f"there is no image {str(path)!r}; give the EXR of a render")
        try:
            with two_threads():
                image = mi.Bitmap(utf8(path))
        except RuntimeError as error:
            raise CommandError(f"{str(path)!r} cannot be read ({error}); give the EXR of a render") from error
    pixels = np.array(image).astype(np.float64)
    pixels = pixels.reshape(*pixels.shape[:2], -1)  # one channel has no axis
    return {channel.name: pixels[..., i] for i, channel in enumerate(image.struct_())}


def _factors(name: str, weight: Weight, colours: list[str]) -> np.ndarray:
    """Return the weight of each colour that ``name`` is given."""
    try:
        values = np.atleast_1d(np.asarray(weight))
    except ValueError:  # a ragged list
        values = np.array([None])
    if values.ndim == 2 and values.shape[1] == 1:  # a colour of a vectorised variant
        values = values[:, 0]
    if values.dtype.kind not in "iuf":
        raise CommandError(f"{name}={weight!r} must be a number, or {len(colours)} for {', '.join(colours)}")
    if values.shape not in ((1,), (len(colours),)):
        raise CommandError(
            f"{name}={_shown(weight)} has {values.size} numbers; give one, or {len(colours)} for "
            f"{', '.join(colours)}"
        )
    if not all(math.isfinite(value) and value >= 0 for value in values):
        raise CommandError(f"{name}={_shown(weight)} must be 0 or greater, and finite")
    return np.broadcast_to(values.astype(np.float64), len(colours))


def _shown(weight: Weight) -> str:
    """Return a weight as on the command line."""
    return ",".join(f"{value:g}" for value in np.ravel(np.asarray(weight)))
