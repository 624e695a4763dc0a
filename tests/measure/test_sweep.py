"""Sweeps: what is stored, what a restart keeps, what is refused."""

import csv
import itertools
import json
import math
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pandas as pd
import pyarrow
import pyarrow.parquet
import pytest
from mitsuba_bdpt.cli.arguments import build_parser
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.files import whole
from mitsuba_bdpt.files.images import write_layers
from mitsuba_bdpt.files.texts import write_json
from mitsuba_bdpt.measure import (
    making,
    metrics,
    reference,
    report,
    showing,
    sweep,
)
from mitsuba_bdpt.measure.preset import read_preset
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.results import cell_file, errors, image_file, keep_missing, missing_of, write_tables
from mitsuba_bdpt.measure.scenes import path_tracers
from mitsuba_bdpt.measure.timing import Timed
from repository import PROJECT, ROOT
from support import measured
from support.measured import new_project

PRESET = """
resolution = 8
max_depth = 3
seeds = 2
scenes = ["cornell_box"]
spp = [2, 4]
[[integrator]]
name = "ours"
type = "bdpt"
[[integrator]]
type = "path"
match = "seconds"
"""


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A project whose sweep of `PRESET` into out/ is over."""
    folder = new_project(tmp_path_factory.mktemp("done"))
    assert sweep_of(folder, preset_file(folder), "-o", folder / "out", "--reference-seconds", 60) == 0
    return folder


@pytest.fixture
def known(done, folder):
    """The project of the test has the reference of `PRESET`."""
    for file in (done / "references").glob("*.exr"):
        shutil.copy(file, folder / "references")


@pytest.fixture
def finished(done, folder, known):
    """The words of a sweep of `PRESET` in the project of the test that is over, and its folder."""
    shutil.copytree(done / "out", folder / "out")
    return (preset_file(folder), "-o", folder / "out"), folder / "out"


@pytest.fixture
def swept(folder):
    """Sweeps the preset in a file, errors raised: the exit status."""

    return partial(sweep_of, folder)


def sweep_of(folder, path, *more):
    words = ["sweep", str(path), "--project", str(folder), *map(str, more)]
    return sweep.run(build_parser().parse_args(words))


def rows_of(output):
    return pyarrow.parquet.read_table(output / "rows.parquet").to_pylist()


def reference_of(project, max_depth, name="cornell_box"):
    return reference.load_reference(project, project.scene(name), 8, max_depth)


def preset_file(folder, text=PRESET):
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


# -- sweeps -----------------------------------------------------------------------------------


def test_a_sweep_writes_a_row_per_render_and_goes_on(finished, monkeypatch, swept, folder, capsys):
    words, output = finished
    table = rows_of(output)
    assert len(table) == 8 and (output / "rows.csv").read_text().count("\n") == 9
    assert {(r["method"], r["budget"], r["seed"]) for r in table} == {
        (m, b, s) for m in ("ours", "path") for b in (2, 4) for s in (1, 2)
    }
    for row in table:
        assert row["seconds"] > 0 and row["rel_mse_trimmed"] <= row["rel_mse"] and row["max_depth"] == 3
        assert row["spp"] == row["budget"] or row["method"] == "path"
        assert row["first"] == "ours" and row["seconds_pilot"] >= 0 and "cores" in row["machine"]
        assert json.loads(row["parameters"])["type"] in ("bdpt", "path")
    assert all(r["rays_camera"] > 0 for r in table if r["method"] == "ours")
    (output / "cells" / f"{table[3]['key']}.json").unlink()
    rendered = []
    measure = sweep.measure
    monkeypatch.setattr(sweep, "measure", lambda b, c: rendered.append(c.key) or measure(b, c))
    assert swept(*words) == 0 and rendered == [table[3]["key"]] and len(rows_of(output)) == 8
    assert "stored renders" not in capsys.readouterr().out
    other = preset_file(folder, PRESET.replace("spp = [2, 4]", "spp = [2]"))
    assert swept(other, *words[1:]) == 0 and len(rows_of(output)) == 4
    others = len([*(output / "cells").iterdir()]) - 4
    assert others >= 4 and f"{others} stored renders of other presets" in capsys.readouterr().out


def test_one_scene_of_a_preset_anew(folder, job, swept, known):
    making.make(job(3, "furnace_emission"))
    text = PRESET.replace('["cornell_box"]', '["cornell_box", "furnace_emission"]')
    output = folder / "out"
    words = preset_file(folder, text), "-o", output
    assert swept(*words) == 0
    before = rows_of(output)
    for file in (output / "cells").iterdir():
        file.unlink()
    assert swept(*words, "--scenes", "furnace_emission") == 0
    after = rows_of(output)
    assert [row["key"] for row in after] == [row["key"] for row in before]
    kept = [row["scene"] == "cornell_box" for row in before]
    assert [a == b for a, b in zip(after, before, strict=True)] == kept and not all(kept) and any(kept)
    with pytest.raises(ValueError, match="--scenes pool: not in the preset, which has cornell_box, furn"):
        swept(*words, "--scenes", "pool")


class Clock(sweep.Bench):
    """Renders take 1 ms per sample by `ours` and 0.25 ms by others, and 1 s more the first time."""

    calls = []

    def timed(self, cell, spp, seed):
        first = (cell.method, spp) not in self.calls
        self.calls.append((cell.method, spp))
        seconds = spp * (1e-3 if cell.method == "ours" else 0.25e-3) + first
        return Timed(np.ones((8, 8, 3)) + 0.1 * seed, seconds, seconds)


def test_equal_time_by_a_clock(folder, monkeypatch, known, swept):
    """Stratified samplers get the nearest power of two: of 28 it is 32, of which multijitter makes 5 x 7."""
    text = PRESET.replace("[2, 4]", "[2, 3, 7]") + '[[integrator]]\nname = "strata"\ntype = "path"\n'
    text += 'sampler = "multijitter"\nmatch = "seconds"\n'
    output = folder / "out"
    monkeypatch.setattr(Clock, "calls", [])
    monkeypatch.setattr(sweep, "Bench", Clock)
    assert swept(preset_file(folder, text), "-o", output) == 0
    table = rows_of(output)
    spp = {(r["method"], r["budget"]): r["spp"] for r in table}
    assert [spp["ours", b] for b in (2, 3, 7)] == [2, 3, 7]
    assert [spp["path", b] for b in (2, 3, 7)] == [8, 12, 28]
    assert [spp["strata", b] for b in (2, 3, 7)] == [8, 16, 35]
    assert all(r["seconds"] < 0.1 for r in table)
    assert len(list((output / "ratios").glob("*.json"))) == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's device that is always full")
def test_a_full_disk_leaves_the_old_image(folder):
    file = folder / "image.exr"
    write_layers(file, {"": np.ones((64, 64, 3))}, {})
    before = file.read_bytes()
    whole._temporary(file).symlink_to("/dev/full")
    with pytest.raises(OSError, match="could not be written whole .*; is the disk full.*image.exr"):
        write_layers(file, {"": np.random.default_rng(0).random((256, 256, 3))}, {})
    assert file.read_bytes() == before and not list(folder.glob(".*"))


def test_a_failing_cell_does_not_cost_the_others(folder, capsys, known, monkeypatch, swept):
    bad = 'type = "bdpt"\nname = "bad"\nlayers = "variance"'
    path = preset_file(folder, PRESET.replace('type = "path"', bad))
    words = path, "-o", folder / "out"
    assert swept(*words) == 1
    out = capsys.readouterr().out
    failed = re.findall(r"failed: cornell_box, \d spp, seed \d, bad: bdpt: layers=variance", out)
    assert len(failed) == 4 and ": 4 rows" in out

    def interrupted(bench, cell):
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        swept(*words)


def test_a_plugin_that_does_not_exist_is_refused(folder, job, swept):
    path = preset_file(folder, PRESET.replace('type = "path"', 'type = "no_such_plugin"\nname = "bad"'))
    with pytest.raises(CommandError, match="integrator 'bad': .*no_such_plugin"):
        swept(path, "-o", folder / "out")
    assert not (folder / "out").exists()


KILLED = """
import os, signal
replace, cells = os.replace, []

