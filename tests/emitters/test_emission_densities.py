"""The density of each kind of emission: it integrates to 1, and is the one that rays are sampled with.

Histograms of sampled emissions are compared with integrals of the stated density over the same bins, taken
with points or directions that are uniform there. Statistic: a normal test per bin (both sides have noise),
Sidak over the bins, at 1e-4; the sum over all bins against 1 within five standard errors.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
import welch
from mitsuba_bdpt.emitters import disks as emitter_disks
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.geometry import boxes
from mitsuba_bdpt.geometry.rounding import ShapeErrors
from mitsuba_bdpt.host.jit import evaluated_mode
from mitsuba_bdpt.transport.photons.aim import Aim
from scipy import stats
from welch import tiles

from scenes import integrator, layer, renders

COUNT = 200_000
LEVEL = 1e-4
FEWEST = 50  # samples that a bin must have to be normal

AT_A_POINT = ("point", "spot", "textured spot", "projector", "textured projector")
AT_INFINITY = ("constant", "envmap", "rotated envmap", "sunsky", "timed_sunsky")
ON_SURFACES = [
    name for name in parts.EMITTERS if parts.plugin_of(parts.EMITTERS[name]()) in ("area", "directionalarea")
]


def emission(name, **others):
    """The emitter ``name`` alone but for a ball: scene, tables and `COUNT` emissions."""
    parts.register_plugins()
    ball = {"type": "sphere", "center": [0.3, 0.5, 0], "radius": 0.5}
    scene = mi.load_dict({"type": "scene", "ball": ball, "lamp": parts.EMITTERS[name]()} | others)
    emitters = Emitters(scene)
    with evaluated_mode(name == "timed_sunsky"):
        e = sampled(emitters, time=0.3)
        dr.eval(e)
    return scene, emitters, e


def sampled(emitters, time=0.0):
    return parts.sampled_emission(emitters, COUNT, time=time)[0]


def test_no_emitter_is_left_out():
    parts.register_plugins()
    ball = {"type": "sphere"}
    scenes = {name: {"type": "scene", "ball": ball, "lamp": make()} for name, make in parts.EMITTERS.items()}
    traced = {name for name, scene in scenes.items() if Emitters(mi.load_dict(scene)).traced}
    assert traced == {*AT_A_POINT, *AT_INFINITY, *ON_SURFACES, "directional"}


def numbers(rows, seed=11):
    return np.random.default_rng(seed).random((rows, COUNT), dtype=np.float32)


def column(x):
    """A Dr.Jit array as (COUNT,) or (components, COUNT), in double precision."""
    x = np.array(x, dtype=np.float64)
    shape = (COUNT,) if x.ndim < 2 else (x.shape[0], COUNT)
    return np.array(np.broadcast_to(x, shape))


def agree(sampled, uniform, density, measure):
    """``sampled`` bins of emissions; ``uniform`` bins in a region of this ``measure``, with the stated
    ``density``."""
    bins = int(max(sampled.max(), uniform.max())) + 1
    value = measure * density
    share = np.bincount(sampled, minlength=bins) / COUNT
    expected = np.bincount(uniform, value, bins) / COUNT
    square = np.bincount(uniform, value**2, bins) / COUNT
    error = np.sqrt((share * (1 - share) + square - expected**2) / COUNT)
    whole_error = value.std() / np.sqrt(COUNT)
    assert whole_error < 0.02
    assert abs(value.mean() - 1) < 5 * whole_error + 1e-4, f"integrates to {value.mean():.4f}"
    enough = np.maximum(share, expected) * COUNT > FEWEST
    assert enough.sum() >= 20
    assert share[~enough].sum() < 0.02
    z = np.abs(share - expected)[enough] / error[enough]
    p = 2 * stats.norm.sf(z)
    family = -np.expm1(len(p) * np.log1p(-p.min()))
    worst = np.flatnonzero(enough)[np.argmin(p)]
    assert family > LEVEL, f"bin {worst}: {share[worst]:.5f} sampled, {expected[worst]:.5f} stated"


def sphere_bins(d, axis, cos_least, rings=10, sectors=16):
    """Bin of each direction (3, n): rings of equal solid angle around ``axis`` down to ``cos_least``."""
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    x = np.cross(axis, helper)
    x /= np.linalg.norm(x)
    y = np.cross(axis, x)
    ring = np.clip((1 - axis @ d) / (1 - cos_least) * rings, 0, rings - 1).astype(int)
    sector = np.floor((np.arctan2(y @ d, x @ d) / (2 * np.pi) % 1) * sectors).astype(int) % sectors
    return ring * sectors + sector


@pytest.mark.parametrize("name", AT_A_POINT)
def test_directions_from_a_point(name):
    """Mitsuba offers no density of what a spot or a projector sends out."""
    _, emitters, e = emission(name)
    d = column(e.d)
    axis, cos_least = np.array([-1, -3, -1.5]) / np.sqrt(12.25), -1.0
    if "spot" in name:  # beyond its cone nobody asks
        cos_least = np.cos(np.deg2rad(35))
    elif "projector" in name:
        cos_least = (axis @ d).min() - 1e-3
    u = numbers(2, 12)
    local = column(mi.warp.square_to_uniform_cone(mi.Point2f(u[0], u[1]), mi.Float(float(cos_least))))
    frame = mi.Frame3f(mi.Vector3f(*axis.tolist()))
    uniform = frame.to_world(mi.Vector3f(*(mi.Float(v.astype(np.float32)) for v in local)))
    density = column(emitters.direction_density(e, e.si.p + uniform, uniform, mi.Bool(True)))
    own = column(emitters.direction_density(e, e.si.p + e.d, e.d, mi.Bool(True)))
    stated = column(e.pdf_second)
    # Directions on the border of two texels, by rounding.
    assert np.mean(np.abs(own - stated) > 1e-3 * stated) < 1e-3
    bins = [sphere_bins(v, axis, cos_least) for v in (d, column(uniform))]
    agree(*bins, density, 2 * np.pi * (1 - cos_least))


@pytest.mark.parametrize("name", AT_INFINITY)
def test_directions_from_infinity(name):
    """As a camera ray that leaves the scene states it."""
    scene, emitters, e = emission(name)
    d = column(e.d)
    u = numbers(2, 12)
    uniform = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))

    def density(outward):
        around = emitters.disks.scene
        si = scene.ray_intersect(mi.Ray3f(around.center + outward * (3 * around.radius), outward))
        si.time = mi.Float(0.3)
        with evaluated_mode(name == "timed_sunsky"):
            return column(emitters.hit_densities(si, mi.Point3f(around.center), mi.Bool(True))[1])

    stated, own = column(e.pdf_first), density(-e.d)
    assert np.mean(np.abs(own - stated) > 2e-3 * stated) < 0.01  # borders of pixels and of the sun
    axis = np.array([0, 1.0, 0])
    bins = [sphere_bins(v, axis, -1.0) for v in (-d, column(uniform))]
    agree(*bins, density(uniform), 4 * np.pi)


@pytest.mark.parametrize("name", [*AT_INFINITY, "directional"])
def test_light_from_infinity_covers_the_scene_evenly(name):
    """Mitsuba's `envmap` starts from a wrong disk if it is rotated. Before the scene's bounding sphere (1e-4
    of the radius), evenly on the disk that covers it (Kolmogorov-Smirnov at 1e-4)."""
    _, emitters, e = emission(name)
    d, around = column(e.d), emitters.disks.scene
    radius = float(around.radius[0])
    start = (column(e.anchor.p) - np.array(around.center, dtype=np.float64).reshape(3, 1)) / radius
    along = np.sum(start * d, axis=0)
    np.testing.assert_allclose(along, -1, atol=1e-4)
    flat = start - along * d
    assert stats.kstest(np.sum(flat**2, axis=0), "uniform").pvalue > LEVEL
    assert np.abs(flat.mean(1)).max() < 5 / np.sqrt(COUNT)
    pdf = column(e.pdf_second)
    np.testing.assert_allclose(pdf, 1 / (np.pi * radius**2), rtol=1e-4)


def place_bins(p, low, high, cells=6):
    """Bin of each point (3, n) in a grid over the box between ``low`` and ``high``."""
    extent = np.maximum(high - low, 1e-6)
    cell = np.clip((p - low[:, None]) / extent[:, None] * cells, 0, cells - 1).astype(int)
    return (cell[0] * cells + cell[1]) * cells + cell[2]


@pytest.mark.parametrize("name", ON_SURFACES)
def test_places_on_a_surface(name):
    """Directions have the density cos / pi about the normal (a directionalarea: one)."""
    scene, emitters, e = emission(name)
    shape = scene.emitters()[0].get_shape()
    u = numbers(2, 12)
    ps = shape.sample_position(0.0, mi.Point2f(u[0], u[1]))
    above = ps.p + ps.n * 0.01
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(above), mi.Vector3f(-ps.n)))
    found = column(dr.select(si.shape == mi.ShapePtr(shape), 1.0, 0.0))
    assert found.mean() > 0.999
    if name == "directionalarea":  # cannot be hit: all places are alike
        density = np.full(COUNT, 1 / float(shape.surface_area()[0]))
        np.testing.assert_allclose(column(e.pdf_first), density, rtol=1e-5)
        np.testing.assert_allclose(column(e.d), column(e.si.sh_frame.n), atol=1e-6)
    else:
        density = column(emitters.hit_densities(si, mi.Point3f(above), mi.Bool(True))[1])
        cos = column(dr.dot(e.si.sh_frame.n, e.d))
        assert stats.kstest(cos**2, "uniform").pvalue > LEVEL
        np.testing.assert_allclose(column(e.pdf_second), cos / np.pi, rtol=1e-3, atol=1e-5)
    box = shape.bbox()
    low, high = (np.array(v, dtype=np.float64).ravel() for v in (box.min, box.max))
    bins = [place_bins(column(v), low, high) for v in (e.si.p, ps.p)]
    agree(*bins, density, float(shape.surface_area()[0]))


def test_selection_beside_what_cannot_be_traced():
    """Half of the emissions carry light. Tolerance: five standard errors."""
    parts.register_plugins()
    _, _, e = emission("point", other=parts.EMITTERS["own lamp"]())
    weight = column(e.weight)[0]
    assert abs(np.mean(weight > 0) - 0.5) < 5 * 0.5 / np.sqrt(COUNT)
    power = 4 * np.pi * 5
    assert abs(weight.mean() - power) < 5 * weight.std() / np.sqrt(COUNT)


def meadow(emitter, sensor=None):
    """A block on a large ground."""
    ground = {"type": "rectangle", "to_world": parts.T().rotate([1, 0, 0], -90).scale(8)}
    block = parts.T().translate([1, 0.5, 0]).rotate([0, 1, 0], 30).scale(0.5)
    scene = {
        "sensor": sensor or parts.perspective((0, 4, 6), (0.5, 0, 0), 50, size=8),
        "ground": ground | {"bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "block": {"type": "cube", "to_world": block},
        "emitter": emitter,
    }
    return mi.load_dict({"type": "scene"} | scene)


FROM_INFINITY = {
    "sky": {"type": "constant", "radiance": 1.0},
    "sun": {"type": "directional", "direction": [0.5, -1, 0.2], "irradiance": 3.0},
}


@pytest.mark.parametrize("name", FROM_INFINITY)
def test_aimed_emission(name):
    """Half of the light subpaths are aimed at the block. Where they pass, per area across their direction, is
    what `Emitters` states at any point of that line, and integrates to the disk of the scene, and to that of
    the block."""
    emitters = Emitters(meadow(FROM_INFINITY[name]))
    e = sampled(emitters)
    stated = column(e.pdf_second)
    for distance in (0.0, 7.0):
        again = column(emitters.direction_density(e, e.si.p + distance * e.d, e.d, mi.Bool(True)))
        # Rounding decides on the rim of a disk, for a share of the points of its size over the radius.
        assert np.mean(np.abs(again - stated) > 1e-3 * stated) < 1e-4
    assert np.isfinite(column(e.weight)).all()
    everything, block = emitters.disks.scene, emitters.disks.details
    assert block.radius[0] < 0.1 * everything.radius[0]
    for sphere, least in ((everything, 1), (block, emitter_disks.AIMED)):
        radius = float(sphere.radius[0])
        offset = column(e.si.p) - np.array(sphere.center, dtype=float).reshape(3, 1)
        d = column(e.d)
        aside2 = (offset**2).sum(0) - (offset * d).sum(0) ** 2
        inside = aside2 < radius**2 * (1 + 1e-4)
        value = inside / stated / (np.pi * radius**2)
        # The spheres' margins and the rim: 1e-4 of the radius.
        assert abs(value.mean() - 1) < 5 * value.std() / np.sqrt(COUNT) + 1e-3
        assert inside.mean() > least - 5 / np.sqrt(COUNT)


def test_details():
    """Not those spread over the scene, nor without extent, nor, since rounding decides, those tiny beside the
    scene or far from the origin."""
    box = mi.ScalarBoundingBox3f

    def found(*small, at=0.0):
        whole = box([at - 10] * 3, [at + 10] * 3)
        sphere = emitter_disks.details([whole, *small], whole)
        return None if sphere is None else (list(sphere.center), sphere.radius)

    center, radius = found(box([1, 1, 1], [2, 2, 2]), box([2, 2, 2], [3, 3, 3]))
    assert center == pytest.approx([2, 2, 2]) and radius == pytest.approx(np.sqrt(3))
    assert found() is None
    assert found(box([-9, -9, -9], [-8, -8, -8]), box([8, 8, 8], [9, 9, 9])) is None
    assert found(box([1, 1, 1], [7, 2, 2])) is None
    assert found(box([1, 1, 1], [1, 1, 1])) is None
    assert found(box([1, 1, 1], [1.002, 1.002, 1.002])) is None
    assert found(box([1e5] * 3, [1e5 + 2] * 3), at=1e5) is None


@pytest.mark.parametrize("scale", [8, 1000])
def test_aimed_points_know_that_they_are(scale):
    """A point on the rim of the details' disk may be outside of it by rounding."""
    ground = {"type": "rectangle", "to_world": parts.T().scale(scale)}
    ball = {"type": "sphere", "center": [0.3, 0.2, 1], "radius": 1.0}
    disks = emitter_disks.Disks(mi.load_dict({"type": "scene", "ground": ground, "ball": ball}))
    u = [mi.Float(v) for v in numbers(4)]
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[2], u[3]))
    _, density = disks.start(d, mi.Point2f(u[0], u[1]))
    density, aimed = column(density), column(u[0]) < emitter_disks.AIMED
    part = emitter_disks.AIMED / (np.pi * float(disks.details.radius[0]) ** 2)
    assert density.min() > 0 and density[aimed].min() >= part * (1 - 1e-6)


