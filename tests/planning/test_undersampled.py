"""Light that a render of few samples hardly ever finds, through lobes that are nearly specular."""

import re

import mitsuba as mi
import numpy as np
import pytest
import variants
from mitsuba_bdpt.merging import undersampled, unsampled
from mitsuba_bdpt.planning import unsampled_light
from mitsuba_bdpt.planning.budget import PROVISIONAL_SAMPLES
from mitsuba_bdpt.run.rendering import Render
from mitsuba_bdpt.transport.photons import aim

import scenes

T = mi.ScalarTransform4f

POINT = {"type": "point", "position": [0.3, 0.2, 2], "intensity": 10.0}

# Mean of the image of the slab, whatever its roughness: 0.27 to 0.31 in renders of 2^20 samples.
MEAN = 0.3

GLASS = {"type": "dielectric", "int_ior": 1.5}
FLOOR = {"type": "rectangle", "to_world": T().scale(1.5)}
PLATE = {"type": "cube", "to_world": T().translate([0, 0, 1]).scale([1.5, 1.5, 0.05])}

POLISHED = {"type": "roughconductor", "alpha": 0.01}
BALL = {"type": "sphere", "center": [0, 0, -9], "radius": 0.5, "bsdf": POLISHED}  # out of view


def camera(origin=(0, -0.5, 3.2), size=32, **keys):
    return scenes.camera(origin=origin, target=(0, 0, 0), fov=50, size=size) | keys


def slab(bsdf, lamp=POINT, size=32, optimize=False, **more):
    scene = {"type": "scene", "eye": camera(size=size), "floor": FLOOR, "slab": PLATE | {"bsdf": bsdf}}
    return mi.load_dict(scene | {"lamp": lamp} | more, optimize=optimize)


def frosted(alpha):
    return {"type": "roughdielectric", "alpha": alpha, "int_ior": 1.5, "ext_ior": 1.0}


def principled(roughness, **keys):
    white = {"type": "rgb", "value": 1.0}
    return {"type": "principled", "roughness": roughness, "spec_trans": 1.0, "base_color": white, **keys}


def sphere(radius):
    """As bright as the point light, from afar."""
    emitter = scenes.area(10 / (np.pi * radius**2))
    return {"type": "sphere", "center": POINT["position"], "radius": radius, "emitter": emitter}


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": 10, "merging": False, **parameters})


def render_of(scene, spp=64, **parameters):
    return Render(scene, scene.sensors()[0], bdpt(**parameters).settings, 0, spp)


def lost_in(scene, spp=64, **parameters):
    return render_of(scene, spp, **parameters)._unsampled()


def share_of(lost):
    return sum(lost.radiance.values()) if lost else 0.0


def share_in(scene, spp=64, **parameters):
    return share_of(lost_in(scene, spp, **parameters))


def said(scene, mean=MEAN, spp=64, **parameters):
    """The warning about an image of this ``mean``."""
    render = render_of(scene, spp, **parameters)
    lost = render._unsampled()
    if lost is None:
        return ""
    missing = unsampled_light.missing(render.prepared, render.plan, lost, lost.shares(mean), spp)
    return f"{missing.cause}; {missing.remedy}" if missing.share >= unsampled_light.WARN_SHARE else ""


@pytest.mark.parametrize(
    "bsdf, warned",
    [
        *((frosted(alpha), True) for alpha in (0.001, 0.003, 0.01, 0.03, 0.1, 0.13)),
        *((frosted(alpha), False) for alpha in (0.2, 0.3)),
        *((principled(roughness), True) for roughness in (0.0, 0.1, 0.2, 0.35)),
        *((principled(roughness), False) for roughness in (0.5, 0.7)),
    ],
    ids=lambda value: str(value.get("alpha", value.get("roughness"))) if isinstance(value, dict) else "",
)
def test_a_word_about_a_rough_slab(bsdf, warned):
    """Expected: a warning where less than a tenth of a sample per pixel is expected of more than 1 % of the
    light: up to alpha .13 (5 %) and roughness .35 (2.5 %); at alpha .2 it is 0.7 %, at roughness .4 0.9 %."""
    text = said(slab(bsdf))
    assert bool(text) == warned
    assert not warned or re.search("'lamp'.*'slab'.*64 samples.*merging=true", text), text


@pytest.mark.parametrize(
    "bsdf, more, never", [(frosted(1e-3), {}, 0), (GLASS, {}, 1), (GLASS, {"ball": BALL}, 1)]
)
def test_nearly_smooth_glass_lacks_what_smooth_glass_lacks(bsdf, more, never):
    """`dielectric` is the limit of alpha to 0; delta lobes beside near-specular ones have an estimate of
    their own. Expected: the same light within 10 % (noise of 2^13 subpaths: 3 %), of which no sample is
    expected of delta lobes alone."""
    lost = lost_in(slab(bsdf, **more))
    assert share_of(lost) == pytest.approx(share_in(slab(GLASS)), rel=0.1)
    assert lost.never == pytest.approx(never, abs=0.01)


