"""Surfaces that are very near, very thin, very small, very many, or where they should not be."""

from __future__ import annotations

import tempfile
import time
from functools import partial
from pathlib import Path

import drjit as dr
import numpy as np
from mitsuba_bdpt.host import memory
from mitsuba_bdpt.measure.agreement import Sample

import mitsuba as mi  # isort: skip

from .agreement import WAYS, family, greens
from .case import Outcome, of_section

_case = of_section("Geometry")
SIZE = 16


# -- parts of scenes --------------------------------------------------------------------------


def _transform():
    return mi.ScalarTransform4f()


def _grey(value):
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [float(value)] * 3}}
    return {"type": "twosided", "bsdf": grey}


def _camera(origin, target, fov=45.0, up=(0, 0, 1), near=1e-3):
    film = {
        "type": "hdrfilm",
        "width": SIZE,
        "height": SIZE,
        "pixel_format": "rgb",
        "rfilter": {"type": "box"},
    }
    return {
        "type": "perspective",
        "fov": float(fov),
        "near_clip": near,
        "to_world": _transform().look_at(list(origin), list(target), list(up)),
        "film": film | {"component_format": "float32"},
    }


def _area(radiance):
    return {"type": "area", "radiance": float(radiance)}


def _floor(reflectance=0.5, half=2.0):
    """In the plane z = 0, facing up."""
    return {"type": "rectangle", "to_world": _transform().scale(half), "bsdf": _grey(reflectance)}


def _lamp(height=3.0, half=0.3, radiance=10.0):
    """A square that faces down."""
    to_world = _transform().translate([0.4, 0.3, height]).rotate([1, 0, 0], 180).scale(half)
    return {"type": "rectangle", "to_world": to_world, "bsdf": _grey(0), "emitter": _area(radiance)}


def _scene(**parts):
    return mi.load_dict({"type": "scene", **parts})


# -- how images are judged --------------------------------------------------------------------


def _tiles(scene, parameters, spp, seeds):
    """As `greens`, by default of this package's integrator."""
    return greens(scene, {"type": "bdpt"} | parameters, seeds, spp)


def _whole(values):
    return Sample.of(np.mean(values, axis=1, keepdims=True))


def _against(makes, parameters, spp=256, most_error=0.02) -> Outcome:
    """Scene pairs ``makes`` that should look alike: (scene, other scene, the other's integrator)."""
    pairs, broken = [], 0
    for scene, other, theirs in makes:
        seen = theirs and Sample.of(_tiles(other, parameters | theirs, 2 * spp, range(10, 16))[0])
        for side in WAYS.values():
            a, bad = _tiles(scene, side | parameters, spp, range(6))
            b = seen or Sample.of(_tiles(other, side | parameters, spp, range(10, 16))[0])
            pairs.append((Sample.of(a), b))
            broken += bad
    outcome = family(pairs, most_error)
    return Outcome(outcome.ok and not broken, f"{outcome.happened}, {broken} samples not finite")


def _known(makes, parameters, spp=256, most_error=0.01) -> Outcome:
    """(scene, mean that is known) pairs."""
    pairs, broken = [], 0
    for scene, expected in makes:
        for side in WAYS.values():
            a, bad = _tiles(scene, side | parameters, spp, range(8))
            pairs.append((_whole(a), Sample.known([expected])))
            broken += bad
    outcome = family(pairs, most_error)
    return Outcome(outcome.ok and not broken, f"{outcome.happened}, {broken} samples not finite")


PATH = {"type": "path"}


# -- plates, walls, contacts ------------------------------------------------------------------


def _form_factor(h):
    """Between two unit squares, parallel and coaxial, at the distance ``h``."""
    x = 1 / h
    root = np.sqrt(1 + x * x)
    terms = np.log((1 + x * x) / np.sqrt(1 + 2 * x * x))
    terms += 2 * x * root * np.arctan(x / root) - 2 * x * np.arctan(x)
    return 2 / (np.pi * x * x) * terms


def _plates() -> Outcome:
    makes = []
    for h in (1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0):
        to_world = _transform().translate([0, 0, h]).rotate([1, 0, 0], 180).scale(0.5)
        lamp = {"type": "rectangle", "emitter": _area(1), "bsdf": _grey(0), "to_world": to_world}
        plate = {"type": "rectangle", "to_world": _transform().scale(0.5), "bsdf": _grey(1)}
        camera = _camera((0, 0, 2), (0, 0, 0), np.rad2deg(2 * np.arctan(0.25)), (0, 1, 0))
        makes.append((_scene(sensor=camera, plate=plate, lamp=lamp), _form_factor(h)))
    return _known(makes, {"max_depth": 2, "hide_emitters": True}, spp=64)


