"""Small scenes with participating media, by parts; each function makes entries of a scene's dictionary.

Objects of one variant are of no use in another: everything is made on demand.
"""

from __future__ import annotations

import drjit as dr
import internals
import mitsuba as mi
import numpy as np

from scenes import camera, matte, rgb, transform
from scenes import thinlens as lens

SIZE = 16


def sensor(near=0.1, **more):
    return camera(near=near, **more)


def thinlens(near=0.1, **more):
    return lens(near=near, **more)


def fog(sigma_t=0.5, albedo=0.8, g=0.3, **more):
    """A gray homogeneous medium."""
    phase = {"type": "hg", "g": g}
    return {"type": "homogeneous", "sigma_t": float(sigma_t), "albedo": albedo, "phase": phase, **more}


def coloured(scale=2.0, **more):
    """A chromatic homogeneous medium."""
    return {
        "type": "homogeneous",
        "sigma_t": rgb(0.9, 0.4, 0.1),
        "scale": scale,
        "albedo": rgb(0.5, 0.8, 0.95),
        "phase": {"type": "hg", "g": 0.3},
        **more,
    }


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
    return {
        "type": "cube",
        "to_world": transform().translate(centre).scale(half),
        "bsdf": {"type": "null"},
        **more,
    }


def wall(**more):
    """A unit sphere, seen from within."""
    return {"type": "sphere", "flip_normals": True, "bsdf": matte(0.7, 0.5, 0.3), **more}


def lamp(**more):
    """A glowing ball that reflects nothing."""
    return {
        "type": "sphere",
        "center": [0.25, 0.3, -0.2],
        "radius": 0.2,
        "bsdf": matte(0, 0, 0),
        "emitter": {"type": "area", "radiance": rgb(5, 4, 3)},
        **more,
    }


def point(**more):
    return {"type": "point", "position": [0.2, 0.3, -0.1], "intensity": 1.0, **more}


def ball(bsdf="null", radius=0.3, center=(-0.35, -0.25, -0.25), **more):
    bsdf = {"type": bsdf} if isinstance(bsdf, str) else bsdf
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf, **more}


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


def integrator(kind="bdpt", **parameters):
    if kind == "bdpt":
        return internals.bdpt(**{"rr_depth": 100} | parameters)
    return mi.load_dict({"type": kind, "rr_depth": 100, **parameters})


def images(scene, method, spp, first_seed, seeds):
    """Renders, stacked: (seeds, height, width, channels)."""
    return np.stack(
        [
            np.array(mi.render(scene, integrator=method, spp=spp, seed=first_seed + i), dtype=np.float64)
            for i in range(seeds)
        ]
    )


def open_air(light, **more):
    """A matte ball in the open, under a sky or a sun."""
    light = {"sky": sky, "sun": sun}[light]()
    eye = sensor(origin=(0, 0.3, 2.5), target=(0, 0, 0), fov=30, size=8)
    return {
        "type": "scene",
        "sensor": eye,
        "matte": ball(matte(0.7, 0.5, 0.3), 0.4, (0, 0, 0)),
        "light": light,
    } | more


_registered = set()


def register_plugins():
    """Register ``own_phase`` and ``own_fog`` for the current variant."""
    if mi.variant() in _registered:
        return
    _registered.add(mi.variant())

    class OwnPhase(mi.PhaseFunction):
        """(1 + a cos) / 4 pi, cos of the angle that light is turned by."""

        def __init__(self, props):
            super().__init__(props)
            self.a = mi.Float(props.get("a", 0.8))
            self.m_flags = mi.PhaseFunctionFlags.Anisotropic

        def eval_pdf(self, ctx, mei, wo, active=True):
            density = (1 - self.a * dr.dot(mei.wi, wo)) / (4 * dr.pi)
            return mi.Spectrum(density), density

        def sample(self, ctx, mei, sample1, sample2, active=True):
            cos = (dr.sqrt(dr.square(1 - self.a) + 4 * self.a * sample2.x) - 1) / self.a
            sin, phi = dr.safe_sqrt(1 - cos * cos), 2 * dr.pi * sample2.y
            d = mi.Vector3f(sin * dr.cos(phi), sin * dr.sin(phi), cos)
            wo = mi.Frame3f(-mei.wi).to_world(d)
            return wo, mi.Spectrum(1), (1 + self.a * cos) / (4 * dr.pi)

    class OwnFog(mi.Medium):
        """Gray and homogeneous, by the calls that ``volpath`` makes."""

        def __init__(self, props):
            super().__init__(props)
            self.extinction, self.albedo = (mi.Float(props.get(name)) for name in ("extinction", "albedo"))
            self.m_is_homogeneous, self.m_has_spectral_extinction = True, False
            self.m_sample_emitters = True

        def intersect_aabb(self, ray):
            return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)

        def get_majorant(self, mei, active=True):
            return mi.Spectrum(self.extinction)

        def get_scattering_coefficients(self, mei, active=True):
            sigma_t = mi.Spectrum(self.extinction)
            return sigma_t * self.albedo, mi.Spectrum(0), sigma_t

    mi.register_phase("own_phase", OwnPhase)
    mi.register_medium("own_fog", OwnFog)
