"""Light that no strategy finds: how much it is, and when a word is said about it."""

import re

import internals
import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
from mitsuba_bdpt.planning import unsampled_light
from mitsuba_bdpt.run import messages, rendering
from mitsuba_bdpt.run.rendering import Render
from warned import Warned

import scenes

T = mi.ScalarTransform4f


FROM_ABOVE = T().look_at([0, 4, 3], [0, 0, 0], [0, 1, 0])


def camera(kind="perspective"):
    if kind == "perspective":
        return scenes.camera(origin=(0, 4, 3), target=(0, 0, 0), fov=40, size=32)
    return {"type": kind, "film": scenes.camera(size=32)["film"], "to_world": FROM_ABOVE.scale(1.5)}


def floor(red=0.6):
    return scenes.floor(size=5, bsdf=scenes.matte(red, 0.8 * red, 0.5 * red))


def sheet(bsdf, height=1.0):
    """Between the floor and all else."""
    return scenes.floor(height, 6, bsdf)


def lamp_with_area(position, radius):
    """As bright as the point light, from afar."""
    emitter = scenes.area(10 / (np.pi * radius**2))
    return {"type": "sphere", "center": position, "radius": radius, "emitter": emitter}


DOWN = T().look_at([0.5, 3, 0], [0, 0, 0.3], [0, 0, 1])
LAMPS = {
    "point": {"type": "point", "position": [0.5, 3, 0], "intensity": 10.0},
    "spot": {"type": "spot", "cutoff_angle": 30, "intensity": 10.0, "to_world": DOWN},
    "directional": {"type": "directional", "direction": [0.2, -1, 0.1], "irradiance": 3.0},
    "projector": {"type": "projector", "fov": 40, "irradiance": scenes.rgb(2.0, 2.0, 2.0), "to_world": DOWN},
}

GLASS = {"type": "dielectric"}
BLOCK = {"type": "cube", "to_world": T().translate([0, 0.51, 0]).scale([1, 0.5, 1]), "bsdf": GLASS}
BALL = {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.5, "bsdf": GLASS}
BEAM = scenes.square(
    (0, 3, 0.2), scenes.DOWNWARDS, 0.5, emitter={"type": "directionalarea", "id": "", "radiance": 5.0}
)
CUT_OUT = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse", "reflectance": 0.0}}


def scene_of(lamp, eye=None, **shapes):
    return mi.load_dict({"type": "scene", "eye": eye or camera(), "lamp": lamp} | {"floor": floor()} | shapes)


def bdpt(max_depth=16, **parameters):
    return internals.bdpt(**{"max_depth": max_depth, "merging": False, **parameters})


def mean(scene, integrator, spp, seed=0):
    """Of the brightest colour, red."""
    return float(np.array(integrator.render(scene, spp=spp, seed=seed))[..., 0].mean())


def lost_in(scene, spp=16, **parameters):
    """Light that a render lacks, by emitter index."""
    render = Render(scene, scene.sensors()[0], bdpt(**parameters).settings, 0, spp)
    return unsampled_light.estimate(render.prepared, render.plan, render.settings, spp).radiance


def estimate(scene, monkeypatch):
    """By four times 2^17 subpaths, where a render takes 2^13."""
    monkeypatch.setattr(unsampled_light, "SUBPATHS", 1 << 17)
    total = 0
    for seed in range(4):
        monkeypatch.setattr(unsampled_light, "SEED", seed)
        total += sum(lost_in(scene).values())
    return total / 4


def share_of(integrator):
    return sum(integrator.statistics["unsampled_light"].values())


@pytest.mark.parametrize("bsdf, passes", [({"type": "null"}, 1), (CUT_OUT, 0.25)])
@pytest.mark.parametrize("eye", ["perspective", "orthographic"])
@pytest.mark.parametrize("lamp", sorted(LAMPS))
def test_behind_a_sheet_of_nothing_the_direct_light_is_lost(lamp, eye, bsdf, passes, monkeypatch):
    """A sheet without any effect is a delta surface: what `path` sees without it is lost, a quarter behind
    one that holds back half on each way. Tolerance: 10 % (of the sun some hundred subpaths arrive in the
    image: noise of 3 %)."""
    through = scene_of(LAMPS[lamp], camera(eye), sheet=sheet(bsdf))
    plain = scene_of(LAMPS[lamp], camera(eye))
    expected = passes * mean(plain, mi.load_dict({"type": "path", "max_depth": 2}), 64)
    assert estimate(through, monkeypatch) == pytest.approx(expected, rel=0.1)
    assert estimate(plain, monkeypatch) == 0


