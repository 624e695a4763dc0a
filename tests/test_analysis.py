"""What is concluded from the rows of a sweep: hand-made rows with known answers, and the report's text."""

import json
import tomllib
from pathlib import Path

import analysis
import mitsuba_bdpt  # noqa: F401  (chooses the LLVM; must come before mitsuba)
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import report
from analysis import Refused, Results
from metrics import Means
from reference import Reference

ROOT = Path(__file__).resolve().parents[1]
TRUE = np.full(51, 2.0)


def row(method="bdpt", seed=1, **values):
    """A render of 64 samples in 1 second with relMSE 0.02, raw and trimmed."""
    plain = {
        "scene": "box",
        "method": method,
        "budget": 64,
        "spp": 64,
        "seed": seed,
        "seconds": 1.0,
        "rel_mse": 0.02,
        "rel_mse_trimmed": 0.02,
        "reference_rel_mse": 0.0,
        "reference_rel_mse_trimmed": 0.0,
        "resolution": 8,
        "width": 8,
        "height": 8,
        "max_depth": 3,
        "machine": "a machine",
        "versions": '{"mitsuba": "3.9.1"}',
        "tile_means": list(TRUE),
    }
    rays = {f"rays_{kind}": 640 for kind in ("camera", "light", "shadow_s1", "shadow_t1", "shadow_inner")}
    return plain | rays | values


def runs(method, count, **values):
    return [row(method, seed, **values) for seed in range(1, count + 1)]


def noisy(method, count, factor=1.0, **values):
    """Rows whose tile means are 2 * factor with a standard deviation of 1 %."""
    rng = np.random.default_rng(len(method))
    means = 2 * factor * (1 + 0.01 * rng.standard_normal((count, 51)))
    return [row(method, i + 1, tile_means=list(m), **values) for i, m in enumerate(means)]


KNOWN = Means.known(np.full((4, 4, 3), 2.0))


# -- figures ----------------------------------------------------------------------------------


def test_efficiency_pairs_the_seeds():
    """Seed 1: ours 1 s and 0.02, theirs 2 s and 0.03: (2 * 0.03) / (1 * 0.02) = 3. Seed 2: theirs 1 s and
    0.1: 5. Seed 3 has no partner. Median 4, extremes 3 and 5.
    """
    theirs = [row("path", 1, seconds=2.0, rel_mse=0.03), row("path", 2, rel_mse=0.1)]
    found = analysis.efficiency(runs("bdpt", 3), theirs, "rel_mse")
    assert (found.median, found.smallest, found.largest, found.count) == pytest.approx((4, 3, 5, 2))


def test_efficiency_is_refused_where_it_means_nothing():
    """A reference with more than 1 % of the error, an exact render, a single one."""
    with pytest.raises(Refused, match="reference carries 5 % of the error"):
        analysis.efficiency(runs("bdpt", 2, reference_rel_mse=0.001), runs("path", 2), "rel_mse")
    with pytest.raises(Refused, match="path is exact here"):
        analysis.efficiency(runs("bdpt", 2), runs("path", 2, rel_mse=0.0), "rel_mse")
    with pytest.raises(Refused, match="fewer than two renders"):
        analysis.efficiency(runs("bdpt", 2), runs("path", 1), "rel_mse")


def test_trimmed_errors_are_judged_by_the_trimmed_error_of_the_reference():
    """A firefly in the reference spoils raw figures, not trimmed ones."""
    ours, theirs = (runs(m, 2, reference_rel_mse=0.01) for m in ("bdpt", "path"))
    assert analysis.efficiency(ours, theirs, "rel_mse_trimmed").median == pytest.approx(1)
    with pytest.raises(Refused):
        analysis.efficiency(ours, theirs, "rel_mse")


def test_widths_are_those_of_the_interval_of_the_median():
    """Ratios 1, 1, 1 have an interval of width 0; of 1, 2, 3 the bootstrap's goes from 1 to 3."""
    rows = runs("bdpt", 3) + runs("path", 3)
    rows += [row("other", seed, rel_mse_trimmed=0.02 * seed) for seed in (1, 2, 3)]
    found = analysis.widths(rows, ("bdpt", "path", "other"))
    assert found == pytest.approx({"path": 0.0, "other": 2.0})


