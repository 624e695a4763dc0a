"""Figures of a sweep, for print: PDF, SVG or PNG by the file's ending, one or two columns wide.

Text has 7 points at the width of a column of a journal, 8.5 cm, or of its page, 17.8 cm. An integrator has
its colour and marker everywhere; raw errors are solid, trimmed ones dashed; a hollow marker is a bound.
"""

from __future__ import annotations

import math
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.path import Path as MarkerPath
from matplotlib.textpath import TextPath
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ..errors import CommandError
from ..files.images import read_layers
from . import crops
from .analysis import (
    ALONE,
    INDEPENDENT,
    LIGHT_TRACER,
    MEDIA_RIVALS,
    MERGING,
    NONE,
    RIVALS,
    UNAIMED,
    Results,
    Unavailable,
)
from .estimates import FEWEST_WITH_INTERVAL, Bound
from .paper import PAPER, WIDTHS, check_figure, save
from .project import Project
from .record import Error
from .reference import Reference
from .results import load
from .tables import has_interval

# Colours: M. Okabe, K. Ito, Color Universal Design, 2008.
STYLES = {
    "bdpt": ("#0072B2", "o"),
    NONE: ("#56B4E9", "v"),
    INDEPENDENT: ("#009E73", "^"),
    ALONE: ("#F0E442", "P"),
    UNAIMED: ("#999999", "X"),
    MERGING: ("#009E73", "D"),
    RIVALS[0]: ("#D55E00", "s"),
    RIVALS[1]: ("#E69F00", "D"),
    # Only in scenes with media.
    MEDIA_RIVALS[0]: ("#D55E00", "s"),
    MEDIA_RIVALS[1]: ("#E69F00", "D"),
    LIGHT_TRACER: ("#CC79A7", "h"),
}
PLAIN = (("#000000", "p"), ("#882255", "*"), ("#117733", "<"), ("#332288", ">"))
"""Of other integrators, in turn."""

RAYS = {
    "camera": ("camera", "#0072B2", ""),
    "light": ("light", "#E69F00", "//"),
    "shadow_s1": ("visibility, s = 1", "#009E73", ".."),
    "shadow_t1": ("visibility, t = 1", "#D55E00", "xx"),
    "shadow_inner": ("visibility, s ≥ 2, t ≥ 2", "#CC79A7", "\\\\"),
}

PANELS = {1: 2, 2: 4}
"""Scenes side by side, at most."""

DASHES = {"rel_mse": "-", "rel_mse_trimmed": (0, (3, 1.5))}
TWO_DASHES = MarkerPath([(-1, 0), (-0.25, 0), (0.25, 0), (1, 0)], [1, 2, 1, 2])
SLOPE = {"color": "black", "linestyle": (0, (1, 2)), "linewidth": 0.8}
KINDS: dict[Error, str] = {"rel_mse": "raw", "rel_mse_trimmed": "trimmed"}
AXES = {"seconds": "seconds", "spp": "samples per pixel"}
SHORT = 30.0  # ratio of the ends of a logarithmic axis
PAGE = 24.0  # cm, the height of the text on a journal's page
POINTS = 72.0  # of an inch
ENTRY = 5.0 * PAPER["legend.fontsize"]  # points beside the text of an entry of a legend: handle and gaps
LOWEST = 0.7  # inches of a plot of efficiencies
LINE = 0.13  # inches of a line of a legend


def style(methods: Sequence[str], method: str) -> dict:
    """Return colour and marker of one of the ``methods``."""
    others = [name for name in methods if name not in STYLES]
    colour, marker = STYLES[method] if method in STYLES else PLAIN[others.index(method) % len(PLAIN)]
    return {"color": colour, "marker": marker}


