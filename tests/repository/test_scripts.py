"""What the scripts answer to a user's mistakes."""

import re
import runpy
import shlex
import shutil
import sys
from functools import partial
from pathlib import Path

import matplotlib.image
import mitsuba as mi
import numpy as np
import pandas as pd
import planted_bugs
import pytest
import versus
from mitsuba_bdpt.cli import mistakes
from mitsuba_bdpt.cli.arguments import build_parser, main
from mitsuba_bdpt.errors import CommandError, UnsupportedError, UsageError
from mitsuba_bdpt.files.images import write_layers
from mitsuba_bdpt.measure import compare, equal_time
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.scenes import depth_of
from mitsuba_bdpt.measure.timing import Timed
from support.measured import ROOM

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory with a scene, text that is neither TOML nor a scene, and no references."""
    monkeypatch.chdir(tmp_path)
    Path("room.xml").write_text(ROOM)
    Path("words.toml").write_text("scenes = [")
    Path("broken").mkdir()
    Path("broken/rows.parquet").write_text("cut short")
    return tmp_path


def by_user(monkeypatch, command, *arguments):
    """The exit status of a script, or of a verb of the command, run as a user does but for the process."""
    if not command.endswith(".py"):
        try:
            return main([command, *arguments])
        except SystemExit as ended:
            return ended.code
    monkeypatch.setattr(sys, "argv", [command, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPTS / command), run_name="__main__")
    return ended.value.code


@pytest.mark.parametrize(
    ("command", "message"),
    [
        *(
            (f"{command} nowhere", "scene='nowhere' is neither a scene file nor the name of one")
            for command in (
                *("choices.py", "floor.py", "pyramid", "equal-time"),
                *("compare bdpt path --scenes", f"versus.py {SCRIPTS.parent} --scenes"),
            )
        ),
        ("equal-time room.xml -o a.jpg", "output='a.jpg' must end in .pdf, .svg, .png"),
        ("equal-time room.xml --reference words.toml", "'words.toml' is not an EXR"),
        ("equal-time words.toml --reference flat.exr", "Parsing of XML"),
        ("equal-time room.xml --reference flat.exr -i 'bdpt skip=some'", "bdpt: skip='some' is not known"),
        ("scale.py nothing", "kind='nothing' is not known; use some of spheres, "),
        ("planted_bugs.py nowhere", "no planted bug has 'nowhere' in its name"),
        ("page . -o a.pdf", "output='a.pdf' must end in .html"),
        ("page . -o words.toml/a.html", "words.toml"),
        ("report broken", "broken: rows.parquet is missing or not whole; run mitsuba-bdpt sweep"),
        ("pyramid room.xml -o words.toml/a", "words.toml"),
        ("pyramid room.xml --max-depth 1", "max_depth=1 has no strategies"),
        ("pyramid room.xml --heuristic some", "bdpt: heuristic='some' is not known"),
        ("sweep words.toml", "words.toml is not TOML"),
        ("versus.py nowhere", "checkout=nowhere has no integrators/mitsuba_bdpt; give a clone or a worktree"),
        *(
            (command, f"argument {command.split()[-2]}: got {command.split()[-1]!r}, which must be")
            for command in (
                "floor.py x --rounds 0",
                *("reference x --seconds nan", "pyramid x --seed -1", "versus.py x --pairs 0.5"),
            )
        ),
    ],
)
def test_mistakes_are_answered_in_one_line(here, monkeypatch, capsys, command, message):
    write_layers(Path("flat.exr"), {"": np.ones((8, 8, 3))}, {})
    script, *words = shlex.split(command)
    assert by_user(monkeypatch, script, *words) == 2
    error = capsys.readouterr().err
    (line,) = [line for line in error.splitlines() if "error: " in line]
    assert message in line and "Traceback" not in error


@pytest.mark.parametrize(
    ("command", "taken"),
    [
        ("equal-time room.xml --reference flat.exr -o a.png", "a.png"),
        ("pyramid room.xml -o a.exr", "a.png"),
        ("pyramid room.xml -o a.exr", "a.exr"),
        ("pyramid room.xml -o a.exr", "a_weighted.png"),
    ],
)
def test_a_file_of_another_format_is_not_overwritten(here, monkeypatch, capsys, command, taken):
    write_layers(Path("flat.exr"), {"": np.ones((8, 8, 3))}, {})
    Path(taken).write_text("precious")
    before = sorted(Path().iterdir())
    script, *words = command.split()
    assert by_user(monkeypatch, script, *words) == 2
    assert "would overwrite" in capsys.readouterr().err and Path(taken).read_text() == "precious"
    assert sorted(Path().iterdir()) == before


def test_a_comparison_with_what_has_no_error_is_refused():
    exact = pd.DataFrame({"rel_mse_trimmed": [0.0, 0.0]})
    (text,) = compare.line(exact, exact).values()
    assert text == "every value (trimmed) is exactly that of the reference"


@pytest.mark.parametrize(("second", "ratio", "bounds"), [(0.1, 4.0, ("", "")), (0.02, None, ("≥", "≤"))])
def test_a_comparison_is_of_the_errors_of_reports(second, ratio, bounds):
    """Noise of 20 %, and of 10 % or 2 %; a reference of 10 %. Expected: a ratio of variances of 4 within
    10 % (12,288 values), the efficiency its reciprocal; bounds below the reference's noise."""
    rng, truth = np.random.default_rng(1), np.ones((64, 64, 3))

    def noisy(sigma):
        return truth + sigma * rng.standard_normal(truth.shape)

    a, b = noisy(0.1 * 2**0.5), noisy(0.1 * 2**0.5)
    kept = Reference((a + b) / 2, (a - b) / 2, None, {})
    sides = [lambda spp, seed, sigma=sigma: Timed(noisy(sigma), 1.0, 1.0) for sigma in (0.2, second)]
    cells = compare.line(*compare.measured([partial(side, 4) for side in sides], kept, 3))
    for kind in ("trimmed", "raw"):
        *mark, value = cells[f"{kind} error"].split()
        assert "".join(mark) == bounds[0] and (ratio is None or float(value) == pytest.approx(ratio, rel=0.1))
        *mark, value, _ = cells[f"{kind} efficiency (quartiles)"].split()
        assert "".join(mark) == bounds[1]
        assert ratio is None or float(value) == pytest.approx(1 / ratio, rel=0.1)


