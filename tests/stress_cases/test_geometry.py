"""Surfaces that are very near, very thin, very small, or where they should not be."""

import numpy as np
import pytest
from meshes import as_ply
from mitsuba_bdpt.measure.agreement import Sample
from scene_parts import T, grey

from scenes import load as scene
from scenes import square

from .compare import WAYS, family, tiles
from .rooms import area, view

PATH = {"type": "path"}


def floor(reflectance=0.5, half=2.0):
    """In the plane z = 0, facing up."""
    return {"type": "rectangle", "to_world": T().scale(half), "bsdf": grey(reflectance)}


def lamp(height=3.0, half=0.3, radiance=10.0, at=(0.4, 0.3)):
    """A square that faces down."""
    return square((*at, height), ([1, 0, 0], 180), half, grey(0.0), emitter=area(radiance))


BALL = {"type": "sphere", "center": [0, 0, 0.4], "radius": 0.4}
VIEW = (2, -3, 2), (0, 0, 0.3)


def alike(pairs, depth, spp=256, most_error=0.02, theirs=None) -> None:
    """Welch's t-test (Šidák at 1e-3) of tile means of ``pairs`` of scenes, over 6 seeds a side, by defaults
    and with all strategies; the other by the same, or by ``theirs``."""
    found, depth = [], {"max_depth": depth}
    for one, other in pairs:
        for way in WAYS.values():
            ours = tiles(one, way | depth, range(6), spp, sound=True)
            their_spp = 2 * spp if theirs else spp
            found.append((ours, tiles(other, (theirs or way) | depth, range(10, 16), their_spp)))
    family([(Sample.of(a), Sample.of(b)) for a, b in found], most_error)


def known(scenes, parameters, spp=256, most_error=0.01) -> None:
    """Student's t-test (Šidák at 1e-3) of the image's mean over 8 seeds, beside the value known of each
    scene."""
    ours = [
        (tiles(made, way | parameters, range(8), spp, sound=True)[:, -1:], value)
        for made, value in scenes
        for way in WAYS.values()
    ]
    family([(Sample.of(values), Sample.known([value])) for values, value in ours], most_error)


# -- plates, walls, contacts ----------------------------------------------------------------------


def slab(axis, place, thickness=1e-4):
    """A wall across an axis, wide enough that walls overlap at the edges of a room of 2 units."""
    half, centre = [1.0 + 2 * thickness] * 3, [0.0] * 3
    half[axis], centre[axis] = thickness / 2, place
    return {"type": "cube", "to_world": T().translate(centre).scale(half), "bsdf": grey(0.7)}


@pytest.mark.parametrize("at, camera", [(0.4, (0.1, -2.9, 0.3)), (1.9, (0.1, -0.8, 0.2))])
def test_thin_walls(at, camera):
    """A closed room of 2 with walls 1e-4 thick, lamps inside and the camera outside, or the other way.

    Expected: exactly black, for no ray may leak; not with a wall missing.
    """
    walls = {f"w{a}{s}": slab(a, s * 1.0) for a in range(3) for s in (-1, 1)}
    parts = {
        "sensor": view(camera, (0, 0, 0), 70),
        "room": {"type": "cube", "to_world": T().scale(4), "bsdf": grey(0.7)},
        "point": {"type": "point", "position": [at, 0.2, at], "intensity": 10.0},
        "ball": {"type": "sphere", "center": [-at, 0.3, 0.4], "radius": 0.2, "emitter": area(20.0)},
    }
    closed = scene(**parts, **walls)
    del walls["w1-1"]
    for way in WAYS.values():
        seen, leaks = (
            tiles(made, way | {"max_depth": 6}, range(2), 256) for made in (scene(**parts, **walls), closed)
        )
        assert seen.min() > 0
        assert not leaks.any()


def test_touching():
    """A box that stands on the floor, two stacked ones.

    Expected: the image of a box that is let into the floor: Welch's test of tiles (1e-3).
    """

    def box(low, high):
        to_world = T().translate([0, 0, (low + high) / 2]).scale([0.5, 0.5, (high - low) / 2])
        return {"type": "cube", "to_world": to_world, "bsdf": grey(0.6)}

    common = {"sensor": view(*VIEW), "floor": floor(), "lamp": lamp()}
    sunk = scene(**common, box=box(-0.7, 0.8))
    standing, stacked = ({"box": box(0, 0.8)}, {"box": box(0, 0.5), "upper": box(0.5, 0.8)})
    alike([(scene(**common, **standing), sunk), (scene(**common, **stacked), sunk)], 5)


