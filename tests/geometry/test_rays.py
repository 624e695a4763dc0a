"""Rays: none finds its own start, none leaks, whatever the scale and the place of the scene.

mitsuba3 #1871, #1962: offsets of 8.9e-5 (1 + max|p|) swallow small scenes and leave gaps in large ones.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import variants
from meshes import as_ply, ball_mesh, folder
from mitsuba_bdpt.geometry import quadrics, rays, rounding
from scene_parts import T, perspective

from scenes import DOWNWARDS, area, floor, integrator, layer, load, matte, renders, square

# (scale of the unit-sized shape, distance by which it is moved in each coordinate)
PLACES = {"small": (1e-3, 0.0), "unit": (1.0, 0.0), "large": (1e3, 0.0), "moved": (1.0, 1e3)}

CLOSED = {"sphere", "cube", "mesh", "instance"}
CONVEX = CLOSED | {"disk", "rectangle", "bsplinecurve", "linearcurve"}  # sdfgrid: not exactly
FLAT = {"disk", "rectangle"}  # both sides are outside


def count(mask):
    return int(dr.count(mask)[0])


def _curve(kind, scale, shift):
    """A straight curve of constant radius, so that it is convex."""
    points = np.linspace([-1, -0.5, -0.2], [1, 0.5, 0.3], 6) * scale + shift
    path = folder() / f"{kind}-{scale}-{shift}.txt"
    lines = [" ".join(f"{x:.9g}" for x in (*p, 0.2 * scale)) for p in points]
    path.write_text("\n".join(lines) + "\n")
    return {"type": kind, "filename": str(path)}


def _sdf(transform):
    x = np.linspace(0, 1, 20)
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    distance = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.4
    centred = transform @ T().scale(2) @ T().translate(-0.5)
    return {
        "type": "sdfgrid",
        "grid": mi.TensorXf(distance[..., None].astype(np.float32)),
        "to_world": centred,
    }


def shape_scene(kind, place):
    """A scene of one shape, about 2 units wide before scaling, turned to no axis; ``place`` of `PLACES`, or a
    scale and three shifts."""
    scale, shift = PLACES[place] if isinstance(place, str) else place
    shift = np.broadcast_to(shift, 3)
    turn = T().rotate(np.array([1, 2, 3]) / np.sqrt(14), 35)  # `rotate` shears about axes of other lengths
    placed = T().translate(shift.tolist()) @ T().scale(scale)
    transform = placed @ turn
    if kind in ("bsplinecurve", "linearcurve"):
        shape = {"shape": _curve(kind, scale, shift)}
    elif kind == "mesh":
        shape = {"shape": ball_mesh(1) | {"to_world": transform}}
    elif kind == "sdfgrid":
        shape = {"shape": _sdf(placed)}  # takes no rotation
    elif kind == "instance":
        instance = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": placed}
        group = {"type": "shapegroup", "ball": ball_mesh(1) | {"to_world": turn}}
        shape = {"group": group, "shape": instance}
    elif kind == "cylinder":
        p0, p1 = (np.array([[-0.3, 0.2, -1], [0.3, -0.1, 1]]) * scale + shift).tolist()
        shape = {"shape": {"type": kind, "p0": p0, "p1": p1, "radius": 0.6 * scale}}
    else:
        shape = {"shape": {"type": kind, "to_world": transform}}
    return mi.load_dict({"type": "scene", **shape})


def _sphere(rng):
    return mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))


def first_hits(scene, place, n, rng, inside, distance=3.0):
    """Hits of ``n`` rays from ``distance`` outside (or from near the centre): ``(si, ray)``."""
    scale, shift = PLACES[place]
    spread = _sphere(rng) * dr.cbrt(rng.next_float32())
    if inside:
        origin, d = mi.Point3f(shift) + spread * (0.2 * scale), _sphere(rng)
    else:
        origin = mi.Point3f(shift) + _sphere(rng) * (distance * scale)
        d = dr.normalize(mi.Point3f(shift) + spread * scale - origin)
    ray = mi.Ray3f(origin, d)
    return scene.ray_intersect(ray), ray


def anchor_of(scene, si, ray):
    """The anchor of a hit, as a subpath makes it."""
    return rays.surface_anchor(si, ray, rounding.ShapeErrors(scene))


def bad_rays(kind, place, n, seed=0):
    """Shares of hits from which a ray finds its own start, and from which one leaks."""
    scene = shape_scene(kind, place)
    own = leaks = total = 0
    for inside in (False, True) if kind in CLOSED or kind == "cylinder" else (False,):
        rng = mi.PCG32(n, seed + 10 * inside)
        si, ray = first_hits(scene, place, n, rng, inside)
        hit = si.is_valid()
        anchor = anchor_of(scene, si, ray)
        d = _sphere(rng)
        cos = dr.dot(d, si.n)
        hit &= dr.abs(cos) > 1e-6  # along the surface: no side, and no light either
        again = scene.ray_intersect(rays.spawn(anchor, d, ray), hit)
        # Its own start: a hit nearby with the same normal; from a convex surface outwards, any hit.
        found = again.is_valid() & (again.t < 10 * anchor.offset)
        found &= dr.abs(dr.dot(again.n, si.n)) > 0.999
        if kind in CONVEX:
            found |= again.is_valid() & (mi.Bool(kind in FLAT) | (cos > 0))
        own += count(hit & found)
        if kind in CLOSED:
            leaks += count(hit & (cos < 0) & ~again.is_valid())
        total += count(hit)
    return own, leaks, total


KINDS = "sphere cylinder disk rectangle cube mesh instance bsplinecurve linearcurve sdfgrid".split()
# Hits per kind of shape, over all places (two rays each). SDF grids take 50 times longer a ray.
HITS = {"sdfgrid": 100_000}


def _allowed(kind, place, total):
    """How many of ``total`` hits may go wrong. Linear curves: Embree's own precision, far from the origin,
    and where radii are below 1e-3 (0.1-0.5 % of first hits lie inside the curve). Cubes and meshes: within
    rounding of an edge a hit may lie on the neighbouring face or outside, and a ray into the solid leaves it
    at once: some 1e-7 of the width, moved by a thousand widths 3e-5."""
    if kind == "linearcurve":
        return total * {"small": 1e-2, "moved": 1e-3}.get(place, 0), 0
    edges = kind in ("cube", "mesh", "instance")
    return 0, total * (1e-4 if place == "moved" else 5e-7 if edges else 0)


@pytest.mark.parametrize("kind", KINDS)
def test_no_ray_finds_its_own_start(kind):
    """And none leaves a closed shape through it. mitsuba3 #1871, #1962. With 8 ulps instead of 32, cylinders
    fail on 0.1 %, with 4 spheres, rectangles, cubes and instances too."""
    n = HITS.get(kind, 1_000_000)
    for place in PLACES:
        own, leaks, total = bad_rays(kind, place, n // 4)
        most_own, most_leaks = _allowed(kind, place, total)
        assert total > 0.005 * n
        assert own <= most_own, f"{kind}, {place}: {own} of {total} hits find their own start"
        assert leaks <= most_leaks, f"{kind}, {place}: {leaks} of {total} rays leak"


@pytest.mark.parametrize("distance", [30.0, 300.0])
@pytest.mark.parametrize("kind", KINDS)
def test_far_ends_do_not_block(kind, distance):
    """Mitsuba solves the quadratics of cylinders, and of spheres in visibility tests, in single precision.
    Segments back to where the rays came from are free in both directions, and no ray that starts there finds
    its own start: exactly so on flat shapes, up to one in 1e4 where limbs and edges are grazed."""
    n = 1 << (14 if kind == "sdfgrid" else 17)
    scene = shape_scene(kind, "unit")
    rng = mi.PCG32(n, 7)
    si, ray = first_hits(scene, "unit", n, rng, False, distance)
    anchor = anchor_of(scene, si, ray)
    flux = dr.select(si.is_valid(), dr.abs(dr.dot(si.n, ray.d)), 0)
    if kind == "cylinder":  # from outside: its inside is hidden by its rim
        flux = dr.select(dr.dot(si.n, ray.d) < 0, flux, 0)
    like = dr.zeros(mi.SurfaceInteraction3f, n)
    for a, b in ((rays.free_anchor(ray.o), anchor), (anchor, rays.free_anchor(ray.o))):
        blocked = scene.ray_test(rays.segment(a, b, like))
        lost = dr.sum(dr.select(blocked, flux, 0)) / dr.sum(flux)
        assert lost[0] <= (0 if kind in FLAT else 1e-4)
    if kind != "sdfgrid":  # convex: outwards there is nothing
        d = _sphere(rng)
        side = dr.sign(dr.dot(-ray.d, si.n)) if kind in FLAT else 1.0  # cylinders: outside only
        outwards = si.is_valid() & (dr.dot(-ray.d, si.n) * side > 0)
        outwards &= dr.dot(d, si.n) * side > 1e-3
        found = outwards & scene.ray_test(rays.spawn(anchor, d, ray))
        assert count(found) <= (0 if kind in FLAT else 1e-4 * n)


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("kind", [k for k in KINDS if k != "sdfgrid"])
def test_what_was_found_from_near_by_is_seen_from_afar(kind, small):
    """A visibility ray errs in proportion to its own length. With and without a ball so small that rays ask
    what they meet; on flat shapes all, else all but one in 1e4. Cosines below 0.1, where curves and cylinders
    hide themselves, are left out."""
    n = 1 << 16
    scene = shape_scene(kind, "unit")
    rng = mi.PCG32(n, 7)
    si, ray = first_hits(scene, "unit", n, rng, False)
    ball = {"type": "sphere", "center": [0, 0, 1e3], "radius": 1e-3 if small else 1e3 - 600}
    errors = rounding.ShapeErrors(mi.load_dict({"type": "scene", "ball": ball, "far": far_away(16)}))
    assert errors.small == small
    anchor = anchor_of(scene, si, ray)
    d = _sphere(rng)
    d = dr.mulsign(d, dr.dot(d, si.n) * dr.dot(-ray.d, si.n))
    counts = si.is_valid() & (dr.abs(dr.dot(d, si.n)) > 0.1)
    if kind not in FLAT:  # from outside: a cylinder is open
        counts &= dr.dot(d, si.n) > 0
    from_afar = rays.free_anchor(anchor.p + 300 * d)
    number = rounding.met(si.shape, si.instance)
    shadow_ray, own = rays.shadow_ray(errors, from_afar, anchor, number, dr.zeros(mi.SurfaceInteraction3f, n))
    blocked = counts & rays.occluded(scene, errors, shadow_ray, counts, own)
    assert count(counts) > 0.01 * n
    assert count(blocked) <= (0 if kind in FLAT else 1e-4 * n)


@pytest.mark.parametrize("place", PLACES)
def test_thin_walls_block_and_ends_do_not(place):
    """mitsuba3 #1871, #1962. The moved scene, where coordinates of 1e3 leave steps of 6e-5, has ten times the
    gap and the thickness."""
    n = 1 << 20
    scale, shift = PLACES[place]
    wide = 10 if place == "moved" else 1
    to_place = T().translate([shift] * 3) @ T().scale(scale)
    gap = 0.01 * wide
    squares = {
        "below": {"type": "rectangle", "to_world": to_place @ T().translate([0, 0, -gap])},
        "above": {
            "type": "rectangle",
            "to_world": to_place @ T().translate([0, 0, gap]) @ T().rotate([1, 0, 0], 180),
        },
    }
    plate = {"type": "cube", "to_world": to_place @ T().scale([1.5, 1.5, 5e-4 * wide])}
    open_scene = mi.load_dict({"type": "scene", **squares})
    walled = mi.load_dict({"type": "scene", **squares, "plate": plate})
    rng = mi.PCG32(n, 3)
    anchors = []
    for z, side in ((-gap, 1), (gap, -1)):
        # From between plate and square, so that the point is found with the plate in place.
        target, origin = (
            mi.Point3f(*(0.99 * (2 * rng.next_float32() - 1) for _ in range(2)), height) * scale + shift
            for height in (z, z + side * 0.5 * gap)
        )
        ray = mi.Ray3f(origin, dr.normalize(target - origin))
        si = open_scene.ray_intersect(ray)
        assert dr.all(si.is_valid())
        anchors.append(anchor_of(open_scene, si, ray))
    like = dr.zeros(mi.SurfaceInteraction3f, n)
    for a, b in (anchors, anchors[::-1]):
        segment = rays.segment(a, b, like)
        assert count(~walled.ray_test(segment)) == 0, "leaks through the plate"
        assert count(open_scene.ray_test(segment)) == 0, "blocked by its ends"


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", ["sphere", "cube", "mesh", "instance"])
def test_points_of_a_hollow_see_each_other(kind, place):
    """But for segments that stay within one offset of an end's surface, as between two points of one face.
    Moved by 1e3: at most 1e-4 of them, near edges."""
    n = 1 << 18
    scene = shape_scene(kind, place)
    anchors = []
    for seed in (1, 2):
        si, ray = first_hits(scene, place, n, mi.PCG32(n, seed), inside=True)
        anchors.append(anchor_of(scene, si, ray))
    a, b = anchors
    between = b.p - a.p
    counts = dr.abs(dr.dot(between, a.n)) > a.offset
    counts &= dr.abs(dr.dot(between, b.n)) > b.offset
    segment = rays.segment(a, b, dr.zeros(mi.SurfaceInteraction3f, n))
    blocked = count(counts & scene.ray_test(segment))
    assert count(counts) > 0.5 * n
    assert blocked <= (1e-4 * n if place == "moved" else 0)


def seen_by(eye, target, fov, **more):
    return perspective(fov=fov, keys={"to_world": T().look_at(eye, target, [0, 0, 1])} | more)


def patch_and_far_wall(kind, distance, shift):
    """A wall lit by a patch of half a unit, ``distance`` away, which a lamp 0.9 away lights. The patch is a
    ``cube`` or a ``rectangle``, at the origin but for the ``shift`` along x."""

    def facing(x, y, z, target, scale):
        return T().look_at([x + shift, y, z], [target[0] + shift, *target[1:]], [0, 0, 1]).scale(scale)

    size = 0.5 if kind == "rectangle" else 0.3
    white = {"bsdf": matte(0.8)}
    emitter = {"type": "area", "radiance": 5.0 * distance**2}
    lamp, wall = (
        {"type": "rectangle", "to_world": facing(*place, (0, 0, 0), scale)}
        for place, scale in (((0, 0.9, 0.3), 0.2), ((0, distance, 0), 0.3 * distance))
    )
    return {
        "sensor": seen_by([shift - 0.2 * distance, 0.9 * distance, 0], [shift, distance, 0], 40),
        "patch": {"type": kind, "to_world": facing(0, 0, 0, (0, 1, 0.3), size)} | white,
        "lamp": lamp | {"emitter": emitter},
        "wall": wall | white,
    }


@pytest.mark.parametrize("kind", ["cube", "rectangle"])
def test_the_image_does_not_depend_on_where_the_origin_is(kind):
    """Within 5 %: four standard errors if the two had nothing in common; they agree within 0.1 %."""
    integrator = {"type": "bdpt", "max_depth": 3, "skip": "none"}
    at_origin, beside = (
        _mean(patch_and_far_wall(kind, 60.0, shift), integrator, 32) for shift in (0.0, 120.0)
    )
    assert abs(at_origin / beside - 1) < 0.05


@pytest.mark.parametrize("kind", ["cube", "rectangle"])
def test_lamps_at_the_origin_are_seen_from_afar_in_fog(kind):
    """Within 2 %, five standard errors."""
    fog = {"type": "homogeneous", "sigma_t": 0.01, "albedo": 0.9}
    lamp = {"type": kind, "to_world": T().look_at([0, 0, 0], [0, -1, 0.2], [0, 0, 1]).scale(0.7)}
    scene = load(
        fog=fog,
        sensor=seen_by([0, -29, 7], [0, 0, 0], 5, medium={"type": "ref", "id": "fog"}),
        lamp=lamp | {"emitter": area(5.0)},
    )
    bdpt = integrator(max_depth=1, skip="none", layers="strategies")
    images = renders(scene, bdpt, 64, 1)
    joined, hit = (layer(images, bdpt, f"unweighted.{name}").mean() for name in ("s1t1", "s0t2"))
    assert abs(joined / hit - 1) < 0.02


@pytest.mark.parametrize("parameters", [{"light_paths": 0}, {"skip": "none"}], ids=["path tracing", "all"])
@pytest.mark.parametrize("radius", [1.0, 0.1, 0.01, 1e-3, 1e-5])
def test_lamps_on_spheres_however_small(radius, parameters):
    """The closed form pi L (R / d)^2 cos. Tolerance: 0.05 %; the mean of 2^22 samples has a standard error
    below 0.01 %, the density of a cone is right within 0.012 %."""
    emitter = {"type": "area", "radiance": 1 / radius**2}
    ground = {"type": "rectangle", "to_world": T().translate([4, 0, 0]).rotate([1, 0, 0], -90)}
    eye = {"to_world": T().look_at([4, 3, 0], [4, 0, 0], [1, 0, 0])}
    scene = load(
        sensor=perspective(fov=2, keys=eye, component_format="float32"),
        floor=ground | {"bsdf": matte(0.5)},
        lamp={"type": "sphere", "center": [0, 6.5, 2.7], "radius": radius, "emitter": emitter},
    )
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 2} | parameters)
    mean = np.mean([np.array(mi.render(scene, integrator=integrator, spp=1 << 12, seed=s)) for s in range(4)])
    d2 = 4**2 + 6.5**2 + 2.7**2
    expected = 0.5 * 6.5 / d2**1.5  # at the middle of a view of 0.1 x 0.1
    assert abs(mean / expected - 1) < 5e-4, f"{mean / expected - 1:.2e} off"


@pytest.mark.parametrize("extent", [np.nan, np.inf])
def test_spheres_are_small_in_scenes_without_bounds(extent):
    """One vertex at infinity leaves a scene without a size."""
    assert quadrics.is_small(quadrics.Sphere([0, 0, 0], 1e-3, 1.0, False), extent)


@pytest.mark.skipif(variants.BACKEND == "cuda", reason="with CUDA all coordinates of flat shapes count")
def test_reach_of_triangles():
    """The largest coordinate of an edge weighted by the normal; 0 for triangles along the axes and broken
    ones."""

    def reach(*rows, last=3):
        mesh = mi.Mesh("mesh", len(rows), 2)
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(np.array(rows, np.float32).ravel())
        params["faces"] = mi.UInt32([0, 1, 2, 0, 2, last])
        params.update()
        return rounding.reaches(mesh).tolist()

    triangle = [90, 0, 0], [97, 0, -7], [90, 3, 0]
    assert reach(*triangle, [97, 9, 0]) == [7, 0]
    assert reach(*triangle, [np.inf, 2, 0]) == [7, 0]
    assert reach(*triangle, [np.nan, 2, 0]) == [7, 0]
    assert reach(*triangle, last=2_000_000_000) == [7, 0]
    assert reach([90, 0, 0], [97, 0, 0], [90, 3, 0], [80, 8, 0]) == [0, 0]


@pytest.mark.skipif(variants.BACKEND == "cuda", reason="states what Embree answers; CUDA variants use OptiX")
def test_reach_with_optix(monkeypatch):
    """OptiX blocked 9 % of the rays that leave a floor of 2,000 units a unit below the camera."""
    floor = mi.load_dict({"type": "rectangle", "to_world": T().scale(1000)})
    assert rounding.reaches(floor).tolist() == [0]
    monkeypatch.setattr(rounding, "_uses_embree", lambda: False)
    assert rounding.reaches(floor).tolist() == [1000]
    cube = mi.load_dict({"type": "cube", "to_world": T().scale([5, 1, 1])})
    assert set(rounding.reaches(cube)) == {2, 10}


@pytest.mark.parametrize("kind", [k for k in KINDS if "curve" not in k])
def test_no_ray_finds_its_own_start_on_large_shapes(kind):
    """The coordinates that a hit is computed from may be larger than those of the hit."""
    scale, n = 1e4, 1 << (13 if kind == "sdfgrid" else 17)
    d = mi.Vector3f(0.36, 0.48, 0.8)
    at_origin = shape_scene(kind, (scale, 0.0))
    si = at_origin.ray_intersect(mi.Ray3f(mi.Point3f(-4 * scale * d), d))
    assert si.is_valid()[0]
    scene = shape_scene(kind, (scale, (-np.array(si.p)[:, 0]).tolist()))
    rng = mi.PCG32(n, 3)
    target = mi.Point3f(_sphere(rng) * dr.cbrt(rng.next_float32()))
    origin = mi.Point3f(_sphere(rng) * (3 * rng.next_float32()))
    ray = mi.Ray3f(origin, dr.normalize(target - origin))
    si = scene.ray_intersect(ray)
    anchor = anchor_of(scene, si, ray)
    d = _sphere(rng)
    hit = si.is_valid() & (dr.abs(dr.dot(d, si.n)) > 1e-3)
    again = scene.ray_intersect(rays.spawn(anchor, d, ray), hit)
    own = again.is_valid() & (dr.abs(dr.dot(again.n, si.n)) > 0.999)
    own &= mi.Bool(kind in FLAT) | (again.t < 10 * anchor.offset)
    assert count(hit) > 0.1 * n
    assert count(hit & own) == 0


@pytest.mark.parametrize("kind", ["rectangle", "cube", "mesh"])
def test_floors_along_the_axes_keep_what_is_small(kind):
    """Offsets are those of the distances, also on a small box in the same mesh as a tilted floor."""
    t, size = T(), 1e5
    if kind == "mesh":
        rows = [[-size, -size, -size - 9], [size, -size, -9], [0, size, -9]]  # far below
        box = mi.load_dict({"type": "cube", "to_world": t.scale(0.01)})
        p, faces = (np.array(mi.traverse(box)[k]).reshape(-1, 3) for k in ("vertex_positions", "faces"))
        corners = len(p) + np.arange(3)[None]
        shape = as_ply(np.concatenate([p, rows]), np.concatenate([faces, corners]))
    else:
        down = t.translate([0, 0, -size]).scale(size) if kind == "cube" else t.scale(size)
        shape = {"type": kind, "to_world": down}
    scene = mi.load_dict({"type": "scene", "shape": shape})
    n = 1 << 14
    rng = mi.PCG32(n, 5)
    side = 0 if kind == "mesh" else 9  # not where triangles of 1e5 join: rays pass between these
    target = mi.Point3f(rng.next_float32() * 0.02 - 0.01 + side, rng.next_float32() * 0.02 - 0.01, 0)
    origin = mi.Point3f(rng.next_float32() - 0.5 + side, rng.next_float32() - 0.5, 2)
    ray = mi.Ray3f(origin, dr.normalize(target - origin))
    si = scene.ray_intersect(ray)
    anchor = anchor_of(scene, si, ray)
    assert count(si.is_valid() & (dr.abs(si.p.z) < 1)) == n
    assert float(dr.max(anchor.offset)[0]) <= (side + 3) * rounding.OFFSET_ULPS * 2.0**-24


def is_seen(scene, errors, origin, end, number, active=True):
    """Mask: the anchor ``end`` on the shape of this ``number`` is seen from ``origin``."""
    like = dr.zeros(mi.SurfaceInteraction3f)
    ray, own = rays.shadow_ray(errors, rays.free_anchor(origin), end, number, like)
    return ~rays.occluded(scene, errors, ray, mi.Bool(active), own)


def sight(origin, p, n, active=True, **shapes):
    """Mask: the points ``p`` with normals ``n`` of the shape ``target`` are seen from ``origin``; and whether
    rays ask what they meet, in a scene that is 16 wide."""
    scene = load(**shapes, far=far_away(16))
    errors = rounding.ShapeErrors(scene)
    shape = mi.ShapePtr(next(shape for shape in scene.shapes() if shape.id() == "target"))
    end = rays.sampled_anchor(mi.Point3f(p), mi.Normal3f(n), errors.at(shape))
    seen = is_seen(scene, errors, origin, end, rounding.met(shape), active)
    dr.eval(seen)  # while there is the scene
    return seen, errors.small


@pytest.mark.parametrize("stretch", [1.0, 50.0])
def test_cylinders_in_groups_are_seen_from_afar(stretch):
    """An instance has the rounding of what is in it, also where it stretches one direction, not along the
    cylinder's axis. All but one in 1e3 (grazing ones)."""
    turn = np.array(T().rotate([0, 0, 1], 45).rotate([1, 0, 0], 35).matrix)
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    instance["to_world"] = T(0.02 * np.diag([1, stretch, stretch, 50]) @ turn)
    tube = {"type": "cylinder", "p0": [0, 0, -1], "p1": [0, 0, 1]}
    scene = load(group={"type": "shapegroup", "shape": tube}, instance=instance)
    n = 1 << 16
    rng = mi.PCG32(n, 11)
    origin = mi.Point3f(7 * _sphere(rng))
    box = scene.bbox()
    u = mi.Vector3f(*(rng.next_float32() for _ in range(3)))
    target = mi.Point3f(box.min) + u * mi.Vector3f(box.max - box.min)
    ray = mi.Ray3f(origin, dr.normalize(target - origin))
    si = scene.ray_intersect(ray)
    outside = si.is_valid() & (dr.dot(si.n, ray.d) < -0.05)
    errors = rounding.ShapeErrors(scene)
    anchor = rays.surface_anchor(si, ray, errors)
    assert count(outside) > 0.02 * n
    seen = is_seen(scene, errors, origin, anchor, rounding.met(si.shape, si.instance), outside)
    assert count(outside & ~seen) <= 1e-3 * count(outside)
    found = scene.ray_test(rays.spawn(anchor, si.n, ray), outside)
    assert count(outside & found) <= 1e-3 * count(outside)


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize(
    ("kind", "radius"),
    [("sphere", 0.02), ("sphere", 3e-3), ("sphere", 1e-4), ("cylinder", 0.05), ("cylinder", 0.02)],
)
def test_backs_of_small_shapes_are_not_seen(kind, radius, flipped):
    """But for 1e-4 of the points off the outline, and on cylinders 2e-3: where 8 * 2^-24 t^2 / radius is more
    than the chord, Mitsuba itself finds no front (one in fifty points at a radius of 0.01, one in five at
    3e-3)."""
    shape = {"type": kind, "flip_normals": flipped}
    ends = {"p0": [0, 0, -1], "p1": [0, 0, 1]} if kind == "cylinder" else {}
    n = 1 << 16
    rng = mi.PCG32(n, 13)
    phi, z = 2 * dr.pi * rng.next_float32(), rng.next_float32() * 2 - 1
    across = 1 if kind == "cylinder" else dr.sqrt(1 - z * z)
    outwards = mi.Vector3f(dr.cos(phi) * across, dr.sin(phi) * across, 0 if kind == "cylinder" else z)
    p = mi.Point3f(outwards * radius)
    p.z += 0.5 * z if kind == "cylinder" else 0
    origin = mi.Point3f(8, 0, 0) + _sphere(rng)
    target = shape | ends | {"radius": radius}
    seen, _ = sight(origin, p, -outwards if flipped else outwards, target=target)
    cos = dr.dot(outwards, dr.normalize(origin - p))
    wrong = (dr.abs(cos) > 0.15) & (seen != (cos > 0))
    assert count(wrong) <= (2e-3 if kind == "cylinder" else 1e-4) * n


