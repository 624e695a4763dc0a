"""Small scenes by parts: every kind of emitter, every kind of sensor, and two scenes to put them in.

``EMITTERS`` and ``SENSORS`` are functions by name, each making one entry of a scene's dictionary;
`takes_part` says which strategies a kind takes part in, as the documentation has it. The plugins in Python
stand for those of users: classes that the package does not know.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

T = mi.ScalarTransform4f

EGG = Path(__file__).parents[2] / "scenes" / "meshes" / "veach_bidir_egg.ply"

# -- materials and textures -------------------------------------------------------------------


def grey(value):
    return {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}},
    }


def sky_bitmap():
    """A sky that is uneven in every direction, brighter in one place."""
    rng = np.random.default_rng(3)
    data = rng.random((8, 16, 3), dtype=np.float32) * 0.5 + 0.2
    data[2, 3] = 6.0
    return mi.Bitmap(data)


def texture():
    data = np.random.default_rng(4).random((6, 6, 3), dtype=np.float32) + 0.1
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest"}


# -- plugins in Python ------------------------------------------------------------------------

_registered = set()


def register_plugins():
    """Register the plugins for the current variant."""
    if mi.variant() in _registered:
        return
    _registered.add(mi.variant())

    class OwnEmitter(mi.Emitter):
        """What both emitters share: no more than `path` calls."""

        def __init__(self, props):
            super().__init__(props)
            self.radiance = mi.Float(props.get("radiance", 1.0))

        def traverse(self, callback):
            callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)
            callback.put("name", "a text", mi.ParamFlags.NonDifferentiable)

        def sample_wavelengths(self, si, sample, active=True):
            raise NotImplementedError

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return f"{type(self).__name__}[]"

    class OwnLamp(OwnEmitter):
        """A point light; ``radiance`` is its intensity."""

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = int(mi.EmitterFlags.DeltaPosition)

        def sample_direction(self, it, sample, active=True):
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p = self.world_transform() @ mi.Point3f(0)
            away = ds.p - it.p
            ds.dist = dr.norm(away)
            ds.d = away / ds.dist
            ds.time = it.time
            ds.pdf = dr.select(active, mi.Float(1), 0)
            ds.delta = mi.Bool(True)
            ds.emitter = mi.EmitterPtr(self)
            return ds, dr.select(active, mi.Spectrum(self.radiance / dr.square(ds.dist)), 0)

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0)

        def eval(self, si, active=True):
            return mi.Spectrum(0)

    class OwnSky(OwnEmitter):
        """Surroundings that are brighter above; directions are chosen uniformly."""

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = int(mi.EmitterFlags.Infinite)

        def seen(self, d, active):
            return dr.select(active, mi.Spectrum(self.radiance * (1 + 0.5 * d.y)), 0)

        def sample_direction(self, it, sample, active=True):
            d = mi.warp.square_to_uniform_sphere(sample)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.dist = mi.Float(100)
            ds.p = it.p + d * ds.dist
            ds.d, ds.n, ds.uv, ds.time = d, -d, mi.Point2f(sample), it.time
            ds.pdf = dr.select(active, mi.Float(dr.inv_four_pi), 0)
            ds.delta = mi.Bool(False)
            ds.emitter = mi.EmitterPtr(self)
            return ds, self.seen(d, active) * (4 * dr.pi)

        def pdf_direction(self, it, ds, active=True):
            return dr.select(active, mi.Float(dr.inv_four_pi), 0)

        def eval(self, si, active=True):
            return self.seen(-si.wi, active)

    class RayleighSky(OwnSky):
        """Light that air scatters once, polarized across the sun's plane (in polarized variants)."""

        def seen(self, d, active):
            sun = dr.normalize(mi.Vector3f(0.5, 0.7, 0.4))
            cos, across = dr.dot(d, sun), dr.normalize(dr.cross(d, sun))
            turned = mi.mueller.rotate_stokes_basis(-d, across, mi.mueller.stokes_basis(-d))
            vector = 1 + dr.square(cos), 1 - dr.square(cos), 0, 0  # in the frame whose x axis is ``across``
            value = dr.zeros(mi.Spectrum)
            for i in range(4):
                value[i, 0] = mi.UnpolarizedSpectrum(sum(turned[i, j] * vector[j] for j in range(4)))
            return dr.select(active, value, 0)

    class OwnFisheye(mi.Sensor):
        """A camera whose directions bend outwards."""

        def __init__(self, props):
            super().__init__(props)
            self.m_needs_sample_3 = False

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
            x, y = 1 - 2 * sample2.x, 1 - 2 * sample2.y
            d = dr.normalize(mi.Vector3f(x, y, 2.5 - 0.4 * (x * x + y * y)))
            to_world = self.world_transform()
            return mi.Ray3f(to_world @ mi.Point3f(0), to_world @ d, time, wavelengths), weight

        def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return "OwnFisheye[]"

    mi.register_emitter("own_lamp", OwnLamp)
    mi.register_emitter("own_sky", OwnSky)
    mi.register_emitter("rayleigh_sky", RayleighSky)
    mi.register_sensor("own_fisheye", OwnFisheye)