def killed(source, target):
    cells.extend([target] if "/cells/" in str(target) else [])
    if len(cells) == 6:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)

os.replace = killed
"""


def test_a_killed_sweep_loses_one_cell_at_most(folder, project, known):
    path, output = preset_file(folder, PRESET.replace("seeds = 2", "seeds = 10")), folder / "out"
    code = (
        "import sys; from mitsuba_bdpt.cli.arguments import main\n"
        f"sys.exit(main(['sweep', {str(path)!r}, '-o', {str(output)!r}, '--project', {str(folder)!r}]))\n"
    )
    done = subprocess.run([sys.executable, "-c", KILLED + code], stdout=subprocess.DEVNULL)
    assert done.returncode == -signal.SIGKILL
    kept = {p: json.loads(p.read_text()) for p in (output / "cells").glob("*.json")}
    assert len(kept) == 5
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(list((output / "cells").glob("*.json"))) == 40
    assert all(json.loads(p.read_text()) == row for p, row in kept.items())


def test_flip_is_of_the_first_seed():
    image = np.random.default_rng(1).random((8, 8, 3)) + 0.5
    ref = reference.Reference(np.ones((8, 8, 3)), np.zeros((8, 8, 3)), None, {})
    assert errors(image, ref, "", False)["flip"] is None
    assert errors(ref.image, ref, "", True)["flip"] == 0


def test_rows_follow_a_better_reference(finished, monkeypatch, project, swept):
    words, output = finished
    before = rows_of(output)
    kept = reference_of(project, 3)
    better = replace(kept, image=1.25 * kept.image, difference=0 * kept.image)
    reference.write(reference.reference_path(project, "cornell_box", 8, 3), better)
    monkeypatch.setattr(sweep, "measure", None)
    assert swept(*words) == 0
    after = rows_of(output)
    for a, b in zip(before, after, strict=True):
        assert a["seconds"] == b["seconds"] and a["mean"] == pytest.approx(b["mean"], rel=1e-6)
        assert b["rel_mse"] != a["rel_mse"] and b["reference_rel_mse"] == 0
    with OpenEXR.File(str(next((output / "images").glob(f"*_{after[0]['key'][:8]}.exr"))), True) as file:
        pixels = np.stack([file.channels()[c].pixels for c in "RGB"], axis=-1).astype(np.float64)
    new = reference_of(project, 3).image
    assert after[0]["rel_mse"] == pytest.approx(metrics.rel_mse(pixels, new))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("resolution = 8", "resolution = 50"), "tiny.toml: resolution=50: .* multiple of 4"),
        (('["cornell_box"]', '["cornell_box", "cornell_box"]'), "names one twice"),
        (("[2, 4]", "[2, 2]"), r"spp=\[2, 2\] must differ"),
        (("[2, 4]", "[true]"), r"spp.0=True: .* integer"),
        (("seeds = 2", "seeds = [1, 2, 3]"), r"seeds=\[1, 2, 3\] be as many"),
        (("seeds = 2", "seed = 2"), "seed=2: unknown; did you mean seeds.* known: scenes, res"),
        (('scenes = ["cornell_box"]', ""), "scenes is missing"),
        (("cornell_box", "nowhere"), "scene='nowhere'"),
        (('type = "bdpt"', 'type = "bdpt"\nseeds = 1'), "the first integrator, 'ours', sets the time"),
        (('type = "bdpt"', 'type = "bdpt"\nmatch = "seconds"'), "the first integrator, 'ours', sets"),
        (('match = "seconds"', 'scenes = ["pool"]'), "scenes of integrator 'path': 'pool' is not among"),
        (('type = "path"', 'name = "path"'), "tiny.toml: integrator.1.type=.*: Field required"),
        (('type = "path"', 'type = "path"\nmax_depth = 3'), "max_depth of one integrator would compare"),
        (('type = "path"', 'type = "path"\nname = "ours"'), "two integrators have the same name"),
        (('match = "seconds"', "x = [1]"), r"integrator.1.x=\[1\]: must be a number, a text"),
        (('match = "seconds"', "[scene.pool]\nspp = [1]\nseeds = 1"), r"\[scene.pool\]: 'pool' is not among"),
        (
            ('match = "seconds"', "[scene.cornell_box]\ndepth = 1"),
            "depth=1: unknown; .* known: max_depth, spp",
        ),
        (('match = "seconds"', "[more]\nspp = 4"), "more={'spp': 4}: unknown; known: scenes"),
    ],
)
def test_mistakes_in_a_preset_are_named(tmp_path, edit, message):
    with pytest.raises(CommandError, match=message):
        read_preset(preset_file(tmp_path, PRESET.replace(*edit)), PROJECT)


@pytest.mark.parametrize("path", sorted((ROOT / "presets").glob("*.toml")), ids=lambda p: p.stem)
def test_presets_are_read(path):
    named = ["cornell_box"] if path.stem == "public" else None
    for method in read_preset(path, PROJECT, named).cells[0].methods:
        mi.load_dict(dict(method.parameters))


def test_rivals_are_those_that_see_the_media():
    names = ["cornell_box", "lamp_behind_glass", "fog_lamp", "skin_ball", "cloud_sky"]
    tracers = {"path", "path multijitter", "ptracer"}, {"volpath", "volpathmis"}
    for cells in read_preset(PROJECT.preset("benchmark"), PROJECT, names).cells:
        has_media, rendered = cells.scene.has_media, {m.name for m in cells.methods}
        assert has_media == (cells.scene.name in ("fog_lamp", "skin_ball", "cloud_sky"))
        assert tracers[has_media] <= rendered and not tracers[not has_media] & rendered
        assert set(path_tracers(has_media)) <= tracers[has_media]


def test_three_lines_are_a_preset(tmp_path):
    text = 'scenes = ["cornell_box", "fog_lamp"]\nspp = [4, 16]\nseeds = 5\n'
    cells = read_preset(preset_file(tmp_path, text), PROJECT).cells
    assert [[m.name for m in one.methods] for one in cells] == [["bdpt", "path"], ["bdpt", "volpath"]]
    assert {m.match for one in cells for m in one.methods[1:]} == {"seconds"}
    assert [(one.resolution, one.spp, one.seeds) for one in cells] == [(128, (4, 16), (5, 5))] * 2
    (one,) = read_preset({"seeds": 3}, PROJECT, scenes=["cornell_box"]).cells
    assert one.scene.name == "cornell_box" and one.spp == (4, 16, 64) and one.seeds == (3, 3, 3)


SCENE = (ROOT / "scenes" / "cornell_box.xml").read_text()


@pytest.fixture
def others(tmp_path):
    """A folder of other people's scenes: folders with a scene file each, one of which lacks a mesh."""
    for name in ("attic", "broken", "cellar"):
        (tmp_path / "theirs" / name).mkdir(parents=True)
        (tmp_path / "theirs" / name / "scene_v3.xml").write_text(SCENE)
    gone = '<shape type="ply"><string name="filename" value="gone.ply"/></shape></scene>'
    (tmp_path / "theirs" / "broken" / "scene_v3.xml").write_text(SCENE.replace("</scene>", gone))
    return tmp_path / "theirs"


