"""What to skip: the pilot's variances, the choice, its record. Variances are compared with those of many
renders with given ``decisions``, whose recorded mean of 0 leaves out roulette on connections, which a pilot
does not know."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import internals
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.image import sink
from mitsuba_bdpt.planning import budget, choice, moments, pilot, unsampled_light
from mitsuba_bdpt.planning import configuration as uniform
from mitsuba_bdpt.planning.configuration import CANDIDATES, Configuration, Decision, candidates
from mitsuba_bdpt.planning.planner import Planner
from mitsuba_bdpt.run import rendering, schedule
from mitsuba_bdpt.transport import kernel, mis
from mitsuba_bdpt.transport.batch import Batch, Places

import scenes

T = mi.ScalarTransform4f
SCENES = Path(__file__).parents[2] / "scenes"


def cornell(size=32, **more):
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    return mi.load_dict(scene | more)


def camera(size, **more):
    return scenes.camera(origin=(0, 2, 4), target=(0, 0.3, 0), fov=40, size=size) | more


def scene_of(size=32, **objects):
    return mi.load_dict({"type": "scene", "sensor": camera(size)} | objects)


def ground(size):
    return scenes.floor(size=size)


BALL = {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.5, "bsdf": {"type": "dielectric"}}


def caustic(size=32, **more):
    """A glass ball under a small lamp."""
    lamp = {"type": "sphere", "center": [0.3, 3, 0.2], "radius": 0.05}
    lamp |= {"emitter": {"type": "area", "radiance": 400.0}}
    return scene_of(size, floor=ground(2), ball=BALL, lamp=lamp, **more)


def lit_caustic():
    """Without black shadows, where a splat is an error without a bound."""
    return caustic(sky={"type": "constant", "radiance": 0.2})


def fog():
    """A ball of fog: connections are drawn before it is known how much of their light passes it."""
    inside = {"type": "homogeneous", "sigma_t": 3.0, "albedo": 0.8}
    return cornell(ball={"type": "sphere", "radius": 0.8, "bsdf": {"type": "null"}, "interior": inside})


def sky(size=32):
    """Nothing to gain: a ball on the ground under a constant sky."""
    ball = {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5}
    return scene_of(size, floor=ground(30), ball=ball, sky={"type": "constant", "radiance": 1.0})


def bdpt(**parameters):
    return internals.bdpt(**{"max_depth": 5, **parameters})


def of(target, **parameters):
    """A render before its first pass."""
    return rendering.Render(target, target.sensors()[0], bdpt(**parameters).settings, 1, 64)


def piloted(target, lanes, seed=3, stands_for=pilot.RAREST, guidable=None, **parameters):
    """The moments of a pilot."""
    render, seed = of(target, **parameters), dr.opaque(mi.UInt32, seed)
    return pilot.measure(render.prepared, render.plan, render.settings, seed, lanes, stands_for, guidable)


def moments_of(target, stands_for=pilot.RAREST):
    """The moments of a pilot of paths, errors the means over eight of them."""
    found = [piloted(target, 1 << 14, seed, stands_for, **OF_PATHS) for seed in range(8)]
    return replace(found[0], errors=np.mean([f.errors for f in found], axis=0))


# One of each ray, and pairs of vertices.
RAYS = dict.fromkeys(("camera", "shadow_s1", "light", "shadow_t1", "evaluated"), 1.0)


def made_of(variances, rays=RAYS, hidden=(), guidable=(0.0, 0.0)):
    """Moments with these variances (else 1) by configuration, of which a typical render lacks ``hidden``."""
    errors = np.ones((2, moments.GROUPS, len(CANDIDATES)))
    for way, variance in variances.items():
        errors[:, :, CANDIDATES.index(way)] = variance
    for way, part in dict(hidden).items():
        errors[1, :, CANDIDATES.index(way)] -= part
    return moments.Moments(errors, guidable, mean=1.0, rays=rays)


def decision(way: Configuration, mean=0.0):
    return Decision.of(way, cost=1.0, variance=1.0, mean=mean)


def forced(decision, **parameters):
    return bdpt(decisions=[decision.record()], **parameters)


ALONE = uniform.PATH_TRACING
SPLATS = Configuration(1 / 2, "none", 1 / 8, 1.0)
CONNECTED = Configuration(1 / 4, "one", 1 / 16, 1.0)
FEW = Configuration(1 / 16, "one", 1 / 4, 1.0)
BOTH = Configuration(1.0, "one", 1.0, 1.0)
PREDICTED = {
    "n0c0": ALONE,
    "n0c0, kappa of s=1": replace(ALONE, kappa_direct=1 / 2),
    "n1c0": SPLATS,
    "n1c1": BOTH,
    "n1c1, one": Configuration(1 / 2, "one", 1 / 2, 1.0),
}


def norms(reference):
    """Squared brightness of the place, as a pilot has it: that of 3 x 3 tiles, here pixels."""
    assert reference.shape == (moments.FINE, moments.FINE)
    around = moments._with_neighbours(reference) / moments._with_neighbours(np.ones_like(reference))
    return around**2 + 0.01 * reference.mean() ** 2


# What a pilot knows of paths (lamps and sky are hidden: it leaves directly seen emitters out).
OF_PATHS = {"hide_emitters": True, "points": "independent"}


@cache
def foretold(make):
    """A scene, and what a pilot of eight rounds found there."""
    target = make()
    return target, moments_of(target)


@pytest.mark.parametrize(
    "make, name",
    [
        *((make, name) for make in (cornell, lit_caustic) for name in PREDICTED),
        *((make, "four per lane") for make in (cornell, sky)),
        (fog, "n1c1, one"),
    ],
)
def test_predicted_variance(make, name):
    """Renders of 8 samples per pixel with independent numbers, paths of 2 to 5 edges (the pilot leaves
    directly seen emitters out). Expected: predicted and measured variance agree within 15 % (a draw in fog by
    sizes that fog does not change: 25 % more). Of path tracing alone in the caustic renders miss most of the
    variance: up to 20 times. Four light subpaths per lane, which count as two: up to 30 % more."""
    way = PREDICTED.get(name, replace(FEW, joined=4))
    target, found = foretold(make)
    predicted = found.errors[0, :, CANDIDATES.index(way)].mean()
    integrator = forced(decision(way), **OF_PATHS)
    seeds = range(64 if make is lit_caustic else 32)
    images = np.stack([np.array(integrator.render(target, seed=s, spp=8))[..., :3].mean(-1) for s in seeds])
    measured = 8 * (images.astype(float).var(axis=0, ddof=1) / norms(images.mean(axis=0))).mean()
    if make is lit_caustic and not way.light_paths:
        assert 0.5 * measured < predicted < 20 * measured
    elif way.joined > 1:
        assert 0.85 * measured < predicted < 1.3 * measured
    else:
        assert predicted == pytest.approx(measured, rel=0.15)


def test_predicted_error_of_a_typical_render():
    """Rationale: renders of the caustic by path tracing alone miss most of the variance. Expected: the
    prediction is within a factor of 1.5 of the mean of 64 trimmed relMSE; the predicted variance is 20 times
    that or more."""
    target, spp = lit_caustic(), 8
    found = moments_of(target, spp * moments.FINE**2 / 2**14)
    predicted = found.errors[1, :, CANDIDATES.index(ALONE)].mean()
    reference = np.array(forced(decision(SPLATS), **OF_PATHS).render(target, spp=4096))[..., :3].mean(-1)
    integrator = forced(decision(ALONE), **OF_PATHS)
    errors = []
    for seed in range(64):
        image = np.array(integrator.render(target, seed=seed, spp=spp))[..., :3].mean(-1)
        squares = np.sort(((image - reference) ** 2 / norms(reference)).ravel())
        errors.append(squares[: -round(moments.TRIMMED * squares.size)].mean())
    measured = spp * np.mean(errors)
    assert measured / 1.5 < predicted < 1.5 * measured
    assert found.errors[0, :, CANDIDATES.index(ALONE)].mean() > 20 * measured


@pytest.mark.parametrize("make, light", [(sky, False), (caustic, True), (cornell, True)])
def test_choice(make, light, monkeypatch):
    """Light subpaths only where they pay, for pilots of five seeds."""
    monkeypatch.setattr(uniform, "UNIFORM_SAMPLES", 0)
    target = make(128)
    integrator = bdpt()
    for seed in range(5):
        monkeypatch.setattr(Planner, "pilot_seed", seed)
        integrator.render(target, seed=seed, spp=32)
        statistics = integrator.statistics
        (made,) = statistics["decisions"]
        assert all(made[name] == float(f"{made[name]:.6g}") for name in ("cost", "variance", "mean"))
        assert (made["light_paths"] > 0) == light == (statistics["rays"]["light"] > 0)
        reasons = [s for s in statistics["skipped"] if s["level"] == "not worth its cost here"]
        assert {r["class"] for r in reasons} >= (set() if light else {"t<=1", "inner"})
        assert statistics["seconds"]["pilot"] > 0


def test_few_pixels(monkeypatch):
    """Rationale: the splats of one pixel have a mean that counts. Expected: a pilot of a film of 2 x 2 pixels
    has as many samples as any other; renders need none and have a light subpath for each camera subpath."""
    target, traced, trace = caustic(2), [], pilot.trace
    monkeypatch.setattr(pilot, "trace", lambda *a: traced.append(a[2].size) or trace(*a))
    found = piloted(target, 2048)
    assert traced == [2048] and (found.errors[0, :, -1] > 0).all()
    integrator = bdpt()
    integrator.render(target, spp=1 << 15)
    statistics = integrator.statistics
    assert statistics["decisions"] == [] and statistics["rays"]["light"] > statistics["rays"]["camera"] / 2


def test_rare_paths_count_by_how_often_they_are_made():
    """A path of size 1, of which light tracing has a share of 1/160 and connections the rest. Expected:
    without connections its second moment is 160, at any coefficient of light tracing; at a share of 1/10240
    it counts as if it were made once in 1,024 times."""
    sink = pilot.Pilot(of(sky()).prepared.camera.region, Batch(0, 8, 0, 2, 1), pilot.RAREST)
    for share, expected in ((1 / 160, 160), (1 / 10240, 1024)):
        shares = mi.Vector4f(*({"light": share, "inner": 1 - share}.get(kind, 0) for kind in mis.CLASSES))
        parts = sink._parts(mi.Float(1), SimpleNamespace(shares=shares, kind="inner"))
        found = [
            p[0] * c.light_paths
            for c, p in zip(CANDIDATES, parts["moment"], strict=True)
            if c.light_paths and c.connections == "none"
        ]
        assert len(found) > 1 and found == pytest.approx([expected] * len(found), rel=1e-4)


@pytest.mark.parametrize("fov", [40, 3], ids=["the whole spot is seen", "a part of the spot is seen"])
def test_narrow_spot_is_not_noisier_than_path(fov):
    """pbrt-v4 #362: light tracing was trusted too much on a floor lit by a narrow spot. Expected: the
    variance, summed over the image, is not above that of `path` (10 % allowed: twice the standard error of
    the ratio). Where a pixel gets few splats light_paths=1/4 is 20,000 times as noisy."""
    above = T().look_at([1, 4, 1], [0, 0, 0], [0, 0, 1])
    lamp = {"type": "spot", "cutoff_angle": 6, "intensity": 30.0, "to_world": above}
    view = camera(128, fov=fov, to_world=T().look_at([0, 2, 4], [0, 0, 0], [0, 1, 0]))
    target = scene_of(sensor=view, floor=ground(3), lamp=lamp)

    def noise(integrator):
        images = [np.array(integrator.render(target, seed=s, spp=32)) for s in range(16)]
        return np.var(images, axis=0, ddof=1).sum()

    integrator = bdpt()
    assert noise(integrator) < 1.1 * noise(mi.load_dict({"type": "path", "max_depth": 5}))
    assert integrator.statistics["decisions"]


@pytest.mark.parametrize("name", ["glass_caustics", "window_room"])
def test_decisions_do_not_depend_on_the_unit_of_radiance(name):
    """Rationale: squares of single precision end at 1e38; connections within a plane (cosines of 1e-20) are 0
    in faint light and overflow in strong light. Expected: the same decision, variance within 1e-6, and the
    image times the factor within 1e-5 of its mean (sums of atomics) but for a percent of the pixels, where
    what is too faint for single precision took part in a draw."""
    images, records = [], []
    for factor in (1.0, 2.0**-66, 2.0**40, 2.0**66):
        scene = mi.load_file(str(SCENES / f"{name}.xml"), resolution=32)
        params = mi.traverse(scene)
        for key in params.keys():
            if key.endswith((".radiance.value", ".scale")):  # a lamp's, an environment's
                params[key] = params[key] * factor
        params.update()
        integrator = bdpt(max_depth=6)
        image = integrator.render(scene, seed=1, spp=128)
        images.append(np.array(image, dtype=np.float64) / factor)
        assert integrator.statistics["non_finite"] == 0
        (record,) = integrator.statistics["decisions"]
        records.append(record)
    assert images[0].mean() > 0.1
    for image, record in zip(images[1:], records[1:], strict=True):
        for key in ("light_paths", "connections", "coefficients"):
            assert record[key] == records[0][key]
        np.testing.assert_allclose(record["variance"], records[0]["variance"], rtol=1e-6)
        assert (np.abs(image - images[0]) > 1e-5 * images[0].mean()).mean() < 0.01


@pytest.mark.parametrize("chosen", [1024, 3000, 9000, 16384])
def test_pixels_of_a_pilot(chosen):
    """Rationale: every 16th pixel of a wide film is in the same columns. Expected: one pixel of each equal
    part of the film; nine tenths of their share in each eighth of width and height (parts are narrower); a
    sequence of its own for each sample."""
    target = sky(128)
    kernel = of(target).kernel
    place = Places(kernel, Batch(0, chosen, 0, 2, 128 * 128), 2)
    slot = dr.arange(mi.UInt32, 2 * chosen)
    pixel, sample = (np.array(x) for x in place._split(slot))
    part = 128 * 128 / chosen
    number = np.arange(2 * chosen) // 2
    assert (pixel >= np.floor(number * part)).all() and (pixel < np.ceil((number + 1) * part)).all()
    np.testing.assert_array_equal(sample, np.arange(2 * chosen) % 2)
    index = np.array(place.index(slot))
    assert len(np.unique(index >> np.uint64(32))) == 2 * chosen and (index % 2**32 == 0).all()
    for line in (pixel % 128, pixel // 128):
        assert (np.bincount(line // 16, minlength=8) / (2 * chosen)).min() > 0.9 / 8


def test_splats_in_shadows_count_by_what_is_there():
    """A picture of radiance 1 with a black block of 3 x 3 fine tiles. Expected: the norm there is that of
    black (a hundredth of the mean's square, and what the larger tile stands in for), of the rest 1."""
    fine = moments.FINE
    tile = np.repeat(np.arange(fine**2), 8)
    dark = np.zeros((fine, fine), dtype=bool)
    dark[9:12, 17:20] = True
    estimate = np.where(dark.ravel()[tile], 0.0, 1.0)[:, None]
    nothing = np.zeros_like(estimate)
    samples = {"moment": nothing, "light": nothing, "brightness": estimate, "tile": tile[:, None]}
    for norm in moments._norms(samples, np.zeros((2, fine**2))).reshape(2, fine, fine):
        assert norm[10, 18] < 0.011 and norm[0, 0] == pytest.approx(1.01, rel=0.02)


@pytest.mark.parametrize("name", ["point_cube", "point_sphere", "spot_sphere", "area_cube"])
def test_small_caustics_get_their_light(name, monkeypatch):
    """Rationale: with 16 camera subpaths for a light subpath a small caustic was a dozen white dots.
    Expected: a light subpath for one or two camera subpaths, for pilots of four seeds."""
    target = mi.load_file(str(SCENES / "small_casters" / f"{name}.xml"))
    for seed in range(4):
        monkeypatch.setattr(Planner, "pilot_seed", seed)
        render = rendering.Render(target, target.sensors()[0], bdpt(max_depth=8).settings, seed, 64)
        assert render.decide()[0].candidate.light_paths >= 1 / 2


def surroundings(bright=1.0, **emitters):
    """`sky` under a map of radiance 1 with one ``bright`` pixel."""
    data = np.ones((16, 32, 3), dtype=np.float32)
    data[3, 5] = bright
    lit = {"type": "envmap", "bitmap": mi.Bitmap(data), "id": "map"}
    return scene_of(ground=ground(30), map=lit, **emitters)


def test_an_uniform_decides_without_a_pilot(monkeypatch):
    """Expected: no pilot under a constant sky or a map without bright spots. A sun in the map (200 times the
    mean), another emitter, or 2^24 samples (2^20 where the sky is nearly uniform) need one."""
    for target, lone in (
        (sky(), True),
        (surroundings(), True),
        (surroundings(bright=300.0), False),
        (surroundings(lamp={"type": "point", "position": [0, 1, 0]}), False),
    ):
        integrator = bdpt()
        integrator.render(target, spp=4, develop=False)
        decisions = integrator.statistics["decisions"]
        assert [d["light_paths"] for d in decisions] == [0.0] * lone
        assert (integrator.statistics["rays"]["light"] == 0) == lone
    monkeypatch.setattr(pilot, "measure", None)
    integrator = bdpt()
    integrator.render(sky(), spp=1 << 9, develop=False)
    assert integrator.statistics["decisions"][0]["coefficients"]["s=1"] == uniform.UNIFORM_DIRECT
    monkeypatch.undo()

    def alone(target, samples):
        render = of(target)
        return uniform.without_pilot(render.prepared, render.plan, render.settings, samples)

    bright = surroundings(bright=10.0)
    for target, samples in ((sky(), uniform.UNIFORM_SAMPLES), (bright, budget.CHEAP_SAMPLES)):
        assert alone(target, samples - 1) and not alone(target, samples)
        with monkeypatch.context() as patch:
            patch.setattr(budget, "samples_of_kernel", lambda _, n=samples: n + 1)
            assert alone(target, samples)
    # A map worth sampling gets its full weight.
    assert alone(surroundings(bright=1.5), 1 << 14).kappa_direct == uniform.UNIFORM_DIRECT
    assert alone(bright, 1 << 14).kappa_direct == 1


def test_why_there_is_no_pilot():
    fixed = "nothing to choose with"
    for parameters, target, why in (
        ({}, cornell(), "the render has 4096 samples, a pilot needs 16384"),
        ({}, sky(), "the scene alone decides"),
        ({"light_paths": 1, "connections": "one"}, cornell(), f"{fixed} light_paths=1 and connections=one"),
        ({"skip": "impossible"}, cornell(), f"{fixed} skip=impossible"),
        ({"decisions": [decision(ALONE).record()]}, cornell(), f"{fixed} decisions"),
        ({"layers": "strategies", "max_depth": 3}, cornell(), f"{fixed} layers=strategies"),
        ({"max_depth": 0}, cornell(), "no light subpaths are possible"),
    ):
        integrator = bdpt(**parameters)
        integrator.render(target, spp=4)
        given = integrator.statistics["no_pilot"] or fixed  # of given decisions there is no reason
        assert why.startswith(given) or given.startswith(why)
        assert integrator.statistics["seconds"]["pilot"] == 0


@pytest.mark.parametrize("connections", ["none", "one"])
def test_light_subpaths_have_to_gain(connections):
    """Rationale: predictions are off by some 10 %."""
    light = {"none": SPLATS, "one": CONNECTED}[connections]
    cost, needed = choice.cost(light, RAYS), choice.REQUIRED_GAIN
    for gain, chosen in ((0.99 * needed, False), (1.01 * needed, True)):
        table = choice.choose(made_of({light: 1 / (gain * cost)}), [ALONE, light])
        assert bool(table[0].candidate.light_paths) == chosen


def test_both_errors_count_alike():
    """Rationale: hardly a render has the outliers that light subpaths remove. Expected: a tenth of the mean
    squared error alone counts as a gain of 10^0.5."""
    for hidden, gain in ((0, 10), (9, 10**0.5)):
        found = made_of({ALONE: 10}, hidden={ALONE: hidden})
        errors = {row.candidate: row.error for row in choice.choose(found, [ALONE, SPLATS])}
        assert errors == {ALONE: 1, SPLATS: pytest.approx(1 / gain)}


def test_points_stratify_direct_illumination():
    """Two lamps: the choice is noise that Sobol' points stratify. Expected: `DIRECT` of the variance of path
    tracing, within 2 % for the same samples (the norms of tiles depend on their noise)."""
    lamps = {n: {"type": "point", "position": [x, 2, 0]} for n, x in (("one", -1), ("other", 1))}
    target, found = scene_of(floor=ground(2), **lamps), {}
    for direct in (1.0, pilot.DIRECT):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pilot, "DIRECT", direct)
            found[direct] = piloted(target, 4096, max_depth=2)
    whole, left = (made.errors[0, :, CANDIDATES.index(ALONE)].mean() for made in found.values())
    assert whole > 0.05 and left == pytest.approx(pilot.DIRECT * whole, rel=0.02)


