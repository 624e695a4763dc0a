"""scripts/scale.py: its scenes, its edits, and its figures."""

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
    scene, path = mi.load_dict(scale.edited(name)), mi.load_dict({"type": "path", "max_depth": 2})
    images = []
    for seed in range(3):
        scale.edit(scene, name, seed)
        images.append(np.array(mi.render(scene, integrator=path, spp=1, seed=0)))
    assert not np.array_equal(images[0], images[1]) and not np.array_equal(images[1], images[2])


def row(kind, size, path, bdpt):
    """A row of these warm processor seconds."""
    each = {"first": 1.0, "memory": 2**30}
    times = {"path": path, "bdpt": bdpt, "alone": path}
    return {"kind": kind, "size": size, "seconds": 1.0} | {
        method: each | {"warm": seconds} for method, seconds in times.items()
    }


def test_figures_are_ratios_over_path():
    """Expected: 1,000 lamps more that take 0.5 s more than with `path` are 0.5 ms each."""
    rows = [row("lamps", 100, 0.1, 0.3), row("lamps", 1100, 0.2, 0.9)]
    assert scale.slope(rows, rows[1], "bdpt") == pytest.approx(0.5)
    assert scale.slope(rows, rows[1], "alone") == 0


def test_what_a_pixel_takes_to_an_error():
    """Expected: three times the time at a twelfth of the variance take a fourth to the same error."""
    shown = row("samples", 100, 1, 3)
    assert scale.effort(shown, "bdpt") is None
    for method, variance in (("path", 1e-6), ("bdpt", 1e-6 / 12), ("alone", 1e-6)):
        shown[method] = shown[method] | {"variance": variance}
    assert scale.effort(shown, "bdpt") == pytest.approx(1 / 4)
