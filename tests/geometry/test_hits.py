"""Surfaces at hits of instances and spheres, which are looked up, beside Mitsuba's own call."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.geometry import hits
from mitsuba_bdpt.geometry.hits import Hits, HitTables
from rendered import same

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


def balls(count, others=1):
    """Spheres, placed, scaled, turned, mirrored and flipped, of which the first are lamps, and rectangles."""
    at, rng = mi.ScalarTransform4f(), np.random.default_rng(7)
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    place = at.look_at([0, -6, 2], [0, 0, 0], [0, 0, 1])
    scene = {"type": "scene", "sensor": {"type": "perspective", "to_world": place, "film": film}}
    for i in range(others):
        scene[f"floor{i}"] = {"type": "rectangle", "to_world": at.translate([0, 0, -3 - i]).scale(4)}
    for i in range(count):
        to_world = at.translate((6 * rng.random(3) - 3).tolist())
        to_world = to_world @ (at, at.rotate([0.6, 0.8, 0], 50), at.scale([1, -1, 1]), at.scale(-1))[i % 4]
        ball = {"type": "sphere", "to_world": to_world.scale(0.2 + rng.random()), "flip_normals": i % 3 == 1}
        if i < 2:
            ball["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 9.0}}
        scene[f"ball{i}"] = ball
    return mi.load_dict(scene, optimize=False)


def check(scene, ray):
    """Compare all that is said of hits, to the rounding of two kernels; returns the hits."""
    pi = scene.ray_intersect_preliminary(ray)
    dr.eval(pi)
    count = dr.width(pi)
    found = Hits(scene, HitTables.of(scene)).at(pi, ray, mi.Bool(True))
    true = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    for owner, names in (("", FIELDS), ("sh_frame", ("s", "t", "n"))):
        for name in names:
            both = (getattr(getattr(si, owner) if owner else si, name) for si in (found, true))
            ours, theirs = (np.array(x + dr.zeros(type(x), count)) for x in both)
            close = np.isclose(ours, theirs, rtol=1e-4, atol=1e-4, equal_nan=True)
            assert close.mean() > 0.999, (
                f"{owner} {name}"
            )  # directions at a pole, where none is the right one
    assert dr.all((found.shape == true.shape) & (found.instance == true.instance))
    return pi


def test_instances_are_mitsubas():
    """On instances of two groups, other shapes and nothing."""
    pi = check(forest(20), rays(20000))
    inside = np.array(pi.instance != dr.zeros(mi.ShapePtr))
    assert 1000 < inside.sum() < np.array(pi.is_valid()).sum() - 1000


@pytest.mark.parametrize("others", [0, 1, 2])
def test_spheres_are_mitsubas(others):
    """Beside other shapes or none, and at the pole, where directions along the surface are arbitrary."""
    scene, ray = balls(14, others), rays(20000)
    poles = np.array(
        [shape.bbox().center() for shape in scene.shapes() if shape.shape_type() == mi.ShapeType.Sphere.value]
    )
    o, d = np.array(ray.o), np.array(ray.d)
    o[:, : len(poles)] = poles.T + [[0], [0], [3]]
    d[:, : len(poles)] = [[0], [0], [-1]]
    pi = check(scene, mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
    assert 2000 < np.array(pi.is_valid()).sum() < 18000


@pytest.mark.parametrize(
    "made, called",
    [(forest, 6), (balls, 1), (lambda n: balls(10, n), None)],
    ids=["copies", "balls", "others"],
)
def test_kernels_do_not_grow(made, called):
    """With 10 and with 30 as many shapes are called one by one, and kernels are as long (a few lines are
    about how tables lie in memory), also with more of other shapes, which share their function."""
    other, counts = balls(3), []  # else shapes might have the numbers by which Dr.Jit merges functions
    for count in (10, 30):
        scene, ray = made(count), rays(16)
        pi = scene.ray_intersect_preliminary(ray)
        dr.eval(pi, ray)
        tables = HitTables.of(scene)
        assert tables is not None and dr.width(tables.targets) == (called or count)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(Hits(scene, tables).at(pi, ray, mi.Bool(True)))
            texts = [k["ir"].getvalue() for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        counts.append(len(max(texts, key=len).splitlines()))
    assert 100 < counts[1] < 1.01 * counts[0] and other.shapes()


@pytest.mark.parametrize("why", ["few", "unnamed", "alike", "few spheres", "other shapes"])
def test_mitsubas_call_is_used_otherwise(why, monkeypatch):
    scene = forest(hits.MANY - (why == "few"))
    if why == "few spheres":
        scene = balls(hits.MANY - 1)
    if why == "other shapes":
        scene = balls(hits.MANY, 4 * hits.MANY + 1)
    if why == "unnamed":
        monkeypatch.setattr(hits, "_GROUP", hits.re.compile("shapegroup of another version (.*)"))
    if why == "alike":
        for group in hits.shape_groups(scene):
            group.set_id("one")
    assert HitTables.of(scene) is None


MOVED = {forest: ("copy3.to_world", "tree.cube.to_world", "bush.knob.to_world"), balls: ("ball3.to_world",)}


@pytest.mark.parametrize("made", [forest, balls])
def test_images_are_the_same(made, monkeypatch):
    """By the tables and by Mitsuba's call, also after a shape was moved, be it an instance or in a group."""
    scene = made(9)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 4, "light_paths": 1, "connections": "one"})

    def image():
        return np.array(integrator.render(scene, seed=2, spp=4))

    for edit in ("", *MOVED[made]):
        parameters = mi.traverse(scene)
        for key in [key for key in parameters.keys() if edit and key.endswith(edit)]:
            parameters[key] = parameters[key] @ mi.ScalarTransform4f().translate([0.1, 0.2, 0.1])
        parameters.update()
        found = image()
        with monkeypatch.context() as patched:
            patched.setattr(Hits, "__init__", lambda self, *_: vars(self).update(_tables=None))
            assert same(found, image())
        assert found.mean() > 0.01
