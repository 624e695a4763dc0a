"""Values of users' plugins, textures and meshes that are not finite, and reflectances above 1."""

import math
import warnings

import mitsuba as mi
import numpy as np
import pytest
import variants
from mitsuba_bdpt.emitters import infinite
from mitsuba_bdpt.scene import diagnostics
from scipy import stats
from warned import Warned

from scenes import UPWARDS, area, camera, load, renders, square
from scenes import matte as diffuse

from stress_cases.poisons import BSDFS, NAN, painted
from stress_cases.rooms import filled, room
from stress_cases.twins import EVERYTHING, compare_with_twin


@pytest.mark.parametrize("name", ["weight", "direction", "eval", "pdf"])
def test_what_is_not_finite_counts_as_zero(name):
    """Expected: what a user's BSDF returns that is NaN counts as 0, is counted and warned of once (`make
    stress` tries infinity, lamps, textures, meshes and pilots too)."""
    compare_with_twin(BSDFS[name], NAN, EVERYTHING)


BLACK = {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((4, 4, 3), dtype=np.float32)), "raw": True}
UNLIT = {
    "projector": {"type": "projector", "irradiance": BLACK},
    "textured plate": {"type": "rectangle", "lamp": {"type": "area", "radiance": BLACK}},
    "textured ball": {"type": "sphere", "radius": 0.2, "lamp": {"type": "area", "radiance": BLACK}},
    "spot": {"type": "spot", "texture": BLACK},
    "scaled": {"type": "projector", "irradiance": 1.0, "scale": 0.0},
    "point": {"type": "point", "intensity": 0.0},
    "sky": {"type": "envmap", "bitmap": BLACK["bitmap"]},
}


SUN = {"sun": {"type": "directional", "direction": [0, 0, -1]}}


@pytest.mark.parametrize(
    ("parameters", "lit"), [({"skip": "none"}, {}), ({"merging": True}, {}), ({"skip": "none"}, SUN)], ids=str
)
def test_lamps_without_light_are_left_out(parameters, lit):
    """A black picture has no density, and every sample of it was NaN, for which a warning blamed plugins.
    Nothing is NaN and nothing warned of, and the image is black unless there is another lamp."""
    eye = camera(origin=(0, 0, 4), target=(0, 0, 0), size=4)
    scene = load(sensor=eye, floor=square((0, 0, -1), size=9), **UNLIT, **lit)
    bdpt = mi.load_dict({"type": "bdpt", **parameters})
    with Warned() as texts:
        image = np.array(bdpt.render(scene, spp=16))
    assert bdpt.statistics["non_finite"] == bdpt.statistics["non_finite_in_pilot"] == 0
    assert image.any() == bool(lit)
    assert [text for text in texts if "NaN" in text] == []
    text = bdpt.explain(scene)
    assert all(f"emitter '{name}': it emits no light" in text for name in UNLIT)


@pytest.mark.parametrize("held", ["bare", "masked", "beside a two-sided one", "step by step"])
def test_a_blend_seen_from_behind_is_black(held):
    """Behind its surface Mitsuba's rough conductor (Beckmann) draws a direction that is NaN and takes it back
    by a weight of 0; `blendbsdf` multiplies this 0 by a density that is NaN. Nothing is counted, neither
    where light subpaths arrive from behind (a sky below the plate) nor where the camera is there. From the
    front the image is `path`'s; from behind what a mask lets pass, and half of what a two-sided matte of 0.5
    reflects. Statistic: t-tests of means over 8 seeds, 1e-4."""
    matte = {"type": "diffuse"}
    if held == "beside a two-sided one":
        matte = {"type": "twosided", "bsdf": matte}
    blend = {"type": "blendbsdf", "weight": 0.5, "metal": {"type": "roughconductor"}, "matte": matte}
    if held == "masked":
        blend = {"type": "mask", "opacity": 0.7, "inner": blend}

    def seen(height):
        eye = camera(origin=(0, height, 1), target=(0, 0, 0), up=(0, 0, 1), fov=50, size=8)
        plain = load(plate=square(turn=UPWARDS, bsdf=blend), sky={"type": "constant"}, sensor=eye)
        # As long as there is such an emitter kernels run step by step.
        other = mi.load_dict({"type": "timed_sunsky"}) if held == "step by step" else None
        bdpt = mi.load_dict({"type": "bdpt", "max_depth": 4, "skip": "none"})
        images = renders(plain, bdpt, 64, 8)
        del other
        assert bdpt.statistics["non_finite"] == 0
        return plain, images

    plain, images = seen(2)
    _, behind = seen(-2)
    others = renders(plain, mi.load_dict({"type": "path", "max_depth": 4}), 64, 8)
    assert stats.ttest_ind(images.mean((1, 2, 3)), others.mean((1, 2, 3)), equal_var=False).pvalue > 1e-4
    found = behind[:, 3:5, 3:5].mean((1, 2, 3))
    expected = {"bare": 0, "masked": 0.3, "beside a two-sided one": 0.25}.get(held, 0)
    assert np.all(found == 0) if expected == 0 else stats.ttest_1samp(found, expected).pvalue > 1e-4