def test_rare_contributions_are_hidden():
    """In 4096 camera samples of 1, one has a contribution of squared size 10^4 that the candidate samples at
    a hundredth of the pilot's rate: 2.4e-6 per sample. Expected: at 64 samples per pixel fewer pixels than
    `TRIMMED` receive it: a typical render lacks its variance, and its light, all in one fine tile; at 640
    nothing."""
    count, rate, size = 4096, 0.01, 100.0
    samples = {name: np.zeros((count, n)) for name, n in moments.SAMPLE.items()}
    samples["estimate"] += 1
    samples["tile"][:, 0] = np.arange(count) * moments.FINE**2 // count
    samples["moment"][0], samples["peak"][0] = rate * size**2, rate * size**4
    splats = moments.split(
        np.zeros(moments.GROUPS * moments.FINE**2 * moments.width(moments.SPLAT)), moments.SPLAT
    )
    inverse = np.ones((2, moments.FINE**2))
    few, many = (
        np.subtract(*moments._errors(samples, splats, inverse, spp)).mean(axis=0) for spp in (64, 640)
    )
    square, fourth = 1 + rate * size**2, 1 + rate * size**4  # with the sample's other contribution
    light = square**1.5 / fourth**0.5 / count
    assert light == pytest.approx(rate * size / count, rel=0.02)
    np.testing.assert_allclose(few, rate * size**2 / count - 64 * light**2 * moments.FINE**2)
    assert not many.any()


