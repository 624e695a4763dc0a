"""Figures for print: widths, type sizes, and the file formats PDF, SVG and PNG."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from ..errors import CommandError
from ..files.images import check_output
from ..files.whole import replacing
from .options import FIGURE_FORMATS

WIDTHS = {1: 8.5 / 2.54, 2: 17.8 / 2.54}  # inches, by columns of a page
DPI = 200  # of PNG
PAPER = {
    "font.size": 7,
    "axes.titlesize": 7,
    "axes.labelsize": 7,
    "xtick.labelsize": 6,
    "ytick.labelsize": 6,
    "legend.fontsize": 6.5,
    "legend.frameon": False,
    "axes.linewidth": 0.5,
    "grid.linewidth": 0.3,
    "lines.linewidth": 1.0,
    "lines.markersize": 3.2,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "mitsuba-bdpt",
}


def save(figure, path: Path) -> None:
    """Write a figure in the file's format; the same figure gives the same bytes."""
    kind = path.suffix[1:].lower()
    none = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format=kind, metadata=none[kind])
    plt.close(figure)


def check_figure(output: Path) -> None:
    """Raise ``CommandError`` if a figure cannot be written into this file."""
    if output.suffix.lower() not in FIGURE_FORMATS:
        raise CommandError(f"output={str(output)!r} must end in {', '.join(FIGURE_FORMATS)}")
    check_output(output, output.suffix.lower())