def test_coincident():
    """A floor three times in one plane, a ball twice.

    Expected: the image of one of each: Welch's test of tiles (1e-3).
    """
    ball = BALL | {"bsdf": grey(0.6)}
    common = {"sensor": view(*VIEW), "lamp": lamp(), "ball": ball, "floor": floor()}
    alike([(scene(**common, twin=ball, second=floor(), third=floor()), scene(**common))], 5)


@pytest.mark.parametrize("way", WAYS)
def test_lamp_in_the_ceiling(way):
    """A lamp in the plane of a black ceiling.

    Expected: finite, and 98 to 100.5 % of the light without the ceiling. Which of the two a ray hits is
    undefined, so that all of s = 0 may be lost; strategies that start on the lamp lose nothing. The lamp
    fills 0.36 / 9 sr, and s = 0 samples a direction in it with a density of 1 / pi at most: a share of 1.3 %
    of the weights. The rest is noise.
    """
    common = {"sensor": view(*VIEW), "floor": floor(), "lamp": lamp()}
    ceiling = lamp(half=1.5, at=(0, 0))
    del ceiling["emitter"]
    both, alone = (
        tiles(made, WAYS[way] | {"max_depth": 4}, range(4), 512, sound=True).mean()
        for made in (scene(**common, ceiling=ceiling), scene(**common))
    )
    print(f"{100 * both / alone:.4g} % of the light without the ceiling")
    assert 0.98 <= both / alone <= 1.005


# -- triangles ------------------------------------------------------------------------------------


def test_triangles_without_area():
    """Triangles without area (points, edges, needles) in a floor and in a lamp.

    Expected: they change nothing: Welch's test of tiles (1e-3).
    """
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0], [0.5, 0.5, 0]])
    whole, empty = [[0, 1, 2], [0, 2, 3]], [[4, 4, 4], [0, 0, 2], [0, 4, 2], [4, 5, 2], [1, 1, 1]]
    shines = {"bsdf": grey(0.0), "emitter": area(10.0)}
    common = {"sensor": view(*VIEW), "ball": BALL | {"bsdf": grey(0.6)}}

    def mesh(points, faces):
        return as_ply(points, np.array(faces)) | {"face_normals": True}

    plain, spoilt = (
        scene(
            **common,
            floor=mesh(points * 2, faces) | {"bsdf": grey(0.5)},
            lamp=mesh(points * [0.3, -0.3, 1] + [0.4, 0.3, 3], faces) | shines,
        )
        for faces in (whole, empty[:3] + whole + empty[3:])
    )
    alike([(spoilt, plain)], 5)


# -- lights ---------------------------------------------------------------------------------------


