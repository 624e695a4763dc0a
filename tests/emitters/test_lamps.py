"""Lamps whose points Mitsuba chooses in a way that is repeated here: by texels, faces, disks, cones.

The densities of such choices enter the weights of all strategies. Where they are wrong each strategy alone
may still be right, but the weights do not sum to 1: so the sum of the weighted strategies of each path length
is compared with s = 0 alone, which samples no lamp.
"""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from meshes import ball_mesh
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.geometry import mitsubas_choices, smooth_meshes
from mitsuba_bdpt.geometry.shape_facts import ShapeFacts
from scene_parts import T, grey, perspective, sampled_emission
from scipy import stats
from test_endpoints import egg_with_coordinates, own_area_class

LEVEL = 1e-4
SEEDS = 8


def peaked(peak, height=8, width=16):
    """A texture of 0.5 with four texels of ``peak``."""
    data = np.full((height, width, 3), 0.5, dtype=np.float32)
    data[2, 3:7] = peak
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest"}


def gap(**lamp):
    """A floor and a ceiling that look at each other past the ``lamp`` at height 1.5."""
    plates = {
        name: {"type": "rectangle", "bsdf": grey(0.6), "to_world": T().translate([0, y, 0]).rotate(*turn)}
        for name, y, turn in (("floor", 0, ([1, 0, 0], -90)), ("ceiling", 3, ([1, 0, 0], 90)))
    }
    for plate in plates.values():
        plate["to_world"] = plate["to_world"].scale(1.5)
    sensor = perspective((0, 1.5, 5), (0, 1.5, 0), 45, size=12)
    return mi.load_dict({"type": "scene", "sensor": sensor} | plates | lamp)


def check_sums(scene, depth=2, spp=512, width=0.03, seeds=SEEDS):
    """For each path length the weighted strategies sum to s = 0 alone, of the same samples: Student's t-test
    of the differences of the image's means over seeds, Sidak over the path lengths, and 1e-4 of the mean for
    rounding; their standard error is below ``width`` of the mean."""
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": depth, "skip": "none", "layers": "strategies"})
    names = bdpt.aov_names()
    means = np.array([np.array(bdpt.render(scene, seed=s, spp=spp)).mean((0, 1)) for s in range(seeds)])
    layers = dict(zip(names, means[:, -len(names) :].T.astype(float), strict=True))
    level = 1 - (1 - LEVEL) ** (1 / depth)
    for k in range(1, depth + 1):
        alone = layers[f"unweighted.s0t{k + 1}.R"]
        both = sum(layers.get(f"weighted.s{s}t{k + 1 - s}.R", 0) for s in range(k + 2))
        off, error = (both - alone).mean(), stats.sem(both - alone)
        found = f"length {k}: {both.mean():.6f} +- {error:.6f}, s = 0 alone {alone.mean():.6f}"
        assert error <= width * max(alone.mean(), both.mean()), f"{found}, too noisy"
        reach = stats.t.isf(level / 2, seeds - 1) * error + 1e-4 * alone.mean()
        assert abs(off) <= reach, found
    assert alone.mean() > 0


PLACED = {
    "as it is": T(),
    "rotated": T().rotate([0.26726124, 0.53452248, 0.80178373], 130),
    "mirrored": T().scale([-1, 1, 1]),
}
CLOSED = ("sphere", "cylinder", "cube", "mesh")
FLAT = ("rectangle", "disk")


def textured_lamps():
    """Mirrored cylinders are refused; where Mitsuba's calls are right, one case for each shape is quick."""
    for shape, flipped, placed in itertools.product((*FLAT, *CLOSED), (False, True), PLACED):
        quick = shape in ("rectangle", "sphere") or (flipped and placed == "rotated")
        if (shape, placed) != ("cylinder", "mirrored"):
            name = ", ".join([shape, *["flipped"] * flipped, placed])
            yield pytest.param(shape, flipped, placed, id=name, marks=[] if quick else pytest.mark.slow)


