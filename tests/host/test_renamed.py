"""Names of Mitsuba 3.10 beside those of 3.9."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.errors import UnsupportedError
from mitsuba_bdpt.host import introspection, renamed
from mitsuba_bdpt.host.introspection import own_parameters
from mitsuba_bdpt.scene import prepared

POSITIONS = np.arange(9, dtype=np.float32).reshape(3, 3)
INDEX, FACES = [0, 1, 2, 1], [[0, 1, 2], [2, 3, 0]]
NONE = np.zeros((0, 3), np.float32)
# In 3.10 tensors have a position for several vertices, by an index.
PARAMETERS = {
    "3.9": lambda: {
        "vertex_positions": mi.Float(POSITIONS[INDEX].ravel()),
        "vertex_normals": mi.Float(),
        "vertex_texcoords": mi.Float(np.zeros(8, np.float32)),
        "faces": mi.UInt32(np.ravel(FACES)),
    },
    "3.10": lambda: {
        "positions": mi.TensorXf(POSITIONS),
        "position_index": mi.TensorXu(INDEX),
        "normals": mi.TensorXf(NONE),
        "normal_index": mi.TensorXu(np.zeros(0, np.uint32)),
        "texcoords": mi.TensorXf(np.zeros((4, 2), np.float32)),
        "faces": mi.TensorXu(FACES),
    },
    "3.10, one position per vertex": lambda: {
        "positions": mi.TensorXf(POSITIONS[INDEX]),
        "texcoords": mi.TensorXf(np.zeros((4, 2), np.float32)),
        "faces": mi.TensorXu(FACES),
    },
}


@pytest.mark.parametrize("version", PARAMETERS)
def test_names_of_meshes(version):
    parameters = PARAMETERS[version]()
    assert renamed.holds_a_mesh(parameters) and renamed.has_coordinates(parameters)
    assert np.array(renamed.positions(parameters)).reshape(-1, 3).tolist() == POSITIONS[INDEX].tolist()
    assert np.array(renamed.faces(parameters)).tolist() == np.ravel(FACES).tolist()
    assert len(renamed.normals(parameters)) == 0


def test_meshes_of_the_installed_version():
    mesh = own_parameters(mi.load_dict({"type": "cube"}))
    assert renamed.holds_a_mesh(mesh) and len(renamed.faces(mesh)) == 36
    assert len(renamed.positions(mesh)) == len(renamed.normals(mesh)) == 72
    assert not renamed.holds_a_mesh(own_parameters(mi.load_dict({"type": "sphere"})))


def test_flags_of_hits(monkeypatch):
    """Expected: 3.9's ``All``, and 3.10's ``Default``, where ``All`` is deprecated."""
    assert renamed.hit_flags() == mi.RayFlags.All
    monkeypatch.setattr(mi, "RayFlags", SimpleNamespace(Default=7))
    assert renamed.hit_flags() == 7


class Transform:
    """``to_world`` of 3.10: transformations by time, those of its branch ``motion_blur``."""

    def __init__(self, *frames):
        self.frames = frames

    def is_animated(self):
        return len(self.frames) > 1

    def eval(self, time):
        return self.frames[0]


MOVED = mi.ScalarTransform4f().translate([1, 2, 3])
TURNED = mi.ScalarTransform4f().rotate([0, 1, 0], 90)


@pytest.fixture
def of_3_10(monkeypatch):
    """Mitsuba has 3.10's transformations."""
    monkeypatch.setattr(mi, "AnimatedTransform4f", Transform, raising=False)


def owner(*frames):
    """Something whose ``traverse`` reports ``to_world`` as 3.10 does, or without frames as 3.9 does."""
    held = Transform(*frames) if frames else MOVED
    return SimpleNamespace(
        traverse=lambda callback: callback.put("to_world", held, 0),
        world_transform=lambda: held,
        class_name=lambda: "Sphere",
        id=lambda: "ball",
    )


def test_to_world_of_both_versions(of_3_10):
    """Expected: matrices of a parameter and of an endpoint are the same from 3.10's object as from 3.9's
    value."""
    expected = np.array(MOVED.matrix, dtype=np.float64)
    for one in (owner(), owner(MOVED)):
        assert introspection.matrix_of(one).tolist() == expected.tolist()
        assert introspection.inverse_of(one).tolist() == np.linalg.inv(expected).tolist()
        assert introspection.world_matrix(one).tolist() == expected.tolist()
    introspection.check_not_animated([owner(), owner(MOVED)])


def moving(base):
    """A class of objects of Mitsuba that move while the shutter is open."""

    class Moving(base):
        def traverse(self, callback):
            callback.put("to_world", Transform(MOVED, TURNED), mi.ParamFlags.NonDifferentiable)

    return Moving


@pytest.mark.parametrize("name", ["lamp", "eye", "view"])
def test_animated_scenes_are_refused(of_3_10, name):
    """Expected: a render of a scene with a lamp, a camera or a view of a batch that moves is refused, with
    its name."""
    mi.register_emitter("moving_lamp", moving(mi.Emitter))
    mi.register_sensor("moving_camera", moving(mi.Sensor))
    scene = {"type": "scene", "eye": {"type": "perspective"}, "lamp": {"type": "point"}}
    scene[name] = {"type": "moving_lamp" if name == "lamp" else "moving_camera"}
    if name == "view":
        film = {"type": "hdrfilm", "width": 2, "height": 1, "rfilter": {"type": "box"}}
        still = {"type": "perspective", "id": "still"}
        scene["eye"] = {"type": "batch", "film": film, "still": still, "view": scene.pop("view")}
    with pytest.raises(UnsupportedError, match=f"bdpt: to_world of .* '{name}' is animated"):
        mi.load_dict({"type": "bdpt"}).render(mi.load_dict(scene), spp=1)


def test_all_that_may_move_is_looked_at(monkeypatch):
    """Expected: shapes, instances, shapes of groups, emitters and the sensor are asked for a transformation
    with key frames."""
    group = {"type": "shapegroup", "id": "group", "box": {"type": "cube"}}
    parts = {
        "eye": {"type": "perspective"},
        "lamp": {"type": "point"},
        "ball": {"type": "sphere"},
        "group": group,
        "copy": {"type": "instance", "of": {"type": "ref", "id": "group"}},
    }
    scene, asked = mi.load_dict({"type": "scene", **parts}), []
    monkeypatch.setattr(prepared, "check_not_animated", asked.extend)
    prepared.PreparedScene(scene, scene.sensors()[0])
    assert {"eye", "lamp", "ball", "box", "copy"} <= {owner.id() for owner in asked}
