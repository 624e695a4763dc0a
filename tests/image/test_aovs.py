"""Feature layers: the parameter `aovs`, against Mitsuba's integrator `aov`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.image.features import FeatureLayers
from mitsuba_bdpt.sampling.points import Points, Purpose
from welch import assert_agree, compare_images

T = mi.ScalarTransform4f

ALL = (
    "albedo:albedo,dd.y:depth, pos:position uv:uv,ng:geo_normal,nn:sh_normal,"
    "du:dp_du,dv:dp_dv,dx:duv_dx,dy:duv_dy,prim:prim_index,shape:shape_index"
)
ALL_NAMES = [
    *("albedo.R", "albedo.G", "albedo.B", "dd.y.T", "pos.X", "pos.Y", "pos.Z", "uv.U", "uv.V"),
    *(f"{name}.{axis}" for name in ("ng", "nn", "du", "dv") for axis in "XYZ"),
    *("dx.U", "dx.V", "dy.U", "dy.V", "prim.I", "shape.I"),
]


class Fixed(mi.Sampler):
    """Every number is the same: the samples of a pixel see the same point, in every integrator."""

    def __init__(self, props=None):
        super().__init__(mi.Properties() if props is None else props)

    def clone(self):
        return Fixed()

    fork = clone

    def next_1d(self, active=True):
        return dr.full(mi.Float, 0.3, self.wavefront_size())

    def next_2d(self, active=True):
        return mi.Point2f(self.next_1d(), 0.8)


def fixed(draw):
    """`Points._draw`, of which camera rays get the numbers of `Fixed`."""
    of_rays = Purpose.FILM, Purpose.APERTURE, Purpose.TIME, Purpose.WAVELENGTH

    def drawn(points, side, stream, purpose, vertex, dims):
        if purpose not in of_rays:
            return draw(points, side, stream, purpose, vertex, dims)
        return mi.Float(0.3) if dims == 1 else mi.Point2f(0.3, 0.8)

    return drawn


def bitmap():
    y, x = np.mgrid[0:16, 0:16] / 16
    return mi.Bitmap(np.stack([x, y, 0.5 + 0 * x], axis=-1).astype(np.float32))


def film(kind="hdrfilm", **keys):
    keys = {"width": 12, "height": 10, "component_format": "float32"} | keys
    return {"type": kind} | keys | {"rfilter": {"type": keys.get("rfilter", "box")}}


def sensor(film, **keys):
    to_world = T().look_at([1, 1.5, 4], [0, 0.4, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 40, "to_world": to_world, "film": film} | keys


def textured(raw=True):
    return {"type": "bitmap", "bitmap": bitmap(), "raw": raw}


def scene(sensor):
    """Textured, bumpy and glowing things before nothing."""
    plastic = {"type": "plastic", "diffuse_reflectance": 0.3}
    bumpy = {"type": "bumpmap", "texture": textured(), "scale": 2.0, "bsdf": plastic}
    mapped = {"type": "normalmap", "normalmap": textured(), "flip_invalid_normals": False}
    mapped["bsdf"] = {"type": "conductor"}
    painted = {"type": "diffuse", "reflectance": textured(mi.is_rgb)}
    box = T().translate([0.8, 0.3, 0.3]).rotate([0, 1, 0], 30).scale(0.3)
    lamp = {"type": "area", "radiance": 5.0}
    parts = {
        "sensor": sensor,
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2), "bsdf": painted},
        "ball": {"type": "sphere", "center": [-0.5, 0.6, 0], "radius": 0.6, "bsdf": bumpy},
        "box": {"type": "cube", "to_world": box, "bsdf": mapped},
        "lamp": {"type": "sphere", "center": [0.2, 1.2, 1], "radius": 0.2, "emitter": lamp},
    }
    return mi.load_dict({"type": "scene"} | parts)


def layers(method, target, spp, seed=0):
    """The layers of ``method``, without the image's colours."""
    image = np.array(method.render(target, spp=spp, seed=seed), dtype=np.float64)
    return image[..., image.shape[-1] - len(method.aov_names()) :]


def aov(aovs=ALL):
    return mi.load_dict({"type": "aov", "aovs": aovs})


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": 3, "aovs": ALL} | parameters)


