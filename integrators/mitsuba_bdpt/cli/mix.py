"""``python -m mitsuba_bdpt mix``: a new balance of light groups or path layers, without a render."""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import CommandError
from ..files.images import check_output, developed, grey, header_of, write_whole
from ..files.loading import set_variant
from ..files.mixing import described, mix
from ..files.whole import MAGIC
from ..image.layers import DENOISED


def run(options: Namespace) -> int:
    set_variant(options.variant)
    if not options.weights:
        print(described(options.image))
        return 0
    weights = dict(options.weights)
    if len(weights) < len(options.weights):
        raise CommandError(f"a layer of {', '.join(weights)} has two weights; give it one.")
    mixed = mix(options.image, weights)
    output: Path = options.output or options.image.with_suffix(".mixed.png")
    suffix = output.suffix.lower()
    if suffix not in MAGIC:
        raise CommandError(f"output={str(output)!r} must end in .png or .exr")
    rendered = {path.resolve() for path in (options.image, options.image.with_suffix(".png"))}
    if rendered & {path.resolve() for path in (output, output.with_suffix(".png"))}:
        raise CommandError(
            f"output={str(output)!r}: the mix would replace the render or its PNG; name another with -o."
        )
    check_output(output, suffix)
    if suffix == ".exr":
        write_whole(mixed, output, mi.Bitmap.FileFormat.OpenEXR)
    has_bands = mixed.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel
    png = developed(grey(np.array(mixed)) if has_bands else mixed, options.exposure)
    write_whole(png, output.with_suffix(".png"), mi.Bitmap.FileFormat.PNG)
    if set(DENOISED) <= {channel.name for channel in header_of(options.image)["channels"]}:
        print("note: the layers are not denoised: the mix has the noise of the render", file=sys.stderr)
    print(output)
    return 0
