"""Scenes of other people: what is found in their folder, what is a reference, what the checks say."""

import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import public_checks
import public_scenes
import public_table
import public_texts
import pytest
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.files.images import write_layers
from mitsuba_bdpt.measure import estimates, given, making, metrics, sweep
from mitsuba_bdpt.measure.agreement import Means, apart, compare_means
from mitsuba_bdpt.measure.analysis import ALONE, NONE, Results
from mitsuba_bdpt.measure.making import Job
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.scenes import SceneFile
from mitsuba_bdpt.measure.sweep import Bench

SCENES = Path(__file__).resolve().parents[2] / "scenes"
BROKEN = """<scene version="3.0.0">
    <sensor type="perspective"/>
    <shape type="obj"><string name="filename" value="gone.obj"/></shape>
</scene>"""
TINY = ["--spp", "4", "--seeds", "8", "--resolution", "16", "--reference-seconds", "0"]


def rendered(file, integrator, size=32, spp=1024):
    scene = mi.load_file(str(file), resolution=size)
    made = mi.load_dict({"type": integrator, "max_depth": 8})
    return np.array(mi.render(scene, integrator=made, spp=spp, seed=99), dtype=np.float64)[..., :3]


class Clock(Bench):
    """Renders take 1 ms per sample, those of `path` half of it: the same samples each time, and no chance."""

    def timed(self, cell, spp, seed):
        seconds = spp * (0.5e-3 if cell.method == "path" else 1e-3)
        return super().timed(cell, spp, seed)._replace(seconds=seconds)


def test_the_command_on_scenes_of_this_project(tmp_path, capsys, monkeypatch):
    """Rationale: one command for a folder of other people's scenes. Expected: a scene of a folder of its own
    with a reference beside it that `path` made, at twice the size; one that is a file, in which `path` misses
    all light of a point lamp behind glass, which its reference, made here, has; and one whose mesh is gone,
    which is named with the reason, and costs the others nothing but the exit status. What is right is not
    called wrong; a TungstenRender.exr is not taken. A second run renders nothing."""
    monkeypatch.setattr(sweep, "Bench", Clock)
    folder, output = tmp_path / "public", tmp_path / "out"
    for name in ("box", "broken"):
        (folder / name).mkdir(parents=True)
    shutil.copy(SCENES / "cornell_box.xml", folder / "box" / "scene_v3.xml")
    (folder / "broken" / "scene.xml").write_text(BROKEN)
    shutil.copy(SCENES / "lamp_behind_glass.xml", folder / "point.xml")
    (folder / "meshes").mkdir()
    shutil.copy(SCENES / "meshes" / "cut_glass.ply", folder / "meshes")
    write_layers(
        folder / "box" / "Reference.exr", {"": rendered(folder / "box" / "scene_v3.xml", "path")}, {}
    )
    write_layers(folder / "box" / "TungstenRender.exr", {"": np.ones((4, 4, 3))}, {})
    words = [str(folder), "-o", str(output), *TINY]
    assert public_scenes.main(words) == 1
    shown = capsys.readouterr().out
    table, summary = ((output / name).read_text() for name in ("table.md", "summary.md"))
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    lines = {line[0]: line[1:] for line in cells if line and line[0].startswith("`")}
    assert list(lines) == ["`point` †", "`box`", "`point`"]
    assert len(lines["`point` †"]) == 6 and all("x (" in cell for cell in lines["`point` †"][2:])
    size, depth, samples, reference, own, path, ours = lines["`box`"]
    assert (size, depth, path, ours) == ("16 x 16", "8", "nothing", "passed")
    assert reference == "given: Reference.exr" and 0 <= float(own[:-1]) < 20
    assert all(
        text in samples for text in ("path 8,", "path tracing alone 4,", "`skip=none` 4,", "default 4;")
    )
    assert "made, 2048 spp" in table and "all energy is missing" in lines["`point`"][5]
    for text in (shown, summary):
        assert "2 of 3 scenes were rendered" in text and "Left out: broken: " in text and "gone.obj" in text
        assert "`path` misses energy in 1 of 2 scenes: `point`, " in text
        assert "Biased by us: 0 of 2 scenes." in text
    assert "* `broken`: " in table
    page = (output / "page.html").read_text()
    assert all(f'id="scene-{name}"' in page or f"#scene-{name}" in page for name in ("box", "point"))
    assert "broken" not in page
    before = sorted((output / "cells").iterdir())
    assert len(before) == 2 * 4 * 8 and public_scenes.main([*words, "--scenes", "box"]) == 0
    assert sorted((output / "cells").iterdir()) == before
    assert [(output / name).read_text() for name in ("table.md", "summary.md")] == [table, summary]
    assert len((output / "rows.csv").read_text().splitlines()) == 1 + len(before)
    # A reference is another one now: the whole folder takes the errors anew; without the scene of it the
    # others' texts are written all the same.
    (reference,) = (output / "references").glob("box_*.exr")
    for more, others in (
        ([], "2 of 3 scenes were rendered"),
        (["--scenes", "point"], "1 of 3 scenes were rendered"),
    ):
        reference.write_bytes(reference.read_bytes() + b"0")
        assert public_scenes.main([*words, *more]) == int(not more)
        said = (output / "summary.md").read_text()
        assert others in said and ("box: its reference is another one now" in said) == bool(more)