def _slab(axis, place, thickness):
    """A wall across an axis, wide enough that walls overlap at the edges of a room of 2 units."""
    half, centre = [1.0 + 2 * thickness] * 3, [0.0] * 3
    half[axis], centre[axis] = thickness / 2, place
    return {"type": "cube", "to_world": _transform().translate(centre).scale(half), "bsdf": _grey(0.7)}


def _walls(inside: bool) -> Outcome:
    """A closed box of walls 1e-4 thick; lamps on one side of it, the camera on the other."""
    walls = {f"w{a}{s}": _slab(a, s * 1.0, 1e-4) for a in range(3) for s in (-1, 1)}
    room = {"type": "cube", "to_world": _transform().scale(4), "bsdf": _grey(0.7)}
    at = 0.4 if inside else 1.9
    point = {"type": "point", "position": [at, 0.2, at], "intensity": 10.0}
    sphere = {"type": "sphere", "center": [-at, 0.3, 0.4], "radius": 0.2, "emitter": _area(20)}
    camera = _camera((0.1, -2.9, 0.3) if inside else (0.1, -0.8, 0.2), (0, 0, 0), 70)
    leaks, seen = {}, {}
    for name, parts in (("closed", walls), ("open", {k: v for k, v in walls.items() if k != "w1-1"})):
        scene = _scene(sensor=camera, point=point, sphere=sphere, room=room, **parts)
        for side, parameters in (*WAYS.items(), ("path", PATH)):
            values, _ = _tiles(scene, parameters | {"max_depth": 6}, 256, range(2))
            (leaks if name == "closed" else seen)[side] = float(values.mean())
    theirs = leaks.pop("path") / seen["path"]
    share = max(leaks[side] / seen[side] for side in leaks)
    text = f"{share:.2g} of the light of the room with one wall missing; `path`: {theirs:.2g}"
    return Outcome(share == 0 and min(seen.values()) > 0, text)


def _touching() -> Outcome:
    """A box that stands on the floor looks like one that is let into it; so does a stack of two."""

    def box(low, high):
        to_world = _transform().translate([0, 0, (low + high) / 2]).scale([0.5, 0.5, (high - low) / 2])
        return {"type": "cube", "to_world": to_world, "bsdf": _grey(0.6)}

    common = {"sensor": _camera((2, -3, 2), (0, 0, 0.3)), "floor": _floor(), "lamp": _lamp()}
    sunk = _scene(**common, box=box(-0.7, 0.8))
    standing = _scene(**common, box=box(0, 0.8))
    stacked = _scene(**common, box=box(0, 0.5), upper=box(0.5, 0.8))
    return _against([(standing, sunk, {}), (stacked, sunk, {})], {"max_depth": 5})


def _coincident() -> Outcome:
    """The same floor twice and thrice is one floor."""
    common = {"sensor": _camera((2, -3, 2), (0, 0, 0.3)), "lamp": _lamp()}
    ball = {"type": "sphere", "center": [0, 0, 0.4], "radius": 0.4, "bsdf": _grey(0.6)}
    one = _scene(**common, ball=ball, floor=_floor())
    three = _scene(**common, ball=ball, twin=ball, floor=_floor(), second=_floor(), third=_floor())
    return _against([(three, one, {})], {"max_depth": 5})


# Of the light that a lamp in a ceiling must keep and may have. Which of the two a ray that meets both hits is
# undefined, so that all of s = 0 may be lost; strategies that start on the lamp lose nothing. The lamp fills
# 0.36 / 9 sr, and s = 0 samples a direction in it with a density of 1 / pi at most: a share of 1.3 % of the
# weights. The rest is noise.
KEPT, MOST_KEPT = 0.98, 1.005


