"""Light that bounces long, through glass in glass, off mirrors, off surfaces of every roughness."""

import mitsuba as mi
import numpy as np
import pytest
from scene_parts import T
from warned import Warned

from scenes import DOWNWARDS, area, floor, square

from .compare import WAYS, agree, tiles
from .rooms import camera, diffuse, loaded, view

SEEDS = range(8)


def scene(sensor=None, **found):
    """A scene of these parts, seen from within the unit sphere unless a ``sensor`` is given."""
    return loaded(sensor or camera(), **found)


def look(origin, target, fov):
    return view(origin, target, fov, (0, 1, 0))


# -- closed rooms ---------------------------------------------------------------------------------

# With this ``rr_depth``, what roulette makes noisy is 0.99^1200 of the light.
LATE = 1200


@pytest.mark.parametrize("albedo, depth, spp", [(1.0, 40, 32), (0.99, -1, 8), (1.5, 7, 64)])
@pytest.mark.parametrize("room", ["point", "cube"])
def test_closed_rooms(room, albedo, depth, spp):
    """A point light in a closed sphere, a closed cube that glows everywhere; albedo 1 to 40 edges, 0.99
    without limit, 1.5 to 7 edges; all strategies, and defaults.

    Expected: the sum of albedo^m over all reflections; Student's test of tiles (1e-3), which sees errors of 3
    % (roulette makes long paths noisy).
    """
    if room == "point":
        target = scene(
            wall={"type": "sphere", "bsdf": diffuse(albedo)},
            lamp={"type": "point", "intensity": float(np.pi)},
        )
    else:
        wall = {"type": "cube", "flip_normals": True, "bsdf": diffuse(albedo), "emitter": area(1.0)}
        target = scene(wall=wall)
    first = int(room == "point")
    known = sum(albedo**m for m in range(first, depth)) if depth >= 0 else albedo**first / (1 - albedo)
    for way in WAYS.values():
        late = {} if depth >= 0 else {"rr_depth": LATE}
        agree(tiles(target, way | late | {"max_depth": depth}, SEEDS, spp), known, 0.03)


