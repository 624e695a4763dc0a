"""``render`` with --checkpoint, --resume and --target-error."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import rendered
from mitsuba_bdpt.cli import checkpoints
from mitsuba_bdpt.cli.arguments import build_parser, main
from mitsuba_bdpt.run.rendering import Render
from mitsuba_bdpt.run.snapshot import read

SCENE = Path(__file__).parents[2] / "scenes" / "cornell_box.xml"
ARGUMENTS = ["render", str(SCENE), "-D", "resolution=16", "-P", "spp_per_pass=4", "--seed", "5"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


# A render that kills itself after a pass, before the checkpoint that would hold it.
KILLED = """import os, signal, sys
import mitsuba_bdpt, short_pilots
from mitsuba_bdpt.cli import checkpoints
from mitsuba_bdpt.cli.arguments import main
after_pass, done = checkpoints.Checkpoints.after_pass, []
def killed(self, report):
    done.append(report)
    if len(done) > 30:
        os.kill(os.getpid(), signal.SIGKILL)
    after_pass(self, report)
checkpoints.Checkpoints.after_pass = killed
main(sys.argv[1:])"""


def test_a_killed_render_is_resumed():
    """To the rounding of atomic sums, and half precision in the file."""
    spp = ["--spp", "256"]
    assert main([*ARGUMENTS, *spp, "-o", "whole.exr"]) == 0
    expected, whole = rendered.image("whole.exr")
    resumable = [*ARGUMENTS, *spp, "-o", "killed.exr", "--checkpoint", "0"]
    assert whole["decisions"]
    finds = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.run([sys.executable, "-c", KILLED, *resumable], env=finds)
    assert process.returncode == -signal.SIGKILL
    checkpoint = Path("killed.checkpoint.npz")
    assert list(read(checkpoint).passes) == whole["passes"][:30] and not Path("killed.exr").exists()
    assert main([*resumable, "--resume"]) == 0
    assert not checkpoint.exists()
    found, resumed = rendered.image("killed.exr")
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-6)
    for name in ("rays", "passes", "decisions"):
        assert resumed[name] == whole[name], name


def interrupt(monkeypatch, arguments, after=3):
    """Run `arguments`; Ctrl-C comes after so many passes."""
    original, passes = checkpoints.Checkpoints.after_pass, []

    def after_pass(self, report):
        original(self, report)
        passes.append(report)
        if len(passes) == after:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints.Checkpoints, "after_pass", after_pass)
        assert main(arguments) == 130


def test_the_same_command_goes_on_or_begins(monkeypatch, capsys):
    arguments = [*ARGUMENTS, "--spp", "32", "-o", "a.exr", "--checkpoint", "60"]
    assert main([*ARGUMENTS, "--spp", "32", "-o", "whole.exr"]) == 0
    expected = rendered.image("whole.exr")[0]
    interrupt(monkeypatch, arguments)
    capsys.readouterr()
    assert main(arguments) == 0
    assert re.search(r"^resume: the checkpoint has \d+ of 32 samples", capsys.readouterr().err, re.MULTILINE)
    np.testing.assert_allclose(rendered.image("a.exr")[0], expected, rtol=2e-3, atol=1e-5)
    assert not Path("a.checkpoint.npz").exists()
    interrupt(monkeypatch, [*arguments, "--resume", "auto"])
    assert main([*arguments, "--resume", "never"]) == 0
    assert "resume:" not in capsys.readouterr().err


def test_an_interrupted_render_leaves_a_checkpoint_of_its_own(monkeypatch, capsys):
    arguments = [*ARGUMENTS, "--spp", "32", "-o", "a.exr", "--checkpoint", "60"]
    interrupt(monkeypatch, arguments)
    assert read(Path("a.checkpoint.npz")).spp < 32
    for others, words in (
        (["--seed", "6"], "its seed is 5, here it is 6"),
        (["-P", "max_depth=3"], "its max_depth is"),
        (["--spp", "64"], "its spp is 32, here it is 64"),
        (["-D", "resolution=8"], "is of another scene"),
        (["--resume", "-D", "resolution=8"], "or begin anew by --resume never"),
    ):
        assert main([*arguments, *others]) == 2
        assert words in capsys.readouterr().err
    assert main([*arguments, "--resume"]) == 0
    assert rendered.image("a.exr")[1]["spp"] == 32
    assert main([*arguments, "--resume"]) == 2
    assert "there is no checkpoint" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("after", "text"),
    [
        (0, "no checkpoint 'a.checkpoint.npz' yet: interrupted in the first pass; "),
        (1, "checkpoint 'a.checkp"),
    ],
)
def test_ctrl_c_within_a_pass_tells_what_the_checkpoint_lacks(monkeypatch, capsys, after, text):
    render = [*ARGUMENTS, "--spp", "32", "-P", "layers=variance", "-o"]
    assert main([*render, "whole.exr"]) == 0
    arguments = [*render, "a.exr", "--checkpoint", "60"]
    original, reports = Render.report, []

    def report(self):
        if len(reports) == after:
            raise KeyboardInterrupt
        reports.append(original(self))
        return reports[-1]

    with monkeypatch.context() as patch:
        patch.setattr(Render, "report", report)
        assert main(arguments) == 130
    done = rendered.image("a.exr")[1]["spp"]
    err = capsys.readouterr().err
    assert text in err and Path("a.checkpoint.npz").exists() == bool(after)
    assert not after or f"has {reports[0].spp_done} of the image's {done} samples per pixel" in err
    assert main(arguments) == 0 and ("resume: " in capsys.readouterr().err) == bool(after)
    (expected, whole), (found, resumed) = rendered.image("whole.exr"), rendered.image("a.exr")
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5)
    assert resumed["error"] == pytest.approx(whole["error"], rel=1e-3)


NAMES = """<scene version="3.0.0">
    <!-- <string name="filename" value="gone.ply"/> -- -->
    <default name="kind" value="default"/><path value="more/meshes"/>
    <include filename="more/part.xml"/>
    <shape type="ply"><string value="turned.ply" name="filename"/></shape>
    <texture type="bitmap"><string name="filename" value="$kind.exr"/></texture>
    <spectrum name="radiance" filename="light.spd"/>