@pytest.mark.parametrize("radius", [0.02, 0.01, 1e-3])
def test_a_shell_about_a_small_sphere_hides_it(radius):
    """Shadow rays end before a small sphere, by more than its radius from afar."""
    lamp, shell = ({"type": "sphere", "radius": r * radius} for r in (1, 1.03))
    rng = mi.PCG32(1 << 16, 13)
    outwards, origin = _sphere(rng), mi.Point3f(8, 0, 0) + _sphere(rng)
    facing = dr.dot(outwards, origin) > 0
    seen, small = sight(origin, outwards * radius, outwards, facing, target=lamp, shell=shell)
    assert small and count(facing & seen) == 0


@pytest.mark.parametrize("radius", [0.01, 1e-3])
def test_small_spheres_hide_flat_shapes(radius):
    """Mitsuba's `ray_test` misses a sphere of radius 1e-3 from 8 away. Single precision errs by 1e-6 /
    radius."""
    turned = T().translate([-1.5 * radius, 0, 0]).rotate([0, 1, 0], 90).scale(2 * radius)
    ball, disk = {"type": "sphere", "radius": radius}, {"type": "disk", "to_world": turned}
    rng = mi.PCG32(1 << 14, 13)
    y, z = 1.4 * radius * (2 * rng.next_float32() - 1), 1.4 * radius * (2 * rng.next_float32() - 1)
    p, origin = mi.Point3f(-1.5 * radius, y, z), mi.Point3f(8, 0, 0)
    seen, small = sight(origin, p, mi.Normal3f(1, 0, 0), ball=ball, target=disk)
    to, o = p.numpy().T.astype(float), np.array([8.0, 0, 0])
    d = (to - o) / np.linalg.norm(to - o, axis=1)[:, None]
    miss = np.linalg.norm(np.cross(d, -o), axis=1) / radius
    seen = np.array(seen)
    assert small and not seen[miss < 0.999].any() and seen[miss > 1.001].all()


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("radius", [0.05, 0.03, 0.02])
def test_the_inside_of_small_tubes_is_seen_through_their_end(radius, flipped):
    """Of points inside, those are seen whose line leaves through the end, but for 2e-3 (those within 5 % of
    the rim, and at cosines below 0.05, are left out)."""
    half = 2 * radius
    ends = {"p0": [0, 0, -half], "p1": [0, 0, half]}
    tube = {"type": "cylinder", "radius": radius, "flip_normals": flipped} | ends
    n = 1 << 16
    rng = mi.PCG32(n, 13)
    phi, z = 2 * dr.pi * rng.next_float32(), half * (rng.next_float32() * 2 - 1)
    outwards = mi.Vector3f(dr.cos(phi), dr.sin(phi), 0)
    p = mi.Point3f(outwards.x * radius, outwards.y * radius, z)
    shift = mi.Vector3f(*(rng.next_float32() for _ in range(3)))
    origin = mi.Point3f(float(8 * np.sin(0.6)), 0, float(8 * np.cos(0.6))) + 0.2 * shift
    seen = np.array(sight(origin, p, -outwards if flipped else outwards, target=tube)[0])
    p, d = np.array(p, dtype=float), np.array(origin - p, dtype=float)
    inside = (np.array(outwards) * d).sum(0) < -0.05 * np.linalg.norm(d, axis=0)
    # Where the line meets the cylinder, as long as it were without ends, once more.
    leaves = p[2] - 2 * (p[0] * d[0] + p[1] * d[1]) / (d[0] ** 2 + d[1] ** 2) * d[2]
    for sure, expected in ((leaves > 1.05 * half, True), (leaves < 0.95 * half, False)):
        sure &= inside
        assert sure.sum() > 0.05 * n
        assert (seen[sure] != expected).mean() < 2e-3


