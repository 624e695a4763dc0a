"""What is concluded from the rows of a sweep: hand-made rows with known answers, and the report's text."""

import json
import re
from dataclasses import replace

import goals
import mitsuba_bdpt  # noqa: F401  (chooses the LLVM; must come before mitsuba)
import numpy as np
import pages
import pandas as pd
import pytest
from mitsuba_bdpt.cli.arguments import build_parser
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.files.texts import read_toml
from mitsuba_bdpt.measure import analysis, reference, report
from mitsuba_bdpt.measure.analysis import Results, Unavailable
from mitsuba_bdpt.measure.models import PresetFile
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.report import Report
from mitsuba_bdpt.measure.results import load
from mitsuba_bdpt.measure.scenes import digest
from repository import ROOT
from support.measured import KNOWN, TRUE, row


def runs(method, count, **values):
    return [row(method, seed, **values) for seed in range(1, count + 1)]


def results_of(rows, references=None, **more):
    return Results(pd.DataFrame(rows), {"box": KNOWN} if references is None else references, **more)


def noisy(method, count, factor=1.0, **values):
    """Rows whose tile means are 2 * factor with a standard deviation of 1 %."""
    rng = np.random.default_rng(len(method))
    means = 2 * factor * (1 + 0.01 * rng.standard_normal((count, 51)))
    return [row(method, i + 1, tile_means=list(m), **values) for i, m in enumerate(means)]


BY_PATH = Reference(None, None, KNOWN, {"integrator": {"type": "path"}})
MADE = {"box": BY_PATH, "dark": BY_PATH}


# -- figures ----------------------------------------------------------------------------------


def test_efficiency_pairs_the_seeds():
    """Seed 1: ours 1 s and 0.02, theirs 2 s and 0.03: (2 * 0.03) / (1 * 0.02) = 3. Seed 2: theirs 1 s and
    0.1: 5. Seed 3 has no partner. Median 4, extremes 3 and 5.
    """
    theirs = [row("path", 1, seconds=2.0, rel_mse=0.03), row("path", 2, rel_mse=0.1)]
    found = results_of(runs("bdpt", 3) + theirs).efficiency("box", "path", "rel_mse")
    assert (found.median, found.smallest, found.largest, found.count) == pytest.approx((4, 3, 5, 2))


def test_efficiency_is_refused_where_it_means_nothing():
    exact, single = runs("path", 2, rel_mse=0.0), runs("path", 1)
    for theirs, why in ((exact, "path is exact here"), (single, "two renders")):
        with pytest.raises(Unavailable, match=why):
            results_of(runs("bdpt", 2) + theirs).efficiency("box", "path", "rel_mse")


def test_cost_is_per_sample():
    """1 s for 64 samples against 2 s for 256: 2x."""
    sides = runs("bdpt", 2), runs("path", 2, seconds=2.0, spp=256)
    assert analysis.cost(*map(pd.DataFrame, sides)).median == pytest.approx(2)


def test_convergence_without_the_references_error():
    """Errors 0.32 / spp at 4, 16 and 64, to all of which the reference adds 1.9e-4."""
    rows = []
    for spp, error in ((4, 0.08), (16, 0.02), (64, 0.005)):
        rows += runs("bdpt", 5, budget=spp, spp=spp, rel_mse=error + 1.9e-4, reference_rel_mse=1.9e-4)
    found = results_of(rows).convergence("box", "bdpt")
    assert (found.value, found.low, found.high) == pytest.approx((-1, -1, -1))
    few = results_of([r for r in rows if r["seed"] < 5]).convergence("box", "bdpt")
    assert f"{few}" == "-1.00 (too few renders for an interval)"
    with pytest.raises(Unavailable, match="fewer than two budgets"):
        results_of([r for r in rows if r["budget"] == 4]).convergence("box", "bdpt")


