"""New balances of the light of an image, from its layers of light groups or paths."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..emitters.light_groups import NO_LAMP, called, is_pattern
from ..errors import CommandError, did_you_mean, listed
from ..image.layers import GROUP, PATH
from .images import STATISTICS, read_exr

Weight = float | Sequence[float]

WEIGHTS = "bdptMix"  # attribute of the header of a mixed EXR: its weights by layer, as JSON
MOST = 1e20  # largest weight: images have single precision


def mix(image: mi.Bitmap | Path | str, weights: Mapping[str, Weight]) -> mi.Bitmap:
    """Return the image with the light of each group, or of each path layer, multiplied by a weight.

    ``image``: rendered with ``light_groups`` or ``path_layers``, an EXR file or ``film.bitmap()``.
    ``weights`` by the name of the group or path layer, not of both kinds: a number, or one for each colour; 1
    for layers that are left out. ``groups.NAME`` and ``path.NAME`` are names too; in names ``*`` and ``?``
    stand for any characters, and exact names win over them. The result has the layers' colours, the image's
    alpha if it has one, in single precision, and the weights as JSON in the metadata ``bdptMix``. Raises
    ``CommandError`` and ``OSError``.
    """
    channels = _channels(image)
    layers, colours = _layers(channels)
    own = {layer: _factors(name, weights[name], colours) for layer, name in _chosen(layers, weights).items()}
    kind = next(iter(own or layers)).partition(".")[0]
    total, alpha = 0.0, [channels["A"][..., None]] if "A" in channels else []
    for layer in (layer for layer in layers if layer.startswith(f"{kind}.")):
        factor = own.get(layer, np.ones(len(colours)))
        with np.errstate(invalid="ignore"):  # infinite light of a layer may be switched off
            total += np.where(factor > 0, factor * layers[layer], 0)
    pixels = np.concatenate([total, *alpha], axis=-1).astype(np.float32)
    if colours == list("RGB"):
        result = mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGBA if alpha else mi.Bitmap.PixelFormat.RGB)
    else:
        result = mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, colours + ["A"] * len(alpha))
    result.metadata()[WEIGHTS] = json.dumps({layer: list(factor) for layer, factor in own.items()})
    return result


def described(path: Path) -> str:
    """Describe the layers of an EXR, and the lamps of light groups, a line for each; raises like `mix`."""
    groups = json.loads(read_exr(path)[1].get(STATISTICS, "{}")).get("light_groups", {})
    lamps = {GROUP + group: listed(list(map(called, ids)), 20) or NO_LAMP for group, ids in groups.items()}
    layers = _layers(_channels(path))[0]
    return "\n".join(f"{layer}: {lamps[layer]}" if layer in lamps else layer for layer in layers)


def _channels(image: mi.Bitmap | Path | str) -> dict[str, np.ndarray]:
    """Return the channels of an image, by name."""
    if not isinstance(image, mi.Bitmap):
        return {name: channel.pixels for name, channel in read_exr(Path(image))[0].items()}
    pixels = np.array(image)
    pixels = pixels.reshape(*pixels.shape[:2], -1)  # one channel has no axis
    return {channel.name: pixels[..., i] for i, channel in enumerate(image.struct_())}


def _layers(channels: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the layers of the image's colours, (height, width, colours) by name, and these colours."""
    image = {channel for channel in channels if "." not in channel} - {"A"}
    depth = {"Z"}  # no colour, but where bands or layers have that name
    most = set("RGB") if image - depth == {"Y"} or image == set("XYZ") else image
    found: dict[str, list[str]] = {}
    for layer, _, colour in (channel.rpartition(".") for channel in channels):
        if layer.startswith((GROUP, PATH)):
            found.setdefault(layer, []).append(colour)
    found = {layer: own for layer, own in found.items() if most - depth <= set(own) <= most}
    if not found:
        raise CommandError(
            "the image has no layers of light groups or paths; give the EXR or film().bitmap() of a "
            "render with light_groups=auto or path_layers=true, not a mix or a tensor, which have none"
        )
    colours = next(iter(found.values()))
    colours = list("RGB") if set(colours) == set("RGB") else colours  # alphabetical in files
    planes = {name: [channels[f"{name}.{c}"] for c in colours] for name in found}
    return {name: np.stack(own, axis=-1, dtype=np.float64) for name, own in planes.items()}, colours


def _chosen(layers: Iterable[str], names: Iterable[str]) -> dict[str, str]:
    """Return the name by layer, of one kind; exact names win."""
    short = {layer: layer.partition(".")[2] for layer in layers}
    own: dict[str, str] = {}
    for name in sorted(names, key=is_pattern):
        found = [layer for layer in short if fnmatchcase(layer if "." in name else short[layer], name)]
        if not found:
            near = did_you_mean(name, short.values(), parts=True)
            raise CommandError(f"the image has no layer {name!r}; {near}there are {', '.join(short)}")
        for layer in found:
            other = own.setdefault(layer, name)
            if other != name and is_pattern(other) == is_pattern(name):
                raise CommandError(f"{layer} has two weights, by {other!r} and {name!r}; give it one")
    if len({layer.partition(".")[0] for layer in own}) > 1:
        raise CommandError(
            f"{', '.join(own)} are light groups and path layers, which divide the same light; mix one kind "
            f"at a time, and write {GROUP}NAME or {PATH}NAME for a name of both kinds"
        )
    return own


def _factors(name: str, weight: Weight, colours: list[str]) -> np.ndarray:
    """Return the weight of each colour that ``name`` is given."""
    values = np.asarray(weight).reshape(-1)  # colours of vectorised variants are (3, 1)
    is_numeric = values.dtype.kind in "iuf" and len(values) in (1, len(colours))
    if not is_numeric or not ((values >= 0) & (values <= MOST)).all():
        raise CommandError(
            f"{name}={weight!r} must be a number, or one for each of {', '.join(colours)}, of 0 to {MOST:g}"
        )
    return np.broadcast_to(values.astype(np.float64), len(colours))