def _lamp_in_the_ceiling() -> Outcome:
    """A lamp in the plane of a ceiling: which of the two a ray meets is undefined."""
    common = {"sensor": _camera((2, -3, 2), (0, 0, 0.3)), "floor": _floor()}
    to_world = _transform().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(1.5)
    ceiling = {"type": "rectangle", "to_world": to_world, "bsdf": _grey(0)}
    means = {}
    for name, more in (("lamp", {}), ("both", {"ceiling": ceiling})):
        scene = _scene(**common, lamp=_lamp(), **more)
        for side, parameters in (*WAYS.items(), ("path", PATH)):
            values, broken = _tiles(scene, parameters | {"max_depth": 4}, 512, range(4))
            means[name, side] = float(values.mean()) if not broken else np.nan
    shares = {side: means["both", side] / means["lamp", side] for side in (*WAYS, "path")}
    text = ", ".join(f"{side} {100 * share:.4g} %" for side, share in shares.items())
    ok = all(KEPT <= shares[side] <= MOST_KEPT for side in WAYS)
    return Outcome(ok, f"of the light without the ceiling: {text}")


# -- triangles --------------------------------------------------------------------------------


def _mesh(positions, faces, folder, name, **parts):
    """A PLY mesh without vertex normals."""
    mesh = mi.Mesh(name, len(positions), len(faces))
    values = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float(np.asarray(positions, dtype=np.float32).ravel())
    values["faces"] = mi.UInt32(np.asarray(faces, dtype=np.uint32).ravel())
    values.update()
    path = Path(folder) / f"{name}.ply"
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "face_normals": True} | parts


# A square of two triangles; and more points on it, for triangles without area: points, edges, needles.
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0], [0.5, 0.5, 0]], dtype=float)
WHOLE = [[0, 1, 2], [0, 2, 3]]
EMPTY = [[4, 4, 4], [0, 0, 2], [0, 4, 2], [4, 5, 2], [1, 1, 1]]


def _no_area() -> Outcome:
    """Triangles without area, in the floor and in the lamp, change nothing."""
    with tempfile.TemporaryDirectory() as folder:
        scenes = []
        for name, faces in (("plain", WHOLE), ("empty", EMPTY[:3] + WHOLE + EMPTY[3:])):
            lamp = SQUARE * [0.3, -0.3, 1] + [0.4, 0.3, 3]
            scenes.append(
                _scene(
                    sensor=_camera((2, -3, 2), (0, 0, 0.3)),
                    floor=_mesh(SQUARE * 2, faces, folder, f"{name}_floor", bsdf=_grey(0.5)),
                    lamp=_mesh(lamp, faces, folder, f"{name}_lamp", bsdf=_grey(0), emitter=_area(10)),
                    ball={"type": "sphere", "center": [0, 0, 0.4], "radius": 0.4, "bsdf": _grey(0.6)},
                )
            )
        return _against([(scenes[1], scenes[0], {})], {"max_depth": 5})


def _lamp_without_area() -> Outcome:
    """A lamp of nothing but empty triangles beside a real one."""
    with tempfile.TemporaryDirectory() as folder:
        nothing = _mesh(SQUARE + [0, 0, 1], EMPTY, folder, "nothing", bsdf=_grey(0), emitter=_area(10))
        common = {"sensor": _camera((2, -3, 2), (0, 0, 0.3)), "floor": _floor(), "lamp": _lamp()}
        happened, good = {}, {}
        for name, parameters in (("bdpt", {}), ("path", PATH)):
            try:
                values, broken = _tiles(_scene(**common, nothing=nothing), parameters, 64, range(2))
                happened[name] = f"renders, {broken} samples not finite, mean {values.mean():.4g}"
                good[name] = broken == 0 and bool(np.isfinite(values).all())
            except (RuntimeError, ValueError) as error:
                said = str(error).strip().splitlines()[-1]
                happened[name] = f"refused: {said[:100]}"
                good[name] = said.startswith("bdpt: ") and "'nothing'" in said
        return Outcome(good["bdpt"], f"`bdpt` {happened['bdpt']}; `path` {happened['path']}")


def _ball_mesh(n, folder, **parts):
    """A unit ball of about 2 n^2 triangles."""
    phi, theta = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.linspace(0, np.pi, n + 1))
    phi, theta = phi.ravel(), theta.ravel()
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)
    j, i = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a, b = (j * n + i).ravel(), (j * n + (i + 1) % n).ravel()
    faces = np.concatenate([np.stack([a, a + n, b], 1), np.stack([b, a + n, b + n], 1)])
    return _mesh(points, faces, folder, "ball", **parts)


# Seconds of CPU time: one that looks at each triangle in Python takes minutes. The time on the clock depends
# on what else the machine does, a second case among others.
LONGEST = 20