def test_cost_is_per_sample():
    """1 s for 64 samples against 2 s for 256: 2x."""
    found = analysis.cost(runs("bdpt", 2), runs("path", 2, seconds=2.0, spp=256))
    assert found.median == pytest.approx(2)


def test_convergence_leaves_out_what_the_reference_cannot_judge():
    """Errors 0.32 / spp at 4 and 16; at 64 only the reference's own error is left and would spoil it."""
    rows = []
    for spp, error in ((4, 0.08), (16, 0.02), (64, 0.018)):
        rows += runs("bdpt", 2, budget=spp, spp=spp, rel_mse=error, reference_rel_mse=1.9e-4)
    found = analysis.convergence(rows)
    assert (found.value, found.low, found.high) == pytest.approx((-1, -1, -1))
    with pytest.raises(Refused, match="fewer than two budgets"):
        analysis.convergence([r for r in rows if r["budget"] != 4])


def test_bias_takes_the_budget_with_most_samples():
    """Of 9 renders of 4 samples, 8 of 16 and 5 of 64 those of 16: only they are 5 % dark."""
    rows = noisy("a", 9, spp=4, budget=4) + noisy("b", 8, 0.95, spp=16, budget=16) + noisy("c", 5)
    found = analysis.bias(rows, KNOWN)
    assert not found.passed and found.missing.value == pytest.approx(0.05, abs=0.005)
    assert analysis.bias(rows[:9], KNOWN).passed
    with pytest.raises(Refused, match="fewer than 8 renders"):
        analysis.bias(rows[-5:], KNOWN)


def test_geometric_mean():
    assert analysis.geometric_mean([1, 4, 16]) == pytest.approx(4)


@pytest.fixture
def results():
    """`path` half as good, with multijitter a quarter better, in `box`; in `dark` path misses a tenth."""
    rows = noisy("bdpt", 16) + noisy("path", 16, rel_mse=0.04, rel_mse_trimmed=0.04)
    rows += noisy("path multijitter", 16, rel_mse=0.016, rel_mse_trimmed=0.016)
    rows += noisy("bdpt skip=none", 16, seconds=3.0) + noisy("ptracer", 16, 0.5)
    dark = [r | {"scene": "dark", "tile_means": list(0.9 * np.array(r["tile_means"]))} for r in rows]
    dark = [r | {"tile_means": list(TRUE)} if r["method"].startswith("bdpt") else r for r in dark]
    probes = {"coldstart": {"values": {"path": [1.0, 3.0], "bdpt": [4.0, 4.0]}}}
    return Results(rows + dark, {"box": KNOWN, "dark": KNOWN}, probes)


def test_the_stronger_path_decides(results):
    assert results.against_path("box").median == pytest.approx(0.8)
    assert results.fair_efficiency("box", "path").median == pytest.approx(2)
    with pytest.raises(Refused, match="9.8 % of the energy is missing"):
        results.fair_efficiency("dark", "path")
    with pytest.raises(Refused, match="not rendered"):
        results.fair_efficiency("pool", "path")


# -- report -----------------------------------------------------------------------------------


