"""What is known of shapes from render to render, until one is edited."""

import gc

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.errors import UsageError
from mitsuba_bdpt.geometry import boxes, quadrics, rounding, shape_facts, smooth_meshes
from mitsuba_bdpt.host import notices
from mitsuba_bdpt.host.jit import registered_emitters

SHEAR = mi.ScalarTransform4f([[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def room():
    """A box with a ball that glows, a triangle mesh and an instance of a small ball."""
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": 16, "height": 16, "rfilter": {"type": "box"}}
    at = mi.ScalarTransform4f()
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 3.0}}
    ball = {"type": "sphere", "radius": 0.2, "center": [0.3, 0.2, 0.1], "emitter": glow}
    group = {"type": "shapegroup", "inner": {"type": "sphere", "radius": 0.1}}
    more = {"group": group, "twin": {"type": "instance", "of": {"type": "ref", "id": "group"}}}
    more["twin"]["to_world"] = at.translate([-0.4, 0.3, 0.2])
    return mi.load_dict(scene | {"ball": ball, "solid": {"type": "cube", "to_world": at.scale(0.2)}} | more)


@pytest.fixture
def found(monkeypatch):
    """What was asked of shapes."""
    asked, errors, sphere, box = [], rounding.ShapeErrors, quadrics.Sphere.of, boxes.box_of
    monkeypatch.setattr(boxes, "box_of", lambda shape: (asked.append("box"), box(shape))[1])
    monkeypatch.setattr(shape_facts, "ShapeErrors", lambda *args: (asked.append("errors"), errors(*args))[1])
    monkeypatch.setattr(quadrics.Sphere, "of", lambda shape: (asked.append("sphere"), sphere(shape))[1])
    curved = smooth_meshes._curved_faces
    monkeypatch.setattr(
        smooth_meshes, "_curved_faces", lambda shape: (asked.append("faces"), curved(shape))[1]
    )
    return asked


def image(scene, seed=0, **parameters):
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 4, "light_paths": 1} | parameters)
    return np.array(integrator.render(scene, seed=seed, spp=4))


def test_shapes_are_asked_once(found):
    """A tenth of a small render. (The ball once more: the first render moves its numbers into memory.)"""
    scene = room()
    for number in range(4):
        image(scene, number, light_paths=number % 2)
    assert found.count("errors") == 2 and found.count("sphere") == 3  # of two lamps
    assert (found.count("faces"), found.count("box")) == (4, 1)


EDITS = {
    "ball.to_world": lambda v: v @ mi.ScalarTransform4f().scale(0.5),
    "twin.to_world": lambda v: v @ mi.ScalarTransform4f().translate([0.1, 0, 0]),
    "solid.vertex_positions": lambda v: 1.5 * v,
    "group.inner.to_world": lambda v: v @ mi.ScalarTransform4f().scale(2),
}


@pytest.mark.parametrize("name", EDITS)
def test_edited_shapes_are_asked_again(name, found):
    """Other shapes are not, and the image is that of a scene that was never rendered before, up to the order
    of sums."""
    scene, fresh = room(), room()
    for number in range(3):
        image(scene, number)
    before, spheres = found.count("errors"), found.count("sphere")
    for edited in (scene, fresh):
        parameters = mi.traverse(edited)
        (key,) = (key for key in parameters.keys() if key.endswith(name))
        parameters[key] = EDITS[name](parameters[key])
        parameters.update()
    after = image(scene, 7)
    assert found.count("errors") == before + 1
    assert found.count("sphere") == spheres + (name == "ball.to_world")  # asked of two lamps
    np.testing.assert_allclose(after, image(fresh, 7), rtol=1e-4, atol=1e-5)


def test_what_cannot_be_rendered_is_said_each_time():
    """A lamp whose matrix Mitsuba samples wrongly, until it is mended."""
    scene = room()
    image(scene)
    parameters = mi.traverse(scene)
    good = mi.ScalarTransform4f().translate([0.3, 0.2, 0.1]).scale(0.2)
    for to_world, is_right in ((good @ SHEAR, False), (good, True), (good @ SHEAR, False)):
        parameters["ball.to_world"] = to_world
        parameters.update()
        for _ in range(2):
            if is_right:
                image(scene)
            else:
                with pytest.raises(UsageError, match="to_world"):
                    image(scene)


def test_facts_are_not_those_of_another_scene(found, monkeypatch):
    """A scene may lie in memory where one was that is gone, and be rendered by the same sensor: all
    parameters are alike, but Dr.Jit has given other numbers to its shapes, or normals are flipped."""
    sensor = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}})
    monkeypatch.setattr(notices, "id", lambda scene: 0, raising=False)
    kept = []
    for flipped in (False, False, True):
        ball = {"type": "sphere", "flip_normals": flipped}
        kept.append(mi.load_dict({"type": "scene", "ball": ball}))
        facts = [shape_facts.ShapeFacts.of(kept[-1], sensor) for _ in range(2)]
        assert facts[0] is facts[1]
    assert found.count("errors") == 3


def test_no_scene_is_kept_alive():
    """Lamps of a scene that is gone would take part in the calls of others."""
    gc.collect()
    before = len(registered_emitters())
    scene = room()
    image(scene)
    assert len(registered_emitters()) == before + 2
    del scene
    gc.collect()
    assert len(registered_emitters()) == before
