"""Fog, milk and clouds that nobody would write: empty, opaque, broken, nested, seen from their boundary."""

import mitsuba as mi
import numpy as np
import pytest
from scene_parts import T
from warned import Warned

from .compare import WAYS, agree, tiles
from .rooms import area, camera, diffuse, loaded

SEEDS, SPP, DEPTH = range(8), 64, 5


def fog(extinction: float) -> dict:
    return {"type": "homogeneous", "sigma_t": float(extinction), "albedo": 0.9}


def cloud(data, scale: float = 1.0) -> dict:
    """A medium on a grid that fills `box`."""
    density = {"type": "gridvolume", "grid": mi.VolumeGrid(np.asarray(data, dtype=np.float32)[..., None])}
    density["to_world"] = T().translate([-0.55, -0.55, -0.6]).scale(0.6)
    return {"type": "heterogeneous", "albedo": 0.9, "scale": float(scale), "sigma_t": density}


def box(size: float = 0.3, **sides) -> dict:
    """A null boundary in the shape of a cube, of half this ``size``."""
    to_world = T().translate([-0.25, -0.25, -0.3]).scale(float(size))
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}} | sides


def room(**found):
    """A matte sphere around a camera and a glowing ball."""
    lamp = {"type": "sphere", "center": [0.3, 0.35, -0.3], "radius": 0.15, "emitter": area(4.0)}
    return loaded(camera(), **{"wall": {"type": "sphere", "bsdf": diffuse(0.6)}, "lamp": lamp} | found)


def like(scene, other, reach=0.01, light=True, **integrator) -> None:
    """Compare a ``scene`` with an ``other`` one.

    All strategies have to trace light subpaths or, in scenes that contradict themselves, none.
    """
    depth = {"max_depth": DEPTH}
    theirs = tiles(other, integrator | depth, [seed + 100 for seed in SEEDS], 4 * SPP)
    for way in WAYS.values():
        agree(tiles(scene, way | depth, SEEDS, SPP), theirs, reach)
    method = mi.load_dict({"type": "bdpt", "skip": "none"} | depth)
    method.render(scene, spp=1)
    assert bool(method.statistics["rays"].get("light", 0)) == light


def test_nested_boxes():
    """32 empty boxes with null boundaries, one in the other.

    Expected: as without them: Welch's test of tiles (1e-3), which sees errors of 1 %. (`volpath` loses 3 % of
    what next-event estimation finds behind them.)
    """
    sides = [{"interior": fog(0)} | ({"exterior": fog(0)} if i else {}) for i in range(32)]
    like(room(**{f"box{i}": box(0.3 * (1 - i / 33), **side) for i, side in enumerate(sides)}), room())


@pytest.mark.parametrize("kind", ["grid", "fog"])
def test_opaque(kind):
    """A grid of density 1e6, whose mean free path is 1e-6 of the scene; fog of extinction 1e6.

    Expected: finite, brighter than a black box and darker than none.
    """
    depth = {"max_depth": DEPTH}
    scene = room(cloud=box(interior=cloud(np.ones((4, 4, 4)), 1e6) if kind == "grid" else fog(1e6)))
    black = box(bsdf={"type": "diffuse", "reflectance": 0.0})
    low, high = (tiles(other, depth, SEEDS, SPP)[:, -1].mean() for other in (room(cloud=black), room()))
    for way in WAYS.values():
        found = tiles(scene, way | depth, SEEDS, SPP)
        print(f"mean {found[:, -1].mean():.4g} between {low:.4g} and {high:.4g}")
        assert np.isfinite(found).all()
        assert low < found[:, -1].mean() < high


@pytest.mark.parametrize("way", WAYS)
def test_nan_voxel(way):
    """A voxel that is NaN.

    Expected: every value finite; what is not counts as zero, and a warning names the grid.
    """
    data = np.ones((4, 4, 4))
    data[1, 2, 2] = np.nan
    with Warned() as warned:
        found = tiles(room(cloud=box(interior=cloud(data, 3))), WAYS[way] | {"max_depth": DEPTH}, SEEDS, SPP)
    assert np.isfinite(found).all()
    assert any("sigma_t" in text for text in warned)


def test_camera_on_a_boundary():
    """A pinhole in the face of a box of fog: half of what surrounds it is fog.

    Expected: as `volpath`, by camera subpaths alone (whatever the sensor declares contradicts a side):
    Welch's test of tiles (1e-3), which sees errors of 2 %.
    """
    at = np.array(camera()["to_world"].matrix).reshape(4, 4)[:3, 3]
    place = T().translate([*(at - [0, 0, 0.2])]).scale(0.2)
    scene = room(milk={"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": fog(2)})
    like(scene, scene, 0.02, light=False, type="volpath")