# -- emitters ---------------------------------------------------------------------------------


def egg(radiance, mirror=1, **keys):
    """An egg of triangles that emits, 0.75 high."""
    return {
        "type": "ply",
        "filename": str(EGG),
        "to_world": T()
        .translate([0.6, 1.6, 0.3])
        .scale([0.5 * mirror, 0.5, 0.5])
        .translate([2.4, -2.6, 0.8]),
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": radiance},
    } | keys


EMITTERS = {
    "rectangle": lambda: {
        "type": "rectangle",
        "to_world": T().translate([0.5, 2.5, 0]).rotate([1, 0, 0], 90).scale(0.4),
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": 6.0},
    },
    "disk": lambda: {
        "type": "disk",
        "to_world": T().translate([0.5, 2.5, 0]).rotate([1, 0, 0], 100).scale(0.4),
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": 8.0},
    },
    "sphere": lambda: {
        "type": "sphere",
        "center": [-1, 1.6, 0.5],
        "radius": 0.3,
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": 5.0},
    },
    # All around, and seen from within.
    "inside of a sphere": lambda: {
        "type": "sphere",
        "center": [0, 1, 1],
        "radius": 7.0,
        "flip_normals": True,
        "bsdf": grey(0.0),
        "emitter": {"type": "area", "radiance": 0.6},
    },
    "cylinder": lambda: {
        "type": "cylinder",
        "p0": [-1.2, 1.5, 0],
        "p1": [1, 2, 0.4],
        "radius": 0.15,
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": 4.0},
    },
    "cube": lambda: {
        "type": "cube",
        "to_world": T().translate([1, 1.6, 0.4]).rotate([0.70710678, 0.70710678, 0], 30).scale(0.25),
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": 5.0},
    },
    "flat mesh": lambda: egg(4.0, face_normals=True),
    "smooth mesh": lambda: egg(4.0),
    "mirrored mesh": lambda: egg(4.0, mirror=-1),
    "textured": lambda: {
        "type": "rectangle",
        "to_world": T().translate([0, 2.5, 0]).rotate([1, 0, 0], 90).scale(0.5),
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": texture()},
    },
    "textured disk": lambda: {
        "type": "disk",
        "to_world": T().translate([0.5, 2.2, 0]).rotate([1, 0, 0], 80).scale(0.5),
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": texture()},
    },
    "textured sphere": lambda: {
        "type": "sphere",
        "center": [-1, 1.6, 0.5],
        "radius": 0.3,
        "bsdf": grey(0.1),
        "emitter": {"type": "area", "radiance": texture()},
    },
    "point": lambda: {"type": "point", "position": [0.7, 2.2, 1], "intensity": 5.0},
    "spot": lambda: {
        "type": "spot",
        "intensity": 12.0,
        "cutoff_angle": 35,
        "beam_width": 20,
        "to_world": T().look_at([1, 3, 1.5], [0, 0, 0], [0, 0, 1]),
    },
    "textured spot": lambda: {
        "type": "spot",
        "intensity": 12.0,
        "cutoff_angle": 35,
        "texture": texture(),
        "to_world": T().look_at([1, 3, 1.5], [0, 0, 0], [0, 0, 1]),
    },
    "projector": lambda: {
        "type": "projector",
        "irradiance": 1.0,
        "scale": 9.0,
        "fov": 60,
        "to_world": T().look_at([1, 3, 1.5], [0, 0, 0], [0, 0, 1]),
    },
    "textured projector": lambda: {
        "type": "projector",
        "irradiance": texture(),
        "scale": 12.0,
        "fov": 50,
        "fov_axis": "y",
        "to_world": T().look_at([1, 3, 1.5], [0, 0, 0], [0, 0, 1]),
    },
    "directional": lambda: {"type": "directional", "direction": [-1, -2, -0.7], "irradiance": 3.0},
    # Lights all that is below as a directional emitter of the same irradiance from straight above does.
    "directionalarea": lambda: {
        "type": "rectangle",
        "to_world": T().translate([0, 2.9, 0]).rotate([1, 0, 0], 90).scale(2.05),
        "bsdf": grey(0.0),
        "emitter": {"type": "directionalarea", "radiance": 3.0},
    },
    "constant": lambda: {"type": "constant", "radiance": 0.7},
    "envmap": lambda: {"type": "envmap", "bitmap": sky_bitmap(), "scale": 0.8},
    "rotated envmap": lambda: {
        "type": "envmap",
        "bitmap": sky_bitmap(),
        "to_world": T().rotate([0.26726124, 0.53452248, 0.80178373], 70),
    },
    # A sun of 25 degrees, so that hits on it are not rare.
    "sunsky": lambda: {
        "type": "sunsky",
        "sun_direction": [0.5, 0.8, 0.4],
        "sun_aperture": 25.0,
        "to_world": T().rotate([1, 0, 0], -90),
    },
    "timed_sunsky": lambda: {
        "type": "timed_sunsky",
        "start_month": 6,
        "end_month": 7,
        "end_year": 2025,
        "window_start_time": 9.0,
        "window_end_time": 15.0,
        "sun_aperture": 25.0,
        "to_world": T().rotate([1, 0, 0], -90),
    },
    "own lamp": lambda: {
        "type": "own_lamp",
        "to_world": T().translate([0.7, 2.2, 1]),
        "radiance": 5.0,
    },
    "own sky": lambda: {"type": "own_sky", "radiance": 0.6},
}


