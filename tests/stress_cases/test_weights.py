"""The weights of all strategies that could have made a path of the kernel: they sum to 1."""

from itertools import cycle

import mitsuba as mi
import pytest
from scene_parts import T, film, grey

from scenes import area, floor

from .chance import by_chance
from .random_scenes import LAMPS, SHAPES, kinds_of, renders
from instruments.capture import Capture, Weighed

# Share of the kernel's paths that may be left out since rounding decides (else a fault may hide there); 0.4
# to 1.3 % are, nearly all for their short edges: where the sky lights, rays are long, and offsets grow with
# them.
MOST_UNSURE = 0.02


def check(found: Weighed, least: int) -> None:
    print(f"{found.paths:,} paths, {found.unsure} left out; weights differ by {found.differ:.1e} at most")
    assert found.bad == found.off == found.wrong == 0
    assert found.unsure <= MOST_UNSURE * found.paths
    assert found.paths >= least


@pytest.mark.parametrize(
    "heuristic, scenes, lanes, least", [("balance", 26, 1 << 16, 4 * 10**6), ("power", 8, 3 << 14, 10**6)]
)
def test_paths_of_the_kernel(heuristic, scenes, lanes, least):
    """Paths that the kernel makes in random scenes (shapes, BSDFs, every kind of lamp, sensors, coefficients,
    all connections or one); its own weight, and those of all other strategies from densities asked of the
    scene anew.

    Expected: every sum is 1 within 1e-3 and no weight is negative, above 1 or not finite; the kernel's own
    weight is that by explicit densities within 1e-3; 4e6 paths at least (1e6 of `power`). Left out, 2 % at
    most: at the rim of a disk on which light from the sky starts, at the poles of an `envmap`, on the surface
    of a lamp, along edges so short that the offset of rays turns them by more than 1e-3 of a cosine.
    """
    found, seen = Weighed(), set()

    def add(render):
        scene, parameters = render
        seen.update(kinds_of(scene))
        integrator = {"type": "bdpt", "max_depth": 6, "heuristic": heuristic} | parameters
        found.add(Capture(mi.load_dict(scene), mi.load_dict(integrator), lanes, seed=3), heuristic)
        assert found.bad == found.off == found.wrong == 0, render

    by_chance(renders(cycle(LAMPS)), add, scenes)
    check(found, least)
    assert len(seen) >= min(scenes, len(LAMPS))


def test_paths_around_a_glint():
    """Paths that the kernel makes around a lamp on a sphere of radius 1e-3, 0.2 above a box and 1 above a
    floor, both diffuse; Mitsuba's density for the cone towards it is off by 0.4 % there and more.

    Expected: as of random scenes; 20,000 paths at least.
    """
    view = T().look_at([0, 0.5, 4], [0, -0.3, 0], [0, 1, 0])
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 50.0, "to_world": view, "film": film(16)},
        "floor": floor(-1, 4, grey(0.6)),
        "box": SHAPES["cube"]([0, -0.6, 0], 0, 0.4) | {"bsdf": grey(0.6)},
        "lamp": {"type": "sphere", "radius": 1e-3, "bsdf": {"type": "diffuse"}, "emitter": area(4.0)},
    }
    integrator, found = mi.load_dict({"type": "bdpt", "max_depth": 4, "skip": "none"}), Weighed()
    found.add(Capture(mi.load_dict(scene), integrator, 1 << 15, 9), "balance")
    check(found, 20_000)
