"""Image files: EXR with a PNG beside it, layers of an EXR."""

from __future__ import annotations

import errno
import re
from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR

from ..errors import CommandError
from ..image.layers import DENOISED
from .whole import MAGIC, check_format, check_writable, replacing

PNG_SIDE = 1_000_000
"""Pixels in a row or column of a PNG, at most: libpng's limit."""


MOST_CHANNELS = 1023
"""Of an image file, the weight of a pixel among them: Mitsuba's bitmaps have 4095 bytes for a pixel."""


def check_channels(film: mi.Film, layers: list[str]) -> None:
    """Raise ``CommandError`` for more ``layers``, names of channels, than a file can hold.

    Before the render: writing would find it out after it.
    """
    if len(layers) + film.base_channels_count() > MOST_CHANNELS // 2:
        count = film.prepare(layers)
        if count > MOST_CHANNELS:
            raise CommandError(
                f"the image has {count} channels, {len(layers)} of them layers, and Mitsuba's images hold "
                f"{MOST_CHANNELS} at most; ask for fewer layers: of strategies, by a smaller max_depth."
            )


def check_png(film: mi.Film) -> None:
    """Raise ``CommandError`` for an image that no PNG can hold, which would come out after the render."""
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


def attribute(path: Path, name: str) -> str | None:
    """A text in the header of an EXR file; None if it is not there, or the file is none."""
    if not path.is_file():
        return None
    try:
        found = OpenEXR.File(str(path), header_only=True).header().get(name)
    except (OSError, RuntimeError, ValueError):
        return None
    return found if isinstance(found, str) else None


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
    write_png(film, bitmap, output.with_suffix(".png"), exposure)


def write_png(film: mi.Film, bitmap: mi.Bitmap, path: Path, exposure: float) -> None:
    """Write the picture for a screen of the ``film``'s ``bitmap``."""
    write_whole(developed(screen_image(film, bitmap), exposure), path, mi.Bitmap.FileFormat.PNG)


def screen_image(film: mi.Film, bitmap: mi.Bitmap) -> mi.Bitmap:
    """What of a ``film``'s ``bitmap`` is shown on screens: its colours, denoised if they are, or `grey`."""
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        return grey(np.array(bitmap)[..., : film.base_channels_count()])
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        parts = dict(bitmap.split())
        is_denoised = all(name in {c.name for c in bitmap.struct_()} for name in DENOISED)
        return parts["denoised"] if is_denoised else parts["<root>"]
    return bitmap


def grey(bands: np.ndarray) -> mi.Bitmap:
    """Grey image of a film without colours, for a screen: the mean of its `bands`.

    Their units are the user's own; it is so bright that one pixel in a hundred is white.
    """
    mean = np.mean(bands, axis=-1, dtype=np.float32, keepdims=True)
    return mi.Bitmap(mean / max(np.quantile(mean, 0.99), 1e-30), mi.Bitmap.PixelFormat.Y)


def developed(bitmap: mi.Bitmap, exposure: float) -> mi.Bitmap:
    """The picture for a screen: exposure, clipping to [0, 1] and the sRGB curve."""
    rgb = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    bright = mi.Bitmap(mi.TensorXf(rgb) * 2.0**exposure, mi.Bitmap.PixelFormat.RGB)
    return bright.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)


def write_whole(bitmap: mi.Bitmap, path: Path, file_format: mi.Bitmap.FileFormat) -> None:
    """Write an image by `replacing`.

    Mitsuba's own files are closed without a look at what could not be written: on a full disk the end of a
    PNG is missing, and nobody hears of it.
    """
    stream = mi.MemoryStream()
    with two_threads():
        bitmap.write(stream, file_format)
    with replacing(path) as temporary:
        temporary.write_bytes(stream.raw_buffer())


@contextmanager
def two_threads():
    """Within, Dr.Jit has two threads at least: with one, Mitsuba waits for ever at an EXR."""
    before = dr.thread_count()
    if before < 2:
        dr.set_thread_count(2)
    try:
        yield
    finally:
        if before < 2:
            dr.set_thread_count(before)


def check_output(path: Path, suffix: str) -> None:
    """Refuse an output that cannot or must not be written, before anything is rendered.

    That is one of another ``suffix``, one that cannot be written, and one that would overwrite an image of
    another format. The output's folder is made. With an EXR goes a PNG of its name, as from the command
    ``render``.
    """
    if suffix == ".exr":
        prepare_output(path)
        return
    if path.suffix.lower() != suffix:
        raise CommandError(f"output={str(path)!r} must end in {suffix}")
    check_format(path, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    check_writable(path)


def write_layers(path: Path, layers: dict, header: dict, dtype=np.float16):
    """An EXR of layers {prefix: (height, width, 3)}, written by `replacing`."""
    channels = {
        f"{layer}{c}": np.ascontiguousarray(pixels[..., i]).astype(dtype)
        for layer, pixels in layers.items()
        for i, c in enumerate("RGB")
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, OpenEXR.File(header, channels) as file:
        temporary.touch()  # OpenEXR does not say what hinders it
        file.write(str(temporary))
        try:
            read_layers(temporary, *layers)
        except CommandError as error:  # nor that a disk is full
            why = "could not be written whole; is the disk full?"
            raise OSError(errno.ENOSPC, why, str(path)) from error


def read_layers(path: Path, *layers: str):
    """Images (height, width, 3) of an EXR's layers, and its header.

    ``layers`` are the prefixes of `write_layers`. Raises ``CommandError`` for another file.
    """
    with path.open("rb") as file:  # OpenEXR does not say what hinders it
        start = file.read(4)
    if start != MAGIC[".exr"]:
        raise CommandError(f"{str(path)!r} is not an EXR")
    try:
        opened = OpenEXR.File(str(path), separate_channels=True)
    except (RuntimeError, ValueError) as error:
        raise CommandError(f"{str(path)!r} is damaged ({error}); delete it, to make it anew") from error
    with opened as file:
        try:
            channels, header = file.channels(), dict(file.header())
        except ValueError as error:  # of a file that ends in the middle
            raise CommandError(f"{str(path)!r} is damaged ({error}); delete it, to make it anew") from error
        missing = [f"{layer}{c}" for layer in layers for c in "RGB" if f"{layer}{c}" not in channels]
        if missing:
            raise CommandError(f"{str(path)!r} has no channel {missing[0]}; there are {sorted(channels)}")
        images = [np.stack([channels[f"{layer}{c}"].pixels for c in "RGB"], axis=-1) for layer in layers]
    return [image.astype(np.float64) for image in images], header