def test_a_sensor_of_one_ray_finds_photons():
    """Its pixel has no size. Expected: the direct light at that point, within half (about twenty photons)."""
    eye = {"type": "radiancemeter", "film": scenes.camera(size=1)["film"], "to_world": FROM_ABOVE}
    scene = scene_of(LAMPS["spot"], eye, sheet=sheet({"type": "null"}))
    expected = mean(scene_of(LAMPS["spot"], eye), mi.load_dict({"type": "path", "max_depth": 2}), 64)
    assert sum(lost_in(scene).values()) == pytest.approx(expected, rel=0.5)


@pytest.mark.parametrize(
    "camera_height, sheet_height, flipped", [(2.4, 2.7, False), (4, 3.5, False), (4, 1, True)]
)
def test_light_that_is_found_or_absorbed_is_not_lost(camera_height, sheet_height, flipped, monkeypatch):
    """Next-event estimation connects to a lamp on the floor's side of the glass, t = 1 to a camera there; the
    back of a one-sided surface is black."""
    eye = camera() | {"to_world": T().look_at([0, camera_height, 2], [0, 0, 0], [0, 1, 0])}
    above = sheet({"type": "null"}, sheet_height)
    scene = scene_of(LAMPS["point"], eye, sheet=above, floor=floor() | {"flip_normals": flipped})
    assert estimate(scene, monkeypatch) == 0


WATER = sheet({"type": "dielectric", "int_ior": 1.33})


@pytest.mark.parametrize("glass", [BLOCK, WATER])
def test_what_a_lamp_with_area_adds_is_what_is_lost(glass, monkeypatch):
    """`path` finds a sphere as bright as the point light (s = 0), also under water. Expected: the image of
    the point light and what is lost add up to that within 10 % on a dark floor (noise of 3 %; light that
    leaves the floor twice within the glass is not estimated: 2 %)."""
    eye, at = camera() | {"fov": 20}, [2, 3, 0]  # without the lamp's image in the glass
    dark = {"floor": floor(0.1), "glass": glass}
    path = mi.load_dict({"type": "path", "max_depth": 16})
    whole = mean(scene_of(lamp_with_area(at, 0.4), eye, **dark), path, 1024)
    scene = scene_of(LAMPS["point"] | {"position": at}, eye, **dark)
    found = mean(scene, bdpt(), 64)
    assert found < whole / 3
    assert found + estimate(scene, monkeypatch) == pytest.approx(whole, rel=0.1)


AREA = lamp_with_area([0.5, 3, 0], 0.4)
SAID = "'lamp', through or off shape 'block'.*set merging=true"


@pytest.mark.parametrize(
    "lamp, shapes, parameters, said",
    [
        (LAMPS["point"], {"block": BLOCK}, {}, [SAID]),
        (LAMPS["directional"], {"block": BLOCK}, {}, ["emitter 'lamp'.*give the sun a disk"]),
        (LAMPS["point"], {"block": BLOCK}, {"light_paths": 0}, ["without light tracing.*leave light_paths"]),
        (BEAM, {}, {"light_paths": 0}, ["99 %.*'lamp'"]),
        (LAMPS["point"], {"ball": BALL}, {}, []),
        (LAMPS["point"], {"ball": BALL | {"center": [30, 0.6, 0]}}, {}, []),
        (LAMPS["point"], {}, {}, []),
        (AREA, {"block": BLOCK}, {}, []),
        ("own lamp", {"block": BLOCK}, {}, []),
    ],
)
def test_a_word_is_said_where_light_is_missing(lamp, shapes, parameters, said):
    """One warning for two renders of the floor beneath glass; none for a glass ball (a thousandth of the
    light), one out of view, no glass, a large lamp, and one of a class without light subpaths."""
    parts.register_plugins()
    scene = scene_of(parts.EMITTERS[lamp]() if lamp == "own lamp" else lamp, **shapes)
    with Warned() as warnings:
        for seed in range(2):
            integrator = bdpt(**parameters)
            integrator.render(scene, spp=4, seed=seed)
    assert len(warnings) == len(said), warnings
    for text, pattern in zip(warnings, said, strict=True):
        share = share_of(integrator)
        assert re.search(pattern, text) and text.startswith("not sampled, "), text
        assert unsampled_light.WARN_SHARE < share <= 1


