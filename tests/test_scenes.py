"""The scenes: they load, their parameters act, and their lamps, walls and meshes are right."""

import importlib.util
from pathlib import Path

import mitsuba_bdpt  # noqa: F401  (chooses the LLVM; must come before mitsuba)

import mitsuba as mi  # isort: skip
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
SCENES = sorted((ROOT / "scenes").glob("*.xml"))
NAMES = [path.stem for path in SCENES]
WIDE = {"veach_mis"}  # 16:9: the height is a parameter of its own

# Unit normals of the area lights, from the lowest to the highest.
SPOT = (0.0707, -0.4294, 0.9003)
LAMPS = {
    "cornell_box": [(0, -1, 0)],
    "glass_caustics": [(0, -1, 0)],
    "uplight_room": [(0, 1, 0)],
    "ajar_door": [(0, -1, 0)],
    "many_lights": [(0, -1, 0)] * 64,
    "veach_bidir": [SPOT, (0, 1, 0)],
}
CLOSED_ROOMS = ["uplight_room", "lamp_behind_glass", "ajar_door"]


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def load(name, **parameters):
    parameters = {"integrator": "path", **parameters}
    return mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), **parameters)


def lamps(scene):
    """The shapes that carry an area light, from the lowest to the highest."""
    shapes = [shape for shape in scene.shapes() if shape.is_emitter()]
    return sorted(shapes, key=lambda shape: float(shape.bbox().center()[1]))


def meshes_module():
    path = ROOT / "scripts" / "make_meshes.py"
    spec = importlib.util.spec_from_file_location("make_meshes", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NAMES)
def test_file_is_short_and_explained(name):
    """At most 150 lines, after a comment on the strategy that wins and the numbers' source."""
    text = (ROOT / "scenes" / f"{name}.xml").read_text()
    comment, rest = text.split("-->", 1)
    assert text.count("\n") <= 150
    assert comment.startswith("<!--")
    assert "Which strategy wins:" in comment
    assert "Numbers:" in comment
    assert '<default name="integrator" value="bdpt"/>' in rest
    assert '<default name="rfilter" value="box"/>' in rest


@pytest.mark.parametrize("name", NAMES)
def test_parameters_take_effect(name):
    """What is given at load time is what the scene then has."""
    given = {"spp": 9, "resolution": 24, "max_depth": 3}
    given |= {"sampler": "multijitter", "rfilter": "tent"}
    if name in WIDE:
        given["resolution_y"] = 16
    scene = load(name, **given)
    sensor = scene.sensors()[0]
    assert list(sensor.film().size()) == [24, given.get("resolution_y", 24)]
    assert sensor.sampler().sample_count() == 9
    assert "Multijitter" in str(sensor.sampler())
    assert "Tent" in str(sensor.film().rfilter())
    assert "max_depth = 3" in str(scene.integrator())


@pytest.mark.parametrize("name", NAMES)
def test_defaults(name):
    """64 spp, width 256, box filter of one pixel, independent numbers unless told otherwise."""
    sensor = load(name).sensors()[0]
    assert list(sensor.film().size()) == [256, 144 if name in WIDE else 256]
    assert sensor.sampler().sample_count() == 64
    assert "Box" in str(sensor.film().rfilter())


@pytest.mark.parametrize("name", sorted(LAMPS))
def test_lamps_face_the_right_way(name):
    """A ray that ends on a lamp's middle finds light from the front and none from behind.

    The rays start 1 mm from the lamp, closer than any of its surroundings (lamps in shades and
    tubes included; only a shape between the two would fail the test, and should).
    """
    scene = load(name)
    middle = np.array([np.array(lamp.bbox().center()).ravel() for lamp in lamps(scene)])
    normal = np.array(LAMPS[name], dtype=float)
    assert middle.shape == normal.shape
    for side in (1.0, -1.0):
        origin = mi.Point3f((middle + 1e-3 * side * normal).T.astype(np.float32))
        ray = mi.Ray3f(origin, mi.Vector3f((-side * normal).T.astype(np.float32)))
        si = scene.ray_intersect(ray)
        np.testing.assert_allclose(np.array(si.t), 1e-3, rtol=0.05)
        seen = np.array(si.emitter(scene).eval(si))
        assert (seen > 0).all() if side > 0 else (seen == 0).all()


