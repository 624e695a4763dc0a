"""scripts/scale.py: its scenes, its edits, and what its tables say."""

import re

import mitsuba as mi
import numpy as np
import pytest
import scale


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Scenes with meshes write files into the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", scale.KINDS)
def test_scenes_have_as_many_objects_as_their_rows_say(folder, name):
    """Expected: every scene of a row loads; one more object is one more shape or emitter, where objects are
    counted. The lamp of a mesh has as many triangles as it can have of two a square."""
    kind = scale.KINDS[name]
    scene = mi.load_dict(kind.scene(kind.sizes[0]), optimize=False)
    assert kind.spp(kind.sizes[0]) >= 1
    if name in {"spheres", "instances", "materials"}:
        assert len(scene.shapes()) == kind.sizes[0] + 2  # the floor and the lamp
    if name in {"lamps", "textured lamps"}:
        assert len(scene.emitters()) == kind.sizes[0]
    if name == "lamp mesh":
        (lamp,) = [shape for shape in scene.shapes() if shape.is_mesh() and shape.is_emitter()]
        assert lamp.face_count() == pytest.approx(kind.sizes[0], rel=0.05) and lamp.has_vertex_normals()


@pytest.mark.parametrize("name", [name for name, key in scale.EDITS.items() if key])
def test_edits_change_the_image(folder, name):
    """Expected: another image after the edit by `path` with the same seed, and another one after the next."""
    scene, path = mi.load_dict(scale.edited(name)), mi.load_dict({"type": "path", "max_depth": 2})
    images = []
    for seed in range(3):
        scale.edit(scene, name, seed)
        images.append(np.array(mi.render(scene, integrator=path, spp=1, seed=0)))
    assert not np.array_equal(images[0], images[1]) and not np.array_equal(images[1], images[2])


def row(kind, size, path, bdpt):
    """A row of these warm processor seconds."""
    each = {"first": 1.0, "first_wall": 1.0, "warm_wall": 1.0, "memory": 2**30}
    times = {"path": path, "bdpt": bdpt, "alone": path}
    return {"kind": kind, "size": size, "seconds": 1.0} | {
        method: each | {"warm": seconds} for method, seconds in times.items()
    }


def test_figures_are_ratios_over_path():
    """Expected: 1,000 lamps more that take 0.5 s more than with `path` are 0.5 ms each; a filter's ratio is
    over that of the box filter; what was not measured is said to be not measured."""
    rows = [row("lamps", 100, 0.1, 0.3), row("lamps", 1100, 0.2, 0.9)]
    assert scale.slope(rows, rows[1], "bdpt") == pytest.approx(0.5)
    assert scale.slope(rows, rows[1], "alone") == 0
    assert scale.cells(rows, rows[0])[7] == "–" and scale.cells(rows, rows[1])[5] == "4.5x"
    filters = [row("filters", "box", 1, 2), row("filters", "gaussian", 2, 5)]
    text, again = (
        re.sub(" +", " ", scale.goals({"rows": rows}))
        for rows in (filters, [filters[0], row("filters", "gaussian", 2, 4)])
    )
    assert "| filters, gaussian, ratio over that of the box filter | 1.1 | 1.25 | **no** |" in text
    assert "| 1.1 | 1 | yes |" in again
    assert "| lamps, 1,000, warm render | 1.5 | not measured | – |" in text


def test_what_a_pixel_takes_to_an_error():
    """Expected: three times the time at a twelfth of the variance take a fourth to the same error; of rows
    without a variance nothing is said."""
    shown = row("samples", 100, 1, 3)
    assert scale.effort(shown, "bdpt") is None and scale.cells([shown], shown)[-2:] == ["–", "–"]
    for method, variance in (("path", 1e-6), ("bdpt", 1e-6 / 12), ("alone", 1e-6)):
        shown[method] = shown[method] | {"variance": variance}
    assert scale.effort(shown, "bdpt") == pytest.approx(1 / 4)
    assert scale.cells([shown], shown)[-2:] == ["0.25x", "1x"] and len(scale.cells([shown], shown)) == len(
        scale.HEAD
    )


def test_goals_are_of_rows_that_are_measured():
    """Expected: kind, size, method and figure of each goal exist; no slope of a first row."""
    for goal in scale.GOALS:
        sizes = scale.KINDS[goal.kind].sizes
        assert goal.size in sizes and goal.method in scale.METHODS and goal.figure in scale.FIGURES
        assert goal.figure != "slope" or goal.size != sizes[0]
