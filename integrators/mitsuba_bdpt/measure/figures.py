"""Plots of a sweep, readable in print: each integrator has its marker and dash."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FuncFormatter, NullFormatter

from .analysis import (
    ALONE,
    INDEPENDENT,
    LIGHT_TRACER,
    MEDIA_RIVALS,
    MERGING,
    NONE,
    RIVALS,
    UNAIMED,
    Refused,
    Results,
    select,
)

# Colours: M. Okabe, K. Ito, Color Universal Design, 2008.
STYLES = {
    "bdpt": ("#0072B2", "o", "-"),
    NONE: ("#56B4E9", "v", "--"),
    INDEPENDENT: ("#009E73", "^", ":"),
    ALONE: ("#F0E442", "P", "-."),
    UNAIMED: ("#999999", "X", "--"),
    MERGING: ("#009E73", "D", "-"),
    RIVALS[0]: ("#D55E00", "s", "-"),
    RIVALS[1]: ("#E69F00", "D", "--"),
    # Only in scenes with media.
    MEDIA_RIVALS[0]: ("#D55E00", "s", "-"),
    MEDIA_RIVALS[1]: ("#E69F00", "D", "--"),
    LIGHT_TRACER: ("#CC79A7", "x", ":"),
}
PLAIN = ("#000000", ".", "-")
RAYS = {
    "camera": ("camera", "#0072B2", ""),
    "light": ("light", "#E69F00", "//"),
    "shadow_s1": ("visibility, s = 1", "#009E73", ".."),
    "shadow_t1": ("visibility, t = 1", "#D55E00", "xx"),
    "shadow_inner": ("visibility, s ≥ 2, t ≥ 2", "#CC79A7", "\\\\"),
}
ERRORS = {"rel_mse_trimmed": ("trimmed", "#0072B2", "o"), "rel_mse": ("raw", "#D55E00", "s")}
COLUMNS = 4
WIDEST = 100.0


def style(method: str) -> dict:
    """Return colour, marker and dash of an integrator."""
    colour, marker, dash = STYLES.get(method, PLAIN)
    return {"color": colour, "marker": marker, "linestyle": dash, "markersize": 4, "linewidth": 1.2}


def convergence(results: Results, against: str, path: Path):
    """Plot relMSE over ``against``, "seconds" or "spp", a panel per scene.

    Means over seeds with 95 % intervals; hollow where the figure is a bound; the dotted line has slope -1.
    """
    rows = math.ceil(len(results.scenes) / COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(11, 2.5 * rows), squeeze=False)
    for scene, axis in zip(results.scenes, axes.flat, strict=False):
        for method in results.methods:
            _curve(axis, results, scene, method, against)
        _ideal(axis, results, scene, against)
        axis.set(xscale="log", yscale="log")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.set_title(scene, fontsize=9)
        axis.tick_params(labelsize=7)
    for axis in axes.flat[len(results.scenes) :]:
        axis.set_axis_off()
    handles = {label: h for a in axes.flat for h, label in zip(*a.get_legend_handles_labels(), strict=True)}
    figure.supxlabel({"seconds": "seconds", "spp": "samples per pixel"}[against], fontsize=10)
    figure.supylabel("relMSE, raw", fontsize=10)
    figure.tight_layout()
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        ncols=4,
        fontsize=9,
        frameon=False,
    )
    _save(figure, path)


def _curve(axis, results, scene, method, against):
    points = []
    for budget in sorted({row["budget"] for row in results.of(scene, method)}):
        found = results.error(scene, method, "rel_mse", budget)
        if found.total.value > 0:
            x = np.median([row[against] for row in results.of(scene, method, budget)])
            points.append(
                [x, found.total.low, found.total.value, min(found.total.high, WIDEST * found.total.value)]
            )
            if found.bound:
                axis.plot(*points[-1][:3:2], **style(method) | {"markerfacecolor": "white", "zorder": 3})
    if points:
        x, low, middle, high = np.array(points).T
        axis.plot(x, middle, label=method, **style(method))
        axis.fill_between(x, low, high, color=style(method)["color"], alpha=0.15, linewidth=0)


def _ideal(axis, results, scene, against):
    """Draw a line of slope -1 through the first integrator's first error."""
    rows = results.of(scene, results.methods[0])
    budgets = sorted({row["budget"] for row in rows})
    if not budgets:
        return
    y0 = results.error(scene, results.methods[0], "rel_mse", budgets[0]).total.value
    x0, x1 = (np.median([row[against] for row in select(rows, budget=b)]) for b in (budgets[0], budgets[-1]))
    if y0 > 0:
        axis.plot([x0, x1], [y0, y0 * x0 / x1], color="black", linestyle=(0, (1, 2)), linewidth=0.8)
        axis.text(x1, y0 * x0 / x1, " −1", fontsize=7, va="center")