def test_guiding_is_not_credited_with_light_subpaths():
    """Expected: light subpaths that raise the typical error 8 times are not chosen with guiding that gains
    nothing."""
    rays = dict.fromkeys((*RAYS, "guidable"), 1e-3)
    found = made_of({ALONE: 20, SPLATS: 8}, rays, hidden={ALONE: 19}, guidable=(0.01, 0.0))
    assert choice.choose(found, [ALONE, SPLATS])[0].candidate == ALONE


def test_no_group_has_less_than_no_variance():
    """Rationale: an estimate of a group's variance may be negative. Expected: it counts as 0."""
    groups = np.full(moments.GROUPS, 2.0)
    groups[3] = -40
    table = choice.choose(made_of({SPLATS: groups}), [ALONE, SPLATS])
    assert table[0].candidate == ALONE
    assert table[1].variance == pytest.approx(2 * 15 / 16)


def test_light_that_only_connections_find():
    """A point lamp in a glass ball. Expected: each candidate has inner connections; without the glass not;
    with a lens in front all trace light."""
    lamp = {"type": "point", "position": [0, 0.6, 0], "intensity": 1.0}
    lens = camera(16, type="thinlens", aperture_radius=0.1, focus_distance=4.0)

    def combinations(**objects):
        render = of(scene_of(16, floor=ground(2), lamp=lamp, **objects))
        found = candidates(render.prepared, render.plan, render.settings)
        return {(c.light_paths > 0, c.connections) for c in found}

    alone, splats, connected = (False, "none"), (True, "none"), (True, "one")
    assert combinations() == {alone, splats, connected}
    assert combinations(ball=BALL) == {connected}
    assert combinations(sensor=lens) == {splats, connected}


