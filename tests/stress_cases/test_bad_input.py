"""Wrong parameters and arguments, odd films, files that are not there or not whole."""

import contextlib

import mitsuba as mi
import numpy as np
import pytest
import repository
from hypothesis import strategies as st
from mitsuba_bdpt.cli.arguments import main

from .chance import by_chance

ANYTHING = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.integers(-2, 70),
    st.floats(),
    st.booleans(),
    st.text(max_size=12),
    st.sampled_from(
        ["", "auto", "none", "all", "1/4", "1/0", "nan", "[]", "{", "x" * 100_000, "albedo:albedo"]
    ),
)
SENSIBLE = {
    "max_depth": (-1, 0, 1, 2, 5, 9),
    "rr_depth": (1, 3, 100),
    "hide_emitters": (False, True),
    "merging": (False, True),
    "light_paths": ("auto", 0, 1, "1/2", 0.25, "1/16"),
    "layers": ("", "strategies", "variance", "denoised", "variance,denoised"),  # stokes: polarized alone
    "target_error": (0.0, 0.1),
    "spp_per_pass": (0, 1, 3),
    "timeout": (-1.0, 0.0, 1e9),
    "heuristic": ("balance", "power"),
    "skip": ("auto", "impossible", "none"),
    "connections": ("auto", "all", "one", "none"),
    "points": ("sobol", "independent"),
    "guiding": ("auto", "always", "photons", "emission", "never"),
    "aovs": ("", "albedo:albedo", "dd:depth,nn:sh_normal"),
}
# Mostly with one value that is not sensible: of many the first alone would be tried.
PARAMETERS = st.builds(
    lambda sensible, wild: sensible | wild,
    st.fixed_dictionaries({}, optional={name: st.sampled_from(values) for name, values in SENSIBLE.items()}),
    st.just({}) | st.dictionaries(st.sampled_from(list(SENSIBLE)), ANYTHING, min_size=1, max_size=1),
)
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

    def load(parameters):
        with in_words(parameters):
            bdpt = mi.load_dict({"type": "bdpt", **parameters})
            accepted.setdefault(str(bdpt), bdpt)

    by_chance(PARAMETERS, load, 400)
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

    values = ANYTHING | st.none() | st.lists(st.integers(0, 2), max_size=2)
    by_chance(
        st.fixed_dictionaries({}, optional=dict.fromkeys(("spp", "seed", "sensor"), values)), render, 150
    )


def crop(x, y, width, height, film=(16, 12)):
    found = {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}
    return found | {"width": film[0], "height": film[1]}


SIZES = (1, 1), (1, 7), (301, 1), (1, 4097), (40_000, 2), (17, 13)
FILMS = [
    *({"width": width, "height": height} for width, height in SIZES),
    *(
        crop(*window)
        for window in ((0, 0, 1, 1), (15, 11, 1, 1), (15, 0, 1, 12), (3, 5, 7, 1), (0, 0, 16, 12))
    ),
    crop(50_000, 50_000, 16, 16, (100_000, 100_000)),
]
# Windows of nothing, and beyond the film.
REFUSED = [{"width": -1, "height": 8}, *(crop(*w) for w in ((4, 4, 0, 5), (16, 12, 1, 1), (8, 8, 9, 4)))]


def seen(film, parameters):
    """The image of a room of radiance 1."""
    wall = {"type": "sphere", "flip_normals": True, "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    # Where there are no pixels the larger axis has no field of view, and Mitsuba would speak of that.
    axis = "larger" if film["width"] > 0 else "x"
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}} | film
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 60, "fov_axis": axis, "film": film},
        "wall": wall | {"emitter": {"type": "area", "radiance": 0.5}},
    }
    bdpt = mi.load_dict({"type": "bdpt"} | parameters)
    return np.array(bdpt.render(mi.load_dict(scene), spp=16), dtype=np.float64)


@pytest.mark.parametrize("parameters", [{"light_paths": 0}, {"skip": "none"}], ids=str)
@pytest.mark.parametrize("film", FILMS, ids=lambda film: str(list(film.values())))
def test_films(film, parameters):
    """Films of 1 x 1, 1 x 4097, 40000 x 2, ... pixels in a room of radiance 1; crop windows of one pixel, of
    a row, of 16 x 16 in a film of 10^10 pixels; path tracing alone, and light subpaths.

    Expected: an image of that size and radiance: within 20 %, for roulette leaves noise in one pixel, and no
    row or column below half of it, as one that lost a side of its pixels would be.
    """
    image = seen(film, parameters)
    assert image.shape[:2] == (film.get("crop_height", film["height"]), film.get("crop_width", film["width"]))
    assert np.isfinite(image).all()
    assert abs(image.mean() - 1) < 0.2
    assert min(image.mean((1, 2)).min(), image.mean((0, 2)).min()) > 0.5


@pytest.mark.parametrize("film", REFUSED, ids=lambda film: str(list(film.values())))
def test_films_without_pixels(film):
    """A film of a negative width; crop windows of nothing, beyond the film.

    Expected: an error that names width, height or the crop window.
    """
    with pytest.raises((ValueError, RuntimeError), match=r"width|height|crop|\d x \d"):
        seen(film, {})


SCENE = """
<scene version="3.0.0">
    <sensor type="perspective">
        <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>
    </sensor>
    <shape type="sphere"><emitter type="area"/></shape>
    {}
</scene>
"""
SHAPE = SCENE.format('<shape type="ply"><string name="filename" value="{}"/></shape>')
SKY = SCENE.format('<emitter type="envmap"><string name="filename" value="{}"/></emitter>')
BROKEN = {
    "no scene": None,
    "an empty file": b"",
    "bytes that are no text": b"\xff\x00\xfe" * 999,
    "half a scene": SCENE[:150].encode(),
    "no mesh": SHAPE.format("missing.ply").encode(),
    "no texture": SKY.format("missing.exr").encode(),
    "a folder for a mesh": SHAPE.format("folder").encode(),
    "half a mesh": SHAPE.format("half.ply").encode(),
    "half a texture": SKY.format("half.exr").encode(),
    "no include": SCENE.format('<include filename="missing.xml"/>').encode(),
    "a scene that includes itself": SCENE.format('<include filename="scene.xml"/>').encode(),
}


@pytest.mark.parametrize("what", BROKEN)
def test_missing_files(what, tmp_path, capsys):
    """`python -m mitsuba_bdpt render` without scene, mesh, texture, include; with half of one.

    Expected: one error, status 2, nothing written.
    """
    (tmp_path / "folder").mkdir()
    mi.Bitmap(np.full((25, 40, 3), 0.5, dtype=np.float32)).write(str(tmp_path / "whole.exr"))
    meshes = (repository.ROOT / "scenes" / "meshes").glob("*.ply")
    for name, source in (("half.ply", next(meshes)), ("half.exr", tmp_path / "whole.exr")):
        (tmp_path / name).write_bytes(source.read_bytes()[: source.stat().st_size // 2])
    scene = tmp_path / "scene.xml"
    if BROKEN[what] is not None:
        scene.write_bytes(BROKEN[what])
    before = sorted(tmp_path.rglob("*"))
    assert main(["render", str(scene), "-o", str(tmp_path / "a.exr"), "--spp", "1"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert "Traceback" not in said
    assert sorted(tmp_path.rglob("*")) == before
