"""Order of the emitters in the tables, whatever Mitsuba's order is."""

import itertools

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.emitters.tables import in_order
from mitsuba_bdpt.planning.unsampled_light import UnsampledLight
from mitsuba_bdpt.run.rendering import Render
from mitsuba_bdpt.transport.photons.aim import Aim


def room(ids, order=None):
    """A room with rectangles that shine in this ``order``, and meshes that share a BSDF, as a file."""
    lamps = "".join(
        f"""<shape type="rectangle"{f' id="{name}"' if name else ""}>
            <transform name="to_world"><rotate y="1" angle="180"/><scale value=".2"/>
            <translate x="{i % 2}" y="{i // 2}" z="-1"/></transform>
            <emitter type="area"><rgb name="radiance" value="{i + 1}, 1, 2"/></emitter></shape>"""
        for i, name in (list(enumerate(ids))[k] for k in order or range(len(ids)))
    )
    floors = "".join(
        f"""<shape type="cube"><transform name="to_world"><scale value="3,3,.1"/><translate z="{-2 - i}"/>
            </transform><ref id="grey"/></shape>"""
        for i in range(6)
    )
    turned = '<transform name="to_world"><rotate y="1" angle="180"/></transform>'
    size = "".join(f'<integer name="{name}" value="16"/>' for name in ("width", "height"))
    sensor = f'<sensor type="perspective">{turned}<film type="hdrfilm">{size}</film></sensor>'
    text = f'<scene version="3.0.0"><bsdf type="diffuse" id="grey"/>{lamps}{floors}{sensor}</scene>'
    return mi.load_string(text, optimize=False)


def places(scene):
    return [tuple(emitter.get_shape().bbox().center()) for emitter in in_order(scene)]


@pytest.mark.parametrize("ids", [["b", "c", "a", "d"], ["", "", "", ""], ["x", "", "e", ""]])
def test_loads_of_a_file_have_one_order(ids):
    """Mitsuba puts meshes in the order of addresses, so that seeds gave other images: by ids, then by
    places."""
    loads = [room(ids, order) for order in itertools.permutations(range(4))]
    assert len({tuple(places(scene)) for scene in loads}) == 1
    found = [emitter.get_shape().id() for emitter in in_order(loads[0])]
    assert found == sorted(ids)


def test_a_seed_has_one_image_in_every_load():
    bdpt = mi.load_dict({"type": "bdpt"})
    orders = [(0, 1, 2, 3), (3, 2, 1, 0), (1, 3, 0, 2)]
    images = [np.array(bdpt.render(room(["b", "c", "a", "d"], order), seed=3, spp=4)) for order in orders]
    assert images[0].mean() > 0.01
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_photons_are_aimed_at_one_order_of_shapes(order):
    glass = {
        f"glass{i}": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([i, -i, 0]).scale(0.1),
            "bsdf": {"type": "dielectric"},
        }
        for i in order
    }
    scene = mi.load_dict({"type": "scene", "lamp": {"type": "point"}} | glass, optimize=False)
    centres = [float(sphere.center.x[0]) for sphere in Aim.of(scene, Emitters(scene)).spheres]
    assert np.allclose(centres, [0, 1, 2])


def test_light_groups_are_those_of_the_tables():
    """Tolerance: sums of some ten numbers in single precision."""
    bdpt = mi.load_dict({"type": "bdpt", "light_groups": "auto", "max_depth": 2})
    image = np.array(bdpt.render(room(["b", "c", "a", "d"]), seed=3, spp=4))
    layers = dict(zip(bdpt.aov_names(), np.moveaxis(image[..., -12:], -1, 0), strict=True))
    for number, name in enumerate("bcad", 1):
        red, green = layers[f"groups.{name}.R"], layers[f"groups.{name}.G"]
        assert green.max() > 0.01
        np.testing.assert_allclose(red, number * green, rtol=1e-5, atol=1e-5)


def test_other_emitters_keep_their_places():
    lamps = {name: {"type": "point", "position": [i, 0, 0]} for i, name in enumerate("cab")}
    scene = mi.load_dict({"type": "scene"} | lamps)
    assert [emitter.id() for emitter in in_order(scene)] == [emitter.id() for emitter in scene.emitters()]


def test_statistics_have_the_scenes_numbers(monkeypatch):
    unsampled = UnsampledLight({0: np.ones(3)})
    monkeypatch.setattr(Render, "_unsampled", lambda self: unsampled)
    scene, bdpt = room(["b", "a"]), mi.load_dict({"type": "bdpt"})
    bdpt.render(scene, spp=1)
    (number,) = bdpt.statistics["unsampled_light"]
    assert scene.emitters()[number].get_shape().id() == "a"
