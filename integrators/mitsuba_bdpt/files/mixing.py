"""New balances of the light of an image, from its layers of light groups."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import CommandError, did_you_mean
from ..image.layers import GROUP

Weight = float | Sequence[float]


def mix(image: mi.Bitmap | Path | str, weights: Mapping[str, Weight]) -> mi.Bitmap:
    """Return the image with the light of each group multiplied by a weight.

    ``image``: rendered with ``light_groups``, an EXR file or ``film.bitmap()``. ``weights`` by the name of
    the group: a number, or one for each colour; 1 for groups that are left out. The result has the image's
    colours, and its alpha if it has one, in single precision. Raises ``CommandError``.
    """
    name = "the image" if isinstance(image, mi.Bitmap) else repr(str(image))
    channels = _channels(image)
    groups: dict[str, dict[str, np.ndarray]] = {}
    for channel, values in channels.items():
        if channel.startswith(GROUP):
            group, _, colour = channel.removeprefix(GROUP).rpartition(".")
            groups.setdefault(group, {})[colour] = values
    if not groups:
        raise CommandError(f"{name} has no layers of light groups; render it with light_groups=auto, say")
    colours = list(next(iter(groups.values())))
    if set(colours) == set("RGB"):  # files have them in another order
        colours = list("RGB")
    factors = {group: np.ones(len(colours)) for group in groups}
    for group, weight in weights.items():
        if group not in groups:
            there = ", ".join(groups)
            raise CommandError(f"{name} has no group {group!r}; {did_you_mean(group, groups)}Groups: {there}")
        factors[group] = _factors(group, weight, colours)
    mixed = [
        sum(factors[group][i] * layer[colour] for group, layer in groups.items())
        for i, colour in enumerate(colours)
    ]
    has_alpha = "A" in channels
    pixels = np.stack([*mixed, channels["A"]] if has_alpha else mixed, axis=-1).astype(np.float32)
    if colours != list("RGB"):
        return mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, colours + ["A"] * has_alpha)
    return mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGBA if has_alpha else mi.Bitmap.PixelFormat.RGB)


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


def _factors(group: str, weight: Weight, colours: list[str]) -> np.ndarray:
    """Return a group's weight of each colour."""
    values = np.atleast_1d(np.asarray(weight, dtype=np.float64))
    if values.shape not in ((1,), (len(colours),)):
        raise CommandError(
            f"{group}={weight!r} has {values.size} numbers; give one, or {len(colours)} for "
            f"{', '.join(colours)}"
        )
    if not all(math.isfinite(value) and value >= 0 for value in values):
        raise CommandError(f"{group}={weight!r} must be 0 or greater, and finite")
    return np.broadcast_to(values, len(colours))
