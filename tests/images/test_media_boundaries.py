"""What the boundaries of media say about where light is: rooms of fog as users make them.

Expected, unless said: whether there are light subpaths, and in which medium they start. Seeds are fixed.
"""

from __future__ import annotations

from dataclasses import replace

import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import variants
from mitsuba_bdpt.geometry import rays
from mitsuba_bdpt.media import tracking
from mitsuba_bdpt.media.equal import representatives
from mitsuba_bdpt.media.media import MediumProperties
from mitsuba_bdpt.media.transmittance import through_surfaces
from mitsuba_bdpt.scene.prepared import PreparedScene
from mitsuba_bdpt.transport.inputs import Shared
from test_media import ALL, CAMERA, assert_agree, means

from scenes import square

import drjit as dr  # isort: skip

# Walls of a box that is open to the front: how to turn a rectangle that faces +z at z = -1.
WALLS = {
    "floor": ([1, 0, 0], -90),
    "ceiling": ([1, 0, 0], 90),
    "left": ([0, 1, 0], 90),
    "right": ([0, 1, 0], -90),
    "back": ([0, 1, 0], 0),
}


def fog(sigma_t=1.0, **more):
    return parts.fog(sigma_t, **{"albedo": 0.9, "g": 0.0} | more)


def plaster():
    return {"type": "twosided", "bsdf": parts.matte(0.7, 0.6, 0.5)}


def below_the_ceiling(half, down=True):
    """Where a rectangle is, 2 cm below the ceiling."""
    turned = parts.transform().translate([0, 0.98, 0]).rotate([1, 0, 0], 90 if down else -90)
    return turned.scale(half)


def box(medium, walls=None, lamp=None, half=0.05, optimize=True, **changed):
    """A box of fog seen through its front, which is null; a ball of glass, and a lamp under the ceiling.

    ``medium()`` is that of the front, the glass and the ``lamp``, unless ``lamp`` and ``walls`` say what
    these state instead.
    """
    lamp = {"exterior": medium()} if lamp is None else lamp
    shapes = {
        name: {"type": "rectangle", "bsdf": plaster(), **(walls() if walls else {})}
        | {"to_world": parts.transform().rotate(*turn).translate([0, 0, -1])}
        for name, turn in WALLS.items()
    }
    shapes["front"] = square((0, 0, 1), bsdf={"type": "null"}, interior=medium())
    shapes["glass"] = parts.ball("dielectric", 0.4, (0.3, -0.6, 0), exterior=medium())
    emitter = {"type": "area", "radiance": 1 / half**2}
    shapes["lamp"] = {"type": "rectangle", "to_world": below_the_ceiling(half), "emitter": emitter, **lamp}
    eye = parts.sensor(origin=(0, 0, 4), target=(0, 0, 0), fov=35, size=8)
    scene = {"type": "scene", "sensor": eye, "fog": fog(id="fog"), **shapes, **changed}
    return mi.load_dict(scene, optimize=optimize)


def shared():
    return {"type": "ref", "id": "fog"}


def prepared(scene):
    """Its media, and where light starts in them."""
    found = PreparedScene(scene, scene.sensors()[0])
    return found.space.media, found.light_media


def starts(scene):
    """Numbers of the media in which random emissions start."""
    found, u = PreparedScene(scene, scene.sensors()[0]), np.random.default_rng(0).random((4, 1 << 12))
    shared = Shared(mi.Float(0), mi.Color0f(), mi.UnpolarizedSpectrum(1), mi.Float(0.5))
    e = found.emitters.sample_emission(mi.Point2f(u[:2]), mi.Point2f(u[2:]), shared, mi.Bool(True))
    return np.array(found.light_media.at(e))