</scene>"""
PART = """<scene version="3.0.0">
    <include filename="plain.xml"/>
    <shape type="obj"><string name="filename" value="inner.obj"/></shape>
    <texture type="bitmap"><string name="filename" value="$kind.exr"/></texture>
</scene>"""


def test_what_a_scene_names_is_part_of_it():
    Path("more/meshes").mkdir(parents=True)
    files = ["turned.ply", "default.exr", "light.spd", "more/meshes/inner.obj", "more/plain.xml"]
    for name in [*files, "given.exr", "gone.ply"]:
        Path(name).write_text('<scene version="3.0.0"><bsdf type="diffuse"/></scene>')
    Path("light.spd").write_text("400 1\n450 1")
    Path("scene.xml").write_text(NAMES)
    Path("more/part.xml").write_text(PART)
    options = build_parser().parse_args(["render", "scene.xml"])
    given = build_parser().parse_args(["render", "scene.xml", "-D", "kind=given"])

    def changes(options, name):
        before = checkpoints.digest(options)
        Path(name).write_text(Path(name).read_text() + "\n500 2" * name.endswith(".spd") + " ")
        return checkpoints.digest(options) != before

    assert [name for name in (*files, "more/part.xml", "scene.xml") if not changes(options, name)] == []
    assert not changes(options, "gone.ply") and not changes(options, "given.exr")
    assert changes(given, "given.exr") and not changes(given, "default.exr")
    Path("more/plain.xml").write_text("<scene>")
    with pytest.raises(RuntimeError, match="plain.xml"):
        checkpoints.digest(options)


def test_an_hour_a_night():
    arguments = [*ARGUMENTS, "--time", "0.2", "-o", "a.exr", "--checkpoint", "60"]
    assert main(arguments) == 0
    first = read(Path("a.checkpoint.npz")).spp
    assert main([*arguments, "--resume"]) == 0
    second = read(Path("a.checkpoint.npz")).spp
    assert 0 < first < second == rendered.image("a.exr")[1]["spp"]


def test_a_full_disk_does_not_cost_the_render(monkeypatch, capsys):
    def full(number):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints.os, "fsync", full)
    assert main([*ARGUMENTS, "--spp", "32", "-o", "a.exr", "--checkpoint", "0"]) == 0
    said = capsys.readouterr().err
    assert "warning: no checkpoint 'a.checkpoint.npz': No space left on device; the render goes on" in said
    assert Path("a.exr").exists() and not Path("a.checkpoint.npz").exists()


def test_a_render_that_had_reached_its_error_is_not_traced_on(monkeypatch):
    arguments = [*ARGUMENTS, "--target-error", "0.02", "-o", "a.exr", "--checkpoint", "0"]
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints.Checkpoints, "remove", lambda self: None)
        assert main(arguments) == 0
    kept = read(Path("a.checkpoint.npz"))
    assert main([*arguments, "--resume"]) == 0
    assert rendered.image("a.exr")[1]["spp"] == kept.spp and not Path("a.checkpoint.npz").exists()


def test_a_damaged_checkpoint_is_refused(monkeypatch, capsys):
    arguments = [*ARGUMENTS, "--spp", "32", "-o", "a.exr", "--checkpoint", "60"]
    interrupt(monkeypatch, arguments)
    file = Path("a.checkpoint.npz")
    file.write_bytes(file.read_bytes()[:200])
    assert main([*arguments, "--resume"]) == 2
    error = capsys.readouterr().err
    assert "'a.checkpoint.npz' is not a snapshot" in error and "begin anew by --resume never" in error
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--resume"], "resume needs --checkpoint"),
        (["--resume", "never"], "resume needs --checkpoint"),
        (["--parts", "3"], "parts needs --scheduler"),
        (["--scheduler", "localhost"], "scheduler='localhost': missing port number"),
        (["--scheduler", "x:1", "--time", "1"], "scheduler together with time"),
        (["--scheduler", "x:1", "--checkpoint", "1"], "scheduler together with checkpoint"),
        (["--scheduler", "x:1", "--target-error", "1"], "scheduler together with target_error"),
        (["--scheduler", "x:1", "-P", "timeout=3"], "scheduler with timeout=3.0 is not possible"),
        (["--scheduler", "x:1", "-P", "aovs=a:duv_dx"], "duv_dx depends on the samples per pixel of a part"),
        (["--integrator", "path", "--checkpoint", "1"], "checkpoint is for the integrator bdpt"),
        (["--integrator", "path", "--scheduler", "x:1"], "scheduler is for the integrator bdpt"),
        (["--time", "2", "-P", "timeout=3"], "-P timeout=X sets what --time sets"),
        (["--target-error", "1", "-P", "target_error=2"], "sets what --target-error sets"),
        (["--integrator", "path", "--target-error", "1"], "target_error is for the integrator bdpt"),
    ],
)
def test_contradictions_are_refused(arguments, words, capsys):
    assert main([*ARGUMENTS[:4], "-o", "a.exr", *arguments]) == 2
    assert words in capsys.readouterr().err and not Path("a.exr").exists()


def test_an_error_that_is_asked_for_ends_a_render(capsys):
    assert main([*ARGUMENTS, "--target-error", "0.02", "-o", "a.exr"]) == 0
    assert "variance.R" in OpenEXR.File("a.exr", separate_channels=True).channels()
    statistics = rendered.image("a.exr")[1]
    assert statistics["error"] <= 0.02 and statistics["spp"] in (32, 64, 128, 256, 512)
    asked = [*ARGUMENTS, "--checkpoint", "60", "-P", "layers=variance", "-o", "a.exr"]
    assert main([*asked, "--spp", "1024", "-P", "target_error=0.5"]) == 0
    assert not Path("a.checkpoint.npz").exists() and "asked for" not in capsys.readouterr().out
    assert rendered.image("a.exr")[1]["spp"] < 1024
    assert main([*asked, "--spp", "32", "-P", "target_error=1e-6"]) == 0
    assert "not the 1e-06 asked for" in capsys.readouterr().out
