"""Figures of a report, computed again from rows.csv as docs/development/measuring.md says."""

import csv
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from mitsuba_bdpt.measure import metrics, report, tables
from mitsuba_bdpt.measure.agreement import Means, tile_columns
from mitsuba_bdpt.measure.analysis import Results
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.results import COLUMNS, write_tables
from mitsuba_bdpt.run.statistics import RAYS
from support.measured import judged

SHAPE = (32, 32, 3)
TRUTH = np.random.default_rng(1).uniform(0.5, 2, SHAPE)


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
            more = {"seconds": float(rng.uniform(1, 2)), "cpu_seconds": 2.0, "variance": variance}
            more |= {"parameters": '{"type": "any"}'}
            rows.append(judged(method, seed, image, kept, **more))
    return pd.DataFrame(rows), kept.means


def errors(rows, kind, is_marked):
    """The errors of an integrator's seeds, by the formulas of the page alone."""
    measured = np.array([float(row[kind]) for row in rows])
    own = np.array([float(row[f"reference_{kind}"]) for row in rows])
    variance = np.array([float(row["variance"]) for row in rows])
    rho = np.mean([float(row["reference_rel_mse"]) for row in rows])
    shifted = 6 * rho**2 > 0.1 * (measured - own).mean()
    is_noisy = own.sum() > 0.9 * measured.sum() or (measured - own).min() <= 0 or shifted
    is_variance = kind == "rel_mse" and (is_noisy if len(rows) < 3 else not is_marked)
    if is_variance:
        return variance if is_noisy else (measured - own) * variance.mean() / (measured - own).mean()
    return measured if is_noisy else measured - own


@pytest.mark.parametrize("own", [0.01, 0.2])
def test_efficiencies_follow_from_the_table_of_renders(tmp_path, own):
    rows, means = rendered(own)
    write_tables(rows, tmp_path)
    found = Results(rows, {"box": means})
    renders = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    marked = {name: found.error("box", name, "rel_mse").bound in ("≥", "~") for name in found.methods}
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


def test_the_columns_of_the_table_are_described():
    text = (Path(__file__).resolve().parents[2] / "docs" / "user" / "measuring_scenes.md").read_text()
    rays = [f"rays_{kind}" for kind in (*RAYS, "photon", "guided", "features")]
    for name in (*COLUMNS, *rays, "image"):
        assert f"`{name}`" in text.partition("## Columns of rows.csv")[2].partition("\n## ")[0]
