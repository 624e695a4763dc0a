"""What is read from Mitsuba's objects."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.objects import own_parameters

OBJECTS = {
    "point": {"type": "point", "position": [1, 2, 3]},
    "spot": {"type": "spot", "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 30)},
    "constant": {"type": "constant", "radiance": 2.0},
    "thinlens": {"type": "thinlens", "aperture_radius": 0.25, "focus_distance": 3.0},
    "sphere": {"type": "sphere", "center": [1, 0, 2], "radius": 0.5},
    "disk": {"type": "disk", "to_world": mi.ScalarTransform4f().scale(3)},
}


@pytest.mark.parametrize("kind", OBJECTS)
def test_own_parameters_are_those_of_traverse(kind):
    """Expected: names and values of ``mi.traverse`` without what belongs to objects inside. Exact."""
    made = mi.load_dict(OBJECTS[kind])
    everything = mi.traverse(made)
    found = own_parameters(made)
    assert found and set(found) == {name for name in everything.keys() if "." not in name}  # noqa: SIM118
    for name, value in found.items():
        expected = everything[name]
        a, b = (x.matrix if hasattr(x, "matrix") else x for x in (value, expected))
        np.testing.assert_array_equal(np.array(a), np.array(b), err_msg=name)
