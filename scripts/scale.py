"""What is fixed per render, per object and per pass: times of `bdpt` over `path` as scenes grow.

    python scripts/scale.py                          # all rows; writes docs/reports/scale.json
    python scripts/scale.py lamps film               # rows of these kinds, printed

A row is a kind of object (lamps, materials, ...; or pixels, samples, edits, film filters) and a size: how
many there are, or which. It has a process of its own with an empty kernel cache, which has rendered something
before. There `path`, `bdpt` and path tracing alone (``light_paths=0``) render the scene one after the other,
then in turns; 64^2 pixels, 16 samples per pixel, ``max_depth`` 6 where nothing else is said. Columns:
processor seconds of the first image and, median, of a warm render, as ratios over `path`; what an object adds
to the difference between `bdpt` and `path`; peak memory of the first render; of films of one pixel, time
times the variance over the seeds. A kind ends where a row takes longer than `PATIENCE`; the table says so.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import command_line
import numpy as np
import pandas as pd
import repository
import room
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.files.texts import write_text
from mitsuba_bdpt.host import memory
from mitsuba_bdpt.host.introspection import versions
from mitsuba_bdpt.measure.tables import markdown, ratio
from mitsuba_bdpt.measure.timing import alternating

import scenes

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

RECORD = repository.ROOT / "docs" / "reports" / "scale.json"
DEPTH = 6
METHODS = {
    "path": {"type": "path"},
    "bdpt": {"type": "bdpt"},
    "alone": {"type": "bdpt", "light_paths": 0},
}
"""Integrators by their names in the record; ``alone``: path tracing alone."""
PATIENCE = 60.0  # seconds of a row after which a kind has no larger one
WARM_SECONDS, ROUNDS = 4.0, (3, 15)
"""Of the warm renders of a row: how long they may take, and the least and the most rounds."""
ROUNDS_OF_NOISE, SECONDS_OF_NOISE = 10, 20.0
"""Of the warm renders of one pixel: the least rounds that show its noise, and how long they may take."""


def ground(width: int = 64, rfilter: str = "box", **objects: dict) -> dict:
    """A scene of a diffuse floor of 12 x 12 units and ``objects``, seen from above in ``width``^2 pixels."""
    view = scenes.camera(origin=(0, 6, 9), target=(0, 0, 0), fov=55, size=width, rfilter=rfilter)
    return {"type": "scene", "sensor": view, "floor": scenes.floor(size=6)} | objects


def lamp() -> dict:
    """A square above the ground that emits."""
    return scenes.square((0, 5, 0), scenes.DOWNWARDS, emitter=scenes.area(10.0))


def grid(count: int) -> list[tuple[float, float, float]]:
    """Positions (x, z) of ``count`` objects on the ground, each with the radius of a sphere that fits."""
    side = int(np.ceil(np.sqrt(count)))
    cell = 10 / side
    return [((i % side + 0.5) * cell - 5, (i // side + 0.5) * cell - 5, 0.4 * cell) for i in range(count)]


def spheres(count: int) -> dict:
    """Spheres of one material."""
    shared, used = {"type": "roughconductor", "id": "shared", "alpha": 0.2}, {"type": "ref", "id": "shared"}
    balls = {f"ball{i}": scenes.ball(used, r, (x, r, z)) for i, (x, z, r) in enumerate(grid(count))}
    return ground(shared=shared, lamp=lamp(), **balls)


def instances(count: int) -> dict:
    """Instances of one group of shapes."""
    group = {"type": "shapegroup", "cube": {"type": "cube", "bsdf": {"type": "diffuse"}}}
    placed = {}
    for i, (x, z, r) in enumerate(grid(count)):
        place = scenes.transform().translate([x, r, z]).rotate([0, 1, 0], 37 * i).scale(0.7 * r)
        used = {"type": "ref", "id": "group"}
        placed[f"placed{i}"] = {"type": "instance", "to_world": place, "group": used}
    return ground(group=group, lamp=lamp(), **placed)


def materials(count: int) -> dict:
    """Spheres with a material each."""
    balls = {}
    for i, (x, z, r) in enumerate(grid(count)):
        colour = scenes.rgb(0.2 + 0.6 * i / count, 0.5, 0.8 - 0.6 * i / count)
        bsdf = {"type": "principled", "base_color": colour, "roughness": 0.2 + 0.6 * i / count}
        balls[f"ball{i}"] = scenes.ball(bsdf, r, (x, r, z))
    return ground(lamp=lamp(), **balls)


def lamps(count: int) -> dict:
    """Spherical lamps."""
    made = {}
    for i, (x, z, r) in enumerate(grid(count)):
        made[f"lamp{i}"] = scenes.ball(scenes.matte(), 0.2 * r, (x, 2, z), emitter=scenes.area(1.0 + i % 7))
    return ground(**made)


def picture(random, low: float, high: float, size: int) -> dict:
    """A texture of random texels."""
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(random.uniform(low, high, (size, size, 3)).astype(np.float32)),
    }


def textured_lamps(count: int) -> dict:
    """Square lamps with a picture each."""
    random, made = np.random.default_rng(1), {}
    for i, (x, z, r) in enumerate(grid(count)):
        emitter = scenes.area(picture(random, 0.1, 5, 8) | {"raw": True})
        made[f"lamp{i}"] = scenes.square((x, 3, z), scenes.DOWNWARDS, 0.5 * r, emitter=emitter)
    return ground(**made)


def waves(triangles: int, height: float) -> mi.Mesh:
    """A mesh of about ``triangles`` triangles with vertex normals, 4 x 4 units, which faces down."""
    side = max(1, round((triangles / 2) ** 0.5))
    x, z = np.meshgrid(*2 * [np.linspace(-2, 2, side + 1)])
    y = height + 0.2 * np.sin(2 * x) * np.cos(2 * z)
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    faces = [(first, first + 1, first + side + 2), (first, first + side + 2, first + side + 1)]
    mesh = mi.Mesh("waves", (side + 1) ** 2, 2 * side**2, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.stack([x, y, z], -1).ravel().astype(np.float32))
    parameters["faces"] = mi.UInt32(
        np.concatenate([np.stack(f, -1) for f in faces]).ravel().astype(np.uint32)
    )
    parameters.update()
    return mesh


def lamp_mesh(triangles: int) -> dict:
    """A lamp of about ``triangles`` triangles; writes its mesh into the working directory."""
    waves(triangles, 4.0).write_ply("lamp.ply")
    lamp = {"type": "ply", "filename": "lamp.ply", "face_normals": False, "emitter": scenes.area(10.0)}
    return ground(lamp=lamp)


def film(width: int) -> dict:
    """A ball on the ground and a lamp, in ``width``^2 pixels."""
    return ground(width, ball=scenes.ball({"type": "plastic"}, center=(0, 1, 0)), lamp=lamp())


def meter(samples: int) -> dict:
    """An irradiance meter on the ground."""
    scene = film(1)
    scene["meter"] = scenes.square((0, 0.01, 2), scenes.UPWARDS, 0.1, sensor=scenes.meter())
    del scene["sensor"]
    return scene


def cornell(width: int, rfilter: str = "box") -> dict:
    """Mitsuba's Cornell box."""
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": width, "height": width, "rfilter": {"type": rfilter}}
    return scene