def test_a_vertex_that_is_not_finite():
    """The box of a mesh with such a vertex is not valid, yet rays meet its other triangles."""
    mesh = mi.Mesh("broken", 4, 2)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [0, 0, 0, 2, 0, 0, 0, 2, 0, np.nan, 0, 0]
    params["faces"] = [0, 1, 2, 1, 2, 3]
    params.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh, "sky": {"type": "constant"}})
    sphere = emitter_disks.Disks(scene).scene
    np.testing.assert_allclose(np.array(sphere.center).ravel(), [1, 1, 0], atol=1e-6)
    assert float(sphere.radius[0]) == pytest.approx(np.sqrt(2), rel=1e-3)


GREY = parts.grey(0.5)


def room_of_rectangles(bsdf=GREY):
    """A room of five rectangles of one BSDF, open to a white sky, with a small cube on its floor."""
    sides = {"floor": ([1, 0, 0], -90), "ceiling": ([1, 0, 0], 90), "left": ([0, 1, 0], 90)}
    sides |= {"right": ([0, 1, 0], -90), "back": ([0, 1, 0], 0)}
    return {
        "type": "scene",
        "sky": {"type": "constant"},
        "cube": {"type": "cube", "to_world": parts.T().translate([0, -0.8, 0]).scale(0.2)},
        "sensor": parts.perspective((0, 0, 0.9), (0, 0, -1), 70),
    } | {
        name: {"type": "rectangle", "to_world": parts.T().rotate(*turn).translate([0, 0, -1]), "bsdf": bsdf}
        for name, turn in sides.items()
    }


