"""Rays: none finds its own start, none leaks, whatever the scale and the place of the scene.

Known failure 13: offsets of 8.9e-5 (1 + max|p|) swallow small scenes and leave gaps in large ones.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from statistics import assert_agree, compare_images, tile_means

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt import rays

ROOT = Path(__file__).resolve().parents[1]

# (scale of the unit-sized shape, distance by which it is moved in each coordinate)
PLACES = {"small": (1e-3, 0.0), "unit": (1.0, 0.0), "large": (1e3, 0.0), "moved": (1.0, 1e3)}

CLOSED = {"sphere", "cube", "mesh", "instance"}
CONVEX = CLOSED | {"disk", "rectangle", "bsplinecurve", "linearcurve"}  # sdfgrid: not exactly
FLAT = {"disk", "rectangle"}  # both sides are outside


def _curve(folder, kind, scale, shift):
    """A straight curve of constant radius, so that it is convex."""
    points = np.linspace([-1, -0.5, -0.2], [1, 0.5, 0.3], 6) * scale + shift
    path = folder / f"{kind}-{scale}-{shift}.txt"
    lines = [" ".join(f"{x:.9g}" for x in (*p, 0.05 * scale)) for p in points]
    path.write_text("\n".join(lines) + "\n")
    return {"type": kind, "filename": str(path)}


def _mesh(folder, transform):
    """A coarse sphere with interpolated normals, far from the facets' own."""
    u, v = np.meshgrid(np.arange(12), np.arange(7))
    phi, theta = u.ravel() * 2 * np.pi / 12, v.ravel() * np.pi / 6
    p = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)
    faces = []
    for j in range(6):
        for i in range(12):
            a, b = j * 12 + i, j * 12 + (i + 1) % 12
            faces += [[a, a + 12, b], [b, a + 12, b + 12]]
    faces = [f for f in faces if len({tuple(np.round(p[k], 6)) for k in f}) == 3]
    mesh = mi.Mesh("ball", len(p), len(faces), has_vertex_normals=True)
    values = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float(p.ravel().astype(np.float32))
    values["vertex_normals"] = mi.Float(p.ravel().astype(np.float32))
    values["faces"] = mi.UInt32(np.array(faces, dtype=np.uint32).ravel())
    values.update()
    path = folder / "ball.ply"
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "to_world": transform}


def _sdf(transform):
    x = np.linspace(0, 1, 20)
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    distance = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.4
    centred = transform @ mi.ScalarTransform4f().scale(2) @ mi.ScalarTransform4f().translate(-0.5)
    return {"type": "sdfgrid", "grid": mi.TensorXf(distance[..., None].astype(np.float32)),
            "to_world": centred}


def shape_scene(kind, place, folder):
    """A scene of one shape, about 2 units wide before scaling, turned to no axis."""
    scale, shift = PLACES[place]
    t = mi.ScalarTransform4f
    turn = t().rotate([1, 2, 3], 35)
    transform = t().translate([shift] * 3) @ t().scale(scale) @ turn
    if kind in ("bsplinecurve", "linearcurve"):
        shape = {"shape": _curve(folder, kind, scale, shift)}
    elif kind == "mesh":
        shape = {"shape": _mesh(folder, transform)}
    elif kind == "sdfgrid":
        shape = {"shape": _sdf(t().translate([shift] * 3) @ t().scale(scale))}  # takes no rotation
    elif kind == "instance":
        shape = {
            "group": {"type": "shapegroup", "ball": _mesh(folder, turn)},
            "shape": {"type": "instance", "group": {"type": "ref", "id": "group"},
                      "to_world": t().translate([shift] * 3) @ t().scale(scale)},
        }
    elif kind == "cylinder":
        ends = np.array([[-0.3, 0.2, -1], [0.3, -0.1, 1]]) * scale + shift
        shape = {"shape": {"type": kind, "p0": ends[0].tolist(), "p1": ends[1].tolist(),
                           "radius": 0.6 * scale}}
    else:
        shape = {"shape": {"type": kind, "to_world": transform}}
    return mi.load_dict({"type": "scene", **shape})


def _sphere(rng):
    return mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))


def first_hits(scene, place, n, rng, inside):
    """Hits of ``n`` rays from outside (or from near the centre): ``(si, ray)``."""
    scale, shift = PLACES[place]
    spread = _sphere(rng) * dr.cbrt(rng.next_float32())
    if inside:
        origin, d = mi.Point3f(shift) + spread * (0.2 * scale), _sphere(rng)
    else:
        origin = mi.Point3f(shift) + _sphere(rng) * (3 * scale)
        d = dr.normalize(mi.Point3f(shift) + spread * scale - origin)
    ray = mi.Ray3f(origin, d)
    return scene.ray_intersect(ray), ray


def bad_rays(kind, place, folder, n, seed=0):
    """Shares of hits from which a ray finds its own start, and from which one leaks."""
    scene = shape_scene(kind, place, folder)
    own = leaks = total = 0
    for inside in (False, True) if kind in CLOSED or kind == "cylinder" else (False,):
        rng = mi.PCG32(n, seed + 10 * inside)
        si, ray = first_hits(scene, place, n, rng, inside)
        hit = si.is_valid()
        anchor = rays.surface_anchor(si, ray)
        d = _sphere(rng)
        cos = dr.dot(d, si.n)
        hit &= dr.abs(cos) > 1e-6  # along the surface: no side, and no light either
        again = scene.ray_intersect(rays.spawn(anchor, d, ray), hit)
        # Its own start: a hit nearby with the same normal; from a convex surface outwards, any hit.
        found = again.is_valid() & (again.t < 10 * anchor.offset)
        found &= dr.abs(dr.dot(again.n, si.n)) > 0.999
        if kind in CONVEX:
            found |= again.is_valid() & (mi.Bool(kind in FLAT) | (cos > 0))
        own += int(dr.count(hit & found)[0])
        if kind in CLOSED:
            leaks += int(dr.count(hit & (cos < 0) & ~again.is_valid())[0])
        total += int(dr.count(hit)[0])
    return own, leaks, total


KINDS = ["sphere", "cylinder", "disk", "rectangle", "cube", "mesh", "instance", "bsplinecurve",
         "linearcurve", "sdfgrid"]
