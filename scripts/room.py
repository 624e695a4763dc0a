"""Rooms of many materials, as people model them: for what a kernel's size depends on, and for decisions.

room = lit_room("window", 21)
print(measure.compare_integrators(room, "bdpt", {"type": "path", "sampler": "multijitter"}))
"""

from __future__ import annotations

import numpy as np
import repository  # noqa: F401 (puts the folder of `scenes` on the path)

import mitsuba as mi  # isort: skip
from scenes import DOWNWARDS, UPWARDS, area, ball, camera, rgb, square, transform


def _picture(seed: int, channels: int = 3) -> dict:
    """A texture of random texels; of one channel heights or opacities."""
    texels = np.random.default_rng(seed).uniform(0.1, 0.8, (16, 16, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels)} | ({"raw": True} if channels == 1 else {})


def _normals(seed: int) -> dict:
    """A texture of normals that lean by chance."""
    lean = np.random.default_rng(seed).uniform(-0.1, 0.1, (16, 16, 3))
    normals = (0.5 + 0.5 * (lean + [0, 0, 1])).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(normals), "raw": True}


def _colour(i: int) -> dict:
    """A reflectance of the material of the number ``i`` alone."""
    return rgb(0.2 + 0.02 * i, 0.7 - 0.01 * i, 0.3 + 0.01 * i)


def _two_sided(kind: str, **parameters) -> dict:
    return {"type": "twosided", "bsdf": {"type": kind, **parameters}}


def _matte(i: int) -> dict:
    return _two_sided("diffuse", reflectance=_colour(i))


# Kinds of materials, by how often they are met in public scenes; each takes a number, which it varies by.
KINDS = (
    _matte,
    lambda i: _two_sided("diffuse", reflectance=_picture(i)),
    lambda i: _two_sided("roughplastic", diffuse_reflectance=_colour(i), alpha=0.05 + 0.01 * i),
    lambda i: _two_sided("roughconductor", material=("Cu", "Al", "Au")[i % 3], alpha=0.1 + 0.01 * i),
    lambda i: _two_sided("principled", base_color=_colour(i), roughness=0.2 + 0.02 * i),
    lambda i: {"type": "dielectric", "int_ior": 1.3 + 0.02 * i},
    lambda i: _two_sided(
        "principled", base_color=_picture(i), roughness=0.4, metallic=0.02 * i, clearcoat=0.3
    ),
    lambda i: _two_sided("roughplastic", diffuse_reflectance=_picture(i), alpha=0.1),
    lambda i: _two_sided("bumpmap", arbitrary=_picture(i, 1), bsdf={"type": "roughplastic"}),
    lambda i: _two_sided("normalmap", normalmap=_normals(i), bsdf=_matte(i)["bsdf"]),
    lambda i: {"type": "mask", "opacity": _picture(i, 1), "bsdf": KINDS[1](i + 1)},
    lambda i: {"type": "thindielectric", "int_ior": 1.4 + 0.01 * i},
    lambda i: _two_sided("conductor", material="Ag", specular_reflectance=_colour(i)),
    lambda i: _two_sided("plastic", diffuse_reflectance=_colour(i)),
)


MOST = 40  # beyond that colours and roughness would be above 1


def _box(centre, size, bsdf: dict) -> dict:
    """A block about ``centre``, of half the ``size`` to each side."""
    return {"type": "cube", "to_world": transform().translate(centre).scale(size), "bsdf": bsdf}


def _shell(scene: dict, opening: tuple[float, float, float, float] | None = None):
    """Add a room of 8 x 3 x 8 units to ``scene``, with an ``opening`` (z, z, y, y) in its right wall."""
    walls = {
        "floor": ((0, 0, 0), UPWARDS, 4),
        "ceiling": ((0, 3, 0), DOWNWARDS, 4),
        "back": ((0, 1.5, -4), None, [4, 1.5, 1]),
        "front": ((0, 1.5, 4), ([0, 1, 0], 180), [4, 1.5, 1]),
        "left": ((-4, 1.5, 0), ([0, 1, 0], 90), [4, 1.5, 1]),
    }
    scene |= {name: square(*wall, _matte(10 + i)) for i, (name, wall) in enumerate(walls.items())}
    z0, z1, y0, y1 = opening or (-4, -4, 0, 3)
    for i, (a, b, low, high) in enumerate(((-4, z0, 0, 3), (z1, 4, 0, 3), (z0, z1, 0, y0), (z0, z1, y1, 3))):
        if a < b and low < high:
            centre, size = [4.1, (low + high) / 2, (a + b) / 2], [0.1, (high - low) / 2, (b - a) / 2]
            scene[f"right{i}"] = _box(centre, size, scene["left"]["bsdf"])


