"""Parts of small scenes, renders of them, and layers of their strategies."""

from __future__ import annotations

import internals
import mitsuba as mi
import numpy as np


def transform():
    return mi.ScalarTransform4f()


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def matte(*value):
    """A diffuse BSDF of one value (by default 0.5) or three."""
    value = value or (0.5,)
    return {"type": "diffuse", "reflectance": rgb(*value) if len(value) > 1 else float(value[0])}


def both_sides(value):
    """A diffuse BSDF that looks alike from both sides."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(value, value, value)}}


def square(at=(0, 0, 0), turn=None, size=1.0, bsdf=None, **more):
    """A rectangle of half-width ``size``, turned by an axis and an angle; by default it looks to +z."""
    to_world = transform().translate(list(at))
    to_world = (to_world.rotate(*turn) if turn else to_world).scale(size)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf or matte(), **more}


def ball(bsdf, radius=1.0, center=(0, 0, 0), **more):
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf, **more}


UPWARDS, DOWNWARDS = ([1, 0, 0], -90), ([1, 0, 0], 90)  # turns of a `square` whose normal is +y or -y


def floor(height=0.0, size=2.0, bsdf=None, **more):
    return square((0, height, 0), UPWARDS, size, bsdf, **more)


def area(radiance):
    return {"type": "area", "radiance": radiance}


def film(size=16, rfilter="box", **keys):
    return {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": rfilter},
    } | keys


_film = film  # beside the parameter of `camera`


def camera(
    kind="perspective",
    origin=(0.1, -0.05, 0.5),
    target=(0, 0, -1),
    fov=60,
    size=16,
    near=0.05,
    pixel_format="rgb",
    up=(0, 1, 0),
    rfilter="box",
    film=None,
    **more,
):
    """A camera of this ``kind``; ``more`` of its parameters, ``film`` of its film's."""
    return {
        "type": kind,
        "fov": fov,
        "near_clip": near,
        "far_clip": 50,
        "to_world": transform().look_at(list(origin), list(target), list(up)),
        "sampler": {"type": "independent"},
        "film": _film(size, rfilter, pixel_format=pixel_format) | (film or {}),
        **more,
    }


def thinlens(**more):
    """The camera with a small lens."""
    return camera("thinlens", **{"aperture_radius": 0.08, "focus_distance": 1.2} | more)


def meter(**more):
    """An irradiance meter, for the shape that holds it."""
    return {"type": "irradiancemeter", "film": film(1), **more}


def load(**parts):
    return mi.load_dict({"type": "scene", **parts})


def integrator(kind="bdpt", **parameters):
    """By default without roulette."""
    parameters = {"rr_depth": 100} | parameters
    return internals.bdpt(**parameters) if kind == "bdpt" else mi.load_dict({"type": kind, **parameters})


def renders(scene, method, spp, seeds, first=0):
    """Images of ``seeds`` renders, (seeds, height, width, channels)."""
    return np.stack(
        [np.array(method.render(scene, seed=first + i, spp=spp), dtype=np.float64) for i in range(seeds)]
    )


def layer(images, method, name):
    """The three channels of a layer, for example ``unweighted.s1t2``, of images as of `renders`."""
    names = method.aov_names()
    first = images.shape[-1] - len(names) + names.index(f"{name}.R")
    return images[..., first : first + 3]