def test_all_candidates_are_possible_in_a_plain_scene():
    """Expected: all, none twice; each class is in use from some candidate on, since sums are added to the
    last ones; the last weights strategies as the pilot's samples do."""
    render = of(cornell())
    assert candidates(render.prepared, render.plan, render.settings) == list(CANDIDATES)
    assert len(set(CANDIDATES)) == len(CANDIDATES)
    assert set(CANDIDATES[-1].weights.values()) == {1.0}
    for kind in mis.CLASSES:
        used = [c.weights[kind] > 0 for c in CANDIDATES]
        assert used == sorted(used)


@cache
def brightness_of_the_box():
    return np.array(bdpt(skip="none").render(cornell(64), seed=90, spp=512))[..., :3].mean()


@pytest.mark.parametrize("name", PREDICTED)
def test_decisions_are_unbiased(name):
    """Expected: with any decision the same brightness (means of 2^22 samples: standard error 0.1 %, 0.5 %
    allowed)."""
    target = cornell(64)
    made = decision(PREDICTED[name], mean=0.1)
    if made.light_paths:
        made = replace(made, kappa_light=0.37, kappa_direct=3.3)
    found = np.array(forced(made).render(target, seed=91, spp=1024))[..., :3].mean()
    assert found == pytest.approx(brightness_of_the_box(), rel=0.005)


