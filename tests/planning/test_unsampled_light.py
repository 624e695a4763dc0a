"""Light that no strategy finds: how much it is, and when a word is said about it."""

import re
from dataclasses import replace
from pathlib import Path

import internals
import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
from mitsuba_bdpt.planning import unsampled_light
from mitsuba_bdpt.run import messages, rendering
from mitsuba_bdpt.run.rendering import Render
from warned import Warned

T = mi.ScalarTransform4f

SCENES = Path(__file__).parents[2] / "scenes"


def film(width=32):
    return {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": "box"}}


def camera(kind="perspective", **keys):
    """Looks at the origin from above."""
    if kind == "orthographic":
        keys["to_world"] = T().look_at([0, 4, 3], [0, 0, 0], [0, 1, 0]).scale(1.5)
    else:
        keys |= {"fov": 40, "to_world": T().look_at([0, 4, 3], [0, 0, 0], [0, 1, 0])}
    return {"type": kind, "film": film(), **keys}


def floor(red=0.6):
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [red, 0.8 * red, 0.5 * red]}}
    return {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(5), "bsdf": bsdf}


def sheet(bsdf):
    """Lies between the floor and all else."""
    place = T().translate([0, 1, 0]).rotate([1, 0, 0], -90).scale(6)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


DOWN = T().look_at([0.5, 3, 0], [0, 0, 0.3], [0, 0, 1])
LAMPS = {
    "point": {"type": "point", "position": [0.5, 3, 0], "intensity": 10.0},
    "spot": {"type": "spot", "cutoff_angle": 30, "intensity": 10.0, "to_world": DOWN},
    "directional": {"type": "directional", "direction": [0.2, -1, 0.1], "irradiance": 3.0},
    "projector": {
        "type": "projector",
        "fov": 40,
        "irradiance": {"type": "rgb", "value": 2.0},
        "to_world": DOWN,
    },
}

GLASS = {"type": "dielectric"}
BLOCK = {"type": "cube", "to_world": T().translate([0, 0.51, 0]).scale([1, 0.5, 1]), "bsdf": GLASS}
BALL = {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.5, "bsdf": GLASS}
BEAM = {
    "type": "rectangle",
    "to_world": T().translate([0, 3, 0.2]).rotate([1, 0, 0], 90).scale(0.5),
    "emitter": {"type": "directionalarea", "id": "", "radiance": 5.0},
}
CUT_OUT = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse", "reflectance": 0.0}}


def lamp_with_area(position, radius):
    """As bright as the point light, from afar."""
    emitter = {"type": "area", "radiance": 10 / (np.pi * radius**2)}
    return {"type": "sphere", "center": position, "radius": radius, "emitter": emitter}


def scene_of(lamp, eye=None, **shapes):
    return mi.load_dict({"type": "scene", "eye": eye or camera(), "lamp": lamp} | {"floor": floor()} | shapes)


def bdpt(max_depth=16, **parameters):
    return internals.bdpt(**{"max_depth": max_depth, "merging": False, **parameters})


def mean(scene, integrator, spp, seed=0):
    """Mean over the image of the colour that is brightest, red here."""
    return float(np.array(integrator.render(scene, spp=spp, seed=seed))[..., 0].mean())


def lost_in(scene, spp=16, **parameters):
    """What a render lacks, by emitter index."""
    render = Render(scene, scene.sensors()[0], bdpt(**parameters).settings, 0, spp)
    return unsampled_light.estimate(render.prepared, render.plan, render.settings, spp).radiance


def estimate(scene, monkeypatch):
    """What is lost, by four times 2^17 subpaths from either end, where a render takes 2^13."""
    monkeypatch.setattr(unsampled_light, "SUBPATHS", 1 << 17)
    total = 0
    for seed in range(4):
        monkeypatch.setattr(unsampled_light, "SEED", seed)
        total += sum(lost_in(scene).values())
    return total / 4


def share_of(integrator):
    """Share of the light that the last render lacks."""
    return sum(integrator.statistics["unsampled_light"].values())


