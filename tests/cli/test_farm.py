"""``render`` on a farm: signals, sizes, files."""

import errno
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import rendered
from mitsuba_bdpt import workers
from mitsuba_bdpt.cli import checkpoints, render
from mitsuba_bdpt.cli.arguments import build_parser, main
from mitsuba_bdpt.cli.mistakes import TERMINATED
from mitsuba_bdpt.files import images
from mitsuba_bdpt.host import signals
from mitsuba_bdpt.measure.scenes import SceneFile
from mitsuba_bdpt.run.snapshot import read

SCENE = Path(__file__).parents[2] / "scenes" / "cornell_box.xml"
SMALL = ["render", str(SCENE), "--size", "16x16", "-P", "spp_per_pass=4"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_sigterm_ends_as_ctrl_c_does():
    command = [sys.executable, "-m", "mitsuba_bdpt", *SMALL, "--spp", "4000000", "--checkpoint", "600"]
    process = subprocess.Popen(
        [*command, "-o", "ended.exr", "--preview", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while process.poll() is None and not Path("ended.png").exists():  # the first pass is over
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate()
    assert process.returncode == TERMINATED == 143, err
    pixels, statistics = rendered.image("ended.exr", "RGB")
    assert statistics["interrupted"] and 0 < statistics["spp"] < 4000000 and np.all(np.isfinite(pixels))
    assert out.rstrip().endswith("interrupted")
    # The signal may come between the end of a pass and its report.
    assert 0 < read(Path("ended.checkpoint.npz")).spp <= statistics["spp"]


def test_size_and_crop():
    """The window is that part of the image: measured 0.03 apart, 0.88 one pixel beside it."""
    arguments = ["render", str(SCENE), "--size", "24x16", "--spp", "64", "-o"]
    assert main([*arguments, "whole.exr"]) == main([*arguments, "part.exr", "--crop", "4,2,10,8"]) == 0
    whole, part = (rendered.image(f"{name}.exr", "RGB")[0] for name in ("whole", "part"))
    assert whole.shape == (16, 24, 3) and part.shape == (8, 10, 3)
    off = {
        (x, y): np.sqrt(np.mean((part - whole[y : y + 8, x : x + 10]) ** 2))
        for x in range(15)
        for y in range(9)
    }
    nearest, second = sorted(off, key=off.get)[:2]
    assert nearest == (4, 2) and off[nearest] < 0.2 * off[second]


PIXEL = (
    '<film type="hdrfilm"><integer name="width" value="1"/><integer name="height" value="1"/>'
    '<rfilter type="box"/></film>'
)
LAMP = (
    '<emitter type="point"><point name="position" value="0,0,1"/><rgb name="intensity" value="3"/></emitter>'
)


def test_size_leaves_meters_alone(capsys):
    pixel = PIXEL.replace('type="hdrfilm"', 'type="hdrfilm" id="pixel"')
    Path("meters.xml").write_text(
        f'<scene version="3.0.0">{LAMP}{pixel}<sensor type="perspective"><film type="hdrfilm"/></sensor>'
        '<sensor type="radiancemeter"><ref id="pixel"/></sensor>'
        f'<shape type="rectangle"><sensor type="irradiancemeter">{PIXEL}</sensor></shape></scene>'
    )
    kinds = [sensor.class_name() for sensor in mi.load_file("meters.xml").sensors()]
    for index, kind in enumerate(kinds):
        command = ["render", "meters.xml", "--sensor", str(index), "--spp", "1", "-o", f"{kind}.exr"]
        camera = kind == "PerspectiveCamera"
        assert main([*command, "--size", "4x3"]) == (0 if camera else 2)
        assert camera or "size=4x3 is for images" in capsys.readouterr().err
        if not camera:
            assert main([*command, "--crop", "0,0,1,1"]) == 2
            assert "crop=0,0,1,1 is for images" in capsys.readouterr().err
            assert main(command) == 0
    assert rendered.image("PerspectiveCamera.exr", "RGB")[0].shape == (3, 4, 3)
    assert rendered.image("IrradianceMeter.exr", "RGB")[0].shape == (1, 1, 3)


def test_equal_meters_on_two_shapes():
    """A file with two equal meters loads; each reads the irradiance of its own small plate, 3 h / r^3."""
    sensor = f'<sensor type="irradiancemeter">{PIXEL}</sensor>'
    plates = "".join(
        f'<shape type="rectangle"><transform name="to_world"><scale value="0.01"/><translate x="{x}"/>'
        f"</transform>{sensor}</shape>"
        for x in (0, 1)
    )
    Path("two.xml").write_text(f'<scene version="3.0.0">{LAMP}{plates}</scene>')
    found = []
    for index in (0, 1):
        command = ["render", "two.xml", "--sensor", str(index), "--spp", "256", "-o", f"{index}.exr"]
        assert main(command) == 0
        found.append(rendered.image(f"{index}.exr", "RGB")[0].mean())
    np.testing.assert_allclose(sorted(found), [3 / 2**1.5, 3], rtol=1e-3)  # the plate is no point


def test_meshes_that_mitsuba_cannot_merge():
    walls = "".join(
        f'<shape type="cube"><transform name="to_world"><scale value="{size}"/></transform>'
        f'<boolean name="flip_normals" value="{flipped}"/><ref id="glass"/></shape>'
        for size, flipped in ((1, "false"), (0.9, "true"))
    )
    glass, sensor = '<bsdf type="dielectric" id="glass"/>', f'<sensor type="perspective">{PIXEL}</sensor>'
    file = Path("hollow.xml")
    file.write_text(f'<scene version="3.0.0">{glass}{walls}<emitter type="constant"/>{sensor}</scene>')
    assert main(["render", "hollow.xml", "--spp", "2"]) == 0
    assert len(SceneFile("hollow", file).load().shapes()) == 2


def test_sizes_that_are_refused(capsys):
    Path("cropped.xml").write_text(
        '<scene version="3.0.0"><emitter type="constant"/><sensor type="perspective"><film type="hdrfilm">'
        '<integer name="width" value="64"/><integer name="height" value="32"/>'
        '<integer name="crop_width" value="8"/><integer name="crop_height" value="8"/>'
        '<rfilter type="box"/></film></sensor></scene>'
    )
    size = "--size", "16x16"
    for arguments, words in (
        ([str(SCENE), *size, "--crop", "8,8,9,8"], "crop=8,8,9,8 is not within the image of 16x16"),
        (["cropped.xml", *size], "film with a crop window"),
    ):
        assert main(["render", *arguments]) == 2
        assert words in capsys.readouterr().err
    assert main(["render", "cropped.xml", *size, "--crop", "0,0,4,4", "--spp", "1", "-o", "a.exr"]) == 0
    assert rendered.image("a.exr", "RGB")[0].shape == (4, 4, 3)


def test_statistics_are_a_file(capsys):
    arguments = [*SMALL, "--spp", "8", "-o", "a.exr", "--statistics"]
    assert main([*arguments, "new/a.json", "-P", "layers=variance"]) == 0
    text = Path("new/a.json").read_text()
    assert "Infinity" not in text and "NaN" not in text
    found = json.loads(text)
    assert found["spp"] == sum(found["passes"]) == 8 and found["settings"]["scene"] == str(SCENE)
    assert found["resident_memory"] > 2**26 and not found["interrupted"] and found["versions"]["mitsuba"]
    header = rendered.image("a.exr", "RGB")[1]
    assert {key: found[key] for key in header} == header
    capsys.readouterr()
    assert main([*arguments, "a.exr/b.json"]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_files_elsewhere(capsys):
    Path("textures").mkdir()
    Path("scene").mkdir()
    mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)).write("textures/appended_sky.exr")
    Path("scene/scene.xml").write_text(
        '<scene version="3.0.0"><emitter type="envmap">'
        '<string name="filename" value="appended_sky.exr"/></emitter>'
        '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>'
        '<integer name="height" value="4"/></film></sensor></scene>'
    )
    arguments = ["render", "scene/scene.xml", "--spp", "1", "-o", "a.exr"]
    assert main([*arguments, "-a", "nowhere"]) == 2
    assert "append='nowhere' is no folder" in capsys.readouterr().err
    assert main([*arguments, "-a", "textures"]) == 0
    options = build_parser().parse_args([*arguments, "-a", "textures"])
    before = checkpoints.digest(options)
    mi.Bitmap(np.full((2, 2, 3), 0.25, np.float32)).write("textures/appended_sky.exr")
    assert checkpoints.digest(options) != before


def test_a_film_that_takes_more_memory_than_is_asked_for_is_refused_before_the_render(capsys):
    for command in ("render", "explain"):
        assert main([command, str(SCENE), "--size", "4096x4096", "--spp", "1", "--memory", "2"]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert "4096 x 4096 pixels takes about 3 GiB of memory; there are 2 GiB (the limit set by" in error
    assert main([*SMALL, "--spp", "1", "-o", "a.exr"]) == 0, "the next command has no such limit"


def test_threads_and_log(capfd):
    before, level = dr.thread_count(), mi.log_level()
    try:
        assert main([*SMALL, "--spp", "1", "--threads", "1", "-v"]) == 0
        assert dr.thread_count() == 1 and mi.log_level() == level
    finally:
        dr.set_thread_count(before)
    logged = r"^info: \d{4}-\d\d-\d\d [\d:]+ +\[messages.py:\d+\] bdpt: "
    assert re.search(logged, capfd.readouterr().err, re.MULTILINE)


def test_a_warning_is_one_line_on_standard_error(capfd):
    meter = f'<shape type="rectangle"><sensor type="irradiancemeter">{PIXEL}</sensor></shape>'
    Path("scene.xml").write_text(f'<scene version="3.0.0">{LAMP}{meter}</scene>')
    assert main(["render", "scene.xml", "--spp", "1", "-P", "light_paths=0", "-o", "a.exr"]) == 0
    shown = capfd.readouterr()
    warnings = [line for line in shown.err.splitlines() if "bdpt: " in line]
    assert warnings and all(line.startswith("warning: bdpt: ") for line in warnings)
    assert "\x1b" not in shown.out + shown.err and "bdpt: " not in shown.out
    mi.Log(mi.LogLevel.Warn, "after the command")
    assert "WARN" in capfd.readouterr().out


def test_a_drive_that_is_gone_does_not_cost_the_image(capsys, monkeypatch, tmp_path):
    """The image is among the temporary files, the error says where, and the exit status is 1."""
    original = render.write_images

    def gone(film, output, *others):
        if output == Path("a.exr"):
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT), str(output))
        original(film, output, *others)

    monkeypatch.setattr(render, "write_images", gone)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert main([*SMALL, "--spp", "4", "-o", "a.exr"]) == 1
    (rescued,) = tmp_path.glob("mitsuba-bdpt-*/a.exr")
    assert rendered.image(rescued, "RGB")[0].shape == (16, 16, 3)
    said = capsys.readouterr().err
    assert "\nerror: 'a.exr': No such file" in said and f"the image is {str(rescued)!r} instead" in said


def test_a_scheduler_that_does_not_answer_is_said_soon(capsys, monkeypatch):
    assert 1 <= workers.ANSWERS_WITHIN <= 5
    monkeypatch.setattr(workers, "ANSWERS_WITHIN", 0.5)
    with socket.create_server(("127.0.0.1", 0), backlog=1) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        assert main([*SMALL, "--spp", "16", "--scheduler", address]) == 1
    assert "error: " in capsys.readouterr().err


def test_a_preview_is_rewritten(monkeypatch):
    seen, write = [], render.write_png

    def noted(film, bitmap, path, exposure):
        write(film, bitmap, path, exposure)
        seen.append((Path(path).read_bytes(), Path("shown.exr").exists()))
        if len(seen) == 1:
            raise RuntimeError("[Bitmap] the image is too large")

    with monkeypatch.context() as patch:
        patch.setattr(render, "write_png", noted)
        assert main([*SMALL, "--spp", "12", "--preview", "0", "-o", "shown.exr"]) == 0
    assert (
        len(seen) > 2 and len({data for data, _ in seen}) == len(seen) and not any(done for _, done in seen)
    )
    assert os.path.exists("shown.exr")
    last = np.array(mi.Bitmap("shown.png")).astype(int)
    Path("last.png").write_bytes(seen[-1][0])
    # Mitsuba dithers.
    assert np.abs(np.array(mi.Bitmap("last.png")).astype(int) - last).max() <= 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_load_at_once(number):
    os.mkfifo("mesh.ply")
    mesh = '<shape type="ply"><string name="filename" value="mesh.ply"/></shape>'
    Path("scene.xml").write_text(f'<scene version="3.0.0">{mesh}</scene>')
    command = [sys.executable, "-m", "mitsuba_bdpt", "render", "scene.xml"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    with open("mesh.ply", "w"):  # opens when it is opened for reading
        process.send_signal(number)
        assert process.communicate(timeout=600)[1] == "interrupted; no image written\n"
    assert process.returncode == 128 + number


@pytest.mark.parametrize("command", ["render", "explain"])
def test_a_signal_while_an_import_loads_is_answered_after_it(monkeypatch, capsys, command):
    def load(options):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except BaseException as error:
            raise SystemError("returned a result with an exception set") from error

    monkeypatch.setattr(render, "load", load)
    assert main([command, str(SCENE)]) == TERMINATED
    assert capsys.readouterr().err == "interrupted; no image written\n"


def test_a_signal_while_the_image_is_written_changes_nothing(monkeypatch):
    write = render.write_images

    def interrupted(*arguments):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        assert Path("a.checkpoint.npz").exists()
        write(*arguments)

    monkeypatch.setattr(render, "write_images", interrupted)
    assert main([*SMALL, "--spp", "8", "-o", "a.exr", "--checkpoint", "0"]) == 130
    assert rendered.image("a.exr", "RGB")[1]["spp"] == 8 and not Path("a.checkpoint.npz").exists()


def test_an_image_that_cannot_be_written_leaves_the_checkpoint(monkeypatch, capsys):
    def full(*arguments):
        raise OSError(28, "No space left on device", "a.exr")

    arguments = [*SMALL, "--spp", "8", "-o", "a.exr", "--checkpoint", "0"]
    with monkeypatch.context() as patch:
        patch.setattr(render, "write_images", full)
        assert main(arguments) == 1
    assert "\nerror: 'a.exr': No space left on device" in capsys.readouterr().err
    assert Path("a.checkpoint.npz").exists()
    assert main([*arguments, "--resume"]) == 0
    assert rendered.image("a.exr", "RGB")[1]["spp"] == 8 and not Path("a.checkpoint.npz").exists()


@pytest.mark.parametrize("error", [OSError(28, "a full disk"), RuntimeError("[Bitmap] a full disk")])
def test_a_png_that_cannot_be_written_does_not_cost_the_exr(monkeypatch, capsys, error):
    """Expected: one line that names both, the status of a failure; the checkpoint has served."""

    def failed(*arguments):
        raise error

    monkeypatch.setattr(images, "write_png", failed)
    assert main([*SMALL, "--spp", "8", "-o", "a.exr", "--checkpoint", "0"]) == 1
    (said,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert "'a.png' could not be written: " in said and said.endswith("a full disk; the image is 'a.exr'")
    assert rendered.image("a.exr", "RGB")[1]["spp"] == 8 and not Path("a.checkpoint.npz").exists()


def test_ctrl_c_while_the_png_is_written_is_no_failure_of_it(monkeypatch, capsys):
    """Rationale: Mitsuba wraps Ctrl-C as a ``RuntimeError``. Expected: the status of an interruption."""

    def interrupted(*arguments):
        raise RuntimeError("wrapped") from KeyboardInterrupt()

    monkeypatch.setattr(images, "write_png", interrupted)
    assert main([*SMALL, "--spp", "8", "-o", "a.exr"]) == 130
    assert "could not be written" not in capsys.readouterr().err


def test_a_signal_is_answered_while_a_call_runs(monkeypatch):
    """Rationale: handlers of Python run after a call of Mitsuba's, and Ctrl-C waited for a pass without a
    word. Expected: a thread answers while this one takes no signal."""
    reader, writer = os.pipe()
    monkeypatch.setattr(signals, "_say", lambda text: os.write(writer, text.encode()))
    before = signal.signal(signal.SIGINT, lambda number, frame: None)
    try:
        with signals.announced("stopping"):
            threading.Timer(0, os.kill, (os.getpid(), signal.SIGINT)).start()
            assert select.select([reader], [], [], 60)[0] and os.read(reader, 8) == b"stopping"
    finally:
        signal.signal(signal.SIGINT, before)


def test_nobody_listens_any_more():
    command = [sys.executable, "-m", "mitsuba_bdpt", *SMALL, "--spp", "8", "-o", "a.exr"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    assert process.wait() == 0, process.stderr.read()
    process.stderr.close()
    assert rendered.image("a.exr", "RGB")[1]["spp"] == 8
