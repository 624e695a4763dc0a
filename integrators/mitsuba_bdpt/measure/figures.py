"""Figures of a sweep, for print: PDF, SVG or PNG, one or two columns wide.

Text has 7 points at the width of a column of a journal, 8.5 cm, or of its page, 17.8 cm. An integrator has
its colour and marker in all panels; raw errors are solid, trimmed ones dashed; a hollow marker is a bound.
"""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ..errors import CommandError
from ..files.images import read_layers
from . import crops
from .analysis import Results, Unavailable
from .estimates import FEWEST_WITH_INTERVAL, KINDS, Error, has_interval
from .paper import PAPER, WIDTHS, check_figure, save
from .project import Project
from .reference import Reference
from .results import image_file, load

STYLES = (
    *(("#0072B2", "o"), ("#D55E00", "s"), ("#E69F00", "D"), ("#56B4E9", "v"), ("#009E73", "^")),
    *(("#CC79A7", "h"), ("#F0E442", "P"), ("#999999", "X"), ("#000000", "p"), ("#882255", "*")),
    *(("#117733", "<"), ("#332288", ">")),
)
"""Of integrators, in turn. Colours: M. Okabe, K. Ito, Color Universal Design, 2008; P. Tol, 2021."""

RAYS = {
    "camera": ("camera", "#0072B2", ""),
    "light": ("light", "#E69F00", "//"),
    "shadow_s1": ("visibility, s = 1", "#009E73", ".."),
    "shadow_t1": ("visibility, t = 1", "#D55E00", "xx"),
    "shadow_inner": ("visibility, s ≥ 2, t ≥ 2", "#CC79A7", "\\\\"),
}

PANELS = {1: 2, 2: 4}  # scenes side by side at most, by columns of a page

DASHES: dict[Error, object] = {"rel_mse": "-", "rel_mse_trimmed": (0, (3, 1.5))}
SLOPE = {"color": "black", "linestyle": (0, (1, 2)), "linewidth": 0.8}
AXES = {"seconds": "seconds", "spp": "samples per pixel"}


def style(methods: Sequence[str], method: str) -> dict:
    """Return colour and marker of one of the ``methods``."""
    colour, marker = STYLES[methods.index(method) % len(STYLES)]
    return {"color": colour, "marker": marker}


def convergence(
    results: Results, path: Path, columns: int = 2, scenes: Sequence[str] | None = None, against: str = "spp"
) -> None:
    """Plot relMSE over ``against``, "seconds" or "spp": a panel per scene.

    Means over seeds, raw (with the 95 % interval) and trimmed, over the median of the seconds; the dotted
    line has slope -1.
    """
    scenes = scenes or results.scenes
    across = min(PANELS[columns], len(scenes)) if len(scenes) > PANELS[1] or columns == 2 else 1
    rows, width = math.ceil(len(scenes) / across), WIDTHS[columns]
    high = max(0.82 * width / max(across, 2 * columns - 2), 1.5)
    with plt.rc_context(PAPER):
        size = width, high * rows
        figure, axes = plt.subplots(rows, across, figsize=size, squeeze=False, layout="constrained")
        for axis in axes.flat[len(scenes) :]:
            axis.set_axis_off()
        for i, (axis, scene) in enumerate(zip(axes.flat, scenes, strict=False)):
            _curves(axis, results, scene, against)
            axis.set_xlabel(AXES[against] if i + across >= len(scenes) else "")
            axis.set_ylabel("" if i % across else "relMSE")
        shown = [name for name in results.methods if any(len(results.of(scene, name)) for scene in scenes)]
        handles = _entries(results.methods, shown)
        kinds = {kind: DASHES[error] for error, kind in KINDS.items()}
        handles += [Line2D([], [], color="black", linestyle=dash, label=kind) for kind, dash in kinds.items()]
        handles.append(Line2D([], [], label="slope −1", **SLOPE))
        _legend(figure, handles)
        save(figure, path)


def _entries(methods: Sequence[str], shown: Sequence[str], before: str = "", **more) -> list[Line2D]:
    """Return the entries of integrators in a legend."""
    return [Line2D([], [], label=before + name, **style(methods, name) | more) for name in shown]


def _legend(figure, handles: Sequence) -> None:
    """Put a legend under the axes, as wide as fits; makes the figure higher."""
    width, height = figure.get_size_inches()
    for across in range(len(handles), 0, -1):
        legend = figure.legend(handles=handles, loc="outside lower center", ncols=across, labelspacing=0.3)
        extent = legend.get_window_extent()
        if extent.width <= figure.bbox.width or across == 1:
            break
        legend.remove()
    figure.set_size_inches(width, height + extent.height / figure.dpi + 0.05)