@pytest.mark.parametrize("bsdf, passes", [({"type": "null"}, 1), (CUT_OUT, 0.25)])
@pytest.mark.parametrize("eye", ["perspective", "orthographic"])
@pytest.mark.parametrize("lamp", sorted(LAMPS))
def test_behind_a_sheet_of_nothing_the_direct_light_is_lost(lamp, eye, bsdf, passes, monkeypatch):
    """Rationale: a sheet without any effect is a delta surface on either side of the floor: all that is left
    of the floor is lost, and it is what `path` sees there without the sheet. One that holds back half on
    each way leaves a quarter. Expected: equal within 10 %: few subpaths arrive in the image (of
    the sun, which lights the whole scene, some hundred: noise of 3 %); measured: 5 % at most. Nothing is lost
    without the sheet."""
    through = scene_of(LAMPS[lamp], camera(eye), sheet=sheet(bsdf))
    plain = scene_of(LAMPS[lamp], camera(eye))
    expected = passes * mean(plain, mi.load_dict({"type": "path", "max_depth": 2}), 64)
    assert estimate(through, monkeypatch) == pytest.approx(expected, rel=0.1)
    assert estimate(plain, monkeypatch) == 0


def test_a_sensor_of_one_ray_finds_photons():
    """Rationale: its pixel has no size, which was the radius of the disc of photons. Expected: beneath a
    sheet of nothing the direct light of the floor at that point is lost, within half (about twenty photons).
    """
    eye = {"type": "radiancemeter", "film": film(1), "to_world": T().look_at([0, 4, 3], [0, 0, 0], [0, 1, 0])}
    scene = scene_of(LAMPS["spot"], eye, sheet=sheet({"type": "null"}))
    expected = mean(scene_of(LAMPS["spot"], eye), mi.load_dict({"type": "path", "max_depth": 2}), 64)
    assert sum(lost_in(scene).values()) == pytest.approx(expected, rel=0.5)


@pytest.mark.parametrize("camera_height, sheet_height", [(2.4, 2.7), (4, 3.5)])
def test_what_lies_behind_glass_on_one_side_only_is_found(camera_height, sheet_height, monkeypatch):
    """Rationale: next-event estimation joins the floor with a lamp on its side of the glass, t = 1 with a
    camera there. Expected: nothing is lost where the sheet lies between the camera and a lamp 3 above the
    floor, whichever of them is beneath it."""
    eye = camera() | {"to_world": T().look_at([0, camera_height, 2], [0, 0, 0], [0, 1, 0])}
    place = T().translate([0, sheet_height, 0]).rotate([1, 0, 0], -90).scale(6)
    scene = scene_of(LAMPS["point"], eye, sheet=sheet({"type": "null"}) | {"to_world": place})
    assert estimate(scene, monkeypatch) == 0


WATER = sheet({"type": "dielectric", "int_ior": 1.33})


@pytest.mark.parametrize("glass", [BLOCK, WATER])
def test_what_a_lamp_with_area_adds_is_what_is_lost(glass, monkeypatch):
    """Rationale: the remedy tells the truth. A sphere as bright as the point light is found by `path`
    (s = 0), through glass too. Under water, light arrives in another medium than it left in. Expected: the
    image of the point light and what is lost add up to that within 10 % on a dark floor (noise of 3 %; light
    that leaves the floor twice within the glass is not estimated: 14 % of the image at a reflectance of 0.6,
    2 % at 0.1). The image alone has less than a third."""
    eye, at = camera() | {"fov": 20}, [2, 3, 0]  # without the lamp's image in the glass
    dark = {"floor": floor(0.1), "glass": glass}
    path = mi.load_dict({"type": "path", "max_depth": 16})
    whole = mean(scene_of(lamp_with_area(at, 0.4), eye, **dark), path, 1024)
    scene = scene_of(LAMPS["point"] | {"position": at}, eye, **dark)
    found = mean(scene, bdpt(), 64)
    assert found < whole / 3
    assert found + estimate(scene, monkeypatch) == pytest.approx(whole, rel=0.1)


AREA = lamp_with_area([0.5, 3, 0], 0.4)
SAID = r"emitter 'lamp', through or off shape 'block' \(no ray hits.*; set merging=true, or .*area"
OF_BEAM = r"about 99 % of the image's light: that of emitter 'lamp' \(the render does without"


