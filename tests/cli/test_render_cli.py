"""Tests of ``python -m mitsuba_bdpt render``."""

import errno
import json
import os
import re
import resource
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
import variants
from mitsuba_bdpt.cli import render
from mitsuba_bdpt.cli.arguments import build_parser, main
from mitsuba_bdpt.errors import CommandError, FailureError, UnsupportedError
from mitsuba_bdpt.files import images
from mitsuba_bdpt.files.loading import in_proportion, load
from mitsuba_bdpt.settings import Settings

SCENE = """
<scene version="3.0.0">
    <default name="integrator" value="path"/>
    <default name="format" value="float32"/>
    <default name="light" value="2"/>
    <integrator type="$integrator">
        <integer name="max_depth" value="3"/>
        <boolean name="hide_emitters" value="false"/>
    </integrator>
    <sensor type="perspective">
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="6"/><integer name="height" value="4"/>
            <string name="component_format" value="$format"/>
        </film>
    </sensor>
    <emitter type="constant"><rgb name="radiance" value="$light"/></emitter>
</scene>
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A scene file in an empty working directory: an environment of radiance 2, nothing else."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "plain.xml"
    path.write_text(SCENE)
    return path


def read(path):
    """Pixels (RGB) and header of an EXR file."""
    file = OpenEXR.File(str(path), separate_channels=True)
    channels = file.channels()
    return np.stack([channels[name].pixels for name in "RGB"], axis=-1), file.header()


def test_writes_exr_and_png_with_one_closing_line(scene, capsys):
    """Environment of radiance 2: every pixel of the EXR is 2, of the PNG white."""
    assert main(["render", str(scene), "--integrator", "scene", "-o", "new/image.exr"]) == 0
    pixels, header = read("new/image.exr")
    assert pixels.shape == (4, 6, 3) and pixels.dtype == np.float32
    np.testing.assert_allclose(pixels, 2.0, rtol=1e-6)
    assert np.all(np.array(mi.Bitmap("new/image.png")) == 255)
    out = capsys.readouterr().out
    assert out.count("\n") == 1 and out.startswith("new/image.exr: ")
    assert "4 spp (96 samples)" in out
    settings = json.loads(header["bdptSettings"])
    assert settings["spp"] == 4 and settings["seed"] == 0 and settings["scene"] == str(scene)
    assert json.loads(header["bdptStatistics"])["versions"]["mitsuba"].startswith("3.9")


def test_definitions_seed_spp_and_exposure(scene):
    """-Dlight=0.25 with one stop more is 0.5 linear, 187.5 in 8-bit sRGB; Mitsuba dithers."""
    arguments = ["-Dlight=0.25", "--spp", "2", "--seed", "7", "--exposure", "1", "-o", "a.exr"]
    assert main(["render", str(scene), "--integrator", "scene", *arguments]) == 0
    pixels, header = read("a.exr")
    np.testing.assert_allclose(pixels, 0.25, rtol=1e-6)
    assert np.all(np.isin(np.array(mi.Bitmap("a.png")), [187, 188]))
    settings = json.loads(header["bdptSettings"])
    assert (settings["spp"], settings["seed"], settings["defines"]) == (2, 7, {"light": "0.25"})


def test_a_width_changes_the_height_in_proportion(scene):
    heights = """<default value="256" name="resolution"/><default name="resolution_y" value="144"/>"""
    film = '<film type="hdrfilm">'
    film = f'{film}<integer name="width" value="$resolution"/><integer name="height" value="$resolution_y"/>'
    text = f'<scene version="3.0.0">{heights}{film}</film></scene>'
    scene.write_text(text)
    both = {"resolution": "512", "resolution_y": 288}
    assert in_proportion(scene, {"resolution": "512"}) == both
    for given in ({}, {"resolution": "512", "resolution_y": "7"}, {"resolution": "wide"}):
        assert in_proportion(scene, given) == given
    for other in (text.replace("$resolution_y", "$resolution"), heights):
        scene.write_text(other)
        assert in_proportion(scene, {"resolution": "512"}) == {"resolution": "512"}


def test_film_component_format_is_kept(scene):
    """Features have 32 bits: half floats are exact up to 2,048. Compositors look for the channel Z."""
    aovs = "aovs=Z:depth,far.Z:depth,d:depth,p:position,al:albedo"
    arguments = ["-Dformat=float16", "-Dintegrator=bdpt", "-P", aovs, "-o", "half.exr"]
    assert main(["render", str(scene), *arguments]) == 0
    assert read("half.exr")[0].dtype == np.float16
    channels = OpenEXR.File("half.exr", separate_channels=True).channels()
    single = {name for name, channel in channels.items() if channel.pixels.dtype == np.float32}
    assert single == {"Z", "far.Z", "d.T", "p.X", "p.Y", "p.Z"}
    assert {"R", "al.R"} <= channels.keys() - single
    np.testing.assert_array_equal(channels["Z"].pixels, channels["d.T"].pixels)


def test_a_spectral_film_is_shown_in_grey(scene):
    """Radiance 2 times the integral 50 of each response."""
    band = '<spectrum name="{}" value="500:0, 550:1, 600:0"/>'
    scene.write_text(
        SCENE.replace("hdrfilm", "specfilm")
        .replace("</film>", "".join(band.format(name) for name in ("one", "three", "two")) + "</film>")
        .replace('<rgb name="radiance" value="$light"/>', '<spectrum name="radiance" value="400:2, 700:2"/>')
    )
    arguments = ["-m", "llvm_ad_spectral", "-Dintegrator=bdpt", "-P", "aovs=dd:depth", "-o", "a.exr"]
    arguments += ["-P", "light_paths=0"]  # the sky seen by splats has noise
    assert main(["render", str(scene), *arguments]) == 0
    channels = OpenEXR.File("a.exr", separate_channels=True).channels()
    assert set(channels) == {"one", "two", "three", "dd.T"}
    for name in ("one", "two", "three"):
        np.testing.assert_allclose(channels[name].pixels, 100, rtol=1e-3)
    assert np.all(np.array(mi.Bitmap("a.png")) == 255)


def test_a_render_without_a_pass_writes_nothing(scene, capsys, monkeypatch):
    monkeypatch.setattr(render, "render", lambda *_: render.Outcome(0.1, 0, interrupted=True))
    assert main(["render", str(scene), "-o", "a.exr"]) == 130
    assert "no image written" in capsys.readouterr().err and not Path("a.exr").exists()


def test_properties_have_types(scene):
    words = "skip=none", "light_paths=0.5", "path_layers=true", "rr_depth=7"
    arguments = [word for pair in words for word in ("-P", pair)]
    settings = loaded(scene, *arguments, "--time", "30").settings
    assert (settings.skip, settings.light_paths, settings.path_layers) == ("none", 0.5, True)
    assert (settings.rr_depth, settings.max_depth, settings.timeout) == (7, 3, 30)


AROUND = """<integrator type="aov">
    <string name="aovs" value="dd:depth, nn:sh_normal"/><float name="timeout" value="50"/>
    <integrator type="aov" name="in">
        <string name="aovs" value="uv:uv"/><float name="timeout" value="20"/>
        <integrator name="img" type="$integrator">
            <integer name="max_depth" value="3"/><integer name="rr_depth" value="2"/>
            <boolean name="hide_emitters" value="true"/><float name="timeout" value="10"/>
        </integrator>
    </integrator>