@pytest.mark.parametrize("optimize", [True, False], ids=["merged", "apart"])
@pytest.mark.parametrize("tagged", [True, False], ids=["tagged", "plain"])
@pytest.mark.parametrize("medium", [shared, fog], ids=["shared", "each"])
def test_fog_between_opaque_walls(medium, tagged, optimize):
    """Lines that look for contradictions went through walls and to the back of the lamp; equal media were
    told apart; a mesh of rectangles that Mitsuba has merged has no valid box. Also where the lamp states no
    medium, and all its rays meet the ceiling first."""
    up = {"to_world": below_the_ceiling(0.05, down=False)}
    for lamp in (None, {}, up):
        scene = box(medium, (lambda: {"exterior": medium()}) if tagged else None, lamp, optimize=optimize)
        media, light = prepared(scene)
        assert (len(media.properties), light.contradiction, light.outside) == (1, "", 0)
        assert (starts(scene) != 1).mean() < 5e-3  # rays that stay between the lamp and the ceiling


def test_light_in_a_room_of_opaque_walls():
    """The box in which walls and both sides of the lamp state the medium has the same image, to rounding;
    with a lamp that states none all strategies see what camera subpaths see."""
    both = {"interior": shared(), "exterior": shared()}
    boxes = box(shared, lambda: {"exterior": shared()}, both), box(fog, optimize=False)
    one, other = (
        np.array(mi.render(scene, integrator=parts.integrator(), spp=16, seed=1)) for scene in boxes
    )
    np.testing.assert_allclose(one, other, rtol=1e-4)
    scene = box(fog, lamp={}, half=0.5)
    assert_agree(means(scene, 10, depth=4, **ALL), means(scene, 300, depth=4, **CAMERA))


@pytest.mark.parametrize("emits", [True, False], ids=["lamp", "wall"])
@pytest.mark.parametrize("light", ["spot", "lamp"])
def test_light_on_a_side_that_states_nothing(light, emits):
    """Light at the back of a one-sided surface, which sends out nothing and whose medium need not be stated,
    started in vacuum: 27 to 90 % of the light was lost."""
    at = parts.transform().translate([0, 0, -2])
    glows = {"emitter": {"type": "area", "radiance": 1.0}}
    lights = {
        "spot": {"type": "spot", "to_world": at, "cutoff_angle": 20.0},
        "lamp": {"type": "rectangle", "to_world": at.scale(0.2), **glows},
    }
    front = {"type": "rectangle", "to_world": parts.transform().scale(5), "exterior": shared()}
    scene = {"type": "scene", "fog": fog(id="fog"), "sensor": parts.sensor(medium=shared())}
    scene |= {"front": front | (glows if emits else {}), "light": lights[light]}
    assert (starts(mi.load_dict(scene)) == 1).all()


def windowed(half, **more):
    """A room of 10 m with opaque walls and a window in the ceiling, which bounds the fog in the room.

    ``half`` the window's width / 2.
    """
    at, wall = parts.transform(), {"type": "rectangle", "bsdf": plaster()}
    shapes = {
        name: {**wall, "to_world": at.rotate(*turn).scale(5).translate([0, 0, -1])}
        for name, turn in WALLS.items()
        if name != "ceiling"
    }
    shapes["front"] = {**wall, "to_world": at.translate([0, 0, 5]).scale(5)}
    up, strip, middle = at.translate([0, 5, 0]).rotate([1, 0, 0], -90), (5 - half) / 2, (5 + half) / 2
    for sign in (-1, 1):
        beside = up.translate([sign * middle, 0, 0]).scale([strip, 5, 1])
        behind = up.translate([0, sign * middle, 0]).scale([half, strip, 1])
        shapes |= {f"strip {sign} {i}": {**wall, "to_world": at} for i, at in enumerate((beside, behind))}
    null = {"bsdf": {"type": "null"}, "interior": shared()}
    window = {"type": "rectangle", "id": "window", "to_world": up.scale(half), **null}
    eye = parts.sensor(origin=(0, 0, 4), target=(0, 0, 0), medium=shared())
    scene = {"type": "scene", "fog": fog(0.08, id="fog"), "sensor": eye, **shapes, "window": window}
    return mi.load_dict(scene | {"sky": parts.sky()} | more)


