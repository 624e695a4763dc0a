"""Two estimates of one image: a table of scenes, ways to render them, and a reference.

The reference is Mitsuba's integrator where it converges, else other strategies of ours. Statistic: Welch's
t-test of tile means over seeds, which differ between the two sides, with Šidák's correction and uniformity of
p-values (`welch`). The standard error of the difference of the images' means, over the mean, is below a row's
``error``.
"""

import json
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import media_parts as fogs
import mitsuba as mi
import numpy as np
import scene_parts as parts
import sds_scenes as sds
import variants
import welch as st
from meshes import as_ply, ball_mesh, folder
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.transport import mis
from sds_scenes import guided, under_glass
from tables import Table
from test_strategies import SURFACES

import scenes
from scenes import (
    DOWNWARDS,
    area,
    both_sides,
    camera,
    floor,
    integrator,
    matte,
    renders,
    square,
    thinlens,
    transform,
)

ROOT = Path(__file__).resolve().parents[2] / "scenes"
CHANNELS = np.array([0.5, 1.0, 1.5])  # one number per pixel that sees every channel

NOT_GUIDED = {"guiding": "emission"}
WAYS = {
    "all": {"skip": "none"},
    "default": {},
    "camera": {"light_paths": 0},
    "power": {"heuristic": "power"},
    "quarter": {"light_paths": 0.25},
    "one vertex": {"stored_vertices": 1},
    "two vertices": {"stored_vertices": 2},
    "three vertices": {"stored_vertices": 3},
    "no connections": {"connections": "none"},
    "one connection": {"connections": "one"},
    "all connections": {"connections": "all"},
    "impossible": {"skip": "impossible"},
    "independent": {"points": "independent"},
    "roulette": {"rr_depth": 1},
    "hidden": {"hide_emitters": True},
    "always": {"guiding": "always"},
    "guided 1": {"decisions": guided(1)},
    "guided 4": {"decisions": guided(4)},
    "merged": {"merging": True, "merging_radius": 0.25},
    "wide discs": {"merging": True, "merging_radius": 0.5},
    "small balls": {"merging": True, "merging_radius": 0.05},
}


class Row(NamedTuple):
    """A scene, its parts or loaded; how it is rendered, and by what it is judged.

    ``more``: parameters of both sides, ``ours`` of one. ``judge``: parameters of the reference and its
    ``kind``; ``other``: its scene if that is another. ``patched``: module, name and value for our side alone.
    """

    scene: object
    judge: dict
    depth: int = 4
    spp: int = 64
    judge_spp: int = 256
    seeds: int = 10
    more: dict = {}
    ours: dict = {}
    other: object = None
    tile: int = 4
    error: float = 0.05
    patched: tuple = ()
    judge_seed: int = 5000


same = Table()
PATH, VOLPATH, VOLPATHMIS = ({"kind": kind} for kind in ("path", "volpath", "volpathmis"))
EVERYTHING = {"skip": "none"}


def loaded(scene):
    return mi.load_dict({"type": "scene"} | scene) if isinstance(scene, dict) else scene


def tiles(images, size):
    """(seeds, tiles, channels) of the image; of a film that is no multiple of ``size`` the whole."""
    images = images[..., : 3 if images.shape[-1] >= 3 else 1]
    if images.shape[1] % size or images.shape[2] % size:
        return images.mean((1, 2))[:, None]
    return st.tiles(images, size).reshape(len(images), -1, images.shape[-1])


def compared(a, b):
    """Tiles of all channels together, and each channel's mean: a wrong hue may leave their sum alone."""
    weights = CHANNELS if a.shape[2] == 3 else np.ones(1)
    family = [st.compare_images(a @ weights, b @ weights)]
    if a.shape[2] == 3 and np.ptp(b, axis=2).max() > 1e-4 * b.max():
        family.append(st.welch(a.mean(1), b.mean(1), labels=list("RGB")))
        family[1].continuous[:] = False  # channels share their paths
    return st.Comparisons.join(family)


judged = {}


def reference(key, row, scene):
    """Tiles of the reference, once for all ways."""
    if key not in judged:
        scene = scene if row.other is None else loaded(row.other)
        method = integrator(**{"max_depth": row.depth} | row.more | row.judge)
        judged[key] = tiles(renders(scene, method, row.judge_spp, row.seeds, row.judge_seed), row.tile)
    return judged[key]


# -- surfaces, beside `path` --------------------------------------------------------------------


def file(name, resolution=16, **parameters):
    if name == "veach_mis":
        parameters["resolution_y"] = resolution
    return mi.load_file(str(ROOT / f"{name}.xml"), resolution=resolution, **parameters)


CONVERGING = {"cornell_box": 6, "uplight_room": 4, "veach_mis": 3, "open_sky": 5, "many_lights": 4}


@same("all", "default", of=CONVERGING)
def scene_file(name):
    return Row(file(name), PATH, CONVERGING[name], 32, 128, 24)


@same("all, one connection", "all, quarter", "default", of=("glass_caustics", "lamp_behind_glass"))
@same("default", of=("veach_bidir",))
def without_path(name):
    """`path` misses most of the light: caustics of small and of delta lamps, a spot that shines through an
    egg."""
    return Row(file(name), EVERYTHING, 5 if name == "veach_bidir" else 6, 32, 32, 24)


@same("all, no connections", of=("glass_caustics", "veach_bidir"))
def by_light_tracing(name):
    """s = 0, s = 1 and t = 1 make all paths of these."""
    return without_path(name)._replace(spp=64)


GLASS_AND_METAL = [
    *("all, power", "all, quarter", "all, no connections", "all, camera", "all, two vertices", "impossible"),
    *("all, three vertices, quarter", "impossible, power, all connections", "all, one connection"),
    "all, independent, quarter",
]


@same(*GLASS_AND_METAL)
def glass_and_metal():
    return Row(SURFACES["glass and metal"].parts(), PATH, 5, 64, 128, 24)


@same("default")
def curve_and_grid():
    """Shapes that cannot emit: Mitsuba's virtual calls visit every live instance; one on shapes'
    sample_position fails as soon as a curve exists."""
    points = "\n".join(f"{x:.3f} {-0.2 + 0.2 * x:.3f} 0.6 0.12" for x in np.linspace(-0.7, 0.7, 6))
    path = folder() / "curve.txt"
    path.write_text(points + "\n")
    z, y, x = np.meshgrid(*[np.linspace(0, 1, 12)] * 3, indexing="ij")
    ball = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.3
    scene = {k: v for k, v in mi.cornell_box().items() if k not in ("small-box", "large-box")}
    scene["sensor"] = scene["sensor"] | {"film": camera()["film"]}
    metal = {"type": "roughconductor", "alpha": 0.3}
    scene["curve"] = {"type": "bsplinecurve", "filename": str(path), "bsdf": metal}
    grid = {"type": "sdfgrid", "grid": mi.TensorXf(ball[..., None].astype(np.float32)), "bsdf": matte(0.8)}
    scene["grid"] = grid | {"to_world": transform().translate([-0.6, -1, -0.5]).scale(0.9)}
    return Row(scene, PATH, 4, 16, 32, 16)