</integrator>"""


@pytest.fixture
def around(scene):
    """The scene, its integrator inside of two of Mitsuba's `aov`."""
    start, end = SCENE.index("<integrator"), SCENE.index("<sensor")
    scene.write_text(SCENE.replace(SCENE[start:end], AROUND))
    return scene


def loaded(scene, *arguments):
    """The integrator that the command would render with."""
    return load(build_parser().parse_args(["render", str(scene), *arguments]))[1]


def test_bdpt_in_place_of_integrators_around_others_keeps_their_layers(around):
    settings = loaded(around, "--integrator", "bdpt").settings
    assert (settings.max_depth, settings.rr_depth, settings.hide_emitters) == (3, 2, True)
    assert (settings.timeout, settings.aovs) == (50, "dd:depth,nn:sh_normal,in.uv:uv")
    ours = loaded(around, "--denoise", "-P", "aovs=al:albedo", "-P", "max_depth=7").settings
    assert (ours.max_depth, ours.aovs, ours.layers) == (7, "al:albedo", ("denoised",))
    own = '<string name="aovs" value="al:albedo"/><string name="layers" value="variance"/></integrator>'
    text = around.read_text()
    around.write_text(text.replace("</integrator>", own, 1))
    inner = loaded(around, "-Dintegrator=bdpt", "--denoise").settings
    assert (inner.max_depth, inner.aovs) == (3, f"{settings.aovs},al:albedo")
    assert inner.layers == ("variance", "denoised")
    around.write_text(text)
    layers = []
    for kind in ("path", "bdpt"):
        assert main(["render", str(around), "--integrator", kind, "-o", f"{kind}.exr"]) == 0
        layers.append(OpenEXR.File(f"{kind}.exr", separate_channels=True).channels())
    image = {f"in.{part}{c}" for part in ("", "img.") for c in "RGBA"}
    assert set(layers[0]) - image == set(layers[1]) >= {"dd.T", "nn.X", "in.uv.V"}