def test_grazing_sun():
    """A sun over a floor, cosines 0.1, 1e-2, … 1e-6.

    Expected: reflectance times irradiance over pi: Student's test (1e-3), standard error below 3 %.
    """
    scenes = []
    for cos in (0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        direction = [float(np.sqrt(1 - cos**2)), 0.0, -cos]
        sun = {"type": "directional", "direction": direction, "irradiance": 1.0 / cos}
        scenes.append(
            (scene(sensor=view((0.5, -2, 2), (0, 0, 0)), floor=floor(0.5, 4), sun=sun), 0.5 / np.pi)
        )
    known(scenes, {"max_depth": 4}, most_error=0.03)


@pytest.mark.parametrize("kind, unit_area", [("rectangle", 4), ("disk", np.pi), ("sphere", np.pi)])
def test_tiny_lamps(kind, unit_area):
    """A lamp on a rectangle, disk or sphere of 1e-6.

    Expected: the light of a point of the same intensity: Student's test (1e-3), standard error below 1 %.
    (Under `path` that of the sphere is black: its density of the cone is infinite in single precision.)
    """
    half, away = 1e-6, 2.0
    shape = {"to_world": T().translate([0, 0, away]).rotate([1, 0, 0], 180).scale(half)}
    if kind == "sphere":
        shape = {"center": [0, 0, away], "radius": half}
    shape |= {"type": kind, "bsdf": grey(0.0), "emitter": area(1 / (unit_area * half**2))}
    # Seen at an angle, so that the lamp does not stand in the way: a spot of 0.003 about the point below it.
    made = scene(sensor=view((0.5, -1, 1.5), (0, 0, 0), 0.1), floor=floor(0.5, 4), lamp=shape)
    known([(made, 0.5 / np.pi / away**2)], {"max_depth": 2}, spp=64)


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
@pytest.mark.parametrize("radius, gap", [(1e-2, 0.03), (5e-3, 0.02), (1e-3, 0.02), (1e-6, 0.07)])
def test_hidden_lamps(kind, radius, gap):
    """Lamps on spheres and cylinders of 1e-2 to 1e-6, 8 above a floor, a black plate 0.02 to 0.07 below.

    Expected: no light at all; without the plate that of a lamp ten times as large and as bright altogether,
    to 3 % (one render of 2^15 samples each).
    """
    plate = floor(0.0, 0.5) | {"to_world": T().translate([0, 0, 8 - gap]).scale(0.5)}
    for way in WAYS.values():
        means = []
        for r, more in ((radius, {"plate": plate}), (radius, {}), (10 * radius, {})):
            shape = {"p0": [-0.1, 0, 8], "p1": [0.1, 0, 8]} if kind == "cylinder" else {"center": [0, 0, 8]}
            shape |= {"type": kind, "radius": r, "emitter": area(r ** (-2 if kind == "sphere" else -1))}
            made = scene(sensor=view((0, 3, 4), (0, 0, 0), 2), floor=floor(), lamp=shape, **more)
            means.append(tiles(made, way | {"max_depth": 2}, range(1), 128, sound=True).mean())
        assert means[0] == 0
        assert abs(means[1] / means[2] - 1) < 0.03


def test_large_floors():
    """A ball and a lamp on floors of half-width or radius 1e3 and 3e3, turned: rectangles, cubes, spheres,
    cylinders; on a cube that an instance brings 1000 units back.

    Expected: what `path` sees on a rectangle of 30: Welch's test of tiles (1e-3), standard error below 0.5 %.
    """
    turn = T().rotate([0.6, 0, 0.8], 33)
    camera, shines = view((0, -4, 2), (0, 0, 0)), lamp(half=0.5, at=(0, 0))
    common = {
        "sensor": camera | {"to_world": turn @ camera["to_world"]},
        "ball": {"type": "sphere", "to_world": turn @ T().translate([0, 0, 1]).scale(0.5)},
        "lamp": shines | {"to_world": turn @ shines["to_world"]},
    }
    floors = [{"type": "rectangle", "to_world": turn @ T().scale(size)} for size in (30.0, 1e3)]
    floors += [
        {"type": "cube", "to_world": turn @ T().translate([0, 0, -size]).scale(size)} for size in (30.0, 1e3)
    ]
    size = 3e3  # 7e-4 lower two units away
    floors.append({"type": "sphere", "to_world": turn @ T().translate([0, 0, -size]).scale(size)})
    lying = (
        T().translate([0, 0, -size]).scale(size).rotate([1, 0, 0], 90).translate([0, 0, -1]).scale([1, 1, 2])
    )
    floors.append({"type": "cylinder", "to_world": turn @ lying})
    plain, *made = (scene(**common, floor=shape | {"bsdf": grey(0.5)}) for shape in floors)
    far = T().translate([1000, 1000, 999]).scale([30, 30, 1])
    group = {"type": "shapegroup", "cube": {"type": "cube", "bsdf": grey(0.5), "to_world": far}}
    back = {"type": "instance", "to_world": turn @ T().translate([-1000, -1000, -1000])}
    made.append(scene(**common, group=group, floor=back | {"group": {"type": "ref", "id": "group"}}))
    alike([(one, plain) for one in made], 4, most_error=0.005, theirs=PATH)


@pytest.mark.parametrize("scale", [(1.5, 0.4, 0.8), (4, 1, 1), (1, 1, 0.1), (1, 1, 0.01), (0.1, 0.1, 0.1)])
def test_scaled_spheres(scale):
    """White spheres in instances that stretch, squash or shrink them, under a sky of radiance 1.

    Expected: radiance 1; by default to 2e-3 or twice the error of `path`, with all strategies to 10 % (where
    spheres are squashed or shrunk, Mitsuba's hits are off by more than the offset of rays).
    """
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.8, "bsdf": grey(1.0)}}
    ball = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": T().scale(list(scale))}
    sky = {"type": "constant", "radiance": 1.0}
    made = scene(sensor=view((0, -4, 2.5), (0, 0, 0)), sky=sky, group=group, ball=ball)
    default, everything, path = (
        abs(tiles(made, way | {"max_depth": 2}, range(2), 64).mean() - 1) for way in (*WAYS.values(), PATH)
    )
    print(f"off by {default:.2g}, with all strategies {everything:.2g}, `path` {path:.2g}")
    assert default < max(2e-3, 2 * path)
    assert everything < 0.1