def _first_render(kind, scene) -> float:
    """CPU seconds of all threads, compilation included."""
    started = time.process_time()
    image = mi.load_dict({"type": kind, "max_depth": 5}).render(scene, spp=16)
    dr.eval(image)
    dr.sync_thread()
    return time.process_time() - started


def _million(emits: bool) -> Outcome:
    """A ball of a million triangles beside the sphere that it stands for."""
    parts = {"bsdf": _grey(0.5)} | ({"emitter": _area(3)} if emits else {})
    common = {"sensor": _camera((3, -5, 3), (0, 0, -0.2)), "floor": _floor(0.5, 5)}
    common["floor"]["to_world"] = _transform().translate([0, 0, -1.2]).scale(5)
    common |= {} if emits else {"lamp": _lamp(4, 0.5, 20)}
    before = memory.peak() or 0
    with tempfile.TemporaryDirectory() as folder:
        mesh = _ball_mesh(707, folder, **parts)
        fine, exact = _scene(**common, ball=mesh), _scene(**common, ball={"type": "sphere"} | parts)
    seconds = _first_render("bdpt", fine)
    more = ((memory.peak() or 0) - before) / 2**20
    theirs = _first_render("path", fine)
    outcome = _against([(fine, exact, {})], {"max_depth": 5})
    text = (
        f"{outcome.happened}; first render {seconds:.1f} s of CPU time (`path` {theirs:.1f} s), "
        f"{more:.0f} MiB for it all"
    )
    return Outcome(outcome.ok and seconds < LONGEST and more < 1024, text)


# -- light at its limits ----------------------------------------------------------------------


