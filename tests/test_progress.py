"""What a render shows of its progress."""

import io
import re
import sys

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt import progress
from mitsuba_bdpt.errors import UsageError
from rich.console import Console


def report(done, total=100, seconds=2.0, rays=5_000_000, **more):
    return progress.Report(done, total, seconds, rays, **{"error": None} | more)


def test_a_bar_is_drawn_on_terminals_alone():
    for is_terminal in (True, False):
        stream = io.StringIO()
        bar = progress.Bar(console=Console(file=stream, force_terminal=is_terminal, width=100))
        for done in (50, 100):
            bar(report(done))
        assert ("50/100 spp" in stream.getvalue()) == is_terminal
        bar.close()  # once more does nothing


def test_a_bar_under_a_cell_needs_no_widgets(monkeypatch):
    """Rationale: rich's bars need ipywidgets. Expected: one output per render, replaced after each pass."""
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    outputs = []

    class Handle:
        def __init__(self, shown):
            outputs.append([shown])

        def update(self, shown):
            outputs[-1].append(shown)

    monkeypatch.setattr("IPython.display.display", lambda shown, display_id: Handle(shown))
    bar = progress.Bar(console=Console(file=io.StringIO(), force_jupyter=True))
    for done in (50, 100, 25, 100):  # of two renders
        bar(report(done))
    assert [len(shown) for shown in outputs] == [2, 2]
    for table in (table for shown in outputs for table in shown):
        made = table._repr_mimebundle_((), ())
        assert re.search(r"\d+/100 spp", made["text/plain"]) and "<pre" in made["text/html"]


def test_lines_come_now_and_then(monkeypatch):
    """Expected: a line every ten seconds, and in long renders every fiftieth of their time."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    lines = progress.Lines(stream=stream)

    def at(seconds, done, **more):
        now[0] = seconds
        lines(report(done, seconds=seconds, rays=seconds * 10**6, **more))
        return stream.getvalue().splitlines()

    assert not at(9.0, 5)
    assert len(at(11.0, 5)) == 1
    assert len(at(20.0, 9)) == 1 and len(at(22.0, 10)) == 2
    assert len(at(3000.0, 60)) == 3 and len(at(3050.0, 61)) == 3 and len(at(3070.0, 61)) == 4


def test_which_display(monkeypatch):
    """The standard error of pytest is no terminal."""
    kinds = {"auto": "Lines", "bar": "Bar", "lines": "Lines", "none": "Display"}
    for name in progress.KINDS:
        shown = progress.display(name)
        assert type(shown).__name__ == kinds[name]
        shown(report(1))
        shown.close()


def test_a_report_has_the_image_so_far():
    """Expected: the image of the first pass is what its snapshot is assembled to; of the last pass the
    render's, whose film holds it once; of an older report there is none any more."""
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": 16, "height": 16}
    scene = mi.load_dict(box)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 4, "spp_per_pass": 4})
    images, reports = [], []

    def watch(report):
        images.append(np.array(report.image()))
        reports.append(report)
        if len(reports) == 1:
            first.append(report.snapshot())

    first = []
    integrator.on_pass = watch
    expected = np.array(integrator.render(scene, spp=8))
    assert len(images) > 1 and not np.array_equal(images[0], images[1])
    assert np.allclose(images[-1], expected, rtol=1e-4, atol=1e-6)
    for late in (reports[0].image, reports[0].snapshot):
        with pytest.raises(UsageError, match="came too late"):
            late()
    integrator.on_pass = None
    assert np.allclose(integrator.assemble(first[0], scene), images[0], rtol=1e-4, atol=1e-6)