OPEN = 'resolution = 8\nmax_depth = 3\nseeds = 2\nspp = [2]\n[[integrator]]\ntype = "bdpt"\n'


def test_a_folder_of_scenes_is_a_preset(tmp_path, others, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for pattern in (f"{others}/*/scene_v3.xml", "theirs/*/*.xml", "~/theirs/*/scene_v?.xml"):
        text = f'scenes = ["{pattern}"]\n{OPEN}'
        preset = read_preset(preset_file(tmp_path, text), Project(tmp_path))
        assert [one.scene.name for one in preset.cells] == ["attic", "cellar"]
        assert preset.scenes == ("attic", "broken", "cellar")
        (said,) = preset.left_out
        assert said.startswith("broken: left out: ") and "gone.ply" in said
    with pytest.raises(CommandError, match=r"scenes='theirs/\*.xml' matches no file"):
        Project(tmp_path).matching("theirs/*.xml")
    file = preset_file(tmp_path, f'scenes = ["theirs/broken/scene_v3.xml"]\n{OPEN}')
    with pytest.raises(CommandError, match="no scene can be measured: broken: left out: .*gone.ply"):
        read_preset(file, Project(tmp_path))
    assert Project(tmp_path).scene(str(others / "attic" / "scene_v3.xml")).name == "attic"
    for stem, name in (("scene", "attic"), ("Scene_v0.6", "attic"), ("scenery", "scenery"), ("room", "room")):
        (others / "attic" / f"{stem}.xml").write_text(SCENE)
        assert Project(tmp_path).scene(str(others / "attic" / f"{stem}.xml")).name == name


def test_scenes_of_the_command_line(tmp_path, others, swept, capsys):
    file = preset_file(tmp_path, OPEN)
    output = tmp_path / "out"
    with pytest.raises(CommandError, match="scenes is missing; list them, or name scene files by --scenes"):
        swept(file, "-o", output)
    named = "-o", output, "--reference-seconds", 0, "--scenes"
    assert swept(file, *named, others / "attic" / "scene_v3.xml", others / "broken" / "scene_v3.xml") == 1
    said = capsys.readouterr().out
    assert said.startswith("broken: left out: ") and "2 rows\nfailed: broken: left out: " in said
    assert swept(file, *named, others / "cellar" / "scene_v3.xml") == 0
    before = sorted((output / "cells").iterdir())
    assert swept(file, *named, others / "attic" / "scene_v3.xml") == 0
    assert sorted((output / "cells").iterdir()) == before and len(before) == 4
    found = list(csv.DictReader((output / "rows.csv").read_text().splitlines()))
    assert [row["scene"] for row in found] == ["attic", "attic", "cellar", "cellar"]


def test_widths_fit_the_film(tmp_path, others):
    for name, sides in (("attic", (12, 10)), ("cellar", (1009, 4))):
        text = SCENE
        for side in sides:
            text = text.replace('value="$resolution"', f'value="{side}"', 1)
        (others / name / "scene_v3.xml").write_text(text)
    preset = read_preset({"scenes": [f"{others}/[ac]*/scene_v3.xml"], "spp": [2]}, Project(tmp_path))
    (cells,) = preset.cells
    assert cells.scene.name == "attic" and cells.resolution == 120 and cells.scene.size(120) == (120, 100)
    assert "1009 x 4 pixels, which divides into 4 x 4 tiles at no width near 128" in preset.left_out[0]


def test_time_left_follows_from_work(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("rich.console.monotonic", lambda: clock[0])
    works = [4, 4, 8]
    with showing.Renders(works) as made, showing.Renders(works, 25) as limited:
        assert made.seconds_left() == math.inf and limited.seconds_left() == 25
        for shown in (made, limited):
            shown.begin("box")
        clock[0] = 10
        for shown in (made, limited):
            shown.end("box", 4)
        assert made.seconds_left() == 30 and limited.seconds_left() == 15


def test_a_time_limit_is_of_everything(tmp_path, monkeypatch):
    text = PRESET.replace('["cornell_box"]', '["cornell_box", "pool"]')
    preset = read_preset(preset_file(tmp_path, text), Project(new_project(tmp_path)))
    asked, limits, clock = [], [], [0.0]
    monkeypatch.setattr(sweep, "obtained", lambda job: asked.append(job.seconds))
    for given, found in (((None, 100.0), 25), ((None, math.inf), 600), ((7.0, 100.0), 7)):
        sweep.Sweep(preset, tmp_path).prepare(*given)
        assert asked[-2:] == [found, found]
    monkeypatch.setattr(sweep.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(sweep.Sweep, "run", lambda self, seconds: limits.append(seconds))
    monkeypatch.setattr(sweep.Sweep, "rows", lambda self: pd.DataFrame())
    for spent, left in ((10.0, 90.0), (170.0, 0.0)):

        def prepared(self, *_, spent=spent):
            clock[0] += spent

        monkeypatch.setattr(sweep.Sweep, "prepare", prepared)
        sweep_of(tmp_path, tmp_path / "tiny.toml", "--seconds", 100, "-o", tmp_path / "out")
        assert limits[-1] == left


def test_the_table_is_tidy(tmp_path):
    values = {"sampler": "multijitter", "spp": 16, "budget": 8, "key": "abc", "rays_camera": 7, "flip": None}
    values |= {"parameters": '{"type": "path", "rr_depth": 3}', "variance": 0.25, "energy": 0.9}
    one = measured.row("path multijitter", **values)
    table = pd.DataFrame([one, one | {"seed": 2, "key": "gone"}])
    stored = image_file(tmp_path, table.iloc[0])
    stored.parent.mkdir()
    stored.write_bytes(b"an image")
    write_tables(table, tmp_path)
    first, second = csv.DictReader((tmp_path / "rows.csv").read_text().splitlines())
    assert not [cell for cell in first.values() if set(cell) & set("{}[]")]
    assert first["sampler"] == "multijitter"
    assert first["parameters"] == "path rr_depth=3" and first["integrator"] == "path multijitter"
    assert [first[name] for name in ("variance", "energy", "rays_camera", "flip")] == ["0.25", "0.9", "7", ""]
    assert first["image"] == stored.name == "box_path-multijitter_8_1_abc.exr" and second["image"] == ""
    (kept, _) = json.loads((tmp_path / "rows.json").read_text())
    assert kept["parameters"] == {"type": "path", "rr_depth": 3}
    assert set(pyarrow.parquet.read_table(tmp_path / "rows.parquet").column_names) == set(one)
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.parametrize("points", ["sobol", "independent"])
def test_samplers_of_rows_are_those_of_the_table(folder, known, swept, points):
    own = f'type = "bdpt"\nsampler = "multijitter"\npoints = "{points}"\n'
    text = PRESET.replace('type = "bdpt"\n', own).replace("[2, 4]", "[2]")
    assert swept(preset_file(folder, text), "-o", folder / "out") == 0
    table = pd.read_csv(folder / "out" / "rows.csv")
    assert len(table) == 4
    assert set(zip(table["integrator"], table["sampler"], strict=True)) == {
        ("ours", points),
        ("path", "independent"),
    }


def test_what_time_does_not_allow_is_cut(folder, monkeypatch):
    """Two integrators and seeds; a budget takes twice as long where it compiles: 8, 16, 4 and 8 s."""
    preset = read_preset(preset_file(folder), Project(folder))
    found, clock = [], [0.0]
    monkeypatch.setattr(sweep.time, "monotonic", lambda: clock[0])

    def rendered(self, progress, bench, cell):
        is_first = (cell.method, cell.budget) not in {(c.method, c.budget) for c in found}
        clock[0] += cell.budget * (1 + is_first)
        found.append(cell)
        return float(cell.budget)

    def swept(seconds):
        found.clear()
        made = sweep.Sweep(preset, folder)
        made.run(seconds)
        keys = [(cell.seed, cell.budget) for cell in found]
        assert keys[::2] == keys[1::2]  # both integrators
        return keys[::2], made

    monkeypatch.setattr(sweep.Sweep, "_cell", rendered)
    every, made = swept(100)
    assert every == [(1, 2), (1, 4), (2, 2), (2, 4)] and not made.cut and made.wanted == 0
    keys, made = swept(29)
    assert keys == every[:3]
    assert made.cut == {"cornell_box": "2 of 8 renders: 2 at 4 spp"} and made.wanted == 10
    keys, made = swept(23)
    assert keys == [(1, 2), (2, 2)] and made.cut == {"cornell_box": "4 of 8 renders: 4 at 4 spp"}
    assert made.wanted == 40
    assert swept(0)[0] == [(1, 2), (2, 2)]


def test_the_limit_is_shared_by_scenes_that_lack_renders(tmp_path, monkeypatch):
    text = PRESET.replace('["cornell_box"]', '["cornell_box", "pool", "furnace_emission"]')
    made = sweep.Sweep(read_preset(preset_file(tmp_path, text), PROJECT), tmp_path)
    clock, shares = [0.0], []
    monkeypatch.setattr(sweep.time, "monotonic", lambda: clock[0])

    class Scene:
        """Renders four times for 10 s each, but no more than twice in a share; of the pool nothing lacks."""

        needed, text = 7.0, "text"

        def __init__(self, cells, output):
            self.cells, self.done = cells, 4 * (cells.scene.name == "pool")

        @property
        def late(self):
            return self.cells.planned[: 4 - self.done]

        def render(self, rendered, seconds):
            shares.append(seconds)
            count = min(int(seconds // 10), 2, 4 - self.done)
            self.done, clock[0] = self.done + count, clock[0] + 10 * count
            return count

    monkeypatch.setattr(sweep, "Pending", Scene)
    made.run(74)
    assert shares[:4] == [37, 54, 17, 24] and made.wanted == 9  # of one scene, 7 s and a quarter more
    assert made.cut == {"furnace_emission": "text"} or made.cut == {"cornell_box": "text"}


def test_a_second_run_uses_the_seconds_of_the_first(folder, monkeypatch, known):
    path, output = preset_file(folder, PRESET.replace("[2, 4]", "[2, 64, 6400]")), folder / "out"
    monkeypatch.setattr(sweep, "Bench", Clock)
    made = sweep.Sweep(read_preset(path, Project(folder)), output)
    (cells,) = made.scenes
    for cell in cells.planned:
        if cell.budget < 6400:
            write_json(cell_file(output, cell), {"seconds": 0.001 * cell.budget})
    made.run(0.1)
    assert made.cut == {"cornell_box": "4 of 12 renders: 4 at 6400 spp"}
    assert made.wanted == math.ceil(1.25 * 2 * 4 * 6.4)


def test_seconds_of_larger_budgets_are_extrapolated(tmp_path):
    """At least half of the proportion, for noise."""
    preset = read_preset(preset_file(tmp_path, PRESET.replace("[2, 4]", "[2, 4, 16]")), PROJECT)
    made = sweep.Pending(preset.cells[0], tmp_path)
    for known, budget, expected in (
        ({}, 4, 0),
        ({2: 0.7}, 4, 0.7 + 0.35 * 2),
        ({2: 0.7, 4: 0.9}, 16, 0.9 + max(0.1, 0.5 * 0.9 / 4) * 12),
        ({2: 0.7, 4: 0.9}, 2, 0.7),
        ({4: 0.8}, 2, 0.4),
    ):
        made._seconds["ours"] = known
        assert made._seconds_of("ours", budget) == pytest.approx(expected)


def test_equal_time_is_measured_at_a_budget_that_time_allows(folder, monkeypatch):
    """1.25 ms a sample of both; a quarter of 1.6 s holds 320 renders of 5 ms."""
    text = PRESET.replace("[2, 4]", "[4, 40, 400]")
    (cells,) = read_preset(preset_file(folder, text), Project(folder)).cells
    monkeypatch.setattr(Clock, "timed", lambda self, cell, spp, seed: Timed(None, spp * PER[cell.method], 0))
    monkeypatch.setattr(Clock, "warm", lambda self, cell, spp: None)
    for seconds, budget in ((0.016, 4), (1.6, 40), (math.inf, 400)):
        bench = Clock(cells, folder / f"{budget}", seconds)
        assert bench.spp_of(cells.of(4, 1)[1]) == 16 and bench.spp_of(cells.of(400, 1)[1]) == 1600
        assert bench.equal(cells.of(4, 1)[1])["spp"] == budget


PER = {"ours": 1e-3, "path": 0.25e-3}


def test_the_report_begins_with_what_was_cut(folder, monkeypatch, capsys, known, swept):
    path, output = preset_file(folder), folder / "out"
    monkeypatch.setattr(sweep, "Bench", Clock)
    words = path, "-o", output
    assert swept(*words, "--seconds", "1e-9") == 0
    assert "cut for lack of time: cornell_box, 4 of 8 renders: 4 at 4 spp" in capsys.readouterr().out
    text = report.Report.of(Project(folder), output).text()
    assert "`cornell_box`, 4 of 8 renders: 4 at 4 spp." in text
    assert f"mitsuba-bdpt sweep {path} -o {output} --project {folder} --seconds " in text
    measure, count = sweep.measure, itertools.count()

    def interrupted(bench, cell):
        if next(count):
            raise KeyboardInterrupt
        return measure(bench, cell)

    with monkeypatch.context() as patched:
        patched.setattr(sweep, "measure", interrupted)
        with pytest.raises(KeyboardInterrupt):
            swept(*words)
    assert len(rows_of(output)) == 5
    missing = missing_of(output)
    assert missing["cornell_box"]["text"] == "3 of 8 renders: 3 at 4 spp"
    assert "--seconds" not in missing["cornell_box"]["command"]
    keep_missing(output, ["another"], {}, "")
    assert missing_of(output) == missing != {}
    assert swept(*words) == 0 and missing_of(output) == {}
    assert "warning" not in capsys.readouterr().out


def keys(folder, text=PRESET):
    return {cell.key for cell in read_preset(preset_file(folder, text), PROJECT).cells[0].planned}


def test_cells_are_named_after_all_that_determines_them(tmp_path, monkeypatch):
    names = keys(tmp_path)
    assert len(names) == 8
    assert not names & keys(tmp_path, PRESET.replace("max_depth = 3", "max_depth = 4"))
    assert len(names | keys(tmp_path, PRESET.replace("seeds = 2", "seeds = [2, 3]"))) == 10
    fewer = keys(tmp_path, PRESET.replace('match = "seconds"', 'match = "seconds"\nseeds = 1'))
    assert len(fewer) == 6 and fewer < names
    monkeypatch.setattr("mitsuba_bdpt.measure.preset.source_digest", lambda: "edited")
    assert not names & keys(tmp_path)