def _grazing() -> Outcome:
    """The sun at cosines from 0.1 to 1e-6 over a floor: rho E cos / pi."""
    makes = []
    for cos in (0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        sun = {
            "type": "directional",
            "direction": [float(np.sqrt(1 - cos**2)), 0.0, -cos],
            "irradiance": 1.0 / cos,
        }
        makes.append(
            (_scene(sensor=_camera((0.5, -2, 2), (0, 0, 0)), floor=_floor(0.5, 4), sun=sun), 0.5 / np.pi)
        )
    return _known(makes, {"max_depth": 4}, spp=256, most_error=0.03)


def _tiny(kind) -> Outcome:
    """A lamp of 1e-6 is a point lamp of the same intensity."""
    half, away = 1e-6, 2.0
    down = _transform().translate([0, 0, away]).rotate([1, 0, 0], 180)
    if kind == "sphere":
        shape = {"type": "sphere", "center": [0, 0, away], "radius": half}
    else:
        shape = {"type": kind, "to_world": down.scale(half)}
    area = {"sphere": np.pi, "disk": np.pi, "rectangle": 4}[kind] * half**2
    # Seen at an angle, so that the lamp does not stand in the way: a spot of 0.003 about the point below it.
    camera = _camera((0.5, -1, 1.5), (0, 0, 0), 0.1)
    scene = _scene(
        sensor=camera, floor=_floor(0.5, 4), lamp=shape | {"bsdf": _grey(0), "emitter": _area(1 / area)}
    )
    expected = 0.5 / np.pi / away**2
    outcome = _known([(scene, expected)], {"max_depth": 2}, spp=64, most_error=0.01)
    theirs, _ = _tiles(scene, PATH | {"max_depth": 2}, 64, range(4))
    text = f"{outcome.happened}; `path` has {theirs.mean() / expected:.3g} of the light"
    if kind == "sphere":
        text += ": Mitsuba's density of the cone towards the sphere is infinite in single precision"
    return Outcome(outcome.ok, text)


def _hidden() -> Outcome:
    """A black plate close below a lamp on a small sphere or cylinder, and the same without the plate."""
    away, brightest, gaps, broken = 8.0, 0.0, [], 0
    camera = _camera((0, 3, 4), (0, 0, 0), 2)
    for kind in ("sphere", "cylinder"):
        for radius, gap in ((1e-2, 0.03), (5e-3, 0.02), (1e-3, 0.02), (1e-6, 0.07)):
            plate = _floor(0, 0.5) | {"to_world": _transform().translate([0, 0, away - gap]).scale(0.5)}
            for side in WAYS.values():
                means = []
                for r, more in ((radius, {"plate": plate}), (radius, {}), (10 * radius, {})):
                    lamp = {"type": "sphere", "center": [0, 0, away], "radius": r}
                    if kind == "cylinder":
                        lamp = {"type": "cylinder", "p0": [-0.1, 0, away], "p1": [0.1, 0, away], "radius": r}
                    lamp["emitter"] = _area(r ** (-2 if kind == "sphere" else -1))
                    scene = _scene(sensor=camera, floor=_floor(), lamp=lamp, **more)
                    image, bad = _tiles(scene, side | {"max_depth": 2}, 128, range(1))
                    means.append(float(image.mean()))
                    broken += bad
                hidden, seen, large = means
                brightest = max(brightest, hidden / large)
                gaps.append(abs(seen / large - 1))
    ok = brightest == 0 and max(gaps) < 0.03 and not broken
    text = f"{100 * brightest:.2g} % of the light behind the plate; without it off by {100 * max(gaps):.2g} %"
    return Outcome(ok, f"{text} at most, {broken} samples not finite")


def _large() -> Outcome:
    """A ball under a lamp on floors of half-width 30 to 3e3, all turned by an odd angle.

    Rectangles, triangles, spheres and cylinders so large that they are as flat, and an instance of a cube far
    from its origin.
    """
    turn = _transform().rotate([0.6, 0, 0.8], 33)
    lamp = turn @ _transform().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(0.5)
    common = {
        "sensor": _camera((0, -4, 2), (0, 0, 0)),
        "ball": {"type": "sphere", "to_world": turn @ _transform().translate([0, 0, 1]).scale(0.5)},
        "lamp": {"type": "rectangle", "to_world": lamp, "bsdf": _grey(0), "emitter": _area(10)},
    }
    common["sensor"]["to_world"] = turn @ common["sensor"]["to_world"]
    floors = {}
    for size in (30.0, 1e3):
        floors[f"rectangle {size:g}"] = {"type": "rectangle", "to_world": turn @ _transform().scale(size)}
        block = _transform().translate([0, 0, -size]).scale(size)
        floors[f"cube {size:g}"] = {"type": "cube", "to_world": turn @ block}
    size = 3e3  # 7e-4 lower two units away
    down = turn @ _transform().translate([0, 0, -size])
    floors["sphere"] = {"type": "sphere", "to_world": down.scale(size)}
    lying = down.rotate([1, 0, 0], 90).translate([0, 0, -size]).scale([size, size, 2 * size])
    floors["cylinder"] = {"type": "cylinder", "to_world": lying}
    makes = {name: floor | {"bsdf": _grey(0.5)} for name, floor in floors.items()}
    scene = _scene(**common, floor=makes.pop("rectangle 30"))
    pairs = [(_scene(**common, floor=floor), scene, PATH) for floor in makes.values()]
    far = _transform().translate([1000, 1000, 999]).scale([30, 30, 1])
    group = {"type": "shapegroup", "cube": {"type": "cube", "bsdf": _grey(0.5), "to_world": far}}
    back = {"type": "instance", "to_world": turn @ _transform().translate([-1000, -1000, -1000])}
    instanced = _scene(**common, group=group, floor=back | {"group": {"type": "ref", "id": "group"}})
    return _against([*pairs, (instanced, scene, PATH)], {"max_depth": 4}, most_error=0.005)


def _large_and_flat() -> Outcome:
    """Boxes of 0.05 under a lamp on floors of half-width 1e4 along the axes, and on a slanting grid."""

    def boxes(floor, turn=None):
        turn = turn or _transform()
        lamp = turn @ _transform().translate([0.3, 0.2, 0.6]).rotate([1, 0, 0], 180).scale(0.1)
        parts = {"lamp": {"type": "rectangle", "to_world": lamp, "bsdf": _grey(0), "emitter": _area(10)}}
        parts["sensor"] = _camera((0.3, -0.4, 0.3), (0, 0, 0.05), 30)
        parts["sensor"]["to_world"] = turn @ parts["sensor"]["to_world"]
        box = turn @ _transform().translate([0.003, 0.002, 0.05]).scale(0.05)
        return _scene(**parts, box={"type": "cube", "to_world": box, "bsdf": _grey(0.5)}, floor=floor)

    size, aside = 1e4, [3, 7, 0]  # triangles of this size have gaps where they join
    small = {"type": "rectangle", "to_world": _transform().scale(10), "bsdf": _grey(0.5)}
    flat = {"type": "rectangle", "to_world": _transform().scale(size)}
    cube = {"type": "cube", "to_world": _transform().translate(aside).translate([0, 0, -size]).scale(size)}
    pairs = [(boxes(f | {"bsdf": _grey(0.5)}), boxes(small), PATH) for f in (flat, cube)]
    turn, wide = _transform().rotate([0.6, 0, 0.8], 33), 300.0
    grid = _slanting(np.array(turn.matrix, dtype=float).reshape(4, 4)[:3, 2], wide) | {"bsdf": _grey(0.5)}
    small = {"type": "rectangle", "to_world": turn @ _transform().scale(10), "bsdf": _grey(0.5)}
    pairs.append((boxes(grid, turn), boxes(small, turn), PATH))
    return _against(pairs, {"max_depth": 4}, spp=256, most_error=0.005)


def _slanting(normal, wide) -> dict:
    """A grid of signed distances of the plane through the origin, ``wide`` along each axis."""
    z, y, x = np.meshgrid(*[np.linspace(-0.5, 0.5, 8)] * 3, indexing="ij")
    distance = (x * normal[0] + y * normal[1] + z * normal[2])[..., None].astype(np.float32)
    place = _transform().scale(wide).translate([-0.5, -0.5, -0.5])
    return {"type": "sdfgrid", "grid": mi.TensorXf(distance), "to_world": place}


def _in_groups() -> Outcome:
    """A cylinder of radius 0.02 and an instance of one of radius 1, seen and lit from 7 away."""
    place = _transform().scale(0.02)
    plain = {"type": "cylinder", "p0": [0, 0, -0.06], "p1": [0, 0, 0.06], "radius": 0.02}
    within = {"type": "cylinder", "p0": [0, 0, -3], "p1": [0, 0, 3], "bsdf": _grey(0.8)}
    common = {
        "sensor": _camera((0, -6, 4), (0, 0, 0), 2),
        "floor": {
            "type": "rectangle",
            "to_world": _transform().translate([0, 0, -0.06]).scale(0.3),
            "bsdf": _grey(0.8),
        },
        "lamp": {
            "type": "rectangle",
            "to_world": _transform().look_at([2, -4, 5], [0, 0, 0], [0, 0, 1]).scale(0.5),
            "bsdf": _grey(0),
            "emitter": _area(100),
        },
    }
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place}
    grouped = _scene(**common, group={"type": "shapegroup", "cylinder": within}, instance=instance)
    alone = _scene(**common, cylinder=plain | {"bsdf": _grey(0.8)})
    return _against([(grouped, alone, {"type": "bdpt"})], {"max_depth": 5}, spp=256, most_error=0.005)


