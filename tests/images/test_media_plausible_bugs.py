"""Media: bugs that were planted in the package and seen by no test, one cheap scene for each.

`scripts/mutants.py` plants them. Seeds are fixed. Statistics: `welch.check_known` against known answers,
Welch's t-test of image means (`test_media_edges.assert_agree`) elsewhere.
"""

from __future__ import annotations

from functools import partial

import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import welch as st
from test_known_failures import ball_mesh
from test_media_edges import ALL, CAMERA, assert_agree, means, unweighted

SEEDS = 8
check = partial(st.check_known, rounding=5e-5)


def render(scene, spp, **parameters):
    """Image means by seed and channel."""
    method = parts.integrator(**parameters)
    return parts.images(mi.load_dict(scene), method, spp, 10, SEEDS).mean((1, 2))


BOUNDARIES = {
    "null": lambda: {"type": "null"},
    "mask": lambda: {"type": "mask", "opacity": 0.3, "bsdf": parts.matte(0, 0, 0)},
}


def wall():
    at = parts.transform().translate([0, 0, -2])
    return {"type": "rectangle", "to_world": at, "bsdf": parts.matte(0.8, 0.8, 0.8)}


def hidden_lamp(boundary, medium, fov=0.2, radiance=1.0, **more):
    """A lamp in the middle of a ball of fog, before which the camera is."""
    return {
        "type": "scene",
        "sensor": parts.sensor(origin=(0, 0, 4), target=(0, 0, 0), fov=fov, size=2),
        "ball": parts.ball(BOUNDARIES[boundary](), 1.0, (0, 0, 0), interior=medium),
        "lamp": parts.lamp(center=[0, 0, 0], radius=0.4, emitter={"type": "area", "radiance": radiance}),
        **more,
    }


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_a_hidden_lamp_in_fog_is_passed(boundary):
    """Rationale: ``hide_emitters`` concerns the camera's first edge, which goes on through null surfaces
    (events of their own where they have other lobes too). Fog that only absorbs, behind it a wall with a
    point lamp at the distance .5. Expected, by all strategies and by camera subpaths alone: the wall's
    radiance, times e^-tau of the whole chord and what two masks let pass. Tolerance: below 5 %.
    """
    point = parts.point(position=[0, 0, -1.5])
    scene = hidden_lamp(boundary, parts.fog(0.5, 0.0), radiance=1e-6, wall=wall(), point=point)
    passed = 0.7**2 if boundary == "mask" else 1.0
    expected = 0.8 / np.pi / 0.5**2 * passed * np.exp(-1.0)
    for way in (ALL, CAMERA):
        check(render(scene, 1 << 14, max_depth=2, hide_emitters=True, **way), expected, 0.05)


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_light_behind_a_hidden_lamp_in_fog(boundary):
    """Rationale: camera rays pass a hidden lamp, and so do visibility rays of splats. A wall and fog behind
    the lamp, which covers most of the image. Expected: t = 1 alone, and the weighted sum, see the light of
    two edges that s = 1 alone sees.
    """
    scene = hidden_lamp(boundary, parts.fog(0.5, 0.8), fov=14, wall=wall())
    found = unweighted(scene, 2, 2048, hide_emitters=True)
    for s in (2, -1):
        assert_agree(found[2, s], found[2, 1])


def leaning(path, angle=60):
    """A ball of 20 triangles, whose vertex normals are turned by an ``angle``."""
    ball = mi.load_dict(ball_mesh(path, 0))
    params = mi.traverse(ball)
    normals = np.array(params["vertex_normals"]).reshape(-1, 3)
    cos, sin = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    params["vertex_normals"] = (normals @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])).ravel()
    params.update()
    ball.write_ply(str(path))
    return {"type": "ply", "filename": str(path)}


def test_a_lamp_between_two_media(tmp_path):
    """Rationale: light leaves a lamp that bounds media into the medium of its side. A null ball of triangles
    that glows, with dense fog in it; by its vertex normals a third of its light goes inwards. Expected: t = 1
    alone, and the weighted sum, see the light of two edges that s = 1 alone sees.
    """
    to_world = parts.transform().translate([0.25, 0.3, -0.2]).scale(0.25)
    lamp = leaning(tmp_path / "ball.ply") | {"to_world": to_world, "bsdf": {"type": "null"}}
    lamp |= {"emitter": {"type": "area", "radiance": 3.0}, "interior": parts.fog(8.0, 0.0)}
    found = unweighted(parts.room(light=lamp), 2, 256)
    for s in (2, -1):
        assert_agree(found[2, s], found[2, 1])


def test_a_lens_behind_a_mask_in_fog():
    """Rationale: t = 0, whose last edge goes on through null lobes and ends in the open, before the light
    does. A point lamp in a mask of opacity .3, in chromatic fog, before a wide lens. Expected: for k = 1 t =
    0 alone is (1,1) alone.
    """
    eye = parts.thinlens(origin=(0, 0, 1), target=(0, 0, 0), size=4, medium=parts.coloured())
    mask = parts.ball(BOUNDARIES["mask"](), 0.4, (0, 0, 0))
    scene = {"type": "scene", "sensor": eye | {"aperture_radius": 0.5}, "mask": mask}
    found = unweighted(scene | {"lamp": parts.point(position=[0, 0, 0])}, 1, 4096)
    assert_agree(found[1, 2], found[1, 1])


def test_a_meter_behind_a_mask_in_fog():
    """Rationale: the weight of t = 0 has T~ of its whole last edge, which goes on through null lobes. A point
    lamp in a mask of opacity .3, in fog that only absorbs, within an irradiance meter of radius 1. Expected:
    .7 e^-tau. Tolerance: below 3 %.
    """
    film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    film |= {"component_format": "float32"}
    meter = {"type": "irradiancemeter", "film": film, "medium": parts.fog(1.0, 0.0)}
    scene = {
        "type": "scene",
        "wall": parts.wall(bsdf=parts.matte(0, 0, 0), sensor=meter),
        "mask": parts.ball(BOUNDARIES["mask"](), 0.6, (0, 0, 0)),
        "lamp": {"type": "point", "position": [0, 0, 0], "intensity": 1.0},
    }
    check(render(scene, 1 << 13, max_depth=2, **ALL), 0.7 * np.exp(-1.0), 0.03)


def test_a_grid_smaller_than_its_shape():
    """Rationale: flights and joins begin within the shape, before the grid. A dense grid near a lamp, in a
    shape of its own size and in a larger one. Expected: all strategies, and camera subpaths alone, see the
    same in both.
    """
    medium = parts.grid(np.full((2, 2, 2), 1.0), parts.LOW, parts.EDGE, 6.0, 0.9)
    lamp = parts.point(position=[-0.35, 0.35, -0.2])
    tight, wide = (
        mi.load_dict(
            parts.room(light=lamp, box=parts.box(parts.LOW - gap, parts.EDGE + 2 * gap, interior=medium))
        )
        for gap in (0.0, 0.15)
    )
    expected = means(tight, 300, 128, **CAMERA)
    for way in (ALL, CAMERA):
        assert_agree(means(wide, 10, 128, **way), expected)