@pytest.mark.parametrize("alpha", [0.03, 0.1])
def test_the_expected_number_of_samples_is_that_of_a_render(alpha, monkeypatch):
    """An independent count: the share of pixels lit by more than a tenth of the mean gives the number of
    samples. Half of the light expects fewer than that, and half more than an eighth (a third to a fifth:
    pixels are also lit by paths with two diffuse vertices)."""
    scene = slab(frosted(alpha), size=64)
    image = np.array(bdpt().render(scene, spp=16))[..., 0]
    lit = -np.log(np.mean(image < 0.1 * MEAN))
    monkeypatch.setattr(unsampled_light, "PREVIEW", 16)
    found = []
    for bound in (1.0, lit, lit / 8):
        monkeypatch.setattr(undersampled, "FEWEST", bound)
        render = render_of(scene, 16)
        found.append(share_of(unsampled_light.estimate(render.prepared, render.plan, render.settings, 16)))
    whole, more, less = found
    assert less < whole / 2 < more


def test_light_that_next_event_estimation_finds_is_not_missing():
    """A lamp beneath the slab. Expected: at most what the slab reflects (3 % of the image; its mean of 0.66
    if the connection of floor and lamp did not count)."""
    assert share_in(slab(frosted(0.005), lamp=POINT | {"position": [0.3, 0.2, 0.6]})) < 0.05


def test_light_that_light_tracing_finds_is_not_missing():
    """A camera beneath the slab. Expected: nothing is missing, without light subpaths all."""
    scene = slab(frosted(0.005), eye=camera((0, -0.3, 0.8), fov=80))
    assert share_in(scene) < 0.005
    assert share_in(scene, light_paths=0) == pytest.approx(0.35, rel=0.1)
    assert "leave light_paths" in said(scene, light_paths=0)


def test_the_aim_of_photons_changes_nothing(monkeypatch):
    """Photons are aimed at the slab, 40 times as densely as the far lamp emits towards it. Expected: the same
    part of the light expects fewer than .04 samples per pixel where none is aimed, with four times the
    photons (within 0.2, for noise), in discs that hold several photons."""
    far = POINT | {"position": [3, 2, 12]}
    monkeypatch.setattr(unsampled, "RADIUS", 10.0)

    def part(subpaths):
        monkeypatch.setattr(unsampled_light, "SUBPATHS", subpaths)
        render, sizes = render_of(slab(frosted(0.03), lamp=far)), []
        for bound in (0.04, 1.0):
            monkeypatch.setattr(undersampled, "FEWEST", bound)
            sizes.append(share_of(unsampled_light.estimate(render.prepared, render.plan, render.settings)))
        return sizes[0] / sizes[1]

    aimed = part(1 << 12)
    monkeypatch.setattr(aim, "_specular_boxes", lambda *_: [])
    assert 0.3 < aimed < 0.7 and part(1 << 14) == pytest.approx(aimed, abs=0.2)


def test_in_fog_it_is_missing_too():
    """Expected: what is missing with `dielectric`, within 10 %, dimmed to a half by fog that absorbs."""
    medium = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.0}
    to_world = T().translate([0, 0, 0.5]).scale([1.4, 1.4, 0.4])
    fog = {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium}
    scene = slab(frosted(0.005), fog=fog)
    lost = share_in(scene)
    assert lost == pytest.approx(share_in(slab(GLASS, fog=fog)), rel=0.1)
    assert 0.3 < lost / share_in(slab(frosted(0.005))) < 0.7
    assert "set merging=true, or" in said(scene)


@pytest.mark.parametrize("variant", ["mono", "spectral"])
def test_in_other_variants(variant):
    """Rationale: spectral variants merge an eighth of the photons; few in a disc make samples look more
    frequent. Expected: as in RGB, within 20 % where that decides (wider discs)."""
    expected = share_in(slab(frosted(0.03)))
    mi.set_variant(variants.of(variant))
    assert share_in(slab(frosted(0.03))) == pytest.approx(expected, rel=0.2)


def test_names_of_objects():
    """Expected: not the ball out of view; by the BSDF without id, also two plates that Mitsuba has merged."""
    satin, one = frosted(0.01) | {"id": "satin"}, {"type": "ref", "id": "satin"}
    other = {"type": "cube", "to_world": T().translate([0, 0, -9]), "bsdf": one}
    for scene, name in (
        (slab(frosted(0.01), ball=BALL), "shape 'slab'"),
        (slab(satin, slab=PLATE | {"id": "", "bsdf": satin}), "shape without id with BSDF 'satin'"),
        (slab(one, optimize=True, satin=frosted(0.01), other=other), "shape without id with BSDF 'satin'"),
    ):
        assert lost_in(scene).objects == (name,)


def test_a_path_is_merged_once():
    """Expected: next to nothing counts (1e-13; 0.17 if paths that are near-specular everywhere did)."""
    scene = slab(frosted(0.001), floor=FLOOR | {"bsdf": {"type": "roughconductor", "alpha": 0.001}})
    assert share_in(scene) < 0.05


