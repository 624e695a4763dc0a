"""scripts/peers.py: what other renderers get of a scene."""

import mitsuba as mi
import numpy as np
import peers
import pytest
import repository


@pytest.mark.parametrize("name", ["glass_caustics", "veach_bidir"])
def test_triangles_are_the_shapes(name):
    """Expected: areas within 1e-3, of disks, cylinders and spheres too; faces turned as the normals."""
    shapes = mi.load_file(str(repository.scene_file(name)), parallel=False, optimize=False).shapes()
    for made, shape in zip(peers.described(name)["shapes"], shapes, strict=True):
        a, b, c = np.moveaxis(made["points"][made["faces"]], 1, 0)
        normals = np.cross(b - a, c - a) / 2
        area = np.linalg.norm(normals, axis=1).sum()
        assert area == pytest.approx(np.ravel(shape.surface_area())[0], rel=1e-3)
        if len(made["normals"]):
            assert np.all(np.sum(normals * made["normals"][made["faces"]].sum(axis=1), axis=1) > 0)
