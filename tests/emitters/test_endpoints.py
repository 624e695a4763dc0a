"""Emitters and sensors by themselves, and everything between them; every pair of them: `test_coverage`.

Images agree by Welch's t-test of tile means over seeds with Sidak's correction, and fail too where the
confidence interval of the mean is wider than stated (`agree`). Images of more materials: `test_same_mean`.
"""

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import welch
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.emitters.kinds import GROUPS, group_of
from mitsuba_bdpt.host.jit import evaluated_mode
from mitsuba_bdpt.transport.inputs import Shared
from scene_parts import (
    EGG,
    EMITTERS,
    T,
    emitter_part,
    grey,
    perspective,
    register_plugins,
    room,
    sampled_emission,
    texture,
)
from welch import tiles

from scenes import DOWNWARDS, area, floor, integrator, layer, load, renders, square

# `path` and we offset rays differently.
agree = partial(welch.agree, rounding=2e-4)


def like_of_rgb():
    return Shared(mi.Float(0), mi.Color0f(), mi.Spectrum(1), mi.Float(0.5))


def emission(count, **lamps):
    scene = mi.load_dict(room() | lamps)
    emitters = Emitters(scene)
    return scene, emitters, sampled_emission(emitters, count)[0]


@pytest.mark.parametrize("name", EMITTERS)
def test_groups_that_a_scene_has_not_are_not_asked(name, monkeypatch):
    """It records the same kernels as if there were none."""
    register_plugins()
    scene = mi.load_dict(room() | {"lamp": EMITTERS[name]()})
    own = group_of(scene.emitters()[0])

    def refuse(*_):
        raise AssertionError("a group of another kind was asked")

    for group in GROUPS:
        if group is not own:
            for method in [name for name, made in vars(group).items() if callable(made)]:
                monkeypatch.setattr(group, method, refuse)
    emitters = Emitters(scene)
    assert [type(group) for group in emitters.groups] == [own]
    si = dr.zeros(mi.SurfaceInteraction3f)
    with evaluated_mode(emitters.evaluated):
        if emitters.traced:
            u = mi.Point2f(0.3, 0.6)
            e = emitters.sample_emission(u, u, like_of_rgb(), mi.Bool(True))
            emitters.connection_density(e, si, mi.Bool(True))
        if emitters.connectible_to_sensor:
            emitters.direction_density(e, si.p, e.d, mi.Bool(True))
            emitters.radiance_towards(e, e.d, mi.Bool(True))
        if emitters.direct:
            emitters.sample_direct(si, mi.Point2f(0.3, 0.6), mi.Bool(True))
        if emitters.hittable:
            ray = mi.Ray3f(mi.Point3f(0, 0.2, 1.5), mi.Vector3f(0.2, 0.9, 0.3))
            emitters.hit_densities(scene.ray_intersect(ray), ray.o, mi.Bool(True))


def power(lamp):
    """Emitted flux of the first channel."""
    if lamp["type"] == "point":
        return 4 * np.pi * lamp["intensity"]
    return np.pi * lamp["emitter"]["radiance"] * float(mi.load_dict(lamp).surface_area()[0])


@pytest.mark.parametrize("name", ["rectangle", "disk", "sphere", "cylinder", "cube", "point"])
def test_emitted_power(name):
    """The mean of the emission's weight. Tolerance: four standard errors of 1e5 samples, and 1e-4."""
    lamp = EMITTERS[name]()
    _, _, e = emission(100_000, lamp=lamp)
    weight = np.array(e.weight, dtype=np.float64)[0]
    error = weight.std() / np.sqrt(len(weight))
    assert abs(weight.mean() - power(lamp)) < 4 * error + 1e-4 * power(lamp)


def off(a, b, used):
    """Share of the ``used`` values that differ by more than 2e-3."""
    a, b = (np.broadcast_to(np.array(x, dtype=np.float64), used.shape)[used] for x in (a, b))
    return np.mean(np.abs(a - b) > 2e-3 * np.abs(b) + 1e-6)


HITTABLE = [k for k in EMITTERS if emitter_part(k).hit and emitter_part(k).traced]


