"""The image of a render while it goes on: a PNG that is rewritten, the viewer tev."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..files.images import screen_image, write_png
from ..run.rendering import PassReport
from .tev import Tev

TEV_EVERY = 1.0
"""Seconds between two images for tev, at least."""


class Often:
    """Calls ``work(report)`` after the first pass, and after passes that end so many ``seconds`` later."""

    def __init__(self, seconds: float, work: Callable[[PassReport], None]):
        self._seconds, self._work, self._last = seconds, work, -float("inf")

    def __call__(self, report: PassReport) -> None:
        if time.monotonic() - self._last >= self._seconds:
            self._work(report)
            self._last = time.monotonic()


@contextmanager
def watchers(options: Namespace, film: mi.Film, output: Path):
    """What shows the image of a render into ``film`` as ``options`` say, a list of functions of a report."""
    found, tev = [], None
    if options.preview is not None:
        path = output.with_suffix(".png")
        found.append(Often(options.preview, lambda report: _rewrite(report, film, path, options.exposure)))
    if options.tev is not None:
        tev = Tev(*options.tev, output.name)
        found.append(Often(TEV_EVERY, lambda report: tev.show(_pixels(report, film))))
    try:
        yield found
    finally:
        if tev is not None:
            tev.close()


def _rewrite(report: PassReport, film: mi.Film, path: Path, exposure: float) -> None:
    """Put the image so far into the PNG. A full disk must not cost the render."""
    report.image()
    try:
        write_png(film, film.bitmap(), path, exposure)
    except OSError as error:
        print(f"warning: no preview {str(path)!r}: {error}", file=sys.stderr)


def _pixels(report: PassReport, film: mi.Film) -> np.ndarray:
    """The colours of the image so far, linear, shape (height, width, 3)."""
    report.image()
    shown = screen_image(film, film.bitmap())
    return np.array(shown.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
