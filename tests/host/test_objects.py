"""What is read from Mitsuba's objects."""

import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.host.introspection import all_shapes, children, named, own_parameters

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
    made = mi.load_dict(OBJECTS[kind])
    everything = mi.traverse(made)
    found = own_parameters(made)
    assert found and set(found) == {name for name in everything.keys() if "." not in name}
    for name, value in found.items():
        expected = everything[name]
        a, b = (x.matrix if hasattr(x, "matrix") else x for x in (value, expected))
        np.testing.assert_array_equal(np.array(a), np.array(b), err_msg=name)


NAMELESS_GROUP = """<scene version="3.0.0">
    <shape type="shapegroup" id="group">
        <shape type="cube"><bsdf type="plastic"/></shape>
        <shape type="cube"><bsdf type="diffuse"/></shape>
        <shape type="cube" id="shape_2"><bsdf type="roughplastic"/></shape>
        <shape type="sphere"><point name="center" x="0" y="1.5" z="0"/><bsdf type="dielectric"/></shape>
    </shape>
    <shape type="instance"><ref id="group"/></shape>
    <shape type="rectangle"><bsdf type="conductor"/></shape>
</scene>"""


def test_shapes_of_a_group_need_no_ids():
    """All shapes without id are called "shape" in what a group holds."""
    scene = mi.load_string(NAMELESS_GROUP)
    found = {s.bsdf().class_name() for s in all_shapes(scene) if s.class_name() != "Instance"}
    smooth = {f"Smooth{name}" for name in ("Conductor", "Dielectric", "Diffuse", "Plastic")}
    assert found == {"RoughPlastic", *smooth}
    group = children(scene)["group"]
    names = {name.split(".")[1] for name in mi.traverse(scene).keys() if name.startswith("group.")}
    assert set(children(group)) == names == {"shape", "shape_1", "shape_2", "shape_3"}


FREED_MEANWHILE = """
import gc, mitsuba_bdpt, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
def box():
    found = mi.cornell_box()
    found["sensor"]["film"].update(width=8, height=8)
    return mi.load_dict(found)
class Cycle: pass
target = box()
for threshold in (20, 50, 100, 200, 400, 700):
    for depth in (2, 3, 4):
        for skip in ("none", "impossible"):
            cycle = Cycle()
            cycle.scene, cycle.me = box(), cycle
            del cycle
            integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "skip": skip})
            gc.set_threshold(threshold, 1, 1)
            integrator.render(target, spp=2)
            gc.set_threshold(700, 10, 10)
print("alive")
"""


def test_scenes_that_the_cycle_collector_frees():
    """A scene in a reference cycle goes whenever Python's cycle collector runs."""
    command = [sys.executable, "-c", FREED_MEANWHILE]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == "alive", done.stderr[-500:]


def test_what_has_no_id_is_named_by_its_class_or_shape():
    stretched = mi.ScalarTransform4f().scale([1, 2, 1])
    spot = {"type": "spot", "id": "", "to_world": stretched}
    lamp = {"type": "rectangle", "emitter": {"type": "area", "id": ""}}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "spot": spot, "lamp": lamp})
    names = sorted(named(emitter) for emitter in scene.emitters())
    assert names == ["without id (SpotLight)", "without id on shape 'lamp'"]
    assert named(scene.sensors()[0]) == "'sensor'"
    with pytest.raises(ValueError, match=r"to_world of spot without id \(SpotLight\) distorts angles"):
        mi.load_dict({"type": "bdpt"}).render(scene, spp=1)
