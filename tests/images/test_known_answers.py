"""Scenes whose radiance is known, in closed form or by quadrature: a table of scenes and ways to render them.

Inside the unit sphere of reflectance 1/2 light that was reflected m times has the radiance 2^-m, for each
path length and each strategy. What scatters without loss is invisible under an even sky. Statistic: Student's
t-test of means over seeds against the known value with Šidák's correction (`welch.check_known`), beside
`ROUNDING`; a confidence interval that reaches further than the tolerance fails too, so each row states what
error it sees.
"""

from functools import cache, partial
from typing import NamedTuple

import media_parts as fogs
import mitsuba as mi
import numpy as np
import pytest
import welch as st
from meshes import ball_mesh
from tables import Table

from scenes import (
    DOWNWARDS,
    UPWARDS,
    area,
    both_sides,
    camera,
    floor,
    integrator,
    layer,
    load,
    matte,
    meter,
    renders,
    rgb,
    square,
    thinlens,
    transform,
)

# Systematic error that float32 is allowed, relative: sums of some 1e3 terms, ray offsets.
ROUNDING = 5e-5
check = partial(st.check_known, rounding=ROUNDING)

WAYS = {
    "all": {"skip": "none"},
    "default": {},
    "camera": {"light_paths": 0},
    "power": {"heuristic": "power"},
    "K=2": {"skip": "none", "stored_vertices": 2},
    "independent": {"points": "independent"},
    "sixteenth": {"skip": "impossible", "light_paths": "1/16", "connections": "all", "heuristic": "power"},
    "one": {"skip": "impossible", "light_paths": 1, "connections": "one"},
    "every": {"skip": "impossible", "light_paths": 1, "connections": "all"},
}
MEDIA = "all", "camera"


def pixels(images):
    return images


def lines(images):
    return np.concatenate([images.mean(1), images.mean(2)], axis=1)