BLACK = scenes.square(emitter=scenes.area(0.0))
BLINDING = {"type": "point", "position": [0, 3, 0], "intensity": np.inf}
INVALID = "the pilot found only invalid samples (NaN or infinite)"
SEEN = "the pilot found no light but that of emitters which the sensor sees directly"


@pytest.mark.parametrize(
    "make, depth, why",
    [
        (lambda: scene_of(24, lamp=BLACK), 5, "no light subpaths are possible"),
        (lambda: cornell(24), 1, SEEN),
        (lambda: scene_of(24, sky={"type": "constant"}), 5, SEEN),
        (lambda: scene_of(24, lamp=BLINDING, floor=ground(5)), 5, INVALID),
    ],
    ids=["dark", "direct light", "sky", "infinite"],
)
def test_pilots_that_see_nothing_decide_nothing(make, depth, why, monkeypatch):
    monkeypatch.setattr(uniform, "UNIFORM_SAMPLES", 0)
    scene, integrator = make(), bdpt(max_depth=depth)
    integrator.render(scene, spp=1024)
    assert integrator.statistics["decisions"] == [] and integrator.statistics["no_pilot"] == why


def test_recording_counts_in_short_renders():
    """Expected: with half of the variance for a half more per sample light subpaths are taken for a million
    samples, not for 2^16."""
    rays = {"camera": 3.0, "shadow_s1": 1.0, "light": 8.0, "shadow_t1": 4.0, "evaluated": 0.0}
    for samples, lit in ((1 << 20, True), (1 << 16, False)):
        table = choice.choose(made_of({FEW: 0.5}, rays), [ALONE, FEW], samples)
        assert bool(table[0].candidate.light_paths) == lit