COMMANDS = sorted(path.name for path in SCRIPTS.glob("*.py") if "__main__" in path.read_text())


@pytest.mark.parametrize("script", COMMANDS)
@pytest.mark.parametrize("words", [["--help"], ["--no-such-option"]], ids=" ".join)
def test_help_does_nothing_else(here, monkeypatch, capsys, script, words):
    """Expected: the usage or an error; no file, no render."""
    monkeypatch.setattr(mi, "render", lambda *args, **keys: pytest.fail("rendered"))
    monkeypatch.setattr(mi, "load_dict", lambda *args, **keys: pytest.fail("loaded"))
    before = sorted(here.rglob("*"))
    assert by_user(monkeypatch, script, *words) == (0 if words == ["--help"] else 2)
    shown = capsys.readouterr()
    assert (shown.out + shown.err).startswith(("usage: ", "mitsuba-bdpt "))
    assert sorted(here.rglob("*")) == before


def test_every_script_of_the_documents_exists():
    pages = SCRIPTS.parent / "README.md", *(SCRIPTS.parent / "docs").rglob("*.md")
    named = {name for page in pages for name in re.findall(r"python scripts/(\w+\.py)", page.read_text())}
    assert len(named) > 4 and named <= set(COMMANDS)


@pytest.mark.parametrize("bug", planted_bugs.BUGS, ids=lambda bug: bug.name)
def test_bugs_can_be_planted(bug, tmp_path):
    """`make planted-bugs` sees whether parameters of the tests exist."""
    copy = planted_bugs.planted(tmp_path, bug) / planted_bugs.PACKAGE.name / bug.file
    original = (planted_bugs.PACKAGE / bug.file).read_text()
    assert bug.old not in copy.read_text() or bug.old in bug.new
    assert copy.read_text() != original and compile(copy.read_text(), copy, "exec")
    for test in bug.tests:
        file, _, name = test.partition("::")
        function = name.partition("[")[0]
        assert f"\ndef {function}(" in (SCRIPTS.parent / file).read_text(), test