def far_away(distance):
    """A small square, so that a scene is wide."""
    place = T().translate([-distance, 0, 0]).scale(0.1)
    return {"type": "rectangle", "to_world": place}


# -- thin things ------------------------------------------------------------------------------


BLACK = {"type": "twosided", "inner": matte(0)}


def seen_through_a_sheet(distance):
    """A white sky seen through a sheet of opacity 0.5 that is 0.3 mm thick, ``distance`` from the origin."""
    return {
        "sensor": perspective((0, 0, distance + 3), (0, 0, distance), 20),
        "sheet": {
            "type": "cube",
            "to_world": T().translate([0, 0, distance]).scale([1, 1, 1.5e-4]),
            "bsdf": {"type": "mask", "opacity": 0.5, "inner": BLACK},
        },
        "sky": {"type": "constant", "radiance": 1.0},
    }


def lamp_behind_a_plate(gap):
    """A floor 5 below a lamp of which a black plate, ``gap`` before it, hides half; None: half a lamp."""
    lamp, half = square((0, 5, 0), DOWNWARDS, 0.2, BLACK), [0.1, 0.2, 1]
    parts = {"plate": square((0.1, 5 - (gap or 0), 0), DOWNWARDS, half, BLACK)}
    if gap is None:
        lamp, parts = square((-0.1, 5, 0), DOWNWARDS, half, BLACK), {}
    return parts | {
        "sensor": perspective((0, 3, 3.5), (0, 0, 0)),
        "lamp": lamp | {"emitter": area(10.0)},
        "floor": floor(),
    }


