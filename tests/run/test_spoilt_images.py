"""Warnings before the first pass of images that are black, incomplete or negative."""

import math

import mitsuba as mi
import numpy as np
import pytest
from support import variants
from warned import Warned

T = mi.ScalarTransform4f
SKY = {"sky": {"type": "constant"}}
GLASS = {"type": "dielectric"}
GROUP = {"type": "shapegroup", "ball": {"type": "sphere"}}
FILM = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgb"}


def sky_and(**shape):
    return SKY | {"thing": shape}


def red(value):
    return {"type": "area", "radiance": {"type": "rgb", "value": [value, 1, 1]}}


def pane(x, thickness, bsdf=GLASS, turn=0):
    size = T().rotate([0, 1, 0], turn).scale([1, 1, thickness / 2])
    return sky_and(type="cube", bsdf=bsdf, to_world=T().translate([x, 0, 0]) @ size)


def rendered(parts, x=0, **parameters):
    """The image of a scene that is seen from (x, 0, 3), warnings, and those of `explain`."""
    eye = T().look_at([x, 0, 3], [x, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {"type": "scene", "sensor": {"type": "perspective", "fov": 20, "to_world": eye, "film": FILM}} | parts
    )
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 2, "light_paths": 0, **parameters})
    with Warned() as texts:
        image = np.array(bdpt.render(scene, spp=16))
        bdpt.render(scene, spp=1)
    lines = bdpt.explain(scene).splitlines()
    return image, texts, [line.removeprefix("warning: ") for line in lines if line.startswith("warning: ")]


SPOILT = {
    "no emitter": ({}, {}, "the scene has no emitter; the image is black"),
    "intensity 0": ({"a": {"type": "point", "intensity": 0.0}}, {}, "no emitter of the scene emits light"),
    "negative": ({"a": {"type": "point", "intensity": -1.0}}, {}, "emitter 'a' has negative radiance"),
    "negative red": ({"a": {"type": "sphere", "lamp": red(-1)}}, {}, "emitter 'a' has negative radiance"),
    "max_depth": (SKY, {"max_depth": 0}, "max_depth=0 leaves no path"),
    "hidden": (SKY, {"max_depth": 1, "hide_emitters": True}, "max_depth=1 renders only directly"),
    "NaN": (sky_and(type="sphere", center=[math.nan, 0, 0]), {}, "shape 'thing' has NaN or infinity"),
    "point": (sky_and(type="cube", to_world=T().scale(0)), {}, "shape 'thing' is a point or a line"),
    "line": (sky_and(type="disk", to_world=T().scale([0, 1, 1])), {}, "shape 'thing' is a point or a line"),
    "narrow": (SKY | {"a": {"type": "spot", "cutoff_angle": 0.1}}, {}, "spot 'a' has cutoff_angle=0.1"),
    "overlap": ({name: {"type": "rectangle", "lamp": red(1)} for name in "ab"}, {}, "overlap in one plane"),
    "flat": (sky_and(type="cylinder", to_world=T().scale([0, 1, 1])), {}, "'thing' is a point or a line"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_what_spoils_an_image_is_said(name):
    """Rationale: the image was black or wrong without a word. Expected: one warning, once for all renders,
    the same in `explain`."""
    parts, parameters, words = SPOILT[name]
    _, texts, explained = rendered(parts, **parameters)
    assert [words in text for text in texts] == [True]
    assert texts[0].strip() == explained[0]


@pytest.mark.parametrize("colour", ["rgb", "spectral"])
def test_black_skies(colour):
    """Expected: a warning in each variant, though spectral ones store coefficients of spectra."""
    mi.set_variant(variants.of(colour))
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.zeros((4, 8, 3), np.float32))}
    assert "no emitter of the scene emits light" in rendered({"sky": sky})[1][0]


