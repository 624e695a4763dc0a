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


def shown(bar):
    """Text and filled share of a bar."""
    (task,) = bar._bar.tasks
    return task.description, task.completed


def test_a_bar_shows_rate_and_time_left():
    """Expected: words and length of the bar, for a render of so many samples and for one that time ends."""
    bar = progress.Bar(console=Console(file=io.StringIO(), force_terminal=True))
    bar(report(1, total=4))
    assert shown(bar) == ("1/4 spp, 2.5 M rays/s, 6 s left", 0.25)
    bar.close()
    bar = progress.Bar(8.0, True, console=Console(file=io.StringIO()))
    bar(report(8, total=1 << 16, rays=2000))
    assert shown(bar) == ("8 spp, 1 k rays/s, 6 s left", 0.25)
    bar(report(8, total=1 << 16, rays=0, seconds=9.0))
    assert shown(bar) == ("8 spp, stopped after 8 s", 1)
    bar = progress.Bar(console=Console(file=io.StringIO()))
    bar(report(1 << 14, total=1 << 16))
    assert shown(bar)[0].startswith("16384/65536 spp, ")


def test_a_bar_is_drawn_on_terminals_alone():
    """Expected: control sequences on a terminal, nothing in a file; the last pass takes the bar away."""
    for is_terminal in (True, False):
        stream = io.StringIO()
        bar = progress.Bar(console=Console(file=stream, force_terminal=is_terminal, width=100))
        for done in (50, 100):
            bar(report(done))
        assert ("50/100 spp" in stream.getvalue()) == is_terminal
        bar.close()  # once more does nothing


def test_a_bar_under_a_cell_needs_no_widgets(monkeypatch):
    """Rationale: rich draws in notebooks with ipywidgets, and warns and shows nothing where they are missing,
    as in a plain Jupyter. Expected: one output for each render, replaced after each pass, as text and HTML.
    """
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
    texts = [table._repr_mimebundle_((), ()) for shown in outputs for table in shown]
    assert [re.search(r"\d+/100 spp", text["text/plain"])[0] for text in texts] == [
        "50/100 spp",
        "100/100 spp",
        "25/100 spp",
        "100/100 spp",
    ]
    assert all("<pre" in text["text/html"] for text in texts)


def test_lines_come_now_and_then(monkeypatch):
    """Rationale: logs of farms are kept. Expected: nothing in the first ten seconds; then a line every ten,
    and in long renders every fiftieth of their time.
    """
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    lines = progress.Lines(stream=stream)

    def at(seconds, done, **more):
        now[0] = seconds
        lines(report(done, seconds=seconds, rays=seconds * 10**6, **more))
        return stream.getvalue().splitlines()

    assert not at(9.0, 5)
    assert at(11.0, 5) == ["00:00:11   5% 5/100 spp, 1 M rays/s, 209 s left"]
    assert len(at(20.0, 9)) == 1 and len(at(22.0, 10, error=0.25)) == 2
    assert at(22.0, 10)[-1].endswith(", relMSE 0.25")
    assert len(at(3000.0, 60)) == 3 and len(at(3050.0, 61)) == 3 and len(at(3070.0, 61)) == 4


def test_which_display(monkeypatch):
    """Expected: of pytest, whose standard error is no terminal, lines, unless asked for something else."""
    kinds = {"auto": "Lines", "bar": "Bar", "lines": "Lines", "none": "Display"}
    for name in progress.KINDS:
        shown = progress.display(name)
        assert type(shown).__name__ == kinds[name]
        shown(report(1))
        shown.close()


def test_a_report_has_the_image_so_far():
    """Rationale: who watches a render wants to see it. Expected: the image of the first pass is what its
    snapshot is assembled to; of the last pass the render's, whose film holds it once; of an older report
    there is none any more.
    """
    scene = mi.load_dict(mi.cornell_box() | {"integrator": {"type": "path"}})
    parameters = mi.traverse(scene)
    parameters["sensor.film.size"] = [16, 16]
    parameters.update()
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
    with pytest.raises(UsageError, match="came too late"):
        reports[0].image()
    integrator.on_pass = None
    assert np.allclose(integrator.assemble(first[0], scene), images[0], rtol=1e-4, atol=1e-6)
