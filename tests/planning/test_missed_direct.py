"""Light of delta emitters that falls on a meter itself: said where it is not sampled."""

import mitsuba as mi
import pytest
import scene_parts as parts

from stress_cases.warned import Warned

T = parts.T
LAMP = {"type": "point", "position": [0, 0, 1], "intensity": 3.0}
LENS = parts.thinlens(0.3, 3.0, origin=(0, 0, -3), target=(0, 0, 1), size=4)
CAMERA = parts.perspective(origin=(0, 0, -3), target=(0, 0, 1), size=4)
WITHOUT = {"light_paths": 0}


def meter(x=0.0):
    plate = {"type": "rectangle", "to_world": T().translate([x, 0, 0]).scale(0.2)}
    return parts.meter(plate)


def batch(**views):
    return {"type": "batch", "film": parts.film(size=1, width=2), **views}


@pytest.mark.parametrize(
    "sensor, lamp, parameters, said",
    [
        (meter, LAMP, WITHOUT, True),
        (lambda: batch(a=meter(-0.1), b=meter(0.1)), LAMP, WITHOUT, True),
        (lambda: batch(a=CAMERA, b=meter()), LAMP, {}, True),
        (meter, LAMP, {}, False),
        (lambda: batch(a=meter(-0.1), b=meter(0.1)), LAMP, {}, False),
        (meter, {"type": "constant"}, WITHOUT, False),
        (meter, LAMP, WITHOUT | {"hide_emitters": True}, False),
        (lambda: LENS, LAMP, WITHOUT, False),
        (lambda: CAMERA, LAMP, WITHOUT, False),
    ],
)
def test_missing_direct_light_is_said(sensor, lamp, parameters, said):
    """Rationale: only (1,1) and t = 0 sample direct light of a delta emitter on a sensor with area; without
    them a meter reads 0, which looks like a measurement. Expected: one warning for two renders, and a line of
    `explain`; none where (1,1) takes part, where s = 0 finds the lamp, where it is hidden, and of cameras.
    """
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -0.3])}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(), "lamp": lamp, "floor": floor}, optimize=False)
    method = mi.load_dict({"type": "bdpt", "max_depth": 4} | parameters)
    with Warned() as warnings:
        for seed in range(2):
            method.render(scene, spp=1, seed=seed)
    assert len(warnings) == said
    if said:
        assert "delta emitter - sensor (needs (1,1))" in warnings[0] and "leave light_paths" in warnings[0]
        assert "not sampled: delta emitter - sensor (needs (1,1))" in method.explain(scene, spp=1)