def porch():
    """A roof above the window, so that no straight line from outside meets it before the room's walls."""
    to_world = parts.transform().translate([0, 8, 0]).rotate([1, 0, 0], 90).scale(20)
    return {"roof": {"type": "rectangle", "bsdf": plaster(), "to_world": to_world}}


@pytest.mark.parametrize("covered", [False, True], ids=["open", "porch"])
def test_sky_through_a_small_window(covered):
    """No ray around the sensor found the window, 10 cm wide, and the sky started in fog without end: a
    contradiction, or 17 % too dark under a porch."""
    _, light = prepared(windowed(0.05, **(porch() if covered else {})))
    assert (light.contradiction, light.outside, light.hides_infinity) == ("", 0, False)


def test_light_from_infinity_over_an_open_sea():
    """Camera subpaths under a sea without walls are in water for ever, light from infinity starts in air: 6 %
    too bright."""
    sea = {"type": "rectangle", "bsdf": {"type": "dielectric"}, "interior": fog(0.3), "id": "sea"}
    sea["to_world"] = parts.transform().rotate([1, 0, 0], -90).scale(50)
    scene = {"type": "scene", "sensor": parts.sensor(origin=(0, 2, 4), target=(0, 0, 0)), "sea": sea}
    _, light = prepared(mi.load_dict(scene | {"sky": parts.sky()}))
    assert "close the boundary between them" in light.contradiction
    _, light = prepared(mi.load_dict(scene | {"lamp": parts.point(position=[0, 3, 0])}))
    assert light.contradiction == ""


def grid(values=None, **more):
    values = np.arange(27.0).reshape(3, 3, 3) if values is None else values
    return parts.grid(values, [0, 0, 0], 1.0, **more)


def tabulated(more=0.0):
    """A phase function of which few random directions see the one value that is larger."""
    values = np.full(1 << 18, 0.5)
    values[1 << 17] += more
    return fog() | {"phase": {"type": "tabphase", "values": ",".join(map(str, values))}}


def blend(g):
    parts = {"a": {"type": "rayleigh"}, "b": {"type": "hg", "g": g}}
    return fog() | {"phase": {"type": "blendphase", "weight": 0.3, **parts}}


# Pairs of media, and whether they are equal.
PAIRS = {
    "numbers": (fog, fog, True),
    "a scale": (lambda: fog(0.8), lambda: fog(0.4, scale=2.0), True),
    "colours": (parts.coloured, parts.coloured, True),
    "grids": (grid, grid, False),
    "another extinction": (fog, lambda: fog(1.01), False),
    "another albedo": (fog, lambda: fog(albedo=0.91), False),
    "another phase function": (fog, lambda: fog(g=0.1), False),
    "another way of sampling": (fog, lambda: fog(sample_emitters=False), False),
    "tables": (tabulated, tabulated, True),
    "one other value": (tabulated, lambda: tabulated(0.01), False),
    "two kinds of medium": (lambda: fog(3.0), lambda: grid(np.ones((3, 3, 3))), False),
    "parts of a blend": (lambda: blend(0.5), lambda: blend(0.6), False),
}


@pytest.mark.parametrize("variant", [variants.of("rgb"), variants.of("spectral")])
def test_media_are_told_apart_by_what_they_are(variant):
    """Two objects of equal numbers were two media, whose boundaries contradict each other: 44 times the
    variance. Two grids that differ beyond what was sampled were one medium."""
    mi.set_variant(variant)
    for name, (one, other, equal) in PAIRS.items():
        media = [mi.load_dict(fog(0.1)), mi.load_dict(one()), mi.load_dict(other())]
        assert representatives([MediumProperties(m) for m in media]) == [0, 1, 1 if equal else 2], name


