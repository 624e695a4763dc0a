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


def _lively(i, more):
    colour = {"type": "rgb", "value": [0.2 + 0.03 * i, 0.5, 0.9 - 0.03 * i]}
    return {"type": "principled", "base_color": colour, "roughness": 0.2 + 0.02 * i} | more


MIXED = [
    *({"type": "diffuse", "reflectance": 0.1 + 0.05 * i} for i in range(8)),
    *(_lively(i, {}) for i in range(8)),
    *(_lively(i, {"metallic": 0.1 * i}) for i in range(8)),
    *({"type": "twosided", "of": _lively(i, {"clearcoat": 0.1 + 0.1 * i})} for i in range(8)),
]


def _asked(bsdfs, traits):
    """Samples and evaluations of ``bsdfs``, one after the other, at random directions."""
    random, count = np.random.default_rng(1), 128 * len(bsdfs)
    number = mi.UInt32(np.arange(count, dtype=np.uint32) % len(bsdfs))
    pointer = dr.gather(mi.BSDFPtr, mi.BSDFPtr(bsdfs), number)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.wi, wo = (
        mi.warp.square_to_uniform_sphere(mi.Point2f(random.random((2, count), dtype=np.float32)))
        for _ in range(2)
    )
    u = mi.Point3f(random.random((3, count), dtype=np.float32))
    target = bsdf.Target(wo, u.x > 0.1, mi.Float(0.7))
    step, f = bsdf.sample(pointer, si, u.x, mi.Point2f(u.y, u.z), u.x > 0.1, traits, target, True)
    at = bsdf.evaluate(pointer, si, wo, u.z > 0.1, traits)
    found = step.wo, step.weight, step.pdf_fwd_w, step.pdf_rev_w, f.value, f.pdf_rev_w, at.value, at.pdf_fwd_w
    dr.eval(found)
    return [np.array(x) for x in found]


def test_bsdfs_that_differ_in_numbers_are_called_as_one(monkeypatch):
    """Mitsuba's `principled` leaves out lobes that are 0 at loading, as a metal's of the first of eight.
    Expected: few functions instead of one per BSDF, the same numbers to the bit, and BSDFs as before, also
    after a call that failed, and with an edit since the tables were made."""
    bsdfs = [mi.load_dict(kind) for kind in MIXED]
    traits = bsdf.Traits.of(bsdfs)
    assert len(traits.dispatch._molds) == 4
    found = _asked(bsdfs, traits)
    monkeypatch.setattr(bsdf, "_MOLDS", 0)
    one_by_one = bsdf.Traits.of(bsdfs)
    assert not one_by_one.dispatch._molds
    for x, y in zip(found, _asked(bsdfs, one_by_one), strict=True):
        assert (x != 0).any()
        np.testing.assert_array_equal(x, y)
    mi.traverse(bsdfs[0])["reflectance.value"] = mi.Float(0.99)
    texts = list(map(str, bsdfs))
    with pytest.raises(RuntimeError):
        traits.dispatch(mi.BSDFPtr(bsdfs), lambda b, active: 1 / 0, mi.Bool([True] * len(bsdfs)))
    assert "0.99" in texts[0] and list(map(str, bsdfs)) == texts
