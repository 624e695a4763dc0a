"""Rooms of many materials, as people model them: for what a kernel's size depends on, and for decisions.

room = lit_room("window", 21)
print(measure.compare_integrators(room, "bdpt", {"type": "path", "sampler": "multijitter"}))
"""

from __future__ import annotations

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
import numpy as np

import mitsuba as mi  # isort: skip


def _picture(seed: int, channels: int = 3) -> dict:
    """A texture of random texels."""
    texels = np.random.default_rng(seed).uniform(0.1, 0.8, (16, 16, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels)}


def _bumps(seed: int) -> dict:
    """A texture of heights."""
    return _picture(seed, 1) | {"raw": True}


def _normals(seed: int) -> dict:
    """A texture of normals that lean by chance."""
    lean = np.random.default_rng(seed).uniform(-0.1, 0.1, (16, 16, 3))
    normals = (0.5 + 0.5 * (lean + [0, 0, 1])).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(normals), "raw": True}


def _colour(i: int) -> dict:
    """A reflectance of the material of the number ``i`` alone."""
    return {"type": "rgb", "value": [0.2 + 0.02 * i, 0.7 - 0.01 * i, 0.3 + 0.01 * i]}


def _two_sided(bsdf: dict) -> dict:
    return {"type": "twosided", "bsdf": bsdf}


# Kinds of materials, by how often they are met in public scenes; each takes a number, which it varies by.
KINDS = (
    lambda i: _two_sided({"type": "diffuse", "reflectance": _colour(i)}),
    lambda i: _two_sided({"type": "diffuse", "reflectance": _picture(i)}),
    lambda i: _two_sided(
        {"type": "roughplastic", "diffuse_reflectance": _colour(i), "alpha": 0.05 + 0.01 * i}
    ),
    lambda i: _two_sided(
        {"type": "roughconductor", "material": ("Cu", "Al", "Au")[i % 3], "alpha": 0.1 + 0.01 * i}
    ),
    lambda i: _two_sided({"type": "principled", "base_color": _colour(i), "roughness": 0.2 + 0.02 * i}),
    lambda i: {"type": "dielectric", "int_ior": 1.3 + 0.02 * i},
    lambda i: _two_sided(
        {
            "type": "principled",
            "base_color": _picture(i),
            "roughness": 0.4,
            "metallic": 0.02 * i,
            "clearcoat": 0.3,
        }
    ),
    lambda i: _two_sided({"type": "roughplastic", "diffuse_reflectance": _picture(i), "alpha": 0.1}),
    lambda i: _two_sided({"type": "bumpmap", "arbitrary": _bumps(i), "bsdf": {"type": "roughplastic"}}),
    lambda i: _two_sided(
        {
            "type": "normalmap",
            "normalmap": _normals(i),
            "bsdf": {"type": "diffuse", "reflectance": _colour(i)},
        }
    ),
    lambda i: {
        "type": "mask",
        "opacity": _picture(i, 1) | {"raw": True},
        "bsdf": _two_sided({"type": "diffuse", "reflectance": _picture(i + 1)}),
    },
    lambda i: {"type": "thindielectric", "int_ior": 1.4 + 0.01 * i},
    lambda i: _two_sided({"type": "conductor", "material": "Ag", "specular_reflectance": _colour(i)}),
    lambda i: _two_sided({"type": "plastic", "diffuse_reflectance": _colour(i)}),
)


MOST = 40  # beyond that colours and roughness would be above 1


