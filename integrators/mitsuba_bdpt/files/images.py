"""Image files: an EXR with a PNG beside it, layers of an EXR."""

from __future__ import annotations

import errno
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import OpenEXR

from ..errors import CommandError, behind
from ..host.jit import two_threads
from ..image.layers import DENOISED
from .whole import MAGIC, check_format, check_writable, replacing, utf8

MOST_CHANNELS = 1023
"""Of an image file, the weight of a pixel among them: Mitsuba's bitmaps have 4095 bytes for a pixel."""


def check_channels(film: mi.Film, layers: list[str]) -> None:
    """Raise ``CommandError``, before the render, if a file cannot hold the ``layers`` (names of channels)."""
    is_large = len(layers) + film.base_channels_count() > MOST_CHANNELS // 2
    if is_large and (count := film.prepare(layers)) > MOST_CHANNELS:
        raise CommandError(
            f"the image has {count} channels, {len(layers)} of them layers, and Mitsuba's images hold "
            f"{MOST_CHANNELS} at most; ask for fewer layers: of strategies, by a smaller max_depth."
        )


STATISTICS = "bdptStatistics"  # attribute of an EXR's header: the statistics of its render, as JSON


def attribute(path: Path, name: str) -> str | None:
    """Return a text of an EXR header; None if it is missing, or the file is no EXR."""
    found = header_of(path).get(name)
    return found if isinstance(found, str) else None


def header_of(path: Path) -> dict[str, Any]:
    """Return the header of an EXR; empty for other files."""
    try:
        return OpenEXR.File(utf8(path), header_only=True).header() if path.is_file() else {}
    except (OSError, RuntimeError, ValueError):
        return {}


def write_images(film: mi.Film, output: Path, attributes: Mapping[str, str], exposure: float) -> str:
    """Write the film as an EXR with header `attributes`, and as a PNG beside it.

    Returns why there is no PNG; empty if there is one. Errors of the EXR are raised.
    """
    _write_exr(output, _channels(film), dict(attributes))
    png = output.with_suffix(".png")
    try:
        write_png(film, film.bitmap(), png, exposure)
    except (OSError, RuntimeError) as error:  # Mitsuba's for an image that is too large for a PNG
        if behind(error, KeyboardInterrupt):
            raise
        why = getattr(error, "strerror", None) or error
        return f"{str(png)!r} could not be written: {why}; the image is {str(output)!r}"
    return ""


def _channels(film: mi.Film) -> dict[str, np.ndarray]:
    bitmap = film.bitmap()
    component = re.search(r"component_format = (float16|float32|uint32)", str(film))
    dtype = np.dtype(component[1] if component else np.float32)
    pixels = np.array(bitmap).reshape(bitmap.height(), bitmap.width(), -1)
    names = [channel.name for channel in bitmap.struct_()]
    planes = zip(names, np.moveaxis(pixels, -1, 0), strict=True)
    return {_file_name(name, names): _stored(plane, name, dtype) for name, plane in planes}


def _file_name(name: str, names: list[str]) -> str:
    """Name of a channel in a file: the depth feature `Z` is stored as channel `Z`."""
    feature, _, part = name.rpartition(".")
    is_depth = part == "T" and feature.rpartition(".")[2] == "Z"
    return feature if is_depth and feature not in names else name


def _stored(pixels: np.ndarray, name: str, dtype: np.dtype) -> np.ndarray:
    """Convert a channel to ``dtype``; features that are no colours have 32 bits at least."""
    is_coarse = dtype == np.float16 and re.search(r"\.[TIUVXYZ]$", name)
    return np.ascontiguousarray(pixels, dtype=np.float32 if is_coarse else dtype)


def _write_exr(path: Path, channels: Mapping[str, np.ndarray], header: dict[str, Any]) -> None:
    """Write an EXR of channels (height, width), by `replacing`, and check that all of it was written."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    with replacing(path) as temporary:
        temporary.touch()  # OpenEXR does not report the cause
        name = utf8(temporary)
        try:
            with OpenEXR.File(header, dict(channels)) as file:
                file.write(name)
            del channels, file
            read_exr(temporary)  # OpenEXR does not report every full disk
        except (CommandError, RuntimeError) as error:
            why = f"could not be written whole ({error.__cause__ or error}); is the disk full?"
            raise OSError(errno.ENOSPC, why, str(path)) from error


def write_png(film: mi.Film, bitmap: mi.Bitmap, path: Path, exposure: float) -> None:
    """Write the tone-mapped image of the ``film``'s ``bitmap``."""
    write_whole(developed(screen_image(film, bitmap), exposure), path, mi.Bitmap.FileFormat.PNG)