def test_more_samples_find_it():
    """A preview counts as a render of 64 samples."""
    found = [share_in(slab(frosted(0.05)), spp) for spp in (1, 64, 256, 1 << 14)]
    assert found[0] == pytest.approx(found[1]) and found[1] > 2 * found[2] > 0
    assert found[3] < 0.01 * found[1]


@pytest.mark.parametrize(
    "metal, warned",
    [
        ({"type": "roughconductor", "alpha": 0.001}, True),
        ({"type": "principled", "metallic": 1.0, "roughness": 0.03}, True),
        ({"type": "roughconductor", "alpha": 0.2}, False),
    ],
    ids=["polished", "principled", "dull"],
)
def test_light_off_a_metal_ceiling(metal, warned):
    """A ceiling that a spot lights and a camera sees from below (the mean is without the spot's
    reflection)."""
    up = T().look_at([0, 0, 1.2], [0.2, 0, 2], [0, 1, 0])
    ceiling = {"type": "rectangle", "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(3)}
    lamp = {"type": "spot", "cutoff_angle": 35, "intensity": 10.0, "to_world": up}
    scene = {"type": "scene", "eye": camera(to_world=up), "lamp": lamp, "floor": scenes.square(size=3)}
    text = said(mi.load_dict(scene | {"ceiling": ceiling | {"bsdf": metal}}, optimize=False), mean=0.2)
    assert bool(text) == warned and (not warned or "off shape 'ceiling'" in text)


@pytest.mark.parametrize(
    "bsdf, lamp",
    [
        ({"type": "null"}, POINT),
        (frosted(0.4), POINT),
        (principled(0.7), POINT),
        ({"type": "thindielectric"}, POINT),
        (frosted(0.01), sphere(0.5)),
        (frosted(0.01), {"type": "constant"}),
    ],
    ids=["null", "rough", "principled", "thin", "large lamp", "sky"],
)
def test_no_near_specular_estimate_of_other_scenes(bsdf, lamp):
    """Rationale: the estimate takes longer than a small preview."""
    render = render_of(slab(bsdf, lamp=lamp))
    assert not unsampled_light.is_undersampling_possible(render.prepared, render.plan, render.settings)


def test_small_lamps_are_hit_too_rarely():
    """Expected: of a sphere of radius .01 is missing what is of the point light (within 15 %: other random
    numbers); of one of .1 nothing in a render of 1,024 samples, of which two hit it in each pixel."""
    small, large = (slab(frosted(0.01), lamp=sphere(radius)) for radius in (0.01, 0.1))
    point = slab(frosted(0.01))
    assert share_in(small) == pytest.approx(share_in(point), rel=0.15)
    assert "make the emitter larger" in said(small)
    assert share_in(large, 1024) < 0.05 * share_in(point, 1024)


def test_small_lamps_behind_smooth_glass():
    """Expected: a sphere of radius .002 lacks what the point light does (within 15 %: other random numbers),
    one of .3 nothing, and none where photons guide s = 0."""
    small, large = (slab(GLASS, lamp=sphere(radius)) for radius in (0.002, 0.3))
    point = share_in(slab(GLASS))
    assert share_in(small) == pytest.approx(point, rel=0.15)
    assert share_in(large) == share_in(small, guiding="always") == 0


@pytest.mark.parametrize("size, bsdf", [(0.03, GLASS), (0.003, GLASS), (0.02, frosted(0.005))])
def test_a_lens_is_hit_too_rarely(size, bsdf):
    """Rationale: next to no light subpath hits a small lens. Expected: what is missing to a pinhole (within
    10 %: other random numbers), nothing in a render of very many samples."""
    lens = camera(type="thinlens", aperture_radius=size, focus_distance=3.2)
    scene, pinhole = slab(bsdf, eye=lens), slab(bsdf)
    assert share_in(scene) == pytest.approx(share_in(pinhole), rel=0.1)
    assert lost_in(scene, 1 << 40) is None


def test_a_timeout_bounds_the_samples(monkeypatch):
    """Expected: samples of the passes so far, at their rate until the timeout, at most those of the render;
    before the first pass as many as a pilot assumes, also under ``target_error``."""
    scene, assumed = slab(frosted(0.05)), PROVISIONAL_SAMPLES // 32**2
    timed, untimed = (render_of(scene, 10**6, **keys) for keys in ({"timeout": 30.0}, {}))
    assert timed._samples() == render_of(scene, 10**6, target_error=0.1)._samples() == assumed
    assert untimed._samples() == 10**6
    monkeypatch.setattr(type(timed.accumulator), "passes", (8,))
    monkeypatch.setattr(timed.meter, "rate", lambda done: done / 4)
    assert timed._samples() == 64 and untimed._samples() == 10**6
    assert render_of(scene, 16, timeout=30.0)._samples() == 16