def test_confidence():
    """Expected: 1 where all parts of a pilot agree; where one of sixteen has seen what decides, 1 -
    (15/16)^16 = 0.64 (of 100 resamplings: three standard errors of 0.05)."""
    assert choice.confidence(made_of({ALONE: 10}), [ALONE, SPLATS]) == 1
    groups = np.full(moments.GROUPS, 0.5)
    groups[3] = 1e3
    found = choice.confidence(made_of({ALONE: groups}), [ALONE, SPLATS])
    assert found == pytest.approx(0.64, abs=0.15)


def furnace():
    """A sphere lit from its centre: the same radiance everywhere, without noise but for the directions of
    many bounces."""
    view = camera(32, to_world=T().look_at([0, 0, 0.5], [0, 0, -1], [0, 1, 0]))
    wall = {"type": "sphere", "flip_normals": True}
    return scene_of(sensor=view, wall=wall, lamp={"type": "point", "position": [0, 0, 0]})


def test_roulette_follows_the_noise():
    """Expected: with the threshold of a small variance less than half of the image's variance (0.40; a spread
    over 1,024 pixels is known to 5 %), and the same mean within five standard errors."""
    target, renders = furnace(), {}
    usual = decision(FEW, mean=0.3)
    for variance in (1.0, 1e-3):
        integrator = forced(replace(usual, variance=variance), max_depth=-1)
        renders[variance] = np.array(integrator.render(target, seed=1, spp=64))[..., 0].astype(float)
    rouletted, quiet = (np.std(x) / np.mean(x) for x in renders.values())
    assert quiet**2 < 0.5 * rouletted**2
    assert np.mean(renders[1.0]) == pytest.approx(np.mean(renders[1e-3]), rel=5 * rouletted / 32)