def test_bias_takes_the_budget_with_most_samples():
    """Of 9 renders of 4 samples, 8 of 16 and 5 of 64 those of 16: only they are 5 % dark."""
    rows = noisy("path", 9, spp=4, budget=4) + noisy("path", 8, 0.95, spp=16, budget=16) + noisy("path", 5)
    found = results_of(rows).bias("box", "path")
    assert not found.passed and found.missing.value == pytest.approx(0.05, abs=0.005)
    assert results_of(rows[:9]).bias("box", "path").passed
    with pytest.raises(Unavailable, match="fewer than 8 renders"):
        results_of(rows[-5:]).bias("box", "path")


@pytest.fixture
def results():
    """`path` half as good, with multijitter a quarter better, in `box`; in `dark` path misses a tenth."""
    rows = noisy("bdpt", 16) + noisy("path", 16, rel_mse=0.04, rel_mse_trimmed=0.04)
    rows += noisy("path multijitter", 16, rel_mse=0.016, rel_mse_trimmed=0.016)
    rows += noisy("bdpt skip=none", 16, seconds=3.0) + noisy("ptracer", 16, 0.5)
    rows += noisy("bdpt skip=impossible", 16, seconds=1.5)
    rows += noisy("bdpt guiding=photons", 16, rel_mse_trimmed=0.05)
    rows += noisy("bdpt merging", 16, rel_mse=0.002)
    dark = [r | {"scene": "dark", "tile_means": list(0.9 * np.array(r["tile_means"]))} for r in rows]
    dark = [r | {"tile_means": list(TRUE)} if r["method"].startswith("bdpt") else r for r in dark]
    return results_of(rows + dark, {"box": KNOWN, "dark": KNOWN}, aside=ASIDE)


ASIDE = "bdpt skip=none", "ptracer", "bdpt skip=impossible", "bdpt guiding=photons", "bdpt merging"


def test_the_stronger_path_decides(results):
    assert results.rivals == ["path", "path multijitter"]
    assert {*ASIDE} <= {*replace(results, aside=()).rivals}
    assert results.against_path("box").median == pytest.approx(0.8)
    assert results.efficiency("box", "path").median == pytest.approx(2)
    assert results.lacks("box", "path") == results.path_lacks("box") == ""
    assert results.lacks("dark", "path").startswith("9.8 % of the energy is missing")
    found = results.efficiency("dark", "path")
    assert found.bound == "≥" and found.median == pytest.approx(2)
    assert results.against_path("dark").bound == "≥" and "is missing" in results.path_lacks("dark")
    with pytest.raises(Unavailable, match="not rendered"):
        results.bias("pool", "path")
    few = results_of(runs("bdpt", 3) + runs("path", 3, rel_mse=0.1))
    assert few.efficiency("box", "path", "rel_mse").median == pytest.approx(5)


# -- report -----------------------------------------------------------------------------------


def test_the_report_says_which_source_measured_what():
    given = "amx bmx bmx amy cnx".split()  # scene, machine, source
    rows = [row(scene=a, machine=m, versions=f'{{"source": "{x}"}}') for a, m, x in given]
    assert report.machine(pd.DataFrame(rows[:2])) == "m; source x"
    several = report.machine(pd.DataFrame(rows))
    assert several.startswith("m; source x; for `")
    assert "; for `a` m; source y" in several and "; for `c` n; source x" in several


def cells(text, first, place=0):
    """The cells of the row of a Markdown table that begins so, of several tables of the ``place``-th."""
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    return [line[1:] for line in lines if line[:1] == [first]][place]


def test_scenes_with_media_have_a_table_of_their_own(results):
    fog = runs("bdpt", 3) + runs("volpath", 3, rel_mse_trimmed=0.1)
    fog += runs("volpathmis", 3, rel_mse_trimmed=0.06)
    rows = pd.concat([results.rows, pd.DataFrame(fog).assign(scene="fog")])
    both = replace(results, rows=rows, references=results.references | {"fog": KNOWN})
    text = report.efficiency_table(both)
    assert text.startswith(report.efficiency_table(results).rstrip("\n"))
    assert cells(text, "`fog`")[:3:2] == ["5x (5–5; n = 3)", "3x (3–3; n = 3)"]
    assert both.against_path("fog").median == pytest.approx(3)
    assert both.against_path("box").median == pytest.approx(0.8)


