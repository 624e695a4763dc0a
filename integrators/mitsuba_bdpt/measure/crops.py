"""Images side by side for print: whole images, magnified windows, false colours of the errors."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..errors import CommandError
from .estimates import RelativeError
from .metrics import rel_mse_epsilon, tone_map
from .paper import PAPER, WIDTHS, save
from .tables import brief

WINDOW = 6  # side of a window: this fraction of the image's
COLOURS = ("#E69F00", "#56B4E9")  # of the two windows
ERRORS = {"norm": LogNorm(1e-5, 10), "cmap": "viridis"}

GAP, LINE = 0.03, 0.105  # inches between images, and per line of text
SCALE = 0.48  # inches of the scale of errors, with its labels in two lines
CHARACTER = 0.052  # inches
NARROW = 0.75  # inches of an image below which the scale of errors has two labels
SMALL = 6  # points


@dataclass(frozen=True)
class Column:
    """An image with its ``caption``, a text per line, and its squared relative ``errors`` (height, width)."""

    image: np.ndarray
    caption: tuple[str, ...]
    errors: np.ndarray


@dataclass(frozen=True)
class Block:
    """The images of a scene, and its reference ``target``."""

    title: str
    columns: tuple[Column, ...]
    target: np.ndarray


def judged(
    name: str, spp: int, seconds: float, error: RelativeError, image: np.ndarray, target: np.ndarray
) -> Column:
    """Return the column of a render, with its errors against ``target``.

    ``error``: the trimmed relMSE that its caption has, that of the tables of reports.
    """
    errors = ((image - target) ** 2 / (target**2 + rel_mse_epsilon(target))).mean(axis=-1)
    figure = f"relMSE {brief(error)} (trimmed)"
    return Column(image, (name, f"{spp} spp, {seconds:.2g} s", figure), errors)


def _side(height: int, width: int) -> int:
    """Return the side of a window in an image."""
    return max(4, min(height, width) // WINDOW)


def windows(first: np.ndarray, last: np.ndarray) -> list[tuple[int, int, int]]:
    """Return two disjoint windows (left, top, side) of the largest differences of two images of errors.

    At least a side apart, where the image has the room. Compares logarithms, so that no single pixel decides.
    """
    height, width = first.shape
    side = _side(height, width)
    difference = np.abs(np.log10(first + 1e-4) - np.log10(last + 1e-4))
    sums = np.pad(difference.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    score = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    chosen: list[tuple[int, int, int]] = []
    for _ in COLOURS:
        for left, top, _ in chosen:
            # Neighbours would show the same: they come after all others, and what overlaps never.
            far = 2 * side
            score[max(0, top - far + 1) : top + far, max(0, left - far + 1) : left + far] -= score.max() + 1
            score[max(0, top - side + 1) : top + side, max(0, left - side + 1) : left + side] = -np.inf
        top, left = (int(i) for i in np.unravel_index(np.argmax(score), score.shape))
        chosen.append((left, top, side))
    return chosen


@dataclass(frozen=True)
class _Layout:
    """Sizes of a block in inches: width and height of an image, lines of captions."""

    width: float
    height: float
    captions: tuple[str, ...]
    lines: int

    @staticmethod
    def of(block: Block, wide: float) -> _Layout:
        count = len(block.columns) + 1
        width = (wide - (count + 1) * GAP) / count
        most = max(int(width / CHARACTER), 8)
        captions = [*(column.caption for column in block.columns), ("reference",)]
        captions = [[_kept_together(line) for line in one] for one in captions]
        wrapped = ["\n".join(textwrap.fill(line, most) for line in one) for one in captions]
        lines = max(text.count("\n") for text in wrapped) + 1
        return _Layout(width, width * block.target.shape[0] / block.target.shape[1], tuple(wrapped), lines)

    @property
    def window(self) -> float:
        return (self.width - GAP) / 2

    @property
    def head(self) -> float:
        """Title and captions."""
        return LINE * (self.lines + 1.6)

    @property
    def whole(self) -> float:
        return self.head + self.height + self.window + max(self.height, SCALE) + 3 * GAP


def _kept_together(line: str) -> str:
    """Return a line of a caption in which a number stays in one line with its unit, and with its bound."""
    return re.sub(r"([≤≥~]) (?=\d)", "\\1\u00a0", re.sub(r"(\d) (s|spp)\b", "\\1\u00a0\\2", line))


def centres(given: Sequence[str] | None) -> list[tuple[float, float]] | None:
    """Return the centres of two windows, from texts "X,Y" in shares of the image; None: to be chosen."""
    if given is None:
        return None
    found: list[tuple[float, float]] = []
    for text in given:
        try:
            x, y = (float(part) for part in text.split(","))
        except ValueError:
            x = y = math.nan
        if not (0 <= x <= 1 and 0 <= y <= 1):
            raise CommandError(
                f"windows={text!r} must be X,Y, shares of the image from 0 to 1, such as 0.5,0.3"
            )
        found.append((x, y))
    if len(found) != len(COLOURS):
        raise CommandError(f"windows={' '.join(given)!r} must be {len(COLOURS)} places X,Y")
    return found


def _around(places: Sequence[tuple[float, float]], height: int, width: int) -> list[tuple[int, int, int]]:
    """Return windows (left, top, side) about these places, within the image."""
    side = _side(height, width)

    def start(share: float, size: int) -> int:
        return min(max(round(share * size - side / 2), 0), size - side)

    return [(start(x, width), start(y, height), side) for x, y in places]


def draw(
    blocks: Sequence[Block], file: Path, columns: int, places: Sequence[tuple[float, float]] | None = None
) -> float:
    """Draw the ``blocks`` under each other, ``columns`` (1 or 2) wide; return the height in inches.

    In each, a column per image, the reference last: image, windows, errors in false colours. ``places``:
    centres of the windows, see `centres`; None: where errors differ most.
    """
    wide = WIDTHS[columns]
    layouts = [_Layout.of(block, wide) for block in blocks]
    tall = sum(layout.whole for layout in layouts)
    with plt.rc_context(PAPER):
        figure = plt.figure(figsize=(wide, tall))
        top = tall
        for block, layout in zip(blocks, layouts, strict=True):
            if places is None:
                chosen = windows(block.columns[0].errors, block.columns[-1].errors)
            else:
                chosen = _around(places, *block.target.shape[:2])
            _block(figure, block, layout, top, chosen)
            top -= layout.whole
        save(figure, file)
    return tall


def _axis(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Add axes without ticks at a place in inches from the top left."""
    wide, tall = figure.get_size_inches()
    axis = figure.add_axes((left / wide, (top - height) / tall, width / wide, height / tall))
    axis.set(xticks=[], yticks=[])
    return axis