@pytest.mark.parametrize(
    "lamp, shapes, parameters, said",
    [
        (LAMPS["point"], {"block": BLOCK}, {}, [SAID]),
        (LAMPS["directional"], {"block": BLOCK}, {}, ["emitter 'lamp'.*give the sun a disk"]),
        (LAMPS["point"], {"block": BLOCK}, {"light_paths": 0}, ["without light tracing.*leave light_paths"]),
        (BEAM, {}, {"light_paths": 0}, [OF_BEAM]),
        (LAMPS["point"], {"ball": BALL}, {}, []),
        (LAMPS["point"], {"ball": BALL | {"center": [30, 0.6, 0]}}, {}, []),
        (LAMPS["point"], {}, {}, []),
        (AREA, {"block": BLOCK}, {}, []),
    ],
)
def test_a_word_is_said_where_light_is_missing(lamp, shapes, parameters, said):
    """Rationale: a point light and a glass object are in many scenes that lack nothing. Expected: one warning
    for two renders of the floor beneath a block of glass, which is dark; none for a glass ball (a thousandth
    of the light), one out of view, no glass, and a lamp that is not small. The lamp is named and a remedy."""
    scene = scene_of(lamp, **shapes)
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
    """Rationale: the warning came after the last pass, when the time was spent. Expected: before the first
    pass, from the mean of a pilot, or without one of an image of one sample per pixel, and not again; the
    share that is stated is that of the whole image, within a fifth (both have the same estimate of what is
    lost; noise of the image's mean, of 1,024 samples at least).
    """
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
    """Rationale: shares that a pilot put between a hundredth and two were said after the first pass, which
    may be the whole render. Expected: a share above a hundredth is said by a pilot, one below is not, as
    after the first pass.
    """
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
    """Rationale: light from infinity is not aimed at glass if small things lie far apart; 2^13 photons of it
    bring two or three into a small case in a large room. Expected: in a render of many samples the estimates
    of four seeds agree within 30 % (with 2^13: 70 %); in a short one the estimate stays short."""
    case = {
        "type": "cube",
        "to_world": T().translate([0, 0, 0.2]).scale(0.15),
        "bsdf": GLASS,
    }
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
    things = {"floor": {"type": "rectangle", "to_world": T().scale(6)}}
    things |= {f"ball{x}": {"type": "sphere", "center": [x, x, 0.1], "radius": 0.1} for x in (-5, 5)}
    film = {"type": "hdrfilm", "width": 128, "height": 128}
    eye = {"type": "perspective", "fov": 5, "to_world": T().look_at([0, -3, 5], [0, 0, 0.2], [0, 0, 1])}
    scene = mi.load_dict({"type": "scene", "case": case, "sun": sun, "eye": eye | {"film": film}} | things)

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
    """Rationale: Mitsuba's `mask` answers with the reflectance of what is inside of it. Expected: beneath
    a sheet of nothing a floor of opacity 0.25 loses a quarter of what one without a mask does, within 5 %:
    the same subpaths, but for the coin where a floor lets light through, among 2^17 (noise of 2 %)."""
    masked = floor() | {"bsdf": {"type": "mask", "opacity": 0.25, "bsdf": floor()["bsdf"]}}
    null = sheet({"type": "null"})
    whole = estimate(scene_of(LAMPS["spot"], sheet=null), monkeypatch)
    found = estimate(scene_of(LAMPS["spot"], sheet=null, floor=masked), monkeypatch)
    assert found == pytest.approx(whole / 4, rel=0.05)


def projector(colour):
    """A projector one of whose texels has this colour."""
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
    """Rationale: a render without light tracing does not make the paths that are lost, and may meet none of
    their numbers; the maximum over colours passes over NaN. Expected: a lamp that is not finite, or beyond
    single precision, is named by one warning for two renders, and has no share; none of a lamp whose light
    meets nothing that is seen through glass."""
    scene, integrator = scene_of(lamp(), block=block), bdpt(light_paths=0)
    with Warned() as warnings:
        for seed in range(2):
            integrator.render(scene, spp=4, seed=seed)
    found = [text for text in warnings if "is unknown, since" in text]
    assert len(found) == said and integrator.statistics["unsampled_light"] == {}, warnings
    assert not said or "how much light of emitter 'lamp' is not sampled is unknown" in found[0]