def test_tables_say_what_the_rows_say(results):
    text = report.efficiency_table(results)
    expected = *["2x (2–2)"] * 2, *["0.8x (0.8–0.8)"] * 2, "3x (3–3)", "none found"
    assert cells(text, "`box`") == list(expected)
    dark = cells(text, "`dark`")
    assert dark[:2] == ["≥ 2x (2–2)"] * 2 and dark[5].startswith("path: 9.8 % of the energy is missing")
    assert "path multijitter: " in dark[5]
    checks = cells(report.checks_table(results, MADE, {}), "`box`")
    assert checks[:3] == ["1x (1–1)", "3x (3–3)", "fewer than two budgets with two renders"]
    assert checks[3].startswith("passed, p = ")
    assert checks[4].startswith("≥ 1x (1–1); 50 % of the energy is missing")
    assert "![box](../images/gallery/box.png)<br>`box`<br>0.8x (0.8–0.8) " in pages.gallery(results)


def test_goals_stand_beside_what_is_measured(results, monkeypatch, tmp_path):
    versions = {"mitsuba": "3.9.1", "source": "s", "machine": "a machine"}
    record = tmp_path / "floor.json"
    record.write_text(json.dumps({"versions": versions, "values": {"box": [1.4, 1.2, 1.3]}}))
    monkeypatch.setattr(goals, "FLOOR", record)
    near = "0.800x, interval 0.800–0.800, 16 pairs"
    both = f"{near.replace('0.8', '2.0')} over path; {near} over path multijitter"
    dark = goals.Goal("dark", (1,), goals.over_path, ("dark",)).row(results)[3]
    assert dark.startswith("≥ 0.8x (0.8–0.8); path: ") and "% of the energy is missing" in dark
    for measure, scenes, bounds, text, met in (
        (goals.over_path, ("box",), (1.4,), "0.8x (0.8–0.8)", "**no**"),
        (goals.worst, (), (0.97,), f"`box` of 2 scenes: {near}", "**no**"),
        (goals.near_one, ("box",), (0.96,), both, "**no**"),
        (goals.costs, ("box",), (2, 1.4), "3x (3–3) / 1.5x (1.5–1.5)", "yes"),
        (goals.against_none, (), (2,), "3x trimmed, 3x raw, 2 of 2 scenes", "yes"),
        (goals.merged, ("box",), (9,), "20x (20–20) over path, 8x (8–8) over path multijitter", "**no**"),
        (goals.unaimed, ("box",), (2,), "2.5x (2.5–2.5) trimmed, 1x (1–1) raw", "yes"),
        (goals.floor, (), (1.35,), "1.3x (1.2–1.4; n = 3) `box`", "**no**"),
    ):
        assert goals.Goal("", bounds, measure, scenes).row(results)[3:] == [text, met]
    record.write_text(json.dumps({"versions": {}, "values": {}}))
    other = goals.Goal("floor", (1.35,), goals.floor, at_most=True).row(results)
    assert other == ["floor", "1.35x at most", "–", "not measured of this version on this machine", "–"]
    assert goals.goals_table(results).count("\n") == len(goals.GOALS) + 2


def test_slopes_need_an_explanation():
    """Errors that fall as samples^-2: marked where slopes are explained in notes, unless this one is."""
    rows = runs("bdpt", 5, budget=4, spp=4) + runs("bdpt", 5, rel_mse=0.02 / 256)
    for notes, expected in (({"pool": "x"}, ", **unexplained**"), ({"box": "points"}, ""), ({}, "")):
        found = cells(report.checks_table(results_of(rows), MADE, notes), "`box`")[1]
        assert found == "-2.00 (-2.00 to -2.00)" + expected


def test_the_cost_of_the_pilot():
    results = results_of([row(seed=seed, seconds_pilot=0.25) for seed in (1, 2, 3)])
    assert goals.pilot(results, "box") == goals.Measured("20.0 % at 64 spp", [20.0])