def _block(
    figure: Figure, block: Block, layout: _Layout, top: float, chosen: Sequence[tuple[int, int, int]]
) -> None:
    """Draw a block below the height ``top``, with these windows."""
    wide, tall = figure.get_size_inches()
    exposure = math.log2(0.9 / max(float(np.quantile(block.target.max(axis=-1), 0.95)), 1e-9))
    figure.text(GAP / wide, (top - 0.2 * LINE) / tall, block.title, va="top", weight="bold")
    images = [*(column.image for column in block.columns), block.target]
    errors = [*(column.errors for column in block.columns), None]
    for i, (image, error, caption) in enumerate(zip(images, errors, layout.captions, strict=True)):
        left = GAP + i * (layout.width + GAP)
        y = top - layout.head
        figure.text(left / wide, (y + 0.3 * LINE) / tall, caption, fontsize=SMALL, va="bottom")
        shown = tone_map(image, exposure)
        axis = _axis(figure, left, y, layout.width, layout.height)
        axis.imshow(shown, interpolation="nearest", aspect="auto")
        axis.set_axis_off()
        y -= layout.height + GAP
        for j, ((x, up, side), colour) in enumerate(zip(chosen, COLOURS, strict=True)):
            frame = {"edgecolor": colour, "facecolor": "none", "linewidth": 0.8}
            axis.add_patch(Rectangle((x - 0.5, up - 0.5), side, side, **frame))
            part = _axis(figure, left + j * (layout.window + GAP), y, layout.window, layout.window)
            part.imshow(shown[up : up + side, x : x + side], interpolation="nearest", aspect="auto")
            for spine in part.spines.values():
                spine.set(color=colour, linewidth=0.8)
        y -= layout.window + GAP
        if error is None:
            _bar(figure, left, y, layout)
        else:
            axis = _axis(figure, left, y, layout.width, layout.height)
            axis.imshow(
                np.maximum(error, ERRORS["norm"].vmin), interpolation="nearest", aspect="auto", **ERRORS
            )
            axis.set_axis_off()


def _bar(figure: Figure, left: float, top: float, layout: _Layout) -> None:
    """Draw the scale of the errors in the place below the reference."""
    axis = _axis(figure, left + 0.08 * layout.width, top - GAP, 0.84 * layout.width, 0.07)
    bar = figure.colorbar(ScalarMappable(**ERRORS), cax=axis, orientation="horizontal")
    between = " " if layout.width > 1 else "\n"
    bar.set_label(f"squared{between}relative error", fontsize=SMALL, labelpad=0)
    bar.set_ticks([1e-4, 1e-2, 1] if layout.width > NARROW else [1e-4, 1])
    bar.ax.tick_params(labelsize=SMALL, pad=1, length=2)
    bar.ax.minorticks_off()