@pytest.mark.parametrize("name", [k for k in HITTABLE if k != "timed_sunsky"])
def test_emission_agrees_with_hits(name):
    """Tracing back from the first hit. 2 %: poles of a textured sphere; edges of textures and pixels."""
    n = 20_000
    scene, emitters, e = emission(n, lamp=EMITTERS[name]())
    ray = mi.Ray3f(e.anchor.towards(e.d), e.d)
    si = scene.ray_intersect(ray)
    hit = np.array(si.is_valid()) & (np.array(dr.max(e.weight)) > 0)
    hit &= np.broadcast_to(np.array(e.cos), n) > 0.2
    back = mi.Ray3f(si.p + si.n * dr.mulsign(mi.Float(2e-5), dr.dot(si.n, -e.d)), -e.d)
    at = scene.ray_intersect(back)
    radiance = emitters.emitted(at, mi.Bool(hit))
    connect, first, second = emitters.hit_densities(at, mi.Point3f(si.p), mi.Bool(hit))
    expected = e.weight * (e.pdf_first * e.pdf_second / e.cos)
    assert hit.sum() > 500
    assert off(radiance.x, expected.x, hit) < 0.02
    assert off(first, e.pdf_first, hit) < 0.02
    assert off(second, e.pdf_second, hit) < 0.02
    # connection_density: in the measure of pdf_first, times the squared length of the edge.
    density = emitters.connection_density(e, si, mi.Bool(hit))
    finite = 1 if emitter_part(name).infinite else dr.squared_norm(si.p - e.si.p)
    assert off(connect * finite, density, hit) < 0.02


@pytest.mark.parametrize("name", [k for k in EMITTERS if emitter_part(k).direct and k != "timed_sunsky"])
def test_direct_sample_agrees_with_hits(name):
    """1 % of the samples: edges of textures; 2 % on a textured sphere: its poles."""
    n = 20_000
    rng = np.random.default_rng(12)
    register_plugins()
    scene = mi.load_dict(room() | {"lamp": EMITTERS[name]()})
    emitters = Emitters(scene)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    u = rng.random((5, n), dtype=np.float32)
    si.p = mi.Point3f(2 * u[0] - 1, 0.02 + 0 * u[1], 2 * u[2] - 1)
    si.n, si.t = mi.Normal3f(0, 1, 0), mi.Float(1)
    direct = emitters.sample_direct(si, mi.Point2f(u[3], u[4]), mi.Bool(True))
    if np.all(np.array(direct.delta)):
        assert np.all(np.array(direct.pdf_w) == 1)
        return
    at = scene.ray_intersect(mi.Ray3f(mi.Point3f(si.p), direct.d))
    emitter = at.emitter(scene)
    seen = np.array(emitter != dr.zeros(mi.EmitterPtr)) & (np.array(direct.pdf_w) > 0)
    seen &= np.array(direct.d.y) > 0.05
    # Samples on a lamp's far side carry nothing; the ray finds the near side.
    seen &= np.array(direct.infinite | (dr.norm(at.p - direct.anchor.p) < 1e-3))
    radiance = emitters.emitted(at, mi.Bool(seen))
    connect, first, second = emitters.hit_densities(at, mi.Point3f(si.p), mi.Bool(seen))
    cos = dr.abs(dr.dot(at.n, direct.d))
    to_angle = dr.select(at.is_valid(), dr.square(at.t) / cos, 1)
    lit = mi.Bool(np.array(dr.max(radiance)) > 0)
    seen &= np.array(lit)
    assert seen.sum() > 500
    assert off((direct.weight * direct.pdf_w).x, radiance.x, seen) < 0.02
    # Hits on cylinders carry an error of Mitsuba's that grows with the distance (see rounding.ShapeErrors).
    few = {"cylinder": 0.05, "textured sphere": 0.02}.get(name, 0.01)
    assert off(direct.pdf_w, connect * to_angle, seen) < few
    edge = dr.select(at.is_valid(), dr.rcp(dr.square(at.t)), 1)
    assert off(direct.emission_ratio, first * second / connect * edge, seen) < few


@pytest.mark.parametrize("scale", [3, 0.2, [-1, 1, 1], [0.5, -0.5, 0.5]], ids=str)
def test_spots_that_are_scaled_or_mirrored(scale):
    """By the same random numbers. Tolerance: 1e-4, rounding of the falloff."""
    flux = []
    for matrix in (T(), T().scale(scale)):
        lamp = EMITTERS["spot"]()
        _, _, e = emission(10_000, lamp=lamp | {"to_world": lamp["to_world"] @ matrix})
        flux.append(np.array(e.weight, dtype=np.float64).mean())
    assert flux[1] == pytest.approx(flux[0], rel=1e-4)


@pytest.mark.parametrize("weight", [float("nan"), float("inf")])
def test_a_sampling_weight_that_is_no_number_is_named(weight):
    lamps = {"a": EMITTERS["point"](), "b": {"type": "spot", "sampling_weight": weight}}
    with pytest.raises(ValueError, match=rf"'b' has sampling_weight={weight:g}; set a finite number"):
        Emitters(mi.load_dict(room() | lamps))