def test_other_integrators_take_the_place_inside(around):
    integrator = loaded(around, "--integrator", "volpath")
    assert {"dd.T", "in.uv.V", "in.img.R"} <= set(integrator.aov_names())
    assert re.search(r"Volumetric\w+\[\s+max_depth = 3,\s+rr_depth = 2", str(integrator))


def test_bdpt_in_place_of_stokes_has_its_layers(around):
    around.write_text(around.read_text().replace('type="aov">', 'type="stokes">'))
    polarized = "-m", "llvm_ad_mono_polarized"
    settings = loaded(around, "--integrator", "bdpt", *polarized).settings
    assert settings.stokes and settings.aovs == "uv:uv" and settings.timeout == 50
    with pytest.raises(RuntimeError, match="layers=stokes needs a polarized variant, llvm_ad_rgb has no"):
        loaded(around, "--integrator", "bdpt")


def test_files_of_version_06_keep_their_parameters(scene):
    old = SCENE.replace("3.0.0", "0.6.0").replace('value="path"', 'value="volpath"')
    for now, then in (
        ("max_depth", "maxDepth"),
        ("hide_emitters", "hideEmitters"),
        ("sample_count", "sampleCount"),
    ):
        old = old.replace(f'"{now}"', f'"{then}"')
    old = old.replace(
        '"hideEmitters" value="false"/>', '"hideEmitters" value="true"/><integer name="rrDepth" value="7"/>'
    )
    scene.write_text(old.replace("<string", '<integer name="cropWidth" value="2"/><string'))
    settings = loaded(scene, "--integrator", "bdpt").settings
    assert (settings.max_depth, settings.rr_depth, settings.hide_emitters) == (3, 7, True)
    assert loaded(scene, "--integrator", "bdpt", "-P", "max_depth=5").settings.max_depth == 5
    assert "max_depth = 2" in str(loaded(scene, "--integrator", "scene", "-P", "max_depth=2"))
    film = load(build_parser().parse_args(["render", str(scene)]))[0].sensors()[0].film()
    assert tuple(film.crop_size()) == (2, 4)
    words = "render", str(scene), "--size", "12x8"
    with pytest.raises(CommandError, match="crop window"):
        load(build_parser().parse_args([*words]))
    film = load(build_parser().parse_args([*words, "--crop", "1,2,5,3"]))[0].sensors()[0].film()
    assert (*film.size(), *film.crop_offset(), *film.crop_size()) == (12, 8, 1, 2, 5, 3)


@pytest.mark.parametrize("kind", ["direct_projective", "prb", "prb_basic", "prb_projective", "prbvolpath"])
def test_integrators_that_end_paths_by_themselves_are_replaced_with_their_depth(scene, kind):
    text = scene.read_text()
    assert loaded(scene, f"-Dintegrator={kind}", "--integrator", "bdpt").settings.max_depth == 3
    scene.write_text(text.replace('<integer name="max_depth" value="3"/>', ""))
    own = loaded(scene, f"-Dintegrator={kind}").max_depth
    assert loaded(scene, f"-Dintegrator={kind}", "--integrator", "bdpt").settings.max_depth == own


