"""Figures of a sweep: sizes and formats for print, and text that can be read."""

import itertools
import re
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.files.images import write_layers
from mitsuba_bdpt.measure import crops, figures, report
from mitsuba_bdpt.measure.analysis import Results
from mitsuba_bdpt.measure.estimates import RelativeError
from mitsuba_bdpt.measure.metrics import Estimate
from mitsuba_bdpt.measure.results import image_file
from support.measured import KNOWN, row

METHODS = ("bdpt", "path", "path multijitter", "bdpt skip=none", "an integrator with a long name of its own")


@pytest.fixture(autouse=True)
def closed():
    """Figures that a test keeps are closed after it."""
    yield
    figures.plt.close("all")


def results(scenes=("a_caustic_with_a_long_name", "b")):
    """Errors c / spp at four budgets; `path` lacks a tenth of the light, its errors are lower bounds."""
    rng, rows = np.random.default_rng(1), []
    for scene, (i, method), budget in itertools.product(scenes, enumerate(METHODS), (4, 16, 64, 256)):
        for seed in range(8):
            error = (i + 1) / budget * rng.lognormal(0, 0.2)
            means = (1.8 if method == "path" else 2.0) + 0.01 * rng.standard_normal(51)
            values = {"scene": scene, "budget": budget, "spp": budget, "seconds": budget / 100}
            values |= {"rel_mse": 2 * error, "rel_mse_trimmed": error, "tile_means": means.tolist()}
            rows.append(row(method, seed, **values))
    return Results(pd.DataFrame(rows), dict.fromkeys(scenes, KNOWN))


def block(count, height=48, width=32, title="a_caustic_with_a_long_name"):
    """Images of a bright, noisy window at the bottom right, the noisier the earlier, and their reference."""
    rng, target = np.random.default_rng(1), np.full((height, width, 3), 0.5)
    shots = []
    for i in range(count):
        image = target + 0.01 * rng.standard_normal(target.shape)
        image[-12:, -12:] += (count - i) * rng.exponential(0.5, (12, 12, 3))
        error = RelativeError(Estimate(0.01234, 0.01, 0.02), "≤", 8)
        shots.append(crops.Shot(METHODS[i], 64, 1.234, image, error))
    return crops.Block(title, shots, target)


def saved(monkeypatch, module):
    found = []
    monkeypatch.setattr(
        module, "save", lambda figure, path: (figure.draw_without_rendering(), found.append(figure))
    )
    return found


def test_windows_lie_where_errors_differ():
    made = block(2)
    (left, top, side), (left2, top2, _) = crops.windows(made.errors(0), made.errors(1))
    assert side == 5 and left >= 20 - 1 and top >= 36 - 1
    assert abs(left - left2) >= 2 * side or abs(top - top2) >= 2 * side
    large = np.full((60, 60), 1e-3)
    large[20:40, 20:40] = 1.0
    (left, top, side), (left2, top2, _) = crops.windows(large, np.full((60, 60), 1e-4))
    assert 20 <= left <= 30 and 20 <= top <= 30 and side == 10
    assert abs(left - left2) >= 2 * side or abs(top - top2) >= 2 * side
    (left, top, side), (left2, top2, _) = crops.windows(np.eye(8), np.ones((8, 8)))
    assert abs(left - left2) >= side or abs(top - top2) >= side


def test_crops_are_of_the_sweep(tmp_path):
    rows = results(("b",)).rows
    rows = rows.assign(reference_rel_mse_trimmed=0.004, key=rows["method"] + rows["seed"].astype(str))
    found = Results(rows, {"b": KNOWN}, compared=64)
    kept = Namespace(image=np.ones((8, 8, 3)))

    def mean(method):
        return found.of("b", method, 64)["rel_mse_trimmed"].mean()

    with pytest.raises(CommandError, match="no image of b is there; run the sweep again"):
        figures.cropped(tmp_path, found, kept, "b")
    for method, value in (("bdpt", 1.5), ("path", 2.0)):
        shown = found.of("b", method, 64).sort_values("rel_mse_trimmed").iloc[3]
        write_layers(image_file(tmp_path, shown), {"": np.full((8, 8, 3), value)}, {})
    made = figures.cropped(tmp_path, found, kept, "b")
    assert [one.caption for one in made.shots] == [
        f"path\n64 spp, 0.64 s\nrelMSE ≥ {mean('path') - 0.004:.2g} (trimmed)",
        f"bdpt\n64 spp, 0.64 s\nrelMSE {mean('bdpt') - 0.004:.2g} (trimmed)",
    ]
    assert f" {mean('bdpt') - 0.004:.2e} (" in report.errors_table(found).splitlines()[2]
    np.testing.assert_allclose(made.errors(1), 0.25 / 1.01, rtol=1e-3)
    rows = found.rows.assign(match=np.where(found.rows["method"] == "path", "spp", "seconds"))
    made = figures.cropped(tmp_path, replace(found, rows=rows), kept, "b")
    assert [one.name for one in made.shots] == ["path (equal spp)", "bdpt"]