def test_emitters_are_chosen_by_sampling_weight():
    """The emitted power stays the sum, but for a weight of zero. Tolerance: five standard errors."""
    lamps = {
        "a": EMITTERS["point"]() | {"sampling_weight": 0.5},
        "b": EMITTERS["sphere"]() | {"emitter": {"type": "area", "radiance": 5.0, "sampling_weight": 3.0}},
        "c": {"type": "spot", "intensity": 1.0, "sampling_weight": 0.0},
    }
    scene, _, e = emission(100_000, **lamps)
    names = [x.class_name() for x in scene.emitters()]
    share = np.bincount(np.array(e.index), minlength=3) / 100_000
    weights = np.array([{"PointLight": 0.5, "AreaLight": 3.0, "SpotLight": 0.0}[n] for n in names])
    np.testing.assert_allclose(share, weights / 3.5, atol=5 * 0.5 / np.sqrt(100_000))
    assert share[weights == 0] == 0
    weight = np.array(e.weight, dtype=np.float64)[0]
    expected = power(EMITTERS["point"]()) + power(EMITTERS["sphere"]())
    assert abs(weight.mean() - expected) < 5 * weight.std() / np.sqrt(100_000)


def egg_with_coordinates(folder):
    """With texture coordinates, four patches of the same ones."""
    egg = mi.load_dict({"type": "ply", "filename": str(EGG)})
    params = mi.traverse(egg)
    uv = mi.Mesh(
        "uv", egg.vertex_count(), egg.face_count(), has_vertex_normals=True, has_vertex_texcoords=True
    )
    copy = mi.traverse(uv)
    for key in ("vertex_positions", "vertex_normals", "faces"):
        copy[key] = params[key]
    p = np.array(params["vertex_positions"]).reshape(-1, 3)
    copy["vertex_texcoords"] = (np.abs(p[:, :2] - p[:, :2].mean(0)) / 2).astype(np.float32).ravel()
    copy.update()
    uv.write_ply(str(folder / "egg.ply"))
    return str(folder / "egg.ply")


def test_a_texture_needs_coordinates():
    lamp = {"type": "ply", "filename": str(EGG), "emitter": {"type": "area", "radiance": texture()}}
    with pytest.raises(ValueError, match="textured radiance on a mesh without texture coordinates"):
        integrator().render(mi.load_dict(room() | {"lamp": lamp}), spp=1)


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "roughdielectric", "alpha": 0.3},
        {"type": "principledthin", "roughness": 0.4, "diff_trans": 1.0, "spec_trans": 0.5},
    ],
    ids=["rough glass", "thin"],
)
@pytest.mark.parametrize("parameters", [{"light_paths": 0}, {"skip": "none"}], ids=["path tracing", "all"])
def test_a_lamp_of_glass_does_not_light_itself(bsdf, parameters):
    """By rounding a point of a sphere may count as outside of it. The image of a black one, with the same
    seed, to 1e-3 of its mean (rays through the sphere meet nothing)."""
    base = {"type": "scene", "sensor": perspective((0, 0, 4), (0, 0, 0))}
    ball = {"type": "sphere", "radius": 0.6, "emitter": {"type": "area", "radiance": 3.0}}
    means = []
    for material in (bsdf, {"type": "diffuse", "reflectance": 0.0}):
        scene = mi.load_dict(base | {"ball": ball | {"bsdf": material}})
        means.append(np.array(integrator(max_depth=4, **parameters).render(scene, spp=256, seed=1)).mean())
    assert abs(means[0] / means[1] - 1) < 1e-3, means


