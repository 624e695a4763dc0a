"""The scenes: they load, their parameters act, and their lamps, walls and meshes are right."""

from pathlib import Path
from xml.etree import ElementTree

import make_meshes
import make_textures
import make_volumes
import mitsuba_bdpt  # noqa: F401  (chooses the LLVM; must come before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np
import pytest
import variants
from mitsuba_bdpt.scene.prepared import PreparedScene

ROOT = Path(__file__).resolve().parents[2]
SCENES = sorted((ROOT / "scenes").glob("*.xml"))
NAMES = [path.stem for path in SCENES]
WIDE = {"veach_mis"}  # 16:9: the height is a parameter of its own

# Unit normals of the area lights, from the lowest to the highest.
SPOT = (0.0707, -0.4294, 0.9003)
LAMPS = {
    "cornell_box": [(0, -1, 0)],
    "glass_caustics": [(0, -1, 0)],
    "rough_glass_caustics": [(0, -1, 0)],
    "frosted_glass_caustics": [(0, -1, 0)],
    "uplight_room": [(0, 1, 0)],
    "ajar_door": [(0, -1, 0)],
    "furnished_door": [(0, -1, 0)],
    "many_lights": [(0, -1, 0)] * 64,
    "veach_bidir": [SPOT, (0, 1, 0)],
    "pool": [(0.401, -0.469, -0.787)],
    "ring_caustic": [(0.802, -0.422, 0.422)],
    "polished_metal": [(-0.770, -0.492, 0.406)],
    "smallvcm_cornell_lamp": [(0, 0, -1)],
    "fog_caustic": [(-0.567, -0.815, 0.142)],
    "cloudy_ball": [(0.514, -0.771, 0.386)],
    "skin_ball": [(0.573, -0.625, -0.521)],
    "glass_slab": [(0.213, -0.355, 0.923)],
}
CLOSED_ROOMS = [
    "uplight_room",
    "lamp_behind_glass",
    "projector_through_glass",
    "ajar_door",
    "pool",
    "furnace_point",
    "furnace_emission",
    "fog_caustic",
    "fog_lamp_in_glass",
    "fog_lamp",
    "lamp_in_glass_seen",
    "furnished_lamps",
    "furnished_door",
    "frosted_bulb",
]
# Extinction, per unit of length, of the medium around the sensor and of those in bodies seen from outside.
FOGS = {
    "fog_beam": 0.15,
    "fog_beam_thick": 0.6,
    "fog_caustic": 0.12,
    "fog_lamp_in_glass": 0.12,
    "fog_lamp": 0.3,
}
BODIES = {"cloudy_ball": 2.0, "skin_ball": 20.0, "glass_slab": 10.0}


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(variants.of("rgb"))


def load(name, **parameters):
    parameters = {"integrator": "path", **parameters}
    return mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), **parameters)


def lamps(scene):
    """The shapes that carry an area light, from the lowest to the highest."""
    shapes = [shape for shape in scene.shapes() if shape.is_emitter()]
    return sorted(shapes, key=lambda shape: float(shape.bbox().center()[1]))


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


@pytest.mark.parametrize(
    "name", ["lamp_behind_glass", "projector_through_glass", "lamp_in_glass_seen", "pool_floor"]
)
def test_delta_lamps_behind_glass_are_black_under_path(name):
    """Every light path starts at a point and goes through glass, so `path` finds exactly nothing."""
    image = np.array(mi.render(load(name, resolution=32), spp=16))
    assert (image == 0).all()


@pytest.mark.parametrize("name, share", [("pool_floor", 0.942), ("lamp_in_glass_seen", 0.0585)])
def test_what_only_merging_finds(name, share):
    """The share of the light that a render without `merging` has not: means of sixteen renders as here.

    Tolerance: 0.01 and 0.003; the shares of single renders have standard deviations of 0.003 and 0.0005, but
    for one with a bright sample near a corner.
    """
    scene = load(name, integrator="bdpt", resolution=32)
    ours = {"type": "bdpt", "max_depth": scene.integrator().max_depth}
    ways = [mi.load_dict(ours | {"merging": merging}) for merging in (False, True)]
    mean = [np.mean(mi.render(scene, integrator=way, spp=64, seed=1)) for way in ways]
    assert 1.0 - mean[0] / mean[1] == pytest.approx(share, abs=0.01 if share > 0.5 else 0.003)


@pytest.mark.parametrize(
    "name", ["rough_glass_caustics", "frosted_glass_caustics", "pane", "frosted_bulb", "polished_metal"]
)
def test_near_specular_scenes_have_no_deltas(name):
    """Expected: some BSDF has a glossy lobe, and no BSDF a delta lobe, so that every path can be connected in
    principle."""
    flags = [int(shape.bsdf().flags()) for shape in load(name).shapes()]
    assert any(mi.has_flag(value, mi.BSDFFlags.Glossy) for value in flags)
    assert not any(mi.has_flag(value, mi.BSDFFlags.Delta) for value in flags)


