"""Sensors, and light that arrives at a sensor (t = 0): densities and importance.

What is asked of every sensor: a join gives back the ray that a camera subpath would take, with its
density; the importance integrates to what a camera subpath's weight is (1 for radiance, pi for
irradiance); an arrival states what the start in the opposite direction does.
"""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
from mitsuba_bdpt.geometry.rounding import ShapeErrors
from mitsuba_bdpt.sensors import kinds as sensors
from mitsuba_bdpt.transport.inputs import Shared

COUNT = 200_000
T = parts.T

SPHERE = {"type": "sphere", "center": [0.3, 1.0, 0.5], "radius": 0.3}
LENSES = {
    "thinlens": lambda: parts.thinlens(0.3, 3.0),
    "thinlens, default focus": lambda: parts.perspective() | {"type": "thinlens", "aperture_radius": 0.02},
    "thinlens, crop": lambda: parts.thinlens(
        0.3, 3.0, size=32, crop_offset_x=10, crop_offset_y=3, crop_width=16, crop_height=16
    ),
}
CAMERAS = parts.CAMERAS | LENSES
SENSORS = CAMERAS | {
    "distant": parts.distant,
    "irradiancemeter": parts.meter,
    "irradiancemeter, sphere": lambda: parts.meter(SPHERE),
    "batch": parts.SENSORS["batch"],
    "batch of lenses": parts.SENSORS["batch of lenses"],
}
BY_RAYS = ["distant, point", "distant, shape", "radiancemeter", "own fisheye"]
PARALLEL = [name for name in SENSORS if name.startswith(("orthographic", "distant"))]
AREA = [*LENSES, "irradiancemeter", "irradiancemeter, sphere"]


def prepared(name):
    """Scene, Mitsuba's sensor, ours, and numbers in [0, 1)."""
    parts.register_plugins()
    scene = mi.load_dict(parts.open_scene((parts.SENSORS | SENSORS)[name]()))
    sensor = scene.sensors()[0]
    u = np.random.default_rng(6).random((10, COUNT), dtype=np.float32)
    return scene, sensor, sensors.prepare(sensor, ShapeErrors(scene), scene), u


def start_of(camera, u):
    """Starts in random pixels."""
    like = Shared(mi.Float(0), mi.Color0f(), mi.Spectrum(1), mi.Float(0.5))
    width, height = (int(x) for x in camera.region.size)
    index = mi.UInt32((u[4] * width * height).astype(np.uint32))
    pixel = camera.region.pixel(index)
    return camera.start(pixel, mi.Point2f(u[0], u[1]), mi.Point2f(u[2], u[3]), like)


def assert_same_position(one, other, atol, valid=slice(None)):
    """Film positions, in pixels."""
    for axis in "xy":
        found, known = (column(getattr(r.position, axis))[valid] for r in (one, other))
        np.testing.assert_allclose(found, known, atol=atol)


def column(x):
    x = np.array(x, dtype=np.float64)
    return np.array(np.broadcast_to(x, (COUNT,) if x.ndim < 2 else (x.shape[0], COUNT)))


@pytest.mark.parametrize("name", [*SENSORS, *BY_RAYS])
def test_rays_are_those_of_mitsuba(name):
    """For the same film position and aperture sample, within 1e-5 of the scene's scale (float32, some ten
    operations; 2e-4 for meters, from whose shapes its offsets and ours differ)."""
    _, sensor, camera, u = prepared(name)
    start = start_of(camera, u)
    uv = camera.region.to_uv(start.position)
    ray, weight = sensor.sample_ray_differential(0, 0.5, uv, mi.Point2f(u[2], u[3]))
    meter = "meter" in name
    np.testing.assert_allclose(column(start.ray.o), column(ray.o), atol=2e-4 if meter else 1e-5)
    np.testing.assert_allclose(column(start.ray.d), column(ray.d), atol=1e-5)
    weights = (column(mi.Spectrum(w)) for w in (start.weight, weight))
    np.testing.assert_allclose(*weights, rtol=1e-5)
    if name in BY_RAYS:
        assert camera.reason and camera.no_area
    if name in CAMERAS:
        np.testing.assert_allclose(column(start.ray.maxt), column(ray.maxt), rtol=1e-5)