def _scaled_spheres() -> Outcome:
    """White spheres in instances that scale them, under a sky of radiance 1: a mean of 1."""
    texts, ok = [], True
    for scale in ((1.5, 0.4, 0.8), (4, 1, 1), (1, 1, 0.1), (1, 1, 0.01), (0.1, 0.1, 0.1)):
        group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.8, "bsdf": _grey(1.0)}}
        place = {"group": {"type": "ref", "id": "group"}, "to_world": _transform().scale(list(scale))}
        camera, sky = _camera((0, -4, 2.5), (0, 0, 0)), {"type": "constant", "radiance": 1.0}
        scene = _scene(sensor=camera, sky=sky, group=group, ball={"type": "instance"} | place)
        default, everything, path = (
            np.abs(_tiles(scene, way | {"max_depth": 2}, 64, range(2))[0].mean() - 1)
            for way in ({}, {"skip": "none"}, PATH)
        )
        ok &= default < max(2e-3, 2 * path) and everything < 0.1
        off = ", ".join(f"{100 * x:.2g} %" for x in (default, everything, path))
        texts.append(f"{scale}: off by {off}")
    return Outcome(bool(ok), "by default, with all strategies, under `path`: " + "; ".join(texts))


def _lit_through() -> Outcome:
    """A lamp on a ball of rough glass 8 above a floor.

    All is scaled by the ball's radius but the distance, and the radiance by its inverse square, so that the
    image is the same.
    """

    def light(radius, depth):
        lamp = _transform().look_at([0, 0, 8 + 1.5 * radius], [0, 0, 8], [0, 1, 0]).scale(0.5 * radius)
        scene = _scene(
            sensor=_camera((3, -4, 4), (0, 0, 0), 8),
            floor=_floor(0.5, 3),
            ball={
                "type": "sphere",
                "center": [0, 0, 8],
                "radius": radius,
                "bsdf": {"type": "roughdielectric", "alpha": 0.5},
            },
            lamp={"type": "disk", "to_world": lamp, "bsdf": _grey(0), "emitter": _area(1 / radius**2)},
        )
        return _tiles(scene, {"max_depth": depth, "skip": "none"}, 1024, range(4))[0].mean(1)

    known = light(0.1, 8)
    texts, ok = [], True
    for radius in (1e-2, 3e-3, 1e-3):
        found, short = light(radius, 8), light(radius, 3).mean() / known.mean()
        off = found.mean() / known.mean() - 1
        error = np.hypot(found.std(ddof=1), known.std(ddof=1)) / 2 / known.mean()
        ok &= abs(off) < 0.05 and error < 0.02 and short < 1e-2
        texts.append(
            f"{radius:g}: {100 * off:+.1f} % (± {100 * error:.1f}), {100 * short:.2g} % in three edges"
        )
    return Outcome(bool(ok), "; ".join(texts))