def test_bdpt_reports_its_statistics(scene, capsys):
    assert main(["render", str(scene), "-Dintegrator=bdpt", "-P", "skip=none", "-o", "a.exr"]) == 0
    statistics = json.loads(read("a.exr")[1]["bdptStatistics"])
    assert statistics["spp"] == sum(statistics["passes"]) == 4
    assert statistics["rays"]["camera"] == 4 * 6 * 4
    assert "no pilot: nothing to choose with skip=none" in capsys.readouterr().out


INTEGRATOR = re.search("<integrator.*</integrator>", SCENE, re.DOTALL)[0]
SENSOR = re.search("<sensor.*</sensor>", SCENE, re.DOTALL)[0]
AOV = '<integrator type="aov"><string name="aovs" value="a:depth"/>'
OWN = "--integrator", "scene", "-D", "integrator=bdpt"


@pytest.mark.parametrize(
    ("edits", "arguments", "words"),
    [
        ([], ["-o", "a.png"], "output='a.png' must end in .exr"),
        ([], ["-o", "/proc/none/a.exr"], r"output='/proc/none/a.exr' cannot be written \(No such file"),
        ([], ["-o", "plain.xml/a.exr"], "name another with -o"),
        ([], ["-m", "LLVM_AD_RGB"], r"variant='LLVM_AD_RGB' is not one of .*; did you mean llvm_ad_rgb\?"),
        (
            [],
            ["-m", "scalar_rgb", "--integrator", "bdpt"],
            "scalar_rgb is not supported; .*example llvm_ad_rgb",
        ),
        ([], ["-s", "3"], "sensor=3 is not in the scene; the last one is 0"),
        ([], ["-Dlight=abc"], r'plain.xml \(line 17, col 31\): could not parse RGB value "abc"'),
        ([], ["--integrator", "diffuse"], 'plugin "diffuse" is of type "bsdf", which does not match'),
        ([], ["--integrator", ""], "integrator='' names no integrator"),
        ([], ["--integrator", "aov", "-P", "aovs="], "integrator=aov is for one around another"),
        ([], ["--integrator", "moment"], "integrator=moment is for one around another"),
        ([], ["-Players=strategies", "-Pmax_depth=17"], "smaller max_depth"),
        ([], ["-P", "layers=stokes"], "layers=stokes needs a .*example llvm_ad_spectral_polarized"),
        ([], ["-P", "max_depth=0.5"], "max_depth=0.5 must be an integer: the longest path"),
        ([], ["-P", "max_dept=4"], r"max_dept=4 is not a parameter; did you mean max_depth\? Parameters:"),
        ([], ["-P", "decisions=[]"], r"decisions='\[\]' is not a parameter; set light_paths and"),
        ([], ["--spp", "9999999999"], "spp=9999999999 must be an integer from 1 to 4294967295, or 0"),
        ([('count" value="4"', 'count" value="0"')], [], "sample_count=0: nothing is to"),
        ([(SENSOR, ""), ('<default name="format" value="float32"/>', "")], [], "no sensor"),
        ([(SCENE, '<bsdf version="3.0.0" type="diffuse"/>')], [], "holds a single object.*no <scene>"),
        (
            [("<boolean", '<integer name="max_dept" value="4"/><boolean')],
            [*OWN, "-P", "skip=none"],
            r"plain.xml \(line 6, col 6\): failed.*bdpt: max_dept=4 is not a parameter",
        ),
        ([(INTEGRATOR, f"{AOV}</integrator>")], [], "aov is around none.*write one inside of it"),
        (
            [(INTEGRATOR, f"{AOV}{INTEGRATOR}</integrator>")],
            [*OWN, "-Paovs=b:depth"],
            "takes aov and stokes over",
        ),
        (
            [(INTEGRATOR, f'<integrator type="moment">{INTEGRATOR}</integrator>')],
            [],
            "integrator moment.*second moments.*variance.*own by --integrator scene",
        ),
        (
            [(INTEGRATOR, f'<integrator type="aov"><integrator type="path"/>{INTEGRATOR}</integrator>')],
            [],
            "just one",
        ),
    ],
)
def test_mistakes_are_one_line_with_a_remedy(scene, capsys, edits, arguments, words):
    text = SCENE
    for old, new in edits:
        assert old in text
        text = text.replace(old, new, 1)
    if "$integrator" not in text:
        text = text.replace('<default name="integrator" value="path"/>', "")
    scene.write_text(text)
    assert main(["render", str(scene), *arguments]) == 2
    captured = capsys.readouterr()
    *_, last = captured.err.splitlines()
    assert last.startswith("error: ") and re.search(words, last) and not captured.out, last


