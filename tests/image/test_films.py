"""Films: spectral bands, crop windows, borders, filters, pixel formats and alpha.

Known answers come from a lamp in a unit sphere: a point light of intensity pi at the centre of a sphere
of reflectance r gives the radiance r + r^2 + ... everywhere, and most of it can be made by splats.
"""

import mitsuba as mi
import numpy as np
import pytest
from welch import assert_agree, compare_images, compare_known, tiles

from scenes import renders

T = mi.ScalarTransform4f

SPECTRAL = "llvm_ad_spectral"

# Nodes 50 nm apart, as far as Mitsuba's film samples its responses; integrals 50 and 100.
BANDS = {"visible": [(450, 0), (500, 1), (550, 0)], "infrared": [(800, 0), (850, 2), (900, 0)]}
INTEGRALS = np.array([50.0, 100.0])

# A reflectance that is constant within each band.
STEP = [(400, 0.25), (600, 0.25), (750, 0.75), (950, 0.75)]
REFLECTANCES = np.array([0.25, 0.75])

CROP = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 8, "crop_height": 12}


def spectrum(values):
    return {"type": "spectrum", "value": values}


def spectral_film(bands=None, **keys):
    bands = {name: spectrum(values) for name, values in (bands or BANDS).items()}
    keys["rfilter"] = {"type": keys.get("rfilter", "box")}
    return {"type": "specfilm", "width": 16, "height": 16, "component_format": "float32"} | bands | keys


def rgb_film(**keys):
    keys["rfilter"] = {"type": keys.get("rfilter", "box")}
    return {"type": "hdrfilm", "width": 16, "height": 16, "component_format": "float32"} | keys


def camera(film, **keys):
    to_world = T().look_at([0, 0, 0.5], [0.2, 0.1, -1], [0, 1, 0])
    return {"type": "perspective", "fov": 60, "near_clip": 1e-3, "to_world": to_world, "film": film} | keys


