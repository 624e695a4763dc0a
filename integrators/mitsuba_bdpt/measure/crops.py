"""Images for print side by side, with magnified windows and error maps."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import SubFigure
from matplotlib.patches import Rectangle

from ..errors import CommandError
from .estimates import RelativeError
from .metrics import exposure_of, relative_errors, tone_map
from .paper import PAPER, WIDTHS, save

WINDOW = 6  # side of a window: this fraction of the image's
COLOURS = ("#E69F00", "#56B4E9")  # of the two windows
ERRORS = {"norm": LogNorm(1e-5, 10, clip=True), "cmap": "viridis"}

GAP, LINE, CHARACTER = 0.03, 0.105, 0.052  # inches between images, per line of text, and across
SCALE = 0.48  # inches of the scale of errors
SMALL = 6  # points

Window = tuple[int, int, int]  # left, top, side in pixels


@dataclass(frozen=True)
class Shot:
    """A render: integrator, samples per pixel, seconds, image, trimmed relMSE."""

    name: str
    spp: int
    seconds: float
    image: np.ndarray
    error: RelativeError

    @property
    def rel_mse(self) -> float:
        """The trimmed relMSE, less the reference's own where that is known."""
        return self.error.total.value

    @property
    def caption(self) -> str:
        error = f"{self.error.bound} {self.rel_mse:.2g}".lstrip()
        return f"{self.name}\n{self.spp} spp, {self.seconds:.2g} s\nrelMSE {error} (trimmed)"


@dataclass(frozen=True)
class Block:
    """The renders of a scene, and its reference ``target``."""

    title: str
    shots: Sequence[Shot]
    target: np.ndarray

    def errors(self, i: int) -> np.ndarray:
        """Return the squared relative errors of a render's pixels, (height, width)."""
        return relative_errors(self.shots[i].image, self.target).mean(axis=-1)


