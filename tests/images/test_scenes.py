"""The scenes: they load, their parameters act, and their lamps, walls and meshes are right."""

from pathlib import Path

import make_meshes
import make_textures
import make_volumes
import mitsuba as mi
import numpy as np
import pytest
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
GLAZED = ["pool_water", "bulb_in_fog_seen", "ice_in_milk", "smoke_globe"]
FOGS = ["fog_beam", "fog_beam_thick", "fog_caustic", "fog_lamp_in_glass", "fog_lamp"]


def load(name, **parameters):
    parameters = {"integrator": "path", **parameters}
    return mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), **parameters)


def lamps(scene):
    """The shapes that carry an area light, from the lowest to the highest."""
    shapes = [shape for shape in scene.shapes() if shape.is_emitter()]
    return sorted(shapes, key=lambda shape: float(shape.bbox().center()[1]))


@pytest.mark.parametrize("name", NAMES)
def test_parameters_take_effect(name):
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


@pytest.mark.parametrize("name", sorted(LAMPS))
def test_lamps_face_the_right_way(name):
    """A ray that ends on a lamp's middle finds light from the front and none from behind. The rays start 1 mm
    from the lamp, closer than any of its surroundings."""
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
    """Of 1e5 rays from the camera in all directions none leaves the room."""
    scene = load(name)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(3, 100_000))
    direction /= np.linalg.norm(direction, axis=0)
    origin = scene.sensors()[0].world_transform() @ mi.Point3f(0.0)
    si = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(direction.astype(np.float32))))
    assert np.array(si.is_valid()).all()


def test_cornell_box_is_the_one_of_mitsuba():
    """For the same seed. 2e-3 of the mean leaves room for the few paths that another rounding of a transform
    sends elsewhere (identical paths agree to 1e-6; unrelated noise gives 0.1 or more)."""
    ours = load("cornell_box", resolution=32, rfilter="gaussian", max_depth=8)
    description = mi.cornell_box()
    description["sensor"]["film"].update(width=32, height=32)
    theirs = mi.load_dict(description)
    images = [np.array(mi.render(scene, spp=16, seed=1)) for scene in (ours, theirs)]
    assert np.abs(images[0] - images[1]).mean() < 2e-3 * images[1].mean()


@pytest.mark.parametrize("name", ["furnace_point", "furnace_emission", "furnace_white"])
def test_furnaces_have_the_known_answer(name):
    """Also where paths end after 3 edges. Tolerance: 0.3 %; the mean has a standard deviation below 0.1 %."""
    expected = {-1: 1.0}
    expected |= {"furnace_point": {3: 0.75}, "furnace_emission": {3: 0.875}}.get(name, {})
    for max_depth, mean in expected.items():
        scene = load(name, integrator="bdpt", resolution=16, max_depth=max_depth)
        assert np.mean(mi.render(scene, spp=64)) == pytest.approx(mean, rel=3e-3)


@pytest.mark.parametrize("make, folder", [(make_meshes, "meshes"), (make_volumes, "volumes")])
def test_files_are_remade_byte_for_byte(make, folder, tmp_path):
    make.make_all(tmp_path)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    committed = {path.name: path.read_bytes() for path in (ROOT / "scenes" / folder).iterdir()}
    assert made == committed


def test_textures_are_remade_exactly(tmp_path):
    """Pixels, not bytes: the compression belongs to the EXR library."""
    make_textures.make_all(tmp_path)
    made, committed = (
        {path.name: np.array(mi.Bitmap(str(path))) for path in folder.iterdir()}
        for folder in (tmp_path, ROOT / "scenes" / "textures")
    )
    assert made.keys() == committed.keys()
    for name, pixels in made.items():
        assert pixels.dtype == np.float16
        np.testing.assert_array_equal(pixels, committed[name])


@pytest.mark.parametrize("name", [*FOGS, *GLAZED, "cloudy_ball", "skin_ball", "glass_slab", "cloud_sky"])
def test_media_are_declared_on_both_sides(name):
    """Boundaries and the sensor agree on the media between them: nothing switches off light subpaths."""
    scene = load(name)
    prepared = PreparedScene(scene, scene.sensors()[0])
    assert prepared.light_media.contradiction == ""
    assert (scene.sensors()[0].get_medium() is not None) == (name in FOGS)