def edited(kind: str) -> dict:
    """What edits change: a lamp, a picture on the floor, a mesh, a camera."""
    waves(1000, 0.5).write_ply("waves.ply")
    scene = film(64)
    reflectance = picture(np.random.default_rng(1), 0.2, 0.8, 64)
    scene["floor"]["bsdf"] = {"type": "diffuse", "reflectance": reflectance}
    grey = scenes.both_sides(0.5)  # the mesh faces down
    return scene | {"mesh": {"type": "ply", "filename": "waves.ply", "bsdf": grey}}


EDITS = {
    "nothing": None,
    "lamp": "lamp.emitter.radiance.value",
    "material": "ball.bsdf.diffuse_reflectance.value",
    "texture": "floor.bsdf.reflectance.data",
    "vertices": "mesh.vertex_positions",
    "camera": "sensor.to_world",
}
"""Parameters that are edited before each render, by what is edited."""


def edit(scene: mi.Scene, name: str, seed: int) -> None:
    """Change a parameter of `EDITS` a little, by another amount for each seed."""
    if (key := EDITS[name]) is None:
        return
    parameters = mi.traverse(scene)
    if name == "camera":
        parameters[key] = mi.Transform4f(
            mi.ScalarTransform4f().look_at([0.01 * seed, 6, 9], [0, 0, 0], [0, 1, 0])
        )
    else:
        parameters[key] = parameters[key] * (1 + 0.001 * (seed % 7 - 3))
    parameters.update()


@dataclass(frozen=True)
class Kind:
    """What there is more and more of: ``what`` in words, ``sizes`` (numbers, or names), the scene of a size.

    ``spp``: samples per pixel of a size. ``before``: called with scene, size and seed before each render.
    ``has_slope``: what one more of them takes is a figure. ``one_pixel``: and so is the noise of the image.
    """

    what: str
    sizes: tuple[int | str, ...]
    scene: Callable[..., dict]
    spp: Callable[..., int] = field(default=lambda size: 16)
    before: Callable[[mi.Scene, str, int], None] | None = None
    has_slope: bool = True
    one_pixel: bool = False