ALL = {"scenes": None, "integrators": None, "spp": None, "windows": None}
"""Options of figures by default."""


def test_integrators_and_windows_can_be_chosen(monkeypatch, tmp_path):
    kept = replace(results(("b",)), aside=(METHODS[1],))
    assert METHODS[1] not in figures._among(kept, None).methods
    assert figures._among(kept, METHODS[1:2]).rivals == [METHODS[1]]
    with pytest.raises(CommandError, match="--integrators pat: not in the sweep, which has bdpt, "):
        figures._among(kept, ["pat"])
    places = crops.centres(["0.5,0.25", "1,0"])
    assert crops._around(places, 60, 120) == [(55, 10, 10), (110, 0, 10)]
    assert crops.centres(None) is None
    for wrong in (["0.5", "1,0"], ["2,0", "1,0"], ["a,b", "1,0"], ["nan,0", "1,0"]):
        with pytest.raises(CommandError, match="must be X,Y, shares of the image"):
            crops.centres(wrong)
    with pytest.raises(CommandError, match="must be 2 places"):
        crops.centres(["0.5,0.5"])
    words = ALL | {"project": tmp_path, "folder": "x", "output": tmp_path / "a.pdf", "columns": 1}
    for more, text in (
        ({"plot": "rays", "windows": ["0,0", "1,1"]}, "--windows is not for --plot rays; leave it out"),
        ({"plot": "crops", "output": tmp_path / "a.jpg"}, "a.jpg' must end in .pdf, .svg, .png"),
        ({"plot": "samples", "spp": 16}, "--spp is not for --plot samples; leave it out"),
    ):
        with pytest.raises(CommandError, match=text):
            figures.run(Namespace(**words | more))
    found = saved(monkeypatch, crops)
    crops.draw([block(2, 60, 60)], None, 2, places)
    frames = [patch.get_xy() for patch in found[0].axes[0].patches]
    assert frames == [(24.5, 9.5), (49.5, -0.5)]


@pytest.mark.parametrize(
    ("least", "labels"),
    [
        (4, [["5", "10", "20", "50", "100", "200"], ["0.01", "0.1", "1"]]),
        (64, [["100", "200"], ["0.005", "0.01", "0.02", "0.05", "0.1"]]),
    ],
)
def test_numbers_are_written_out_beside_axes(monkeypatch, least, labels):
    found, kept = saved(monkeypatch, figures), results(("b",))
    figures.convergence(replace(kept, rows=kept.rows.query(f"budget >= {least}")), None, 1)
    (axis,) = found[0].axes
    for i, (one, limits) in enumerate(((axis.xaxis, axis.get_xlim()), (axis.yaxis, axis.get_ylim()))):
        ticks = [label for which in (False, True) for label in one.get_ticklabels(minor=which)]
        inside = [tick.get_text() for tick in ticks if limits[0] < tick.get_position()[i] < limits[1]]
        assert [text for text in inside if text] == labels[i]


def test_points_are_joined_in_the_order_of_budgets():
    kept = results(("b",))
    slow = replace(kept, rows=kept.rows.assign(seconds=1 / kept.rows["budget"]))
    assert figures._points(slow, "b", "bdpt", "seconds", "rel_mse")["x"].is_monotonic_decreasing


def test_single_renders_have_points_alone_and_no_efficiencies(monkeypatch, tmp_path):
    kept = results(("b",))
    few = replace(kept, rows=kept.rows.query("budget < 256 or seed == 0"))
    assert figures._points(few, "b", "bdpt", "spp", "rel_mse")["x"].tolist() == [4, 16, 64]
    one = replace(kept, rows=kept.rows.query("seed == 0"))
    assert len(figures._points(one, "b", "bdpt", "spp", "rel_mse")) == 4
    monkeypatch.setattr(figures, "load", lambda *_: (one, {}, {}))
    words = {"project": tmp_path, "folder": "x", "output": tmp_path / "a.pdf", "plot": "efficiency"}
    with pytest.raises(CommandError, match="two renders of each integrator; set seeds = 2 or more"):
        figures.run(Namespace(**ALL | words, columns=1))


@pytest.mark.parametrize("ending", ["pdf", "svg", "png"])
def test_the_format_is_that_of_the_ending(tmp_path, ending):
    """A file of that format, the same bytes each time, of exactly 8.5 cm."""
    files = [tmp_path / f"{i}.{ending}" for i in (1, 2)]
    for file in files:
        figures.PLOTS["efficiency"](results(("b",)), file, 1, ("b",))
    data = files[0].read_bytes()
    assert data == files[1].read_bytes()
    if ending == "svg":
        assert b">over path</text>" in data
    if ending == "pdf":
        assert data.startswith(b"%PDF")
        width = float(re.search(rb"/MediaBox \[\s*0 0 ([\d.]+)", data)[1])
        assert width == pytest.approx(8.5 / 2.54 * 72, abs=0.1)
    else:
        assert data[:200].find({"svg": b"<?xml", "png": b"PNG"}[ending]) >= 0