def room(materials: int, size: int = 128) -> dict:
    """A scene of so many materials for ``mi.load_dict``, ``size``^2 pixels.

    Walls, floor and a lamp of the first kind, and a grid of balls and blocks on the floor, one for each of
    the other materials. The mix is that of `KINDS`, over and over; no two are equal. `MOST` at most.
    """
    if not 1 <= materials <= MOST:
        raise ValueError(f"materials={materials} is out of range; a room has 1 to {MOST} of them")
    t = mi.ScalarTransform4f()
    made = [KINDS[i % len(KINDS)](i) for i in range(materials)]
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 50,
            "to_world": t.look_at([0, 3.5, 9], [0, 1.2, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": t.translate([0, 5.9, 0]).rotate([1, 0, 0], 90).scale(1),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [12, 11, 9]}},
        },
    }
    walls = {
        "floor": t.rotate([1, 0, 0], -90).scale(6),
        "ceiling": t.translate([0, 6, 0]).rotate([1, 0, 0], 90).scale(6),
        "back": t.translate([0, 3, -6]).scale(6),
        "left": t.translate([-6, 3, 0]).rotate([0, 1, 0], 90).scale(6),
        "right": t.translate([6, 3, 0]).rotate([0, 1, 0], -90).scale(6),
    }
    for i, (name, place) in enumerate(walls.items()):
        scene[name] = {"type": "rectangle", "to_world": place, "bsdf": made[i % materials]}
    for i, bsdf in enumerate(made[len(walls) :]):
        x, z = 1.5 * (i % 6) - 3.75, 1.5 * (i // 6) - 3
        if i % 2:
            shape = {"type": "sphere", "center": [x, 0.5, z], "radius": 0.5}
        else:
            shape = {"type": "cube", "to_world": t.translate([x, 0.4, z]).scale(0.4)}
        scene[f"thing{i}"] = shape | {"bsdf": bsdf}
    return scene


def _shell(scene: dict, opening: tuple[float, float, float, float] | None = None):
    """Add a room of 8 x 3 x 8 units to ``scene``, with an ``opening`` (z, z, y, y) in its right wall."""
    t = mi.ScalarTransform4f()
    places = {
        "floor": t.rotate([1, 0, 0], -90).scale(4),
        "ceiling": t.translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(4),
        "back": t.translate([0, 1.5, -4]).scale([4, 1.5, 1]),
        "front": t.translate([0, 1.5, 4]).rotate([0, 1, 0], 180).scale([4, 1.5, 1]),
        "left": t.translate([-4, 1.5, 0]).rotate([0, 1, 0], 90).scale([4, 1.5, 1]),
    }
    for i, (name, place) in enumerate(places.items()):
        scene[name] = {"type": "rectangle", "to_world": place, "bsdf": KINDS[0](10 + i)}
    z0, z1, y0, y1 = opening or (-4, -4, 0, 3)
    for i, (a, b, low, high) in enumerate(((-4, z0, 0, 3), (z1, 4, 0, 3), (z0, z1, 0, y0), (z0, z1, y1, 3))):
        if a < b and low < high:
            place = t.translate([4.1, (low + high) / 2, (a + b) / 2]).scale(
                [0.1, (high - low) / 2, (b - a) / 2]
            )
            scene[f"right{i}"] = {"type": "cube", "to_world": place, "bsdf": scene["left"]["bsdf"]}


def _lamp(radiance: float, **shape) -> dict:
    """A shape that emits."""
    radiance = {"type": "rgb", "value": [radiance, 0.9 * radiance, 0.75 * radiance]}
    return {"bsdf": KINDS[0](5), "emitter": {"type": "area", "radiance": radiance}} | shape


def _facing_down(x: float, y: float, z: float, size: float):
    return mi.ScalarTransform4f().translate([x, y, z]).rotate([1, 0, 0], 90).scale(size)


def _door(scene: dict):
    """A door ajar to the next room, which has the lamp."""
    _shell(scene, (-3.2, -2.0, 0.0, 2.2))
    t = mi.ScalarTransform4f()
    leaf = (
        t.translate([4, 1.1, -2.02]).rotate([0, 1, 0], -25).translate([0, 0, -0.57]).scale([0.03, 1.08, 0.56])
    )
    scene["door"] = {"type": "cube", "to_world": leaf, "bsdf": KINDS[0](6)}
    places = (
        t.translate([6.2, 0, -2.5]).rotate([1, 0, 0], -90).scale([2, 2, 1]),
        t.translate([6.2, 3, -2.5]).rotate([1, 0, 0], 90).scale([2, 2, 1]),
        t.translate([6.2, 1.5, -4.5]).scale([2, 1.5, 1]),
        t.translate([6.2, 1.5, -0.5]).rotate([0, 1, 0], 180).scale([2, 1.5, 1]),
        t.translate([8.2, 1.5, -2.5]).rotate([0, 1, 0], -90).scale([2, 1.5, 1]),
    )
    for i, place in enumerate(places):
        scene[f"next{i}"] = {"type": "rectangle", "to_world": place, "bsdf": scene["back"]["bsdf"]}
    scene["lamp"] = _lamp(120, type="rectangle", to_world=_facing_down(6.5, 2.9, -2.5, 0.5))


def _window(scene: dict):
    """A window, a sky and a ground."""
    _shell(scene, (-1.5, 1.0, 0.9, 2.3))
    ground = mi.ScalarTransform4f().translate([0, -0.05, 0]).rotate([1, 0, 0], -90).scale(30)
    scene["ground"] = {"type": "rectangle", "to_world": ground, "bsdf": KINDS[0](7)}
    scene["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": [2, 2.5, 3.5]}}