@pytest.mark.parametrize(
    "parameters, spp, long, passes",
    [
        ({}, 64, True, [(64, 1)]),
        ({}, 4, True, [(1, 0), (1, 1), (3, 1)]),
        ({"light_paths": 0, "skip": "none"}, 4, True, [(1, 0), (4, 1)]),
        ({}, 4, False, [(1, 0), (4, 1)]),
    ],
    ids=["pilot", "no pilot", "path tracing", "short"],
)
def test_it_is_said_before_the_samples_are_traced(parameters, spp, long, passes, monkeypatch):
    """Expected: one warning before the first pass, from the mean of a pilot, or of an image of one sample per
    pixel; its share is that of the whole image within a fifth (noise of the image's mean)."""
    scene, integrator = scene_of(LAMPS["point"], block=BLOCK), bdpt(**parameters)
    if long:
        monkeypatch.setattr(rendering, "TWO_PASSES", 0)
    begun, trace = [], Render._pass
    with Warned() as warnings:

        def counted(self, step):
            begun.append((step.size, len(warnings)))
            trace(self, step)

        monkeypatch.setattr(Render, "_pass", counted)
        integrator.render(scene, spp=spp)
    assert begun == passes and len(warnings) == 1
    share = float(re.search("about ([0-9]+) %", warnings[0])[1]) / 100
    assert share == pytest.approx(share_of(integrator), rel=0.2)


def test_a_share_of_a_hundredth_is_said_before_the_first_pass():
    scene = scene_of(LAMPS["point"], block=BLOCK)
    render = Render(scene, scene.sensors()[0], bdpt().settings, 0, 16)
    lost = unsampled_light.UnsampledLight({0: np.array([0.02, 0.02, 0.02])})
    for share, said in ((0.009, False), (0.011, True)):
        mean = 0.02 / share - 0.02
        for of_pilot in (True, False):
            shares = lost.shares(mean, of_pilot)
            assert shares == {0: pytest.approx(share)}
        with Warned() as warnings:
            missing = unsampled_light.missing(render.prepared, render.plan, lost, shares, 16)
            messages.warn_of_unsampled_light(render.prepared, render.plan, missing)
        assert bool(warnings) == said


def test_a_small_glass_case_in_the_sun():
    """Rationale: light from infinity is not aimed at glass if small things lie far apart. Expected: in a
    render of many samples the estimates of four seeds agree within 30 % (with 2^13 photons: 70 %)."""
    case = {"type": "cube", "to_world": T().translate([0, 0, 0.2]).scale(0.15), "bsdf": GLASS}
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
    things = {"floor": {"type": "rectangle", "to_world": T().scale(6)}}
    things |= {f"ball{x}": {"type": "sphere", "center": [x, x, 0.1], "radius": 0.1} for x in (-5, 5)}
    eye = scenes.camera(origin=(0, -3, 5), target=(0, 0, 0.2), fov=5, size=128, up=(0, 0, 1))
    scene = scenes.load(case=case, sun=sun, eye=eye, **things)

    def found(spp, seed):
        made, merged = [], unsampled_light._merged
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(unsampled_light, "SEED", seed)
            patch.setattr(unsampled_light, "_merged", lambda *a: made.append(merged(*a)) or made[0])
            return sum(lost_in(scene, spp).values()), made[0][1]

    lights, counts = zip(*(found(512, seed) for seed in range(4)), strict=True)
    assert counts[0] == unsampled_light.MOST_SUBPATHS and found(1, 0)[1] == unsampled_light.SUBPATHS
    assert max(lights) < 1.3 * min(lights), lights


