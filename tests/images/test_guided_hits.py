"""Guided s = 0: unbiased whatever the photons say; less noisy where a small lamp is behind glass; when."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import internals
import mitsuba as mi
import numpy as np
import pytest
import welch as st
from mitsuba_bdpt.planning import choice, pilot, unsampled_light
from mitsuba_bdpt.planning.configuration import CANDIDATES
from mitsuba_bdpt.planning.moments import FINE, GROUPS, GuidableLight, Moments
from mitsuba_bdpt.planning.planner import Planner
from mitsuba_bdpt.run.rendering import Render
from mitsuba_bdpt.transport.photons import photon_guide
from mitsuba_bdpt.transport.photons.photon import Photon
from mitsuba_bdpt.transport.photons.photon_guide import Guide
from mitsuba_bdpt.transport.plan import GUIDED_SAMPLES
from sds_scenes import ASIDE, ball, glass, guided, images, matte, point, rough, transform, under_glass
from snapshots import ROUNDING

import scenes
from scenes import square

import drjit as dr  # isort: skip

SCENES = Path(__file__).parents[2] / "scenes"
NOT_GUIDED = {"guiding": "emission"}


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": 6, **parameters})


# -- the guide ----------------------------------------------------------------------------------------


def photons(count, spread, seed=1):
    """``count`` photons on a unit square, whose directions differ by about ``spread`` from (0, 0, 1)."""
    rng = np.random.default_rng(seed)
    p = np.concatenate([rng.random((2, count)), np.zeros((1, count))])
    d = np.concatenate([spread * rng.standard_normal((2, count)), np.ones((1, count))])
    found = Photon.zeros(count)
    found.p, found.d = mi.Point3f(*p), mi.Vector3f(*(d / np.linalg.norm(d, axis=0)))
    found.distance, found.lane = mi.Float(np.full(count, 2.0)), dr.arange(mi.UInt32, count)
    return found


def density_at(guide, at, w):
    return np.array(photon_guide.density(guide, at, photon_guide.find(guide, at), w))


@pytest.mark.parametrize("count", [1, 3, 50, 5000])
def test_directions_follow_the_density(count):
    """Means over drawn directions of (cos theta)^n about (0, 0, 1), and the share of draws that make one, are
    integrals of the density by the midpoint rule; four standard errors of 2^20 draws, beside 2e-3 for lobes
    that the grid does not resolve."""
    guide = Guide.of(photons(count, 0.3), count)
    p = mi.Point3f(0.4, 0.6, 0.2)  # not nearer to any than 0.2, over a length of 2: lobes are wide
    rng, n = mi.PCG32(size=1 << 20), 1 << 20
    at = dr.zeros(mi.Point3f, n) + p
    u, v, w = (rng.next_float32() for _ in "uvw")
    d, active = photon_guide.draw(guide, at, photon_guide.find(guide, at), u, mi.Point2f(v, w))

    z, phi = np.meshgrid(np.linspace(-1, 1, 2001)[:-1] + 5e-4, (np.arange(720) + 0.5) * math.pi / 360)
    sin = np.sqrt(1 - z**2)
    w = mi.Vector3f(*(x.ravel() for x in (sin * np.cos(phi), sin * np.sin(phi), z)))
    at = dr.zeros(mi.Point3f, dr.width(w)) + p
    density = density_at(guide, at, w)
    for power in (0, 1, 2, 4):
        values = np.where(active, np.array(d)[2] ** power, 0)
        expected = (density * z.ravel() ** power).mean() * 4 * math.pi
        assert abs(values.mean() - expected) < 4 * values.std() / math.sqrt(n) + 2e-3


def test_the_guide_is_the_same_in_any_order():
    """Photons arrive in the order of threads; also if all lie in one place."""
    found = photons(1000, 0.3)
    found.p = mi.Point3f(dr.select(found.lane % 2 == 0, 0.5, found.p.x), 0.5, 0)
    order = mi.UInt32(np.random.default_rng(2).permutation(1000).astype(np.uint32))
    at = mi.Point3f(0.5, 0.5, dr.linspace(mi.Float, 0, 1, 64))
    w = dr.normalize(mi.Vector3f(dr.linspace(mi.Float, -1, 1, 64), 0.1, 1))
    a, b = (density_at(Guide.of(x, 1000), at, w) for x in (found, found.at(order)))
    np.testing.assert_array_equal(a, b)


def test_the_guide_finds_a_weak_caustic_beside_a_strong_one():
    """Of one photon in 50; windows alone have the density of a diffuse BSDF at one of ten points."""
    found = photons(5000, 0.02)
    found.d = dr.normalize(found.d + mi.Vector3f(dr.select(found.lane % 50 == 0, 1, 0), 0, 0))
    at, w = mi.Point3f(*np.random.default_rng(3).random((2, 200)), 0), dr.normalize(mi.Vector3f(1, 0, 1))
    assert (density_at(Guide.of(found, 5000), at, w) > 1 / math.pi).mean() > 0.9


# -- unbiased -------------------------------------------------------------------------------------------


def test_without_photons():
    """A lamp that shines away from all glass gives no photon."""
    lamp = {"type": "rectangle", "to_world": transform().translate([0, 0, 2.5]).scale(0.2)}
    scene = mi.load_dict(under_glass(lamp | {"emitter": {"type": "area", "radiance": 10.0}}))
    a, b = (images(scene, 16, 1, guiding=when) for when in ("always", "emission"))
    np.testing.assert_allclose(a, b, **ROUNDING)


# -- when ------------------------------------------------------------------------------------------------


def large(lamp):
    """The plate under a ``lamp``, and a film that is large enough for a pilot."""
    scene = under_glass(lamp)
    scene["sensor"]["film"] |= {"width": 64, "height": 64}
    return scene


def test_the_pilot_guides_where_it_pays(monkeypatch):
    """``always`` guides whatever it costs."""
    scene = mi.load_dict(large(ball(0.05)))
    method = bdpt()
    image = np.array(mi.render(scene, integrator=method, spp=16))
    found = method.statistics
    assert found["decisions"][0]["guided"] == GUIDED_SAMPLES and found["unbiased"]
    assert found["rays"]["photon"] and found["rays"]["guided"]
    text = method.explain(scene, spp=16)
    assert "used: guided s=0" in text
    again = internals.bdpt(max_depth=6, decisions=found["decisions"])
    np.testing.assert_allclose(np.array(mi.render(scene, integrator=again, spp=16)), image, **ROUNDING)
    never = bdpt(guiding="emission", merging=False)
    assert "skipped (by hand): guided s=0: guiding=emission" in never.explain(scene, spp=16)
    assert "guided s=0" not in method.explain(mi.load_dict(mi.cornell_box()), spp=16)
    monkeypatch.setitem(choice.COSTS, "guided", 1e9)
    always = bdpt(guiding="always")
    assert always.decide(scene, spp=16)[0]["guided"] == GUIDED_SAMPLES
    assert "guided s=0" not in {skipped["class"] for skipped in always.statistics["skipped"]}


def test_the_variance_without_guiding_is_predicted():
    """Under glass, where there is hardly any other light: within 15 % (noise of both)."""
    scene = mi.load_dict(under_glass(ball(0.3) | {"center": ASIDE}))
    found = images(scene, 64, 20, guiding="never", light_paths=0, points="independent")
    render = Render(scene, scene.sensors()[0], internals.bdpt(max_depth=6, light_paths=0).settings, 1, 64)
    light = unsampled_light.guidable(render.prepared, render.planner.full, render.settings, 4096, 0)
    assert light.light.sum() == pytest.approx(found.mean(), rel=0.15)
    assert light.second.sum() == pytest.approx(found.var(axis=0, ddof=1).mean() * 64, rel=0.15)


def test_paths_that_can_be_guided_are_in_no_sample_of_a_pilot():
    """Their outliers hide how candidates differ. At most half as many of a pilot's parts find light (of five
    seeds 1 to 6 of 16, and 10 to 14)."""
    scene = mi.load_dict(under_glass(ball(0.3)))
    render = Render(scene, scene.sensors()[0], bdpt(max_depth=8).settings, 1, 64)

    def parts(guidable, light):
        plan, seed = replace(render.plan, guidable=guidable), mi.UInt32(1)
        found = pilot.measure(render.prepared, plan, render.settings, seed, 1 << 14, guidable=light)
        return np.count_nonzero(found.errors[0, :, 0])

    light = GuidableLight(*np.ones((5, FINE**2)))
    assert max(parts(True, light), parts(True, None)) <= parts(False, None) / 2


@pytest.mark.parametrize("mean, typical, chosen", [(9.0, 9.0, True), (99.0, 0.0, True), (9.0, 0.0, False)])
def test_guiding_has_to_pay(mean, typical, chosen):
    """Beside 1 of all else, guiding for 3.5 times the cost removes SDS paths of a variance of 9, which gains
    10 / 3.5, or 99 in outliers alone, sqrt(100) / 3.5, but not 9 in outliers; nor what was not measured."""
    rays = dict.fromkeys(("camera", "shadow_s1", "light", "shadow_t1"), 1.0) | {"guidable": 0.36}
    moments = Moments(np.ones((2, GROUPS, len(CANDIDATES))), (mean, typical), mean=1.0, rays=rays)
    possible = [c for c in CANDIDATES if c.light_paths == 1 and c.connections == "none"]
    table = choice.choose(moments, possible)
    assert table[0].candidate.guided == (GUIDED_SAMPLES if chosen else 0)
    assert bool(choice.left_out(table)) == (not chosen)
    unmeasured = choice.choose(replace(moments, guidable=(0.0, 0.0)), possible)
    assert not any(row.candidate.guided for row in unmeasured)


def ball_in_the_sun():
    """A ball of glass on a floor under a clear sky: few renders meet the sun by s = 0, behind the ball."""
    scene = {
        "sensor": scenes.camera(origin=(0, -4, 2.5), target=(0, 0, 0.3), fov=40, size=64, up=(0, 0, 1)),
        "floor": square(size=6),
        "ball": scenes.ball(glass(), 0.4, (0.3, -0.2, 0.42)),
        "sky": {"type": "sunsky", "sun_direction": [0.4, -0.5, 0.77]},
    }
    return scenes.load(**scene)


def caustics(name, **parameters):
    return mi.load_file(str(SCENES / f"{name}.xml"), resolution=64, **parameters)


@pytest.mark.parametrize(
    "make, depth, guides",
    [
        (ball_in_the_sun, 12, False),
        (partial(caustics, "glass_caustics"), 12, True),
        (partial(caustics, "rough_glass_caustics", alpha=0.005), 8, True),
        (partial(caustics, "rough_glass_caustics", alpha=0.1), 8, False),
    ],
    ids=["sun", "glass_caustics", "alpha .005", "alpha .1"],
)
def test_pilots_of_any_seed_decide_alike(make, depth, guides, monkeypatch):
    """In `glass_caustics` guiding takes a sixtieth of the time to the same error. In the sun one of 60
    renders has an outlier without guiding, and every one with. Through rough glass it gains 30 times (alpha
    .005) and nothing (.1: its error is the same, and it takes 1.1 times as long)."""
    scene = make()
    for spp in (16, 64):
        for seed in range(5):
            monkeypatch.setattr(Planner, "pilot_seed", seed)
            render = Render(scene, scene.sensors()[0], bdpt(max_depth=depth).settings, 0, spp)
            assert bool(render.planner.run_pilot()[0].candidate.guided) == guides


@pytest.mark.parametrize("light, needed", [(ball, False), (point, True)])
def test_merging_that_does_not_pay_is_left_out(light, needed, monkeypatch):
    """Where photons cost more than they gain the ball is rendered without them, and the point lamp, which
    nothing else finds, with them."""
    described = large(light())
    method = bdpt(merging=True)
    for cost, used in ((choice.COSTS["guided"], True), (1e9, needed)):
        monkeypatch.setitem(choice.COSTS, "guided", cost)
        scene = mi.load_dict(described)  # anew: what a pilot has chosen is remembered
        mi.render(scene, integrator=method, spp=8)
        assert method.statistics["unbiased"] != used
        text = method.explain(scene, spp=8)
        assert ("used: vertex merging" in text) == used
        assert ("skipped (not worth its cost here): merging" in text) != used


def test_light_that_is_hit_too_rarely_is_merged():
    """A pilot dropped hits that a render rarely has, found no gain, and left out ``merging=true``: the image
    was black."""
    described = large(ball(0.001))
    method = bdpt(merging=True)
    image = np.array(mi.render(mi.load_dict(described), integrator=method, spp=8))
    assert image.any() and method.statistics["merging"]["merges"]
    assert bdpt(merging=False).decide(mi.load_dict(described), spp=16)[0]["guided"]


@pytest.mark.parametrize("speck, merges", [(0.001, True), (0.2, False)])
def test_light_that_is_hit_too_rarely_is_merged_beside_other_light(speck, merges):
    """Guiding was chosen for the light of the other lamp, and what photons find of a speck's was fireflies:
    merging the caustics of a mirror has a thousandth of the raw error. Both lamps have the same flux."""
    lamp = ball(speck) | {"center": ASIDE, "emitter": scenes.area(1 / speck**2)}
    method = bdpt()
    mi.render(mi.load_dict(large(ball(0.3)) | {"speck": lamp}), integrator=method, spp=16)
    assert ("merging" in method.statistics, method.statistics["unbiased"]) == (merges, not merges)


# -- through near-specular lobes ---------------------------------------------------------------------------


def jar():
    """Of rough glass, beside a lamp: some subpaths choose a rare reflection several times, though no event is
    diffuse."""
    glass = {"type": "roughdielectric", "alpha": 0.02}
    return {
        "type": "scene",
        "sensor": scenes.camera(origin=(0, 2, 4), target=(0, 0, 0), fov=22, size=24),
        "outer": scenes.ball(glass, 0.75),
        "inner": scenes.ball(glass, 0.65, flip_normals=True),
        "lamp": scenes.ball(matte(), 0.1, (0.4, 2.2, 0.6), emitter=scenes.area(10.0)),
    }


SMALL = ball(0.2) | {"center": ASIDE}


@pytest.mark.parametrize(
    "described, guiding, agree",
    [
        (under_glass(SMALL), {"decisions": guided(4)}, True),
        (under_glass(SMALL, plate=rough(0.001)), {"decisions": guided(4)}, False),
        (under_glass(SMALL, plate=rough(0.05)), {"decisions": guided(4)}, False),
        (jar(), {"guiding": "always", "max_depth": 8}, False),
    ],
    ids=["ideal glass", "alpha .001", "alpha .05", "jar"],
)
def test_small_lamps_without_fireflies(described, guiding, agree):
    """By hits alone a small lamp is met as rarely through rough glass as through ideal glass: guided, the
    variance of pixels is less than a tenth (1/110 for alpha .001 and 1/27 were measured; 1/3.5 in the jar if
    not guided at each event). The means agree where hits are frequent enough for a test."""
    described = mi.load_dict(described)
    a = images(described, 64, 12, **guiding)
    b = images(described, 64, 12, first=100, guiding="never", max_depth=guiding.get("max_depth", 6))
    assert a.var(axis=0).mean() < 0.1 * b.var(axis=0).mean()
    if agree:
        st.assert_agree(st.compare_images(st.tiles(a, 8), st.tiles(b, 8)), at_least=4)


def lit_metal(**more):
    """A floor of rough metal, lit by a small lamp in an ideal glass shell, seen through an ideal pane."""
    to_world = transform().look_at([0, -2.5, 2], [0, -4, 2.8], [0, 0, 1]).scale(3)
    return {
        "type": "scene",
        "sensor": scenes.camera(origin=(0, -4, 3), target=(0, -1.6, 0), fov=12, size=32, up=(0, 0, 1)),
        "floor": square(size=4, bsdf={"type": "roughconductor", "alpha": 0.1}),
        "lamp": scenes.ball(matte(), 0.02, (0, 0, 2), emitter=scenes.area(2500.0)),
        "shell": scenes.ball({"type": "dielectric"}, 0.4, (0, 0, 2)),
        "pane": {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "thindielectric"}},
    } | more


def test_an_unrelated_ball_changes_no_variance():
    """The static test is one of the scene: a polished ball out of view makes the floor's lobes near-specular,
    and no other event of its paths is diffuse. They are SDS paths by their delta events alone, and guided at
    the floor: the variance is that without the ball within a factor of 2 (1.2 was measured, and 12 where such
    paths are not guided)."""
    ball_of_metal = scenes.ball({"type": "roughconductor", "alpha": 0.02}, 0.1, (-3, 3, 0.4))
    a, b = (
        images(mi.load_dict(lit_metal(**more)), 64, 8, first=first, guiding="auto")
        for first, more in ((0, {"ball": ball_of_metal}), (100, {}))
    )
    assert a.var(axis=0).mean() < 2 * b.var(axis=0).mean()
    st.assert_agree(st.compare_images(st.tiles(a), st.tiles(b)), at_least=12)


def test_guided_light_is_not_undersampled():
    """Of a small lamp's light through nearly smooth glass some is undersampled unless photons guide to it."""
    described = mi.load_dict(under_glass(ball(0.2) | {"center": ASIDE}, plate=rough(0.001)))
    for guiding in ("always", "never"):
        settings = internals.bdpt(max_depth=6, guiding=guiding).settings
        render = Render(described, described.sensors()[0], settings, 0, 64)
        lost = unsampled_light.estimate(render.prepared, render.plan, render.settings)
        assert bool(lost.radiance) == (guiding == "never")


def test_light_that_is_not_guided_is_in_a_second_pilot(monkeypatch):
    """Where guiding would cost too much, the variances are those of a pilot that does not look for it, to the
    bit: by one thread, since additions of several have no order."""
    scene = caustics("rough_glass_caustics", alpha=0.005)
    monkeypatch.setitem(choice.COSTS, "guided", 1e9)
    auto, never = (internals.bdpt(max_depth=8, guiding=guiding).settings for guiding in ("auto", "emission"))
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        found = [Render(scene, scene.sensors()[0], each, 0, 64).planner.run_pilot() for each in (auto, never)]
    finally:
        dr.set_thread_count(threads)
    assert not found[0][0].candidate.guided and found[0][0].variance == found[1][0].variance