def test_the_black_side_of_a_surface_lacks_no_light(monkeypatch):
    """Rationale: a one-sided surface is black from behind. Expected: nothing is lost on a floor that is seen
    and lit from behind, under a sheet of nothing."""
    scene = scene_of(LAMPS["point"], floor=floor() | {"flip_normals": True}, sheet=sheet({"type": "null"}))
    assert estimate(scene, monkeypatch) == 0


def test_it_is_looked_for_once(monkeypatch):
    """Rationale: the look takes some ten milliseconds, and its kernels are compiled. Expected: one for three
    renders of a scene where such paths are possible, none where they are not."""
    looked, original = [], unsampled_light.estimate
    monkeypatch.setattr(unsampled_light, "estimate", lambda *a: looked.append(a) or original(*a))
    for shapes in ({}, {"block": BLOCK}):
        scene = scene_of(LAMPS["point"], **shapes)
        for seed in range(3):
            bdpt().render(scene, spp=1, seed=seed)
        assert len(looked) == len(shapes)


@pytest.mark.parametrize(
    "name, share, said",
    [
        ("lamp_behind_glass", 0.006, []),
        ("smallvcm_cornell_point", 0.0012, []),
        ("projector_through_glass", 0.028, ["emitter without id (Projector)"]),
        ("smallvcm_cornell_sun", 0.040, ["emitter without id (DirectionalEmitter)"]),
        ("pool_floor", 0.94, ["emitter without id (DirectionalEmitter)"]),
        ("lamp_in_glass_seen", 0.0605, ["emitter without id (PointLight)"]),
    ],
)
def test_what_the_committed_scenes_lack(name, share, said, monkeypatch):
    """Rationale: all of them have a lamp without area, and glass; their files say what only merging finds.
    Expected: a word about those that lack more than a hundredth of the light, and none about the others.
    The share is that of 2^18 subpaths, which three seeds agree about to a tenth; 2^13 are off by a third, the
    2^15 of this test by a sixth."""
    monkeypatch.setattr(unsampled_light, "SUBPATHS", 1 << 15)
    scene = mi.load_file(str(SCENES / f"{name}.xml"), resolution=24, integrator="bdpt")
    integrator = scene.integrator()
    integrator.settings = replace(integrator.settings, merging=False)
    with Warned() as warnings:
        integrator.render(scene, spp=16)
    found = [text.partition("that of ")[2].partition(", through")[0] for text in warnings]
    assert found == said
    assert share_of(integrator) == pytest.approx(share, rel=0.4)


def test_what_merging_adds_on_rough_metal_is_what_is_lost(monkeypatch):
    """Rationale: the albedo of a glossy surface says little about what a camera sees of it. Expected: what
    merging adds to the image of rough metal beneath glass, within 15 % (light that leaves the floor twice
    within the glass is not estimated: 9 % of it; noise of 2 %)."""
    metal = {"type": "roughconductor", "alpha": 0.2}
    scene = scene_of(LAMPS["point"], block=BLOCK, floor=floor() | {"bsdf": metal})
    added = mean(scene, bdpt(merging=True), 64) - mean(scene, bdpt(), 64)
    assert estimate(scene, monkeypatch) == pytest.approx(added, rel=0.15)


def test_only_lamps_that_no_ray_hits_lack_light():
    """Rationale: camera subpaths hit a lamp with area through glass. Expected: of that and a point light the
    share of the point light alone, as without the other (the same photons but for the choice of the emitter:
    within 15 %)."""
    scenes = (
        scene_of(LAMPS["point"], block=BLOCK, **others)
        for others in ({}, {"second": lamp_with_area([-2, 3, 0], 0.3)})
    )
    alone, beside = (lost_in(scene, guiding="always") for scene in scenes)
    assert len(alone) == len(beside) == 1
    assert sum(beside.values()) == pytest.approx(sum(alone.values()), rel=0.15)


def fog(albedo):
    """Fills the space between the floor and the sheet."""
    medium = {"type": "homogeneous", "sigma_t": 0.4, "albedo": albedo}
    to_world = T().translate([0, 0.4, 0]).scale([5.5, 0.5, 5.5])
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium}