def test_what_a_biased_integrator_lacks_is_said():
    def lacks(rows):
        return results_of(rows).lacks("box", "path")

    assert lacks(noisy("path", 12, 0.95)).startswith("4.9 % of the energy is missing")
    assert lacks(noisy("path", 12, 1.1)).startswith("10 % too much energy")
    assert lacks(noisy("path", 12)) == lacks(noisy("path", 5, 0.5)) == ""
    assert lacks(noisy("path", 5, 0.0)) == analysis.NOTHING
    rows = noisy("path", 12)
    for r in rows:
        r["tile_means"][:6] = np.array(r["tile_means"][:6]) + np.repeat([0.5, -0.5], 3)
    assert re.match("wrong in the tile in row 0, column [01] of 4 x 4, by -?0.[45]", lacks(rows))


def test_names_are_those_of_the_preset():
    file = PresetFile.model_validate(read_toml(ROOT / "presets" / "benchmark.toml"))
    names = {m.name for m in file.methods}
    others = analysis.NONE, goals.IMPOSSIBLE, analysis.INDEPENDENT, goals.ALONE, analysis.LIGHT_TRACER
    assert names >= {*analysis.RIVALS, *analysis.MEDIA_RIVALS, *others}


def test_a_sweep_that_was_cut_has_figures():
    small, large = ([*runs("bdpt", 2, budget=n), *runs("path", 2, budget=n)] for n in (16, 64))
    assert results_of([*small, *large[:3]], {}).deciding == 16
    assert results_of([*small, *large], {}).deciding == 64
    assert results_of([*small, *large, row("bdpt skip=none", 1, budget=16)], {}).deciding == 64
    assert results_of([*large[:1], *large[2:3], row(budget=4)], {}).deciding == 64
    assert results_of([*small, *large], {}, compared=16).deciding == 16
    with pytest.raises(CommandError, match="spp=32 must be one of 16, 64"):
        _ = results_of([*small, *large], {}, compared=32).deciding


def test_cells_are_numbers_where_nothing_is_wrong():
    """Of three renders 1, 2 and 3 % too bright, +2 % with Student's interval of their mean, 4.30 * 1 % /
    sqrt(3); no verdict of so few, or by a reference of few renders, or of a single render."""
    rows = [row(seed=i, tile_means=list((1 + i / 100) * TRUE), variance=0.02) for i in (1, 2, 3)]
    found = results_of(rows)
    energy = found.missing("box", "bdpt")
    assert (-energy.value, energy.high - energy.value) == pytest.approx((0.02, 0.0248), rel=1e-2)
    checks = report.checks_table(found, MADE, {})
    assert "energy +2 % ± 2.5 (fewer than 8 renders of one budget: no verdict), by `path`" in checks
    with pytest.raises(Unavailable, match="the reference has fewer than 8 renders"):
        results_of(rows, {}).missing("box", "bdpt")
    with pytest.raises(Unavailable, match="fewer than two renders"):
        results_of(rows[:1]).missing("box", "bdpt")


@pytest.mark.parametrize(("own", "text"), [(0.008, "29 %"), (0.01, "33 % ⚠")])
def test_a_reference_is_marked_by_its_share_in_errors(own, text):
    """The larger share, that of `bdpt`, whose error is half."""
    rows = runs("bdpt", 2, rel_mse_trimmed=0.02 + own, reference_rel_mse_trimmed=own)
    rows += runs("path", 2, rel_mse_trimmed=0.04 + own, reference_rel_mse_trimmed=own)
    assert cells(report.references_table(results_of(rows), {"box": image_of_two()}), "`box`")[4] == text


def test_a_reference_of_few_renders_costs_the_bias_check_alone(tmp_path):
    stored(tmp_path, pd.DataFrame(runs("bdpt", 2)), None)
    found, made, _ = load(Project(tmp_path), tmp_path)
    assert found.scenes == ["box"] == list(made) and not found.references
    with pytest.raises(Unavailable, match="the reference has fewer than 8 renders"):
        found.bias("box", "bdpt")