@pytest.mark.parametrize("name", CLOSED_ROOMS)
def test_closed_rooms_are_closed(name):
    """Of 1e5 rays from the camera in all directions none leaves the room: expected 0, exactly."""
    scene = load(name)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(3, 100_000))
    direction /= np.linalg.norm(direction, axis=0)
    origin = scene.sensors()[0].world_transform() @ mi.Point3f(0.0)
    si = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(direction.astype(np.float32))))
    assert np.array(si.is_valid()).all()


def test_cornell_box_is_the_one_of_mitsuba():
    """The file's image equals that of mi.cornell_box() for the same seed.

    Statistic: mean |difference| over the mean; 2e-3 leaves room for the few paths that another
    rounding of a transform sends elsewhere (identical paths agree to 1e-6; unrelated noise at
    16 spp gives 0.1 or more).
    """
    ours = load("cornell_box", resolution=32, rfilter="gaussian", max_depth=8)
    description = mi.cornell_box()
    description["sensor"]["film"].update(width=32, height=32)
    theirs = mi.load_dict(description)
    images = [np.array(mi.render(scene, spp=16, seed=1)) for scene in (ours, theirs)]
    assert np.abs(images[0] - images[1]).mean() < 2e-3 * images[1].mean()


def test_lamp_behind_glass_is_black_under_path():
    """Every light path starts at a point inside glass, so `path` finds exactly nothing."""
    image = np.array(mi.render(load("lamp_behind_glass", resolution=32), spp=16))
    assert (image == 0).all()


def test_veach_mis_lamps_have_equal_power():
    """radiance * radius^2 is the same for the three spheres (numbers of six digits)."""
    power = []
    for lamp in lamps(load("veach_mis")):
        radius = 0.5 * float(lamp.bbox().extents()[0])
        power.append(radius**2 * float(mi.traverse(lamp.emitter())["radiance.value"][0][0]))
    assert len(power) == 3
    assert power == pytest.approx([power[0]] * 3, rel=1e-4)


def test_veach_bidir_lamp_lies_in_its_head():
    """From the lamp's corners, horizontally outward, the metal cone is hit before anything else."""
    scene = load("veach_bidir")
    for x, z in ((-2.757, 2.314), (-2.206, 2.314), (-2.757, 2.865), (-2.206, 2.865)):
        outward = np.array([x + 2.4815, 0.0, z - 2.5895])
        outward /= np.linalg.norm(outward)
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 6.001, z), mi.Vector3f(outward)))
        assert float(si.t[0]) < 0.1
        assert "RoughConductor" in str(si.bsdf()[0])


def test_meshes_are_remade_byte_for_byte(tmp_path):
    """scripts/make_meshes.py gives the committed files and no others."""
    meshes_module().make_all(tmp_path)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    committed = {path.name: path.read_bytes() for path in (ROOT / "scenes" / "meshes").iterdir()}
    assert made == committed


@pytest.mark.parametrize("name", ["veach_bidir_egg", "cut_glass"])
def test_glass_meshes_are_closed_and_face_outward(name):
    """Every edge has two faces that pass it in opposite directions; the signed volume is > 0."""
    vertices, _, faces = meshes_module().MESHES[name]()
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = {tuple(edge) for edge in edges.tolist()}
    assert len(forward) == len(edges)
    assert forward == {(b, a) for a, b in forward}
    assert signed_volume(vertices, faces) > 0.0


def test_egg_has_the_measured_shape():
    """Volume against the solid of revolution through the measured radii (frustums between them).

    Tolerance 1.5 %: 64 sides instead of a circle take 0.16 % away, and the smooth curve bulges
    beyond the straight frustums by up to 1 %. Radii: 4 mm, but 14 mm at the flat foot.
    """
    module = meshes_module()
    vertices, normals, faces = module.egg()
    height, radius = np.vstack([(module.EGG_BOTTOM, 0.0), module.EGG, (module.EGG_TOP, 0.0)]).T
    square = (radius[1:] ** 2 + radius[1:] * radius[:-1] + radius[:-1] ** 2) / 3.0  # mean of r^2
    frustums = np.pi * np.sum(np.diff(height) * square)
    assert signed_volume(vertices, faces) == pytest.approx(frustums, rel=0.015)

    y, r, _, _ = module.egg_profile(rows=400)
    error = np.abs(np.interp(module.EGG[:, 0], y[::-1], r[::-1]) - module.EGG[:, 1])
    assert error[1:].max() < 0.004
    assert error[0] < 0.014
    assert vertices[:, 1].min() > 1.9  # above the table's top

    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fci->fc", face_normals, normals[faces]) > 0.0).all()


def signed_volume(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0