def _lamp(radiance: float) -> dict:
    """What makes a shape emit."""
    return {"bsdf": _matte(5), "emitter": area(rgb(radiance, 0.9 * radiance, 0.75 * radiance))}


def _door(scene: dict):
    """A door ajar to the next room, which has the lamp."""
    _shell(scene, (-3.2, -2.0, 0.0, 2.2))
    hinge = transform().translate([4, 1.1, -2.02]).rotate([0, 1, 0], -25)
    leaf = hinge.translate([0, 0, -0.57]).scale([0.03, 1.08, 0.56])
    scene["door"] = {"type": "cube", "to_world": leaf, "bsdf": _matte(6)}
    walls = (
        ((6.2, 0, -2.5), UPWARDS, [2, 2, 1]),
        ((6.2, 3, -2.5), DOWNWARDS, [2, 2, 1]),
        ((6.2, 1.5, -4.5), None, [2, 1.5, 1]),
        ((6.2, 1.5, -0.5), ([0, 1, 0], 180), [2, 1.5, 1]),
        ((8.2, 1.5, -2.5), ([0, 1, 0], -90), [2, 1.5, 1]),
    )
    scene |= {f"next{i}": square(*wall, scene["back"]["bsdf"]) for i, wall in enumerate(walls)}
    scene["lamp"] = square((6.5, 2.9, -2.5), DOWNWARDS, 0.5, **_lamp(120))


def _window(scene: dict):
    """A window, a sky and a ground."""
    _shell(scene, (-1.5, 1.0, 0.9, 2.3))
    scene["ground"] = square((0, -0.05, 0), UPWARDS, 30, _matte(7))
    scene["sky"] = {"type": "constant", "radiance": rgb(2, 2.5, 3.5)}


def _sun(scene: dict):
    """The sun and a sky through a window."""
    _window(scene)
    scene["sun"] = {"type": "directional", "direction": [-0.7, -0.6, -0.25], "irradiance": rgb(40, 36, 28)}


def _lamps(scene: dict):
    """24 small lamps under the ceiling."""
    _shell(scene)
    for i in range(24):
        centre = -3.3 + 1.3 * (i % 6), 2.85, -3.3 + 1.7 * (i // 6)
        scene[f"lamp{i}"] = ball(radius=0.04, center=centre, **_lamp(60 + 20 * (i % 3)))


def _bulbs(scene: dict):
    """Bulbs in hollow glass balls."""
    _shell(scene)
    glass = {"type": "dielectric", "int_ior": 1.5}
    for i, centre in enumerate(((-2, 2.2, -2), (1, 2.2, -2.5), (2.6, 2.2, 0.3))):
        scene[f"outside{i}"] = ball(glass, 0.22, centre)
        scene[f"inside{i}"] = ball(glass, 0.2, centre, flip_normals=True)
        scene[f"bulb{i}"] = ball(radius=0.05, center=centre, **_lamp(150))


def _ceiling(scene: dict):
    """One large lamp under the ceiling."""
    _shell(scene)
    scene["lamp"] = square((0, 2.95, -0.5), DOWNWARDS, 0.8, **_lamp(12))


# How a `lit_room` is lit.
LIGHTS = {f.__name__[1:]: f for f in (_door, _window, _sun, _lamps, _bulbs, _ceiling)}


def lit_room(light: str, materials: int, width: int = 256, height: int = 144) -> dict:
    """A scene for ``mi.load_dict``: a room with a thing of each of so many ``materials``, lit as `LIGHTS`."""
    sensor = camera(
        origin=(0.4, 1.7, 3.7), target=(0, 1.1, -1), fov=70, film={"width": width, "height": height}
    )
    scene = {"type": "scene", "sensor": sensor}
    LIGHTS[light](scene)
    for i in range(materials):
        bsdf = KINDS[i % len(KINDS)](i % MOST)
        x, z, r = -3 + 1.2 * (i % 6), -3 + 1.1 * (i // 6), 0.22
        if z > 2.2:  # further things are small, along the back wall
            x, z, r = -3.3 + 0.3 * (i % 20), -3.7, 0.1
        scene[f"thing{i}"] = ball(bsdf, r, (x, r, z)) if i % 2 else _box([x, r, z], r, bsdf)
    return scene