@pytest.mark.parametrize(
    ("wall", "processor", "is_busy"),
    [
        ((1.6, 4.6, 4.4, 4.0), (3.2, 3.4, 3.3, 3.2), True),
        ((1.6, 4.6, 4.4, 4.0), (1.6, 4.6, 4.4, 4.0), False),  # the work itself differs
        ((1.0, 1.2, 1.1, 1.3), (2.0, 2.01, 2.0, 2.0), False),  # by less than a fifth
        ((1.0, 3.0), (2.0, 2.0), False),  # too few
        ((1.0, 3.0, 2.0), (None,) * 3, False),  # an older sweep
    ],
)
def test_other_programs_are_noticed(wall, processor, is_busy):
    times = enumerate(zip(wall, processor, strict=True))
    rows = runs("bdpt", len(wall), cpu_seconds=1.0)
    found = results_of(rows + [row("path", i, seconds=w, cpu_seconds=c) for i, (w, c) in times])
    text = report.conditions_table(found)
    assert ("| path: other programs ran meanwhile" in text) == is_busy == bool(text)
    if is_busy:
        assert not report.conditions_table(replace(found, aside=("path",)))
        page = Report(found, {"box": image_of_two()}, {}, "Box", {}).text()
        assert page.index('clock = "processor"') < page.index(text) < page.index("Efficiency is")


def test_a_path_tracer_is_known_by_its_type():
    ways = {"path": "path", "my tracer": "path", "path of mine": "bdpt", "bdpt": "bdpt"}
    errors = {"path": 0.04, "my tracer": 0.03}
    found = []
    for name, kind in ways.items():
        found += runs(name, 2, parameters=json.dumps({"type": kind}), rel_mse_trimmed=errors.get(name, 0.02))
    results = results_of(found)
    assert results.standard == ["path", "my tracer"]
    assert results.against_path("box").median == pytest.approx(1.5)


def image_of_two(means=KNOWN):
    provenance = {"integrator": {"type": "path"}, "max_depth": 3, "spp": 4096, "scene_sha256": "the scene"}
    return Reference(np.full((4, 4, 3), 2.0), np.zeros((4, 4, 3)), means, provenance)


def stored(folder, rows, means=KNOWN):
    """The file of a reference, against which the errors of the folder's rows were taken."""
    file = reference.reference_path(Project(folder), "box", 8, 3)
    reference.write(file, image_of_two(means))
    rows.assign(reference_sha256=digest(file)).to_parquet(folder / "rows.parquet")
    return file


def test_a_report_is_written(results, tmp_path):
    file = stored(tmp_path, results.rows[results.rows["scene"] == "box"])
    (tmp_path / "notes.toml").write_text('box = "why"\n')
    options = build_parser().parse_args(["report", str(tmp_path), "--project", str(tmp_path)])
    (tmp_path / "README.md").write_text("# Mine\n")
    with pytest.raises(CommandError, match="README.md' exists and was made by something else; move it away"):
        report.run(options)
    (tmp_path / "README.md").unlink()
    assert [report.run(options), report.run(options)] == [0, 0]
    page = (tmp_path / "README.md").read_text()
    assert "* `box`: why" in page
    found = cells(page.partition("## References")[2], "`box`")
    assert found == ["3", "`path`", "4096", "0.0e+00", "0 %", "0.04"]
    for name in ("efficiency", "seconds", "samples", "rays"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
        assert f"({name}.png)" in page
    assert not list(tmp_path.glob(".*"))
    kept = image_of_two()
    reference.write(file, replace(kept, image=kept.image * 2))
    with pytest.raises(ValueError, match="taken against another reference; run mitsuba-bdpt sweep"):
        report.run(options)
    reference.write(file, kept)
    (tmp_path / "notes.toml").write_text('nowhere = "why"\n')
    with pytest.raises(ValueError, match="'nowhere' is not among the scenes"):
        report.run(options)