KINDS = {
    "spheres": Kind("spheres of one material", (10, 100, 1000, 10000), spheres),
    "instances": Kind("instances", (10, 100, 300, 1000), instances),
    "materials": Kind("spheres with a material each", (10, 100, 300, 1000), materials),
    "rooms": Kind(
        "materials of a room, see room.py", (10, 27, 40), lambda n: room.lit_room("ceiling", n, 64, 64)
    ),
    "lamps": Kind("spherical lamps", (10, 100, 1000, 10000), lamps),
    "textured lamps": Kind("square lamps with a picture each", (10, 128, 1000), textured_lamps),
    "lamp mesh": Kind("triangles of one lamp", (1000, 10000, 100000, 1000000), lamp_mesh),
    "film": Kind(
        "pixels a side, 2^20 samples in all, one a pixel at least",
        (1, 16, 256, 1024, 4096),
        film,
        lambda width: max(1, 2**20 // width**2),
        has_slope=False,
    ),
    "samples": Kind(
        "samples of one pixel", (1, 100, 10**4, 10**6, 10**7), lambda n: film(1), lambda n: n, one_pixel=True
    ),
    "meter": Kind("samples of an irradiance meter", (10**4, 10**6), meter, lambda n: n, one_pixel=True),
    "previews": Kind(
        "samples per pixel, `cornell_box`, 64^2",
        (1, 8, 64),
        lambda n: cornell(64),
        lambda n: n,
        has_slope=False,
    ),
    "edits": Kind("an edit before each render", tuple(EDITS), edited, before=edit),
    "filters": Kind(
        "film filter, `cornell_box`, 128^2, 64 samples per pixel",
        ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos"),
        lambda name: cornell(128, name),
        lambda name: 64,
    ),
}


def over_path(row: dict, figure: str, method: str) -> float:
    """A time (``first``, ``warm``) of a method over that of `path`."""
    return row[method][figure] / row["path"][figure]


def effort(row: dict, method: str) -> float | None:
    """Time times variance of a film of one pixel, over those of `path`; None if it was not measured."""
    both = [row[name]["warm"] * row[name].get("variance", 0) for name in (method, "path")]
    return both[0] / both[1] if all(both) else None


def slope(rows: list[dict], row: dict, method: str) -> float:
    """Milliseconds that an object adds to a warm render beyond `path`, since the next smaller row."""
    last = rows[rows.index(row) - 1]
    extra = [1e3 * (of[method]["warm"] - of["path"]["warm"]) for of in (last, row)]
    return (extra[1] - extra[0]) / (row["size"] - last["size"])


FIGURES: dict[str, Callable[[list[dict], dict, str], float]] = {
    "warm": lambda rows, row, method: over_path(row, "warm", method),
    "first": lambda rows, row, method: over_path(row, "first", method),
    "slope": slope,
    "memory": lambda rows, row, method: row[method]["memory"] / 2**30,
    "over box": lambda rows, row, method: over_path(row, "warm", method) / over_path(rows[0], "warm", method),
}
"""Figures for goals.toml, given the rows of a kind, one of them and a method."""


def taken(kind: Kind, size: int | str, scene: mi.Scene, integrator: mi.Integrator, seed: int) -> dict:
    """Processor seconds of an edit, if the kind has one, and a render; the image's mean."""
    dr.sync_thread()
    started = time.process_time()
    if kind.before:
        kind.before(scene, str(size), seed)
    image = mi.render(scene, integrator=integrator, spp=kind.spp(size), seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return {"seconds": time.process_time() - started, "mean": float(np.mean(image))}


def forget_peak() -> int:
    """Free what Dr.Jit keeps, forget the peak of this process's memory; return the bytes it takes now."""
    gc.collect()
    dr.flush_malloc_cache()
    if Path("/proc/self/clear_refs").exists():  # Linux
        Path("/proc/self/clear_refs").write_text("5")
    return memory.peak() or 0


def here(kind: Kind, size: int | str) -> dict:
    """The times of a size, rendered in this process: {method: {figure: value}}, see `FIGURES`."""
    integrators = {name: mi.load_dict(given | {"max_depth": DEPTH}) for name, given in METHODS.items()}
    small = mi.load_dict(ground(16, sky={"type": "constant"}))
    found, renders = {}, {}
    for integrator in integrators.values():
        dr.eval(mi.render(small, integrator=integrator, spp=1))
    scene = mi.load_dict(kind.scene(size))  # one for all: virtual calls visit the shapes of all scenes
    for name, integrator in integrators.items():
        renders[name] = partial(taken, kind, size, scene, integrator)
        before = forget_peak()
        first = renders[name](0)["seconds"]
        found[name] = {"first": first, "memory": (memory.peak() or 0) - before}
    warm, started = [], time.perf_counter()
    most = SECONDS_OF_NOISE if kind.one_pixel else WARM_SECONDS
    for turn in alternating(list(renders.values()), ROUNDS[1], is_warm=True):
        warm.append(turn)
        if len(warm) >= ROUNDS[0] and time.perf_counter() - started >= most:
            break
    for name, times in zip(renders, zip(*warm, strict=True), strict=True):
        found[name]["warm"] = statistics.median(one["seconds"] for one in times)
        if kind.one_pixel and len(times) >= ROUNDS_OF_NOISE:
            means = [one["mean"] for one in times]
            found[name]["variance"] = statistics.variance(means) / statistics.mean(means) ** 2
    return found


def apart(name: str, size: int | str) -> dict:
    """The row of a size, rendered in a new process with an empty kernel cache."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as empty:
        done = subprocess.run(
            [sys.executable, __file__, "--here", name, json.dumps(size)],
            env=os.environ | {"DRJIT_CACHE_DIR": empty, "HOME": empty},
            capture_output=True,
            text=True,
            cwd=empty,
        )
    if done.returncode:
        raise CommandError(f"{name} {size} ended with status {done.returncode}: {done.stderr[-500:]}")
    row = {"kind": name, "size": size} | json.loads(done.stdout.splitlines()[-1])
    return row | {"seconds": round(time.perf_counter() - started, 1)}


def rows_of(name: str, sizes: Iterable[int | str]) -> list[dict]:
    """The rows of a kind, up to one that takes longer than `PATIENCE`; says each."""
    rows: list[dict] = []
    for size in sizes:
        if rows and rows[-1]["seconds"] > PATIENCE:
            print(f"{name} {size}: not tried, the last took {rows[-1]['seconds']} s", flush=True)
            continue
        rows.append(apart(name, size))
        found = cells(rows, rows[-1])
        print(name, *(f"{head}: {cell}" for head, cell in found.items()), sep="\n    ", flush=True)
    return rows


def cells(rows: list[dict], row: dict) -> dict[str, str]:
    """A line of a table, by columns."""
    warm, size = 1e3 * row["path"]["warm"], row["size"]
    counted = row is not rows[0] and isinstance(size, int) and KINDS[row["kind"]].has_slope
    found = {
        "size": f"{size:,}" if isinstance(size, int) else size,
        "first image: `path`, s": f"{row['path']['first']:.2g}",
        "warm: `path`, ms": f"{warm:.3g}" if warm < 1000 else f"{warm:,.0f}",
    }
    for method, name in (("bdpt", "`bdpt`"), ("alone", "path tracing alone")):
        noise = effort(row, method)
        found |= {
            f"first image: {name}": ratio(over_path(row, "first", method)),
            f"warm: {name}": ratio(over_path(row, "warm", method)),
            f"an object, ms beyond `path`: {name}": f"{slope(rows, row, method):.3g}" if counted else "–",
            f"one pixel, time × variance: {name}": "–" if noise is None else ratio(noise),
        }
    memory = {f"memory, GiB: `{of}`": f"{row[of]['memory'] / 2**30:.2f}" for of in ("path", "bdpt")}
    return found | memory


def tables(record: dict) -> str:
    """The tables of a record, as Markdown: one of all kinds' rows each."""
    parts = []
    for name, kind in KINDS.items():
        rows = [row for row in record["rows"] if row["kind"] == name]
        left = [str(size) for size in kind.sizes if size not in [row["size"] for row in rows]]
        note = (
            f" Not tried, as the row before takes over {PATIENCE:.0f} s: {', '.join(left)}." if left else ""
        )
        parts.append(
            f"**{name}**: {kind.what}.{note}\n\n" + markdown(pd.DataFrame([cells(rows, row) for row in rows]))
        )
    return "\n".join(parts)


def main(arguments=None) -> int:
    """Run the command line."""
    parser = command_line.parser(__doc__)
    parser.add_argument("kinds", nargs="*", help="kinds of rows; default: all, and the record is written")
    parser.add_argument("--here", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    if asked.here:
        mi.set_log_level(mi.LogLevel.Error)  # warnings would begin the line of the row
        name, size = asked.here
        print(json.dumps(here(KINDS[name], json.loads(size))))
        return 0
    for name in asked.kinds:
        if name not in KINDS:
            raise CommandError(f"kind={name!r} is not known; use some of {', '.join(KINDS)}")
    rows = []
    for name in asked.kinds or KINDS:
        rows += rows_of(name, KINDS[name].sizes)
    if not asked.kinds:
        record = {"versions": versions(), "rows": rows}
        write_text(RECORD, json.dumps(record, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