def convergence(
    results: Results, against: str, path: Path, columns: int = 2, scenes: Sequence[str] | None = None
) -> None:
    """Plot relMSE over ``against``, "seconds" or "spp", a panel per scene, raw and trimmed.

    Means over seeds, those of the report's tables, with the 95 % interval of the raw error, and the median of
    the seconds; the dotted line has slope -1. A single panel in two columns has the legend beside it.
    """
    scenes = scenes or results.scenes
    across = min(PANELS[columns], len(scenes)) if len(scenes) > PANELS[1] or columns == 2 else 1
    rows, width = math.ceil(len(scenes) / across), WIDTHS[columns]
    is_beside = columns == 2 and len(scenes) == 1
    high = max(0.82 * (WIDTHS[1] if is_beside else width / across), 1.5)
    with plt.rc_context(PAPER):
        figure, axes = plt.subplots(
            rows, across, figsize=(width, high * rows), squeeze=False, layout="constrained"
        )
        sloped = [
            _curves(axis, results, scene, against) for scene, axis in zip(scenes, axes.flat, strict=False)
        ]
        for axis in axes.flat[len(scenes) :]:
            axis.set_axis_off()
        for i, axis in enumerate(axes.flat[: len(scenes)]):
            if i + across >= len(scenes):
                axis.set_xlabel(AXES[against])
            if i % across == 0:
                axis.set_ylabel("relMSE")
        shown = [name for name in results.methods if any(results.of(scene, name) for scene in scenes)]
        handles = _entries(results.methods, shown)
        handles += [
            Line2D([], [], color="black", linestyle=DASHES[kind], label=text) for kind, text in KINDS.items()
        ]
        if any(sloped):
            handles.append(Line2D([], [], label="slope −1", **SLOPE))
        _legend(figure, handles, is_beside)
        save(figure, path)


def _entries(methods: Sequence[str], shown: Sequence[str], before: str = "", **more) -> list[Line2D]:
    """Return the entries of integrators in a legend: one of those that look alike, as in different scenes."""
    alike: dict[tuple, list[str]] = {}
    for name in shown:
        alike.setdefault(tuple(style(methods, name).items()), []).append(name)
    return [
        Line2D([], [], label=before + " / ".join(names), **dict(look) | more) for look, names in alike.items()
    ]


def _across(labels: Sequence[str], width: float) -> int:
    """Return how many columns of a legend fit into the ``width`` in inches."""
    sizes = [TextPath((0, 0), label, size=PAPER["legend.fontsize"]).get_extents().width for label in labels]

    def taken(across: int) -> float:
        columns = np.array_split(np.array(sizes), across)  # as Matplotlib fills them
        return sum(float(column.max()) + ENTRY for column in columns) / POINTS

    return max(n for n in range(1, len(labels) + 1) if n == 1 or taken(n) <= width)


def _legend(figure, handles: Sequence, is_beside: bool = False) -> None:
    """Put a legend under the axes, and make the figure higher by it, or beside them."""
    if is_beside:
        figure.legend(handles=handles, loc="outside right center")
        return
    width, height = figure.get_size_inches()
    across = _across([handle.get_label() for handle in handles], width)
    figure.set_size_inches(width, height + LINE * math.ceil(len(handles) / across) + 0.1)
    figure.legend(handles=handles, loc="outside lower center", ncols=across, labelspacing=0.3)


def _curves(axis, results: Results, scene: str, against: str) -> bool:
    """Plot all integrators in a scene; return whether there is a line of slope -1."""
    first = None
    for method in results.methods:
        for error in KINDS:
            points, bounds = _points(results, scene, method, against, error)
            if not len(points):
                continue
            look = style(results.methods, method) | {"linestyle": DASHES[error]}
            x, low, middle, high = points.T
            # A single point has no line: two dashes stand for a dashed one.
            dash = {"marker": TWO_DASHES, "markersize": 9} if len(points) == 1 else {"marker": ""}
            axis.plot(x, middle, **look | (dash if error != "rel_mse" else {}))
            if error == "rel_mse":
                axis.fill_between(x, low, high, color=look["color"], alpha=0.18, linewidth=0)
                hollow = np.array([bool(bound) for bound in bounds])
                axis.plot(x[hollow], middle[hollow], **look | {"linestyle": "", "markerfacecolor": "white"})
            first = points if first is None else first
    axis.set(xscale="log", yscale="log", title=scene)
    is_sloped = False
    if first is not None and len(first) > 1:
        is_sloped = True
        (x0, _, y0, _), (x1, _, _, _) = first[0], first[-1]
        axis.plot([x0, x1], [y0, y0 * x0 / x1], zorder=1, **SLOPE)
    for side in (axis.xaxis, axis.yaxis):
        _ticks(side)
    return is_sloped