def lamp_in_a_sphere(film, reflectance=None):
    """See above; the sphere has the spectrum `STEP` unless another is given."""
    inner = {"type": "diffuse", "reflectance": reflectance or spectrum(STEP)}
    lamp = {"type": "point", "intensity": {"type": "uniform", "value": float(np.pi)}}
    wall = {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": inner}}
    return mi.load_dict({"type": "scene", "sensor": camera(film), "wall": wall, "lamp": lamp})


def known(depth):
    """The bands of the sphere's radiance on paths of up to ``depth`` edges."""
    return INTEGRALS * sum(REFLECTANCES**m for m in range(1, depth))


def integrator(kind="bdpt", **parameters):
    return mi.load_dict({"type": kind, **parameters})


def layer_names(scene):
    return [channel.name for channel in scene.sensors()[0].film().bitmap().struct_()]


@pytest.mark.parametrize(
    ("parameters", "film"),
    [
        ({}, {}),
        ({"skip": "none"}, {"rfilter": "gaussian", **CROP}),
        ({"skip": "none"}, {"rfilter": "mitchell", "sample_border": True}),
        ({"light_paths": 0}, {"rfilter": "lanczos", "sample_border": True, **CROP}),
    ],
    ids=["default", "gaussian crop", "mitchell border", "camera side, lanczos crop border"],
)
def test_bands_are_known(parameters, film):
    """The responses' integrals times r + r^2 + r^3, in every tile and along the border. Student's t over 12
    seeds with Sidak's correction."""
    mi.set_variant(SPECTRAL)
    scene = lamp_in_a_sphere(spectral_film(**film))
    images = renders(scene, integrator(max_depth=4, **parameters), 64, 12)
    assert layer_names(scene) == ["visible", "infrared"] and images.shape[-1] == 2
    images /= known(4)
    border = np.concatenate(
        [x.mean(1) for x in (images[:, 0], images[:, -1], images[:, :, 0], images[:, :, -1])], axis=1
    )
    for samples, bound in ((tiles(images), 0.003), (border, 0.003), (images.mean((1, 2)), 0.0006)):
        assert (samples.std(0, ddof=1) / np.sqrt(12)).max() < bound
        assert_agree(compare_known(samples, np.ones(samples.shape[1])), at_least=0)


COLOURFUL = {
    "blue": [(400, 0), (450, 1), (500, 0.2), (550, 0)],
    "green": [(450, 0), (500, 0.4), (550, 1), (600, 0.4), (650, 0)],
    "red": [(550, 0), (600, 0.5), (650, 3), (700, 0)],
}


@pytest.mark.parametrize(
    "film", [{}, {"rfilter": "gaussian", "sample_border": True, **CROP}], ids=["box", "gaussian crop border"]
)
def test_overlapping_bands_equal_path(film):
    """Bands may overlap and differ in scale. Welch over tiles; the image's mean is compared to some 1 %."""
    mi.set_variant(SPECTRAL)
    lamp = {"type": "area", "radiance": spectrum([(400, 3), (550, 8), (700, 2)])}
    floor = T().translate([0, -0.7, -2]).rotate([1, 0, 0], -90).scale(2)
    matte = {"type": "diffuse", "reflectance": spectrum([(400, 0.8), (700, 0.1)])}
    metal = {"type": "roughconductor", "alpha": 0.4}
    parts = {
        "sensor": camera(spectral_film(COLOURFUL, **film)),
        "sky": {"type": "constant", "radiance": spectrum([(400, 0.1), (700, 0.4)])},
        "lamp": {"type": "sphere", "radius": 0.2, "center": [0.7, 0.5, -0.6], "emitter": lamp},
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": matte},
        "ball": {"type": "sphere", "radius": 0.4, "center": [0.1, -0.2, -1.5], "bsdf": metal},
    }
    scene = mi.load_dict({"type": "scene"} | parts)
    a = renders(scene, integrator(max_depth=4), 64, 12)
    b = renders(scene, integrator("path", max_depth=4), 256, 12, 50)
    assert layer_names(scene) == list(COLOURFUL)
    scale = b.mean((0, 1, 2))
    assert_agree(compare_images(tiles(a / scale), tiles(b / scale)), at_least=15)
    for band in range(3):
        x, y = a[..., band].mean((1, 2)), b[..., band].mean((1, 2))
        assert np.hypot(x.std(ddof=1), y.std(ddof=1)) / np.sqrt(12) < 0.012 * y.mean()


def test_unit_of_a_response_does_not_matter():
    """Responses x 1000 give 1000 times the image (1e-3: the threshold is rounded to powers of two) with the
    same rays; roulette ends as many connections as on an RGB film, within a factor of two."""
    mi.set_variant(SPECTRAL)
    loud = {name: [(x, 1000 * y) for x, y in values] for name, values in BANDS.items()}
    flat = {"type": "uniform", "value": 0.5}
    images, ended = [], []
    for film in (spectral_film(), spectral_film(loud), rgb_film()):
        bdpt = integrator(max_depth=6, spp_per_pass=2)  # roulette begins with the second pass
        images += list(renders(lamp_in_a_sphere(film, flat), bdpt, 16, 1, 1))
        counts = bdpt.statistics["connections"]
        ended.append(counts["rouletted"] / (counts["evaluated"] + bdpt.statistics["rays"]["shadow_t1"]))
    np.testing.assert_allclose(images[1], 1000 * images[0], rtol=1e-3)
    assert ended[1] == pytest.approx(ended[0], rel=1e-3)
    assert ended[2] > 0 and ended[0] == pytest.approx(ended[2], rel=1)


def test_variance_of_bands():
    """The mean of the layers is the spread over 12 seeds. Tolerance: 20 %: 12 seeds give each pixel's
    variance to 43 %, 256 correlated pixels the mean to 4 %; the error pairs the variance of one half of the
    replicates with the mean of the other."""
    mi.set_variant(SPECTRAL)
    scene = lamp_in_a_sphere(spectral_film(rfilter="gaussian"))
    bdpt = integrator(max_depth=3, layers="variance")
    result = renders(scene, bdpt, 16, 12)
    assert layer_names(scene) == ["visible", "infrared", "variance.visible", "variance.infrared"]
    images, estimates = result[..., :2], result[..., 2:]
    expected = images.var(0, ddof=1).mean((0, 1))
    np.testing.assert_allclose(estimates.mean((0, 1, 2)), expected, rtol=0.2)
    last, variance = images[-1] / INTEGRALS, estimates[-1] / INTEGRALS**2
    error = (variance / (last**2 + 0.01 * last.mean() ** 2)).mean()
    assert bdpt.statistics["error"] == pytest.approx(error, rel=0.2)


def test_one_band_without_noise():
    """One band's wavelengths are drawn in proportion to its response: exactly its integral (1e-4: a hundred
    additions)."""
    mi.set_variant(SPECTRAL)
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 0.7}}
    film = spectral_film({"only": BANDS["infrared"]}, rfilter="gaussian")
    scene = mi.load_dict({"type": "scene", "sensor": camera(film), "sky": sky})
    image = renders(scene, integrator(max_depth=1, light_paths=0), 4, 1)[0]
    assert image.shape == (16, 16, 1)
    np.testing.assert_allclose(image, 70, rtol=1e-4)


