"""Mitsuba's samplers in the scene give the number of samples alone; the image's mean is ``path``'s.

The scene is the Cornell box seen through a lens. Statistics: the sample is the mean of a 16x16-pixel tile in
one render, 24 renders a side with seeds of their own, Welch's t with Sidak's correction (see ``welch``) at
1e-3.
"""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from welch import assert_agree, compare_images, tile_means

SIZE, TILES, RUNS, DEPTH = 64, 4, 24, 5

# Samples per pixel that a sampler makes of 5: the next product of two like factors, square, square of a
# prime, power of four.
ROUNDED = {"independent": 5, "stratified": 9, "multijitter": 6, "orthogonal": 9, "ldsampler": 16}


def box_parts(sampler, count, size):
    scene = mi.cornell_box()
    scene["sensor"] |= {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.5}
    scene["sensor"]["sampler"] = {"type": sampler, "sample_count": count}
    scene["sensor"]["film"].update(width=size, height=size, rfilter={"type": "box"})
    return scene


def box(sampler="independent", count=4, size=SIZE):
    return mi.load_dict(box_parts(sampler, count, size))


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": DEPTH, **parameters})


def image(integrator, scene, **keywords):
    return np.array(integrator.render(scene, **keywords), dtype=np.float64)


def renders(scene, integrator, first_seed, spp=0, runs=RUNS):
    """Tile means (green) of ``runs`` renders, (runs, tiles)."""
    return np.stack(
        [tile_means(integrator.render(scene, seed=first_seed + i, spp=spp), TILES)[:, 1] for i in range(runs)]
    )


@cache
def reference():
    """``path``'s renders of the box."""
    return renders(box(), mi.load_dict({"type": "path", "max_depth": DEPTH}), 0, 64)


@pytest.mark.parametrize("points", ["sobol", "independent"])
def test_the_sampler_gives_the_number_of_samples_alone(points):
    """Expected: with each sampler the same image up to rounding (1e-4: atomic sums have no order), of as many
    samples as asked for, and the sampler's own number with spp=0.
    """
    images = []
    for kind in ROUNDED:
        scene, integrator = box(kind, 5, 16), bdpt(points=points)
        images.append(image(integrator, scene, spp=7))
        assert sum(integrator.statistics["passes"]) == 7
        integrator.render(scene)
        assert sum(integrator.statistics["passes"]) == ROUNDED[kind]
    for other in images[1:]:
        np.testing.assert_allclose(other, images[0], rtol=1e-4)


@pytest.mark.parametrize("points", ["sobol", "independent"])
def test_own_points_equal_path(points):
    """Expected: with few samples per pixel the mean of ``path``'s renders. Statistic: see the module."""
    assert_agree(
        compare_images(reference(), renders(box(), bdpt(points=points), 1000, 4), points), at_least=16
    )
