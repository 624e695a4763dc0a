"""Mitsuba's samplers in the scene give the number of samples alone."""

import mitsuba as mi
import numpy as np
import pytest

# Samples per pixel that a sampler makes of 5: the next product of two like factors, square, square of a
# prime, power of four.
ROUNDED = {"independent": 5, "stratified": 9, "multijitter": 6, "orthogonal": 9, "ldsampler": 16}


@pytest.mark.parametrize("points", ["sobol", "independent"])
def test_the_sampler_gives_the_number_of_samples_alone(points):
    """The same image up to rounding (1e-4: atomic sums have no order), and the sampler's own number with
    spp=0."""
    images = []
    for kind, rounded in ROUNDED.items():
        scene = mi.cornell_box()
        scene["sensor"] |= {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.5}
        scene["sensor"]["sampler"] = {"type": kind, "sample_count": 5}
        scene["sensor"]["film"] |= {"width": 16, "height": 16, "rfilter": {"type": "box"}}
        scene, integrator = mi.load_dict(scene), mi.load_dict({"type": "bdpt", "points": points})
        images.append(np.array(integrator.render(scene, spp=7), dtype=np.float64))
        assert sum(integrator.statistics["passes"]) == 7
        integrator.render(scene)
        assert sum(integrator.statistics["passes"]) == rounded
    for other in images[1:]:
        np.testing.assert_allclose(other, images[0], rtol=1e-4)