def _curves(axis, results: Results, scene: str, against: str) -> None:
    """Plot all integrators in a scene."""
    for method in results.methods:
        for error in reversed(KINDS):
            points = _points(results, scene, method, against, error)
            if points.empty:
                continue
            look = style(results.methods, method) | {"linestyle": DASHES[error]}
            if error == "rel_mse":
                axis.plot(points["x"], points["y"], **look)
                axis.fill_between(
                    points["x"], points["low"], points["high"], color=look["color"], alpha=0.18, linewidth=0
                )
                hollow = points[points["bound"] != ""]
                axis.plot(hollow["x"], hollow["y"], **look | {"linestyle": "", "markerfacecolor": "white"})
            else:  # a single point has no line
                axis.plot(points["x"], points["y"], **look | {"marker": "" if len(points) > 1 else "_"})
    axis.set(xscale="log", yscale="log", title=scene)
    if axis.lines:
        x, y = axis.lines[0].get_data()
        axis.plot([x[0], x[-1]], [y[0], y[0] * x[0] / x[-1]], zorder=1, **SLOPE)
    for one, (low, high) in ((axis.xaxis, axis.get_xlim()), (axis.yaxis, axis.get_ylim())):
        one.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
        one.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.10g}"))
        one.set_minor_formatter(NullFormatter())


def _points(results: Results, scene: str, method: str, against: str, error: Error) -> pd.DataFrame:
    """Return positive errors ``y`` over ``x`` by budget, with interval and bound."""
    points: list[dict[str, object]] = []
    groups = results.of(scene, method).groupby("budget")
    # Where time was too short for a second render, a single one would look as certain as the others.
    fewest = min(groups.size().max(), 2)
    for budget, rows in groups:
        found = results.error(scene, method, error, budget)
        total = found.total
        if len(rows) >= fewest and total.value > 0:
            ends = (total.low, total.high) if has_interval(total, found.count) else (math.nan, math.nan)
            point = {"x": rows[against].median(), "y": total.value, "low": ends[0], "high": ends[1]}
            points.append(point | {"bound": found.bound})
    numbers = dict.fromkeys(["x", "y", "low", "high"], float)
    return pd.DataFrame(points, columns=[*numbers, "bound"]).astype(numbers)


def efficiencies(results: Results, path: Path, columns: int = 2, scenes: Sequence[str] | None = None) -> None:
    """Plot efficiencies per scene, the first integrator's over each of its rivals.

    Median with its 95 % interval, of fewer than `FEWEST_WITH_INTERVAL` seeds their range; trimmed filled, raw
    hollow; arrows where a ratio is a bound.
    """
    scenes, rivals = scenes or results.scenes, results.rivals
    with plt.rc_context(PAPER):
        most = max(len(results.present(scene, rivals)) for scene in scenes)
        high = max((0.08 * max(most, 1) + 0.06) * len(scenes), 0.7)
        figure, axis = plt.subplots(figsize=(WIDTHS[columns], high + 0.4), layout="constrained")
        counts: set[int] = set()
        for place, scene in enumerate(scenes):
            if place % 2:
                axis.axhspan(place - 0.5, place + 0.5, color="#f3f3f3", zorder=0, linewidth=0)
            here = results.present(scene, rivals)
            for i, rival in enumerate(here):
                for j, error in enumerate(KINDS):
                    y = place + 0.8 * ((2 * i + j + 0.5) / (2 * len(here)) - 0.5)
                    counts |= _dot(axis, results, scene, rival, error, y)
        axis.axvline(1, color="black", linewidth=0.6)
        axis.set(xscale="log", xlabel=f"efficiency of {results.methods[0]}, {results.deciding} spp")
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.10g}x"))
        _name_scenes(axis, scenes)
        axis.grid(axis="x")
        axis.set_axisbelow(True)
        shown = [rival for rival in rivals if any(rival in results.present(s, rivals) for s in scenes)]
        handles = _entries(results.methods, shown, "over ", linestyle="")
        plain = {"color": "#666666", "linestyle": "", "marker": handles[0].get_marker() if handles else "o"}
        are_few = min(counts, default=FEWEST_WITH_INTERVAL) < FEWEST_WITH_INTERVAL
        interval = "95 % interval" + are_few * f" (range if n < {FEWEST_WITH_INTERVAL})"
        handles += [
            Line2D([], [], label=interval, color="#666666", linewidth=0.8),
            Line2D([], [], label="trimmed", **plain),
            Line2D([], [], label="raw", markerfacecolor="white", **plain),
        ]
        if axis.texts:
            arrows = plain | {"marker": "$\\leftrightarrow$", "markersize": 7}
            handles.append(Line2D([], [], label="at least, at most", **arrows))
        _legend(figure, handles)
        save(figure, path)