def test_a_variant_without_its_hardware_is_reported(scene, capsys, monkeypatch):
    def no_gpu(variant):
        raise ImportError("the CUDA backend hasn't been initialized")

    monkeypatch.setattr(render.mi, "set_variant", no_gpu)
    assert main(["render", str(scene), "--variant", "cuda_ad_rgb"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: variant='cuda_ad_rgb' cannot be used on this machine")
    assert "llvm_ad_rgb" in error


@pytest.mark.parametrize("kind", ["prb", "prbvolpath"])
def test_integrators_that_must_develop_their_image_render_too(scene, kind):
    """The image, 2 everywhere."""
    assert main(["render", str(scene), "--integrator", kind, "--time", "0", "-o", "a.exr"]) == 0
    np.testing.assert_allclose(read("a.exr")[0], 2.0, rtol=1e-5)


def wrapped(error):
    """An error as Dr.Jit raises it for one in the body of a loop."""
    found = RuntimeError("drjit.while_loop(): encountered an exception (see above).")
    found.__cause__ = error
    return found


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (CommandError("wrong"), 2),
        (UnsupportedError("wrong"), 2),
        (FailureError("gone"), 1),
        (OSError(errno.EIO, "Input/output error", "a.exr"), 1),
        (OSError(errno.ENOENT, "No such file or directory", "drive/a.exr"), 1),
        (
            RuntimeError("jit_malloc(): out of memory! Could not allocate 9 bytes (backend=llvm, shared=0)."),
            1,
        ),
        (wrapped(RuntimeError("jit_malloc(): out of memory! Could not allocate 9 bytes.")), 1),
        (MemoryError(), 1),
        (wrapped(MemoryError()), 1),
        (RuntimeError("[BitmapTextureImpl[float32]] eval(): queried\nfor a spectrum"), 2),
        (wrapped(RuntimeError("[GridVolume] the grid is empty")), 2),
    ],
)
def test_what_a_render_ends_with_is_its_exit_status(scene, capsys, monkeypatch, error, status):
    """2 for what would happen again, 1 for what may not."""

    def broken(*_):
        raise error

    monkeypatch.setattr(render, "render", broken)
    assert main(["render", str(scene), "-o", "a.exr"]) == status
    *_, last = capsys.readouterr().err.splitlines()
    assert last.startswith("error: ") and "Traceback" not in last and "see above" not in last
    lacking = any("memory" in repr(found).lower() for found in (error, error.__cause__))
    assert ("not enough memory" in last) == lacking


@pytest.mark.parametrize(
    "error",
    [
        KeyError("bug"),
        RuntimeError("bug"),
        wrapped(RuntimeError("bug")),
        RuntimeError("[Lamp] eval(): Traceback (most recent call last):\nKeyError: bug"),
        RuntimeError("[ImageBlock] put_block(): mismatched channel counts!"),
        wrapped(RuntimeError("[HDRFilm] prepare(): wrong")),
    ],
)
def test_a_bug_shows_its_traceback(scene, monkeypatch, error):
    def broken(*_):
        raise error

    monkeypatch.setattr(render, "render", broken)
    with pytest.raises(type(error)) as caught:
        main(["render", str(scene), "-o", "a.exr"])
    assert caught.value is error


@pytest.mark.parametrize("kind", ["bdpt", "path"])
def test_an_error_of_a_plugin_is_one_line(tmp_path, capsys, kind):
    mi.Bitmap(np.ones((2, 2, 3), dtype=np.float32)).write(str(tmp_path / "t.exr"))
    text = (
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" '
        'value="4"/><integer name="height" value="4"/></film><transform name="to_world"><lookat '
        'origin="0,0,3" target="0,0,0" up="0,1,0"/></transform></sensor><shape type="rectangle"><emitter '
        'type="area"><texture type="bitmap" name="radiance"><string name="filename" value="t.exr"/><boolean '
        'name="raw" value="true"/></texture></emitter></shape></scene>'
    )
    (tmp_path / "a.xml").write_text(text)
    variant = variants.of("spectral")
    arguments = ["--spp", "1", "-m", variant, "--integrator", kind, "-o", str(tmp_path / "a.exr")]
    assert main(["render", str(tmp_path / "a.xml"), *arguments]) == 2
    *_, last = capsys.readouterr().err.splitlines()
    assert last.startswith("error: [BitmapTexture") and last.endswith("explicitly disabled! (raw=true)")


