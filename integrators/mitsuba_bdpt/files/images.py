"""Image files: EXR with a PNG beside it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import CommandError
from .whole import check_format, check_writable, replacing

PNG_SIDE = 1_000_000
"""Pixels in a row or column of a PNG, at most: libpng's limit."""


def check_png(film: mi.Film) -> None:
    """Raise ``ValueError`` for an image that no PNG can hold, which would come out after the render."""
    width, height = film.crop_size()
    if max(width, height) > PNG_SIDE:
        raise CommandError(
            f"the image of {width} x {height} is too long for a PNG, whose sides have {PNG_SIDE} "
            "pixels at most; render crop windows."
        )


def prepare_output(output: Path) -> None:
    """Refuse an `output` that cannot be written in the end, which may be in hours; create its directory."""
    if output.suffix.lower() != ".exr":
        raise CommandError(
            f"output={str(output)!r} must end in .exr; a PNG is written beside it in any case."
        )
    for path in (output, output.with_suffix(".png")):
        check_format(path, output)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        for path in (output, output.with_suffix(".png")):
            check_writable(path)
    except OSError as error:
        raise CommandError(
            f"output={str(output)!r} cannot be written ({error.strerror}); name another with -o."
        ) from error


def write_images(film: mi.Film, output: Path, attributes: Mapping[str, str], exposure: float) -> None:
    """Write the film as an EXR with these header `attributes`, and as a PNG beside it."""
    bitmap = film.bitmap()
    names = [channel.name for channel in bitmap.struct_()]
    # Mitsuba's own conversion loses the names of channels beyond the image's.
    component = re.search(r"component_format = (float16|float32|uint32)", str(film))
    pixels = np.array(bitmap).astype(component[1] if component else np.float32)
    image = mi.Bitmap(pixels, bitmap.pixel_format(), names)
    for key, value in attributes.items():
        image.metadata()[key] = value
    write_whole(image, output, mi.Bitmap.FileFormat.OpenEXR)
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        bitmap = grey(pixels[..., : film.base_channels_count()])
    write_whole(developed(bitmap, exposure), output.with_suffix(".png"), mi.Bitmap.FileFormat.PNG)


def grey(bands: np.ndarray) -> mi.Bitmap:
    """What a film without colours shows on a screen: the mean of its `bands`, whose units are the user's
    own, so bright that one pixel in a hundred is white."""
    mean = np.mean(bands, axis=-1, dtype=np.float32, keepdims=True)
    return mi.Bitmap(mean / max(np.quantile(mean, 0.99), 1e-30), mi.Bitmap.PixelFormat.Y)


def developed(bitmap: mi.Bitmap, exposure: float) -> mi.Bitmap:
    """The picture for a screen: exposure, clipping to [0, 1] and the sRGB curve."""
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        bitmap = next(part for name, part in bitmap.split() if name == "<root>")
    rgb = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    bright = mi.Bitmap(mi.TensorXf(rgb) * 2.0**exposure, mi.Bitmap.PixelFormat.RGB)
    return bright.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)


def write_whole(bitmap: mi.Bitmap, path: Path, file_format: mi.Bitmap.FileFormat) -> None:
    """Write an image by `replacing`. (Mitsuba's own files are closed without a look at what could not be
    written: on a full disk the end of a PNG is missing, and nobody hears of it.)"""
    stream = mi.MemoryStream()
    bitmap.write(stream, file_format)
    with replacing(path) as temporary:
        temporary.write_bytes(stream.raw_buffer())