def attributed_lamp(scale=1.0):
    """A quad that emits what an attribute of its vertices says."""
    properties = mi.Properties()
    radiance = {"type": "mesh_attribute", "name": "vertex_glow"}
    properties["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    properties["bsdf"] = mi.load_dict(grey(0))
    mesh = mi.Mesh("lamp", 4, 2, has_vertex_texcoords=True, props=properties)
    keys = mi.traverse(mesh)
    corners = np.float32([[-0.6, 2, -0.6], [0.6, 2, -0.6], [0.6, 2, 0.6], [-0.6, 2, 0.6]])
    keys["vertex_positions"] = corners.ravel().tolist()
    keys["vertex_texcoords"] = [0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 1.0]
    keys["faces"] = [0, 1, 2, 0, 2, 3]
    keys.update()
    glow = scale * np.array([9.0, 1.0, 1.0, 1.0, 9.0, 1.0, 1.0, 1.0, 9.0, 20.0, 20.0, 20.0])
    mesh.add_attribute("vertex_glow", 3, glow.tolist())
    return mesh


def grid_lamp():
    """A ball by signed distances, of which Mitsuba samples no point."""
    at = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(at, axis=-1, keepdims=True) - 0.8
    return {
        "type": "sdfgrid",
        "grid": mi.TensorXf(distance.astype(np.float32)),
        "to_world": T().translate([-0.5, 1.2, -0.5]),
        "bsdf": grey(0),
        "emitter": {"type": "area", "radiance": 3.0},
    }


@pytest.mark.parametrize("lamp", [attributed_lamp, grid_lamp])
def test_lamps_that_do_not_tell_their_points(lamp):
    """An attribute of a mesh needs the number of a face, which a sampled point lacks. Beside another lamp the
    image is the sum of s = 0 alone and the other lamp's."""
    odd, other = {"lamp": lamp()}, {"other": EMITTERS["point"]()}
    everything = integrator(skip="none", max_depth=3, layers="strategies")
    alone = renders(mi.load_dict(room() | odd), everything, 512, 10, 100)
    hits = sum(layer(alone, everything, f"unweighted.s0t{t}") for t in (2, 3, 4))
    assert hits.mean() > 0.01
    dark = room() | {"lamp": {k: v for k, v in grid_lamp().items() if k != "emitter"}}
    if lamp is attributed_lamp:
        dark = room() | {"lamp": attributed_lamp(0.0)}
    rest = renders(mi.load_dict(dark | other), integrator(skip="none", max_depth=3), 128, 10, 200)
    for skip in ("none", "auto"):
        both = renders(mi.load_dict(room() | odd | other), integrator(skip=skip, max_depth=3), 512, 10)
        agree(tiles(both), tiles(hits + rest), 0.06)
    text = integrator().explain(mi.load_dict(room() | odd | other))
    assert "light subpaths of emitter" in text and "it can only be hit" in text


def own_area_class():
    """A user's emitter that repeats `area` on a rectangle of half size 0.6 in the plane y = 2, from above."""

    class OwnArea(mi.Emitter):
        def __init__(self, properties):
            super().__init__(properties)
            self.m_flags = mi.EmitterFlags.Surface

        def eval(self, si, active=True):
            return mi.Spectrum(dr.select(active & (mi.Frame3f.cos_theta(si.wi) > 0), 5.0, 0.0))

        def sample_direction(self, it, sample, active=True):
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p = mi.Point3f(1.2 * sample.x - 0.6, 2, 1.2 * sample.y - 0.6)
            ds.n, ds.time, ds.delta = mi.Normal3f(0, -1, 0), it.time, mi.Bool(False)
            ds.d = ds.p - it.p
            ds.dist = dr.norm(ds.d)
            ds.d /= ds.dist
            ds.emitter = mi.EmitterPtr(self)
            ds.pdf = self.pdf_direction(it, ds, active)
            return ds, mi.Spectrum(dr.select(active & (ds.pdf > 0), 5.0 / ds.pdf, 0.0))

        def pdf_direction(self, it, ds, active=True):
            cos = dr.dot(ds.d, -ds.n)
            return dr.select(active & (cos > 0), dr.square(ds.dist) / (1.44 * cos), 0)

        def sample_wavelengths(self, si, sample, active=True):
            return mi.Color0f(), mi.Spectrum(5.0)

    return OwnArea


@pytest.mark.parametrize("height", [0.5, 2.0], ids=["near", "far"])
def test_a_lamp_of_the_users_on_a_surface(height):
    """Densities of s = 0 and s = 1 are in the same measure."""
    mi.register_emitter("own_area", own_area_class())
    lamp = square((0, 2, 0), DOWNWARDS, 0.6, grey(0))
    sensor = perspective(origin=(0, 2 - height / 2, 5), target=(0, 2 - height, 0), fov=30)
    ours, theirs = (
        load(sensor=sensor, floor=floor(2 - height, 2, grey(0.6)), lamp=lamp | {"emitter": emitter})
        for emitter in ({"type": "own_area"}, area(5.0))
    )
    a = renders(ours, integrator(skip="none", max_depth=3), 512, 10)
    b = renders(theirs, integrator("path", max_depth=3), 2048, 10, 100)
    agree(tiles(a), tiles(b), 0.03)


def test_a_timed_sky_elsewhere_does_no_harm():
    """Calls visit every living emitter, and `timed_sunsky` cannot be called while a kernel is recorded."""
    lit = mi.load_dict(room() | {"lamp": EMITTERS["point"]()})
    bdpt = integrator(max_depth=3)
    before = np.array(bdpt.render(lit, spp=4))
    assert "slow:" not in bdpt.explain(lit)
    other = mi.load_dict({"type": "scene", "sky": {"type": "timed_sunsky"}})
    beside = np.array(bdpt.render(lit, spp=4))
    assert "slow: a timed_sunsky lives" in bdpt.explain(lit) and len(other.emitters()) == 1
    np.testing.assert_allclose(beside.mean(), before.mean(), rtol=1e-4)