def test_a_mask_reflects_what_its_opacity_says(monkeypatch):
    """Rationale: Mitsuba's `mask` has the reflectance of what is inside of it. Tolerance: 5 % (the same
    subpaths but for the coin where the floor lets light through, 2^17: 2 %)."""
    masked = floor() | {"bsdf": {"type": "mask", "opacity": 0.25, "bsdf": floor()["bsdf"]}}
    null = sheet({"type": "null"})
    whole = estimate(scene_of(LAMPS["spot"], sheet=null), monkeypatch)
    found = estimate(scene_of(LAMPS["spot"], sheet=null, floor=masked), monkeypatch)
    assert found == pytest.approx(whole / 4, rel=0.05)


def projector(colour):
    """With one texel of this colour."""
    pixels = np.full((8, 8, 3), 2, np.float32)
    pixels[4, 4] = colour
    return LAMPS["projector"] | {"irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}}


BENEATH = BLOCK | {"to_world": T().translate([0, -3, 0])}  # the floor


@pytest.mark.parametrize(
    "lamp, block, said",
    [
        (lambda: LAMPS["point"] | {"intensity": 1e38}, BLOCK, True),
        (lambda: projector(np.inf), BLOCK, True),
        (lambda: projector([np.nan, 2, 2]), BLOCK, True),
        (lambda: LAMPS["point"] | {"intensity": 1e38}, BENEATH, False),
    ],
    ids=["large", "inf", "nan", "out of view"],
)
def test_what_is_not_finite_is_said(lamp, block, said):
    """Rationale: a render without light tracing does not make the paths that are lost. Expected: one warning
    for two renders, and no share; none of a lamp whose light meets nothing that is seen through glass."""
    scene, integrator = scene_of(lamp(), block=block), bdpt(light_paths=0)
    with Warned() as warnings:
        for seed in range(2):
            integrator.render(scene, spp=4, seed=seed)
    found = [text for text in warnings if "is unknown, since" in text]
    assert len(found) == said and integrator.statistics["unsampled_light"] == {}, warnings
    assert not said or "how much light of emitter 'lamp' is not sampled is unknown" in found[0]


def test_it_is_looked_for_once(monkeypatch):
    looked, original = [], unsampled_light.estimate
    monkeypatch.setattr(unsampled_light, "estimate", lambda *a: looked.append(a) or original(*a))
    for shapes in ({}, {"block": BLOCK}):
        scene = scene_of(LAMPS["point"], **shapes)
        for seed in range(3):
            bdpt().render(scene, spp=1, seed=seed)
        assert len(looked) == len(shapes)


def test_what_merging_adds_on_rough_metal_is_what_is_lost(monkeypatch):
    """To 15 %: light that leaves the floor twice within the glass (9 %) is not estimated; noise of 2 %."""
    metal = {"type": "roughconductor", "alpha": 0.2}
    scene = scene_of(LAMPS["point"], block=BLOCK, floor=floor() | {"bsdf": metal})
    added = mean(scene, bdpt(merging=True), 64) - mean(scene, bdpt(), 64)
    assert estimate(scene, monkeypatch) == pytest.approx(added, rel=0.15)


def test_only_lamps_that_no_ray_hits_lack_light():
    """As without the other lamp, to 15 %: the same photons but for the choice of the emitter."""
    others = {}, {"second": lamp_with_area([-2, 3, 0], 0.3)}
    both = (scene_of(LAMPS["point"], block=BLOCK, **more) for more in others)
    alone, beside = (lost_in(scene, guiding="always") for scene in both)
    assert len(alone) == len(beside) == 1
    assert sum(beside.values()) == pytest.approx(sum(alone.values()), rel=0.15)


def fog(albedo):
    """Between the floor and the sheet."""
    medium = {"type": "homogeneous", "sigma_t": 0.4, "albedo": albedo}
    to_world = T().translate([0, 0.4, 0]).scale([5.5, 0.5, 5.5])
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium}