def test_transmittance_of_a_grid_is_not_negative():
    """Where the extinction between equal values exceeds its majorant by rounding."""
    medium = parts.grid(np.full((4, 4, 4), 0.7), [-0.5] * 3, 1.0, 5.0, 0.5)
    box = parts.box([-0.5] * 3, 1.0, interior=medium)
    media, _ = prepared(
        mi.load_dict({"type": "scene", "sensor": parts.sensor(), "box": box, "sky": {"type": "constant"}})
    )
    word = dr.arange(mi.UInt32, 1 << 14)
    ray = mi.Ray3f(mi.Point3f(-0.5, 0.1, 0.2), dr.normalize(mi.Vector3f(1, 0.1, 0.2)))
    found, *_ = tracking.ratio(media, mi.UInt32(1), ray, mi.Float(1), word, mi.Bool(True))
    assert np.array(found).min() == 0


def test_media_of_python_are_equal_to_themselves_only():
    parts.register_plugins()
    own_fog = {"type": "own_fog", "extinction": 4.0, "albedo": 0.9}
    for medium in (own_fog, fog() | {"phase": {"type": "own_phase", "a": 0.3}}):
        assert representatives([MediumProperties(mi.load_dict(medium)) for _ in range(2)]) == [0, 1]


# -- connections: the medium that a shadow ray arrives in at a lamp -------------------------------------


def milk():
    return parts.fog(6, 0.9)


def drop(radius, center):
    return parts.ball("null", radius, center, interior=milk())


CONNECTED = {
    "fog everywhere": parts.foggy,
    "a lamp in milk": lambda: parts.room(milk=drop(0.35, (0.25, 0.3, -0.2))),
    "a lamp partly in milk": lambda: parts.room(milk=drop(0.2, (0.25, 0.5, -0.2))),
    "a lamp of milk": lambda: parts.foggy(light=parts.lamp(interior=milk(), exterior=parts.fog())),
    "a point in milk": lambda: parts.room(light=parts.point(), milk=drop(0.3, (0.2, 0.3, -0.1))),
    "sun and sky": lambda: parts.outdoors(sky=parts.sky(), sun=parts.sun()),
    "a room of fog": lambda: box(fog),
}


@pytest.mark.parametrize("name", CONNECTED)
def test_shadow_rays_arrive_in_the_medium_that_light_starts_in(name):
    """A path is the same from both ends: shadow rays between points past null surfaces and lamps arrive in
    the medium that `LightMedia.at` states for the reversed ray; but for one in a thousand, by rounding at an
    edge."""
    made = CONNECTED[name]()
    scene = mi.load_dict(made) if isinstance(made, dict) else made
    found, count, rng = PreparedScene(scene, scene.sensors()[0]), 1 << 14, np.random.default_rng(1)
    assert found.light_media.contradiction == ""
    found.light_media.settle()
    u = rng.random((8, count))
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(u[:2]), mi.Point2f(u[2:4]))
    ray = mi.Ray3f(ray.o, ray.d, mi.Float(4 * u[4]), 0, ray.wavelengths)
    seen = through_surfaces(found.space, ray, found.space.media.sensor, mi.Bool(True))
    q = rays.free_anchor(ray(ray.maxt))
    shared = Shared(mi.Float(0), ray.wavelengths, mi.UnpolarizedSpectrum(1), mi.Float(0.5))
    e = found.emitters.sample_emission(mi.Point2f(u[5:7]), mi.Point2f(u[[7, 0]]), shared, mi.Bool(True))
    shadow = rays.segment(q, e.anchor, shared)
    d = dr.select(e.infinite, e.d, -shadow.d)
    emits = e.infinite | (dr.squared_norm(e.anchor.n) == 0)
    emits |= dr.dot(e.anchor.n, d) * dr.dot(e.anchor.n, e.d) > 0
    shadow = mi.Ray3f(q.p, -d, dr.select(e.infinite, dr.inf, shadow.maxt), 0, ray.wavelengths)
    arrives = through_surfaces(found.space, shadow, seen.medium, mi.Bool(True))
    connected = np.array(seen.clear & arrives.clear & emits)
    wrong = np.array(arrives.medium != found.light_media.at(replace(e, d=d)))
    assert connected.sum() > count / 50
    assert wrong[connected].mean() < 1e-3
