"""Small scenes by parts: every kind of emitter, every kind of sensor, and two scenes to put them in.

``EMITTERS`` and ``SENSORS`` are functions by name, each making one entry of a scene's dictionary;
`takes_part` says which strategies a kind takes part in, as the documentation has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from plugins import register_plugins

from scenes import area, ball, film, floor, square
from scenes import both_sides as grey

T = mi.ScalarTransform4f

EGG = Path(__file__).parents[2] / "scenes" / "meshes" / "veach_bidir_egg.ply"


def sky_bitmap():
    """A sky that is uneven in every direction, brighter in one place."""
    rng = np.random.default_rng(3)
    data = rng.random((8, 16, 3), dtype=np.float32) * 0.5 + 0.2
    data[2, 3] = 6.0
    return mi.Bitmap(data)


def texture():
    data = np.random.default_rng(4).random((6, 6, 3), dtype=np.float32) + 0.1
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest"}


# -- emitters ---------------------------------------------------------------------------------


def glowing(kind, radiance, at=None, angle=90, size=1.0, **keys):
    """A shape that emits; if it is placed ``at`` a point, turned about the x axis."""
    to_world = {} if at is None else {"to_world": T().translate(at).rotate([1, 0, 0], angle).scale(size)}
    return {"type": kind, "bsdf": grey(0.1), "emitter": area(radiance)} | to_world | keys


def egg(radiance, mirror=1, **keys):
    """An egg of triangles that emits, 0.75 high."""
    at = T().translate([0.6, 1.6, 0.3]).scale([0.5 * mirror, 0.5, 0.5]).translate([2.4, -2.6, 0.8])
    return glowing("ply", radiance, filename=str(EGG), to_world=at) | keys


def aimed(kind, **keys):
    """An emitter at a point, above and turned to the origin."""
    return {"type": kind, "to_world": T().look_at([1, 3, 1.5], [0, 0, 0], [0, 0, 1])} | keys


def cube():
    turned = T().translate([1, 1.6, 0.4]).rotate([0.70710678, 0.70710678, 0], 30).scale(0.25)
    return glowing("cube", 5.0, to_world=turned)


# A sun of 25 degrees, so that hits on it are not rare.
BROAD_SUN = {"sun_aperture": 25.0, "to_world": T().rotate([1, 0, 0], -90)}
DAYTIME = {"start_month": 6, "end_month": 7, "end_year": 2025}
DAYTIME |= {"window_start_time": 9.0, "window_end_time": 15.0}
BULB = {"center": [-1, 1.6, 0.5], "radius": 0.3}
ALL_AROUND = {"center": [0, 1, 1], "radius": 7.0, "flip_normals": True}
TUBE = {"p0": [-1.2, 1.5, 0], "p1": [1, 2, 0.4], "radius": 0.15}
TURNED_SKY = T().rotate([0.26726124, 0.53452248, 0.80178373], 70)
# Lights all that is below as a directional emitter of the same irradiance from straight above does.
BEAM = {"type": "directionalarea", "radiance": 3.0}

EMITTERS = {
    "rectangle": lambda: glowing("rectangle", 6.0, [0.5, 2.5, 0], size=0.4),
    "disk": lambda: glowing("disk", 8.0, [0.5, 2.5, 0], 100, 0.4),
    "sphere": lambda: glowing("sphere", 5.0, **BULB),
    "inside of a sphere": lambda: glowing("sphere", 0.6, **ALL_AROUND, bsdf=grey(0.0)),
    "cylinder": lambda: glowing("cylinder", 4.0, **TUBE),
    "cube": cube,
    "flat mesh": lambda: egg(4.0, face_normals=True),
    "smooth mesh": lambda: egg(4.0),
    "mirrored mesh": lambda: egg(4.0, mirror=-1),
    "textured": lambda: glowing("rectangle", texture(), [0, 2.5, 0], size=0.5),
    "textured disk": lambda: glowing("disk", texture(), [0.5, 2.2, 0], 80, 0.5),
    "textured sphere": lambda: glowing("sphere", texture(), **BULB),
    "point": lambda: {"type": "point", "position": [0.7, 2.2, 1], "intensity": 5.0},
    "spot": lambda: aimed("spot", intensity=12.0, cutoff_angle=35, beam_width=20),
    "textured spot": lambda: aimed("spot", intensity=12.0, cutoff_angle=35, texture=texture()),
    "projector": lambda: aimed("projector", irradiance=1.0, scale=9.0, fov=60),
    "textured projector": lambda: aimed("projector", irradiance=texture(), scale=12.0, fov=50, fov_axis="y"),
    "directional": lambda: {"type": "directional", "direction": [-1, -2, -0.7], "irradiance": 3.0},
    "directionalarea": lambda: glowing("rectangle", 0, [0, 2.9, 0], size=2.05, bsdf=grey(0.0), emitter=BEAM),
    "constant": lambda: {"type": "constant", "radiance": 0.7},
    "envmap": lambda: {"type": "envmap", "bitmap": sky_bitmap(), "scale": 0.8},
    "rotated envmap": lambda: {"type": "envmap", "bitmap": sky_bitmap(), "to_world": TURNED_SKY},
    "sunsky": lambda: {"type": "sunsky", "sun_direction": [0.5, 0.8, 0.4]} | BROAD_SUN,
    "timed_sunsky": lambda: {"type": "timed_sunsky"} | DAYTIME | BROAD_SUN,
    "own lamp": lambda: {"type": "own_lamp", "to_world": T().translate([0.7, 2.2, 1]), "radiance": 5.0},
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


def sensor(kind, keys=None, **film_keys):
    return {"type": kind, "sampler": {"type": "independent"}, "film": film(**film_keys)} | (keys or {})


def looking(origin=(0, 2, 5), target=(0, 0.3, 0)):
    return T().look_at(list(origin), list(target), [0, 1, 0])


def perspective(origin=(0, 2, 5), target=(0, 0.3, 0), fov=40, keys=None, **film_keys):
    placed = {"fov": fov, "to_world": looking(origin, target)}
    return sensor("perspective", placed | (keys or {}), **film_keys)


def thinlens(aperture=0.15, focus=4.5, **keys):
    lens = {"type": "thinlens", "aperture_radius": aperture, "focus_distance": focus}
    return perspective(**keys) | lens


def orthographic(scale=1.9, keys=None, **film_keys):
    placed = {"to_world": looking().scale([scale, scale, 1])}
    return sensor("orthographic", placed | (keys or {}), **film_keys)


def batch(one, two):
    """Two views of 8 x 8 pixels side by side."""
    views = {"one": one | {"film": film(8)}, "two": two | {"film": film(8)}}
    return sensor("batch", views, height=8)


def distant(target=None, direction=(-0.3, -0.8, -0.5)):
    """Seen from afar, on a film of one pixel."""
    keys = {"direction": list(direction)} | ({} if target is None else {"target": target})
    return sensor("distant", keys, size=1)


def meter(shape=None):
    """A plate that faces down and measures irradiance: lamps above it are not seen directly, for `path`
    misses what comes straight from a lamp that cannot be hit."""
    to_world = T().translate([0.3, 1.3, 1.2]).rotate([1, 0, 0], 90).scale(0.25)
    plate = shape or {"type": "rectangle", "to_world": to_world}
    return plate | {"sensor": sensor("irradiancemeter", size=1)}


ON_THE_FLOOR = T().translate([0.5, 0.01, 0.7]).rotate([1, 0, 0], -90).scale(0.35)
RAY = {"origin": [0, 2, 5], "direction": [0.2, -2, -4.1]}

SENSORS = {
    "perspective": perspective,
    "thinlens": thinlens,
    "orthographic": orthographic,
    "distant": distant,
    "distant, point": lambda: distant([0.5, 0.0, 0.7]),
    "distant, shape": lambda: distant({"type": "disk", "to_world": ON_THE_FLOOR}),
    "radiancemeter": lambda: sensor("radiancemeter", RAY, size=1),
    "irradiancemeter": meter,
    "batch": lambda: batch(perspective(), perspective((4, 1.6, 3), fov=45)),
    "batch of lenses": lambda: batch(thinlens(), thinlens(0.3, 4, origin=(4, 1.6, 3))),
    "mixed batch": lambda: batch(perspective(), orthographic()),
    "own fisheye": lambda: sensor("own_fisheye", {"to_world": looking()}),
}


CROP = {"size": 32, "crop_offset_x": 10, "crop_offset_y": 3, "crop_width": 16, "crop_height": 16}
OFF_AXIS = {"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.15}
BORDER = {"rfilter": "gaussian", "sample_border": True}

# Cameras whose film, crop window, lens or field of view differ.
CAMERAS = {
    "plain": perspective,
    "crop": lambda: perspective(**CROP),
    "off axis": lambda: perspective(keys=OFF_AXIS),
    "off axis, crop": lambda: perspective(keys=OFF_AXIS, **CROP),
    **{
        f"fov {axis}": (lambda axis=axis: perspective(height=24, keys={"fov_axis": axis}))
        for axis in ("x", "y", "diagonal", "smaller", "larger")
    },
    "thinlens": thinlens,
    "thinlens, crop": lambda: thinlens(**CROP),
    "sample_border": lambda: perspective(**BORDER),
    "orthographic": orthographic,
    "orthographic, stretched, crop": lambda: orthographic(
        1.5, keys={"near_clip": 0.5, "far_clip": 12.0}, height=24, **CROP
    ),
    "orthographic, sample_border": lambda: orthographic(**BORDER),
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


def box(at, size, angle=25):
    to_world = T().translate(at).rotate([0, 1, 0], angle).scale(size)
    return {"type": "cube", "bsdf": grey(0.5), "to_world": to_world}


def room(sensor=None, **more):
    """A floor, a back wall, a ball and a box. Shapes of unequal BSDFs, so that Mitsuba merges none."""
    return {
        "type": "scene",
        "sensor": sensor or perspective(),
        "floor": floor(bsdf=grey(0.6)),
        "back": square((0, 1, -2), size=2, bsdf=grey(0.55)),
        "ball": ball({"type": "roughplastic", "alpha": 0.3}, 0.5, (-0.6, 0.5, 0.4)),
        "box": box([0.8, 0.4, -0.3], 0.4),
    } | more


def open_scene(sensor=None, **more):
    """A floor with a ball and a box above it, all well apart and in the open, so that the geometry term of
    every connection is bounded and so is the variance of every strategy."""
    plastic = {"type": "roughplastic", "alpha": 0.4, "diffuse_reflectance": 0.6}
    return {
        "type": "scene",
        "sensor": sensor or perspective(),
        "floor": floor(bsdf=grey(0.6)),
        "ball": ball(plastic, 0.45, (-0.7, 0.75, -0.3)),
        "box": box([0.85, 0.7, -0.6], 0.25),
    } | more


def pair(emitter, sensor, reference=False):
    """The scene of an emitter and a sensor, given by their names; ``reference``: for `path`."""
    register_plugins()
    part = SENSORS[sensor]()
    if emitter == "timed_sunsky":
        part = with_shutter(part)
    lamp = reference_lamp(emitter) if reference else EMITTERS[emitter]()
    return mi.load_dict(open_scene(part, lamp=lamp))