# -- the camera in odd places -----------------------------------------------------------------


def _in_glass() -> Outcome:
    """Inside a glass ball under a sky of radiance 1, off its centre: n^2, since nothing is lost."""
    glass = {"type": "sphere", "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}
    sky = {"type": "constant", "radiance": 1.0}
    scene = _scene(sensor=_camera((0.3, 0.1, 0.2), (1, 1, 0.5), 70), glass=glass, sky=sky)
    floor = {"sensor": _camera((0.3, 0.1, 0.2), (0.4, 0.5, -1), 60), "lamp": _lamp()}
    floor["floor"] = {"type": "rectangle", "to_world": _transform().translate([0, 0, -1.5]).scale(3)}
    room = _scene(**floor, glass=glass)
    known = _known([(scene, 2.25)], {"max_depth": 40}, spp=64)
    same = _against([(room, room, PATH)], {"max_depth": 5}, spp=1024, most_error=0.1)
    return Outcome(known.ok and same.ok, f"sky: {known.happened}; lamp and floor: {same.happened}")


def _odd_cameras(where) -> Outcome:
    """A pinhole on a surface or at a light sees what `path` sees."""
    ball = {"type": "sphere", "center": [0, 0, 0.4], "radius": 0.4, "bsdf": _grey(0.6)}
    parts = {"floor": _floor(), "ball": ball, "lamp": _lamp()}
    if where == "surface":
        cameras = [
            _camera((-1.5, -1, 0), (0, 0, 0.2)),  # in the plane of the floor
            _camera((0, 0, 0.8), (0.4, 0.3, 3), 80, (0, 1, 0)),  # on top of the ball
            _camera((2, 2, 0), (0, 0, 0.3)),  # at the corner of the floor
        ]
    else:
        cameras = [
            _camera((0.4, 0.3, 3), (0, 0, 0), 60),  # in the square of the lamp
            _camera((1.0, -1.2, 1.5), (0, 0, 0.3)),  # at the point light
            _camera(
                (-1, 0.5, 1.2), (0, 0, 0.3)
            ),  # in the middle of a lamp on a sphere, whose inside is black
        ]
        parts["point"] = {"type": "point", "position": [1.0, -1.2, 1.5], "intensity": 5.0}
        parts["bulb"] = {"type": "sphere", "center": [-1, 0.5, 1.2], "radius": 0.1, "emitter": _area(30)}
    scenes = [_scene(sensor=camera, **parts) for camera in cameras]
    return _against([(s, s, PATH) for s in scenes], {"max_depth": 4}, spp=512, most_error=0.05)


_T_TEST = "t-test with Šidák at 1e-3"
_WELCH = f"Welch's {_T_TEST} of tile means over 6 seeds a side, defaults and all strategies"


CASES = (
    _case(
        "plates",
        "two parallel plates 1e-4, 1e-3, … 100 of their width apart",
        f"the analytic form factor: {_T_TEST} over 8 seeds, standard error below 1 %",
        _plates,
    ),
    *(
        _case(
            f"thin-walls-{'out' if inside else 'in'}",
            f"a closed room of 2 with walls 1e-4 thick, lamps {'in' if inside else 'out'}side, camera "
            f"{'out' if inside else 'in'}side",
            "exactly black: no ray may leak",
            partial(_walls, inside),
            not inside,
        )
        for inside in (False, True)
    ),
    _case(
        "touching",
        "a box that stands on the floor, two stacked ones",
        f"the image of a box that is let into the floor: {_WELCH}",
        _touching,
    ),
    _case(
        "coincident",
        "a floor three times in one plane, a ball twice",
        f"the image of one of each: {_WELCH}",
        _coincident,
    ),
    _case(
        "lamp-in-the-ceiling",
        "a lamp in the plane of a black ceiling",
        "finite, and 98 to 100.5 % of the light without the ceiling; which of the two a ray hits is "
        "undefined: hitting the lamp (s = 0) has at most 1.3 % of the weights, strategies that start on it "
        "the rest",
        _lamp_in_the_ceiling,
    ),
    _case(
        "triangles-without-area",
        "triangles without area (points, edges, needles) in a floor and in a lamp",
        f"they change nothing: {_WELCH}",
        _no_area,
        True,
    ),
    _case(
        "lamp-without-area",
        "a lamp of nothing but triangles without area, beside a real one",
        "an error that names the lamp's shape, or an image of finite values",
        _lamp_without_area,
    ),
    *(
        _case(
            f"million-triangles{'-emit' if emits else ''}",
            f"a ball of a million triangles{' that emits' if emits else ''}",
            f"the image of a sphere: {_WELCH}; first render below {LONGEST} s of CPU time (whatever else "
            "runs), mesh and renders below 1 GiB",
            partial(_million, emits),
        )
        for emits in (False, True)
    ),
    _case(
        "grazing-sun",
        "a sun over a floor, cosines 0.1, 1e-2, … 1e-6",
        f"reflectance times irradiance over pi: {_T_TEST} over 8 seeds, standard error below 3 %",
        _grazing,
        True,
    ),
    *(
        _case(
            f"tiny-{kind}",
            f"a lamp on a {kind} of 1e-6",
            f"the light of a point of the same intensity: {_T_TEST} over 8 seeds, standard error below 1 %",
            partial(_tiny, kind),
        )
        for kind in ("rectangle", "disk", "sphere")
    ),
    _case(
        "hidden-lamps",
        "lamps on spheres and cylinders of 1e-2 to 1e-6, 8 above a floor, a black plate 0.02 to 0.07 below",
        "no light at all; without the plate that of a lamp ten times as large and as bright altogether, to "
        "3 % (one render of 2^15 samples each)",
        _hidden,
        True,
    ),
    _case(
        "large-floors",
        "a ball and a lamp on floors of half-width or radius 1e3 and 3e3, turned: rectangles, cubes, "
        "spheres, cylinders; on a cube that an instance brings 1000 units back",
        f"what `path` sees on a rectangle of 30: {_WELCH}, standard error of a tile below 0.5 %",
        _large,
    ),
    _case(
        "large-flat-floors",
        "a box of 0.1 and a lamp on floors of half-width 1e4 along the axes, a rectangle and a cube, and on "
        "a grid of signed distances 300 wide, slanting",
        f"what `path` sees on a rectangle of 10: {_WELCH}, standard error of a tile below 0.5 %",
        _large_and_flat,
    ),
    _case(
        "cylinders-in-groups",
        "a cylinder of radius 0.02, seen and lit from 7 away, as an instance of one of radius 1",
        f"the same cylinder without a group: {_WELCH}, standard error of a tile below 0.5 %",
        _in_groups,
    ),
    _case(
        "scaled-spheres",
        "white spheres in instances that stretch, squash or shrink them, under a sky of radiance 1",
        "radiance 1; by default to 2e-3 or twice the error of `path`, with all strategies to 10 % (where "
        "spheres are squashed or shrunk, Mitsuba's hits are off by more than the offset of rays)",
        _scaled_spheres,
    ),
    _case(
        "lit-through",
        "a lamp on a ball of rough glass of 1e-2 to 1e-3, 8 above a floor",
        "the light of a ball of 0.1 as bright altogether, to 5 % (8 +- 0.1 is worth 2.5 %; standard error "
        "below 2 %), less than 1 % of it in paths of three edges, which cannot enter and leave the ball",
        _lit_through,
    ),
    _case(
        "camera-in-glass",
        "the camera in a glass ball, under a sky and in a lit room",
        f"n^2 = 2.25 times the sky's radiance; in the room what `path` sees: {_WELCH}",
        _in_glass,
    ),
    *(
        _case(
            f"camera-{name}",
            f"the pinhole {words}",
            f"what `path` sees: {_WELCH}",
            partial(_odd_cameras, where),
        )
        for name, where, words in (
            ("on-a-surface", "surface", "in the plane of a floor, on a ball, at a corner"),
            ("at-a-light", "light", "in a lamp's surface, at a point light, in a lamp on a sphere"),
        )
    ),
)