def _ticks(side) -> None:
    """Label powers of ten of a logarithmic axis; where there are few, 2 and 5 times these too, or others."""
    low, high = side.get_view_interval()
    side.set_minor_formatter(NullFormatter())
    powers, fine = LogLocator(numticks=6), LogLocator(subs=(1.0, 2.0, 5.0), numticks=12)

    def several(locator) -> bool:
        return sum(low <= tick <= high for tick in locator.tick_values(low, high)) > 1

    if high >= SHORT * low and several(powers):
        side.set_major_locator(powers)
        return
    side.set_major_locator(fine if several(fine) else MaxNLocator(4, steps=[1, 2, 5, 10]))
    side.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.10g}"))


def _points(
    results: Results, scene: str, method: str, against: str, error: Error
) -> tuple[np.ndarray, list[Bound]]:
    """Return an integrator's points (n, 4) and their bounds.

    Abscissa, low end, mean and high end of positive errors; the ends are NaN without an interval.
    """
    points: list[list[float]] = []
    bounds: list[Bound] = []
    counts = Counter(row["budget"] for row in results.of(scene, method))
    # Where time was too short for a second render, a single one would look as certain as the others.
    several = [budget for budget in counts if counts[budget] > 1]
    for budget in sorted(several or counts):
        rows = results.of(scene, method, budget)
        found = results.error(scene, method, error, budget)
        total = found.total
        ends = [total.low, total.high] if has_interval(total, found.count) else [math.nan] * 2
        if total.value > 0:
            middle = float(np.median([row[against] for row in rows]))
            points.append([middle, ends[0], total.value, ends[1]])
            bounds.append(found.bound)
    order = np.argsort([point[0] for point in points])
    return np.array(points)[order] if points else np.empty((0, 4)), [bounds[i] for i in order]


def efficiencies(
    results: Results,
    rivals: Sequence[str],
    path: Path,
    columns: int = 2,
    scenes: Sequence[str] | None = None,
) -> None:
    """Plot efficiencies per scene, the first integrator's over each of the ``rivals``.

    Median with its 95 % interval, of fewer than `FEWEST_WITH_INTERVAL` seeds their range; trimmed filled, raw
    hollow; arrows where a ratio is a bound.
    """
    scenes = scenes or results.scenes
    with plt.rc_context(PAPER):
        most = max(len(_present(results, scene, rivals)) for scene in scenes)
        high = max((0.08 * max(most, 1) + 0.06) * len(scenes), LOWEST)
        figure, axis = plt.subplots(figsize=(WIDTHS[columns], high + 0.4), layout="constrained")
        counts: set[int] = set()
        for place, scene in enumerate(scenes):
            if place % 2:
                axis.axhspan(place - 0.5, place + 0.5, color="#f3f3f3", zorder=0, linewidth=0)
            here = _present(results, scene, rivals)
            for i, rival in enumerate(here):
                for j, error in enumerate(("rel_mse_trimmed", "rel_mse")):
                    y = place + 0.8 * ((2 * i + j + 0.5) / (2 * len(here)) - 0.5)
                    counts |= _dot(axis, results, scene, rival, error, y, style(results.methods, rival))
        axis.axvline(1, color="black", linewidth=0.6)
        axis.set(xscale="log", xlabel=f"efficiency of {results.methods[0]}, {results.deciding} spp")
        _ticks(axis.xaxis)
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.10g}x"))
        axis.set_yticks(range(len(scenes)), scenes)
        axis.tick_params(axis="y", length=0)
        axis.set_ylim(len(scenes) - 0.5, -0.5)
        axis.grid(axis="x")
        axis.set_axisbelow(True)
        shown = [rival for rival in rivals if any(results.of(scene, rival) for scene in scenes)]
        handles = _entries(results.methods, shown, "over ", linestyle="")
        plain = {"color": "#666666", "linestyle": "", "marker": handles[0].get_marker() if handles else "o"}
        handles += [
            Line2D([], [], label=_interval(counts), color="#666666", linewidth=0.8),
            Line2D([], [], label="trimmed", **plain),
            Line2D([], [], label="raw", markerfacecolor="white", **plain),
        ]
        if axis.texts:
            arrows = plain | {"marker": "$\\leftrightarrow$", "markersize": 7}
            handles.append(Line2D([], [], label="at least, at most", **arrows))
        _legend(figure, handles)
        save(figure, path)