def test_rough_glass_caustics_is_glass_caustics_but_for_two_materials():
    """Expected: without ``alpha`` and the BSDFs of the balls both files have the same elements."""

    def rest(name):
        root = ElementTree.parse(ROOT / "scenes" / f"{name}.xml").getroot()
        kept = [e for e in root if e.get("id") not in ("glass", "mirror") and e.get("name") != "alpha"]
        return [ElementTree.canonicalize(ElementTree.tostring(e), strip_text=True) for e in kept]

    assert rest("rough_glass_caustics") == rest("glass_caustics")


def test_projector_shines_through_its_ball_only():
    """Rays from the projector to the corners of its picture (field of view 15 degrees) meet glass first, so
    that nothing but glass passes its light on."""
    scene = load("projector_through_glass")
    reach = np.tan(np.deg2rad(7.5))
    corners = np.array([(x, y, -1.0) for x in (-reach, 0, reach) for y in (-reach, 0, reach)], np.float32)
    ray = mi.Ray3f(mi.Point3f(0, 1, 1.2), dr.normalize(mi.Vector3f(corners.T)))
    si = scene.ray_intersect(ray)
    assert np.array(si.is_valid()).all()
    assert all("Dielectric" in str(si.bsdf()[i]) for i in range(len(corners)))


def test_projector_shows_its_slide_upside_down():
    """The ball turns the picture: the slide's upper left (red), as the projector throws it, is on the lower
    right of the wall as seen from the projector, and so on.

    Statistic: at the middles of the quarters on the wall, the largest channel of t = 1 and all else, 64 spp.
    Expected: blue or green above, red or orange below (the channels differ by 2 and more).
    """
    scene = load("projector_through_glass", integrator="bdpt", max_depth=4, resolution=64)
    image = np.array(mi.render(scene, spp=64))
    sensor = scene.sensors()[0]
    above, below = [], []
    for y, found in ((1.25, above), (0.75, below)):
        for x in (-0.25, 0.25):
            ds, _ = sensor.sample_direction(_point(x, y, -2.5), mi.Point2f(0.5))
            column, row = (int(v) for v in (ds.uv.x[0], ds.uv.y[0]))
            found.append(image[row - 1 : row + 2, column - 1 : column + 2].mean((0, 1)))
    assert all(rgb[0] < 0.7 * rgb[1:].max() for rgb in above)
    assert all(rgb[0] > 1.3 * rgb[2] for rgb in below)


def _point(x, y, z):
    it = dr.zeros(mi.Interaction3f)
    it.p = mi.Point3f(x, y, z)
    return it


@pytest.mark.parametrize("name", ["furnace_point", "furnace_emission", "furnace_white"])
def test_furnaces_have_the_known_answer(name):
    """The mean over the image is 1, and the sum of 2^-m where paths end after 3 edges.

    Tolerance 0.3 %: the mean of 16x16 pixels of 64 samples has a standard deviation below 0.1 %.
    """
    expected = {-1: 1.0}
    expected |= {"furnace_point": {3: 0.75}, "furnace_emission": {3: 0.875}}.get(name, {})
    for max_depth, mean in expected.items():
        scene = load(name, integrator="bdpt", resolution=16, max_depth=max_depth)
        assert np.mean(mi.render(scene, spp=64)) == pytest.approx(mean, rel=3e-3)


def test_window_lets_the_sun_in():
    """From the bright patch on the floor a ray towards the sun leaves and meets it."""
    scene = load("window_room")
    row, column = np.add(make_textures.SUN_TEXEL, 1)  # the corner that its four texels share
    theta, phi = np.pi * row / make_textures.SKY_SIZE[0], 2.0 * np.pi * column / make_textures.SKY_SIZE[1]
    sun = np.array((np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)))
    pane = np.array((-2.0, 1.3, -0.3))  # a point in the window
    floor = pane - 0.999 * pane[1] / sun[1] * sun
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(*floor.tolist()), mi.Vector3f(*sun.tolist())))
    assert not si.is_valid()[0]
    seen = np.array(scene.environment().eval(si)).ravel()
    np.testing.assert_allclose(seen, make_textures.SUN, rtol=1e-2)


@pytest.mark.parametrize("name, lost", [("smallvcm_cornell_point", 0.029), ("smallvcm_cornell_sun", 0.215)])
def test_path_misses_caustics_of_lamps_without_area(name, lost):
    """The share of the light that `path` has not: 2.9 % and 21.5 %, measured with 2^21 samples.

    Tolerance: 1 percentage point for the point light, 2.5 for the sun; the means of 32x32 pixels, 64
    samples (both sides), have standard deviations of 0.2 % and 0.6 %.
    """
    mean = {
        kind: np.mean(mi.render(load(name, integrator=kind, resolution=32), spp=64))
        for kind in ("bdpt", "path")
    }
    assert 1.0 - mean["path"] / mean["bdpt"] == pytest.approx(lost, abs=0.01 if lost < 0.1 else 0.025)


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
    make_meshes.make_all(tmp_path)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    committed = {path.name: path.read_bytes() for path in (ROOT / "scenes" / "meshes").iterdir()}
    assert made == committed


