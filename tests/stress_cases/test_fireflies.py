"""The worst samples of a render: whether each is what its path says, and whether others would do."""

import mitsuba as mi
import pytest
from repository import benchmark_depth, load_reference, load_scene

from instruments import fireflies

RESOLUTION, SPP, TOP = 32, 32, 32

# Samples that are off by more than so many values of their pixel (where those of a Cornell box are not).
LARGE = 3.0


def undrawn(firefly) -> float:
    """By how many values of its pixel a sample would be off without the draw of a connection and roulette."""
    path = firefly.path
    return firefly.off * (path.estimate * path.weight).max() / path.value.max()


@pytest.mark.parametrize(
    "name", ["glass_caustics", "cornell_box", "smallvcm_cornell_lamp", "smallvcm_cornell_sun"]
)
def test_explained(name):
    """The 32 worst samples of each of two renders of a scene (32², 32 samples per pixel), each path found
    anew with Mitsuba's calls, densities of all strategies written out.

    Expected: all have the estimate and the weight that follow from their vertices (1 %: float32 directions at
    rough surfaces); those that are off by more than three values of their pixel, also without the draw of a
    connection and its roulette, can be made by one strategy alone.
    """
    depth = benchmark_depth(name)
    scene = load_scene(name, resolution=RESOLUTION)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "guiding": "never"})
    image = load_reference(name, 128, depth).image.astype(float)  # its filter is a box
    target = image.reshape(RESOLUTION, 4, RESOLUTION, 4, 3).mean(axis=(1, 3))
    found = []
    for seed in (1, 2):
        found += fireflies.fireflies(scene, integrator, target, SPP, seed, 0.1, TOP)[1]
    large = [f for f in found if f.off > LARGE]
    print(f"{len(found)} samples, {len(large)} off by more than {LARGE:g}")
    assert len(found) >= TOP
    assert {f.doubt for f in found} == {""}
    assert [f.letters for f in large if fireflies.in_use(f).sum() > 1 and undrawn(f) > LARGE] == []