@pytest.mark.parametrize(
    ("film_keys", "sensor_keys", "parameters"),
    [
        ({}, {}, {}),
        ({"rfilter": "gaussian", "pixel_format": "rgba"}, {}, {"hide_emitters": True}),
        (
            {"rfilter": "mitchell", "sample_border": True},
            {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0},
            {"skip": "none"},
        ),
        (
            {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 6, "crop_height": 7, "rfilter": "tent"},
            {"principal_point_offset_x": 0.1},
            {"spp_per_pass": 2},
        ),
        ({"rfilter": "lanczos"}, {}, {"layers": "variance,strategies"}),
        ({"pixel_format": "luminance_alpha"}, {}, {"max_depth": 0}),
    ],
    ids=["plain", "hidden emitters", "thin lens, border", "crop, passes", "all layers", "depth 0"],
)
def test_features_are_those_of_aov(film_keys, sensor_keys, parameters, monkeypatch):
    """All kinds equal `aov`'s in every pixel for any film, sensor and parameter, but where its uv derivatives
    are NaN; they follow the image and come before other layers. Tolerance: 1e-4 of a layer's largest value
    (rays are set up in another order)."""
    mi.register_sampler("fixed", Fixed)
    monkeypatch.setattr(Points, "_draw", fixed(Points._draw))
    target = scene(sensor(film(**film_keys), sampler={"type": "fixed"}, **sensor_keys))
    integrator = bdpt(**parameters)
    spp = 16 if "layers" in parameters else 4
    names, result = integrator.aov_names(), layers(integrator, target, spp)
    assert names[: len(ALL_NAMES)] == ALL_NAMES
    held = layer_names(target)
    assert held[target.sensors()[0].film().base_channels_count() :] == names
    expected = layers(aov(), target, spp)
    result, defined = result[..., : len(ALL_NAMES)], np.isfinite(expected)
    assert defined.mean() > 0.9 and np.isfinite(result).all()
    scale = np.abs(np.where(defined, expected, 0)).max((0, 1))
    assert (scale > 0).all()
    difference = np.where(defined, np.abs(result - expected), 0).max((0, 1)) / scale
    assert difference.max() < 1e-4, dict(zip(ALL_NAMES, difference, strict=True))
    assert integrator.statistics["rays"]["features"] == spp * region(target)


def layer_names(target):
    return [channel.name for channel in target.sensors()[0].film().bitmap().struct_()]


def region(target):
    """How many pixels camera samples cover."""
    film = target.sensors()[0].film()
    border = 2 * film.rfilter().border_size() if film.sample_border() else 0
    return int(np.prod([int(n) + border for n in film.crop_size()]))


def test_uv_derivatives_of_misses_are_zero():
    """Sums lose NaN or keep it by chance, so samples are looked at: one sees nothing, the other the floor."""
    target = scene(sensor(film()))
    features = FeatureLayers(target, target.sensors()[0], "dx:duv_dx,dy:duv_dy", 4)
    position, lens = mi.Point2f([0.5, 11.5], [0.5, 9.5]), mi.Point2f(0.5)
    values, finite = features.sample(None, None, position, lens, 0.0, True)
    miss, hit = np.array(mi.ArrayXf(values)).T
    assert (miss == 0).all() and (hit != 0).all()
    assert np.all(finite)  # a miss is no error


@pytest.mark.parametrize("kind", ["bumpmap", "normalmap"])
def test_denoisers_are_told_normals_of_the_world(kind):
    """Mitsuba's `aov` has normals of bump maps in the shading frame. A map without effect, on a wall."""
    flat = {"type": "normalmap", "normalmap": {"type": "rgb", "value": [0.5, 0.5, 1]}}
    maps = {"bumpmap": {"type": "bumpmap", "texture": textured(), "scale": 0.0}, "normalmap": flat}
    wall = {"type": "rectangle", "to_world": T().rotate([0, 1, 0], 40).scale(9)}
    wall["bsdf"] = maps[kind] | {"bsdf": {"type": "diffuse"}}
    target = mi.load_dict({"type": "scene", "sensor": sensor(film()), "wall": wall})
    features = FeatureLayers(target, target.sensors()[0], "nn:sh_normal", 4, guides=True)
    values, _ = features.sample(None, None, mi.Point2f(6, 5), mi.Point2f(0.5), 0.0, True)
    turned = [np.sin(np.deg2rad(40)), 0, np.cos(np.deg2rad(40))]
    found = np.array(mi.ArrayXf(values)).ravel()
    assert found[-3:] == pytest.approx(turned, abs=1e-5)
    assert found[:3] == pytest.approx([0, 0, 1] if kind == "bumpmap" else turned, abs=1e-5)


def test_the_image_is_the_same_with_features():
    target = scene(sensor(film(rfilter="gaussian")))
    plain = np.array(bdpt(aovs="", skip="none").render(target, spp=8, seed=3))
    result = np.array(bdpt(skip="none").render(target, spp=8, seed=3))
    assert plain.shape[-1] == 3
    np.testing.assert_allclose(result[..., :3], plain, rtol=1e-4, atol=1e-5)


