"""Measurements as functions, of scenes that are dictionaries."""

import json
from pathlib import Path

import mitsuba as mi
import pandas as pd
import pytest
from mitsuba_bdpt import measure
from mitsuba_bdpt.errors import FailureError
from mitsuba_bdpt.files.texts import write_text
from mitsuba_bdpt.measure import api, estimates, sweep
from mitsuba_bdpt.measure.reference import read_reference
from mitsuba_bdpt.measure.results import rel_mse_columns

PRESET = """
resolution = 8
scenes = ["room"]
spp = [4]
seeds = 2
max_depth = 3
[[integrator]]
type = "bdpt"
"""


def room(**more):
    """A lamp under the ceiling of a sphere, 16 x 8 pixels."""
    camera = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 8, "rfilter": {"type": "box"}},
    }
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 1, 0]).rotate([1, 0, 0], 90),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}},
    }
    walls = {"type": "sphere", "radius": 5, "flip_normals": True}
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 3}, "camera": camera}
    return scene | {"lamp": lamp, "walls": walls} | more


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda scene: scene["lamp"]["emitter"]["radiance"].update(value=[3, 2, 2]),
        lambda scene: scene["camera"].update(to_world=mi.ScalarTransform4f()),
        lambda scene: scene["walls"].update(bsdf={"type": "diffuse"}),
        lambda scene: Path("wall.ply").write_text("another mesh"),
    ],
    ids=["number", "transform", "plugin", "file"],
)
def test_a_dictionary_that_changes_is_another_scene(here, change):
    Path("wall.ply").write_text("a mesh")
    dictionary = room(mesh={"type": "ply", "filename": "wall.ply"})
    before, same = (found(dictionary) for _ in range(2))
    sha256 = before.sha256
    assert before.name == same.name and len([*Path("dictionaries").iterdir()]) == 1
    change(dictionary)
    after = found(measure.SceneDict("scene_v2", dictionary))
    assert after.sha256 != sha256 and after.name == "scene_v2"


def found(dictionary):
    """The scene of a dictionary, as the functions measure it."""
    with api._measured(dictionary, ".") as (project, (name,)):
        return project.scene(name)


def test_measurements_take_dictionaries(here):
    common = {"project": "project", "resolution": 8}
    mi.set_variant("llvm_ad_mono")
    reference = measure.make_reference(room(), seconds=0, spp=4, **common)
    assert reference.image.shape == (4, 8, 3) and reference.provenance["max_depth"] == 3
    named = measure.SceneDict("mine", room())
    table = measure.compare_integrators(
        [room(), named], "bdpt", {"type": "path", "sampler": "stratified"}, spp=4, pairs=1, **common
    )
    assert table.count("\n| `mine` ") == 1 and "\n| `scene_" in table
    path, bdpt = measure.compare_at_equal_time(named, spp=4, **common)
    assert (path.name, bdpt.name, bdpt.spp) == ("path", "bdpt", 4) and bdpt.image.shape == (4, 8, 3)
    kept = read_reference(Path("project/references/mine_8_3.exr"))
    row = pd.DataFrame([rel_mse_columns(bdpt.image, kept)])
    error = estimates.relative_error(row, "rel_mse_trimmed", False)
    assert bdpt.error == error and f"{error.total.value:.2g} (trimmed)" in bdpt.caption
    images = measure.render_pyramid(named, spp=1, max_depth=2, **common)
    assert images["weighted"].keys() == images["unweighted"].keys() >= {(2, 1, 2)}
    assert {"equal_time_mine.png", "pyramid_mine.exr"} <= {p.name for p in Path("project/renders").iterdir()}
    assert mi.variant() == "llvm_ad_mono"