def cells(text, first):
    """The cells of the row of a Markdown table that begins so."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {first} |")]
    return [cell.strip() for cell in line.split("|")[2:-1]]


def test_tables_say_what_the_rows_say(results):
    text = report.efficiency_table(results)
    assert cells(text, "`box`") == [
        *("2x (2–2)", "2x (2–2)", "0.8x (0.8–0.8)", "0.8x (0.8–0.8)", "3x (3–3)"),
    ]
    dark = cells(text, "`dark`")
    assert dark[0].startswith("9.8 % of the energy is missing") and dark[1] == "–"
    checks = cells(report.checks_table(results), "`box`")
    assert checks[:3] == [
        "1x (1–1)",
        "3x (3–3)",
        "fewer than two budgets with errors that the reference can judge",
    ]
    assert checks[4].startswith("passed, p = ") and checks[5].startswith("50 % of the energy is missing")


def test_goals_stand_beside_what_is_measured(results):
    goals = [
        {"what": "box", "at_least": "1.4x", "measure": "efficiency", "scene": "box"},
        {"what": "worst", "at_least": "0.97x", "measure": "worst"},
        {"what": "none", "at_least": "2x", "measure": "against none"},
        {"what": "cold", "at_least": "4x", "measure": "coldstart"},
        {"what": "memory", "at_least": "1 GiB", "measure": "memory"},
        {"what": "floor", "at_least": "1x"},
        {"what": "dark", "at_least": "1x", "measure": "efficiency", "scene": "dark"},
    ]
    text = report.goals_table(results, goals)
    assert cells(text, "box") == ["1.4x", "0.8x (0.8–0.8)"]
    assert cells(text, "worst") == ["0.97x", "0.8x, `box`, of 1 scenes that can be judged"]
    assert cells(text, "none") == ["2x", "3x, 2 scenes"]
    assert cells(text, "cold") == ["4x", "4.00 s, 2x `path`'s"]
    assert cells(text, "memory") == ["1 GiB", "not measured"]
    assert cells(text, "floor") == ["1x", "not measured yet"]
    assert cells(text, "dark") == ["1x", "0.8x (0.8–0.8); path and path multijitter fail the bias check"]


def test_the_goals_of_the_project_can_be_measured(results):
    """Expected: every row of goals.toml names a figure that exists, and gives a text for any data."""
    goals = tomllib.loads((ROOT / "docs" / "benchmark" / "goals.toml").read_text())["goal"]
    assert report.goals_table(results, goals).count("\n") == len(goals) + 2


def test_parts_of_the_readme_are_replaced():
    text = "a\n<!-- report: x -->\nold\n<!-- end -->\nb\n<!-- report: y -->\n<!-- end -->\n"
    expected = "a\n<!-- report: x -->\n\nnew\n\n<!-- end -->\nb\n<!-- report: y -->\n<!-- end -->\n"
    once = report.replace_part(text, "x", "new\n")
    assert once == expected and report.replace_part(once, "x", "new\n") == expected
    with pytest.raises(ValueError, match="there must be one `<!-- report: z -->`"):
        report.replace_part(text, "z", "")


def test_a_report_is_written(results, tmp_path, monkeypatch):
    """Expected: from the data of a folder the page, the plots, and the project's README's parts."""
    pyarrow.parquet.write_table(pa.Table.from_pylist(results.rows), tmp_path / "rows.parquet")
    (tmp_path / "probes.json").write_text(json.dumps(results.probes))
    (tmp_path / "goals.toml").write_text('[[goal]]\nwhat = "floor"\nat_least = "1x"\n')
    (tmp_path / "notes.toml").write_text('dark = "why"\n')
    readme = tmp_path / "TOP.md"
    provenance = {"integrator": {"type": "path"}, "max_depth": 3, "spp": 4096}
    exact = Reference(np.full((4, 4, 3), 2.0), 1e-5, 5e-6, KNOWN, provenance)
    readme.write_text("".join(f"<!-- report: {name} -->\n<!-- end -->\n" for name in ("goals", "efficiency")))
    monkeypatch.setattr(report, "load", lambda folder: (results, {"box": exact}))
    monkeypatch.setattr("sys.argv", ["report.py", str(tmp_path), "--readme", str(readme)])
    report.main()
    page = (tmp_path / "README.md").read_text()
    assert "* `dark`: why" in page and cells(page, "floor") == ["1x", "not measured yet"]
    assert "| `box` | 3 | `path` | 4096 | 1.0e-05 | 5.0e-06 | 0.04 |" in page
    assert cells(readme.read_text(), "`box`")[0] == "2x (2–2)"
    for name in ("efficiency", "seconds", "samples", "rays"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
        assert f"({name}.png)" in page
    assert not list(tmp_path.glob(".*"))