def _name_scenes(axis, scenes: Sequence[str]) -> None:
    """Name a row of the plot after each scene, the first on top."""
    axis.set_yticks(range(len(scenes)), scenes)
    axis.tick_params(axis="y", length=0)
    axis.set_ylim(len(scenes) - 0.5, -0.5)


def _dot(axis, results: Results, scene: str, rival: str, error: Error, y: float) -> set[int]:
    """Plot one efficiency at the height ``y``; return its number of seeds, if any."""
    try:
        ratio = results.efficiency(scene, rival, error)
    except Unavailable:
        return set()
    look = style(results.methods, rival)
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
        _name_scenes(axis, scenes)
        axis.set_xlabel(f"rays per camera subpath, {results.methods[0]}, {results.deciding} spp")
        _legend(figure, axis.get_legend_handles_labels()[0])
        save(figure, path)


def _rays_per_sample(results: Results, scene: str, kind: str) -> float:
    rows = results.of(scene, results.methods[0], results.deciding)
    counts = rows.get(f"rays_{kind}", pd.Series(dtype=float)) / rows["spp"] / (rows["width"] * rows["height"])
    return float(counts.median()) if counts.notna().any() else 0.0


PLOTS: dict[str, Callable[[Results, Path, int, Sequence[str]], None]] = {
    "samples": partial(convergence, against="spp"),
    "seconds": partial(convergence, against="seconds"),
    "efficiency": efficiencies,
    "rays": rays,
}
"""What the command `figure` draws, beside the images of ``crops``."""

# Options that plots lack.
NOT_FOR = {"windows": tuple(PLOTS), "integrators": ("rays",), "spp": ("samples", "seconds")}


def shots(folder: Path, results: Results, scene: str, methods: Sequence[str]) -> list[crops.Shot]:
    """Return renders of a scene at the deciding budget, where their image is there.

    Of each integrator the seed with the median trimmed error, with the seconds and errors of tables.
    """
    found: list[crops.Shot] = []
    for method in results.present(scene, methods, results.deciding):
        rows = results.of(scene, method, results.deciding).sort_values("rel_mse_trimmed", kind="stable")
        shown = rows.iloc[(len(rows) - 1) // 2]
        file = image_file(folder, shown)
        if file.exists():
            (image,), _ = read_layers(file, "")
            called = f"{method} (equal spp)" if method in results.at_equal_samples else method
            seconds, error = rows["seconds"].median(), results.error(scene, method)
            found.append(crops.Shot(called, shown["spp"], seconds, image, error))
    return found


def cropped(folder: Path, results: Results, kept: Reference, scene: str) -> crops.Block:
    """Return the `shots` of a scene, rivals first, and the reference."""
    found = shots(folder, results, scene, [*results.rivals, results.methods[0]])
    if not found:
        raise CommandError(f"{folder}: no image of {scene} is there; run the sweep again, which renders them")
    return crops.Block(scene, found, kept.image)


def _check_names(option: str, given: Sequence[str], known: Sequence[str]) -> None:
    if unknown := [name for name in given if name not in known]:
        raise CommandError(f"--{option} {unknown[0]}: not in the sweep, which has {', '.join(known)}")


def _among(results: Results, names: Sequence[str] | None) -> Results:
    """Return the results of the first and these integrators; None: all compared."""
    methods = results.rows["method"]
    if names is None:
        return replace(results, rows=results.rows[~methods.isin(results.aside)])
    _check_names("integrators", names, results.methods)
    return replace(results, rows=results.rows[methods.isin([results.methods[0], *names])], aside=())


def run(options: Namespace) -> int:
    """Draw the figure that the command-line ``options`` request."""
    project = Project(options.project)
    folder = project.results(options.folder)
    output = options.output or folder / f"{options.plot}.pdf"
    check_figure(output)
    for name, plots in NOT_FOR.items():
        if options.plot in plots and getattr(options, name):
            raise CommandError(f"--{name} is not for --plot {options.plot}; leave it out")
    results, made, _ = load(project, folder)
    results = replace(_among(results, options.integrators), compared=options.spp)
    _ = results.deciding  # raises for a budget that is not there
    _check_names("scenes", options.scenes or (), results.scenes)
    scenes = options.scenes or results.scenes
    if options.plot == "efficiency" and not results.has_efficiency(scenes):
        raise CommandError(
            f"{folder}: no efficiency can be computed, which takes a rival of {results.methods[0]} and two "
            "renders of each integrator; set seeds = 2 or more in the preset, and sweep again"
        )
    if options.plot == "crops":
        blocks = [cropped(folder, results, made[scene], scene) for scene in scenes]
        crops.draw(blocks, output, options.columns, crops.centres(options.windows))
    else:
        PLOTS[options.plot](results, output, options.columns, scenes)
    print(output)
    return 0
