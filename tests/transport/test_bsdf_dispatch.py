"""How BSDFs are called: by Mitsuba's virtual calls, or one by one through Python."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.scene.prepared import PreparedScene
from mitsuba_bdpt.transport import bsdf
from rendered import same

import scenes

KINDS = [
    {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}},
    {"type": "roughconductor", "alpha": 0.3},
    {"type": "dielectric"},
    {"type": "twosided", "of": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}},
    {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "roughconductor"}},
]
DIFFUSE, CONDUCTOR, GLASS, TWOSIDED, BLEND = range(len(KINDS))


def beads(kinds, copies=0):
    """Balls with these BSDFs; ``copies`` (instances) of a ball far away."""
    at = mi.ScalarTransform4f()
    view = scenes.camera(origin=(0, -3, 2), target=(0, 0, 0.2), up=(0, 0, 1), fov=35)
    lamp = {"type": "sphere", "center": [0, 0, 2], "radius": 0.3, "emitter": scenes.area(9.0)}
    scene = {"type": "scene", "sensor": view, "floor": scenes.square(size=2), "lamp": lamp}
    for number, kind in enumerate(kinds):
        place = [-1 + 0.5 * (number % 5), -1 + 0.5 * (number // 5), 0.2]
        scene[f"ball{number}"] = {"type": "sphere", "center": place, "radius": 0.2, "bsdf": dict(KINDS[kind])}
    if copies:
        scene["group"] = {"type": "shapegroup", "one": {"type": "sphere", "radius": 0.1}}
    for number in range(copies):
        to_world = at.translate([number, 9, 9])
        of = {"type": "ref", "id": "group"}
        scene[f"copy{number}"] = {"type": "instance", "to_world": to_world, "of": of}
    return mi.load_dict(scene, optimize=False)


PLAIN = [DIFFUSE, CONDUCTOR, GLASS] * 4


@pytest.mark.parametrize(
    "kinds, copies, expected",
    [
        (PLAIN, 0, True),
        ([DIFFUSE] * 3, 0, False),
        ([*PLAIN, TWOSIDED], 0, True),
        ([*PLAIN, *[TWOSIDED] * 6], 0, False),
        ([*PLAIN, BLEND], 0, False),
        (PLAIN, 6, False),
    ],
    ids=["plain", "few", "one nested", "many nested", "a blend", "instances"],
)
def test_who_calls(kinds, copies, expected):
    """Mitsuba's virtual calls are recorded faster, but visit BSDFs that no ray hits, and sample a blend as a
    whole. Expected: they are used for many BSDFs without corrections, beside few that no ray hits."""
    scene = beads(kinds, copies)
    assert PreparedScene(scene, scene.sensors()[0]).traits.dispatch.by_mitsuba == expected


def test_both_ways_of_calling_give_one_image(monkeypatch):
    """Also beside another scene, which Mitsuba's calls visit. Kernels of their own may round otherwise,
    `same`."""
    scene, images = beads(PLAIN), []
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 5, "light_paths": 1, "connections": "all"})
    for unhit in (bsdf._UNHIT, -1, bsdf._UNHIT):
        monkeypatch.setattr(bsdf, "_UNHIT", unhit)
        images.append(np.array(integrator.render(scene, seed=1, spp=4)))
        other = beads([BLEND, TWOSIDED])
    assert images[0].mean() > 0.04 and other.shapes()
    assert same(images[1], images[0]) and same(images[2], images[0])


@pytest.mark.parametrize("adjoint", [False, True])
def test_a_sample_is_one_question(adjoint, monkeypatch):
    """Each is recorded for every BSDF; of a light subpath's sample, evaluated from its other end, too."""
    count, call = [], bsdf.BSDFDispatch.__call__
    monkeypatch.setattr(bsdf.BSDFDispatch, "__call__", lambda *args: (count.append(1), call(*args))[1])
    scene = beads(PLAIN)
    traits = PreparedScene(scene, scene.sensors()[0]).traits
    si = scene.ray_intersect(mi.Ray3f([0, 0, 1], dr.opaque(mi.Vector3f, [0, 0, -1])))
    bsdf.sample(si.bsdf(), si, mi.Float(0.5), mi.Point2f(0.5), mi.Bool(True), traits, adjoint=adjoint)
    assert len(count) == 1
