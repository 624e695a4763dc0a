"""Surfaces at hits of instances, which are looked up, beside Mitsuba's own call."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.geometry import hits
from mitsuba_bdpt.geometry.hits import Hits, Instances
from mitsuba_bdpt.host import renamed

FIELDS = "t time p n uv dp_du dp_dv dn_du dn_dv duv_dx duv_dy wi prim_index".split()


def forest(count, groups=2):
    """A floor and instances, placed, scaled and mirrored at random, of groups of several kinds of shapes."""
    at, rng = mi.ScalarTransform4f(), np.random.default_rng(5)
    place = at.look_at([0, -4, 2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    scene = {"type": "scene", "sensor": {"type": "perspective", "to_world": place, "film": film}}
    scene["floor"] = {"type": "rectangle", "to_world": at.scale(3)}
    scene["lamp"] = {"type": "sphere", "center": [0, 0, 3], "radius": 0.3}
    scene["lamp"]["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 9.0}}
    parts = {
        "ball": {"type": "sphere", "radius": 0.2},
        "cube": {"type": "cube", "to_world": at.translate([0.2, 0, 0]).scale(0.1)},
        "pipe": {"type": "cylinder", "radius": 0.05, "p1": [0, 0.1, 0.5], "flip_normals": True},
        "leaf": {"type": "rectangle", "to_world": at.translate([0, -0.2, 0]).scale(0.1)},
        "knob": {"type": "sphere", "center": [0, 0, 0.3], "radius": 0.1},
    }
    scene["tree"] = {"type": "shapegroup", **{name: parts[name] for name in ("ball", "cube", "pipe")}}
    scene["bush"] = {"type": "shapegroup", **{name: parts[name] for name in ("leaf", "knob")}}
    for i in range(count):
        to_world = at.translate((4 * rng.random(3) - 2).tolist()).rotate([1, 0, 0], 360 * rng.random())
        to_world = to_world @ at.scale((rng.choice([-1, 1]) * (0.4 + 2 * rng.random(3))).tolist())
        of = {"type": "ref", "id": ("tree", "bush")[i % groups]}
        scene[f"copy{i}"] = {"type": "instance", "to_world": to_world, "of": of}
    return mi.load_dict(scene, optimize=False)


def rays(count):
    rng = np.random.default_rng(1)
    start, end = (6 * rng.random((2, 3, count)) - 3).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(start), dr.normalize(mi.Vector3f(end - start)))
    ray.time = mi.Float(0.25)
    return ray


def test_instances_are_mitsubas():
    """Expected: all that Mitsuba's own call says of 20,000 hits, on instances of two groups, other shapes and
    nothing, bit for bit."""
    scene, ray = forest(20), rays(20000)
    pi = scene.ray_intersect_preliminary(ray)
    instances = Instances.of(scene)
    assert instances is not None
    found = Hits(scene, instances).at(pi, ray, mi.Bool(True))
    true = pi.compute_surface_interaction(ray, renamed.hit_flags())
    inside = np.array(pi.instance != dr.zeros(mi.ShapePtr))
    assert 1000 < inside.sum() < np.array(pi.is_valid()).sum() - 1000
    for owner, names in (("", FIELDS), ("sh_frame", ("s", "t", "n"))):
        for name in names:
            ours, theirs = (getattr(getattr(si, owner) if owner else si, name) for si in (found, true))
            shape = np.shape(np.array(ours + dr.zeros(type(ours), 20000)))
            ours, theirs = (
                np.broadcast_to(np.array(x + dr.zeros(type(x), 20000)), shape) for x in (ours, theirs)
            )
            np.testing.assert_array_equal(ours, theirs, err_msg=f"{owner} {name}")
    assert dr.all((found.shape == true.shape) & (found.instance == true.instance))


def test_kernels_do_not_grow_with_instances():
    """Rationale: Mitsuba records n^2 functions for n instances, most of a forest's first image. Expected: as
    long a kernel with 30 as with 10 (a few lines are about the alignment of tables)."""
    counts = []
    for count in (10, 30):
        scene, ray = forest(count), rays(16)
        pi = scene.ray_intersect_preliminary(ray)
        dr.eval(pi, ray)
        table = Hits(scene, Instances.of(scene))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(table.at(pi, ray, mi.Bool(True)))
            texts = [k["ir"].getvalue() for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        counts.append(len(max(texts, key=len).splitlines()))
    assert 100 < counts[1] < 1.01 * counts[0]


@pytest.mark.parametrize("why", ["few", "unnamed", "alike"])
def test_mitsubas_call_is_used_otherwise(why, monkeypatch):
    """Expected: no table for few instances, nor where the description of an instance does not name its group
    or groups are named alike."""
    scene = forest(hits.MANY - (why == "few"))
    if why == "unnamed":
        monkeypatch.setattr(hits, "_GROUP", hits.re.compile("shapegroup of another version (.*)"))
    if why == "alike":
        for group in hits.shape_groups(scene):
            group.set_id("one")
    assert Instances.of(scene) is None


def test_images_of_forests(monkeypatch):
    """Expected: the same image by the table and by Mitsuba's call, also after an instance and a shape of a
    group were moved."""
    scene, integrator = forest(9), mi.load_dict({"type": "bdpt", "max_depth": 4, "light_paths": 1})

    def image():
        return np.array(integrator.render(scene, seed=2, spp=4))

    for edit in ("", "copy3.to_world", "tree.cube.to_world", "bush.knob.to_world"):
        parameters = mi.traverse(scene)
        for key in [key for key in parameters.keys() if edit and key.endswith(edit)]:
            parameters[key] = parameters[key] @ mi.ScalarTransform4f().translate([0.1, 0.2, 0.1])
        parameters.update()
        found = image()
        with monkeypatch.context() as patched:
            patched.setattr(hits, "MANY", 100)
            patched.setattr(hits.Hits, "__init__", lambda self, *_: vars(self).update(_instances=None))
            np.testing.assert_array_equal(found, image())
        assert found.mean() > 0.01