@pytest.mark.parametrize(
    "parameters",
    [
        {"light_paths": 0},
        {"light_paths": 0.25, "connections": "one"},
        {"light_paths": 1, "connections": "all", "heuristic": "power"},
        {"skip": "none"},
    ],
    ids=str,
)
def test_loops_are_recorded_once(parameters, capfd):
    """Rationale: a loop whose state holds something that it does not change is recorded twice, which took a
    third of the time of short renders."""
    render, before = of(cornell(8), **parameters), dr.log_level()
    drawn = render.points.of(schedule.Step(0, 0, 1, 1))
    dr.set_log_level(dr.LogLevel.Debug)
    try:
        counts = kernel.trace(render.kernel, sink.Image(render.accumulator), Batch(0, 4, 0, 1), drawn, 1)
        render.accumulator.evaluate(counts)
        if parameters.get("light_paths") != 0:  # else there is nothing to choose
            pilot.measure(render.prepared, render.plan, render.settings, render.points.seed, 64)
    finally:
        dr.set_log_level(before)
    log = "".join(capfd.readouterr())
    assert "created a loop" in log and "re-recording" not in log


def test_rays_of_light_subpaths_are_counted_for_each():
    """Expected: rays per light subpath and camera sample are those of a render with a light subpath for each
    sample, within 3 % (4,096 subpaths of three rays, deviation two: 1 %)."""
    found = piloted(cornell(32), 4096, max_depth=6, rr_depth=100).rays
    integrator = bdpt(max_depth=6, rr_depth=100, skip="none", light_paths=1)
    integrator.render(cornell(32), spp=16)
    counted, samples = integrator.statistics["rays"], 16 * 32 * 32
    for name in ("camera", "light", "shadow_s1", "shadow_t1"):
        assert found[name] == pytest.approx(counted[name] / samples, rel=0.03)


