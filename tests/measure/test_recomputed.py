"""Figures of a report, computed again from rows.csv as docs/development/measuring.md says."""

import csv
import json
import math
from pathlib import Path

import mitsuba as mi
import numpy as np
import pandas as pd
import pytest
from mitsuba_bdpt.measure import estimates, figures, metrics, page, reference, report, tables
from mitsuba_bdpt.measure.agreement import Means, tile_columns
from mitsuba_bdpt.measure.analysis import Results
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.results import COLUMNS, relative_errors, write_tables
from mitsuba_bdpt.run.statistics import RAYS
from scipy import stats

SHAPE = (32, 32, 3)
TRUTH = np.random.default_rng(1).uniform(0.5, 2, SHAPE)
PLAIN = {
    "scene": "box",
    "first": "bdpt",
    "parameters": '{"type": "any"}',
    "sampler": "independent",
    "decisions": "[]",
    "statistics": "{}",
    "versions": "{}",
    "machine": "a",
    "started": "2026-11-28T15:23:37+00:00",
    "budget": 64,
    "spp": 64,
}


def rendered(own):
    """Rows of integrators of known noise: few, biased, with fireflies; and the reference's means.

    ``own``: the reference's relative standard error.
    """
    rng = np.random.default_rng(4)

    def noisy(level, sigma):
        return TRUTH * (level + sigma * rng.standard_normal(SHAPE))

    a, b = noisy(1, own * math.sqrt(2)), noisy(1, own * math.sqrt(2))
    kept = Reference((a + b) / 2, (a - b) / 2, Means.of([tile_columns(noisy(1, own)) for _ in range(8)]), {})
    sides = {
        "bdpt": [noisy(1, 0.05) for _ in range(6)],
        "path": [noisy(1, 0.2) + 9 * (rng.random(SHAPE) < 1e-3) for _ in range(6)],
        "dark": [noisy(0.9, 0.1) for _ in range(6)],
        "few": [noisy(0.9, 0.1) for _ in range(2)],
    }
    rows = []
    for method, images in sides.items():
        variances = metrics.spread(images, kept.image)
        for seed, (image, variance) in enumerate(zip(images, variances, strict=True), 1):
            seconds = {"seconds": float(rng.uniform(1, 2)), "cpu_seconds": 2.0}
            names = {"method": method, "key": f"{method}{seed}", "seed": seed, "variance": variance}
            measured = relative_errors(image, kept) | {"tile_means": tile_columns(image).tolist()}
            measured |= {"mean": float(image.mean())}
            rows.append(PLAIN | names | seconds | measured)
    return pd.DataFrame(rows), kept.means


def errors(rows, kind, is_marked):
    """The errors of an integrator's seeds, by the formulas of the page alone."""
    measured = np.array([float(row[kind]) for row in rows])
    own = np.array([float(row[f"reference_{kind}"]) for row in rows])
    variance = np.array([float(row["variance"]) for row in rows])
    is_noisy = own.sum() > 0.9 * measured.sum() or (measured - own).min() <= 0
    is_variance = kind == "rel_mse" and (is_noisy if len(rows) < 3 else not is_marked)
    if is_variance:
        return variance if is_noisy else (measured - own) * variance.mean() / (measured - own).mean()
    return measured if is_noisy else measured - own


@pytest.mark.parametrize("own", [0.01, 0.2])
def test_efficiencies_follow_from_the_table_of_renders(tmp_path, own):
    """By the formulas of the page the table of efficiencies, to each digit, from the columns of rows.csv and
    the marks of the table of errors; with a reference noisier than the renders too."""
    rows, means = rendered(own)
    write_tables(rows, tmp_path)
    found = Results(rows, {"box": means})
    renders = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    marked = {name: found.error("box", name, "rel_mse").bound == "≥" for name in found.methods}
    assert own > 0.1 or [name for name in marked if marked[name]] == ["dark"]
    cells = []
    for rival in ("path", "dark", "few"):
        for kind in ("rel_mse_trimmed", "rel_mse"):
            sides = []
            for name in ("bdpt", rival):
                here = [row for row in renders if row["integrator"] == name]
                seconds = np.array([float(row["seconds"]) for row in here])
                sides.append(seconds * errors(here, kind, marked[name]))
            ratios = sides[1] / sides[0][: len(sides[1])]
            cells.append(f"{tables.ratio(np.median(ratios))} ({ratios.min():.3g}–{ratios.max():.3g}")
    line = report.efficiency_table(found).splitlines()[2]
    for cell, text in zip(cells, line.split("|")[2:], strict=False):
        assert text.lstrip("≥≤~ ").startswith(cell)