def test_culprits_are_named():
    assert diagnostics.not_finite(filled(painted(NAN))) == ["plate.bsdf.reflectance.data"]
    assert diagnostics.not_finite(room()) == []


def test_a_transform_that_is_not_finite_is_named():
    """And NumPy says nothing of it."""
    lamp = {"type": "sphere", "radius": NAN, "emitter": {"type": "area"}}
    scene = mi.load_dict({"type": "scene", "ball": lamp, "sensor": {"type": "perspective"}})
    assert diagnostics.not_finite(scene) == ["ball.to_world"]
    nameless = '<shape type="sphere"><float name="radius" value="nan"/></shape>'
    nameless = mi.load_string(f'<scene version="3.0.0">{nameless}</scene>')
    assert diagnostics.not_finite(nameless) == ["to_world of an object without id (Sphere)"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mi.load_dict({"type": "bdpt"}).render(scene, spp=1)


@pytest.mark.parametrize(
    "bsdf, said",
    [
        ({"type": "diffuse", "reflectance": 1.5}, "has reflectance up to 1.5"),
        (
            {"type": "twosided", "a": {"type": "plastic", "diffuse_reflectance": 2.0}},
            "diffuse_reflectance up to 2",
        ),
        ({"type": "diffuse", "reflectance": 1.0}, ""),
        ({"type": "conductor", "eta": 3.0, "k": 5.0}, ""),
    ],
)
def test_what_reflects_more_than_it_receives_is_named(bsdf, said):
    """One warning; none where all is 1 or less, or where a parameter above 1 is no reflectance."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 3})
    with Warned() as warnings:
        image = np.array(integrator.render(room(bsdf), spp=4))
    assert np.isfinite(image).all()
    assert len(warnings) == bool(said)
    assert all(said in text for text in warnings)


def bitmap(value, kind=np.uint8, **keys):
    """A texture of one value; 8 bits are sRGB unless it is ``raw``."""
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 4, 3), value, kind)), **keys}


@pytest.mark.parametrize(
    "texture, said",
    [
        (bitmap(243), ""),
        (bitmap(255, raw=True), ""),
        (bitmap(65535, np.uint16), ""),
        (bitmap(200, format="variant"), ""),
        (bitmap(1.5, np.float32), "up to 1.5"),
        (bitmap(1.5, np.float16), "up to 1.5"),
        ({"type": "checkerboard", "color0": bitmap(243), "color1": bitmap(1.5, np.float32)}, "up to 1.5"),
    ],
)
def test_bytes_of_a_bitmap_are_shares_of_255(texture, said):
    """Mitsuba keeps the bytes of 8-bit images, divides them by 255 at each look-up and undoes sRGB: no such
    texture reflects more than all."""
    found = diagnostics.non_conserving_bsdfs([mi.load_dict({"type": "principled", "base_color": texture})])
    assert len(found) == bool(said) and all(said in text for text in found), found


def nameless(texture, **keys):
    """A BSDF without id, nor has its texture one."""
    return {"type": "diffuse", "id": "", "reflectance": {**texture, "id": ""}} | keys


LOUD = bitmap(1.5, np.float32)
TWOSIDED = {"type": "twosided", "id": "both", "a": nameless(LOUD)}
CHECKERED = {"type": "checkerboard", "id": "squares", "color0": LOUD}


@pytest.mark.parametrize(
    "shape, name",
    [
        ({"id": "box", "bsdf": nameless(LOUD, id="paint")}, "BSDF 'paint'"),
        ({"id": "box", "bsdf": TWOSIDED}, "BSDF 'both'"),
        ({"id": "box", "bsdf": nameless(LOUD)}, "the BSDF of shape 'box'"),
        ({"id": "box", "bsdf": nameless({}, reflectance=CHECKERED)}, "the BSDF with texture 'squares'"),
        ({"id": "", "bsdf": nameless(LOUD)}, "a BSDF without id (SmoothDiffuse of Sphere)"),
    ],
)
def test_the_nearest_object_with_an_id_is_named(shape, name):
    """Scene files give ids to few objects. One text (a two-sided BSDF holds the same one twice), which names
    the nearest object around the number that has an id."""
    (text,) = diagnostics.non_conserving_bsdfs([mi.load_dict({"type": "sphere", **shape})])
    assert text == f"{name} has reflectance up to 1.5"


def test_what_is_wrong_with_a_scene_is_said_once():
    """An animation or a viewer renders a scene hundreds of times. One warning for any number of renders and
    integrators, and one more where the scene was edited and another number is too large."""
    scene = room({"type": "diffuse", "reflectance": 1.5})
    with Warned() as said:
        for seed in range(3):
            mi.load_dict({"type": "bdpt", "max_depth": 2}).render(scene, seed=seed, spp=1)
    assert len(said) == 1 and "up to 1.5" in said[0]
    parameters = mi.traverse(scene)
    parameters["plate.bsdf.reflectance.value"] = 2.5
    parameters.update()
    with Warned() as again:
        for seed in range(2):
            mi.load_dict({"type": "bdpt", "max_depth": 2}).render(scene, seed=seed, spp=1)
    assert len(again) == 1 and "up to 2.5" in again[0]


@pytest.mark.parametrize("texel", [math.nan, math.inf, -1e4])
def test_a_map_without_a_mean_is_not_even(texel):
    """A comparison with NaN is false, so that such a map counted as uniform. Black all over is even."""
    texels = np.full((8, 16, 3), 0.5, np.float32)
    texels[2, 3] = texel
    for data, expected in ((texels, math.inf), (0 * texels[:2], 1.0)):
        made = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(data)})
        assert infinite.contrast(made) == expected


def beside_spots(*angles):
    """A scene with a spot of each cutoff angle."""
    lamps = {f"lamp {i}": {"type": "spot", "cutoff_angle": angle} for i, angle in enumerate(angles)}
    return load(sensor=camera(), ball={"type": "sphere"}, **lamps)


def beside_lamps(*places, kind="rectangle"):
    """A floor under lamps of side 1 at these places."""
    lamp = {"type": kind, "emitter": area(1.0)}
    lamps = {f"lamp {i}": square(at, ([1, 0, 0], 180), 0.5, diffuse(0)) | lamp for i, at in enumerate(places)}
    eye = camera(origin=(0, 0, 0.9), target=(0, 0, -1), fov=50, size=8)
    scene = {"type": "scene", "sensor": eye, "floor": square((0, 0, -1), size=2), **lamps}
    return mi.load_dict(scene, optimize=False)


def test_lamps_that_overlap_are_named():
    """Rays hit one of two lamps in one plane, next-event estimation samples each: the floor under two is
    nearly twice as bright, with a warning; of lamps as far apart as the manual says it is, without one, that
    under lamps farther apart. Tolerance: the noise of 2^12 samples, mostly of points on a lamp as large as
    its distance, and a thousandth of the distance."""
    integrator, mean, said = mi.load_dict({"type": "bdpt", "max_depth": 2, "hide_emitters": True}), {}, {}
    for gap in (0, 2e-5, 1e-3):  # of a scene of size 2
        with Warned() as warnings:
            scene = beside_lamps([0, 0, 1], [0, 0, 1 + gap])
            mean[gap] = np.array(integrator.render(scene, seed=1, spp=64)).mean()
        said[gap] = len(warnings)
    assert said == {0: 1, 2e-5: 0, 1e-3: 0}
    assert 1.8 < mean[0] / mean[1e-3] < 2.1 and mean[2e-5] / mean[1e-3] == pytest.approx(1, rel=0.02)


def on_a_floor(height=0.0, turn=0, scale=(0.5, 0.5, 0.25), kind="cube", **more):
    """A floor z = 0 under glass whose lowest point is at this height, if it is not turned about x."""
    place = mi.ScalarTransform4f().translate([0, 0, height + scale[2]]).rotate([1, 0, 0], turn)
    glass = {"type": kind, "to_world": place.scale(scale), "bsdf": {"type": "dielectric"}} | more
    lamp = {"type": "sphere", "center": [1, 0.5, 3], "radius": 0.15, "emitter": area(200.0)}
    eye = camera(origin=(-0.3, 0.3, 4), target=(0, 0, 0), fov=10, size=8)
    return load(sensor=eye, floor=square((0, 0, 0), size=3), glass=glass, lamp=lamp)


def test_glass_in_the_plane_of_a_floor_is_named():
    """Rays that leave the glass begin below the floor. Expected: a warning, and less than half of the light
    of glass 1e-4 of the scene's size higher, which has none."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 6, "guiding": "always"})
    mean, said = {}, {}
    for height in (0.0, 6e-4):
        with Warned() as warnings:
            mean[height] = np.array(integrator.render(on_a_floor(height), seed=1, spp=256)).mean()
        said[height] = len([text for text in warnings if "share a plane" in text])
    assert said == {0.0: 1, 6e-4: 0} and mean[0.0] < 0.5 * mean[6e-4]


@pytest.mark.parametrize(
    ("glass", "count"),
    [({}, 1), ({"height": -0.5}, 1), ({"kind": "rectangle", "scale": (1, 1, 0)}, 1), ({"height": -0.1}, 0)]
    + [({"turn": 45}, 0), ({"kind": "sphere"}, 0), ({"scale": (0.5, 0.01, 0.5)}, 0)]
    + [({"kind": "rectangle", "turn": 90, "height": -0.5, "scale": (0.5, 1, 1)}, 0)]
    + [({"bsdf": {"type": "diffuse"}}, 0)],
)
def test_which_glass_shares_a_plane(glass, count):
    """A block on the floor or below it, a pane on it; none that is sunk into it or stands on an edge, no
    sphere, no upright pane, no opaque block."""
    assert len(diagnostics.glass_in_planes(on_a_floor(**glass))) == count


def test_which_lamps_overlap():
    """Rectangles that share a part of a plane; not neighbours that share an edge, nor discs."""
    row = [0, 0, 1], [1, 0, 1], [2.5, 0, 1]
    assert diagnostics.overlapping_lamps(beside_lamps(*row)) == []
    assert diagnostics.overlapping_lamps(beside_lamps(*row, [2.1, 0.95, 1], kind="disk")) == []
    (text,) = diagnostics.overlapping_lamps(beside_lamps(*row, [2.1, 0.95, 1]))
    assert text == "lamps 'lamp 3' and 'lamp 2'"


@pytest.mark.parametrize(
    "angle, said",
    [
        (0.21, []),
        (0.19, ["0.19 (up to 1% of its light)"]),
        (0.1, ["0.1 (up to 4% of its light)"]),
        (0.01, ["0.01 (up to all of its light)"]),
        (0.0, ["0 (up to all of its light)"]),
        (-1.0, []),
        (math.inf, []),
        (math.nan, []),
    ],
)
def test_no_more_than_all_light_is_lost(angle, said):
    """A step of the cosine over 1 - cos has no limit as the angle goes to 0. All of the light where the
    quotient is 1 or more; no warning of NumPy (an error in these tests) at any angle."""
    found = diagnostics.narrow_spots(beside_spots(angle))
    assert found == [f"spot 'lamp 0' has cutoff_angle={text}" for text in said]


def test_coefficients_of_spectra_are_no_reflectances():
    """A spectral variant keeps three coefficients for each colour of a texture, above 1 for one of more than
    0.85; a number above 1 is still named."""
    mi.set_variant(variants.of("spectral"))
    bright = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.95, np.float32))}
    loud = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 1), 1.5, np.float32)), "raw": True}
    bsdfs = [mi.load_dict({"type": "diffuse", "reflectance": texture}) for texture in (bright, loud)]
    assert diagnostics.non_conserving_bsdfs(bsdfs[:1]) == []
    assert "reflectance up to 1.5" in diagnostics.non_conserving_bsdfs(bsdfs[1:])[0]