def _mean(parts, integrator, spp=256):
    scene = mi.load_dict({"type": "scene"} | parts, optimize=False)
    made = mi.load_dict({"max_depth": 4} | integrator)
    return float(np.mean([np.array(mi.render(scene, integrator=made, spp=spp, seed=s)) for s in range(4)]))


OURS = {"all": {"type": "bdpt", "skip": "none"}, "path tracing": {"type": "bdpt", "light_paths": 0}}


@pytest.mark.parametrize("distance", [0.0, 3.0])
def test_a_thin_mask_is_two_surfaces(distance):
    """Of white light a quarter passes, wherever the sheet is; under `path` half of it, 3 from the origin.
    Tolerance: 1 %, five standard errors."""
    for name, parameters in OURS.items():
        assert abs(_mean(seen_through_a_sheet(distance), parameters, 1024) / 0.25 - 1) < 0.01, name
    by_path = _mean(seen_through_a_sheet(distance), {"type": "path"}, 1024)
    assert abs(by_path / (0.5 if distance else 0.25) - 1) < 0.01


def test_a_plate_close_to_a_lamp_hides_it():
    """With a plate 3 mm before half of the lamp the floor has the light of the other half alone; `path` has
    that of both, which its own hits deny. Tolerance: 1 %, of which 0.3 % for what the edge hides
    obliquely."""
    half = _mean(lamp_behind_a_plate(None), {"type": "path", "max_depth": 2})
    for name, parameters in OURS.items():
        assert abs(_mean(lamp_behind_a_plate(3e-3), parameters | {"max_depth": 2}) / half - 1) < 0.01, name
    by_path = _mean(lamp_behind_a_plate(3e-3), {"type": "path", "max_depth": 2})
    assert abs(by_path / (2 * half) - 1) < 0.01
