"""Wrong parameters and arguments, odd films, files that are not there or not whole."""

import contextlib

import mitsuba as mi
import numpy as np
import pytest
import repository
from hypothesis import strategies as st
from mitsuba_bdpt.cli.arguments import main
from mitsuba_bdpt.settings import PARAMETERS

from .chance import by_chance
from .rooms import diffuse

TEXTS = "", "auto", "none", "all", "1/4", "1/0", "nan", "[]", "{", "x" * 100_000, "albedo:albedo"
ANYTHING = st.integers() | st.integers(-2, 70) | st.floats() | st.booleans() | st.text(max_size=12)
ANYTHING |= st.sampled_from(TEXTS)
SENSIBLE = {
    name: p.choices or (p.default, *[not p.default] * (p.kind is bool)) for name, p in PARAMETERS.items()
}
SENSIBLE |= {
    "max_depth": (-1, 0, 1, 2, 5, 9),
    "light_paths": ("auto", 0, 1, "1/2", 0.25, "1/16"),
    "layers": ("", "strategies", "variance", "denoised", "variance,denoised"),
    "spp_per_pass": (0, 1, 3),
    "aovs": ("", "albedo:albedo", "dd:depth,nn:sh_normal"),
}
WRONG = TypeError, ValueError, RuntimeError, NotImplementedError


@contextlib.contextmanager
def in_words(names):
    """Let errors pass that are ours and about a parameter of these ``names``."""
    try:
        yield
    except WRONG as error:
        if "bdpt: " not in str(error) or not any(name in str(error) for name in names):
            raise


def test_parameters():
    """400 dictionaries of parameters, most with one value that is anything: a word, a number, NaN, an
    infinity, 10^5 letters; 24 that are accepted are rendered.

    Expected: accepted, or an error that names a parameter; images are finite.
    """
    accepted = {}

    def load(sensible, wild):
        with in_words(sensible | wild):
            bdpt = mi.load_dict({"type": "bdpt"} | sensible | wild)
            accepted.setdefault(str(bdpt), bdpt)

    drawn = {name: st.sampled_from(values) for name, values in SENSIBLE.items()}
    # One value that is not sensible: of many the first alone would be tried.
    wild = st.just({}) | st.dictionaries(st.sampled_from(list(SENSIBLE)), ANYTHING, min_size=1, max_size=1)
    by_chance(st.tuples(st.fixed_dictionaries({}, optional=drawn), wild), lambda both: load(*both), 400)
    scene = repository.load_scene("cornell_box", resolution=4)
    assert len(accepted) >= 24
    for bdpt in list(accepted.values())[:24]:
        with in_words(SENSIBLE):
            image = np.array(bdpt.render(scene, spp=8))
            # A variance of fewer than two replicates is infinite by contract.
            assert np.isfinite(image[..., :3]).all(), bdpt.settings


def test_arguments():
    """150 times anything for `spp`, `seed` and `sensor` of `render`.

    Expected: a finite image, or an error that names the argument.
    """
    scene = repository.load_scene("cornell_box", resolution=4)
    quick = {"max_depth": 3, "light_paths": 1, "connections": "one", "timeout": 0}
    bdpt = mi.load_dict({"type": "bdpt"} | quick)  # however many samples are accepted, one pass is made

    def render(arguments):
        with in_words(arguments):
            image = np.array(bdpt.render(scene, **{"spp": 1} | arguments))
            assert image.shape == (4, 4, 3)
            assert np.isfinite(image).all()

    values = dict.fromkeys(("spp", "seed", "sensor"), ANYTHING | st.none() | st.lists(st.integers(0, 2)))
    by_chance(st.fixed_dictionaries({}, optional=values), render, 150)


# Width and height of a film, or of its crop window, at its place, and then the film's.
FILMS = [(1, 1), (1, 4097), (40_000, 2), (17, 13), (1, 1, 15, 11, 16, 12), (1, 12, 15, 0, 16, 12)]
FILMS += [(7, 1, 3, 5, 16, 12), (16, 16, 50_000, 50_000, 100_000, 100_000)]
CROP = "crop_width", "crop_height", "crop_offset_x", "crop_offset_y", "width", "height"


@pytest.mark.parametrize("parameters", [{"light_paths": 0}, {"skip": "none"}], ids=str)
@pytest.mark.parametrize("film", FILMS, ids=str)
def test_films(film, parameters):
    """Films of 1 x 1, 1 x 4097, 40000 x 2, ... pixels in a room of radiance 1; crop windows of one pixel, of
    a row, of 16 x 16 in a film of 10^10 pixels; path tracing alone, and light subpaths.

    Expected: an image of that size and radiance: within 20 %, for roulette leaves noise in one pixel, and no
    row or column below half of it, as one that lost a side of its pixels would be.
    """
    keys = dict(zip(CROP if len(film) > 2 else CROP[-2:], film, strict=True))
    made = {"type": "hdrfilm", "rfilter": {"type": "box"}} | keys
    wall = {"type": "sphere", "flip_normals": True, "bsdf": diffuse(0.5)}
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 60, "fov_axis": "larger", "film": made},
        "wall": wall | {"emitter": {"type": "area", "radiance": 0.5}},
    }
    bdpt = mi.load_dict({"type": "bdpt"} | parameters)
    image = np.array(bdpt.render(mi.load_dict(scene), spp=16), dtype=np.float64)
    assert image.shape[:2] == film[1::-1]
    assert np.isfinite(image).all()
    assert abs(image.mean() - 1) < 0.2
    assert min(image.mean((1, 2)).min(), image.mean((0, 2)).min()) > 0.5


HEAD = """
<scene version="3.0.0">
    <sensor type="perspective">
        <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>
    </sensor>
    <shape type="sphere"><emitter type="area"/></shape>
"""
BROKEN = {
    "half a scene": "",
    "no mesh": '<shape type="ply"><string name="filename" value="missing.ply"/></shape></scene>',
    "half a texture": '<emitter type="envmap"><string name="filename" value="half.exr"/></emitter></scene>',
    "no include": '<include filename="missing.xml"/></scene>',
    "a scene that includes itself": '<include filename="scene.xml"/></scene>',
}


@pytest.mark.parametrize("what", BROKEN)
def test_missing_files(what, tmp_path, capsys):
    """`python -m mitsuba_bdpt render` of half a scene, without mesh or include; with half a texture.

    Expected: one error, status 2, nothing written.
    """
    scene, texture = tmp_path / "scene.xml", tmp_path / "half.exr"
    mi.Bitmap(np.full((25, 40, 3), 0.5, dtype=np.float32)).write(str(texture))
    texture.write_bytes(texture.read_bytes()[: texture.stat().st_size // 2])
    scene.write_text(HEAD + BROKEN[what])
    before = sorted(tmp_path.rglob("*"))
    assert main(["render", str(scene), "-o", str(tmp_path / "a.exr"), "--spp", "1"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert "Traceback" not in said
    assert sorted(tmp_path.rglob("*")) == before