def blocks(size, images):
    """Means of size x size pixels."""
    seeds, height, width = images.shape[:3]
    return images.reshape(seeds, height // size, size, width // size, size, -1).mean((2, 4))


def border(images):
    """The four outermost rows and columns."""
    sides = images[:, 0], images[:, -1], images[:, :, 0], images[:, :, -1]
    return np.stack([side.mean(1) for side in sides], axis=1)


def ring(images):
    """All outermost pixels."""
    outer = np.ones(images.shape[1:3], dtype=bool)
    outer[1:-1, 1:-1] = False
    return images[:, outer].mean(1)


def inner(images):
    return images[:, 1:-1, 1:-1].mean((1, 2))


class Row(NamedTuple):
    """A scene's parts, the mean of its image (a number, or one for each colour) and the tolerance, relative.

    ``regions``: pairs of a mean of pixels and its tolerance. ``layers``: by name of a strategy's layer, or by
    the number of edges whose weighted layers are added, expectation and tolerance. ``more``: parameters.
    """

    scene: dict
    expected: object
    tolerance: float = 0.01
    spp: int = 128
    more: dict = {}
    regions: tuple = ()
    layers: dict = {}
    seeds: int = 16
    rounding: float = ROUNDING


known = Table()


# -- the unit sphere ----------------------------------------------------------------------------

EYE = {"origin": (0, 0, 0.5), "target": (0.2, 0.1, -1), "near": 1e-3}


def sphere(reflectance=0.5, **more):
    return {"type": "sphere", "bsdf": both_sides(reflectance), **more}


def sphere_lit_by(kind, sensor=None):
    """The unit sphere around a point lamp, or glowing by 1/2."""
    scene = {"sensor": sensor or camera(**EYE)}
    if kind == "point":
        return scene | {"wall": sphere(), "lamp": {"type": "point", "intensity": float(np.pi)}}
    return scene | {"wall": sphere(flip_normals=True, emitter=area(0.5))}


def radiance(kind, k):
    """Of paths of ``k`` edges in `sphere_lit_by`."""
    return 0.5**k if kind == "emission" else 0.5 ** (k - 1) if k >= 2 else 0.0


@known("default", "all", "K=2", "independent", "sixteenth", of=("point", "emission"))
def all_bounces(kind):
    """As users render: unlimited depth, roulette, one drawn connection."""
    return Row(sphere_lit_by(kind), 1, 3e-3, more={"rr_depth": 5}, regions=((lines, 2e-2),))


@known("default", "K=2")
def two_bounces():
    """``max_depth`` with the drawn connection and the roulette."""
    return Row(sphere_lit_by("point"), 0.75, 3e-3, more={"max_depth": 3, "rr_depth": 5})


@known("one", "every")
def many_stored_vertices():
    """A white sphere: 1 for each of the path lengths 2 to 60, with light subpaths of 58 stored vertices."""
    scene = sphere_lit_by("point", camera(**EYE, size=8)) | {"wall": sphere(1.0)}
    return Row(scene, 59.0, 1e-2, 16, more={"max_depth": 60})


@known("all", of=("box", "gaussian", "mitchell"))
def borders_of_a_sphere(rfilter):
    """LuxCore #237, #239: dark or bright border rows with splats and filters."""
    scene = sphere_lit_by("emission", camera(**EYE, rfilter=rfilter))
    return Row(scene, 0.75, 1e-3, 256, {"max_depth": 2}, ((border, 5e-3), (inner, 1e-3)))


@known("all", of=("box", "gaussian"))
def crop_window(rfilter):
    """pbrt-v4 #347, #456: crop windows changed the number of light paths per pixel, in the image but not in
    the weights."""
    window = {"crop_offset_x": 7, "crop_offset_y": 3, "crop_width": 16, "crop_height": 14}
    scene = sphere_lit_by("emission", camera(**EYE, size=24, rfilter=rfilter, film=window))
    alone = {f"s{s}t{k + 1 - s}": (0.5**k, 0.05) for k in (1, 2, 3) for s in range(k + 1)}
    return Row(scene, 0.875, 5e-3, 256, {"max_depth": 3}, layers=alone)


@known("all", of=((1, 1), (0.1, 5), (30, 1)))
def unequal_sampling_weights(one, other):
    """LuxCore #671, #687: next-event estimation and emission picked lights with unequal probabilities."""
    half = {"type": "point", "intensity": float(np.pi) / 2}
    scene = {"sensor": camera(origin=(0, 0, 0.5), target=(0, 0.1, -1)), "wall": sphere()}
    scene["one"] = half | {"sampling_weight": one}
    scene["two"] = half | {"sampling_weight": other, "position": [0.3, 0.2, -0.1]}
    # A light that is picked once in 51 times makes few and bright subpaths.
    alone = dict.fromkeys(("s1t3", "s2t2", "s3t1"), (0.25, 0.06))
    return Row(scene, None, 0, 256, {"max_depth": 3}, layers=alone | {3: (0.25, 0.01)})


def glass(**more):
    return {"type": "sphere", "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}, **more}


# Parameters, and what error the weighted sums can show.
CONFIGURATIONS = {
    "everything": ({"skip": "none"}, 3e-3),
    "K=2": ({"skip": "none", "stored_vertices": 2}, 3e-3),
    "light_paths=1/4": ({"skip": "impossible", "light_paths": "1/4"}, 3e-3),
    "power, 1/2": ({"skip": "impossible", "heuristic": "power", "light_paths": 0.5}, 3e-3),
    "light_paths=0": ({"skip": "none", "light_paths": 0}, 3e-3),
    "no connections": ({"skip": "none", "connections": "none"}, 5e-3),
}


@known("default", of=[(kind, name) for kind in ("point", "emission") for name in CONFIGURATIONS])
def every_path_length(kind, name):
    """The weighted strategies of each path length add up to 2^-m, and so does each unweighted one that can
    make the path (5e-2, for t = 1), also with stored vertices short of the path length; others are 0."""
    (parameters, tolerance), layers = CONFIGURATIONS[name], {}
    for k in range(1 if kind == "emission" else 2, 6):
        layers[k] = radiance(kind, k), tolerance
        for s in range(k + 1):
            traced, t = s >= 2 or s == k == 1, k + 1 - s
            off = kind == "point" and (s == 0 or k == 1)
            off |= name == "no connections" and s >= 2 <= t
            off |= traced and (name == "light_paths=0" or k > parameters.get("stored_vertices", 64))
            layers[f"s{s}t{t}"] = (0, 0) if off else (radiance(kind, k), 5e-2)
    return Row(sphere_lit_by(kind), None, 0, 256, {"max_depth": 5} | parameters, layers=layers)


@known("all", "power", of=[(sensor, kind) for sensor in ("meter", "lens") for kind in ("point", "emission")])
def sensor_with_area(sensor, kind):
    """With t = 0 a path of k edges has k + 2 strategies. The meter is the sphere itself, the lens one that a
    hundredth of all light hits within its view; it sees the point lamp as a disk out of focus, of which a
    part is on the film: k = 1 is left out."""
    first = 1 if kind == "point" else 0
    if sensor == "meter":
        scene, unit, spp, least = sphere_lit_by(kind), np.pi, 1 << 15, 1
        del scene["sensor"]
        scene["wall"] |= {"flip_normals": True, "sensor": meter()}
    else:
        lens = thinlens(**EYE, size=4, aperture_radius=0.3, focus_distance=1.0)
        scene, unit, spp, least = sphere_lit_by(kind, lens), 1, 1 << 13, 1 + first
    known = {k: unit * 0.5 ** (k - first) for k in range(least, 4)}
    layers = {k: (value, 0.02) for k, value in known.items()}
    layers |= {f"s{s}t{k + 1 - s}": (v, 0.15) for k, v in known.items() for s in range(first, k + 2)}
    return Row(scene, None, 0, spp, {"max_depth": 3, "skip": "none"}, layers=layers)


@known("all", "default")
def lamp_in_glass_around_a_meter():
    """t = 0 alone makes paths of a delta lamp, delta surfaces, the sensor: all of the lamp's light falls on a
    black sphere of radius 3. Paths of more than 12 edges carry 0.04^5 of it at most."""
    wall = sphere(0.0, radius=3, flip_normals=True, sensor=meter())
    scene = {"lamp": {"type": "point", "intensity": 1.0}, "ball": glass(), "wall": wall}
    return Row(scene, 1 / 9, 1e-3, 4096, {"max_depth": 12, "rr_depth": 5})


@known("all", "default")
def lamp_in_a_shell():
    """mitsuba2 #262, #491, mitsuba3 #1462: a lamp behind glass lights nothing, for `path` is blind. The flux
    times the transmittance of two faces, after one reflection."""
    shell = glass(radius=0.3), glass(radius=0.25, bsdf={"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5})
    scene = sphere_lit_by("point", camera(origin=(0, 0, 0.6), target=(0, 0.5, 1), fov=50, size=8))
    scene |= {"outer": shell[0], "inner": shell[1]}
    return Row(scene, 0.5 * 0.96**2, 0.04, 1024, {"max_depth": 4})


@known("all", of=("camera", "light"))
def lobes_and_roulette(side):
    """The number that chooses a lobe must not decide roulette too: with one number for both the camera sees
    1/38. A tenth of the ball is transparent, the rest black, with roulette from the first vertex on."""
    mask = {"type": "mask", "opacity": 0.9, "bsdf": matte(0)}
    ball = {"type": "sphere", "radius": 0.2, "bsdf": mask}
    if side == "camera":
        scene, depth = sphere_lit_by("emission", camera(origin=(0, 0, 0), target=EYE["target"])), 2
    else:
        scene, depth = sphere_lit_by("point", camera(origin=(0, 0, -0.3))), 3
    return Row(scene | {"ball": ball}, 0.05, 3e-2, 1024, {"max_depth": depth, "rr_depth": 1})


@known("all")
def disk_before_the_near_plane():
    """Light that flies to a lens (t = 0) passes what is before its near plane, as camera rays do: with the
    disk the image is 0.5 % too dark."""
    lens = thinlens(**EYE | {"near": 0.25}, size=4, aperture_radius=0.3, focus_distance=1.0)
    forwards = transform().look_at([0, 0, 0.5], [0.2, 0.1, -1], [0, 1, 0])
    to_world = forwards @ transform().translate([0, 0, 0.2]).scale(0.6)
    scene = sphere_lit_by("emission", lens) | {"wall": sphere(0.0, flip_normals=True, emitter=area(0.5))}
    scene["black"] = {"type": "disk", "bsdf": both_sides(0), "to_world": to_world}
    return Row(scene, 0.5, 2e-3, 1024, {"max_depth": 1})


@known("all")
def plate_before_a_lens():
    """The lens is no shape, so that light subpaths that cross it (t = 0) have to be told what is in
    between."""
    scene = {
        "lamp": square((0, 0, -3), bsdf=matte(0), emitter=area(5.0)),
        "plate": square((0, 0, -1), size=5, bsdf=matte(0)),
        "sensor": thinlens(origin=(0, 0, 2), target=(0, 0, 0), aperture_radius=0.5, focus_distance=3.0),
    }
    return Row(scene, 0.0, 0, 64, {"max_depth": 3}, seeds=2)


# -- under an even sky --------------------------------------------------------------------------


def sky(value=1.0):
    return {"type": "constant", "radiance": value}


def white_matte():
    cube = transform().translate([0.9, -0.4, 0.3]).rotate([0.70710678, 0.70710678, 0], 30).scale(0.5)
    return {
        "ball": sphere(1.0, radius=0.8, center=[-0.7, 0.3, 0]),
        "box": {"type": "cube", "bsdf": both_sides(1), "to_world": cube},
        "floor": floor(-1.2, 3, both_sides(1)),
    }


def white_glass():
    mirror = {"type": "conductor", "material": "none"}
    return {
        "ball": glass(radius=0.8, center=[-0.7, 0.3, 0]),
        "mirror": {"type": "sphere", "radius": 0.6, "center": [0.9, 0, 0], "bsdf": mirror},
        "pane": square((0.3, 0.4, 1), ([0, 1, 0], 30), 0.6, {"type": "thindielectric"}),
        "floor": floor(-1.2, 3, both_sides(1)),
    }


@known("all", "power", of=[("matte", "box"), ("glass", "box"), ("matte", "gaussian")])
def white_furnace(objects, rfilter):
    shapes = white_matte() if objects == "matte" else white_glass()
    eye = camera(origin=(0, 0, 4), target=(0, 0, 0), fov=50, rfilter=rfilter)
    regions = ((pixels, 0.15),) if rfilter == "box" else ((border, 1.5e-2),)
    return Row(shapes | {"sensor": eye, "sky": sky()}, 1, 5e-3, more={"rr_depth": 5}, regions=regions)


@known("all", "default", of=("box", "gaussian"))
def sky_alone(rfilter):
    """Mitsuba 0.6 #80 was black without shapes; s = 0 and (1,1) meet in each pixel."""
    return Row({"sensor": camera(rfilter=rfilter), "sky": sky(0.7)}, 0.7, 5e-3, regions=((pixels, 0.1),))


@known("all", of=(100.0, 5.5))
def lens_beside_the_scene(far_clip):
    """Light subpaths from infinity start on a disk that covers the shapes, and the lens is none: t = 0 must
    not be counted beyond it (0.7 % of the sky was lost), nor where an object behind the far plane is in the
    way."""
    lens = camera("thinlens", (6, 0, 0), (0, 0, 0), 40, aperture_radius=0.8, focus_distance=6.0)
    ball = {"type": "sphere", "bsdf": matte(1)}
    scene = {"sensor": lens | {"far_clip": far_clip}, "ball": ball, "sky": sky()}
    return Row(scene, 1, 3e-3, 512, {"rr_depth": 5}, ((partial(blocks, 4), 1e-2),))


@known("all", of=(0, 130))
def meter_of_a_turned_sphere(angle):
    """With the wrong normals it was 59 % too dark."""
    turned = transform().rotate([0.26726124, 0.53452248, 0.80178373], angle).scale(0.5)
    scene = {"meter": {"type": "sphere", "to_world": turned, "sensor": meter()}, "sky": sky(0.7)}
    return Row(scene, 0.7 * np.pi, 0.01, 1 << 12, {"max_depth": 1})


@known("all", "default")
def distant_sensor_in_an_empty_scene():
    """Mitsuba's sensor starts its rays nowhere if there are no bounds."""
    eye = {"type": "distant", "direction": [0.2, 0.3, -1], "film": camera(size=1)["film"]}
    return Row({"sensor": eye, "sky": sky()}, 1, spp=16, more={"max_depth": 3})


@known("all", of=[(kind, far) for kind in ("constant", "envmap") for far in (False, True)])
def disk_under_a_sky(kind, far):
    """Mitsuba 0.6 #80: brightness depended on other objects. A small sphere far away makes the scene 30 times
    as large, out of the disk's sight."""
    light = (
        sky(0.8)
        if kind == "constant"
        else {"type": kind, "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.8, np.float32))}
    )
    to_world = transform().rotate([1, 0, 0], -90).scale(2)
    scene = {
        "sensor": camera(origin=(0, 3, 0), target=(0, 0, 0), fov=30, up=(0, 0, 1)),
        "disk": {"type": "disk", "bsdf": matte(0.5), "to_world": to_world},
        "sky": light,
    }
    scene |= {"far": {"type": "sphere", "center": [0, -60, 0], "bsdf": matte(0)}} if far else {}
    return Row(scene, 0.4, 0.01, 256, {"max_depth": 2}, layers={"s2t1": (0.4, 0.5 if far else 0.05)})


@known("all", "default", of=(False, True))
def mirror_in_a_blend(wrapped):
    """0.4 mirror and 0.6 matte of 0.5. Mitsuba's ``blendbsdf`` divides what its mirror reflects by the sum of
    its probability and of the matte part's density, so that `path` shows 0.64 to 0.66."""
    parts = {"a": matte(0.5), "b": {"type": "conductor", "material": "none"}}
    blend = {"type": "blendbsdf", "weight": 0.4, **parts}
    blend = {"type": "twosided", "nested": blend} if wrapped else blend
    scene = {"sensor": camera(origin=(0, 3, 3), target=(0, 0, 0), fov=30), "floor": floor(0, 100, blend)}
    return Row(scene | {"sky": sky()}, 0.7, 5e-3, 64, {"max_depth": 3}, seeds=8)


# -- one lamp, one surface ----------------------------------------------------------------------


@known("all", of=(3, 6))
def directional_light_on_a_wide_floor(size):
    """pbrt-v3 #69: a directional light was treated as point-like."""
    angle = np.deg2rad(40)
    direction = [float(np.sin(angle)), -float(np.cos(angle)), 0]
    scene = {
        "sensor": camera(origin=(0, 4, 0), target=(0, 0, 0), fov=40, up=(0, 0, 1)),
        "floor": floor(0, size, matte(0.5)),
        "sun": {"type": "directional", "irradiance": 3.0, "direction": direction},
    }
    expected = 0.5 * 3 * np.cos(angle) / np.pi
    alone = {"s1t2": (expected, 1e-3), "s2t1": (expected, 0.02)}
    return Row(scene, expected, 1e-3, 256, {"max_depth": 2}, ((partial(blocks, 8), 5e-3),), alone)


SPLATS = [(1, 2e-2, rfilter, border) for rfilter in ("gaussian", "mitchell") for border in (False, True)]
SPLATS += [(1, 2e-2, "lanczos", True), (1, 2e-2, "box", False), (10, 2.5e-3, "gaussian", False)]


@known("all", of=SPLATS)
def splats_alone(spp, tolerance, rfilter, sample_border):
    """A splat divided by the sum of the camera samples' filter weights is biased, for E[1/W] > 1/E[W]: by
    +5.7 and +0.5 % at 1 and 10 spp with the gaussian filter, +11 % at 1 spp with mitchell. A spot in a glass
    ball lights the sphere: with three edges t = 1 alone makes the image. The tolerance is below half of the
    bias."""
    film = {"sample_border": sample_border}
    spot = {"type": "spot", "cutoff_angle": 40, "beam_width": 39.99, "intensity": float(2 * np.pi / 0.96)}
    scene = {
        "sensor": camera(
            origin=(0, 0, -0.4), size=128 if spp == 1 else 192, rfilter=rfilter, near=1e-3, film=film
        ),
        "wall": sphere(),
        "glass": glass(radius=0.3),
        "lamp": spot | {"to_world": transform().look_at([0, 0, 0], [0, 0, -1], [0, 1, 0])},
    }
    return Row(scene, 1, tolerance, spp, {"max_depth": 3}, ((ring, 10 * tolerance),))


def squares_form_factor(h):
    """Between two unit squares, parallel and coaxial, at the distance ``h``."""
    x = 1 / h
    root = np.sqrt(1 + x * x)
    logarithm = np.log((1 + x * x) / np.sqrt(1 + 2 * x * x))
    return 2 / (np.pi * x * x) * (logarithm + 2 * x * root * np.arctan(x / root) - 2 * x * np.arctan(x))


@known("all", "power", of=(1e-3, 1e-2, 1, 100))
def parallel_plates(h):
    """From touching plates (only hits of the emitter work) to distant ones (only its samples do): a white
    plate seen through the hidden lamp, in a film that it fills."""
    scene = {
        "sensor": camera(
            origin=(0, 0, 2), target=(0, 0, 0), fov=float(np.rad2deg(2 * np.arctan(0.25))), near=1e-3
        ),
        "plate": square(size=0.5, bsdf=both_sides(1)),
        "lamp": square((0, 0, h), ([1, 0, 0], 180), 0.5, matte(0), emitter=area(1.0)),
    }
    return Row(scene, squares_form_factor(h), 6e-3, 256, {"max_depth": 2, "hide_emitters": True})


# -- media: transmittance -----------------------------------------------------------------------

COLOURS = np.array([0.9, 0.4, 0.1])  # extinction of `media_parts.coloured` at scale 1
ALBEDO = np.array([0.5, 0.8, 0.95])


def slab(medium, thickness=1.0, wide=1e4):
    """Between z = -``thickness`` and 0."""
    to_world = transform().translate([0, 0, -thickness / 2]).scale([wide, wide, thickness / 2])
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium}


def view(mu=1.0, fov=0.01, size=2):
    """A camera above the slab's middle that looks down at the cosine ``mu`` to the normal."""
    d = np.array([np.sqrt(1 - mu * mu), 0, mu]) * 3 / mu
    return camera(origin=d.tolist(), target=(0, 0, 0), fov=fov, size=size, near=1e-3) | {"far_clip": 1e5}


def absorbing(kind):
    """A medium without scattering and its extinction."""
    return {
        "gray": lambda: (fogs.fog(0.7, 0.0), np.full(3, 0.7)),
        "chromatic": lambda: (fogs.coloured(1.0) | {"albedo": 0.0}, COLOURS),
        "grid": lambda: (
            fogs.grid(np.full((4, 4, 4), 0.5), [-6, -6, -1], [12, 12, 1], 1.4, 0.0),
            np.full(3, 0.7),
        ),
    }[kind]()


@known(*MEDIA, of=[(kind, mu) for kind in ("gray", "chromatic", "grid") for mu in (1.0, 0.5)])
def slab_absorbs(kind, mu):
    """Flights that collide with nothing see the sky: the variance is e^-tau of its square."""
    medium, sigma = absorbing(kind)
    scene = {"sensor": view(mu, size=8), "slab": slab(medium, wide=5.0), "sky": sky()}
    return Row(scene, np.exp(-sigma / mu), 0.01, 4096, seeds=12)


@known(*MEDIA, of=("gray", "chromatic", "grid"))
def fog_between_lamp_and_wall(kind):
    """Connections evaluate T where walks sample it. The lamp is straight above what the camera sees."""
    medium, sigma = absorbing(kind)
    scene = {
        "sensor": camera(origin=(1, 0, -1.5), target=(0, 0, -2), fov=0.01, size=2, near=1e-3),
        "slab": slab(medium, wide=5.0),
        "plane": square((0, 0, -2), size=3),
        "lamp": {"type": "point", "position": [0, 0, 0.5], "intensity": 1.0},
    }
    return Row(scene, 0.5 / np.pi * np.exp(-sigma) / 2.5**2, 0.03, 16384, {"max_depth": 2}, seeds=12)


@known("default")
def grid_of_an_instance():
    """Mitsuba does not move grids with instances: the box is there, and its grid where it was."""
    medium = fogs.grid(np.ones((2, 2, 2)), [-0.5] * 3, 1.0, 3.0, 0.0)
    instance = {"type": "instance", "g": {"type": "ref", "id": "group"}}
    scene = {
        "group": {"type": "shapegroup", "box": fogs.box([-0.5] * 3, 1.0, interior=medium)},
        "instance": instance | {"to_world": transform().translate([2, 0, 0])},
        "sensor": camera(origin=(2, 0, 3), target=(2, 0, 0), fov=1, size=4),
        "sky": sky(),
    }
    return Row(scene, 1.0, 1e-3)


@known(*MEDIA)
def five_balls_before_a_lamp():
    """pbrt-v3 #69: interfaces counted as bounces. Ten boundaries of fog that absorbs, by paths of one
    edge."""
    balls = {f"{i}": fogs.ball("null", 0.1, (0, 0, 0.3 * i), interior=fogs.fog(0.6, 0.0)) for i in range(5)}
    lamp = square((0, 0, -2), bsdf=matte(0), emitter=area(1.0))
    scene = balls | {"sensor": camera(origin=(0, 0, 3), target=(0, 0, 0), fov=0.1, size=4), "lamp": lamp}
    return Row(scene, np.exp(-5 * 0.2 * 0.6), 0.01, 1024, {"max_depth": 1}, seeds=8)


@cache
def lit_face(sigma):
    """Mean radiance over the film of `face_in_fog`, of the plane z = 1 below a point at z = 2."""
    sensor = mi.load_dict(face_camera())
    u = mi.Point2f(*((np.indices((128, 128)).reshape(2, -1) + 0.5) / 128))
    rays, _ = sensor.sample_ray(0.0, 0.5, u, mi.Point2f(0.5))
    o, d = np.array(rays.o, dtype=np.float64), np.array(rays.d, dtype=np.float64)
    t = (1 - o[2]) / d[2]  # from the near plane, where the fog before the sensor begins
    r = np.linalg.norm((o + d * t).T - [0, 0, 2], axis=1)
    return np.mean(0.5 / np.pi * np.exp(-sigma * (r + t)) / r**3)


def face_camera():
    return camera(origin=(0.8, 0, 2.6), target=(0, 0, 1), fov=25, size=8, near=1e-3)


@known(*MEDIA)
def face_in_fog():
    """mitsuba3 #538, #552: connections that start on a boundary had the wrong medium. A matte cube of thick
    fog in thin fog: .5 / pi I cos e^(-sigma (r + d)) / r^2 over the film."""
    thin = {"type": "ref", "id": "thin"}
    scene = {
        "thin": fogs.fog(0.2, 0.0, id="thin"),
        "sensor": face_camera() | {"medium": thin},
        "cube": {"type": "cube", "bsdf": matte(0.5), "exterior": thin, "interior": fogs.fog(40.0, 0.0)},
        "lamp": {"type": "point", "position": [0, 0, 2], "intensity": 1.0},
    }
    return Row(scene, lit_face(0.2), 0.01, 1024, {"max_depth": 2}, seeds=12)


@known("all")
def face_in_fog_by_splats():
    row = face_in_fog()
    return row._replace(layers={"s2t1": (row.expected, 0.03)})


BOUNDARIES = {
    "null": lambda: {"type": "null"},
    "mask": lambda: {"type": "mask", "opacity": 0.3, "bsdf": matte(0)},
}


@known("all", "camera", of=BOUNDARIES)
def hidden_lamp_in_fog(boundary):
    """``hide_emitters`` concerns the camera's first edge, which goes on through null surfaces: a wall is seen
    through a ball of fog, the lamp in it and what two masks let pass."""
    scene = {
        "sensor": camera(origin=(0, 0, 4), target=(0, 0, 0), fov=0.2, size=2),
        "ball": fogs.ball(BOUNDARIES[boundary](), 1.0, (0, 0, 0), interior=fogs.fog(0.5, 0.0)),
        "lamp": fogs.lamp(center=[0, 0, 0], radius=0.4, emitter=area(1e-6)),
        "wall": square((0, 0, -2), bsdf=matte(0.8)),
        "point": fogs.point(position=[0, 0, -1.5]),
    }
    expected = 0.8 / np.pi / 0.5**2 * (0.7**2 if boundary == "mask" else 1.0) * np.exp(-1.0)
    return Row(scene, expected, 0.05, 1 << 14, {"max_depth": 2, "hide_emitters": True}, seeds=8)


# -- media: one scattering ----------------------------------------------------------------------


@known(*MEDIA, of=("gray", "chromatic"))
def slab_under_the_sun(kind):
    """albedo rho E mu0 / (mu + mu0) (1 - exp(-tau (1 / mu + 1 / mu0))), rho of hg (S. Chandrasekhar,
    "Radiative Transfer", 1950)."""
    mu, mu0, g = 0.8, 0.6, 0.3
    medium = fogs.fog(0.9, 0.8) if kind == "gray" else fogs.coloured(1.0)
    tau, albedo = (np.full(3, 0.9), 0.8) if kind == "gray" else (COLOURS, ALBEDO)
    light = np.array([np.sqrt(1 - mu0 * mu0), 0.0, -mu0])
    sun = {"type": "directional", "direction": light.tolist(), "irradiance": 2.0}
    scene = {"sensor": view(mu, fov=0.5, size=1), "slab": slab(medium, wide=8.0), "sun": sun}
    cos = np.array([np.sqrt(1 - mu * mu), 0, mu]) @ light
    rho = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cos) ** 1.5)
    expected = albedo * rho * 2 * mu0 / (mu + mu0) * (1 - np.exp(-tau * (1 / mu + 1 / mu0)))
    return Row(scene, expected, 0.05, 1 << 14, {"max_depth": 2}, seeds=12)


# -- media: all orders of scattering ------------------------------------------------------------


@known(*MEDIA, of=("gray", "chromatic", "grid", "glass"))
def white_fog(kind):
    """Albedo 1 under an even sky."""
    medium = {
        "gray": lambda: fogs.fog(4, 1.0),
        "glass": lambda: fogs.fog(4, 1.0),
        "chromatic": lambda: fogs.coloured(8.0) | {"albedo": 1.0},
        "grid": lambda: fogs.grid(np.random.default_rng(0).random((5, 5, 5)), [-0.5] * 3, 1.0, 8.0, 1.0),
    }[kind]()
    shape = fogs.ball("dielectric" if kind == "glass" else "null", 0.6, (0, 0, 0), interior=medium)
    shape = fogs.box([-0.5] * 3, 1.0, interior=medium) if kind == "grid" else shape
    eye = camera(origin=(0, 0.3, 3), target=(0, 0, 0), fov=25, size=8)
    regions = ((partial(blocks, 4), 0.07),)
    scene = {"sensor": eye, "shape": shape, "sky": sky()}
    return Row(scene, np.ones(3), 0.02, 256, {"max_depth": 256}, regions, seeds=12)


@known(*MEDIA)
def glowing_sphere_of_fog():
    """As without fog, with roulette."""
    glowing = fogs.wall(bsdf=matte(0.5), emitter=area(0.5))
    scene = {"sensor": camera(near=0.1, medium=fogs.fog(1.5, 1.0)), "wall": glowing}
    return Row(scene, 1.0, 0.01, 256, {"rr_depth": 5}, seeds=12)


@known("all", of=("mesh", "cube", "rectangles"))
def glowing_walls_that_bound_fog(kind):
    """The medium that light starts in is that on its side of the wall, by the geometric normal of hits.
    Samples report another one on meshes with interpolated normals that are flipped, and on mirrored cubes and
    rectangles. Fog of albedo 1 within, fog that absorbs without; light that starts in the other leaves
    0.6."""
    mirrored = transform().scale([-1, 1, 1])
    glowing = {"bsdf": matte(0), "emitter": area(1.0)}
    inside, outside = ({"type": "ref", "id": name} for name in ("inside", "outside"))
    cube = {
        "type": "cube",
        "to_world": mirrored,
        "flip_normals": True,
        "exterior": outside,
        "interior": inside,
    }
    turns = [([0, 1, 0], angle) for angle in (0, 90, 180, 270)] + [([1, 0, 0], 90), ([1, 0, 0], 270)]
    walls = {
        "mesh": lambda: [ball_mesh(4) | {"flip_normals": True, "exterior": inside, "interior": outside}],
        "cube": lambda: [cube],
        "rectangles": lambda: [
            {"type": "rectangle", "to_world": transform().rotate(*turn).translate([0, 0, -1]) @ mirrored}
            | {"interior": inside, "exterior": outside}
            for turn in turns
        ],
    }[kind]()
    scene = {"inside": fogs.fog(1.5, 1.0, id="inside"), "outside": fogs.fog(0.05, 0.0, id="outside")}
    scene["sensor"] = camera(near=0.1, medium=inside, size=8)
    scene |= {f"wall {i}": wall | glowing for i, wall in enumerate(walls)}
    return Row(scene, 1.0, 0.02, 256, {"max_depth": 64}, seeds=12)


def coloured_grid():
    """A grid of even extinction `COLOURS` around the unit sphere."""
    values = np.broadcast_to(COLOURS.astype(np.float32), (2, 2, 2, 3))
    medium = fogs.grid(np.zeros((2, 2, 2)), [-1.1] * 3, 2.2, 1.0, 0.0)
    medium["sigma_t"] |= {"raw": True, "grid": mi.VolumeGrid(np.ascontiguousarray(values))}
    return medium


def spiky_grid():
    """A grid whose mean extinction is a ninth of its majorant, which T~ must not take for it."""
    return fogs.grid(np.random.default_rng(1).random((6, 6, 6)) ** 8, [-1.1] * 3, 2.2, 9.0, 1.0)


METERS = {
    "gray": (lambda: fogs.fog(1.0, 1.0), 1.0),
    "chromatic": (lambda: fogs.coloured(1.0) | {"albedo": 1.0}, 1.0),
    "chromatic, absorbing": (lambda: fogs.coloured(1.0) | {"albedo": 0.0}, np.exp(-COLOURS)),
    "grid": (lambda: fogs.grid(np.full((2, 2, 2), 1.0), [-1.1] * 3, 2.2, 1.0, 1.0), 1.0),
    "coloured grid": (coloured_grid, np.exp(-COLOURS)),
    "spiky grid": (spiky_grid, 1.0),
}


def meter_around_a_lamp(medium, **more):
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": 1.0}
    return {"wall": fogs.wall(bsdf=matte(0), sensor=meter(medium=medium)), "lamp": lamp, **more}


@known("all", of=METERS)
def meter_in_fog(kind):
    """t = 0 and the last edge of light subpaths, which ends before the flight does (in coloured grids there
    is none): of albedo 1 all light arrives on the black sphere, which camera subpaths alone cannot find."""
    medium, expected = METERS[kind]
    return Row(meter_around_a_lamp(medium()), expected * np.ones(3), 0.02, 1 << 15, seeds=12)


@known("all")
def meter_behind_a_mask():
    """The weight of t = 0 has T~ of its whole last edge, which goes on through null lobes."""
    mask = fogs.ball(BOUNDARIES["mask"](), 0.6, (0, 0, 0))
    scene = meter_around_a_lamp(fogs.fog(1.0, 0.0), mask=mask)
    return Row(scene, 0.7 * np.exp(-1.0), 0.03, 1 << 13, {"max_depth": 2}, seeds=8)


def chandrasekhar(albedo, mu, n=64):
    """1 - sqrt(1 - albedo) H(mu): what a half space that scatters evenly reflects of an even light, H by
    iteration of 1 / H(mu) = sqrt(1 - a) + a / 2 int x H(x) / (mu + x) dx ("Radiative Transfer", section
    37)."""
    x, w = np.polynomial.legendre.leggauss(n)
    x, w = (x + 1) / 2, w / 2
    h = np.ones(n)
    root = np.sqrt(1 - albedo)
    for _ in range(500):
        h = 1 / (root + albedo / 2 * ((w * x * h) / (x[:, None] + x)).sum(1))
    return 1 - root / (root + albedo / 2 * (w * x * h / (mu + x)).sum())


@known(*MEDIA, of=(1.0, 0.5))
def half_space(mu):
    """A slab of optical thickness 50 and albedo .8; its far side is e^-50 away."""
    scene = {"sensor": view(mu, size=4), "slab": slab(fogs.fog(50, 0.8, 0.0), wide=100.0), "sky": sky()}
    return Row(scene, chandrasekhar(0.8, mu), 0.015, 1024, {"max_depth": 200}, seeds=12)


# -- lamps and sensors to which `path` is blind ---------------------------------------------------


def below_a_beam(sensor):
    """A directionalarea of radiance 2, 3, 4 that shines straight down on a floor of reflectance 0.6, which
    has the power L A (Mitsuba's convention)."""
    lamp = square((0, 1.5, 0), DOWNWARDS, 0.5, matte(0), emitter=BEAM)
    return {"sensor": sensor, "floor": floor(0, 2, both_sides(0.6)), "lamp": lamp}


BEAM = {"type": "directionalarea", "radiance": rgb(2, 3, 4)}
LIT = 0.6 / np.pi * np.array([2.0, 3.0, 4.0])
ABOVE = {"origin": (1.5, 1, 0), "target": (0, 0, 0), "size": 8}
ONTO = transform().look_at([1.5, 1, 0], [0, 0, 0], [0, 1, 0]).scale([0.2, 0.2, 1])
VIEWS = {
    "perspective": lambda: camera(fov=12, **ABOVE),
    "thinlens": lambda: thinlens(aperture_radius=0.05, focus_distance=1.8, fov=12, **ABOVE),
    "orthographic": lambda: {"type": "orthographic", "to_world": ONTO, "film": camera(size=8)["film"]},
}


@known("all", of=VIEWS)
def floor_below_a_directionalarea(kind):
    """All of the view is lit."""
    more = {"max_depth": 2}
    return Row(below_a_beam(VIEWS[kind]()), LIT, 0.03, 2048, more, ((partial(blocks, 4), 0.06),), seeds=12)


@known("all")
def directionalarea_seen_from_afar():
    """The mean over the disk that covers the scene's bounding sphere: the lit square's radiance times A cos /
    (pi R^2)."""
    parallel = {"type": "distant", "direction": [-1, -1, 0], "film": camera(size=1)["film"]}
    scene = below_a_beam(parallel)
    radius = load(**scene).bbox().bounding_sphere().radius * (1 + 1500 * 2.0**-24)  # Mitsuba's RayEpsilon
    return Row(scene, LIT / np.sqrt(2) / (np.pi * radius**2), 0.03, 1 << 14, {"max_depth": 2}, seeds=12)


# A meter of half-width 0.4 that faces up, and lamps above it.
UPWARDS_METER = {"type": "rectangle", "to_world": transform().rotate(*UPWARDS).scale(0.4)}
DOWN = transform().look_at([0.2, 1, 0], [0, 0, 0], [0, 0, 1])


def above(emitter):
    return square((0.2, 1, 0), DOWNWARDS, 0.7, matte(0), emitter=emitter)


SPOT = {"type": "spot", "intensity": 3.0, "cutoff_angle": 40, "beam_width": 39.9, "to_world": DOWN}
# And the strategies that see each directly.
LAMPS_ABOVE = {
    "rectangle": (lambda: above(area(2.0)), (0, 1, 2)),
    "point": (lambda: {"type": "point", "position": [0.2, 1, 0], "intensity": 3.0}, (1, 2)),
    "spot": (lambda: SPOT, (1, 2)),
    "projector": (lambda: {"type": "projector", "irradiance": 1.0, "fov": 60, "to_world": DOWN}, (1, 2)),
    "directional": (lambda: {"type": "directional", "direction": [0.6, -0.8, 0], "irradiance": 3.0}, (1, 2)),
    "constant": (lambda: sky(0.7), (0, 1, 2)),
    "directionalarea": (lambda: above({"type": "directionalarea", "radiance": 2.0}), (2,)),
}


def irradiance_above(lamp):
    """Mean irradiance of the meter under a lamp of `LAMPS_ABOVE`: integrals over grids of midpoints."""
    middle = (np.arange(40) + 0.5) / 20 - 1
    x, z = (0.4 * v for v in np.meshgrid(middle, middle))
    if lamp in ("constant", "directional", "directionalarea"):  # below which is all of the meter
        return {"constant": 0.7 * np.pi, "directional": 3.0 * 0.8, "directionalarea": 2.0}[lamp]
    if lamp == "rectangle":
        u, v = (0.7 * v for v in np.meshgrid(middle, middle))
        to = [a[..., None, None] - b for a, b in ((x, 0.2 + u), (z, v))]
        dist2 = to[0] ** 2 + to[1] ** 2 + 1
        return 2.0 * np.mean(1 / dist2**2) * 1.4**2
    dist2 = (x - 0.2) ** 2 + z**2 + 1
    intensity = 3.0
    if lamp == "projector":
        axis = np.array([-0.2, -1, 0]) / np.hypot(0.2, 1)
        cos = ((x - 0.2) * axis[0] - axis[1]) / np.sqrt(dist2)
        intensity = np.pi / cos**3
    return np.mean(intensity / dist2**1.5)


@known("all", of=LAMPS_ABOVE)
def meter_below(lamp):
    """What a sensor with area sees of a lamp directly has strategies of its own."""
    make, strategies = LAMPS_ABOVE[lamp]
    answer = irradiance_above(lamp)
    scene = {"plate": UPWARDS_METER | {"sensor": meter()}, "lamp": make()}
    layers = {f"s{s}t{2 - s}": (answer, 0.1) for s in strategies}
    return Row(scene, answer, 0.05, 1 << 14, {"max_depth": 1}, layers=layers, seeds=12)


@known("all")
def point_before_a_lens():
    """A disk on the film: the mean over the lens of I / d^2 times the density of directions, 1 / (A cos^3), A
    being the film's area at distance 1."""
    view = {"origin": (0, 0, 0), "target": (0, 0, 1), "fov": 50, "size": 8}
    lens = thinlens(aperture_radius=0.4, focus_distance=3.0, **view)
    lamp = {"type": "point", "position": [0.1, 0.05, 1.5], "intensity": 2.0}
    r, phi = np.meshgrid(0.4 * np.sqrt((np.arange(200) + 0.5) / 200), 2 * np.pi * np.arange(200) / 200)
    dist2 = (0.1 - r * np.cos(phi)) ** 2 + (0.05 - r * np.sin(phi)) ** 2 + 1.5**2
    cos = 1.5 / np.sqrt(dist2)
    answer = np.mean(2.0 / dist2 / (4 * np.tan(np.deg2rad(25)) ** 2 * cos**3))
    layers = {"s1t1": (answer, 0.1), "s2t0": (answer, 0.1)}
    return Row(
        {"sensor": lens, "lamp": lamp}, answer, 0.05, 1 << 13, {"max_depth": 1}, layers=layers, seeds=12
    )


@known.test
def test_known_answer(make, way):
    row = make()
    check = partial(st.check_known, rounding=row.rounding)
    layered = {"layers": "strategies"} if row.layers else {}
    method = integrator(**WAYS[way] | layered | row.more)
    images = renders(load(**row.scene), method, row.spp, row.seeds, 10)
    image = images[..., :3] if np.ndim(row.expected) else images[..., :3].mean(-1)
    if row.expected is not None:
        check(image.mean((1, 2)), row.expected, row.tolerance)
    for region, tolerance in row.regions:
        check(region(image), np.broadcast_to(row.expected, region(image).shape[1:]), tolerance)
    for name, (expected, tolerance) in row.layers.items():
        edges = name if isinstance(name, int) else 0
        names = (
            [f"weighted.s{s}t{edges + 1 - s}" for s in range(edges + 2)] if edges else [f"unweighted.{name}"]
        )
        present = [n for n in names if f"{n}.R" in method.aov_names()]
        check(sum(layer(images, method, n) for n in present).mean((1, 2, 3)), expected, tolerance)


@pytest.mark.parametrize("skip", ["none", "auto"])
@pytest.mark.parametrize("shapes", [dict, white_matte], ids=["empty", "shapes"])
def test_a_scene_without_emitters_is_black(shapes, skip):
    image = np.array(integrator(skip=skip, max_depth=4).render(load(sensor=camera(), **shapes()), spp=4))
    assert image.shape == (16, 16, 3) and np.all(image == 0)


def test_seeds_are_evaluated():
    """The test sees an error of one percent, and refuses noise."""
    rng = np.random.default_rng(1)
    values = 1 + 1e-3 * rng.standard_normal((24, 5))
    check(values, 1, 3e-3)
    with pytest.raises(AssertionError, match="allowed"):
        check(values, 1.01, 3e-3)
    with pytest.raises(AssertionError, match="is not seen"):
        check(1 + rng.standard_normal((24, 5)), 1, 3e-3)