@pytest.mark.parametrize("shape, flipped, placed", list(textured_lamps()))
def test_peaked_textures(shape, flipped, placed, tmp_path):
    """Mitsuba samples the texture of some lamps, and the shape of others. Closed shapes surround all if
    flipped."""
    # A sphere that is mirrored turns its normals as well.
    around = shape in CLOSED and flipped != (shape == "sphere" and placed == "mirrored")
    to_world = T().translate([0, 1.5, 0]).scale((16 if shape == "mesh" else 8) if around else 1)
    to_world = to_world @ PLACED[placed]
    if shape in FLAT:
        size = 1.6 if shape == "disk" else 1
        to_world = T().translate([0, 1.5, 0]).rotate([1, 0, 0], 75).scale(size) @ PLACED[placed]
    keys = {"type": shape, "to_world": to_world}
    if shape == "mesh":
        keys = {
            "type": "ply",
            "filename": egg_with_coordinates(tmp_path),
            "to_world": to_world @ T().translate([2.4, -2.6, 0.8]),
        }
    if shape == "cylinder":
        keys["to_world"] = to_world @ T().scale([1, 1, 2]).translate([0, 0, -0.5])
    lamp = keys | {"flip_normals": flipped, "bsdf": grey(0)}
    check_sums(gap(lamp=lamp | {"emitter": {"type": "area", "radiance": peaked(50)}}))