def _present(results: Results, scene: str, rivals: Sequence[str]) -> list[str]:
    """Return the ``rivals`` that were rendered in a scene."""
    return [rival for rival in rivals if results.of(scene, rival)]


def _interval(counts: set[int]) -> str:
    """Name what lines of medians of these ``counts`` of seeds show: that of few is their range."""
    few = sorted(count for count in counts if count < FEWEST_WITH_INTERVAL)
    if not few:
        return "95 % interval"
    if len(few) < len(counts):
        return f"95 % interval; range if n < {FEWEST_WITH_INTERVAL}"
    return f"range of {few[0]} seeds" if len(few) == 1 else f"range of {few[0]} to {few[-1]} seeds"


def _dot(axis, results: Results, scene: str, rival: str, error: Error, y: float, look: dict) -> set[int]:
    """Plot one efficiency with its interval at the height ``y``; return its number of seeds, if any."""
    try:
        ratio = results.efficiency(scene, rival, error)
    except Unavailable:
        return set()
    face = look["color"] if error == "rel_mse_trimmed" else "white"
    axis.plot([ratio.low, ratio.high], [y, y], color=look["color"], linewidth=0.8)
    axis.plot(ratio.median, y, **look | {"markerfacecolor": face, "linestyle": "", "markeredgewidth": 0.6})
    arrow = {"arrowstyle": "<|-", "color": look["color"], "linewidth": 0.6, "mutation_scale": 4}
    for bounds, end, away in (("≥~", ratio.high, 5), ("≤~", ratio.low, -5)):
        if ratio.bound and ratio.bound in bounds:
            axis.annotate("", (end, y), xytext=(away, 0), textcoords="offset points", arrowprops=arrow)
    return {ratio.count}


def rays(results: Results, path: Path, columns: int = 2, scenes: Sequence[str] | None = None) -> None:
    """Plot rays per sample of the first integrator by kind, a bar per scene."""
    scenes = scenes or results.scenes
    with plt.rc_context(PAPER):
        figure, axis = plt.subplots(figsize=(WIDTHS[columns], 0.17 * len(scenes) + 0.4), layout="constrained")
        left = np.zeros(len(scenes))
        for kind, (label, colour, hatch) in RAYS.items():
            widths = np.array([_rays_per_sample(results, scene, kind) for scene in scenes])
            look = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0.3, "label": label}
            axis.barh(range(len(scenes)), widths, left=left, **look)
            left += widths
        axis.set_yticks(range(len(scenes)), scenes)
        axis.tick_params(axis="y", length=0)
        axis.set_ylim(len(scenes) - 0.5, -0.5)
        axis.set_xlabel(f"rays per camera subpath, {results.methods[0]}, {results.deciding} spp")
        _legend(figure, axis.get_legend_handles_labels()[0])
        save(figure, path)


def _rays_per_sample(results: Results, scene: str, kind: str) -> float:
    rows = results.of(scene, results.methods[0], results.deciding)
    rows = [row for row in rows if row.get(f"rays_{kind}") is not None]
    pixels = [row["width"] * row["height"] for row in rows]
    counts = [row[f"rays_{kind}"] / row["spp"] / n for row, n in zip(rows, pixels, strict=True)]
    return float(np.median(counts)) if counts else 0.0