def test_strategy_images_of_bands_are_refused():
    """They are RGB in every variant, and the RGB of a film that samples its bands only would be wrong."""
    mi.set_variant(SPECTRAL)
    scene = lamp_in_a_sphere(spectral_film())
    bdpt = integrator(max_depth=3, layers="strategies")
    for call in (bdpt.render, bdpt.explain):
        with pytest.raises(NotImplementedError, match="layers=strategies.*SpecFilm.*use hdrfilm"):
            call(scene)


class OtherFilm(mi.Film):
    """A film that wants samples of its own."""

    def __init__(self, props):
        super().__init__(props)
        self.m_flags = int(mi.FilmFlags.Special)


def test_other_special_films_are_refused():
    mi.register_film("other", OtherFilm)
    eye = camera({"type": "other", "width": 4, "height": 4})
    scene = mi.load_dict({"type": "scene", "sensor": eye, "l": {"type": "point"}})
    with pytest.raises(NotImplementedError, match="film .* is not supported; use hdrfilm or specfilm"):
        integrator().render(scene, spp=1)


def lamps_and_sky(film, sky):
    """A lamp before the camera, a wall, glass without colour; past all of them, the sky if there is one."""
    matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [2.0, 3.0, 5.0]}}
    wall, pane = T().translate([0.3, -0.2, 0]).scale([1.2, 1, 1]), T().translate([-1, -0.6, 0.5]).scale(0.5)
    scene = {
        "type": "scene",
        "sensor": camera(film, to_world=T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]), fov=45),
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": matte},
        "lamp": {"type": "sphere", "radius": 0.25, "center": [-0.4, 0.3, 0.8], "emitter": lamp},
        "pane": {"type": "rectangle", "to_world": pane, "bsdf": {"type": "thindielectric"}},
    }
    if sky:
        scene["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.3, 0.1]}}
    return mi.load_dict(scene)


FORMATS = [
    ("rgba", "tent", True, True, False),
    ("rgba", "catmullrom", True, True, True),
    ("rgb", "lanczos", True, False, True),
    ("luminance_alpha", "gaussian", True, True, False),
    ("luminance", "mitchell", False, False, False),
    ("xyza", "box", False, True, True),
    ("xyz", "gaussian", True, True, False),
]


@pytest.mark.parametrize(("pixel_format", "rfilter", "border", "hide", "sky"), FORMATS)
def test_cropped_formats_equal_path(pixel_format, rfilter, border, hide, sky):
    """Each channel, alpha included, in tiles of an 8x12 crop, which splats reach from outside. Welch with
    Sidak; the mean of each channel is compared to 2 %."""
    keys = {"pixel_format": pixel_format, "rfilter": rfilter, "sample_border": border, **CROP}
    scene = lamps_and_sky(rgb_film(**keys), sky)
    a = renders(scene, integrator(max_depth=3, hide_emitters=hide, skip="none"), 64, 24)
    b = renders(scene, integrator("path", max_depth=3, hide_emitters=hide), 256, 24, 50)
    alpha = pixel_format.endswith("a")
    assert a.shape == b.shape == (24, 12, 8, (1 if "lum" in pixel_format else 3) + alpha)
    scale = b.mean((0, 1, 2))
    assert_agree(compare_images(tiles(a / scale, 2), tiles(b / scale, 2)), at_least=20)
    error = np.hypot(*(np.std(x.mean((1, 2)), axis=0, ddof=1) for x in (a, b))) / np.sqrt(24)
    assert (error < 0.02 * scale).all()
    if alpha and not (sky and not hide):
        assert b[..., -1].mean(0).min() < 0.5 < b[..., -1].mean(0).max()


@pytest.mark.parametrize("hide", [False, True])
def test_depth_zero_is_black_and_clear(hide):
    scene = lamps_and_sky(rgb_film(pixel_format="rgba"), True)
    for kind in ("bdpt", "path"):
        image = renders(scene, integrator(kind, max_depth=0, hide_emitters=hide), 4, 1)
        assert (image == 0).all()