SHEARED = T([[1, 0.7, 0.4, 0], [0, 1, 0.3, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
LAMP = {"bsdf": grey(0), "emitter": {"type": "area", "radiance": 5.0}}
SHEARED_LAMPS = {
    "disk": ("disk", SHEARED),
    "stretched disk": ("disk", T().scale([1, 0.4, 2])),
    "rectangle": ("rectangle", SHEARED),
    "cube": ("cube", SHEARED.scale(0.6)),
    # Mitsuba's rotate shears about such an axis, and takes the inverse of a rotation; this rectangle keeps
    # its normal, and a mesh keeps no matrix.
    "turned rectangle": ("rectangle", T().rotate([1, 1, 0], 40)),
    "turned cube": ("cube", T().rotate([1, 1, 1], 40).scale(0.6)),
    # Mitsuba rotates the points of a sphere, but not their normals.
    "turned sphere": ("sphere", PLACED["rotated"].scale(0.6)),
}
# Rectangles, disks and spheres are one surface for all strategies, whatever turned them.
REFLECTORS = {
    "sheared instance": ("instance", SHEARED.scale(0.5)),
    "sheared cylinder": ("cylinder", SHEARED.scale(0.5)),
    "axis of two figures": ("instance", T().rotate([0.71, 0.71, 0], 180).scale(0.5)),
    "turned rectangle": ("rectangle", T().rotate([1, 1, 1], 40)),
    "turned disk": ("disk", T().rotate([1, 1, 1], 40)),
    "turned sphere": ("sphere", T().rotate([1, 1, 1], 40).scale(0.5)),
}


@pytest.mark.parametrize("name", SHEARED_LAMPS)
def test_shapes_that_may_be_sheared(name):
    shape, matrix = SHEARED_LAMPS[name]
    to_world = T().translate([0, 1.5, 0]).rotate([1, 0, 0], 75) @ matrix
    check_sums(gap(lamp=LAMP | {"type": shape, "to_world": to_world}))


@pytest.mark.parametrize("name", REFLECTORS)
def test_what_reflects_may_be_sheared(name):
    """Connections need the surface's area and normal."""
    shape, matrix = REFLECTORS[name]
    parts = {"lamp": {"type": "rectangle", "to_world": T().translate([0, 2.9, 0]).rotate([1, 0, 0], 90)}}
    parts["lamp"]["emitter"] = LAMP["emitter"]
    keys = {"type": shape, "to_world": T().translate([0, 1, 0]) @ matrix, "bsdf": grey(0.6)}
    if shape == "instance":
        parts["group"] = {"type": "shapegroup", "cube": {"type": "cube", "bsdf": keys.pop("bsdf")}}
        keys["ref"] = {"type": "ref", "id": "group"}
    check_sums(gap(**parts, thing=keys), depth=3, spp=1024)


def test_flat_instances_are_not_refused():
    flat = T().rotate([0.6, 0.8, 0], 30).scale([1, 1, 1e-7])
    group = {"type": "shapegroup", "plate": {"type": "rectangle"}}
    one = {"type": "instance", "to_world": flat, "group": {"type": "ref", "id": "group"}}
    ShapeFacts(mi.load_dict({"type": "scene", "group": group, "one": one}))


def test_a_sheared_disk_is_found_where_it_is_sampled():
    """Of a disk turned by `rotate` about [1, 1, 0], 40 degrees, rays find 46 % of the sampled points."""
    matrix = np.array(T().rotate([1, 1, 0], 40).matrix)
    lamp = {"type": "disk", "emitter": {"type": "area", "radiance": 5.0}}
    scene = gap(lamp=lamp | {"to_world": T().translate([0, 1.5, 0]) @ T(matrix)})
    emitters = Emitters(scene)
    e, _ = sampled_emission(emitters, 1000)
    si = scene.ray_intersect(mi.Ray3f(e.si.p + 0.01 * e.anchor.n, mi.Vector3f(-e.anchor.n)))
    np.testing.assert_allclose(np.array(si.p), np.array(e.si.p), atol=1e-5)
    area = np.pi * np.linalg.norm(np.cross(matrix[:3, 0], matrix[:3, 1]))
    np.testing.assert_allclose(np.array(e.pdf_first), 1 / area, rtol=1e-5)
    for turned in (T().rotate([1, 1, 0], 40), T().rotate([0, 0, 2], 40)):
        with pytest.raises(ValueError, match="give rotate an axis of length 1"):
            Emitters(gap(lamp=lamp | {"to_world": turned}))


def shining_ball(subdivisions, radius=0.5):
    """A ball of 20 * 4^n triangles at the height of the `gap`'s middle."""
    return ball_mesh(subdivisions) | LAMP | {"to_world": T().translate([0, 1.5, 0]).scale(radius)}


@pytest.mark.parametrize("subdivisions", [0, 3, 5, 6])
def test_normals_of_fine_meshes(subdivisions):
    """Within the largest angle between a face and the sphere above it: that to a corner, 37 degrees of an
    icosahedron, halved by each division, and two fifths more, since the middle triangles are larger."""
    count = 20_000
    scene = gap(lamp=shining_ball(subdivisions))
    emitters = Emitters(scene)
    e, u = sampled_emission(emitters, count)
    at = dr.zeros(mi.SurfaceInteraction3f, count)
    at.p = mi.Point3f(0.3, 0, 0.2)
    direct = emitters.sample_direct(at, mi.Point2f(u[:2]), mi.Bool(True))
    limit = 1.4 * 0.652 / 2**subdivisions
    for anchor in (e.anchor, direct.anchor):
        away = dr.normalize(anchor.p - mi.Point3f(0, 1.5, 0))
        cos = np.abs(np.array(dr.dot(away, anchor.n)))
        assert np.isfinite(cos).all() and (cos > np.cos(limit)).all(), (cos < np.cos(limit)).mean()


def placed_lamps():
    """Shapes and ``to_world`` of `test_normals_have_the_sign_of_hits`."""
    for shape, placed, flipped in itertools.product((*FLAT, *CLOSED), PLACED, (False, True)):
        if (shape, placed) != ("cylinder", "mirrored"):  # refused
            yield pytest.param(shape, placed, flipped, id=f"{shape}, {placed}" + ", flipped" * flipped)


@pytest.mark.parametrize("shape, placed, flipped", list(placed_lamps()))
def test_normals_have_the_sign_of_hits(shape, placed, flipped):
    """The side of an emitting surface decides in which medium light starts. 99 % of the points: others are on
    edges."""
    count = 2000
    lamp = {"type": shape, "flip_normals": flipped}
    if shape == "mesh":
        lamp |= ball_mesh(1)
    lamp |= {"to_world": PLACED[placed], "emitter": {"type": "area", "radiance": 1.0}}
    scene = mi.load_dict({"type": "scene", "lamp": lamp})
    emitters = Emitters(scene)
    e, u = sampled_emission(emitters, count, seed=3)
    at = dr.zeros(mi.SurfaceInteraction3f, count)
    at.p = mi.Point3f(3, 4, -5)
    direct = emitters.sample_direct(at, mi.Point2f(u[:2]), mi.Bool(True))
    for anchor in (e.anchor, direct.anchor):
        si = scene.ray_intersect(mi.Ray3f(anchor.p + 1e-3 * anchor.n, -mi.Vector3f(anchor.n), 2e-3, 0, []))
        same = np.array(si.is_valid() & (dr.squared_norm(si.n - anchor.n) < 1e-3))
        assert same.mean() > 0.99


def test_a_fine_mesh_shines_like_any():
    check_sums(gap(lamp=shining_ball(5, 0.6)), width=0.01)


def test_another_table_of_faces_is_noticed(monkeypatch):
    """By sums in double precision, and after an edit of the faces alone, after which Mitsuba keeps
    its areas."""
    scene = gap(lamp=shining_ball(6))
    Emitters(scene)
    right = smooth_meshes._Faces.of

    def in_double(shape):
        faces = right(shape)
        if faces is not None:
            p = np.array(mi.traverse(shape)["vertex_positions"], dtype=float).reshape(-1, 3)
            a, b, c = p[np.array(mi.traverse(shape)["faces"]).reshape(-1, 3)].transpose(1, 0, 2)
            faces.sums = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1)) / 2
            faces.area = faces.sums[-1]
        return faces

    with monkeypatch.context() as planted:
        planted.setattr(smooth_meshes._Faces, "of", in_double)
        with pytest.raises(ValueError, match="bdpt: .*% of the points that Mitsuba samples on the mesh"):
            Emitters(scene)
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith(".faces"))
    params[key] = np.roll(np.array(params[key]).reshape(-1, 3), 100, axis=0).ravel().tolist()
    params.update()
    with pytest.raises(ValueError, match="update vertex_positions with them, or load"):
        Emitters(scene)
    positions = key.replace("faces", "vertex_positions")
    params[positions] = np.array(params[positions]).tolist()
    params.update()
    Emitters(scene)