def test_textures_are_remade_exactly(tmp_path):
    """scripts/make_textures.py gives the committed files' pixels and no other files.

    Pixels, not bytes: the compression belongs to the EXR library.
    """
    make_textures.make_all(tmp_path)
    made, committed = (
        {path.name: np.array(mi.Bitmap(str(path))) for path in folder.iterdir()}
        for folder in (tmp_path, ROOT / "scenes" / "textures")
    )
    assert made.keys() == committed.keys()
    for name, pixels in made.items():
        assert pixels.dtype == np.float16
        np.testing.assert_array_equal(pixels, committed[name])


def test_volumes_are_remade_byte_for_byte(tmp_path):
    """scripts/make_volumes.py gives the committed files and no others."""
    make_volumes.make_all(tmp_path)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    committed = {path.name: path.read_bytes() for path in (ROOT / "scenes" / "volumes").iterdir()}
    assert made == committed


@pytest.mark.parametrize("name", [*FOGS, *BODIES, "cloud_sky"])
def test_media_are_declared_on_both_sides(name):
    """Boundaries and the sensor agree on the media between them: nothing switches off light subpaths."""
    scene = load(name)
    prepared = PreparedScene(scene, scene.sensors()[0])
    assert prepared.light_media.contradiction == ""
    assert (scene.sensors()[0].get_medium() is not None) == (name in FOGS)


@pytest.mark.parametrize("name", [*FOGS, *BODIES])
def test_media_have_their_extinction(name):
    """In every channel, exactly as in the table above but for single precision."""
    scene = load(name)
    inner = [shape.interior_medium() for shape in scene.shapes() if shape.is_medium_transition()]
    medium = scene.sensors()[0].get_medium() if name in FOGS else next(m for m in inner if m is not None)
    sigma = np.array(medium.get_majorant(dr.zeros(mi.MediumInteraction3f))).ravel()
    np.testing.assert_allclose(sigma, {**FOGS, **BODIES}[name], rtol=1e-6)


@pytest.mark.parametrize("name", ["pool_water", "ring", "headlight_mirror"])
def test_normals_are_on_the_side_of_the_faces(name):
    """At every corner of every face, and as long as 1."""
    vertices, normals, faces = make_meshes.MESHES[name]()
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fci->fc", face_normals, normals[faces]) > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)


def test_pool_water_fills_the_pool():
    """It passes through the walls on all sides, and stays between bottom and edge."""
    vertices, normals, _ = make_meshes.pool_water()
    assert (vertices.min(axis=0) < (-2.0, 0.0, -1.6)).all()
    assert (vertices.max(axis=0) > (2.0, 0.0, 0.8)).all()
    assert np.abs(vertices[:, 1]).max() < 0.1
    assert normals[:, 1].min() > 0.95  # gentle waves: at most 18 degrees
    # The slope of the surface, from its own grid.
    y = vertices[:, 1].reshape(49, 81)
    x = vertices[:, 0].reshape(49, 81)
    slope = (y[:, 2:] - y[:, :-2]) / (x[:, 2:] - x[:, :-2])
    nx, ny = normals[:, 0].reshape(49, 81), normals[:, 1].reshape(49, 81)
    np.testing.assert_allclose(slope, (-nx / ny)[:, 1:-1], atol=5e-3)


def test_headlight_mirror_makes_rays_parallel():
    """What comes from the focus leaves along +y."""
    vertices, normals, _ = make_meshes.headlight_mirror()
    ray = vertices - (0.0, 1.0, 0.0)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    leaves = ray - 2.0 * np.einsum("vi,vi->v", ray, normals)[:, None] * normals
    np.testing.assert_allclose(leaves, np.broadcast_to((0.0, 1.0, 0.0), leaves.shape), atol=1e-12)


@pytest.mark.parametrize("name", ["veach_bidir_egg", "cut_glass"])
def test_glass_meshes_are_closed_and_face_outward(name):
    """Every edge has two faces that pass it in opposite directions; the signed volume is > 0."""
    vertices, _, faces = make_meshes.MESHES[name]()
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
    vertices, normals, faces = make_meshes.egg()
    profile = [(make_meshes.EGG_BOTTOM, 0.0), make_meshes.EGG, (make_meshes.EGG_TOP, 0.0)]
    height, radius = np.vstack(profile).T
    square = (radius[1:] ** 2 + radius[1:] * radius[:-1] + radius[:-1] ** 2) / 3.0  # mean of r^2
    frustums = np.pi * np.sum(np.diff(height) * square)
    assert signed_volume(vertices, faces) == pytest.approx(frustums, rel=0.015)

    y, r, _, _ = make_meshes.egg_profile(rows=400)
    error = np.abs(np.interp(make_meshes.EGG[:, 0], y[::-1], r[::-1]) - make_meshes.EGG[:, 1])
    assert error[1:].max() < 0.004
    assert error[0] < 0.014
    assert vertices[:, 1].min() > 1.9  # above the table's top

    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fci->fc", face_normals, normals[faces]) > 0.0).all()


def signed_volume(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0