def test_in_fog_the_direct_light_is_lost(monkeypatch):
    """Expected: beneath glass that neither reflects nor refracts all direct light of the floor is lost, as
    `volpath` sees it without the sheet in fog that only absorbs (within 5 %: noise of 1 %); the share has the
    noise of 2^13 subpaths: 15 %."""
    sheet_of_glass = sheet({"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0})
    path = mi.load_dict({"type": "volpath", "max_depth": 2})
    expected = mean(scene_of(LAMPS["spot"], fog=fog(0.0)), path, 64)
    clear = mean(scene_of(LAMPS["spot"]), path, 64)
    scene, integrator = scene_of(LAMPS["spot"], fog=fog(0.0), sheet=sheet_of_glass), bdpt()
    assert estimate(scene, monkeypatch) == pytest.approx(expected, rel=0.05) and expected < 0.6 * clear
    with Warned() as warnings:
        found = mean(scene, integrator, 4)
    assert len(warnings) == 1 and "set merging=true, or" in warnings[0]
    share = share_of(integrator)
    assert share == pytest.approx(expected / (expected + found), rel=0.15)


def test_nothing_is_estimated_where_sensor_and_boundaries_contradict_each_other():
    """Light subpaths would see another scene than the camera, which is the only warning."""
    around = fog(0.8) | {"to_world": T().scale(20)}
    scene, integrator = scene_of(LAMPS["point"], block=BLOCK, around=around), bdpt()
    with Warned() as warnings:
        integrator.render(scene, spp=1)
    assert len(warnings) == 1 and "declares no medium" in warnings[0], warnings
    assert integrator.statistics["unsampled_light"] == {}


def test_lamps_of_several_colours_are_lost_together():
    """Expected: a red, a green and a blue lamp lack what a white one does, each in proportion to what the
    floor reflects (noise of a tenth)."""

    def lamp(colour):
        return {"type": "point", "position": [0.5, 3, 0], "intensity": {"type": "rgb", "value": colour}}

    one = scene_of(lamp([10, 10, 10]), block=BLOCK)
    three = scene_of(lamp([10, 0, 0]), block=BLOCK, green=lamp([0, 10, 0]), blue=lamp([0, 0, 10]))
    white, coloured = lost_in(one), lost_in(three)
    assert len(coloured) == 3
    assert sum(coloured.values()) == pytest.approx(sum(white.values()), rel=0.2)
    parts_of = np.array([*coloured.values()]) / sum(coloured.values())
    np.testing.assert_allclose(parts_of, np.array([1, 0.8, 0.5]) / 2.3, rtol=0.2)


NEAR = {"type": "point", "position": [0, 0, 1], "intensity": 3.0}
LENS = parts.thinlens(0.3, 3.0, origin=(0, 0, -3), target=(0, 0, 1), size=4)
PINHOLE = parts.perspective(origin=(0, 0, -3), target=(0, 0, 1), size=4)
WITHOUT = {"light_paths": 0}


def meter(x=0.0):
    plate = {"type": "rectangle", "to_world": T().translate([x, 0, 0]).scale(0.2)}
    return parts.meter(plate)


def batch(**views):
    return {"type": "batch", "film": parts.film(size=1, width=2), **views}


@pytest.mark.parametrize(
    "sensor, lamp, parameters, said",
    [
        (meter, NEAR, WITHOUT, True),
        (lambda: batch(a=meter(-0.1), b=meter(0.1)), NEAR, WITHOUT, True),
        (lambda: batch(a=PINHOLE, b=meter()), NEAR, {}, True),
        (meter, NEAR, {}, False),
        (lambda: batch(a=meter(-0.1), b=meter(0.1)), NEAR, {}, False),
        (meter, {"type": "constant"}, WITHOUT, False),
        (meter, NEAR, WITHOUT | {"hide_emitters": True}, False),
        (lambda: LENS, NEAR, WITHOUT, False),
        (lambda: PINHOLE, NEAR, WITHOUT, False),
    ],
)
def test_missing_direct_light_is_said(sensor, lamp, parameters, said):
    """Only (1,1) and t = 0 sample direct light of a delta emitter on a sensor with area: without them a meter
    reads 0. Expected: one warning for two renders."""
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -0.3])}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(), "lamp": lamp, "floor": floor}, optimize=False)
    method = mi.load_dict({"type": "bdpt", "max_depth": 4} | parameters)
    with Warned() as warnings:
        for seed in range(2):
            method.render(scene, spp=1, seed=seed)
    assert len(warnings) == said
    assert not said or "delta emitter - sensor (needs (1,1))" in warnings[0]