def test_too_bright_without_limit():
    """A closed sphere whose texture reflects 1.2, no limit of the depth.

    Expected: finite, and one warning (and one of non-finite values); the true value is infinite.
    """
    bitmap = mi.Bitmap(np.full((4, 4, 3), 1.2, dtype=np.float32))
    bright = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}
    wall = {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": bright}}
    made = mi.load_dict({"type": "bdpt"})
    with Warned() as warnings:
        image = np.array(made.render(scene(wall=wall, lamp={"type": "point"}), spp=32))
    assert np.isfinite(image).all()
    assert "up to 1.2" in warnings[0]
    assert len(warnings) == 1 + bool(made.statistics["non_finite"])


# -- mirrors and glass ----------------------------------------------------------------------------

# Of the steepest ray in the corridor of mirrors, in both directions across it: 32 reflections each.
SLOPE = 0.323


@pytest.mark.parametrize("reflectance", [1.0, 0.98])
def test_corridor(reflectance):
    """Up to 64 bounces in a corridor of mirrors, 100 times as long as wide, with a lamp at its end.

    Expected: the reflectance to the number of bounces. Of 1: every tile of 16 pixels to two of its 64 x 16
    samples, without other noise. Of 0.98: means of tiles over 8 seeds to 5e-4, since rays start 2e-4 of the
    width off a mirror and so bounce the sooner (under `path` tiles are off by 4e-3).
    """
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": reflectance}
    sides = {
        f"side{i}": {
            "type": "rectangle",
            "bsdf": {"type": "twosided", "bsdf": mirror},
            "to_world": T()
            .rotate([0, 0, 1], 90 * i)
            .translate([0.5, 0, -49])
            .rotate([0, 1, 0], -90)
            .scale([51, 0.6, 1]),  # beyond the corners, so that no ray slips out between two sides
        }
        for i in range(4)
    }
    end = square((0, 0, -100), size=0.6, bsdf=diffuse(0), emitter=area(1.0))
    fov = float(np.rad2deg(2 * np.arctan(SLOPE)))
    target = scene(look((0, 0, 0), (0, 0, -1), fov), end=end, **sides)
    means = tiles(target, {"max_depth": 70, "rr_depth": 200}, SEEDS, 64)[:, :-1]
    # After n reflections about x or y; slopes are even over the film, and the tube is 1 wide.
    slopes = (np.arange(1 << 16).reshape(4, -1) + 0.5) / (1 << 15) - 1
    along = (reflectance ** np.floor(100 * SLOPE * np.abs(slopes) + 0.5)).mean(axis=1)
    known = np.outer(along, along).ravel()
    if reflectance == 1:
        np.testing.assert_allclose(means, 1, rtol=0, atol=2 / (64 * 16))
    else:
        np.testing.assert_allclose(means.mean(axis=0), known, rtol=5e-4)


def glass(sensor, **inside):
    """A ball of glass in a white world, with what is ``inside`` it."""
    ball = {"type": "sphere", "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}
    return scene(sensor, ball=ball, sky={"type": "constant", "radiance": 1.0}, **inside)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("index", [1.33, 1.0, 2.4])
def test_nested_dielectrics(index, way):
    """A ball of water, air or diamond in a ball of glass in a white world; all strategies, and defaults.

    Expected: radiance 1, as nothing is absorbed: Student's test of tiles (1e-3), which sees errors of 2 %.
    """
    bsdf = {"type": "dielectric", "int_ior": index, "ext_ior": 1.5}
    inner = {"type": "sphere", "center": [0.2, 0.1, 0.0], "radius": 0.6, "bsdf": bsdf}
    target = glass(look((0, 0, 4), (0, 0, 0), 40), inner=inner)
    agree(tiles(target, WAYS[way] | {"rr_depth": 200}, SEEDS, 64), 1.0, 0.02)


def test_total_reflection():
    """A lamp in a glass cube of index 1.8: most of its light is reflected totally.

    Expected: as `path`: Welch's test of tiles (1e-3), which sees errors of 3 % (few paths leave the cube).
    """
    target = scene(
        look((0, 1, 3.5), (0, -0.2, 0), 40),
        cube={
            "type": "cube",
            "to_world": T().rotate([0.70710678, 0.70710678, 0], 30).scale(0.5),
            "bsdf": {"type": "dielectric", "int_ior": 1.8},
        },
        lamp={"type": "sphere", "radius": 0.2, "bsdf": diffuse(0.3), "emitter": area(3.0)},
        floor=floor(-1, 2, diffuse(0.6)),
    )
    theirs = tiles(target, {"type": "path", "max_depth": 16}, SEEDS, 1024)
    for way in WAYS.values():
        agree(tiles(target, way | {"max_depth": 16}, SEEDS, 256), theirs, 0.03)


# -- surfaces of every roughness ------------------------------------------------------------------

SHARP = {
    kind: {"type": kind, "alpha": 1e-4} for kind in ("roughconductor", "roughdielectric", "roughplastic")
}
SURFACES = {
    f"{kind} {alpha:g}": {"type": kind, "alpha": alpha}
    for kind in SHARP
    for alpha in (1e-4, 1e-3, 1e-2, 0.1, 1.0)
} | {
    "sharp metal beside glass": {
        "type": "blendbsdf",
        "weight": 0.5,
        "one": SHARP["roughconductor"],
        "two": {"type": "dielectric"},
    },
    "sharp glass beside glass": {
        "type": "blendbsdf",
        "weight": 0.5,
        "one": SHARP["roughdielectric"],
        "two": {"type": "dielectric"},
    },
    "sharp plastic in a mask": {"type": "mask", "opacity": 0.5, "bsdf": SHARP["roughplastic"]},
    "sharp principled": {
        "type": "principled",
        "roughness": 0.01,
        "spec_trans": 0.5,
        "clearcoat": 1.0,
        "base_color": 0.7,
    },
}


@pytest.mark.parametrize("name", SURFACES)
def test_surface(name):
    """A ball and a plate of rough metal, glass and plastic of roughness 1e-4 to 1, of blends and a mask with
    such sharp lobes, and of `principled`, in a room with a wide lamp; sharp ones also with all strategies.

    Expected: as `path`, every value finite: Welch's test of tiles (1e-3), which sees errors of 2 %.
    """
    bsdf = SURFACES[name]
    target = scene(
        look((0, 0.4, 3.2), (0, 0.1, 0), 45),
        floor=floor(-0.6, 2.5, diffuse(0.5)),
        back=square((0, 0.9, -1.5), size=2.5, bsdf=diffuse(0.4)),
        ball={"type": "sphere", "center": [-0.6, 0, 0], "radius": 0.55, "bsdf": bsdf},
        plate=square((0.8, 0, -0.2), ([0, 1, 0], -25), 0.5, bsdf),
        lamp=square((0, 2.2, 0.5), DOWNWARDS, 0.9, diffuse(0), emitter=area(2.0)),
        sky={"type": "constant", "radiance": 0.1},
    )
    theirs = tiles(target, {"type": "path", "max_depth": 6}, SEEDS, 512)
    for way in WAYS if "sharp" in name or "0.0001" in name else ("defaults",):
        agree(tiles(target, WAYS[way] | {"max_depth": 6}, SEEDS, 128, sound=True), theirs, 0.02)