@same("all")
def blend_from_behind():
    """A point light in a ball of frosted glass and matte parts: what one part draws from behind Mitsuba's
    blend keeps as a direction of the other; light subpaths found twice the light. `path` meets the ball from
    outside."""
    blend = {
        "type": "blendbsdf",
        "weight": 0.5,
        "a": {"type": "roughdielectric", "alpha": 0.3},
        "b": matte(0.5),
    }
    scene = {
        "sensor": camera(origin=(0, 1.2, 4), target=(0, 0, 0), fov=30),
        "floor": floor(),
        "ball": {"type": "sphere", "center": [0, 1, 0], "radius": 0.5, "bsdf": blend},
        "light": {"type": "point", "position": [0, 1, 0], "intensity": 5.0},
    }
    return Row(scene, PATH, 3, 256, 1024, 8)


def bumpy_sphere(kind):
    """Bumps or a normal map inside of a sphere. By default Mitsuba turns normals that face away from the
    camera; a walk from the light then cannot sample all that the camera side sees."""
    y, x = np.mgrid[0:64, 0:64] / 64 * 2 * np.pi
    height = 0.5 + 0.15 * (np.sin(6 * x) + np.sin(5 * y) + np.sin(3 * x + 4 * y))
    n = np.stack([0.4 * np.sin(4 * x), 0.4 * np.sin(3 * y), np.ones_like(x)], axis=-1)
    n = 0.5 + 0.5 * n / np.linalg.norm(n, axis=-1, keepdims=True)
    values = height[..., None] if "bumpmap" in kind else n
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(values.astype(np.float32)), "raw": True}
    texture = {"type": "bumpmap", "height": bitmap, "scale": 0.3}
    texture = texture if "bumpmap" in kind else {"type": "normalmap", "normalmap": bitmap}
    texture |= {"flip_invalid_normals": False} if kind.endswith("unflipped") else {}
    return {
        "sensor": camera(origin=(0, -0.6, 0), target=(0.3, 0.2, -1), fov=70, near=1e-3),
        "wall": {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": texture | {"bsdf": matte(0.7)}}},
        "lamp": {"type": "point", "position": [0.1, 0.3, 0.2], "intensity": 3.0},
    }


BUMPS = "bumpmap", "normalmap", "bumpmap unflipped", "normalmap unflipped"


@same("all", of=BUMPS)
def bumpy_surface(kind):
    """mitsuba3 #42, #45: the light tracer was brighter than `path`."""
    return Row(bumpy_sphere(kind), PATH, 3, 256, 512, 16, error=0.005)


def coarse_ball():
    spot = {"type": "spot", "intensity": 40.0, "cutoff_angle": 25}
    return {
        "sensor": camera(origin=(0, 1, 5), target=(0, 0, 0), fov=35),
        "ball": ball_mesh(1) | {"bsdf": both_sides(0.8)},
        "floor": floor(-1.2, 2, both_sides(0.5)),
        "lamp": spot | {"to_world": transform().look_at([3, 4, 1], [0, -0.5, 0], [0, 1, 0])},
    }


@same("all")
def coarse_mesh():
    """pbrt-v4 #385, #526, #13: without the adjoint factor interpolated normals are too shiny on the light
    side."""
    return Row(coarse_ball(), PATH, 4, 256, 512, 16)


def under_a_disk(origin=(0, 2, 3), **more):
    """A bright disk that looks down, and a camera."""
    down = transform().translate([0, 2.5, 0]).rotate(*DOWNWARDS).scale(0.5)
    lamp = {"type": "disk", "to_world": down, "bsdf": matte(0), "emitter": area(5.0)}
    return {"lamp": lamp, "sensor": camera(origin=origin, target=(0, 0, 0), fov=50), **more}


@same("all")
def light_on_a_hidden_lamp():
    """Camera rays pass through a lamp under ``hide_emitters``: what its surface reflects is not seen."""
    screen = floor(0.3, 0.6, matte(0.8), emitter=area(0.5))
    scene = under_a_disk(screen=screen, floor=floor(0, 2, matte(0.8)))
    return Row(scene, WAYS["camera"], 4, 64, 64, 16, WAYS["hidden"])


@same("all", "camera")
def ball_behind_a_hidden_lamp():
    """`path` shades what lies behind a hidden lamp at a wrong point of spheres (a ninth of it). The pole of a
    matte ball is seen through the lamp above it as from below the lamp."""

    def pole(height):
        view = camera(origin=(0, height, 0), target=(0, 0, 0), up=(0, 0, 1), size=4, fov=0.3 / height)
        lamp = square((0, 2, 0), DOWNWARDS, 0.8, emitter=area(4.0))
        return {"lamp": lamp, "ball": scenes.ball(matte()), "sensor": view}

    return Row(pole(6.0), WAYS["camera"], 4, 256, 256, 16, WAYS["hidden"], other=pole(1.5), error=0.01)


@same("default", of=[(3, 1), (5, 3)])
def splats_on_a_film_of(width, height):
    """Where S does not divide the samples, there are more light subpaths than 1/S of them: of three pixels
    with S = 16, one for each three samples."""
    scene = {
        "ball": scenes.ball({"type": "dielectric"}, 0.2, (0, 1, 0)),
        "lamp": {"type": "point", "position": [0, 1.05, 0]},
        "floor": floor(0, 2, matte(0.8)),
        "sensor": camera(origin=(0, 2, 3), target=(0, 0, 0), fov=50, film={"width": width, "height": height}),
    }
    few = {"light_paths": 1 / 16}
    return Row(scene, {"light_paths": 1}, 4, 63, 63, 16, {"connections": "one"}, few, error=0.1)


@same("all")
def point_light_in_a_cornell_box():
    """Mitsuba 0.6 #132: a point light seen by a pinhole made one pixel above 80,000."""
    scene = mi.cornell_box() | {"sensor": mi.cornell_box()["sensor"] | {"film": scenes.film()}}
    scene["light"] = {"type": "point", "position": [0.1, 0.5, 0.1], "intensity": 1.0}
    return Row(scene, PATH, 5, 64, 128)


@same("all")
def lamp_of_many_triangles():
    """pbrt-v4 #183: one light for each of a million triangles took nine kilobytes each. As one rectangle."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, 101)] * 2)
    first = (np.arange(100)[:, None] * 101 + np.arange(100)).ravel()
    corner, above = first + 1, first + 101
    faces = np.concatenate([np.stack([first, above, corner], 1), np.stack([corner, above, above + 1], 1)])
    mesh = as_ply(np.stack([x, y, 0 * x], -1).reshape(-1, 3), faces)

    def under(lamp):
        return {
            "lamp": lamp | {"emitter": area(2.0), "bsdf": both_sides(0)},
            "floor": square((0, 0, -2), size=2, bsdf=both_sides(0.5)),
            "sensor": camera(origin=(0, -5, -0.7), target=(0, 0, -1), fov=45, size=8, up=(0, 0, 1)),
        }

    return Row(under(mesh), EVERYTHING, 2, 64, 64, other=under(square(turn=([1, 0, 0], 180))))


@same("all")
def own_lamp():
    """An emitter of a class that the package does not know takes part by Mitsuba's calls alone: as a point
    light."""
    parts.register_plugins()
    scene, other = (parts.open_scene(lamp=parts.EMITTERS[name]()) for name in ("own lamp", "point"))
    return Row(scene, EVERYTHING, 3, 128, 128, 12, other=other)


@same("all")
def own_sky():
    parts.register_plugins()
    return Row(parts.open_scene(lamp=parts.EMITTERS["own sky"]()), WAYS["camera"], 3, 128, 128, 12)


# -- colours ------------------------------------------------------------------------------------


def lamps():
    """Coloured lamps of three kinds in a closed room, seen through a lens. The point lamps are behind the
    sensor, for ``path`` does not see them directly."""
    glow = {"type": "spectrum", "value": [(400, 1), (500, 3), (600, 6), (700, 8)]}
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.3}
    spot = {"type": "spot", "intensity": scenes.rgb(3, 1, 0.5), "cutoff_angle": 40, "beam_width": 20}
    return {
        "sensor": thinlens(),
        "wall": fogs.wall(),
        "gold": fogs.ball(gold),
        "lamp": fogs.lamp(emitter=area(glow)),
        "point": {"type": "point", "position": [0.1, 0.2, 0.55], "intensity": scenes.rgb(0.1, 0.4, 0.9)},
        "spot": spot | {"to_world": transform().look_at([-0.2, 0.2, 0.6], [-0.1, -0.3, -1], [0, 1, 0])},
    }


def outside(**more):
    """A coloured floor with a ball of glass and one of plastic."""
    plastic = {"type": "plastic", "diffuse_reflectance": scenes.rgb(0.6, 0.1, 0.2)}
    return {
        "sensor": camera(origin=(0, 1.2, 4), target=(0, 0.3, 0), fov=35),
        "floor": floor(0, 3, matte(0.2, 0.5, 0.7)),
        "glass": fogs.ball({"type": "dielectric", "int_ior": "bk7"}, 0.5, (-0.6, 0.55, 0)),
        "plastic": fogs.ball(plastic, 0.5, (0.6, 0.55, -0.2)),
        **more,
    }


def picture(height, width, seed):
    """A bitmap of smooth colours between 0.1 and 0.9."""
    phase = np.random.default_rng(seed).random((2, 3)) * 2 * np.pi
    lines = (np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (height, width))
    y, x = np.meshgrid(*lines, indexing="ij")
    value = 0.5 + 0.4 * np.sin(x[..., None] + phase[0]) * np.cos(y[..., None] + phase[1])
    return mi.Bitmap(value.astype(np.float32))


def textures():
    """A coloured surrounding, and a lamp that is a picture."""
    glow = area({"type": "bitmap", "bitmap": picture(8, 8, 2)})
    lamp = square((0, 1.6, -1.2), ([1, 0, 0], 30), 0.7, matte(0), emitter=glow)
    return outside(around={"type": "envmap", "bitmap": picture(8, 16, 1)}, lamp=lamp)


COLOURED = {
    "lamps": lamps,
    "sky": lambda: outside(sky={"type": "constant", "radiance": scenes.rgb(0.5, 0.8, 1.1)}),
    "textures": textures,
}


@same("all", of=[(variant, name) for variant in ("mono", "spectral") for name in COLOURED])
def coloured(variant, name):
    """Emission, next-event estimation, splats and connections each evaluate spectra themselves."""
    mi.set_variant(variants.of(variant))
    return Row(COLOURED[name](), PATH, 5, 64, 256, 24)


CHROMATIC = {
    "room": lambda: fogs.foggy(fogs.coloured()),
    "ball": lambda: fogs.room(light=fogs.point(), ball=fogs.ball(interior=fogs.coloured(6.0))),
}


@same("all", of=[(variant, name) for variant in ("mono", "spectral") for name in CHROMATIC])
def chromatic_fog(variant, name):
    """Spectral variants have wavelengths of each sample, for which a medium has no table."""
    mi.set_variant(variants.of(variant))
    return Row(CHROMATIC[name](), VOLPATHMIS, 3, 128, 256, 12)


# -- media, beside `volpath` --------------------------------------------------------------------


def lit(**more):
    """A room lit by a point: behind null boundaries `volpath` is wrong under lamps with an area."""
    return fogs.room(light=fogs.point(), **more)


def hg(g):
    return {"type": "hg", "g": g}


PHASES = {
    "isotropic": {"type": "isotropic"},
    "rayleigh": {"type": "rayleigh"},
    "tabphase": {"type": "tabphase", "values": "0.2, 0.1, 0.5, 1.5, 0.4"},
    "blendphase": {"type": "blendphase", "weight": 0.3, "a": hg(0.7), "b": hg(-0.5)},
    "own_phase": {"type": "own_phase"},
}


@same("all", of=PHASES)
def phase_function(name):
    """Phase functions are evaluated in both directions by calls of their own, whose conventions (which way
    ``wi`` points, normalisation, frames) each could take otherwise. Much of the image is light scattered
    once."""
    fogs.register_plugins()
    return Row(fogs.foggy(fogs.fog(1.5, 0.9) | {"phase": PHASES[name]}), VOLPATH, error=0.01)


@same("all", of=("thindielectric", "blendbsdf"))
def boundary(name):
    """Lobes that pass straight on are transmittance to a connection and no vertex to a walk; where they are
    one lobe of several the weights of both have to agree. (With a point `volpath` would miss what
    thindielectric reflects.)"""
    medium = fogs.fog(3, 0.7)
    if name == "thindielectric":
        return Row(fogs.room(ball=fogs.ball(name, interior=medium)), VOLPATH, error=0.01)
    blend = {"type": name, "weight": 0.4, "a": {"type": "null"}, "b": matte(0.7, 0.5, 0.3)}
    return Row(lit(ball=fogs.ball(blend, interior=medium)), VOLPATH, error=0.01)


@same("all")
def fog_without_next_event_estimation():
    return Row(fogs.foggy(fogs.fog(1.5, 0.9, sample_emitters=False)), VOLPATH, error=0.01)


FOG = {"type": "ref", "id": "fog"}


def orthographic():
    look = transform().look_at([0.1, -0.05, 0.5], [0, 0, -1], [0, 1, 0]).scale([0.5, 0.5, 1])
    return {"sensor": parts.sensor("orthographic", {"to_world": look, "medium": FOG})}


def irradiancemeter():
    look = transform().look_at([-0.05, 0, 0], [0.25, 0.3, -0.2], [0, 0, 1]).scale(0.1)
    sensor = scenes.meter(medium=FOG)
    return {"plate": {"type": "rectangle", "to_world": look, "bsdf": matte(0), "sensor": sensor}}


def batch():
    return {
        "sensor": parts.batch(camera(near=0.1), camera(near=0.1, origin=(-0.5, 0.1, 0.4))) | {"medium": FOG}
    }


@same("all", of=("orthographic", "irradiancemeter", "batch"))
def sensor_in_fog(name):
    """Rays start at the near plane, on the sensor's shape or by view, and their transmittance with them."""
    scene = fogs.room() | {"fog": fogs.fog(0.8, 0.8, id="fog")}
    del scene["sensor"]
    scene = {"fog": scene.pop("fog"), **scene, **globals()[name]()}
    times = 128 if name == "irradiancemeter" else 1  # of the one pixel
    return Row(scene, VOLPATH, spp=64 * times, judge_spp=256 * times, error=0.01)


@same("all")
def medium_in_python():
    """What a medium is like is asked of it, not read from its class."""
    fogs.register_plugins()
    own = {"type": "own_fog", "extinction": 4.0, "albedo": 0.9, "phase": hg(0.3)}
    uniform = lit(ball=fogs.ball(interior=fogs.fog(4, 0.9)))
    return Row(lit(ball=fogs.ball(interior=own)), VOLPATH, other=uniform, error=0.01)


@same("all")
def constant_grid():
    """Delta and ratio tracking against closed forms."""
    grid = fogs.grid(np.full((3, 3, 3), 0.5), fogs.LOW - 0.1, fogs.EDGE + 0.2, 8.0, 0.9, phase=hg(0.3))
    uniform = lit(box=fogs.box(interior=fogs.fog(4, 0.9)))
    return Row(lit(box=fogs.box(interior=grid)), EVERYTHING, spp=128, judge_spp=128, seeds=16, other=uniform)


@same("all", of=(40.0, 5.0))
def spot_in_fog(cutoff):
    """pbrt-v3 #179: bidirectional images of a spot in fog were 12 % darker; LuxCoreRender #216, #683."""
    look = transform().look_at([0.6, 0.3, -0.4], [-0.6, -0.2, -0.5], [0, 1, 0])
    spot = {
        "type": "spot",
        "intensity": 4.0,
        "cutoff_angle": cutoff,
        "beam_width": cutoff * 0.9,
        "to_world": look,
    }
    # Beside a narrow beam light is rare: tiles of few pixels are not normal.
    spp, tile = (512, 4) if cutoff > 5 else (1024, 8)
    scene = fogs.foggy(fogs.fog(0.8, 0.8), light=spot)
    return Row(scene, VOLPATH, spp=256, judge_spp=spp, seeds=16, tile=tile)


def coloured_grid(values, low=fogs.LOW, edge=fogs.EDGE, **more):
    """A grid of extinctions of three colours."""
    medium = fogs.grid(np.zeros((2, 2, 2)), low, edge, **more)
    medium["sigma_t"] |= {"raw": True, "grid": mi.VolumeGrid(np.asarray(values, dtype=np.float32))}
    return medium


@same("all")
def null_collisions_by_channel():
    """mitsuba3 #1387, #1628."""
    values = np.random.default_rng(0).random((6, 6, 6, 3)) * [1.0, 0.5, 0.1]
    scene = lit(ball=fogs.box(interior=coloured_grid(values)))
    return Row(scene, VOLPATHMIS, spp=128, judge_spp=128, seeds=16)


def inside_without_saying():
    """The sensor is in a ball of fog, and declares no medium."""
    return lit(ball=fogs.ball(radius=0.9, center=(0, 0, 0), interior=fogs.fog(1, 0.8)))


def hole_in_fog():
    """A ball with a medium of its own whose shape says that outside of it is none, in a foggy room."""
    return fogs.foggy(fogs.fog(0.5, 0.8), light=fogs.point()) | {"ball": fogs.ball(interior=fogs.fog(4, 0.9))}


CONTRADICTORY = {"declares no medium": inside_without_saying, "that it is in no medium": hole_in_fog}


@same("all", of=CONTRADICTORY)
def contradictory_media(why):
    """LuxCoreRender #485: light and camera subpaths would see two scenes."""
    return Row(CONTRADICTORY[why](), VOLPATH, spp=128, judge_spp=128, seeds=16)


def lens_before_a_far_plane(**more):
    return camera(
        "thinlens", (0, 0, 1), (0, 0, 0), 30, 4, aperture_radius=0.3, focus_distance=1.2, **more
    ) | {"far_clip": 1.5}


def beyond_the_far_plane(light, blocker):
    medium = {"type": "ref", "id": "m"}
    return {
        "m": fogs.fog(0.6, 0.8, 0.3, id="m"),
        "sensor": lens_before_a_far_plane(medium=medium),
        "box": fogs.box(low=(-2, -2, -2), edge=4, interior=medium),
        "light": fogs.sky() if light == "sky" else fogs.sun() | {"direction": [0, 0, 1]},
    } | ({"ball": fogs.ball(matte(0.5), 0.6, (0, 0, -1.2))} if blocker else {})


@same("default", of=[(light, blocker) for light in ("sky", "sun") for blocker in (False, True)])
def far_plane_in_fog(light, blocker):
    """A camera ray that ends at the far plane saw the sky through the fog before it, and light from infinity
    came to the lens through all fog: twice what ``volpath`` shows under a sky, 38 times under a sun.
    (Homogeneous fog goes on behind the plane.)"""
    return Row(beyond_the_far_plane(light, blocker), VOLPATH, 3, 2048, 2048, 8)


@same("all", of=("sky", "sun"))
def medium_of_nothing(light):
    """Light from infinity does not come through a medium without end, unless that is nothing."""
    scene = fogs.open_air(light)
    scene["sensor"] |= {"medium": {"type": "homogeneous", "sigma_t": 0.0, "albedo": 0.5}}
    return Row(scene, PATH, 3, 256, 256, 8, other=fogs.open_air(light))


@same("all")
def albedo_that_is_zero_at_the_origin():
    """Whether a medium scatters was asked at the origin: as an albedo that is 1e-6 more."""

    def scene(more):
        values = np.zeros((4, 2, 2, 1), np.float32)
        values[:2] = 0.9
        to_world = transform().translate([-1, -1, -1]).scale([2, 2, 1.5])
        albedo = {"type": "gridvolume", "grid": mi.VolumeGrid(values + np.float32(more))}
        albedo |= {"to_world": to_world, "filter_type": "nearest"}
        return fogs.foggy({"type": "homogeneous", "sigma_t": 1.0, "albedo": albedo})

    return Row(scene(0), EVERYTHING, 3, 256, 256, 8, other=scene(1e-6))


@same("all")
def lamp_of_which_a_hundredth_is_in_fog():
    """Few probes did not find that some rays of a lamp start in the medium: a ball of fog on a glowing
    floor."""
    x, y, half = -1.3, 0.9, matte(0.5)
    scene = {
        "sensor": camera(origin=(x, y + 0.001, 2.0), target=(x, y, 0), fov=16, size=8, near=0.1),
        "floor": square(size=3, bsdf=half, emitter=area(1.0)),
        "ball": fogs.ball("null", 0.3, (x, y, 0), interior=fogs.fog(6, 0.9)),
        "top": square((0, 0, 4), ([1, 0, 0], 180), 4, half),
    }
    return Row(scene, WAYS["camera"], 4, 256, 256, 8)


@same("all", "camera")
def grid_smaller_than_its_shape():
    """Flights and connections begin within the shape, before the grid: as in a shape of the grid's size."""
    medium = fogs.grid(np.full((2, 2, 2), 1.0), fogs.LOW, fogs.EDGE, 6.0, 0.9)
    tight, wide = (
        fogs.room(
            light=fogs.point(position=[-0.35, 0.35, -0.2]),
            box=fogs.box(fogs.LOW - gap, fogs.EDGE + 2 * gap, interior=medium),
        )
        for gap in (0.0, 0.15)
    )
    return Row(wide, WAYS["camera"], 3, 128, 128, 8, other=tight)


# -- SDS paths: merging and photon-guided BSDF sampling -----------------------------------------

LENS = {"kind": "thinlens"}


def wide(scene, radius=0.8):
    scene["sensor"] |= {"aperture_radius": radius}
    return scene


@same("guided 4", of=sds.CASES)
@same("guided 1", of=("diffuse",))
def large_lamp(case):
    """Of a large lamp s = 0 (and with a lens t = 0) finds what is guided."""
    return Row(under_glass(sds.ball(), **sds.CASES[case]), NOT_GUIDED, 6, 128, 128, 8)


@same(
    *("always, " + way for way in ("power", "camera", "no connections", "roulette", "one vertex")),
    *("always, independent", "always, hidden"),
)
def large_lamp_guided():
    """No pixel shows the lamp itself."""
    return Row(under_glass(sds.ball()), NOT_GUIDED, 6, 128, 128, 8)


@same("always")
def large_lamp_and_wide_lens():
    """t = 0 makes the paths that are guided, and has to know by which density."""
    return Row(wide(under_glass(sds.ball(), **LENS)), NOT_GUIDED, 6, 256, 256, 8, EVERYTHING)


@same("guided 4")
def lamp_below_the_plate():
    """From the floor the guide also makes directions straight to the lamp, on paths that s = 1 connects."""
    lamp = sds.ball(0.1) | {"center": [0.5, 0.0, 0.2]}
    return Row(under_glass(lamp), NOT_GUIDED, 6, 128, 128, 8, error=0.05, judge_seed=100)


@same("always")
def guided_sun_with_hide_emitters():
    """What is hidden is the sky that a camera ray meets first. A sun of 11 degrees that the plate does not
    mirror into the camera."""
    pixels = np.zeros((33, 64, 3), dtype=np.float32)
    pixels[10:12, 8:10] = 200.0
    sky = {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": transform().rotate([1, 0, 0], 90)}
    return Row(under_glass(sky), NOT_GUIDED, 6, 32, 32, 6, WAYS["hidden"], error=0.1)


def caustics(wide):
    """The scene of two balls, its lamp made ``wide`` times as large."""
    tree = ElementTree.parse(ROOT / "glass_caustics.xml")
    lamp = next(s for s in tree.iter("shape") if s.find("emitter") is not None)
    scale = lamp.find("transform/scale")
    scale.set("value", str(wide * float(scale.get("value"))))
    return mi.load_string(ElementTree.tostring(tree.getroot(), "unicode"), resolution=32)


@same("guided 4")
def wide_lamp_over_glass_balls():
    """So that s = 0 finds it without guiding."""
    return Row(caustics(8), NOT_GUIDED, 8, 64, 64, 8)


@same("merged")
def glass_balls():
    return Row(caustics(1), WAYS["always"] | {"merging": False}, 8, 64, 64, 8)


GUIDED = {"merging": False, "guiding": "always"}


@same("merged", of=sds.CASES)
def small_lamp(case):
    """Of a small lamp guided s = 0 (and with a lens t = 0) finds what merging finds; discs of a quarter of a
    pixel."""
    return Row(under_glass(sds.spark(), **sds.CASES[case]), GUIDED, 6, 256, 256, 8, EVERYTHING, error=0.15)


@same("merged, power")
def small_lamp_by_power():
    return small_lamp("diffuse")


@same("merged")
def small_lamp_and_sky():
    """s = 0 finds the light of an even sky, which is not merged."""
    sky = {"type": "constant", "radiance": 0.2}
    return Row(under_glass(sds.spark(), sky=sky), GUIDED, 6, 256, 256, 8)


@same("merged", of=(None, 4))
def spectral_lamp(spp_per_pass):
    """Photons and camera subpaths share sets of wavelengths: in one pass, and in passes of less than a sample
    for each set."""
    mi.set_variant(variants.of("spectral"))
    lamp = sds.ball(0.05) | {"emitter": area(scenes.rgb(1000, 600, 200))}
    ours = {"spp_per_pass": spp_per_pass} if spp_per_pass else {}
    scene = under_glass(lamp, matte(0.2, 0.6, 0.4))
    return Row(scene, GUIDED, 6, 64 if spp_per_pass else 256, 256, 8, ours=ours, error=0.15)


@same("wide discs")
def lens_and_point_lamp():
    """A wide lens is hit by light subpaths, t = 0, which makes the paths that merging makes."""
    return Row(
        wide(under_glass(sds.point(), **LENS)), EVERYTHING, 6, 512, 512, 8, EVERYTHING, tile=8, error=0.03
    )


@same("default")
def lens_and_photons_without_aim():
    """Photons are aimed at specular shapes; t = 0, which shares the light with merging, is not."""
    scene = wide(under_glass(sds.point(), **LENS))
    scene["plate"]["to_world"] = transform().translate([0, 0, 0.5]).scale([1, 1, sds.THICKNESS / 2])
    patched = (("mitsuba_bdpt.transport.photons.aim._specular_boxes", lambda *_: []),)
    more = WAYS["wide discs"] | EVERYTHING
    return Row(scene, {}, 6, 512, 512, 8, more, tile=8, error=0.1, patched=patched)


@same("merged", "guided 4", of=("an instance", "a border"))
def small_lamp_and(change):
    """An instance in place of the plate; pixels around the film."""
    scene = under_glass(sds.spark())
    if change == "a border":
        scene["sensor"]["film"] |= {"sample_border": True, "rfilter": {"type": "gaussian"}}
    else:
        plate = scene.pop("plate") | {"to_world": transform().scale([4, 4, 0.1])}
        again = {"type": "instance", "to_world": transform().translate([0, 0, 0.5])}
        scene["group"] = {"type": "shapegroup", "plate": plate}
        scene["again"] = again | {"group": {"type": "ref", "id": "group"}}
    return Row(scene, GUIDED, 6, 256, 256, 8, other=under_glass(sds.spark()), error=0.15)


@same("default")
def meter_below_the_plate():
    """Without light subpaths merging finds what t = 1 finds with them, in several passes."""
    scene = under_glass(sds.point())
    del scene["sensor"]
    paper = square((0.5, 0, 0.2), ([1, 0, 0], 180), 0.2, sensor=scenes.meter())
    merged = {"light_paths": 0, "merging": True}
    return Row(scene | {"paper": paper}, {}, 4, 1 << 14, 1 << 14, 8, ours=merged, error=0.1)


@same("merged, camera")
def point_lamp_seen_from_below_the_plate():
    """An edge is connected only by a strategy that is in use: t = 1 sees the floor, or else merging does."""
    scene = under_glass(sds.point())
    scene["sensor"] = camera(origin=(0, 0.1, 0.35), target=(0.5, 0, 0), fov=90)
    return Row(scene, {}, 4, 256, 256, 8, error=0.1)


# One photon subpath for each sample: else merges have little of the weight beside a large lamp.
MANY_PHOTONS = ("mitsuba_bdpt.merging.passes.SAMPLES_PER_PHOTON", 1)
MANY_IN_MEDIA = ("mitsuba_bdpt.merging.passes.IN_MEDIA", 1)
NEVER = {"guiding": "never"}


@same("guided 4", of=("alpha .005", "blend", "bumpy", "coated floor", "lens", "ramp"))
@same("merged", of=[case for case in sds.NEAR_SPECULAR if case != "alpha .03"])
def near_specular(case):
    """Which strategy finds a path changes with guiding, gate, weights and bounds; across the gate (a ramp of
    alpha) nothing may jump."""
    scene = under_glass(sds.ball(), **sds.NEAR_SPECULAR[case])
    return Row(scene, NEVER, 6, 128, 256, 8, patched=(MANY_PHOTONS,))


CHOICES = "all", "camera", "no connections", "power"


@same(
    *(f"{by}, {way}" for by in ("always", "merged") for way in CHOICES),
    *("always, all, one vertex", "always, roulette", "merged, all, three vertices"),
)
def nearly_smooth():
    """Edges that no strategy in use connects make more paths SDS paths."""
    return near_specular("alpha .03")


@same("always", "merged", of=("spectral", "mono", "mono_polarized"))
def nearly_smooth_in(variant):
    mi.set_variant(variants.of(variant))
    scene = under_glass(sds.ball(), plate=sds.rough(0.03))
    return Row(scene, NEVER, 6, 128, 256, 8, patched=(MANY_PHOTONS,))


@same("always")
def nearly_smooth_and_wide_lens():
    """t = 0 samples SDS paths, and leaves them to s = 0."""
    return Row(
        wide(under_glass(sds.ball(), plate=sds.rough(0.02), **LENS)), NEVER, 6, 256, 256, 8, EVERYTHING
    )


@same("always", of=("point and ball", "sky"))
def nearly_smooth_under(lamps):
    """Nothing is left out of the light of emitters that rays cannot hit; the sky is hit at no vertex."""
    pixels = np.full((8, 16, 3), 0.01, dtype=np.float32)
    pixels[1:3, 2:5] = 50.0
    sky = {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": transform().rotate([1, 0, 0], 90)}
    lamp = {"light": sds.ball(), "point": {"type": "point", "position": [0.0, 0.5, 2.0], "intensity": 1.0}}
    scene = under_glass(plate=sds.rough(0.2), **({"light": sky} if lamps == "sky" else lamp))
    return Row(scene, NEVER, 6, 128, 256, 8)


@same("guided 4")
def nested_near_specular():
    """A plate with a normal map, beside metal that is masked and has two sides."""
    rng = np.random.default_rng(3)
    normals = 0.5 + 0.5 * np.concatenate([0.05 * rng.uniform(-1, 1, (8, 8, 2)), np.ones((8, 8, 1))], axis=2)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(normals.astype(np.float32)), "raw": True}
    plate = {"type": "normalmap", "normalmap": texture, "bsdf": sds.rough(0.02)}
    wall = sds.steel(0.03)
    wall["bsdf"] = {"type": "mask", "opacity": 0.7, "bsdf": {"type": "twosided", "bsdf": wall["bsdf"]}}
    return Row(under_glass(sds.ball(), plate=plate, mirror=wall), NEVER, 6, 128, 256, 8)


LIGHTS = {
    "point": sds.point,
    "spot": lambda: {
        "type": "spot",
        "intensity": 10.0,
        "cutoff_angle": 40.0,
        "to_world": transform().look_at(origin=[0.5, 0, 4.5], target=[0, 0, 0], up=[0, 1, 0]),
    },
    "sun": sds.sun,
    "ball": sds.ball,
}


@same("merged", of=[(light, kind) for light in LIGHTS for kind in ("perspective", "thinlens")])
def all_vertices_merged(light, kind):
    """With B = 0 every path is merged, also by diffuse surfaces alone, and no bound leaves out a photon:
    every strategy shares every path with merges, from each kind of emitter and to both kinds of sensors."""
    scene = under_glass(LIGHTS[light](), plate=sds.rough(0.35), kind=kind)
    scene = wide(scene) if kind == "thinlens" else scene
    patched = MANY_PHOTONS, (mis, "MERGE_DOMINATED", 0.0)
    return Row(scene, {}, 5, 64, 64, 8, EVERYTHING | NEVER, patched=patched)


# -- merging in media ---------------------------------------------------------------------------

ALL_MERGED = (mis, "MERGE_DOMINATED", 0.0)


def under_water(medium, bed=0.2, judge=VOLPATH, patched=(MANY_IN_MEDIA, ALL_MERGED), **more):
    """A lamp so large that hits find it through water; balls lack up to 1 % of the light, at surfaces."""
    scene = sds.pool(medium, sds.ball(0.8), matte(bed), **more)
    return Row(scene, judge, 5, 256, 2048, 8, patched=patched)


def noise(*shape):
    return np.random.default_rng(3).random(shape) ** 2


IN_WATER = {"low": (-1.6, -1.6, -1), "edge": (3.2, 3.2, 1)}
WATERS = {
    "fog": lambda: under_water(fogs.fog(1, 0.8)),
    "forward": lambda: under_water(fogs.fog(2, 0.9, 0.8)),
    "black fog": lambda: under_water(fogs.fog(1, 0.0), 0.8),
    "coloured": lambda: under_water(fogs.coloured(1.5), judge=VOLPATHMIS),
    "grid": lambda: under_water(fogs.grid(noise(4, 4, 4), *IN_WATER.values(), 4.0, 0.9, phase=hg(0.3))),
    "coloured grid": lambda: under_water(
        coloured_grid(noise(4, 4, 4, 3) * [1, 0.5, 0.1], *IN_WATER.values(), scale=4.0), judge=VOLPATHMIS
    ),
}


@same("small balls", of=WATERS)
def pool(name):
    return WATERS[name]()


@same("small balls", of=("mono", "spectral"))
def coloured_pool_in(variant):
    mi.set_variant(variants.of(variant))
    return pool("coloured")


@same(*(f"small balls, {way}" for way in (*CHOICES, "quarter, three vertices, independent, roulette")))
def pool_by():
    """Merges of half of the light, where they dominate."""
    return under_water(fogs.fog(1, 0.8), patched=(MANY_IN_MEDIA,))


@same("small balls, all", "small balls, camera", of=("homogeneous", "grid"))
def pool_around_a(kind):
    """Fog of another number behind a null boundary, in part black. (`volpath` is wrong behind these.)"""
    at = (-0.5, -0.5, -0.9), (1, 1, 0.6)
    other = fogs.fog(3, 0.9, 0.0) if kind == "homogeneous" else fogs.grid(noise(4, 4, 4), *at, 9.0, 0.9)
    box = fogs.box(*at, interior=other, exterior={"type": "ref", "id": "water"})
    return under_water(fogs.fog(0.5, 0.8), judge=WAYS["camera"] | {"merging": False}, box=box)


@same("small balls, all", "small balls, camera")
def pool_point_lamp_and_wide_lens():
    """t = 0 finds what merging finds; the reference would merge by itself."""
    point = {"type": "point", "position": [-2.2, 2.0, 2.5], "intensity": 10.0}
    eye = camera("thinlens", (-2.2, -2, 2.5), (0, 0, -0.3), 40, aperture_radius=0.8, focus_distance=3.9)
    scene = sds.pool(fogs.fog(1, 0.8), point, matte(0.2), sensor=eye)
    judge = EVERYTHING | {"merging": False}
    return Row(scene, judge, 5, 256, 4096, 8, tile=8, error=0.06, patched=(MANY_IN_MEDIA,))


@same("small balls", "small balls, camera", of=("null", "dielectric"))
def fog_all_merged(bsdf):
    """A foggy room and a ball of denser fog in it, the sensor in the fog."""
    glass = fogs.ball({"type": "dielectric"}, 0.2, (0.2, -0.3, -0.4))
    dense = fogs.ball(bsdf, interior=fogs.fog(5, 0.9), exterior={"type": "ref", "id": "fog"})
    eye = fogs.sensor(medium=FOG)
    scene = {"fog": fogs.fog(0.8, 0.8, id="fog"), **fogs.room(eye, dense=dense, glass=glass)}
    judge = WAYS["camera"] if bsdf == "null" else VOLPATH
    return Row(scene, judge, 4, 64, 256, 8, patched=(MANY_IN_MEDIA, ALL_MERGED))


# -- guided emission, and several light subpaths in a lane --------------------------------------


def random_tables(scene):
    """Tables of a scene's emitters, of neighbours that differ by up to 50."""
    from mitsuba_bdpt.guided_emission import EmissionTables, side_of  # other rows do without

    emitters = Emitters(scene)
    side = side_of(sum(emitters.tables))
    densities = np.random.default_rng(1).random((sum(emitters.tables), side, side)) ** 4 + 0.02
    return EmissionTables.of(densities / densities.mean(axis=(1, 2), keepdims=True), 0.5)


def decided(kappa=1.0, **way):
    """A decision for all strategies; ``way``: what it has beside one light subpath and all connections."""
    way = {"light_paths": 1.0, "connections": "all"} | way
    rest = {"coefficients": {"t<=1": kappa, "s=1": 1.0}, "cost": 1.0, "variance": 0.0, "mean": 0.0}
    return {"decisions": json.dumps([rest | way])}


LAMPS = {
    "rectangle": ["rectangle"],
    "upright rectangle": ["upright"],
    "disk": ["disk"],
    "sphere": ["sphere"],
    "smooth mesh": ["smooth mesh"],
    "textured": ["textured"],
    "spot": ["spot"],
    "point and rectangle": ["point", "rectangle"],
    "constant": ["constant"],
    "sun along an axis": ["down"],
    "sun and sky": ["directional", "constant"],
    "envmap": ["rotated envmap"],
    "projector and sphere": ["projector", "sphere"],
}
OWN = {
    "upright": lambda: (
        parts.EMITTERS["rectangle"]()
        | {"to_world": transform().translate([1.5, 1, 0]).rotate([0, 1, 0], -90).scale(0.4)}
    ),
    "down": lambda: {"type": "directional", "direction": [0, -1, 0], "irradiance": 2.0},
}


def scene_of(lamps, lens=False, **more):
    parts.register_plugins()
    made = {f"lamp {i}": (OWN.get(name) or parts.EMITTERS[name])() for i, name in enumerate(LAMPS[lamps])}
    eye = parts.thinlens(aperture=0.6) if lens else parts.perspective()
    return mi.load_dict(parts.open_scene(eye, **made, **more))


def by_tables(scene, spp=256, seeds=10, more=None, **way):
    ours = decided(emission=vars(random_tables(scene)), **way)
    return Row(scene, EVERYTHING, 4, spp, spp, seeds, more or {}, ours)


@same("default", of=LAMPS)
def emission_tables(lamps):
    return by_tables(scene_of(lamps))


@same("default", of=("rectangle", "sphere", "point and rectangle", "sun and sky"))
def emission_tables_and_wide_lens(lamps):
    """t = 0 and (1,1) have densities of emission too."""
    return by_tables(scene_of(lamps, lens=True))


@same("power", "independent", "two vertices")
def emission_tables_by():
    return by_tables(scene_of("point and rectangle"), light_paths=0.25, connections="one", kappa=0.5)


@same("hidden")
def emission_tables_hidden():
    row = emission_tables_by()
    return row._replace(more=WAYS["hidden"])


@same("default", of=("spectral", "mono"))
def emission_tables_in(variant):
    mi.set_variant(variants.of(variant))
    return by_tables(scene_of("sun and sky"), 64, 8)


@same("default")
def emission_tables_in_fog():
    to_world = transform().translate([0, 1, 0]).scale(0.9)
    box = {
        "type": "cube",
        "to_world": to_world,
        "bsdf": {"type": "null"},
        "interior": fogs.fog(0.8, 0.7, 0.0),
    }
    return by_tables(scene_of("point and rectangle", fog=box))


@same("default")
def emission_tables_of_photons():
    """Photons set out by the same tables, mixed with their own aim; the blur is the same."""
    glass = {"type": "sphere", "center": [0.2, 0.9, 0.9], "radius": 0.3, "bsdf": {"type": "dielectric"}}
    return by_tables(scene_of("point and rectangle", glass=glass), more={"merging": True})


def bumps():
    values = np.random.default_rng(1).random((8, 8, 1), dtype=np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


METAL = {"type": "roughconductor", "alpha": 0.3}
MATERIALS = {
    "diffuse": lambda: parts.grey(0.6),
    "roughplastic": lambda: {"type": "roughplastic", "alpha": 0.2},
    "roughconductor": lambda: {"type": "roughconductor", "alpha_u": 0.25, "alpha_v": 0.1},
    "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.3},
    "principled": lambda: {"type": "principled", "roughness": 0.4, "metallic": 0.5, "spec_trans": 0.3},
    "principledthin": lambda: {
        "type": "principledthin",
        "roughness": 0.4,
        "diff_trans": 0.8,
        "spec_trans": 0.3,
    },
    "bumpmap": lambda: {"type": "bumpmap", "arbitrary": bumps(), "scale": 0.4, "bsdf": METAL},
    "mask": lambda: {"type": "mask", "opacity": 0.6, "bsdf": {"type": "roughplastic", "alpha": 0.3}},
    "blend": lambda: {"type": "blendbsdf", "weight": 0.5, "a": parts.grey(0.7), "b": METAL | {"alpha": 0.2}},
    "one side": lambda: {"type": "diffuse", "reflectance": 0.6},
}


def of_material(material, lamp="sphere", sensor=None):
    """Ball and box of a material in the open; other shapes are gray."""
    parts.register_plugins()
    made = parts.open_scene(sensor or parts.perspective(), lamp=parts.EMITTERS[lamp]())
    for name in ("ball", "box"):
        made[name]["bsdf"] = MATERIALS[material]()
    return made


def joined(scene, depth=5, more=None, error=0.02, **way):
    """One connection to one of four light subpaths in each lane, beside all connections."""
    ours = decided(**{"light_paths": 1 / 16, "connections": "one", "joined": 4} | way)
    return Row(scene, EVERYTHING, depth, 256, 256, 10, more or {}, ours, error=error)


@same("default", of=("diffuse", "roughdielectric", "principledthin", "bumpmap", "mask", "one side"))
def joined_light_subpaths(material):
    return joined(of_material(material))


@same("power", "independent", "three vertices", "roulette")
def joined_light_subpaths_by():
    return joined(of_material("roughplastic", "rectangle"))


@same("default", of=("hidden", "as many", "with roulette"))
def joined_light_subpaths_when(change):
    scene = of_material("roughplastic", "rectangle")
    return {
        "hidden": lambda: joined(scene, more=WAYS["hidden"]),
        "as many": lambda: joined(scene, light_paths=1.0),
        "with roulette": lambda: joined(scene, light_paths=1 / 4, mean=0.3, variance=1.0),
    }[change]()


@same("default", of=("point", "constant", "directionalarea"))
def joined_light_subpaths_of(lamp):
    return joined(of_material("roughconductor", lamp))


@same("default", of=("spectral", "mono"))
def joined_light_subpaths_in(variant):
    mi.set_variant(variants.of(variant))
    return joined(of_material("roughplastic"))


@same("default")
def joined_light_subpaths_and_wide_lens():
    """t = 0 and t = 1 count the light subpaths of a lane."""
    return joined(of_material("roughplastic", "sphere", parts.thinlens(aperture=0.6)))


@same("default", of=[(17, 13), (9, 8)])
def joined_light_subpaths_on_a_film_of(width, height):
    """The last lanes serve fewer camera subpaths, and there are more light subpaths for each."""
    film = parts.film() | {"width": width, "height": height}
    return joined(of_material("diffuse", sensor=parts.perspective() | {"film": film}), error=0.002)


# -- in the room of `scene_parts`, beside `path` --------------------------------------------------------


IN_A_ROOM = {
    name: MATERIALS[name] for name in ("roughdielectric", "principled", "mask", "blend", "one side")
} | {
    "bumpmap": lambda: MATERIALS["bumpmap"]() | {"bsdf": matte(0.6)},
    "null": lambda: {"type": "null"},
    "two sides": lambda: {"type": "twosided", "front": {"type": "diffuse"}, "back": METAL},
    "dielectric": lambda: {"type": "dielectric"},
    "thindielectric": lambda: {"type": "thindielectric"},
    "conductor": lambda: {"type": "conductor"},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": 0.5},
    "textured": lambda: {"type": "diffuse", "reflectance": parts.texture()},
}


@same("all", of=IN_A_ROOM)
def surface_in_a_room(name):
    """A ball and an upright card. `path` finds the lamp through delta lobes by chance only."""
    scene = parts.room(lamp=parts.EMITTERS["rectangle"]())
    scene["ball"]["bsdf"] = IN_A_ROOM[name]()
    at = transform().translate([0.3, 0.7, 1]).rotate([0, 1, 0], 40).scale([0.5, 0.7, 1])
    card = {"type": "rectangle", "bsdf": IN_A_ROOM[name](), "to_world": at}
    return Row(scene | {"card": card}, PATH, 4, 128, 1024, error=0.01)


@same("all")
def unequal_lamps():
    """LuxCore #68: a point light and an environment were each right alone, and not together."""
    lamps = {}
    for i, name in enumerate(("rectangle", "sphere", "point", "spot", "directional", "envmap")):
        lamps[name] = lamp = parts.EMITTERS[name]()
        lamp.get("emitter", lamp)["sampling_weight"] = 0.3 + i * i / 4
    return Row(parts.room(**lamps), PATH, 3, 256, 512, error=0.015)


@same("all")
def instances():
    """A group of a ball and a box, instanced twice with scale and rotation."""
    box = {"type": "cube", "bsdf": matte(0.4), "to_world": transform().translate([0.5, 0, 0]).scale(0.2)}
    ball = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "roughplastic"}}
    turned = transform().translate([-0.2, 1.3, 0.5]).rotate([0, 0.70710678, 0.70710678], 50)
    stretched = transform().translate([0.4, 0.4, 1.2]).scale([1, 1.3, 0.8])
    one, two = (
        {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": at}
        for at in (turned, stretched)
    )
    group = {"type": "shapegroup", "a": ball, "b": box}
    return Row(
        parts.room(lamp=parts.EMITTERS["rectangle"](), group=group, one=one, two=two), PATH, error=0.01
    )


@same("all", of=[(lamp, hide) for lamp in ("sphere", "constant") for hide in (False, True)])
def lamp_before_the_sky(lamp, hide):
    """One corner of the image sees past all."""
    glass = {"type": "sphere", "center": [1, 1.5, 0.5], "radius": 0.4, "bsdf": {"type": "null"}}
    scene = parts.room(parts.perspective(origin=(0, 2, 7), fov=50), lamp=parts.EMITTERS[lamp](), glass=glass)
    return Row(scene, PATH, 3, 128, 1024, more={"hide_emitters": hide}, error=0.01)


@same("default", of=("plastic", "dielectric", "conductor"))
def timed_sky_over(name):
    """Step by step, calls of functions written in Python fail for `plastic`."""
    sky = {"type": "timed_sunsky", "to_world": transform().rotate([1, 0, 0], -90)}
    scene = parts.room(sky=sky)
    del scene["back"], scene["box"]
    scene["ball"]["bsdf"] = IN_A_ROOM[name]()
    return Row(scene, WAYS["camera"], 4, 64, 64, 5, error=0.02)


@same.test
def test_same_mean(make, way, monkeypatch):
    row = make()
    scene = loaded(row.scene)
    given = [WAYS[part] for part in way.split(", ")]
    parameters = {"max_depth": row.depth} | row.more | row.ours
    for one in given:
        parameters |= one
    theirs = reference((make.func, make.args), row, scene)
    for place in row.patched:
        monkeypatch.setattr(*place)
    method = integrator(**parameters)
    ours = tiles(renders(scene, method, row.spp, row.seeds), row.tile)
    if "merging" in parameters and "one vertex" not in way and "three vertices" not in way:
        assert method.statistics["merging"]["merges"], "nothing is merged"
    st.assert_agree(compared(ours, theirs))
    error = np.sqrt(sum(x.mean((1, 2)).var(ddof=1) / row.seeds for x in (ours, theirs)))
    assert error < row.error * theirs.mean(), f"too noisy: {error / theirs.mean():.2%}"