def test_an_interrupted_render_keeps_features():

    def interrupt(report):
        if report.spp_done >= 2:
            raise KeyboardInterrupt

    to_world = T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    wall = {"type": "rectangle", "to_world": T().translate([0, 0, 1]).scale(9)}
    eye = sensor(film(rfilter="gaussian"), to_world=to_world)
    lamp = {"type": "point", "position": [0, 0, 5]}
    target = mi.load_dict({"type": "scene", "sensor": eye, "wall": wall, "lamp": lamp})
    integrator = bdpt(aovs="pos:position", spp_per_pass=1, skip="none")
    integrator.on_pass = interrupt
    with pytest.raises(KeyboardInterrupt):
        integrator.render(target, spp=5)
    position = np.array(target.sensors()[0].film().develop())[..., 3:]
    np.testing.assert_allclose(position[..., 2], 1, rtol=1e-5)
    assert position[..., :2].min() < -0.5 and position[..., :2].max() > 0.5


def test_spectral_albedo():
    """A spectral film's wavelengths follow its bands, which says nothing about RGB. Welch over tiles."""
    mi.set_variant("llvm_ad_spectral")
    bands = {"near": {"type": "spectrum", "value": [(600, 0.0), (700, 1.0), (800, 0.0)]}}
    aovs = "albedo:albedo,dd:depth"

    def renders(target, integrator, seeds, spp):
        result = np.stack([np.array(integrator.render(target, spp=spp, seed=s)) for s in seeds])
        n, h, w, channels = result.shape
        return result.reshape(n, h // 5, 5, w // 6, 6, channels).mean((2, 4)).reshape(n, -1, channels)

    rgb, near = scene(sensor(film())), scene(sensor(film("specfilm", **bands)))
    integrator = bdpt(aovs=aovs, max_depth=2)
    b = renders(rgb, aov(aovs), range(50, 62), 256)
    for target, first in ((rgb, 3), (near, 1)):
        a = renders(target, integrator, range(12), 256)[..., first : first + 4]
        assert layer_names(target)[first:] == ["albedo.R", "albedo.G", "albedo.B", "dd.T"]
        assert_agree(compare_images(a.reshape(12, -1), b.reshape(12, -1)), at_least=8)


@pytest.mark.parametrize(
    ("aovs", "message"),
    [
        ("depth", "'depth' is not a pair name:kind; write for example"),
        (":depth", "':depth' is not a pair"),
        ("dd:", "'dd:' is not a pair"),
        ("a:b:depth", "'b:depth' is not a kind of feature"),
        ("nn:world_normal", "'world_normal' is not a kind of feature"),
        ("dd:dept", "'dept' is not a kind of feature; did you mean depth.*shape_index"),
        ("a:uv,a:duv_dx", "two layers a.U; give the feature another name"),
        ("variance:albedo", "two layers variance.R"),
        ("weighted.s0t2:albedo", "two layers weighted.s0t2.R"),
        ("groups:albedo", "groups.R has the name of a light group or path layer; give the feature another"),
        ("groups.x:albedo", "groups.x.R has the name of a light group or path layer"),
        ("a:uv,path:depth", "path.T has the name of a light group or path layer"),
    ],
)
def test_bad_features_are_named(aovs, message):
    """Mitsuba puts what a constructor raises into a RuntimeError."""
    with pytest.raises((ValueError, RuntimeError), match=f"(?s)UsageError.*bdpt: aovs='{aovs}'.*{message}"):
        bdpt(aovs=aovs, layers="variance,strategies")


@pytest.mark.parametrize("aovs", ["", " , "])
def test_no_features(aovs):
    integrator = bdpt(aovs=aovs)
    assert integrator.aov_names() == []
    integrator.render(scene(sensor(film())), spp=1)
    assert "features" not in integrator.statistics["rays"]


def test_features_in_a_scene_file():
    """Scenes are loaded on several threads."""
    text = """
        <scene version="3.0.0">
            <integrator type="bdpt"><string name="aovs" value="dd:depth, nn:sh_normal"/></integrator>
            <sensor type="perspective"/>
            <shape type="sphere"><emitter type="area"/></shape>
        </scene>"""
    names = mi.load_string(text, parallel=True).integrator().aov_names()
    assert names == ["dd.T", "nn.X", "nn.Y", "nn.Z"]


def test_features_leave_the_sampler_alone():
    target = scene(sensor(film(), sampler={"type": "stratified", "sample_count": 9}))
    sampler = target.sensors()[0].sampler()
    sampler.seed(3, 64)
    expected = np.array(sampler.next_2d())
    sampler.seed(3, 64)
    bdpt().render(target, spp=4)
    assert sampler.sample_count() == 9
    np.testing.assert_array_equal(np.array(sampler.next_2d()), expected)


def test_another_sample_count_does_not_recompile():
    """The spread of ray differentials, which follows the samples per pixel, is no literal."""
    target, integrator = scene(sensor(film())), bdpt(spp_per_pass=1)
    integrator.render(target, spp=4)
    dr.sync_thread()
    integrator.render(target, spp=9)
    assert integrator.statistics["kernels"]["compiled"] == 0
