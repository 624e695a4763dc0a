"""A room of many materials, as people model them: for what a kernel's size depends on."""

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