def test_faces_are_chosen_as_mitsuba_chooses():
    """A search within a part of [0, 1) may miss the face by one at the part's ends; areas over six
    decades."""
    rng, meshes = np.random.default_rng(0), [None]
    for count in (1000, 3):
        areas = 10 ** rng.uniform(-6, 0, count) * (np.arange(count) % 5 > 0)
        chosen = mi.DiscreteDistribution(mi.Float(areas))
        zeros = np.zeros((count, 3))
        meshes.append(smooth_meshes._Faces(zeros, zeros, np.array(chosen.cdf), dr.slice(chosen.sum())))
        ends = np.arange(1, 2048, dtype=np.float32) / 2048
        u = np.concatenate([[0, 1 - 2**-24], ends, np.nextafter(ends, 0), rng.random(1 << 16) * (1 - 2**-24)])
        tables, u = smooth_meshes.SmoothMeshes(meshes), mi.Float(u.astype(np.float32))
        found = tables._face(mi.UInt32(len(meshes) - 1), u, mi.Bool(True))
        assert dr.all(found - int(tables._first[len(meshes) - 1]) == chosen.sample(u))


@pytest.mark.parametrize("u", [0.4, 0.9])
def test_a_dome_is_sampled_by_its_texture_wherever_that_is_bright(u):
    """Normals of two points of a sphere may be opposite without being flipped. (Relative variance of a floor
    by texture 0.003; by shape, with the sun at u = 0.9: 8.2.)"""
    image = np.full((64, 128, 3), 0.2, np.float32)
    image[26:28, int(u * 128) - 1 : int(u * 128) + 1] = 2000
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "nearest"}
    dome = {"type": "sphere", "flip_normals": True, "emitter": {"type": "area", "radiance": texture}}
    emitters = Emitters(mi.load_dict({"type": "scene", "dome": dome}))
    (group,) = emitters.groups
    assert mitsubas_choices.is_sampled_by_texture(emitters.scene.emitters()[0])
    assert group._surfaces.textured.mask.all