def test_rare_paths_count_in_short_renders_too():
    """Expected: inner connections (without them a render takes 7 and 1.6 times as long for the same trimmed
    error)."""
    chosen = {}
    for name, depth in (("glass_slab", 48), ("cloudy_ball", 48)):
        scene = mi.load_file(str(SCENES / f"{name}.xml"), resolution=128, parallel=False, optimize=False)
        (decision,) = mi.load_dict({"type": "bdpt", "max_depth": depth}).decide(scene, spp=16)
        chosen[name] = decision["light_paths"] > 0, decision["connections"]
    assert chosen["glass_slab"] == chosen["cloudy_ball"] == (True, "one")


def test_pilots_that_do_not_measure_guided_hits():
    """Expected: no moments of guided s = 0, and no such candidate; other moments are the same but for the
    light of these paths in the brightness of a place (up to 18 %)."""
    target = caustic()
    render = of(target)
    light = unsampled_light.guidable(render.prepared, render.plan, render.settings, 64, 0)
    without, found = (piloted(target, 2048, guidable=guidable) for guidable in (None, light))
    np.testing.assert_allclose(without.errors[0], found.errors[0], rtol=0.25)
    assert not any(without.guidable) and all(found.guidable)
    possible = candidates(render.prepared, render.plan, render.settings)
    for one, guided in ((without, False), (found, True)):
        table = choice.choose(one, possible)
        assert any(row.candidate.guided for row in table) == guided


def test_outliers_of_guidable_light_are_in_no_typical_render():
    """Expected: of two tiles of variance 8 the one whose samples fewer than 0.1 % of the pixels have is
    missing from a typical render, which lacks its light."""
    found = moments.GuidableLight(*np.zeros((5, moments.FINE**2)))
    found.second[:2], rates = 4.0, np.array([1e-2, 1e-6])
    found.light[:2], found.fourth[:2] = np.sqrt(found.second[:2] * rates), found.second[:2] ** 2 / rates
    mean, typical = moments._of_guidable(found, np.full(moments.FINE**2, 2.0), 64)
    assert mean == pytest.approx(16)
    assert typical == pytest.approx(8 + 64 * moments.FINE**2 * 2 * found.light[1] ** 2)