def sampled_emission(emitters, count, seed=11, time=0.0):
    """``count`` emissions by an `Emitters`, and the random numbers, (4, count)."""
    u = np.random.default_rng(seed).random((4, count), dtype=np.float32)
    like = dr.zeros(mi.Interaction3f)  # time and wavelengths
    like.time = mi.Float(time)
    return emitters.sample_emission(mi.Point2f(u[:2]), mi.Point2f(u[2:]), like, mi.Bool(True)), u


def plugin_of(part) -> str:
    """Mitsuba's name of the emitter or sensor in an entry of a scene."""
    return next((part[key]["type"] for key in ("emitter", "sensor") if key in part), part["type"])


def reference_lamp(name):
    """What `path` renders in place of the emitter ``name``: for one that it cannot see, its equal."""
    if name == "directionalarea":
        return {"type": "directional", "direction": [0, -1, 0], "irradiance": 3.0}
    return EMITTERS[name]()


# -- sensors ----------------------------------------------------------------------------------


def film(size=16, rfilter="box", **keys):
    return {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": rfilter},
    } | keys


def sensor(kind, keys=None, **film_keys):
    return {"type": kind, "sampler": {"type": "independent"}, "film": film(**film_keys)} | (keys or {})


def perspective(origin=(0, 2, 5), target=(0, 0.3, 0), fov=40, keys=None, **film_keys):
    placed = {"fov": fov, "to_world": T().look_at(list(origin), list(target), [0, 1, 0])}
    return sensor("perspective", placed | (keys or {}), **film_keys)


def thinlens(aperture=0.15, focus=4.5, **keys):
    return perspective(**keys) | {
        "type": "thinlens",
        "aperture_radius": aperture,
        "focus_distance": focus,
    }


def orthographic(scale=1.9, keys=None, **film_keys):
    placed = {"to_world": T().look_at([0, 2, 5], [0, 0.3, 0], [0, 1, 0]).scale([scale, scale, 1])}
    return sensor("orthographic", placed | (keys or {}), **film_keys)


def fisheye(**film_keys):
    placed = {"to_world": T().look_at([0, 2, 5], [0, 0.3, 0], [0, 1, 0])}
    return sensor("own_fisheye", placed, **film_keys)


