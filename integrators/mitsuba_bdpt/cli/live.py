"""Previews during a render: a PNG that is rewritten."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi

from ..files.images import write_png
from ..run.rendering import PassReport


class Often:
    """Calls ``work(report)`` after the first pass, then at intervals of ``seconds``."""

    def __init__(self, seconds: float, work: Callable[[PassReport], None]):
        self._seconds, self._work, self._last = seconds, work, -float("inf")

    def __call__(self, report: PassReport) -> None:
        if time.monotonic() - self._last >= self._seconds:
            self._work(report)
            self._last = time.monotonic()


def watchers(options: Namespace, film: mi.Film, output: Path, least: int) -> list[Often]:
    """Return functions of a `PassReport` that show the image as ``options`` request.

    Previews replace the PNG from ``least`` samples per pixel on.
    """
    if options.preview is None:
        return []
    path = output.with_suffix(".png")

    def preview(report: PassReport) -> None:
        if report.spp_done >= least:
            _rewrite(report, film, path, options.exposure)

    return [Often(options.preview, preview)]


def _rewrite(report: PassReport, film: mi.Film, path: Path, exposure: float) -> None:
    """Write the image so far to the PNG; a full disk does not end the render."""
    report.image()
    try:
        write_png(film, film.bitmap(), path, exposure)
    except OSError as error:
        print(f"warning: no preview {str(path)!r}: {error}", file=sys.stderr)