PLOTS: dict[str, Callable[[Results, Path, int, Sequence[str]], None]] = {
    "samples": lambda results, path, columns, scenes: convergence(results, "spp", path, columns, scenes),
    "seconds": lambda results, path, columns, scenes: convergence(results, "seconds", path, columns, scenes),
    "efficiency": lambda results, path, columns, scenes: efficiencies(
        results, results.rivals, path, columns, scenes
    ),
    "rays": rays,
}
"""What the command `figure` draws, beside the images of ``crops``."""


def cropped(folder: Path, results: Results, kept: Reference, scene: str) -> crops.Block:
    """Return images of a scene at the deciding budget, rivals first, and the reference.

    Each integrator's image is of the seed with the median trimmed error. Captions have the median seconds and
    the trimmed relMSE of all seeds, those of the tables, and say which integrators have equal samples in
    place of equal time.
    """
    columns: list[crops.Column] = []
    for method in [*results.rivals, results.methods[0]]:
        rows = sorted(results.of(scene, method, results.deciding), key=lambda row: row["rel_mse_trimmed"])
        shown = rows[(len(rows) - 1) // 2] if rows else None
        file = folder / "images" / scene / f"{shown['key']}.exr" if shown else None
        if shown is None or file is None or not file.exists():
            continue
        (image,), _ = read_layers(file, "")
        called = f"{method} (equal spp)" if method in results.at_equal_samples else method
        seconds = float(np.median([row["seconds"] for row in rows]))
        error = results.error(scene, method)
        columns.append(crops.judged(called, shown["spp"], seconds, error, image, kept.image))
    if not columns:
        raise CommandError(f"{folder}: no image of {scene} is there; run the sweep again, which renders them")
    return crops.Block(scene, tuple(columns), kept.image)


def _among(results: Results, names: Sequence[str] | None) -> Results:
    """Return the results of the first integrator and of these others; None: all that are compared."""
    if names is None:
        return replace(results, rows=[row for row in results.rows if row["method"] not in results.aside])
    for name in names:
        if name not in results.methods:
            raise CommandError(
                f"--integrators {name}: not in the sweep, which has {', '.join(results.methods)}"
            )
    kept = {results.methods[0], *names}
    return replace(results, rows=[row for row in results.rows if row["method"] in kept], aside=())


def run(options: Namespace) -> int:
    """Draw the figure that the command-line ``options`` request."""
    project = Project(options.project)
    folder = project.results(options.folder)
    output = options.output or folder / f"{options.plot}.pdf"
    check_figure(output)
    if options.windows and options.plot != "crops":
        raise CommandError(f"--windows is for --plot crops, not for {options.plot}; leave it out")
    if options.integrators and options.plot == "rays":
        raise CommandError("--integrators is not for --plot rays, which is of the first one; leave it out")
    if options.spp and options.plot in ("samples", "seconds"):
        raise CommandError(f"--spp is not for --plot {options.plot}, which has all budgets; leave it out")
    results, made = load(project, folder)
    results = replace(_among(results, options.integrators), compared=options.spp)
    _ = results.deciding  # raises for a budget that is not there
    for scene in options.scenes or ():
        if scene not in results.scenes:
            raise CommandError(f"--scenes {scene}: not in the sweep, which has {', '.join(results.scenes)}")
    if options.plot == "efficiency" and not results.rivals:
        raise CommandError(f"{folder} has no other integrator than {results.methods[0]} to compare with")
    scenes = options.scenes or results.scenes
    if options.plot == "efficiency" and not results.has_efficiency(scenes):
        raise CommandError(
            f"{folder}: no efficiency can be computed, which takes two renders of each integrator; set "
            "seeds = 2 or more in the preset and sweep again, which renders the others"
        )
    if options.plot == "crops":
        blocks = [cropped(folder, results, made[scene], scene) for scene in scenes]
        tall = 2.54 * crops.draw(blocks, output, options.columns, crops.centres(options.windows))
        if tall > PAGE:
            print(
                f"warning: {output} is {tall:.0f} cm tall, more than the text on a journal's page (about "
                f"{PAGE:g} cm): draw fewer scenes by --scenes, such as --scenes {scenes[0]!r}"
            )
    else:
        PLOTS[options.plot](results, output, options.columns, scenes)
    print(output)
    return 0
