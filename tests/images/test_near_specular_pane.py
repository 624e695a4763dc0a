"""Merging under panes that are nearly deltas: the floor has the light that it has under ideal glass.

A point light above a pane of glass, a floor below, the camera above. The highlight of the light in the pane,
which `dielectric` does not have, is left out: the middle of the image, and what a black floor shows of it.
Lobes blur the floor's irradiance by their width, which its mean does not show: it is that under `dielectric`,
which `test_merging.py` compares with a closed form.
"""

from functools import cache

import numpy as np
import pytest
import sds_scenes
from sds_scenes import glass, matte, principled, rough, transform

import scenes

SIZE, SEEDS = 48, 4
# Pixels around the highlight.
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
BESIDE = np.hypot(ROWS, COLUMNS) > 14

PANES = {f"alpha {alpha}": rough(alpha) for alpha in (1e-4, 1e-3, 3e-3, 0.01, 0.02, 0.03)}
PANES |= {f"roughness {roughness}": principled(roughness) for roughness in (0.0, 0.05, 0.1, 0.15, 0.2)}


def images(bsdf, reflectance=0.5, seeds=SEEDS):
    """(seeds, height, width) of the first colour."""
    to_world = transform().translate([0, 0, 1]).scale([1.5, 1.5, 0.05])
    scene = {
        "type": "scene",
        "sensor": scenes.camera(origin=(0, -1.5, 5), target=(0, 0, 0), fov=25, size=SIZE),
        "floor": {"type": "rectangle", "to_world": transform().scale(1.5), "bsdf": matte(reflectance)},
        "pane": {"type": "cube", "to_world": to_world, "bsdf": bsdf},
        "lamp": {"type": "point", "position": [0, 0, 2], "intensity": 10.0},
    }
    settings = {"max_depth": 8, "skip": "none", "merging": True}
    return sds_scenes.images(scene, 64, seeds, merges=reflectance > 0, **settings)


@cache
def under_ideal_glass():
    return images(glass())[:, BESIDE].mean()


@pytest.mark.parametrize("pane", PANES)
def test_floor_has_the_light_that_it_has_under_ideal_glass(pane):
    """Lobes of alpha 1e-3 are no deltas, and yet connections through them hardly ever succeed: 98 % of the
    light was missing, and some pixels had 17,000 times their share. Expected: the mean under `dielectric`
    within 3 % (both have a standard error of 0.7 %), no pixel above 100 times the median of its eight
    neighbours in all images."""
    found, highlight = images(PANES[pane]), images(PANES[pane], 0.0, 1)
    light = found[:, BESIDE].mean() - highlight[:, BESIDE].mean()
    assert light == pytest.approx(under_ideal_glass(), rel=0.03)
    around = np.lib.stride_tricks.sliding_window_view(found, (3, 3), axis=(1, 2))[:, BESIDE[1:-1, 1:-1]]
    neighbours = np.delete(around.reshape(SEEDS, -1, 9), 4, axis=-1)
    assert (around[..., 1, 1] <= 100.0 * np.median(neighbours, axis=(0, 2))).all()
