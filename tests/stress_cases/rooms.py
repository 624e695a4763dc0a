"""Scenes that several stress cases share, in parts."""

import mitsuba as mi
import numpy as np
import scene_parts as parts
from scene_parts import T

from scenes import DOWNWARDS, area, square

# Of the film, along each side.
SIZE = 16


def plate(bsdf=None):
    """That of `room` in its place."""
    return square((0, -0.3, -0.2), ([1, 0, 0], -50), 0.45, bsdf or diffuse(0.5))


def down():
    """From above onto the plate."""
    return T().look_at([0, 0.5, 0.3], [0, -0.3, -0.2], [0, 0, 1])


def diffuse(reflectance: float):
    """A number may be above 1, which a colour may not."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def view(origin, target, fov=45.0, up=(0, 0, 1)):
    to_world = T().look_at(list(origin), list(target), list(up))
    camera = {"type": "perspective", "fov": float(fov), "near_clip": 1e-3, "to_world": to_world}
    return camera | {"film": parts.film(SIZE)}


def camera():
    """From within a unit sphere."""
    return view((0, 0.1, 0.8), (0, -0.1, -1), 70, (0, 1, 0))


def loaded(sensor, **found):
    """The scene of parts that are not None."""
    found = {name: part for name, part in found.items() if part is not None}
    return mi.load_dict({"type": "scene", "sensor": sensor} | found)


def room(bsdf=None, **found):
    """A closed sphere with a plate of the ``bsdf`` that fills a part of the view, and a lamp.

    Or other parts in their place.
    """
    lamp = square((0.3, 0.8, 0), DOWNWARDS, 0.2, emitter=area(4.0))
    inside = {"wall": {"type": "sphere", "bsdf": diffuse(0.5)}, "plate": plate(bsdf), "lamp": lamp}
    return loaded(camera(), **inside | found)


def filled(bsdf, **found):
    """A plate that fills the film, lit by a point above all of it, which each of its points sees.

    Each of 4 x 4 texels covers 4 x 4 pixels.
    """
    facing = view((0, 0, 4), (0, 0, 0), np.rad2deg(2 * np.arctan(0.25)), (0, 1, 0))
    lamp = {"type": "point", "position": [0, 0, 3.0], "intensity": 5.0}
    return loaded(facing, **{"plate": {"type": "rectangle", "bsdf": bsdf}, "lamp": lamp} | found)