def test_scenes_are_found_in_both_layouts(tmp_path):
    """Expected: files by their names, folders by theirs, scene_v3.xml before scene.xml before the only one;
    folders of meshes are no scenes; what is ambiguous is left out with the reason."""
    names = (
        "a.xml",
        "b/scene.xml",
        "b/scene_v3.xml",
        "c/c.xml",
        "c/part.xml",
        "d/only.xml",
        "e/x.xml",
        "e/y.xml",
    )
    for name in (*names, "a/scene.xml", "meshes/m.ply", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    files, left_out = public_scenes.found_in(tmp_path)
    there = {name: str(path.relative_to(tmp_path)) for name, path in files.items()}
    assert there == {"a": "a.xml", "b": "b/scene_v3.xml", "c": "c/c.xml", "d": "d/only.xml"}
    assert left_out == {
        "a/": "a.xml beside it has the same name; rename one",
        "e": "several scene files: x.xml, y.xml; call the one to render scene.xml",
    }


def test_what_is_taken_for_a_reference(tmp_path):
    """Expected: NAME.exr before reference.exr, in any case of letters; nothing else; no reference.exr for
    files that share a folder; no texture of the scene."""
    (tmp_path / "room").mkdir()
    for file in (tmp_path / "room" / "scene.xml", tmp_path / "hall.xml"):
        file.write_text('<scene version="3.0.0"><string name="filename" value="room.exr"/></scene>')
    taken = []
    for name in ("TungstenRender.exr", "Reference.EXR", "room.exr", "ROOM.exr"):
        (tmp_path / "room" / name).touch()
        found, others = public_scenes.references_beside("room", tmp_path / "room" / "scene.xml", tmp_path)
        taken.append((found and found.name, others))
    foreign = "TungstenRender.exr"
    assert taken[:3] == [(None, (foreign,)), ("Reference.EXR", (foreign,)), ("Reference.EXR", (foreign,))]
    assert taken[3] == ("ROOM.exr", ("Reference.EXR", foreign))
    for name, expected in (("reference.exr", None), ("hall.exr", "hall.exr")):
        (tmp_path / name).touch()
        found, others = public_scenes.references_beside("hall", tmp_path / "hall.xml", tmp_path)
        assert (found and found.name) == expected and not others


def test_a_given_image_is_reduced_by_areas():
    """Expected: pixels that are covered in part count in part; the mean stays."""
    image = np.arange(3.0 * 5 * 3).reshape(3, 5, 3)
    small = given.reduced(image, 2, 2)
    assert small.mean() == pytest.approx(image.mean())
    top = (image[0] + 0.5 * image[1]) / 1.5
    np.testing.assert_allclose(small[0, 0], (top[0] + top[1] + 0.5 * top[2]) / 2.5)
    np.testing.assert_allclose(given.reduced(image, 5, 3), image)


def test_the_own_error_of_a_given_image():
    """Rationale: nobody tells how noisy such an image is. Expected: the relMSE of its noise to the truth,
    within a tenth, though the renders that tell it are five times as noisy: it is the mean of 40,000 products
    of standard deviation 0.01^2 + 0.05^2 / 8, which leaves 2e-6 of 1e-4; and less for a right image."""
    rng = np.random.default_rng(5)
    truth = rng.uniform(1, 2, (100, 133, 3))
    renders = [truth * (1 + 0.05 * rng.standard_normal(truth.shape)) for _ in range(16)]
    noisy = truth * (1 + 0.01 * rng.standard_normal(truth.shape))
    found = given.own_errors(noisy, renders)["rel_mse"]
    assert found == pytest.approx(metrics.rel_mse(noisy, truth), rel=0.1)
    assert given.own_errors(truth, renders)["rel_mse_trimmed"] < 0.1 * found


def test_fireflies_of_a_given_image():
    """Rationale: a pixel that is ten times too bright in the image given adds to each raw error, and to no
    trimmed one. Expected: the error of a render is 0.05^2 all the same, once the image's own is known."""
    rng = np.random.default_rng(6)
    truth = rng.uniform(1, 2, (100, 133, 3))
    renders = [truth * (1 + 0.05 * rng.standard_normal(truth.shape)) for _ in range(16)]
    image = truth.copy()
    image[40, 50] *= 10
    own = given.own_errors(image, renders)
    errors = {error: metrics.rel_mse(renders[0], image, trim) for error, trim in given.TRIMS.items()}
    rows = given.with_own_errors([errors], own)
    expected = metrics.rel_mse(renders[0], truth)
    for error in given.TRIMS:
        ((found,), bound) = estimates.seed_errors(rows, error, False)
        assert bound == "" and found == pytest.approx(expected, rel=0.03)
    assert own["rel_mse"] == pytest.approx(0.9**2 * 3 / truth.size, rel=0.05)


def test_images_that_cannot_be_references_are_refused(tmp_path):
    """Expected: smaller ones, those of another shape and those with NaN, each in words."""
    job = Job(Project(tmp_path), SceneFile("box", SCENES / "cornell_box.xml"), 16, 3)
    hole = np.ones((32, 32, 3))
    hole[3, 4] = np.nan
    for image, words in (
        (np.ones((8, 8, 3)), "8 x 8 pixels, less than the 16 x 16"),
        (np.ones((32, 48, 3)), "the film of the scene another shape"),
        (hole, "values that are not finite"),
    ):
        write_layers(tmp_path / "image.exr", {"": image}, {})
        with pytest.raises(CommandError, match=words):
            given.adopt(job, tmp_path / "image.exr")
    assert not list((tmp_path / "references").glob("*"))


def test_images_that_cannot_be_references_cost_no_scene(tmp_path):
    """Expected: one beside the scene that is too small is noted, and a reference is made; one that was asked
    for is an error; one that is brighter than half precision holds is taken as it is; of others beside the
    scene a note says how they are taken."""
    job = Job(Project(tmp_path), SceneFile("box", SCENES / "cornell_box.xml"), 16, 3, spp=4, seconds=0)
    file = tmp_path / "box.exr"
    write_layers(file, {"": np.ones((4, 4, 3))}, {})
    made, notes = public_scenes.referenced(job, public_scenes.Found(job.scene, file, False))
    assert not made.given and "`box.exr` beside it cannot be its reference" in notes[0]
    with pytest.raises(CommandError, match="4 x 4 pixels, less than"):
        public_scenes.referenced(job, public_scenes.Found(job.scene, file, True))
    write_layers(file, {"": np.full((16, 16, 3), 1e5)}, {}, np.float32)
    kept, notes = public_scenes.referenced(job, public_scenes.Found(job.scene, file, False))
    assert kept.given and (kept.image == 1e5).all() and not notes
    others = ("TungstenRender.exr",)
    made, notes = public_scenes.referenced(job, public_scenes.Found(job.scene, None, False, others))
    assert not made.given and "--reference box=TungstenRender.exr takes it" in notes[0]


def test_what_another_run_left_stays(tmp_path):
    """Expected: a folder with the rows of another sweep is refused; where no scene can be rendered, the texts
    say so, and the rows of former runs are gone; with --scenes they stay."""
    scenes, output = tmp_path / "scenes", tmp_path / "out"
    (scenes / "broken").mkdir(parents=True)
    (scenes / "broken" / "scene.xml").write_text(BROKEN)
    output.mkdir()
    (output / "rows.csv").write_text("scene\n")
    with pytest.raises(CommandError, match=r"rows\.csv' exists and is of another sweep"):
        public_scenes.main([str(scenes), "-o", str(output), *TINY])
    assert (output / "rows.csv").read_text() == "scene\n"
    (output / "table.md").write_text(public_table.MARK)
    assert public_scenes.main([str(scenes), "-o", str(output), *TINY]) == 1
    assert "0 of 1 scenes were rendered" in (output / "summary.md").read_text()
    assert "gone.obj" in (output / "table.md").read_text() and not (output / "rows.csv").exists()
    assert not (output / "rows.parquet").exists()
    texts = public_texts.Texts.of(output, ["broken", "new"], False)
    assert list(texts.left_out) == ["broken"] and not public_texts.Texts.of(output, ["broken"], True).left_out


def test_a_given_image_gives_way_to_one_that_is_made(tmp_path):
    """Rationale: it claims no error of its own, and a reference that the time has cut short replaces no
    better one. Expected: it is stored once, and again when another image is given; forgotten, one is made."""
    job = Job(Project(tmp_path), SceneFile("box", SCENES / "cornell_box.xml"), 16, 3, spp=4, seconds=0)
    for value in (1.0, 2.0):
        write_layers(tmp_path / "image.exr", {"": np.full((32, 32, 3), value)}, {})
        for _ in range(2):
            kept = given.adopt(job, tmp_path / "image.exr")
            assert kept.given and (kept.image == value).all() and kept.means is None
    given.forget(job)
    assert job.stored is None
    made, _ = making.make(job)
    given.forget(job)
    assert not made.given and job.stored is not None


def sample(brightness, seeds=16, seed=0):
    """Columns of so many renders, of tiles that are so bright, 1 per cent of noise."""
    rng = np.random.default_rng(seed)
    bright = np.append(np.broadcast_to(brightness, 16), np.mean(brightness)).repeat(3)
    return bright * (1 + 0.01 * rng.standard_normal((seeds, 51)))


def one_tile(value):
    tiles = np.ones(16)
    tiles[6] = value
    return tiles


def test_where_renders_differ():
    """Expected: nowhere exactly where the bias check passes; else the tile that is darker, by its share."""
    even, dark = Means.of(sample(1.0)), Means.of(sample(one_tile(0.8), seed=1))
    assert not apart(even, Means.of(sample(1.0, seed=2)))
    (place,) = [place for place in apart(dark, even) if place.tile]
    assert place.tile == (1, 2) and place.share == pytest.approx(-0.2, abs=0.03)
    for value in (0.98, 0.985, 0.99, 0.995, 1.0):
        other = Means.of(sample(one_tile(value), seed=3))
        assert compare_means(other, even).passed == (not apart(other, even))


@pytest.mark.parametrize(
    ("brightness", "path", "wrong", "lacks"),
    [
        ({}, False, [], []),
        ({"path": 0.8, ALONE: 0.8}, True, [], ["path tracing alone"]),
        ({"path": 0.8, ALONE: 0.8, "bdpt": 0.8}, True, [], ["path tracing alone", "default"]),
        ({"bdpt": 0.9}, False, ["default is darker than `path` in tile 1,2"], []),
        ({NONE: 1.1}, False, ["`skip=none` is brighter than the reference in tile 1,2"], []),
        ({"path": 1.1, ALONE: 1.1}, False, ["`skip=none` is darker than `path`", "`path` is brighter"], []),
        ({ALONE: 1.1}, False, ["path tracing alone is brighter than `path` in tile 1,2"], []),
    ],
)
def test_who_is_wrong(brightness, path, wrong, lacks):
    """Expected: less light in `path` than in the reference is what `path` misses, and what others of ours
    miss with it is said; less than in `path`, more than in the reference, and path tracing alone that differs
    from `path` are errors of ours."""
    methods = ("bdpt", NONE, ALONE, "path")
    rows = [
        {"scene": "a", "method": method, "first": "bdpt", "budget": 64, "seed": seed, "tile_means": columns}
        for number, method in enumerate(methods)
        for seed, columns in enumerate(sample(one_tile(brightness.get(method, 1.0)), seed=number))
    ]
    results = Results(rows, {"a": Means.of(sample(1.0, 64, 9))}, {})
    found = public_checks.check(results, "a")
    assert bool(found.path) == path and list(found.lacks) == lacks and not found.unchecked
    assert ("of the energy is missing" in found.path and "1,2 (-20 %)" in found.path) or not path
    assert all(any(text in said for said in found.wrong) for text in wrong) and bool(wrong) == bool(
        found.wrong
    )
    few = [row for row in rows if row["seed"] < 7]
    assert "`path` has 7 renders" in public_checks.check(Results(few, {}, {}), "a").unchecked


@pytest.mark.parametrize(("given_tile", "disputed"), [(0.8, True), (0.99, False)])
def test_a_given_image_is_a_witness(given_tile, disputed):
    """Rationale: what `path` lacks beside `skip=none` is light that it misses, or light of ours that is not
    there. Expected: a given image that is as dark as `path` there makes it a dispute, which the summary calls
    so and no loss of `path`'s; one that is as bright as ours settles it."""
    rows = [row | {"statistics": '{"lost_light": {"lamp": 0.25}}'} for row in rows_of("a", (1, 1, 1), 0.8)]
    image = one_tile(given_tile).reshape(4, 4, 1) * np.ones(3)
    kept = Reference(image, 0 * image, None, {"given": "a.exr", "integrator": "given: a.exr"})
    findings = public_table.Findings(Results(rows, {}, {}), {"a": kept}, {}, {"a": ["so it is"]})
    words = findings.words()
    assert findings.checks["a"].disputed == disputed and bool(findings.wrong()) == disputed
    assert ("`path` misses energy in 0 of 1 scenes." in words) == disputed
    assert ("Either `path` and what made the given image miss energy in `a`" in words) == disputed
    assert "`a`: so it is." in words and "`a`: about 25.0% of its light" in words


def rows_of(scene, ratios, path=1.0):
    """Rows of eight seeds whose efficiencies over `path` are these, raw twice as much as trimmed."""
    methods = {ALONE: ratios[0], NONE: ratios[1], "bdpt": ratios[2], "path": 1.0}
    own = {"reference_rel_mse": 0.0, "reference_rel_mse_trimmed": 0.0}
    return [
        {"scene": scene, "method": method, "first": "bdpt", "budget": 64, "seed": seed, **own}
        | {"statistics": "{}", "spp": 64, "seconds": 2.0}
        | {"rel_mse": (1 if method == "path" else 0.5) / figure, "rel_mse_trimmed": 1 / figure}
        | {"tile_means": columns}
        for number, (method, figure) in enumerate(methods.items())
        for seed, columns in enumerate(sample(one_tile(path if method in ("path", ALONE) else 1), 8, number))
    ]


def test_the_summary_in_words():
    """Expected: geometric means of the medians, of the scenes with all figures, apart for those in which
    `path` finds all light; the worst of the default; where `path` misses light; a scene in which an
    integrator is exact has no part in the means, and is said."""
    rows = rows_of("a", (1, 0.5, 2)) + rows_of("b", (1, 0.5, 8)) + rows_of("c", (1, 0.5, 0.5), path=0.8)
    exact = {"bdpt": {"rel_mse": 0.0}}
    rows += [row | exact.get(row["method"], {}) for row in rows_of("d", (1, 1, 1))]
    reference = Means.of(sample(1.0, 64, 9))
    kept = Reference(np.ones((4, 4, 3)), np.zeros((4, 4, 3)), reference, {})
    results = Results(rows, dict.fromkeys("abcd", reference), {})
    words = public_table.Findings(results, dict.fromkeys("abcd", kept), {"e": "no sensor"}, {}).words()
    assert "4 of 5 scenes were rendered.\n* Left out: e: no sensor" in words
    alike = "path tracing alone 1x trimmed, 2x raw; `skip=none` 0.5x trimmed, 1x raw"
    for text in (
        f"of 2 scenes with all figures, where `path` finds all light: {alike}; default 4x trimmed, 8x raw.",
        f"of 3 scenes with all figures, also where `path` may miss light: {alike}; default 2x ",
        "The default's worst scene: `c`, 0.5x trimmed; `c`, 1x raw.",
        "`path` misses energy in 1 of 4 scenes: `c`, ",
        ": tile 1,2 (-20 %).",
        "Biased by us: 0 of 4 scenes.",
        "`c`: path tracing alone: darker than the reference, no more than `path`.",
        "`d`: no figure: bdpt is exact here.",
    ):
        assert text in words
