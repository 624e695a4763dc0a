"""Fog, milk and clouds that nobody would write: empty, opaque, broken, nested, without an end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import mitsuba as mi  # isort: skip

from .agreement import WAYS, against, images, tiles, together, worst
from .case import Outcome, of_section
from .poisons import camera
from .transport import WELCH, bdpt, diffuse, place
from .warned import Warned

_case = of_section("Media")

SEEDS, SPP, DEPTH = range(8), 64, 5

# What the image's mean may be off without being seen.
REACH = 0.01

VOLPATH = {"type": "volpath", "max_depth": DEPTH}

# Nested boundaries.
BOXES = 32


def fog(extinction: float, **more) -> dict:
    return {"type": "homogeneous", "sigma_t": float(extinction), "albedo": 0.9, **more}


def cloud(data, scale: float = 1.0) -> dict:
    """A medium on a grid that fills `box`."""
    density = {"type": "gridvolume", "grid": mi.VolumeGrid(np.asarray(data, dtype=np.float32)[..., None])}
    density["to_world"] = place().translate([-0.55, -0.55, -0.6]).scale(0.6)
    return {"type": "heterogeneous", "albedo": 0.9, "scale": float(scale), "sigma_t": density}


def box(size: float = 0.3, **sides) -> dict:
    """A null boundary in the shape of a cube, of half this ``size``."""
    to_world = place().translate([-0.25, -0.25, -0.3]).scale(float(size))
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, **sides}


def room(sensor=None, **parts):
    """A matte sphere around a camera and a glowing ball."""
    lamp = {"type": "area", "radiance": 4.0}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor or camera(),
            "wall": {"type": "sphere", "bsdf": diffuse(0.6)},
            "lamp": {"type": "sphere", "center": [0.3, 0.35, -0.3], "radius": 0.15, "emitter": lamp},
            **parts,
        }
    )


def in_all_ways(
    scene, other, integrator=None, what: str = "without", reach: float = REACH, light=True
) -> Outcome:
    """Our image of a ``scene``, with all strategies and by default, beside one of the ``other``.

    "All strategies" have to trace light subpaths, or if not ``light`` none: so it is in scenes that
    contradict themselves.
    """
    integrator = integrator or bdpt(max_depth=DEPTH)
    theirs = tiles(other, integrator, [seed + 100 for seed in SEEDS], 4 * SPP)
    outcomes = {
        name: against(tiles(scene, bdpt(max_depth=DEPTH, **way), SEEDS, SPP), theirs, reach, what)
        for name, way in WAYS.items()
    }
    for name, way in WAYS.items():
        method = mi.load_dict(bdpt(max_depth=DEPTH, **way))
        method.render(scene, spp=1)
        traced = method.statistics["rays"].get("light", 0)
        if way and bool(traced) != light:
            outcomes[name] = replace(outcomes[name], ok=False, happened=f"{traced} light subpaths' rays")
    return worst(outcomes)


def empty_grid() -> Outcome:
    return in_all_ways(room(cloud=box(interior=cloud(np.zeros((4, 4, 4))))), room())


def nested() -> Outcome:
    """`BOXES` empty ones, one in the other."""
    boxes = {}
    for i in range(BOXES):
        outside = {"exterior": fog(0)} if i else {}
        boxes[f"box{i}"] = box(0.3 * (1 - i / (BOXES + 1)), interior=fog(0), **outside)
    return in_all_ways(room(**boxes), room())


def opaque(medium) -> Outcome:
    """What is inside reflects less than it gets: the image lies between a black box's and an empty one's."""
    scene = room(cloud=box(interior=medium))
    black = room(cloud=box() | {"bsdf": {"type": "diffuse", "reflectance": 0.0}})
    bounds = [tiles(other, bdpt(max_depth=DEPTH), SEEDS, SPP)[:, -1].mean() for other in (black, room())]
    outcomes = {}
    for name, way in WAYS.items():
        found = tiles(scene, bdpt(max_depth=DEPTH, **way), SEEDS, SPP)
        mean = found[:, -1].mean()
        ok = np.isfinite(found).all() and bounds[0] < mean < bounds[1]
        outcomes[name] = Outcome(bool(ok), f"mean {mean:.4g} between {bounds[0]:.4g} and {bounds[1]:.4g}")
    return together(outcomes)


def not_a_number() -> Outcome:
    """One voxel of a grid is NaN."""
    data = np.ones((4, 4, 4))
    data[1, 2, 2] = np.nan
    scene = room(cloud=box(interior=cloud(data, 3)))
    outcomes = {}
    for name, way in WAYS.items():
        with Warned() as warned:
            found = list(images(scene, bdpt(max_depth=DEPTH, **way), SEEDS, SPP))
        finite = all(np.isfinite(image).all() for image, _ in found)
        counted = sum(count for _, count in found)
        named = any("sigma_t" in text for text in warned)
        text = f"{counted} values counted as zero, the grid {'named' if named else 'not named'}"
        outcomes[name] = Outcome(finite and named, text if finite else "the image is not finite")
    return together(outcomes)


def without_boundary() -> Outcome:
    """A lamp and a camera in fog, and nothing else: what is seen is what the fog scatters."""
    sensor = camera() | {"medium": fog(0.5)}
    scene = mi.load_dict(
        {"type": "scene", "sensor": sensor, "lamp": {"type": "point", "position": [0.2, 0.1, -0.8]}}
    )
    # Of a lamp without area `volpath` sees one in so many samples through the fog.
    return in_all_ways(scene, scene, VOLPATH, "`volpath`", 0.15)


def on_a_boundary() -> Outcome:
    """The camera's pinhole lies in the face of a box of fog: half of what surrounds it is fog."""
    at = np.array(camera()["to_world"].matrix).reshape(4, 4)[:3, 3]
    milk = {"type": "cube", "to_world": place().translate([*(at - [0, 0, 0.2])]).scale(0.2)}
    scene = room(milk=milk | {"bsdf": {"type": "null"}, "interior": fog(2)})
    return in_all_ways(scene, scene, VOLPATH, "`volpath`", 0.02, light=False)


CASES = (
    _case("media-empty-grid", "a grid of density 0", f"as without it: {WELCH}", empty_grid),
    _case(
        "media-opaque-grid",
        "a grid of density 1e6, whose mean free path is 1e-6 of the scene",
        "finite, brighter than a black box and darker than none",
        lambda: opaque(cloud(np.ones((4, 4, 4)), 1e6)),
    ),
    _case(
        "media-opaque-fog",
        "fog of extinction 1e6 in a box",
        "finite, brighter than a black box and darker than none",
        lambda: opaque(fog(1e6)),
    ),
    _case(
        "media-nan-voxel",
        "a voxel that is NaN",
        "every value finite; what is not counts as zero, and a warning names the grid",
        not_a_number,
        True,
    ),
    _case(
        "media-without-boundary",
        "a point lamp and a camera in fog without end, and no shape",
        f"as `volpath`: {WELCH}",
        without_boundary,
    ),
    _case(
        "media-nested-boxes",
        f"{BOXES} empty boxes with null boundaries, one in the other",
        f"as without them: {WELCH}. (`volpath` loses 3 % of what next-event estimation finds behind them)",
        nested,
    ),
    _case(
        "media-camera-on-a-boundary",
        "a pinhole in the face of a box of fog",
        f"as `volpath`, by camera subpaths alone (whatever the sensor declares contradicts a side): {WELCH}",
        on_a_boundary,
    ),
)