@pytest.mark.parametrize(
    ("status", "output", "fault"),
    [
        (0, "1 passed", "does not see the bug"),
        (1, "E   NameError: name 'x'", "fails by something else"),
        (1, "E       AssertionError: ", ""),
        (4, "no such test", "not run"),
    ],
)
def test_outcomes_of_planted_bugs_are_judged(status, output, fault):
    judged = planted_bugs.judged(status, output)
    assert judged.startswith(fault) and bool(judged) == bool(fault)


def test_bugs_are_not_taken_for_mistakes():
    """Only errors of this project's own types are about what a user gave."""

    plugin = "[parser.cpp:1] At x: Traceback (most recent call last):\n  File y\nTypeError: z"
    bugs = TypeError("x"), KeyError("x"), ValueError("x"), RuntimeError(plugin), RuntimeError("drjit: x")
    own = CommandError("own"), UsageError("own"), UnsupportedError("own")

    def raised(error):
        raise error

    for bug in bugs:
        with pytest.raises(type(bug)):
            mistakes.answered(lambda bug=bug: raised(bug))
    for error in own:
        assert mistakes.answered(lambda error=error: raised(error)) == mistakes.USAGE


def test_equal_time_of_a_scene_file(here, capsys):
    """Errors are upper bounds where the reference's own is not known; one of another size is refused."""
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file("room.xml")
    path = mi.load_dict({"type": "path", "max_depth": 3})
    assert depth_of(scene.integrator()) == 3 == depth_of(path)
    assert depth_of(mi.load_dict({"type": "path"})) == -1 == depth_of(None)
    for size, name in ((8, "right.exr"), (4, "wrong.exr")):
        write_layers(Path(name), {"": np.ones((size, size, 3))}, {})
    arguments = ["equal-time", "room.xml", "--spp", "2", "-o", "a/b.png", "--reference"]
    assert main([*arguments, "right.exr"]) == 0
    assert matplotlib.image.imread("a/b.png").ndim == 3
    out = capsys.readouterr().out
    assert "bdpt, 2 spp" in out and out.count("relMSE ≤ ") == 2
    with pytest.raises(ValueError, match="has 4 x 4 pixels, the film of 'room.xml' 8 x 8"):
        equal_time.run(build_parser().parse_args([*arguments, "wrong.exr"]))


def test_two_checkouts_are_compared(tmp_path, capsys):
    """This checkout, and one in which light subpaths are a hundredth as bright."""
    other = tmp_path / "other"
    shutil.copytree(SCRIPTS.parent / "integrators", other / "integrators")
    options = ["--scenes", "ring_caustic", "--spp", "4", "--pairs", "1", "--same"]
    assert versus.main([str(other), *options]) == 0
    module = other / "integrators" / "mitsuba_bdpt" / "transport" / "techniques.py"
    text = module.read_text()
    module.write_text(text.replace("def splat(", "def _splat(") + DIMMED)
    assert versus.main([str(other), *options]) == 1
    first, second = [line for line in capsys.readouterr().out.splitlines() if "ring_caustic" in line]
    assert float(first.split("|")[2]) < 1e-4 < float(second.split("|")[2])


DIMMED = """

def splat(*args):
    c = _splat(*args)
    c.value *= 0.01
    return c
"""