def efficiencies(results: Results, rivals: Sequence[str], path: Path):
    """Plot the ratio of efficiencies per scene, median and range, trimmed and raw.

    Hollow where a figure is a bound.
    """
    figure, axes = plt.subplots(1, len(rivals), figsize=(11, 0.28 * len(results.scenes) + 1.2), sharey=True)
    for rival, axis in zip(rivals, np.atleast_1d(axes), strict=True):
        for place, scene in enumerate(results.scenes):
            _ratios(axis, results, scene, rival, place)
        axis.axvline(1, color="black", linewidth=0.8)
        axis.set(xscale="log", title=f"efficiency over {rival}, {results.deciding} spp")
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}x"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.title.set_fontsize(10)
        axis.set_yticks(range(len(results.scenes)), results.scenes, fontsize=8)
        axis.set_ylim(len(results.scenes) - 0.5, -0.5)
        axis.grid(axis="x", linewidth=0.3)
        handles, labels = axis.get_legend_handles_labels()
        unique = dict(zip(labels, handles, strict=True))
        axis.legend(unique.values(), unique.keys(), fontsize=8, loc="lower right")
    figure.tight_layout()
    _save(figure, path)


def _ratios(axis, results, scene, rival, place):
    """Plot a scene's efficiencies over a rival at ``place``."""
    if not results.of(scene, rival):
        return
    for (error, (label, colour, marker)), y in zip(ERRORS.items(), (place - 0.15, place + 0.15), strict=True):
        try:
            ratio = results.efficiency(scene, rival, error)
        except Refused:
            continue
        axis.plot([ratio.smallest, ratio.largest], [y, y], color=colour, linewidth=1.5)
        face = "white" if ratio.bound else colour
        axis.plot(
            ratio.median,
            y,
            marker=marker,
            color=colour,
            markerfacecolor=face,
            markersize=4,
            linestyle="none",
            label=label,
        )


def rays(results: Results, path: Path):
    """Plot rays per sample of the first integrator by kind, a bar per scene."""
    figure, axis = plt.subplots(figsize=(9, 0.28 * len(results.scenes) + 1.4))
    left = np.zeros(len(results.scenes))
    for kind, (label, colour, hatch) in RAYS.items():
        widths = np.array([_rays_per_sample(results, scene, kind) for scene in results.scenes])
        axis.barh(
            range(len(results.scenes)),
            widths,
            left=left,
            color=colour,
            hatch=hatch,
            edgecolor="white",
            linewidth=0.3,
            label=label,
        )
        left += widths
    axis.set_yticks(range(len(results.scenes)), results.scenes, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel(f"rays per camera subpath, {results.methods[0]}, {results.deciding} spp")
    axis.legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.45, 1))
    figure.tight_layout()
    _save(figure, path)


def _rays_per_sample(results, scene, kind) -> float:
    rows = results.of(scene, results.methods[0], results.deciding)
    rows = [row for row in rows if row.get(f"rays_{kind}") is not None]
    pixels = [row["width"] * row["height"] for row in rows]
    counts = [row[f"rays_{kind}"] / row["spp"] / n for row, n in zip(rows, pixels, strict=True)]
    return float(np.median(counts)) if counts else 0.0


def _save(figure, path: Path):
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)