SOUND = {
    "red lamp": ({"a": {"type": "sphere", "lamp": red(0)}}, {}),
    "features alone": (SKY, {"max_depth": 0, "aovs": "dd:depth"}),
    "instance": (SKY | {"group": GROUP, "a": {"type": "instance", "b": {"type": "ref", "id": "group"}}}, {}),
    "plates of one material": (SKY | {name: {"type": "rectangle"} for name in "ab"}, {}),
    "flat glass": (sky_and(type="rectangle", bsdf=GLASS, to_world=T().rotate([0, 1, 0], 30)), {}),
    "paper": (pane(0, 1e-7, {"type": "diffuse"}), {}),
}


@pytest.mark.parametrize("name", SOUND)
def test_nothing_is_said_of_sound_scenes(name):
    parts, parameters = SOUND[name]
    assert rendered(parts, **parameters)[1:] == ([], [])


@pytest.mark.parametrize(("x", "share"), [(0, 1.1), (4096, 0.5), (4096, 1.5), (500_000, 0.3)])
def test_panes_thinner_than_the_ray_offset(x, share):
    """Paths to the sky through both faces of a pane have three edges, through a single face two: with
    max_depth=2 the image has the light that the pane reflects, 4 % of it from the front (a mean of 0.08 and
    less with that of the back), or all of it, where a face is lost. Expected: the latter, and a warning, for
    panes of less than a ray offset at their place, seen from nearby; neither for the thicker ones (at the
    origin the ray's length of 3 makes the offset: 4 times that)."""
    thickness = share * 32 * 2**-24 * (x + 1) * (1 if x else 4)
    image, texts, _ = rendered(pane(x, thickness), x=x)
    assert (image.mean() > 0.4) == (share < 1)
    thin = [text.startswith("shape 'thing' lets light through and is thinner") for text in texts]
    assert thin == [True] * (share < 1)


def test_panes_that_are_turned_or_merged():
    """Expected: a warning too; Mitsuba merges meshes of one material, and names the mesh itself."""
    thickness = 16 * 2**-24 * 4096
    assert "'thing' lets light" in rendered(pane(4096, thickness, turn=30), x=4096)[1][0]
    panes = {
        name: pane(x, thickness, {"type": "ref", "id": "glass"})["thing"]
        for name, x in (("a", 4096), ("b", 4099))
    }
    assert "thinner than single precision" in rendered({"glass": GLASS} | SKY | panes, x=4096)[1][0]


def ball(n=32, radius=0.01):
    """Vertices and faces of a ball 1 km from the origin, its edges shorter than the ray offset of 2 mm."""
    i, j = (index.ravel() for index in np.indices((n, n)))
    height, turn = np.pi * i / (n - 1), 2 * np.pi * j / n
    points = [np.sin(height) * np.cos(turn), np.sin(height) * np.sin(turn), np.cos(height)]
    lower, next_one = np.minimum(i + 1, n - 1) * n, (j + 1) % n
    faces = [i * n + j, lower + j, i * n + next_one, i * n + next_one, lower + j, lower + next_one]
    return radius * np.transpose(points) + [1000, 0, 0], np.transpose(faces).reshape(-1, 3)


FLOOR = [[0, 0, 1000], [1, 0, 1000.0001], [0, 1, 1000], [1, 1, 1000.0001]], [[0, 1, 2], [2, 1, 3]]


@pytest.mark.parametrize(("corners", "faces"), [FLOOR, ball()], ids=["floor", "ball"])
def test_meshes_that_are_not_thin(corners, faces):
    """Expected: no warning of a floor of glass, far from the origin, whose points are off by an ulp, nor of a
    finely tessellated ball that is ten ray offsets thick."""
    mesh = mi.Mesh("mesh", len(corners), np.size(faces) // 3)
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = np.float32(corners).ravel(), np.ravel(faces)
    params.update()
    mesh.set_bsdf(mi.load_dict(GLASS))
    assert rendered(SKY | {"mesh": mesh})[1] == []