def batch(one, two):
    """Two views of 8 x 8 pixels side by side."""
    views = {"one": one | {"film": film(8)}, "two": two | {"film": film(8)}}
    return sensor("batch", views, height=8)


DOWNWARDS = [-0.3, -0.8, -0.5]


def distant(target=None, direction=None):
    """Seen from afar, on a film of one pixel."""
    keys = {"direction": direction or DOWNWARDS} | ({} if target is None else {"target": target})
    return sensor("distant", keys, size=1)


def meter(shape=None):
    """A plate that faces down and measures irradiance: lamps above it are not seen directly, for `path`
    misses what comes straight from a lamp that cannot be hit."""
    plate = shape or {
        "type": "rectangle",
        "to_world": T().translate([0.3, 1.3, 1.2]).rotate([1, 0, 0], 90).scale(0.25),
    }
    return plate | {"sensor": sensor("irradiancemeter", size=1)}


SENSORS = {
    "perspective": perspective,
    "thinlens": thinlens,
    "orthographic": orthographic,
    "distant": distant,
    "distant, point": lambda: distant([0.5, 0.0, 0.7]),
    "distant, shape": lambda: distant(
        {"type": "disk", "to_world": T().translate([0.5, 0.01, 0.7]).rotate([1, 0, 0], -90).scale(0.35)}
    ),
    "radiancemeter": lambda: sensor(
        "radiancemeter", {"origin": [0, 2, 5], "direction": [0.2, -2, -4.1]}, size=1
    ),
    "irradiancemeter": meter,
    "batch": lambda: batch(perspective(), perspective((4, 1.6, 3), fov=45)),
    "batch of lenses": lambda: batch(thinlens(), thinlens(0.3, 4, origin=(4, 1.6, 3))),
    "mixed batch": lambda: batch(perspective(), orthographic()),
    "own fisheye": fisheye,
}