def test_a_render_without_noise_is_stopped_by_its_time():
    options = build_parser().parse_args(["render", "a.xml", "--time", "1"])
    outcome = render.Outcome(1.0, 16, False, statistics={"error": 0.0})
    words = render.stopped_by(options, Settings(timeout=1.0), outcome, 32)
    assert words == "stopped by the time limit of 1 s after 16 spp"


@pytest.mark.parametrize("kind", ["path", "ptracer"])
def test_other_integrators_keep_to_the_time_too(scene, capsys, kind):
    """Seeds of 16 spp until the time is over, their mean in the film (2 everywhere)."""
    assert main(["render", str(scene), "--integrator", kind, "--time", "0.3", "-o", "a.exr"]) == 0
    statistics = json.loads(read("a.exr")[1]["bdptStatistics"])
    assert statistics["spp"] >= 16 and statistics["spp"] % 16 == 0
    if kind == "path":
        np.testing.assert_allclose(read("a.exr")[0], 2.0, rtol=1e-5)
    assert "; stopped by the time limit of 0.3 s after " in capsys.readouterr().out
    arguments = ["--integrator", kind, "--time", "60", "--spp", "24", "-o", "b.exr"]
    assert main(["render", str(scene), *arguments]) == 0
    out = capsys.readouterr().out
    assert " 24 spp " in out and "stopped" not in out


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("plian.xml", "did you mean plain.xml? the folder '.' has other.xml, plain.xml"),
        (".", "the folder '.' has other.xml, plain.xml"),
        ("nowhere/plain.xml", "the folder 'nowhere' has no scene files (.xml)"),
    ],
)
def test_missing_scene_is_reported(scene, capsys, name, words):
    Path("other.xml").write_text(SCENE)
    Path("empty").mkdir()
    assert main(["render", name]) == 2
    assert f"scene={name!r} is not a file; {words}\n" in capsys.readouterr().err
    assert not Path("renders").exists()


@pytest.mark.parametrize("kind", ["diffuse", "cli_mirror"])
def test_what_is_no_integrator_is_refused_in_a_scene_without_one_too(scene, capsys, kind):
    mi.set_variant("llvm_ad_rgb")
    mi.register_bsdf("cli_mirror", lambda properties: mi.load_dict({"type": "conductor"}))
    start, end = SCENE.index("<integrator"), SCENE.index("<sensor")
    text = SCENE.replace(SCENE[start:end], "").replace('<default name="integrator" value="path"/>', "")
    scene.write_text(text)
    assert main(["render", str(scene), "--integrator", kind]) == 2
    assert capsys.readouterr().err.startswith(f"error: integrator={kind!r} is a plugin of ")
    assert main(["render", str(scene), "--spp", "1", "-o", "a.exr"]) == 0  # by bdpt
    assert json.loads(read("a.exr")[1]["bdptStatistics"])["rays"]["camera"] == 6 * 4


@pytest.mark.parametrize(
    ("arguments", "question"),
    [
        (["rendr"], "did you mean render?"),
        (["render", "plain.xml", "--traget-error=1"], "did you mean --target-error?"),
        (
            ["render", "plain.xml", "--light-groups", "auto"],
            "that is a parameter of the integrator: -P light_groups=VALUE",
        ),
        (["render", "plain.xml", "--check", "4"], "did you mean --checkpoint?"),
        (["sweep", "preset", "--sched=x"], "did you mean --scheduler?"),
        (["mix", "a.exr", "--spp", "4"], "see mitsuba-bdpt --help"),
    ],
)
def test_mistyped_commands_and_options_are_answered_with_those_that_exist(capsys, arguments, question):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(arguments)
    assert caught.value.code == 2 and capsys.readouterr().err.endswith(f"; {question}\n")


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_a_file_of_another_format_is_not_overwritten(scene, capsys, name):
    Path(name).write_text("precious")
    assert main(["render", str(scene), "-o", "a.exr"]) == 2
    assert Path(name).read_text() == "precious"
    assert "would overwrite" in capsys.readouterr().err
    Path(name).unlink()
    assert [main(["render", str(scene), "-o", "a.exr"]) for _ in range(2)] == [0, 0]