@pytest.mark.parametrize("name", SENSORS)
def test_a_join_is_the_ray_back(name):
    """A point on a camera ray, joined with the sensor point of that ray, has its film position within 1e-3
    pixels (cameras: 1e-4, float32 at some 30 pixels, times ten), its direction and density within 1e-3."""
    _, _, camera, u = prepared(name)
    start = start_of(camera, u)
    p = start.ray.o + start.ray.d * mi.Float(0.5 + 5 * u[5])
    u_film = camera.region.to_uv(start.position)
    if "batch" in name:  # chooses the view, as the film position does
        u_film = mi.Point2f(u_film.x, 0)
    join = camera.connect(p, mi.Point2f(u[2], u[3]), u_film)
    valid = column(dr.select(join.valid, 1.0, 0.0)) > 0
    assert valid.mean() > 0.999
    near = column(start.pdf_w) > 1e-2  # off grazing directions, where rounding decides
    valid &= near
    np.testing.assert_allclose(column(join.d)[:, valid], -column(start.ray.d)[:, valid], atol=1e-3)
    np.testing.assert_allclose(column(join.pdf_w)[valid], column(start.pdf_w)[valid], rtol=5e-3)
    if name in CAMERAS:
        np.testing.assert_allclose(column(join.importance)[valid], column(start.pdf_w)[valid], rtol=1e-4)
    if name != "distant":
        assert_same_position(join, start, 1e-4 if name in CAMERAS else 1e-3, valid)


@pytest.mark.parametrize("name", [name for name in CAMERAS if "orthographic" not in name])
def test_splats_do_not_depend_on_where_the_camera_stands(name):
    """Within 1e-4 pixels, as at the origin. Eight places, since in some of them rounding errors cancel."""
    rng = np.random.default_rng(6)
    for shift in rng.uniform(-1e4, 1e4, (8, 3)):
        part = CAMERAS[name]()
        away = T().translate(shift.tolist()).rotate([0.6, 0, 0.8], 35)
        scene = mi.load_dict({"type": "scene", "it": part | {"to_world": away @ part["to_world"]}})
        camera = sensors.prepare(scene.sensors()[0], ShapeErrors(scene), scene)
        u = rng.random((5, COUNT), dtype=np.float32)
        start = start_of(camera, u)
        join = camera.connect_direction(-start.ray.d, mi.Point2f(u[2], u[3]), None)
        valid = column(dr.select(join.valid, 1.0, 0.0)) > 0
        assert valid.mean() > 0.99  # float32 loses a few on the film's rim
        assert_same_position(join, start, 1e-4)


@pytest.mark.parametrize("name", [name for name in SENSORS if not name.startswith(("distant", "irrad"))])
def test_nothing_is_joined_beyond_the_far_plane(name):
    """Points at 0.999 of a camera ray's length are joined, those at 1.001 are not."""
    _, _, camera, u = prepared(name)
    start = start_of(camera, u)
    u_film = camera.region.to_uv(start.position)
    if "batch" in name:
        u_film = mi.Point2f(u_film.x, 0)
    for part, share in ((0.999, 1), (1.001, 0)):
        p = start.ray.o + start.ray.d * (start.ray.maxt * part)
        join = camera.connect(p, mi.Point2f(u[2], u[3]), u_film)
        # Film positions at the edge of the region, or of a view, may be rounded out of it.
        assert abs(column(dr.select(join.valid, 1.0, 0.0)).mean() - share) < 1e-3