# Cameras whose film, crop window, lens or field of view differ.
CAMERAS = {
    "plain": perspective,
    "crop": lambda: perspective(size=32, crop_offset_x=10, crop_offset_y=3, crop_width=16, crop_height=16),
    "off axis": lambda: perspective(
        keys={"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.15}
    ),
    "off axis, crop": lambda: perspective(
        size=32,
        crop_offset_x=10,
        crop_offset_y=3,
        crop_width=16,
        crop_height=16,
        keys={"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.15},
    ),
    **{
        f"fov {axis}": (lambda axis=axis: perspective(height=24, keys={"fov_axis": axis}))
        for axis in ("x", "y", "diagonal", "smaller", "larger")
    },
    "thinlens": thinlens,
    "thinlens, crop": lambda: thinlens(
        size=32, crop_offset_x=10, crop_offset_y=3, crop_width=16, crop_height=16
    ),
    "sample_border": lambda: perspective(rfilter="gaussian", sample_border=True),
    "orthographic": orthographic,
    "orthographic, stretched, crop": lambda: orthographic(
        1.5,
        keys={"near_clip": 0.5, "far_clip": 12.0},
        size=32,
        height=24,
        crop_offset_x=10,
        crop_offset_y=3,
        crop_width=16,
        crop_height=16,
    ),
    "orthographic, sample_border": lambda: orthographic(rfilter="gaussian", sample_border=True),
}


def with_shutter(part):
    """The sensor's entry with a shutter that is open from 0 to 1."""
    if "sensor" in part:
        return part | {"sensor": with_shutter(part["sensor"])}
    return part | {"shutter_open": 0.0, "shutter_close": 1.0}


# -- who takes part in what -------------------------------------------------------------------


@dataclass(frozen=True)
class EmitterPart:
    """``hit``: camera subpaths can hit the emitter (s = 0); ``direct``: next-event estimation can choose it
    (s = 1); ``traced``: light subpaths start from it; ``infinite``: it is at infinity."""

    hit: bool = True
    direct: bool = True
    traced: bool = True
    infinite: bool = False


@dataclass(frozen=True)
class SensorPart:
    """``connectible``: points of the scene can be connected to the sensor (t = 1); ``area``: light subpaths
    can hit it (t = 0); ``open``: it has many points, so that it sees lamps that cannot be hit; ``parallel``:
    all its rays have one direction."""

    connectible: bool = True
    area: bool = False
    open: bool = False
    parallel: bool = False


DELTA = EmitterPart(hit=False)

EMITTER_PARTS = {
    "area": EmitterPart(),
    "point": DELTA,
    "spot": DELTA,
    "projector": DELTA,
    "directional": EmitterPart(hit=False, infinite=True),
    "directionalarea": EmitterPart(hit=False, direct=False),
    "constant": EmitterPart(infinite=True),
    "envmap": EmitterPart(infinite=True),
    "sunsky": EmitterPart(infinite=True),
    "timed_sunsky": EmitterPart(infinite=True),
    "own_lamp": EmitterPart(hit=False, traced=False),
    "own_sky": EmitterPart(traced=False, infinite=True),
}

SENSOR_PARTS = {
    "perspective": SensorPart(),
    "thinlens": SensorPart(area=True, open=True),
    "orthographic": SensorPart(parallel=True),
    "distant": SensorPart(parallel=True),
    "distant, point": SensorPart(connectible=False, parallel=True),
    "distant, shape": SensorPart(connectible=False, parallel=True),
    "radiancemeter": SensorPart(connectible=False, parallel=True),
    "irradiancemeter": SensorPart(area=True, open=True),
    "batch": SensorPart(),
    "batch of lenses": SensorPart(open=True),
    "mixed batch": SensorPart(connectible=False),
    "own fisheye": SensorPart(connectible=False),
}


def emitter_part(name) -> EmitterPart:
    return EMITTER_PARTS[plugin_of(EMITTERS[name]())]


def takes_part(emitter, sensor, s, t) -> bool:
    """Whether (s, t) can make paths from the emitter to the sensor, given by their names."""
    e, z = emitter_part(emitter), SENSOR_PARTS[sensor]
    if s == 0:
        return e.hit
    if s == 1 and t == 1:
        if not (e.direct and e.traced and z.connectible):
            return False
        return z.open if not e.hit else not (e.infinite and z.parallel)
    if s == 1:
        return e.direct
    return e.traced and (z.area if t == 0 else z.connectible if t == 1 else True)


# -- scenes -----------------------------------------------------------------------------------


def room(sensor=None, **more):
    """A floor, a back wall, a ball and a box. Shapes of unequal BSDFs, so that Mitsuba merges none."""
    return {
        "type": "scene",
        "sensor": sensor or perspective(),
        "floor": {
            "type": "rectangle",
            "bsdf": grey(0.6),
            "to_world": T().rotate([1, 0, 0], -90).scale(2),
        },
        "back": {
            "type": "rectangle",
            "bsdf": grey(0.55),
            "to_world": T().translate([0, 1, -2]).scale(2),
        },
        "ball": {
            "type": "sphere",
            "center": [-0.6, 0.5, 0.4],
            "radius": 0.5,
            "bsdf": {"type": "roughplastic", "alpha": 0.3},
        },
        "box": {
            "type": "cube",
            "bsdf": grey(0.5),
            "to_world": T().translate([0.8, 0.4, -0.3]).rotate([0, 1, 0], 25).scale(0.4),
        },
    } | more


def open_scene(sensor=None, **more):
    """A floor with a ball and a box above it, all well apart and in the open, so that the geometry term of
    every connection is bounded and so is the variance of every strategy."""
    return {
        "type": "scene",
        "sensor": sensor or perspective(),
        "floor": {
            "type": "rectangle",
            "bsdf": grey(0.6),
            "to_world": T().rotate([1, 0, 0], -90).scale(2),
        },
        "ball": {
            "type": "sphere",
            "center": [-0.7, 0.75, -0.3],
            "radius": 0.45,
            "bsdf": {"type": "roughplastic", "alpha": 0.4, "diffuse_reflectance": 0.6},
        },
        "box": {
            "type": "cube",
            "bsdf": grey(0.5),
            "to_world": T().translate([0.85, 0.7, -0.6]).rotate([0, 1, 0], 25).scale(0.25),
        },
    } | more


def pair(emitter, sensor, reference=False):
    """The scene of an emitter and a sensor, given by their names; ``reference``: for `path`."""
    register_plugins()
    part = SENSORS[sensor]()
    if emitter == "timed_sunsky":
        part = with_shutter(part)
    lamp = reference_lamp(emitter) if reference else EMITTERS[emitter]()
    return mi.load_dict(open_scene(part, lamp=lamp))
