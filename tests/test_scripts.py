"""What the scripts answer to a user's mistakes."""

import runpy
import shlex
import sys
from pathlib import Path

import equal_time
import matplotlib.image
import mistakes
import mitsuba as mi
import numpy as np
import pytest
import reference

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"

ROOM = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective">
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/>
            <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="sphere"><point name="center" x="0" y="0" z="3"/></shape>
</scene>"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory with a scene, text that is neither TOML nor a scene, and no references."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reference, "REFERENCES", tmp_path)
    Path("room.xml").write_text(ROOM)
    Path("words.toml").write_text("scenes = [")
    Path("broken").mkdir()
    Path("broken/rows.parquet").write_text("cut short")
    return tmp_path


def by_user(monkeypatch, script, *arguments):
    """The exit status of a script, run as a user does but for the process."""
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPTS / script), run_name="__main__")
    return ended.value.code


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("candidates.py nowhere", "scene='nowhere' is not in scenes/"),
        ("compare.py bdpt path --scenes nowhere", "scene='nowhere' is not in scenes/"),
        ("compare_ptracer.py --only=no-such-case --page missing.md", "missing.md"),
        ("endurance.py --show --record .", "Is a directory"),
        (
            "equal_time.py scenes/nowhere",
            "neither a file nor the name of one in scenes/; there are ajar_door",
        ),
        ("equal_time.py cornell_box -o a.jpg", "output='a.jpg' must end in .png"),
        ("equal_time.py room.xml", "give one with --reference"),
        ("equal_time.py room.xml --reference words.toml", "'words.toml' is not an EXR"),
        ("equal_time.py words.toml --reference flat.exr", "Parsing of XML"),
        ("equal_time.py room.xml --reference flat.exr -i nope bdpt", "nope"),
        ("equal_time.py room.xml --reference flat.exr -i 'bdpt skip=some'", "bdpt: skip='some' is not known"),
        ("equal_time.py room.xml --reference flat.exr -i 'bdpt nothing' path", "the form KEY=VALUE"),
        ("fireflies.py nowhere", "scene='nowhere' is not in scenes/"),
        ("floor.py nowhere", "scene='nowhere' is not in scenes/"),
        ("overhead.py nowhere", "scene='nowhere' is not in scenes/"),
        ("page.py broken", "broken: rows.parquet is missing or not whole; run scripts/sweep.py"),
        ("page.py . -o a.pdf", "output='a.pdf' must end in .html"),
        ("page.py . -o words.toml/a.html", "words.toml"),
        ("point_error.py nowhere", "scene='nowhere' is not in scenes/"),
        ("report.py nowhere", "nowhere: rows.parquet is missing or not whole; run scripts/sweep.py"),
        ("stopping.py nowhere", "scene='nowhere' is not in scenes/"),
        ("strategies.py nowhere", "scene='nowhere' is neither a file"),
        ("strategies.py room.xml -o words.toml/a", "words.toml"),
        ("strategies.py room.xml --max-depth 1", "max_depth=1 has no strategies"),
        ("strategies.py room.xml --heuristic some", "bdpt: heuristic='some' is not known"),
        ("strategy_noise.py nowhere", "scene='nowhere' is not in scenes/"),
        ("sweep.py nowhere.toml", "nowhere.toml"),
        ("sweep.py words.toml", "words.toml is not TOML"),
        (f"sweep.py {SCRIPTS.parent / 'presets' / 'small.toml'} -o words.toml", "words.toml"),
    ],
)
def test_mistakes_are_answered_in_one_line(here, monkeypatch, capsys, command, message):
    """Expected: one line on standard error that names what is wrong, status 2, no traceback."""
    reference.write_exr(Path("flat.exr"), {"": np.ones((8, 8, 3))}, {})
    script, *words = shlex.split(command)
    assert by_user(monkeypatch, script, *words) == 2
    error = capsys.readouterr().err
    (line,) = [line for line in error.splitlines() if line.startswith("error: ")]
    assert message in line and "Traceback" not in error


def test_bugs_are_not_taken_for_mistakes():
    """Expected: what neither a check of this project nor the system nor Mitsuba's parser raised is raised."""

    def plugin(error):
        return RuntimeError(f"[parser.cpp:1] At x: Traceback (most recent call last):\n  File y\n{error}")

    def raised(error):
        raise error

    for bug in (
        lambda: np.zeros(2) + np.zeros(3),
        lambda: int("x"),
        lambda: {}["x"],
        lambda: raised(plugin("TypeError: unsupported operand")),
        lambda: raised(RuntimeError("drjit: something")),
    ):
        with pytest.raises((ValueError, KeyError, RuntimeError)):
            mistakes.answered(bug)
    # This file is not among the scripts, so neither is its own `raise`.
    with pytest.raises(ValueError, match="own"):
        mistakes.answered(lambda: raised(ValueError("own")))


def test_equal_time_of_a_scene_file(here, capsys):
    """Rationale: only names in scenes/ were taken. Expected: a file with a reference of its own gives the
    picture; one of another size is refused."""
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file("room.xml")
    path = mi.load_dict({"type": "path", "max_depth": 3})
    assert equal_time.depth_of(scene.integrator()) == 3 == equal_time.depth_of(path)
    assert equal_time.depth_of(mi.load_dict({"type": "path"})) == -1 == equal_time.depth_of(None)
    for size, name in ((8, "right.exr"), (4, "wrong.exr")):
        reference.write_exr(Path(name), {"": np.ones((size, size, 3))}, {})
    arguments = ["room.xml", "--spp", "2", "-o", "a/b.png", "--reference"]
    assert equal_time.main([*arguments, "right.exr"]) == 0
    assert matplotlib.image.imread("a/b.png").ndim == 3
    assert "bdpt, 2 spp" in capsys.readouterr().out
    with pytest.raises(ValueError, match="has 4 x 4 pixels, the film of 'room.xml' 8 x 8"):
        equal_time.main([*arguments, "wrong.exr"])