def test_in_fog_the_direct_light_is_lost(monkeypatch):
    """Rationale: media were left out. Expected: beneath a sheet of glass that neither reflects nor refracts
    all direct light of the floor is lost, dimmed by the fog on its way down and up, as `volpath` sees it
    without the sheet in a fog that only absorbs (within 5 %: noise of 1 %). A word is said, the share is
    that of the image (with the noise of 2^13 subpaths: within 15 %), and the remedy is not merging, which
    fog rules out.
    """
    sheet_of_glass = sheet({"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0})
    path = mi.load_dict({"type": "volpath", "max_depth": 2})
    expected = mean(scene_of(LAMPS["spot"], fog=fog(0.0)), path, 64)
    clear = mean(scene_of(LAMPS["spot"]), path, 64)
    scene, integrator = scene_of(LAMPS["spot"], fog=fog(0.8), sheet=sheet_of_glass), bdpt()
    assert estimate(scene, monkeypatch) == pytest.approx(expected, rel=0.05) and expected < 0.6 * clear
    with Warned() as warnings:
        found = mean(scene, integrator, 4)
    assert len(warnings) == 1 and "emitter 'lamp', through or off shape 'sheet'" in warnings[0], warnings
    assert "merging" not in warnings[0] and "small area" in warnings[0]
    share = share_of(integrator)
    assert share == pytest.approx(expected / (expected + found), rel=0.15)


def test_nothing_is_estimated_where_sensor_and_boundaries_contradict_each_other():
    """Rationale: light subpaths would see another scene than the camera, which one warning says; a second one
    blamed light_paths and decisions, which nobody had set. Expected: the first one alone, and no share."""
    around = fog(0.8) | {"to_world": T().scale(20)}
    scene, integrator = scene_of(LAMPS["point"], block=BLOCK, around=around), bdpt()
    with Warned() as warnings:
        integrator.render(scene, spp=1)
    assert len(warnings) == 1 and "declares no medium" in warnings[0], warnings
    assert integrator.statistics["unsampled_light"] == {}


def test_lamps_of_several_colours_are_lost_together():
    """Rationale: the brightest colours of a red, a green and a blue lamp are those of three white ones.
    Expected: together they lack what a white lamp does, each in proportion to what the floor reflects of its
    colour, to the noise of a tenth."""

    def lamp(colour):
        return {"type": "point", "position": [0.5, 3, 0], "intensity": {"type": "rgb", "value": colour}}

    one = scene_of(lamp([10, 10, 10]), block=BLOCK)
    three = scene_of(lamp([10, 0, 0]), block=BLOCK, green=lamp([0, 10, 0]), blue=lamp([0, 0, 10]))
    white, coloured = lost_in(one), lost_in(three)
    assert len(coloured) == 3
    assert sum(coloured.values()) == pytest.approx(sum(white.values()), rel=0.2)
    parts_of = np.array([*coloured.values()]) / sum(coloured.values())
    np.testing.assert_allclose(parts_of, np.array([1, 0.8, 0.5]) / 2.3, rtol=0.2)


def test_nothing_is_looked_for_where_no_light_subpath_starts():
    """Rationale: a lamp of a user's own class without area emits no light subpath that could be followed
    through glass. Expected: the render ends, without a word."""
    parts.register_plugins()
    glass = {"type": "sphere", "radius": 0.5, "bsdf": GLASS}
    scene = scene_of(parts.EMITTERS["own lamp"](), glass=glass)
    integrator = bdpt()
    integrator.render(scene, spp=4)
    assert integrator.statistics["unsampled_light"] == {}


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
    """Rationale: only (1,1) and t = 0 sample direct light of a delta emitter on a sensor with area; without
    them a meter reads 0, which looks like a measurement. Expected: one warning for two renders, and a line of
    `explain`; none where (1,1) takes part, where s = 0 finds the lamp, where it is hidden, and of cameras.
    """
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -0.3])}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(), "lamp": lamp, "floor": floor}, optimize=False)
    method = mi.load_dict({"type": "bdpt", "max_depth": 4} | parameters)
    with Warned() as warnings:
        for seed in range(2):
            method.render(scene, spp=1, seed=seed)
    assert len(warnings) == said
    if said:
        assert "delta emitter - sensor (needs (1,1))" in warnings[0] and "leave light_paths" in warnings[0]
        assert "not sampled: delta emitter - sensor (needs (1,1))" in method.explain(scene, spp=1)