@pytest.mark.parametrize("missing", [1, 100, 5000])
def test_a_full_disk_leaves_the_former_image(tmp_path, monkeypatch, missing):
    pixels = (np.random.default_rng(1).random((64, 64, 3)) * 255).astype(np.uint8)
    image, png, path = mi.Bitmap(pixels), mi.Bitmap.FileFormat.PNG, tmp_path / "a.png"
    images.write_whole(image, path, png)
    size = path.stat().st_size
    path.write_bytes(b"former")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size - missing, before[1]))
    try:
        with pytest.raises(OSError):  # noqa: PT011 (its text is the system's)
            images.write_whole(image, path, png)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"] and path.read_bytes() == b"former"


@pytest.mark.parametrize(
    "kind", ["folder", "folder.png", "pipe", "name", "in a file", "no name", "checkpoint"]
)
def test_an_output_that_cannot_be_written_is_refused_before_the_render(scene, capsys, monkeypatch, kind):
    monkeypatch.setattr(render, "render", lambda *arguments: pytest.fail("rendered"))
    names = {"name": "a" * 251 + ".exr", "in a file": "text/a.exr", "no name": ".exr"}
    output = Path(names.get(kind, "a.exr"))
    Path("text").touch()
    if kind == "pipe":
        os.mkfifo(output)
    elif kind not in names:
        Path({"folder.png": "a.png", "checkpoint": "a.checkpoint.npz"}.get(kind, "a.exr")).mkdir()
    more = ["--checkpoint", "1"] if kind == "checkpoint" else []
    before = sorted(Path().iterdir())
    assert main(["render", str(scene), "-o", str(output), *more]) == 2
    assert capsys.readouterr().err.startswith("error: ") and sorted(Path().iterdir()) == before


@pytest.mark.parametrize(
    "arguments",
    ["--spp 0", "--spp 1.5", "--time nan", "--time -1", "--seed -1", f"--seed {2**32}", "-D x", "-P =1"]
    + ["--sensor x", "--size 16", "--size 0x4", "--crop 1,2,3", "--crop 0,0,0,4"]
    + ["--threads 0", "--resume plain.xml", "--resume yes"],
)
def test_bad_values_are_usage_errors(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(["render", "scene.xml", *arguments.split()])
    error = capsys.readouterr().err
    assert caught.value.code == 2 and re.search("which must|choose from", error) and error.count("\n") == 1
    assert error.startswith("mitsuba-bdpt render: error: ") and "see mitsuba-bdpt render --help" in error


@pytest.mark.parametrize(
    ("arguments", "used", "line"),
    [
        (
            [],
            "bdpt",
            "bdpt in place of the scene file's path, with its max_depth=3, hide_emitters=False; --integrator",
        ),
        (["-Dintegrator=bdpt"], "bdpt", "bdpt, the scene file's own"),
        (["--integrator", "scene"], "path", "path, the scene file's own"),
        (["--integrator", "volpath"], "volpath", "volpath in place of the scene file's path, with its max"),
    ],
)
def test_bdpt_renders_unless_the_command_line_says_otherwise(scene, capsys, arguments, used, line):
    assert main(["render", str(scene), "-o", "a.exr", *arguments]) == 0
    assert capsys.readouterr().err.startswith(f"integrator: {line}")
    assert ("rays" in json.loads(read("a.exr")[1]["bdptStatistics"])) == (used == "bdpt")


def test_explain(scene, capsys):
    assert main(["explain", str(scene), "-P", "max_depth=1", "-Dlight=3"]) == 0
    said = capsys.readouterr().out
    assert "used: s=0" in said and "max_depth=1 allows no such path" in said and "no pilot" in said
    assert main(["explain", str(scene), "-P", "max_depth=oops"]) == 2
    assert "max_depth" in capsys.readouterr().err
    assert list(scene.parent.iterdir()) == [scene]