def test_lit_through():
    """A lamp on a ball of rough glass of 1e-2 to 1e-3, 8 above a floor.

    Expected: the light of a ball of 0.1 as bright altogether, to 5 % (8 +- 0.1 is worth 2.5 %; standard error
    below 2 %), less than 1 % of it in paths of three edges, which cannot enter and leave the ball.
    """

    def light(radius, depth):
        to_world = T().look_at([0, 0, 8 + 1.5 * radius], [0, 0, 8], [0, 1, 0]).scale(0.5 * radius)
        emits = {"type": "disk", "to_world": to_world, "bsdf": grey(0.0), "emitter": area(1 / radius**2)}
        glass = {"type": "roughdielectric", "alpha": 0.5}
        ball = {"type": "sphere", "center": [0, 0, 8], "radius": radius, "bsdf": glass}
        made = scene(sensor=view((3, -4, 4), (0, 0, 0), 8), floor=floor(0.5, 3), ball=ball, lamp=emits)
        return tiles(made, {"max_depth": depth, "skip": "none"}, range(4), 1024)[:, -1]

    expected = light(0.1, 8)
    for radius in (1e-2, 3e-3, 1e-3):
        found = light(radius, 8)
        error = np.hypot(found.std(ddof=1), expected.std(ddof=1)) / 2 / expected.mean()
        print(f"{radius:g}: {found.mean() / expected.mean():.3f} of it (± {error:.3f})")
        assert abs(found.mean() / expected.mean() - 1) < 0.05
        assert error < 0.02
        assert light(radius, 3).mean() < 1e-2 * expected.mean()


# -- the camera in odd places ---------------------------------------------------------------------


def test_camera_in_glass():
    """The camera in a glass ball, off its centre, under a sky and in a lit room.

    Expected: n^2 = 2.25 times the sky's radiance (Student's test, 1e-3), since nothing is lost; in the room
    what `path` sees: Welch's test of tiles (1e-3).
    """
    glass = {"type": "sphere", "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}
    sky = {"type": "constant", "radiance": 1.0}
    open_air = scene(sensor=view((0.3, 0.1, 0.2), (1, 1, 0.5), 70), glass=glass, sky=sky)
    known([(open_air, 2.25)], {"max_depth": 40}, spp=64)
    below = floor(half=3.0) | {"to_world": T().translate([0, 0, -1.5]).scale(3), "bsdf": {"type": "diffuse"}}
    room = scene(sensor=view((0.3, 0.1, 0.2), (0.4, 0.5, -1), 60), lamp=lamp(), floor=below, glass=glass)
    alike([(room, room)], 5, spp=1024, most_error=0.1, theirs=PATH)


CAMERAS = {
    "in the plane of the floor": ((-1.5, -1, 0), (0, 0, 0.2)),
    "on top of the ball": ((0, 0, 0.8), (0.4, 0.3, 3), 80, (0, 1, 0)),
    "at the corner of the floor": ((2, 2, 0), (0, 0, 0.3)),
    "in the square of the lamp": ((0.4, 0.3, 3), (0, 0, 0), 60),
    "at the point light": ((1.0, -1.2, 1.5), (0, 0, 0.3)),
    "within a lamp on a sphere, whose inside is black": ((-1, 0.5, 1.2), (0, 0, 0.3)),
}


@pytest.mark.parametrize("where", CAMERAS)
def test_camera(where):
    """The pinhole in the plane of a floor, on a ball, at a corner, in a lamp's surface, at a point light, in
    a lamp on a sphere.

    Expected: what `path` sees: Welch's test of tiles (1e-3).
    """
    parts = {"floor": floor(), "ball": BALL | {"bsdf": grey(0.6)}, "lamp": lamp()}
    if "lamp" in where or "light" in where:
        parts["point"] = {"type": "point", "position": [1.0, -1.2, 1.5], "intensity": 5.0}
        parts["bulb"] = {"type": "sphere", "center": [-1, 0.5, 1.2], "radius": 0.1, "emitter": area(30.0)}
    made = scene(sensor=view(*CAMERAS[where]), **parts)
    alike([(made, made)], 4, spp=512, most_error=0.05, theirs=PATH)