def test_errors_and_intervals_follow_from_the_table_of_renders(tmp_path):
    """Variance, raw relMSE and squared bias with their intervals by the formulas of the page."""
    rows, means = rendered(0.01)
    write_tables(rows, tmp_path)
    renders = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    variance = np.array([float(row["variance"]) for row in renders if row["integrator"] == "path"])
    n = len(variance)
    without = np.log((variance.sum() * (n - 1) / n - variance) / (n - 2))
    error = math.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2))
    factor = math.exp(stats.t.ppf(0.975, n - 1) * error)
    found = Results(rows, {"box": means}).error("box", "path", "rel_mse")
    expected = estimates.Estimate(variance.mean(), variance.mean() / factor, variance.mean() * factor)
    for end in ("value", "low", "high"):
        assert getattr(found.total, end) == pytest.approx(getattr(expected, end))
        assert getattr(found.variance, end) == pytest.approx(getattr(expected, end))


@pytest.mark.parametrize("error", ["rel_mse", "rel_mse_trimmed"])
def test_points_of_figures_are_the_errors_of_the_table(error):
    """Of each integrator the cell of the table of errors, with its interval and bound: value and ends; no
    ends of two renders."""
    rows, means = rendered(0.01)
    found = Results(rows, {"box": means})
    column = {"rel_mse_trimmed": 6, "rel_mse": 7}[error]
    for line in report.errors_table(found).splitlines()[2:]:
        cells = [cell.strip() for cell in line.split("|")]
        ((x, middle, low, high, bound),) = figures._points(found, "box", cells[2], "spp", error).to_numpy()
        ends = "too few renders for an interval" if np.isnan(low) else f"{low:.2e}–{high:.2e}"
        assert f"{bound} {middle:.2e} ({ends})".lstrip() == cells[column]
        assert x == 64 and np.isnan(high) == (cells[2] == "few")


def test_energies_follow_from_the_table_and_the_header_of_the_reference(tmp_path):
    """The energy of each integrator with its interval, of two renders too, by the formula of the page, from
    rows.csv and what the reference's file has, which Mitsuba reads as the page says; the image of a reference
    likewise."""
    rows, means = rendered(0.02)
    write_tables(rows, tmp_path)
    renders = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    image = TRUTH.astype(np.float16).astype(float)
    reference.write(tmp_path / "box.exr", Reference(image, 0.01 * image, means, {}))
    kept = json.loads(mi.Bitmap(str(tmp_path / "box.exr")).metadata()["provenance"])["means"]["whole"]
    shown = np.array(dict(mi.Bitmap(str(tmp_path / "box.exr")).split())["<root>"])
    np.testing.assert_array_equal(shown, image)
    (r,), (e,), found = kept["mean"], kept["error"], Results(rows, {"box": means})
    for name in ("bdpt", "path", "few"):
        here = [float(row["mean"]) for row in renders if row["integrator"] == name]
        x, n = np.mean(here), len(here)
        own = stats.t.ppf(0.975, n - 1) * np.std(here, ddof=1) / (r * math.sqrt(n))
        half = math.hypot(own, stats.t.ppf(0.975, kept["freedom"]) * x * e / r**2)
        energy = found.surplus("box", name)
        assert (energy.value, energy.low, energy.high) == pytest.approx(
            (x / r - 1, *(x / r - 1 + half * np.array([-1, 1]))), abs=1e-6
        )


def test_pages_have_the_errors_of_the_table():
    """In its table of renders the errors of the report, with their bounds."""
    rows, means = rendered(0.1)
    others = dict.fromkeys(("mape", "flip", "delta_e_itp"))
    found = Results(rows.assign(**others), {"box": means})
    for line in page.lines(found):
        cells = dict(zip(page.COLUMNS, line, strict=True))
        for head, kind in (("relMSE, trimmed", "rel_mse_trimmed"), ("relMSE, raw", "rel_mse")):
            error = found.error("box", cells["integrator"], kind)
            assert cells[head] == ([error.total.value, error.bound] if error.bound else error.total.value)


def test_the_columns_of_the_table_are_described():
    """Each column of rows.csv has a line on the page about measuring, with each kind of rays."""
    text = (Path(__file__).resolve().parents[2] / "docs" / "user" / "measuring_scenes.md").read_text()
    rays = [f"rays_{kind}" for kind in (*RAYS, "photon", "guided", "features")]
    for name in (*COLUMNS, *rays, "image"):
        assert f"`{name}`" in text.partition("## Columns of rows.csv")[2].partition("\n## ")[0]