def _side(height: int, width: int) -> int:
    """Return the side of a window in an image."""
    return max(4, min(height, width) // WINDOW)


def windows(first: np.ndarray, last: np.ndarray) -> list[Window]:
    """Return two disjoint windows of the largest differences of two images of errors.

    At least a side apart, where the image has the room. Compares logarithms, so that no single pixel decides.
    """
    side = _side(*first.shape)
    difference = np.abs(np.log10(first + 1e-4) - np.log10(last + 1e-4))
    sums = np.pad(difference.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    score = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    chosen: list[Window] = []
    for _ in COLOURS:
        for left, top, _ in chosen:
            # Neighbours would show the same: they come after all others, and what overlaps never.
            far = 2 * side
            score[max(0, top - far + 1) : top + far, max(0, left - far + 1) : left + far] -= score.max() + 1
            score[max(0, top - side + 1) : top + side, max(0, left - side + 1) : left + side] = -np.inf
        top, left = (int(i) for i in np.unravel_index(np.argmax(score), score.shape))
        chosen.append((left, top, side))
    return chosen


def centres(given: Sequence[str] | None) -> list[tuple[float, float]] | None:
    """Parse the centres of two windows, "X,Y" in shares of the image; None: automatic."""
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


def _around(places: Sequence[tuple[float, float]], height: int, width: int) -> list[Window]:
    """Return windows about these places, within the image."""
    side = _side(height, width)

    def start(share: float, size: int) -> int:
        return min(max(round(share * size - side / 2), 0), size - side)

    return [(start(x, width), start(y, height), side) for x, y in places]


def draw(
    blocks: Sequence[Block], file: Path, columns: int, places: Sequence[tuple[float, float]] | None = None
) -> None:
    """Draw the ``blocks`` under each other, ``columns`` (1 or 2) wide.

    A column per image, the reference last. ``places``: centres of windows; None: where errors differ most.
    """
    rows = [_heights(block, WIDTHS[columns]) for block in blocks]
    heights = [sum(row) + len(row) * GAP for row in rows]
    with plt.rc_context(PAPER):
        figure = plt.figure(figsize=(WIDTHS[columns], sum(heights)))
        parts = figure.subfigures(len(blocks), 1, height_ratios=heights, squeeze=False)[:, 0]
        for part, block, row in zip(parts, blocks, rows, strict=True):
            if places is None:
                chosen = windows(block.errors(0), block.errors(-1))
            else:
                chosen = _around(places, *block.target.shape[:2])
            _block(part, block, row, chosen)
        save(figure, file)


def _captions(block: Block, wide: float) -> list[str]:
    """Return the captions, wrapped to an image's width in a block of ``wide`` inches."""
    every = [*(re.sub(r"(?<=\d) ", "\u00a0", shot.caption) for shot in block.shots), "reference"]
    most = max(int((wide / len(every) - GAP) / CHARACTER), 8)
    return ["\n".join(textwrap.fill(line, most) for line in caption.split("\n")) for caption in every]


def _heights(block: Block, wide: float) -> list[float]:
    """Return the heights in inches of title and captions, images, windows, errors."""
    width = wide / (len(block.shots) + 1) - GAP
    height = width * block.target.shape[0] / block.target.shape[1]
    lines = max(text.count("\n") for text in _captions(block, wide)) + 1
    return [LINE * (lines + 1.6), height, (width - GAP) / 2, max(height, SCALE)]


def _block(figure: SubFigure, block: Block, heights: Sequence[float], chosen: Sequence[Window]) -> None:
    """Draw a block, with these windows, in rows of these ``heights``."""
    exposure = exposure_of(block.target)
    wide, tall = figure.bbox.width / figure.dpi, figure.bbox.height / figure.dpi
    images = [*(shot.image for shot in block.shots), block.target]
    grid = figure.add_gridspec(
        *(len(heights), 2 * len(images)),
        height_ratios=heights,
        left=GAP / 2 / wide,
        right=1 - GAP / 2 / wide,
        bottom=GAP / tall,
        top=1,
        wspace=GAP / (wide / len(images) / 2 - GAP),
        hspace=GAP / np.mean(heights),
    )
    figure.text(GAP / wide, 1 - 0.2 * LINE / tall, block.title, va="top", weight="bold")
    for i, (image, caption) in enumerate(zip(images, _captions(block, wide), strict=True)):
        place = slice(2 * i, 2 * i + 2)
        shown = tone_map(image, exposure)
        axis = figure.add_subplot(grid[1, place])
        axis.imshow(shown, interpolation="nearest", aspect="auto")
        axis.set_axis_off()
        axis.set_title(caption, loc="left", fontsize=SMALL, pad=2)
        for j, ((x, up, side), colour) in enumerate(zip(chosen, COLOURS, strict=True)):
            frame = {"edgecolor": colour, "facecolor": "none", "linewidth": 0.8}
            axis.add_patch(Rectangle((x - 0.5, up - 0.5), side, side, **frame))
            part = figure.add_subplot(grid[2, 2 * i + j], xticks=[], yticks=[])
            part.imshow(shown[up : up + side, x : x + side], interpolation="nearest", aspect="auto")
            part.spines[:].set(color=colour, linewidth=0.8)
        axis = figure.add_subplot(grid[3, place])
        axis.set_axis_off()
        if i < len(block.shots):
            axis.imshow(block.errors(i), interpolation="nearest", aspect="auto", **ERRORS)
            continue
        where = axis.inset_axes((0.08, 1 - 0.1 / heights[3], 0.84, 0.07 / heights[3]))
        bar = figure.colorbar(ScalarMappable(**ERRORS), cax=where, orientation="horizontal")
        bar.set_label("squared\nrelative error", fontsize=SMALL, labelpad=0)
        bar.set_ticks([1e-4, 1])
        bar.ax.tick_params(labelsize=SMALL, pad=1, length=2)
        bar.ax.minorticks_off()