def test_a_sweep_takes_dictionaries(here):
    Path("mine.toml").write_text(PRESET)
    dictionaries = [measure.SceneDict("room", room())]
    rows = measure.run_sweep("mine.toml", dictionaries, reference_seconds=0, output=Path("rows"))
    assert rows["seed"].tolist() == [1, 2] and (rows["rel_mse"] > 0).all()
    assert json.loads(rows["parameters"][0]) == {"type": "bdpt"}
    content = {"resolution": 8, "spp": [4], "seeds": 2, "max_depth": 3, "integrator": [{"type": "bdpt"}]}
    again = measure.run_sweep(content, dictionaries, reference_seconds=0, output=Path("rows"))
    assert again["key"].tolist() == rows["key"].tolist()  # nothing is rendered anew


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: measure.make_reference(room(), secnds=3), "unexpected keyword argument 'secnds'"),
        (lambda: measure.make_reference(room(), resolution=10), "resolution=10 must be .* divisible by 4"),
        (lambda: measure.make_reference(room(), by="light"), "by='light' must be one of path, bdpt, merging"),
        (
            lambda: measure.compare_integrators(room(), "bdpt", "path", spp=(4, 0)),
            "spp=.4, 0. must be a whole",
        ),
        (lambda: measure.compare_integrators(room(), "bdpt", {"skip": "none"}), "must be a type or a dict"),
        (lambda: measure.render_pyramid({"type": "sphere"}), "a dictionary of type 'scene'"),
        (
            lambda: measure.run_sweep({}, [measure.SceneDict("box", room())], project="named"),
            "'box' is the name of a file in 'named/scenes'; take another",
        ),
        (lambda: measure.render_pyramid(3), "scene=3 must be a file, a name or a dictionary"),
        (lambda: measure.render_pyramid("nowhere"), "scene='nowhere' is neither a scene file nor"),
        (lambda: measure.render_pyramid(room(), exposure=float("nan")), "exposure=nan must be a number"),
        *(
            (call, "must be a text or a path")
            for call in (
                lambda: measure.run_sweep({}, output=3),
                lambda: measure.run_sweep(3),
                lambda: measure.make_reference(room(), project=3),
                lambda: measure.run_sweep({}, scenes=[3]),
                lambda: measure.compare_at_equal_time(room(), reference=b"a.exr"),
                lambda: measure.compare_at_equal_time(room(), windows=(0.5, 0.5)),
            )
        ),
        (lambda: measure.render_pyramid(room(odd=object())), "could not assign an object of type 'object'"),
    ],
)
def test_what_cannot_be_measured_is_named(here, call, words):
    write_text(Path("named/scenes/box.xml"), "")
    with pytest.raises((ValueError, RuntimeError, TypeError), match=words):
        call()


def test_paths_may_be_texts(here):
    mine = measure.SceneDict("mine", room())
    preset, common = {"resolution": 8, "spp": [2], "seeds": 2}, {"project": "p", "reference_seconds": 0}
    assert len(measure.run_sweep(preset, [mine], output="rows", **common)) == 4
    image = str(next(Path("rows/images").glob("mine_*.exr")))
    measure.compare_at_equal_time(mine, reference=image, output="a.png", spp=2, resolution=8, **common)
    measure.render_pyramid(mine, output="b.exr", project="p", spp=2, resolution=8)
    assert Path("rows/rows.csv").is_file() and Path("a.png").is_file() and Path("b.exr").is_file()


def test_a_reference_of_another_dictionary_is_made_anew(here, capsys):
    common = {"project": "project", "resolution": 8, "spp": 4}
    measure.make_reference(measure.SceneDict("mine", room()), seconds=0, **common)
    edited = room()
    edited["walls"]["radius"] = 6
    mine = measure.SceneDict("mine", edited)
    measure.compare_integrators(mine, "bdpt", "path", pairs=1, reference_seconds=0, **common)
    said = capsys.readouterr().out
    assert (
        "mine: the scene has changed since its reference at 8 and depth 3 was made; making one anew" in said
    )
    assert "mitsuba-bdpt reference project/dictionaries/mine.xml --resolution 8 --max-depth 3 --spp 4" in said
    assert len([*Path("project/references").glob("mine_*.exr")]) == 1


def test_a_sweep_that_fails_is_no_usage_error(here, monkeypatch):
    Path("mine.toml").write_text(PRESET)
    monkeypatch.setattr(sweep, "swept", lambda *_: ([], ["room, 4 spp, seed 1: no memory"]))
    with pytest.raises(FailureError, match="1 failed: room, 4 spp, seed 1: no memory"):
        measure.run_sweep("mine.toml", [measure.SceneDict("room", room())])