@pytest.mark.parametrize("parameters", [{"light_paths": 0}, {"skip": "none"}], ids=str)
def test_a_room_of_merged_rectangles(parameters):
    """Shadow rays of `path` towards the sky end at the box of the cube, and meet no wall. Tolerance: 1e-5 of
    the mean for sums in another order."""
    merged, apart = (mi.load_dict(room_of_rectangles(), optimize=on) for on in (True, False))
    assert len(merged.shapes()) == 2 and len(apart.shapes()) == 6
    ours = mi.load_dict({"type": "bdpt", "max_depth": 4} | parameters)
    a, b = (np.array(ours.render(scene, spp=64, seed=1), dtype=float) for scene in (merged, apart))
    assert np.abs(a - b).mean() < 1e-5 * b.mean()
    path = mi.load_dict({"type": "path", "max_depth": 4})
    a, b = (np.array(mi.render(scene, integrator=path, spp=64, seed=1)).mean() for scene in (merged, apart))
    assert a > 1.05 * b


def test_sizes_of_scenes_with_merged_rectangles():
    """A ball of radius 0.001 is small beside them; spheres around merged mirrors are finite."""
    scene = room_of_rectangles({"type": "conductor"})
    scene["cube"] = {"type": "sphere", "radius": 1e-3}
    merged, apart = (mi.load_dict(scene, optimize=on) for on in (True, False))
    assert boxes.scene_box(merged) == boxes.scene_box(apart) == apart.bbox() != merged.bbox()
    assert ShapeErrors(merged).small and ShapeErrors(apart).small
    aims = Aim.of(merged, Emitters(merged))
    assert all(np.isfinite(float(sphere.radius[0])) for sphere in aims.spheres)


