"""The commands that measure, on a scene file of a user's in a project folder of a user's."""

import importlib.resources
import importlib.util
import re
import shlex
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest
from mitsuba_bdpt.cli import measuring
from mitsuba_bdpt.cli.arguments import build_parser, main
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.measure import equal_time, making, reference, sweep, timing
from mitsuba_bdpt.measure.preset import read_preset
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.scenes import SceneFile
from repository import ROOT

# A child of a shape that no render takes.
REFUSED = f"""<medium type="homogeneous" name="interior"><volume type="gridvolume" name="sigma_t">
    <string name="filename" value="{ROOT}/scenes/volumes/cloud.vol"/></volume></medium>"""

# Nothing of it is as in this repository: a size that no parameter sets, Mitsuba's default filter and sampler,
# materials without names.
ROOM = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="64"/><integer name="height" value="{height}"/>
        </film>
        {sampler}
    </sensor>
    <shape type="sphere"><float name="radius" value="5"/><boolean name="flip_normals" value="true"/></shape>
    <shape type="obj"><string name="filename" value="lamp.obj"/>
        <emitter type="area"><rgb name="radiance" value="3, 2, 1"/></emitter></shape>
</scene>"""
LAMP = "v -1 1 0\nv 1 1 0\nv 0 1 1\nf 1 2 3\n"
STRATIFIED = '<sampler type="stratified"><integer name="sample_count" value="9"/></sampler>'

PRESET = """
resolution = 16
scenes = ["../elsewhere/room.xml"]
spp = [2, 4]
seeds = [8, 2]
[[integrator]]
type = "bdpt"
[[integrator]]
type = "path"
match = "seconds"
[[integrator]]
name = "power"
type = "bdpt"
heuristic = "power"
sampler = "multijitter"
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working directory with a scene and a project, in folders of their own."""
    monkeypatch.chdir(tmp_path)
    for folder in ("elsewhere", "project/presets"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "elsewhere" / "room.xml").write_text(ROOM.format(height=64, sampler=""))
    (tmp_path / "elsewhere" / "lamp.obj").write_text(LAMP)
    (tmp_path / "project" / "presets" / "mine.toml").write_text(PRESET)
    return tmp_path


@pytest.fixture
def command(capfd):
    """Runs a command that has to succeed without a warning; its output."""

    def run(*words):
        capfd.readouterr()
        status, said = main([*words]), capfd.readouterr()
        assert status == 0 and "Warning" not in said.err, said.err
        return said.out

    return run


@pytest.fixture
def refused(capsys):
    """Runs a command that has to answer with the exit status of a mistake; its last line."""

    def run(*words):
        assert main([*words]) == 2
        return capsys.readouterr().err.strip().splitlines()[-1]

    return run


def test_a_scene_of_the_users_is_swept_reported_and_shown(here, command):
    said = command("sweep", "mine", "--project", "project")
    assert "room: no reference at 16 and depth 4 yet; making one" in said and ": 30 rows" in said
    results = here / "project" / "results" / "mine"
    rows = pyarrow.parquet.read_table(results / "rows.parquet").to_pylist()
    assert {row["scene"] for row in rows} == {"room"} and len(rows) == 30
    assert {(row["width"], row["height"], row["max_depth"]) for row in rows} == {(16, 16, 4)}
    kept = reference.read_reference(here / "project" / "references" / "room_16_4.exr")
    assert kept.provenance["integrator"]["type"] == "bdpt" and kept.means.columns.freedom >= 7
    said = command("sweep", "project/presets/mine.toml", "--project", "project")
    assert "reference" not in said and ": 30 rows" in said
    command("report", "mine", "--project", "project")
    text = (results / "README.md").read_text()
    assert re.search("over path, trimmed .* over path, raw .* over power, trimmed .* over power, raw", text)
    assert re.search(r"\| `room` .*passed, p = ", text)
    for name in re.findall(r"\((\w+\.png)\)", text):
        assert (results / name).stat().st_size > 5000
    command("page", "mine", "--project", "project")
    page = (results / "page.html").read_text()
    assert 'href="#scene-room"' in page and "{{" not in page.partition("<script>")[0]
    assert not (here / "references").exists() and not (here / "results").exists()


def test_the_first_integrator_may_be_any(here):
    preset = here / "project" / "presets" / "alone.toml"
    head = PRESET.partition("[[integrator]]")[0]
    preset.write_text(head + '[[integrator]]\ntype = "path"\n')
    for words in (["sweep", "alone"], ["report", "alone"], ["page", "alone"]):
        assert main([*words, "--project", "project"]) == 0
    text = (here / "project" / "results" / "alone" / "README.md").read_text()
    assert "| `room` " in text and "efficiency.png" not in text


def test_commands_in_messages_can_be_pasted(here, capsys):
    project = here / "my project"
    (project / "presets").mkdir(parents=True)
    (project / "presets" / "mine.toml").write_text(PRESET)
    words = ["reference", "elsewhere/room.xml", "--resolution", "8", "--spp", "64", "--project", "my project"]
    assert main([*words, "--seconds", "0"]) == 1
    quoted = capsys.readouterr().out.partition("to go on: ")[2]
    program, *again = shlex.split(quoted)
    assert program == "mitsuba-bdpt" and build_parser().parse_args(again).project.name == "my project"
    assert main(again) == 0
    assert [file.name for file in (project / "references").iterdir()] == ["room_8_4.exr"]
    assert main(["report", "my project/results/mine", "--project", "my project"]) == 2
    quoted = capsys.readouterr().err.partition("; run ")[2]
    again = "sweep", "mine", "-o", "my project/results/mine", "--project", "my project"
    assert shlex.split(quoted)[1:] == list(again)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("reference nowhere", "nowhere: failed: scene='nowhere' is neither a scene file nor the name of one"),
        ("compare bdpt path --scenes nowhere", "give the path of an XML file, or put it into 'scenes'"),
        ("equal-time rooom --project named", "or a name; there are room; did you mean room?"),
        ("sweep nowhere", "nowhere"),
        ("report nowhere", "run mitsuba-bdpt sweep PRESET -o nowhere"),
        ("reference", "name a scene, or give --all, not both"),
        ("reference --all", "there is no scene in 'scenes'; name the folder that has scenes/ by --project"),
        ("reference --all elsewhere/room.xml", "name a scene, or give --all, not both"),
        ("reference elsewhere/room.xml --project badly", "[room]: by='light'"),
    ],
)
def test_mistakes_are_answered_with_what_to_do(here, capsys, words, message):
    (here / "named" / "scenes").mkdir(parents=True)
    (here / "named" / "scenes" / "room.xml").write_text(ROOM)
    (here / "badly" / "references").mkdir(parents=True)
    (here / "badly" / "references" / "scenes.toml").write_text('[room]\nby = "light"\n')
    (here / "lamp.obj").write_text(LAMP)
    assert main(words.split()) in (1, 2)
    said = capsys.readouterr()
    (line,) = (said.out + said.err).strip().splitlines()[-1:]
    assert message in line


@pytest.mark.parametrize(
    ("words", "made"),
    [
        ("reference elsewhere/room.xml --seconds 0", []),
        ("compare bdpt path --pairs 1 --spp 1 --reference-seconds 0 --scenes elsewhere/room.xml", []),
        ("equal-time elsewhere/room.xml --spp 1 --reference-seconds 0", ["equal_time_room.png"]),
    ],
    ids=["reference", "compare", "equal-time"],
)
def test_commands_take_the_users_scene_at_a_width_that_fits(here, capsys, words, made):
    """All do as `sweep`, and say it, first: of 64 x 36 pixels and a width of 16 these are 8 x 4."""
    (here / "elsewhere" / "room.xml").write_text(ROOM.format(height=36, sampler=""))
    assert main([*words.split(), "--resolution", "16"]) in (0, 1)
    said = capsys.readouterr().out
    assert said.startswith("room: rendered with 8 x 4 pixels: the 16 x 9 of resolution=16 do not divide")
    assert ("| `room` " in said) == (words.split()[0] == "compare")
    assert [file.name for file in (here / "references").iterdir()] == ["room_8_4.exr"]
    assert [file.name for file in here.glob("renders/*")] == made


def test_samples_are_those_that_a_sampler_takes(here, capfd):
    """Of 32 `multijitter` makes 5 x 7."""
    count = '<sampler type="independent"><integer name="sample_count" value="32"/></sampler>'
    (here / "elsewhere" / "room.xml").write_text(ROOM.format(height=64, sampler=count))
    preset = 'resolution = 8\nscenes = ["elsewhere/room.xml"]\nspp = [32]\nseeds = 2\n[[integrator]]\n'
    strata = 'name = "strata"\ntype = "path"\nsampler = "multijitter"\nmatch = "spp"\n'
    own = 'type = "bdpt"\nsampler = "multijitter"\n[[integrator]]\n'
    (here / "mine.toml").write_text(preset + own + strata)
    common = "--resolution", "8", "--reference-seconds", "0"
    room = "elsewhere/room.xml"
    assert main(["sweep", "mine.toml", "-o", "out", *common[2:]]) == 0
    rows = pyarrow.parquet.read_table(here / "out" / "rows.parquet").to_pylist()
    assert {(row["method"], row["spp"]) for row in rows} == {("bdpt", 32), ("strata", 35)}
    sides = "bdpt", "path sampler=multijitter"
    assert main(["compare", *sides, "--scenes", room, "--spp", "32", "--pairs", "1", *common]) == 0
    assert main(["equal-time", room, "--spp", "32", "--sampler", "multijitter", *common]) == 0
    said = capfd.readouterr()
    assert "rounded" not in said.out + said.err
    assert re.search(r"\| `room` +\| 32 / 35 +\|", said.out) and "bdpt, 32 spp" in said.out


def test_a_sample_is_timed_where_a_sampler_rounds_up(here, monkeypatch):
    head = 'resolution = 8\nscenes = ["elsewhere/room.xml"]\nspp = [32]\nseeds = 2\n[[integrator]]\n'
    strata = 'type = "path"\nsampler = "multijitter"\n'
    (here / "mine.toml").write_text(f'{head}type = "bdpt"\n[[integrator]]\n{strata}')
    (cells,) = read_preset(here / "mine.toml", Project(here)).cells

    def timed(self, cell, spp, seed):
        taken = 35.0 if (cell.sampler, spp) == ("multijitter", 32) else float(spp)
        return timing.Timed(np.ones((8, 8, 3)), taken, taken)

    monkeypatch.setattr(sweep.Bench, "timed", timed)
    bench = sweep.Bench(cells, here / "out")
    assert bench.equal(cells.of(32, 1)[1])["samples"] == pytest.approx(1)


@pytest.mark.parametrize("wanted", [64, 80])
@pytest.mark.parametrize(
    ("width", "height"),
    [("$resolution", "48"), ("160", "$resolution"), ("$resolution", "$resolution_y"), ("160", "48")],
)
def test_films_keep_their_shape(here, width, height, wanted):
    """Sizes from parameters of the file; without its crop window; of the first of two sensors."""
    defaults = {"resolution": 48 if height == "$resolution" else 160, "resolution_y": 48}
    declared = "".join(f'<default name="{name}" value="{value}"/>' for name, value in defaults.items())
    window = {"crop_offset_x": 4, "crop_offset_y": 4, "crop_width": 16, "crop_height": 8}
    cropped = "".join(f'<integer name="{name}" value="{value}"/>' for name, value in window.items())
    text = ROOM.format(height=height, sampler="").replace('value="64"', f'value="{width}"')
    text = text.replace("<integrator", f"{declared}<integrator", 1).replace("</film>", f"{cropped}</film>")
    second = '<sensor type="perspective"/></scene>'
    file = here / "elsewhere" / "room.xml"
    file.write_text(text.replace("</scene>", second))
    scene = SceneFile("room", file)
    nearest = making.fitted(scene, wanted)
    assert nearest == {64: 68, 80: 80}[wanted] and scene.size() == (160, 48)
    loaded = scene.load(nearest).sensors()[0].film()
    expected = nearest, round(0.3 * nearest)
    assert (*loaded.size(),) == (*loaded.crop_size(),) == scene.size(nearest) == expected


@pytest.mark.parametrize("sampler", ["", STRATIFIED, '<ref id="own"/>'])
def test_scenes_are_loaded_at_any_size_with_any_sampler(here, sampler):
    """Means of 2 x 2 pixels agree (box filters, the same light) to the noise of 1024 samples."""
    file = here / "elsewhere" / "room.xml"
    text = ROOM.format(height=32, sampler=sampler).replace(
        "<sensor", '<sampler type="independent" id="own"/><sensor'
    )
    file.write_text(text.replace("</film>", '<rfilter type="box"/></film>'))
    scene = SceneFile("room", file)
    loaded = scene.load(32, "multijitter")
    sensor = loaded.sensors()[0]
    assert [int(n) for n in sensor.film().size()] == [32, 16] == list(scene.size(32))
    assert "Multijitter" in sensor.sampler().class_name()
    whole = np.array(mi.render(scene.load(), spp=256))
    small = np.array(mi.render(loaded, spp=1024))
    means = whole.reshape(16, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(small - means).mean() < 0.05 * means.mean()
    assert scene.max_depth == 4


def test_recipes_say_what_makes_a_reference(here):
    references = here / "project" / "references"
    references.mkdir()
    recipe = references / "scenes.toml"
    words = ["reference", "elsewhere/room.xml", "--resolution", "8", "--spp", "1", "--seconds", "0"]
    words += ["--project", "project"]

    def maker(text, *more):
        recipe.write_text(f"[room]\n{text}\n")
        (references / "room_8_4.exr").unlink(missing_ok=True)
        main([*words, *more])
        return reference.read_reference(references / "room_8_4.exr").provenance["integrator"]

    assert maker("")["type"] == "bdpt"
    assert maker('by = "path"')["type"] == "path"
    assert maker('by = "path"', "--by", "bdpt")["type"] == "bdpt"
    assert maker('by = "merging"')["merging_radius"] == 0.25
    assert maker('by = "merging"\nmerging_radius = 0.5')["merging_radius"] == 0.5
    assert maker("radiance = { limit = 1.0, lacks = 2.0 }") == "known answer"
    assert (reference.read_reference(references / "room_8_4.exr").image == 0.875).all()
    for wrong, message in (
        ("windows = [[0.5, 0, 0.5, 1]]", "must be left, top, right, bottom"),
        ("merging_radius = 0.5", "merging_radius=0.5 needs by = 'merging'"),
    ):
        recipe.write_text(f"[room]\n{wrong}\n")
        with pytest.raises(CommandError, match=message):
            making.recipe_of(Project(here / "project"), "room")


@pytest.mark.parametrize("command", measuring.COMMANDS)
def test_without_the_extra_a_command_says_how_to_get_it(command, monkeypatch, capsys):
    arguments = ["bdpt", "path", "--scenes", "x"] if command == "compare" else ["x"]
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "scipy" else find(name))
    assert main([command, *arguments]) == measuring.mistakes.USAGE
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == f"error: {command} needs scipy; install them with: pip install 'mitsuba-bdpt[measure]'"


def test_the_parser_needs_nothing_of_the_extra():
    code = (
        "import sys\n"
        f"for name in {measuring.NEEDED!r}: sys.modules[name] = None\n"
        "from mitsuba_bdpt.cli import render\n"
        "from mitsuba_bdpt.cli.arguments import build_parser\n"
        "build_parser().format_help()\n"
        "found = {name for name in sys.modules if name.startswith('mitsuba_bdpt.measure')}\n"
        "assert found <= {f'mitsuba_bdpt.measure{name}' for name in ('', '.api', '.options')}\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_mistakes_that_only_a_render_finds_are_one_line(here, refused):
    room, preset = here / "elsewhere" / "room.xml", here / "project" / "presets" / "mine.toml"
    options = ["--scenes", str(room), "--resolution", "16", "--spp", "4", "--pairs", "1"]
    words = ["compare", "bdpt skp=none", "bdpt", *options, "--project", "project"]
    assert "bdpt: skp='none' is not a parameter; did you mean skip?" in refused(*words)
    words = ["compare", "bdpt max_depth=2", "path", *options, "--project", "project"]
    assert "max_depth=2 of 'bdpt' would compare different images" in refused(*words)
    preset.write_text(PRESET.replace('heuristic = "power"', 'heuristic = "pwer"'))
    assert "heuristic='pwer' is not known" in refused("sweep", "mine", "--project", "project")
    preset.write_text(PRESET.replace('sampler = "multijitter"', 'sampler = "multijiter"'))
    assert "sampler of 'power'" in refused("sweep", "mine", "--project", "project")
    assert not (here / "project" / "references").exists()
    room.write_text(ROOM.format(height=64, sampler="").replace("<emitter", f"{REFUSED}<emitter", 1))
    words = ["pyramid", str(room), "--resolution", "16", "--spp", "4", "--project", "project"]
    assert "sigma_t of class GridVolume" in refused(*words)


def test_a_sweep_says_what_its_reference_is_too_noisy_for(here, capsys, monkeypatch):
    preset = here / "project" / "presets" / "mine.toml"
    head = PRESET.partition("[[integrator]]")[0].replace("[8, 2]", "2").replace("[2, 4]", "[2, 64]")
    preset.write_text(head + '[[integrator]]\ntype = "bdpt"\n')
    room = ["reference", "elsewhere/room.xml", "--resolution", "16", "--project", "project"]
    with monkeypatch.context() as patched:
        patched.setattr(making, "LEAST_SPP", 1)  # of a reference
        assert main([*room, "--seconds", "0", "--spp", "1"]) == 1
    capsys.readouterr()
    words = ["sweep", "mine", "--project", "project", "-o", "out", "--reference-seconds", "0"]
    assert main(words) == 0
    _, noisy = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert noisy.startswith("warning: room: the reference is too noisy for the renders of bdpt at 64 spp")
    assert noisy.endswith("--spp 64 --seconds 600 --project project")
    assert main(shlex.split(noisy.partition("To go on: ")[2])[1:]) == 0
    capsys.readouterr()
    assert main(words) == 0 and "warning" not in capsys.readouterr().out


def test_damaged_files_are_named_with_what_to_do(here, capsys):
    preset = PRESET.partition("[[integrator]]")[0].replace("[8, 2]", "1") + '[[integrator]]\ntype = "path"\n'
    (here / "project" / "presets" / "mine.toml").write_text(preset)
    sweep_words = ["sweep", "mine", "--project", "project", "-o", "out", "--reference-seconds", "1"]
    assert main(sweep_words) == 0
    made = here / "project" / "references" / "room_16_4.exr"
    reference_words = ["reference", "elsewhere/room.xml", "--resolution", "16", "--project", "project"]
    reference_words += ["--spp", "1", "--seconds", "1"]
    report_words = ["report", "out", "--project", "project"]
    again, rows = ["equal-time", *reference_words[1:-2]], here / "out" / "rows.parquet"
    for file, keep, words, message in (
        (made, 2, report_words, "room_16_4.exr' is damaged .*; delete it, to make it anew"),
        (made, 20, again, "room_16_4.exr' is .*anew, by mitsuba-bdpt reference"),
        (rows, 2, [*sweep_words, "--scenes", "room"], "run the sweep without --scen"),
    ):
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // keep])
        capsys.readouterr()
        assert main(words) in (1, 2), file
        said = capsys.readouterr()
        assert re.search(message, said.out + said.err), (file, said)
        file.write_bytes(whole)


def test_folders_that_cannot_be_made_are_named_before_renders(here, capsys):
    (here / "project" / "references").write_text("")
    (here / "file").write_text("")
    words = ["--scenes", "elsewhere/room.xml", "--resolution", "16", "--project", "project"]
    compare, swept = ["compare", "bdpt", "path", *words], ["sweep", "mine", "--project", "project", "-o"]
    for command in (compare, [*swept, "a"]):
        assert main(command) == 2
        said = capsys.readouterr().err
        assert "the reference of room cannot be written into 'project/references' (File exists)" in said
    assert not (here / "a").exists()
    (here / "project" / "references").unlink()
    assert main([*swept, "file"]) == 2
    assert "output='file/rows.csv' cannot be written (File exists)" in capsys.readouterr().err
    assert not (here / "project" / "renders").exists()


def test_an_edited_scene_is_rendered_anew(here, capsys):
    text = (here / "elsewhere" / "room.xml").read_text()
    (here / "elsewhere" / "other.xml").write_text(text)
    head = PRESET.partition("[[integrator]]")[0].replace("[8, 2]", "2")
    preset = head.replace('"../elsewhere/room.xml"', '"elsewhere/room.xml", "elsewhere/other.xml"')
    (here / "mine.toml").write_text(f'{preset}[[integrator]]\ntype = "bdpt"\n')

    def swept(scene):
        (here / "elsewhere" / "room.xml").write_text(scene)
        assert main(["sweep", "mine.toml", "-o", "out", "--reference-seconds", "0"]) == 0
        found = pd.read_csv(here / "out" / "rows.csv").set_index("image")
        assert all((here / "out" / "images" / name).is_file() for name in found.index)
        return found["mean"].to_dict(), capsys.readouterr().out

    first, _ = swept(text)
    second, said = swept(text.replace("3, 2, 1", "6, 4, 2"))
    assert "room: the scene has changed since its reference at 16 and depth 4 was made" in said
    kept = first.keys() & second.keys()
    assert len(second) == 8 and len(kept) == 4 and all(name.startswith("other_") for name in kept)
    assert swept(text)[0] == first


def test_samples_of_a_render_that_stops_are_its_own(here, command):
    stopping = PRESET.split("[[integrator]]")[0].replace("[2, 4]", "[256]").replace("[8, 2]", "[1]")
    own = '[[integrator]]\ntype = "bdpt"\ntarget_error = 100.0\n'
    (here / "project" / "presets" / "mine.toml").write_text(stopping + own)
    command("sweep", "mine", "--project", "project", "-o", "out", "--reference-seconds", "1")
    rows = pd.read_csv(here / "out" / "rows.csv")
    assert (rows["budget"][0], rows["spp"][0]) == (256, 32)
    (here / "project" / "presets" / "mine.toml").write_text(stopping + own.replace("100.0", "1e-9"))
    said = command("sweep", "mine", "--project", "project", "-o", "out")
    assert "warning: room, 256 spp, seed 1, bdpt: ended before target_error=1e-09; give it more spp\n" in said


def test_one_scene_does_not_cost_a_sweep_the_others(here, capsys):
    room = ROOM.format(height=64, sampler="")
    lamp = re.search(r"<emitter.*</emitter>", room, re.DOTALL)[0]
    for name, text in (("dark", room.replace(lamp, "")), ("fog", room.replace(lamp, REFUSED + lamp))):
        (here / "elsewhere" / f"{name}.xml").write_text(text)
    preset = here / "project" / "presets" / "mine.toml"
    head = PRESET.partition("[[integrator]]")[0].replace("[2, 4]", "[2]").replace("[8, 2]", "2")
    listed = ", ".join(f'"elsewhere/{name}.xml"' for name in ("dark", "fog", "room"))
    preset.write_text(head.replace('"../elsewhere/room.xml"', listed) + '[[integrator]]\ntype = "bdpt"\n')
    words = ["sweep", "mine", "--project", "project", "-o", "out", "--reference-seconds", "1"]
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "failed: dark: left out: scene='dark' is black" in out and "max_depth=4" in out
    assert "failed: fog: left out: bdpt: medium" in out and "out: 2 rows" in out
    next((here / "out" / "cells").iterdir()).write_text("{")
    assert main([*words, "--scenes", "room"]) == 1
    assert re.search(r"failed: room: no rows: .*json' is damaged .*; delete it", capsys.readouterr().out)
    grey = '<film type="hdrfilm"><string name="pixel_format" value="luminance"/>'
    (here / "elsewhere" / "fog.xml").write_text(room.replace('<film type="hdrfilm">', grey))
    next((here / "project" / "references").glob("room*")).unlink()
    assert main(words) == 1
    said = capsys.readouterr().out
    assert "fog.xml': its film has no colours" in said.partition("making one")[0]


def test_samples_in_equal_time_are_matched_again(monkeypatch):
    """Of 3 s 200 samples, to 5 %; no further renders where the first ones take as long."""
    asked = []

    def seconds(scene, made, spp):
        asked.append(spp)
        return 1 + 0.01 * spp

    monkeypatch.setattr(equal_time, "seconds", seconds)
    monkeypatch.setattr(equal_time, "samples_taken", lambda scene, made, spp: spp)
    assert equal_time._samples_within(3.0, None, None, 64) == pytest.approx(200, rel=0.08)
    assert asked[0] == 64 and len(asked) <= 4
    asked.clear()
    assert equal_time._samples_within(1.64, None, None, 64) == 64 and asked == [64]
