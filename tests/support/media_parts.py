"""Small scenes with participating media, by parts; each function makes entries of a scene's dictionary.

Objects of one variant are of no use in another: everything is made on demand.
"""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np
from plugins import register_plugins

import scenes
from scenes import area, camera, integrator, matte, rgb, transform

__all__ = ["integrator", "register_plugins", "transform"]

SIZE = 16


sensor, thinlens = (partial(make, near=0.1) for make in (camera, scenes.thinlens))


def fog(sigma_t=0.5, albedo=0.8, g=0.3, **more):
    """A gray homogeneous medium."""
    phase = {"type": "hg", "g": g}
    return {"type": "homogeneous", "sigma_t": float(sigma_t), "albedo": albedo, "phase": phase, **more}


def coloured(scale=2.0, **more):
    """A chromatic homogeneous medium."""
    colours = {"sigma_t": rgb(0.9, 0.4, 0.1), "scale": scale, "albedo": rgb(0.5, 0.8, 0.95)}
    return fog() | colours | more


def grid(values, low, size, scale=3.0, albedo=0.8, **more):
    """A medium of type heterogeneous whose extinction are ``values`` (z, y, x) in a box at ``low``."""
    values = np.asarray(values, dtype=np.float32)
    volume = {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(values[..., None]),
        "to_world": transform().translate(list(low)).scale(list(np.broadcast_to(size, 3))),
        "filter_type": "trilinear",
    }
    return {"type": "heterogeneous", "albedo": albedo, "scale": scale, "sigma_t": volume, **more}


# A box for grids, apart from walls and lamps.
LOW, EDGE = np.array([-0.65, -0.5, -0.5]), 0.6


def box(low=LOW, edge=EDGE, **more):
    """A null cube."""
    centre = [float(x) for x in np.asarray(low) + np.asarray(edge) / 2]
    half = [float(x) for x in np.broadcast_to(edge, 3) / 2]
    to_world = transform().translate(centre).scale(half)
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, **more}


def wall(**more):
    """A unit sphere, seen from within."""
    return {"type": "sphere", "flip_normals": True, "bsdf": matte(0.7, 0.5, 0.3), **more}


def lamp(**more):
    """A glowing ball that reflects nothing."""
    glow = area(rgb(5, 4, 3))
    return scenes.ball(matte(0, 0, 0), 0.2, (0.25, 0.3, -0.2), emitter=glow) | more


def point(**more):
    return {"type": "point", "position": [0.2, 0.3, -0.1], "intensity": 1.0, **more}


def ball(bsdf="null", radius=0.3, center=(-0.35, -0.25, -0.25), **more):
    bsdf = {"type": bsdf} if isinstance(bsdf, str) else bsdf
    return scenes.ball(bsdf, radius, center, **more)


def room(camera=None, light=None, **more):
    """Wall and lamp seen from within, and what else there is."""
    return {"type": "scene", "sensor": camera or sensor(), "wall": wall(), "lamp": light or lamp(), **more}


def foggy(medium=None, camera=sensor, **more):
    """A room that a medium fills, the sensor in it."""
    return room(camera(medium=fog() if medium is None else medium), **more)


def outdoors(**more):
    """Two balls and a cloud in the open."""
    return {
        "type": "scene",
        "sensor": sensor(origin=(0, 0.3, 4), target=(0, 0, 0), fov=35),
        "a": ball(matte(0.7, 0.5, 0.3), 0.5, (-0.75, 0, 0)),
        "c": ball(matte(0.7, 0.5, 0.3), 0.8, (0, -1.6, -0.2)),
        "cloud": ball("null", 0.5, (0.65, 0.2, -0.3), interior=fog(3, 0.9)),
        **more,
    }


def sky():
    return {"type": "constant", "radiance": rgb(0.5, 0.8, 1.1)}


def sun():
    return {"type": "directional", "direction": [0.3, -1, -0.5], "irradiance": 3.0}


def open_air(light, **more):
    """A matte ball in the open, under a sky or a sun."""
    return {
        "type": "scene",
        "sensor": sensor(origin=(0, 0.3, 2.5), target=(0, 0, 0), fov=30, size=8),
        "matte": ball(matte(0.7, 0.5, 0.3), 0.4, (0, 0, 0)),
        "light": {"sky": sky, "sun": sun}[light](),
    } | more