def screen_image(film: mi.Film, bitmap: mi.Bitmap) -> mi.Bitmap:
    """Return the colours to display: denoised if present, or `grey` without colours."""
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        return grey(np.array(bitmap)[..., : film.base_channels_count()])
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        parts = dict(bitmap.split())
        is_denoised = set(DENOISED) <= {channel.name for channel in bitmap.struct_()}
        return parts["denoised" if is_denoised else "<root>"]
    return bitmap


def grey(bands: np.ndarray) -> mi.Bitmap:
    """Return the mean of a film's ``bands``, of arbitrary units: 1 % of the pixels are white."""
    mean = np.mean(bands, axis=-1, dtype=np.float32, keepdims=True)
    return mi.Bitmap(mean / max(np.quantile(mean, 0.99), 1e-30), mi.Bitmap.PixelFormat.Y)


def developed(bitmap: mi.Bitmap, exposure: float) -> mi.Bitmap:
    """Tone-map: exposure, clipping to [0, 1], sRGB curve."""
    rgb = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    bright = mi.Bitmap(mi.TensorXf(rgb) * 2.0**exposure, mi.Bitmap.PixelFormat.RGB)
    return bright.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)


def write_whole(bitmap: mi.Bitmap, path: Path, file_format: mi.Bitmap.FileFormat) -> None:
    """Write an image by `replacing`, and check that all of it was written.

    Mitsuba does not report failed writes: on a full disk the end of a PNG is missing.
    """
    stream = mi.MemoryStream()
    with two_threads():
        bitmap.write(stream, file_format)
    with replacing(path) as temporary:
        temporary.write_bytes(stream.raw_buffer())


def check_output(path: Path, suffix: str) -> None:
    """Create the folder of an output; raises ``CommandError`` if it cannot be written.

    Also for another ``suffix``, or if it would overwrite an image of another format (the EXR, or the PNG
    beside it).
    """
    is_exr = suffix == ".exr"
    if path.suffix.lower() != suffix:
        more = "; a PNG is written beside it in any case." if is_exr else ""
        raise CommandError(f"output={str(path)!r} must end in {suffix}{more}")
    files = [path, path.with_suffix(".png")] if is_exr else [path]
    for file in files:
        check_format(file, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for file in files:
            check_writable(file)
    except OSError as error:
        raise CommandError(
            f"output={str(path)!r} cannot be written ({error.strerror}); name another with -o."
        ) from error


def write_layers(
    path: Path,
    layers: Mapping[str, np.ndarray],
    header: dict[str, str],
    dtype: type[np.floating] = np.float16,
) -> None:
    """Write an EXR of layers {prefix: (height, width, 3)}, by `replacing`."""
    channels = {
        f"{layer}{c}": np.ascontiguousarray(pixels[..., i]).astype(dtype)
        for layer, pixels in layers.items()
        for i, c in enumerate("RGB")
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    _write_exr(path, channels, header)


def read_layers(path: Path, *layers: str) -> tuple[list[np.ndarray], dict[str, Any]]:
    """Images (height, width, 3) of an EXR's layers (prefixes), and its header; or ``CommandError``."""
    channels, header = read_exr(path)
    missing = [f"{layer}{c}" for layer in layers for c in "RGB" if f"{layer}{c}" not in channels]
    if missing:
        raise CommandError(f"{str(path)!r} has no channel {missing[0]}; there are {sorted(channels)}")
    images = [np.stack([channels[f"{layer}{c}"].pixels for c in "RGB"], axis=-1) for layer in layers]
    return [image.astype(np.float64) for image in images], header


def read_exr(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the channels and the header of an EXR; raises ``CommandError`` for other files."""
    with path.open("rb") as file:  # OpenEXR does not report the cause
        start = file.read(4)
    if start != MAGIC[".exr"]:
        raise CommandError(f"{str(path)!r} is not an EXR")
    try:
        with OpenEXR.File(utf8(path), separate_channels=True) as opened:
            return dict(opened.channels()), dict(opened.header())
    except (RuntimeError, ValueError) as error:  # ValueError of a truncated file
        raise CommandError(f"{str(path)!r} is damaged ({error}); delete it, to make it anew") from error