def _sun(scene: dict):
    """The sun and a sky through a window."""
    _window(scene)
    sun = {"type": "rgb", "value": [40, 36, 28]}
    scene["sun"] = {"type": "directional", "direction": [-0.7, -0.6, -0.25], "irradiance": sun}


def _lamps(scene: dict):
    """24 small lamps under the ceiling."""
    _shell(scene)
    for i in range(24):
        centre = [-3.3 + 1.3 * (i % 6), 2.85, -3.3 + 1.7 * (i // 6)]
        scene[f"lamp{i}"] = _lamp(60 + 20 * (i % 3), type="sphere", center=centre, radius=0.04)


def _bulbs(scene: dict):
    """Bulbs in hollow glass balls."""
    _shell(scene)
    glass = {"type": "dielectric", "int_ior": 1.5}
    for i, centre in enumerate(([-2, 2.2, -2], [1, 2.2, -2.5], [2.6, 2.2, 0.3])):
        scene[f"outside{i}"] = {"type": "sphere", "center": centre, "radius": 0.22, "bsdf": glass}
        inside = {"type": "sphere", "center": centre, "radius": 0.2, "flip_normals": True, "bsdf": glass}
        scene[f"inside{i}"] = inside
        scene[f"bulb{i}"] = _lamp(150, type="sphere", center=centre, radius=0.05)


def _ceiling(scene: dict):
    """One large lamp under the ceiling."""
    _shell(scene)
    scene["lamp"] = _lamp(12, type="rectangle", to_world=_facing_down(0, 2.95, -0.5, 0.8))


# How a `lit_room` is lit.
LIGHTS = {f.__name__[1:]: f for f in (_door, _window, _sun, _lamps, _bulbs, _ceiling)}


def lit_room(light: str, materials: int, width: int = 256, height: int = 144) -> dict:
    """A scene for ``mi.load_dict``: a room with a thing of each of so many ``materials``, lit as `LIGHTS`."""
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0.4, 1.7, 3.7], [0, 1.1, -1], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 70, "to_world": view, "film": film}
    scene = {"type": "scene", "sensor": sensor}
    LIGHTS[light](scene)
    for i in range(materials):
        x, z, r = -3 + 1.2 * (i % 6), -3 + 1.1 * (i // 6), 0.22
        if z > 2.2:  # further things are small, along the back wall
            x, z, r = -3.3 + 0.3 * (i % 20), -3.7, 0.1
        if i % 2:
            shape = {"type": "sphere", "center": [x, r, z], "radius": r}
        else:
            shape = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([x, r, z]).scale(r)}
        scene[f"thing{i}"] = shape | {"bsdf": KINDS[i % len(KINDS)](i % MOST)}
    return scene
