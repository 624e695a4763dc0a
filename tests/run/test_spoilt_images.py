"""Warnings before the first pass of images that are black, incomplete or negative."""

import math

import mitsuba as mi
import numpy as np
import pytest

from stress_cases.warned import Warned

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
    "hidden": (SKY, {"max_depth": 1, "hide_emitters": True}, "max_depth=1 leaves visible emitters alone"),
    "NaN": (sky_and(type="sphere", center=[math.nan, 0, 0]), {}, "shape 'thing' has NaN or infinity"),
    "point": (sky_and(type="cube", to_world=T().scale(0)), {}, "shape 'thing' is a point or a line"),
    "line": (sky_and(type="disk", to_world=T().scale([0, 1, 1])), {}, "shape 'thing' is a point or a line"),
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


@pytest.mark.parametrize(("x", "share"), [(0, 1.1), (4096, 0.5), (4096, 1.5)])
def test_panes_thinner_than_the_ray_offset(x, share):
    """Paths to the sky through both faces of a pane have three edges, through a single face two: with
    max_depth=2 the image has the light that the pane reflects, 4 % of it from the front (a mean of 0.08 and
    less with that of the back), or all of it, where a face is lost.

    Expected: the latter, and a warning, for the pane of half a ray offset at its place, seen from nearby;
    neither for the thicker ones (at the origin the ray's length of 3 makes the offset: 4 times that)."""
    thickness = share * 32 * 2**-24 * (x + 1) * (1 if x else 4)
    image, texts, _ = rendered(pane(x, thickness), x=x)
    assert (image.mean() > 0.4) == (share < 1)
    assert [text.startswith("shape 'thing' lets light through and is thinner") for text in texts] == [
        True
    ] * (share < 1)


def test_panes_that_are_turned_or_merged():
    """Expected: a warning too; Mitsuba merges meshes of one material, and names the mesh itself."""
    thickness = 16 * 2**-24 * 4096
    assert "'thing' lets light" in rendered(pane(4096, thickness, turn=30), x=4096)[1][0]
    panes = {
        name: pane(x, thickness, {"type": "ref", "id": "glass"})["thing"]
        for name, x in (("a", 4096), ("b", 4099))
    }
    assert "thinner than the ray offset" in rendered({"glass": GLASS} | SKY | panes, x=4096)[1][0]


def test_a_flat_mesh_that_is_rounded_is_not_thin():
    """Expected: no warning of a floor of glass, far from the origin, whose points are off by an ulp."""
    mesh = mi.Mesh("floor", 4, 2)
    params = mi.traverse(mesh)
    corners = np.array([[0, 0, 1000], [1, 0, 1000.0001], [0, 1, 1000], [1, 1, 1000.0001]], dtype=np.float32)
    params["vertex_positions"], params["faces"] = corners.ravel(), [0, 1, 2, 2, 1, 3]
    params.update()
    assert 0 < np.ptp(corners[:, 2]) < 1e-3
    mesh.set_bsdf(mi.load_dict(GLASS))
    assert rendered(SKY | {"floor": mesh})[1] == []