def test_the_size_of_a_scene_with_rectangles_merged_with_a_cube():
    """The box of such a mesh is that of the cube alone, and valid."""
    scene = room_of_rectangles()
    scene["cube"]["bsdf"] = scene["floor"]["bsdf"]
    merged, apart = (mi.load_dict(scene, optimize=on) for on in (True, False))
    assert (len(merged.shapes()), len(apart.shapes())) == (1, 6)
    assert boxes.scene_box(merged) == apart.bbox()


@pytest.mark.parametrize("name", FROM_INFINITY)
def test_aimed_light_subpaths(name):
    """Next-event estimation and light tracing alone, and all together."""
    scene = meadow(FROM_INFINITY[name])
    bdpt = integrator(max_depth=2, light_paths=1, layers="strategies", hide_emitters=True)
    assert Emitters(scene).disks.details is not None
    images = renders(scene, bdpt, 1024, 24)
    alone = tiles(layer(images, bdpt, "unweighted.s1t2"), 1)
    for other in (layer(images, bdpt, "unweighted.s2t1"), images[..., :3]):
        welch.agree(tiles(other, 1), alone, 0.04, 1e-4)


def test_aimed_light_subpaths_that_reach_a_lens():
    """For t = 0 the density is asked for at the sensor, which may lie outside the scene."""
    lens = {"type": "thinlens", "aperture_radius": 3.0, "focus_distance": 20.0}
    sensor = parts.perspective((0, 5, 25), (0, 0, 0), 60, size=6) | lens
    scene, bdpt = meadow(FROM_INFINITY["sky"], sensor), integrator(max_depth=1, skip="none")
    assert Emitters(scene).disks.details is not None and "used: t=0" in bdpt.explain(scene)
    path = renders(scene, integrator("path", max_depth=1), 1024, 12, 100)
    welch.agree(tiles(renders(scene, bdpt, 512, 24), 1), tiles(path, 1), 0.02, 1e-4)