@pytest.mark.parametrize("name", SENSORS)
def test_importance_integrates_to_the_weight(name):
    """Uniform radiance 1 gives 1, for a meter pi: over directions, the points being far away and uniform
    about the sensor; of parallel sensors over a square across their direction. Tolerance: five standard
    errors, below 3 %, plus 2e-3 for points that are not at infinity."""
    _, sensor, camera, u = prepared(name)
    lens, choice = mi.Point2f(u[2], u[3]), mi.Point2f(u[6], u[7])
    if name in PARALLEL:
        start = start_of(camera, u)
        frame = mi.Frame3f(mi.Vector3f(start.ray.d))
        side = 12.0
        middle = column(start.ray.o + start.ray.d * 4).mean(1)
        p = mi.Point3f(*middle.tolist()) + side * (
            frame.s * mi.Float(u[0] - 0.5) + frame.t * mi.Float(u[1] - 0.5)
        )
        measure = side**2
    elif name in CAMERAS:  # from a cone about the axis
        cos = np.cos(np.deg2rad(50))
        local = mi.warp.square_to_uniform_cone(mi.Point2f(u[0], u[1]), mi.Float(cos))
        p = sensor.world_transform() @ mi.Point3f(local * 3000)
        measure = 2 * np.pi * (1 - cos)
    else:
        # From all directions, so that views of a batch that look elsewhere are seen too.
        middle = mi.Point3f(0, 1.5, 3)
        p = middle + mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1])) * 3000
        measure = 4 * np.pi
    join = camera.connect(p, lens, choice)
    values = np.where(column(dr.select(join.valid, 1.0, 0.0)) > 0, column(join.importance), 0) * measure
    error = values.std() / np.sqrt(COUNT)
    known = np.pi if "meter" in name else 1.0
    assert error < 0.03 * known
    assert abs(values.mean() - known) < 5 * error + 2e-3 * known


@pytest.mark.parametrize("name", AREA)
def test_an_arrival_is_a_start_in_reverse(name):
    """Light that comes along a camera ray arrives at its film position, with the densities of the start and
    of the join, and importance times cosine over both is the start's weight. Tolerance: 1e-2, twice what
    offsets from a meter's shape (2e-4) are of a cosine of 0.05."""
    scene, _, camera, u = prepared(name)
    start = start_of(camera, u)
    p = start.ray.o + start.ray.d * mi.Float(0.5 + 5 * u[5])
    ray = mi.Ray3f(p, mi.Vector3f(-start.ray.d))
    pi = scene.ray_intersect_preliminary(ray)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    lens = name.startswith("thinlens")
    if lens:  # nothing in between: what is there does not matter to the question
        pi = dr.zeros(mi.PreliminaryIntersection3f, COUNT)
        pi.t = mi.Float(dr.inf)
    walk = SimpleNamespace(previous=p, d=ray.d, pi=pi, active=mi.Bool(True))
    vertex = SimpleNamespace(si=si, cos=dr.abs(dr.dot(si.n, ray.d)), hit=si.is_valid())
    arrival = camera.hit(walk, vertex, mi.Bool(False))
    active = column(dr.select(arrival.active, 1.0, 0.0)) > 0
    cos = column(arrival.cos)
    keep = active & (cos > 0.05)
    assert active.mean() > (0.999 if lens else 0.4)  # before a meter lies the scene
    cos, both = cos[keep], (column(arrival.pdf_a) * column(arrival.pdf_w))[keep]
    weight = column(arrival.importance)[keep] * cos / both
    np.testing.assert_allclose(weight, column(start.weight)[keep], rtol=1e-2)
    np.testing.assert_allclose(column(arrival.pdf_w)[keep], column(start.pdf_w)[keep], rtol=1e-2)
    np.testing.assert_allclose(cos / both, column(start.arrival)[keep], rtol=1e-2)
    join = camera.connect(p, mi.Point2f(u[2], u[3]), camera.region.to_uv(start.position))
    ratio = column(join.arrival * join.dist2)[keep]
    np.testing.assert_allclose(ratio, cos / column(arrival.pdf_a)[keep], rtol=1e-2)
    if lens:
        assert_same_position(arrival, start, 2e-3, keep)