@pytest.mark.parametrize("emitter", [None, "timed_sunsky", "own_area"])
def test_textured_lamps_beside_shapes_without_points(emitter, tmp_path):
    curve = tmp_path / "curve.txt"
    curve.write_text("\n".join(f"{x} 1 0 0.1" for x in (-1.5, -0.5, 0.5, 1.5)))
    area = {"type": "area", "radiance": peaked(20)}
    lamps = {
        "first": {"type": "cylinder", "to_world": T().translate([-1, 1.5, 0]).scale(0.4)},
        "second": {"type": "cube", "to_world": T().translate([1, 1.5, 0]).scale(0.4)},
    }
    curve = {"type": "bsplinecurve", "filename": str(curve), "bsdf": grey(0.5)}
    others = {
        "group": {"type": "shapegroup", "a": {"type": "cube", "bsdf": grey(0.5)}, "b": {"type": "sphere"}},
        "one": {"type": "instance", "to_world": T().scale(0.3), "group": {"type": "ref", "id": "group"}},
        "curves": {"type": "shapegroup", "a": curve},
        "two": {"type": "instance", "to_world": T().scale(0.5), "group": {"type": "ref", "id": "curves"}},
        "curve": curve,
        "grid": {"type": "sdfgrid", "grid": mi.TensorXf(np.arange(-3, 5).reshape(2, 2, 2, 1))},
    }
    if emitter == "timed_sunsky":
        others["sky"] = {"type": emitter, "sun_scale": 0.0, "sky_scale": 0.01}
    elif emitter == "own_area":
        mi.register_emitter("own_area", own_area_class())
        place = T().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(0.6)  # where that class has it
        others["own"] = {
            "type": "rectangle",
            "to_world": place,
            "bsdf": grey(0),
            "emitter": {"type": emitter},
        }
    lamps = {name: lamp | {"emitter": area, "bsdf": grey(0.3)} for name, lamp in lamps.items()}
    check_sums(gap(**lamps, **others))


def test_a_textured_cube_that_was_met_as_an_emitters_shape():
    lamp = {"type": "cube", "emitter": {"type": "area", "radiance": peaked(2)}}
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    eye = T().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "to_world": eye, "film": film}
    scene = mi.load_dict({"type": "scene", "lamp": lamp, "sensor": sensor})
    assert scene.emitters()[0].get_shape() is not None
    assert np.isfinite(np.array(mi.load_dict({"type": "bdpt", "max_depth": 2}).render(scene, spp=4))).all()


def test_a_sky_seen_from_the_origin_beside_a_lamp_that_shines_inwards():
    """Such a lamp is sampled by its area from within, which must not be asked of others: the sky
    was black."""
    lamp = {"type": "sphere", "center": [0, 0, -5], "flip_normals": True}
    lamp["emitter"] = {"type": "area", "radiance": 1.0}
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    floor = {"type": "rectangle", "to_world": T().translate([0, -3, 0]).rotate([1, 0, 0], -90)}
    eye = T().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 30, "to_world": eye, "film": film}
    scene = {"type": "scene", "lamp": lamp, "sky": {"type": "constant", "radiance": 1.0}, "floor": floor}
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 4, "skip": "none"})
    image = np.array(integrator.render(mi.load_dict(scene | {"sensor": sensor}), spp=256))
    assert integrator.statistics["non_finite"] == 0
    assert image[..., :3].mean() == pytest.approx(1, rel=0.05)
