"""The plugin's contract: parameters, errors, passes, seeds, interruptions, statistics.

Noise is kept out where possible: the inside of a glowing unit sphere (radiance and reflectance 1/2) has
exact pixel values for light that is seen directly. Where noise decides, the statistic is named.
"""

import json
import re
from contextlib import nullcontext
from fractions import Fraction
from types import SimpleNamespace

import drjit as dr
import internals
import mitsuba as mi
import mitsuba_bdpt
import numpy as np
import pytest
from mitsuba_bdpt.host import memory
from mitsuba_bdpt.run import schedule
from mitsuba_bdpt.run import statistics as statistics_module
from mitsuba_bdpt.scene.prepared import PreparedScene
from mitsuba_bdpt.transport import techniques
from processes import run
from rendered import same

import scenes

T = mi.ScalarTransform4f


integrator = internals.bdpt


def diffuse():
    return scenes.both_sides(0.5)


def sensor(size=16, spp=4, sampler="independent", rfilter="box", keys=None, **film):
    sampler = {"type": sampler, "sample_count": spp}
    made = scenes.camera(origin=(0, 0, 0.5), target=(0.2, 0.1, -1), near=1e-3, size=size)
    made["film"] |= film | {"rfilter": {"type": rfilter}}
    return made | {"sampler": sampler} | (keys or {})


def glowing_sphere(**keys):
    emitter = scenes.area(0.5)
    wall = {"type": "sphere", "flip_normals": True, "bsdf": diffuse(), "emitter": emitter}
    return scenes.load(sensor=sensor(**keys), wall=wall)


def lamp_in_a_sphere(bsdf=None, intensity=float(np.pi), **keys):
    """Radiance 1 everywhere, 2^-m after m reflections."""
    wall = {"type": "sphere", "bsdf": bsdf or diffuse()}
    return scenes.load(sensor=sensor(**keys), wall=wall, lamp={"type": "point", "intensity": intensity})


def image(bdpt, scene, **keywords):
    return np.array(bdpt.render(scene, **keywords), dtype=np.float64)


# -- parameters -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters, message",
    [
        ({"max_depth": -2}, "max_depth=-2"),
        ({"max_depth": "deep"}, "max_depth='deep'"),
        ({"max_depth": True}, "max_depth=True"),
        ({"rr_depth": 0}, "rr_depth=0"),
        ({"hide_emitters": 1}, "hide_emitters=1"),
        ({"heuristic": "best"}, "heuristic='best'.*balance, power"),
        ({"skip": "all"}, "skip='all'.*auto, impossible, none"),
        ({"light_paths": 3}, "light_paths=3.*1/16"),
        ({"light_paths": "1/0"}, "light_paths='1/0'"),
        ({"connections": "two"}, "connections='two'.*all, one, none"),
        ({"points": "halton"}, "points='halton'.*sobol, independent"),
        ({"spp_per_pass": -1}, "spp_per_pass=-1"),
        ({"timeout": "soon"}, "timeout='soon'"),
        ({"timeout": float("nan")}, "timeout=nan"),
        ({"target_error": -1.0}, "target_error=-1.0 is out of range; it is the relMSE to stop at, or 0"),
        ({"layers": "strategies", "max_depth": 0}, "layers=strategies.*max_depth"),
        ({"merging": "yes"}, "merging='yes'"),
        ({"max_deph": 3}, "max_deph=3 is not a parameter; did you mean max_depth.*rr_depth"),
        ({"skip": [1, 2, 3]}, r"skip=\[1, 2, 3\] must be a string, one of auto"),
        ({"light_paths": [1, 2, 3]}, r"light_paths=\[1, 2, 3\] is not possible; use one of auto, 0"),
        ({"inner": {"type": "path"}}, r"inner \(PathIntegrator\) cannot be nested in it.*take it out"),
    ],
    ids=str,
)
def test_bad_values_are_named(parameters, message):
    with pytest.raises((ValueError, TypeError, RuntimeError), match=f"(?s){message}"):
        integrator(**parameters)


@pytest.mark.parametrize("value", ["auto", 0, 1, 1.0, 0.5, "1/2", "0.25", "1/8", 1 / 16, "1/16"])
def test_light_paths_are_read(value):
    expected = value if value == "auto" else float(Fraction(value))
    assert integrator(light_paths=value).settings.light_paths == expected


@pytest.mark.parametrize("depth, expected", [(0, 0), (1, 0.5), (2, 0.75), (3, 0.875), (-1, 1)])
@pytest.mark.parametrize("skip", ["none", "auto"])
def test_max_depth_counts_edges(depth, expected, skip):
    """Expected: the partial sums of 2^-k, as with `path`. Tolerance: five standard errors of one render."""
    path = mi.load_dict({"type": "path", "max_depth": depth})
    for method in (integrator(max_depth=depth, skip=skip), path):
        assert abs(image(method, glowing_sphere(), spp=256).mean() - expected) <= 0.02 * expected


@pytest.mark.parametrize("rr_depth", [1, 2, 4])
def test_roulette_starts_at_rr_depth(rr_depth):
    """Expected: in the sphere a subpath has r + 2 * 2^-r edges in the mean. Tolerance: five standard errors
    (the number of edges has a variance below 6)."""
    bdpt = integrator(rr_depth=rr_depth, skip="none")
    result = image(bdpt, glowing_sphere(), spp=64)
    n = 16 * 16 * 64
    expected = rr_depth + 2 * 0.5**rr_depth
    rays = bdpt.statistics["rays"]
    assert abs(rays["camera"] / n - expected) < 5 * np.sqrt(6 / n)
    assert abs(rays["light"] / n - expected) < 5 * np.sqrt(6 / n)
    assert abs(result.mean() - 1) < 0.03


def test_light_roulette_does_not_depend_on_the_unit_of_radiance():
    """Rationale: roulette on the throughput itself ends all light subpaths of a dim lamp at once. Tolerance:
    rounding (the threshold of roulette on connections is rounded to powers of two, so skip=none)."""
    images, rays = [], []
    for scale in (1e-6, 1.0, 1e6):
        bdpt = integrator(skip="none", rr_depth=2)
        images.append(image(bdpt, lamp_in_a_sphere(intensity=float(np.pi) * scale), spp=16) / scale)
        rays.append(bdpt.statistics["rays"]["light"])
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3)
    np.testing.assert_allclose(images[2], images[1], rtol=1e-3)
    assert max(rays) - min(rays) < 1e-3 * max(rays)


# -- samples, seeds, sensors ------------------------------------------------------------------


def test_spp_of_zero_is_the_samplers_count():
    scene = lamp_in_a_sphere(spp=6)
    bdpt = integrator(skip="none", max_depth=3)
    a = image(bdpt, scene)
    assert sum(bdpt.statistics["passes"]) == 6
    np.testing.assert_allclose(a, image(bdpt, scene, spp=6), rtol=1e-4)
    with pytest.raises(ValueError, match="spp=-1"):
        bdpt.render(scene, spp=-1)
    with pytest.raises(ValueError, match="spp=0.*sample_count.*'sensor'.*set one of them to 1 or more"):
        bdpt.render(lamp_in_a_sphere(spp=0))


@pytest.mark.parametrize("skip", ["none", "auto"])
def test_seeds(skip):
    """Expected: one seed, one image up to rounding (atomic sums have no fixed order); the noise of different
    seeds is uncorrelated (of 2,304 pixels within five standard deviations)."""
    scene = lamp_in_a_sphere(size=48)
    bdpt = integrator(skip=skip, max_depth=3)
    a, b, c = (image(bdpt, scene, seed=seed, spp=8)[..., 0] for seed in (1, 1, 2))
    np.testing.assert_allclose(a, b, rtol=1e-4)
    assert abs(np.corrcoef(a.ravel(), c.ravel())[0, 1]) < 5 / np.sqrt(a.size)
    d = image(bdpt, scene, seed=mi.UInt32(1), spp=8)[..., 0]
    np.testing.assert_allclose(a, d, rtol=1e-4)


@pytest.mark.parametrize(
    "parameters, spp, most",
    [
        ({"points": "sobol"}, 64, 2e-3),
        ({"points": "independent"}, 64, 2e-3),
        ({"spp_per_pass": 1}, 15, 5e-3),
        ({"spp_per_pass": 7}, 15, 5e-3),
    ],
    ids=str,
)
def test_points_and_passes_are_unbiased(parameters, spp, most):
    """Expected: radiance 7/8 at depth 4 in the lamp's sphere. Statistic: t-test over 12 seeds, five standard
    errors, below 1 %."""
    scene = lamp_in_a_sphere()
    bdpt = integrator(max_depth=4, **parameters)
    means = np.array([image(bdpt, scene, seed=seed, spp=spp).mean() for seed in range(12)])
    assert sum(bdpt.statistics["passes"]) == spp
    error = means.std(ddof=1) / np.sqrt(12)
    assert error < most
    assert abs(means.mean() - 0.875) < 5 * error + (1e-4 if "points" in parameters else 0)


def test_sensor_is_an_index_or_an_object():
    wall, lamp = {"type": "sphere", "bsdf": diffuse()}, {"type": "point", "intensity": 1.0}
    scene = scenes.load(a=sensor(), b=sensor(size=8), wall=wall, lamp=lamp)
    bdpt = integrator(max_depth=2, skip="none")
    by_index = image(bdpt, scene, sensor=1, spp=4)
    by_object = image(bdpt, scene, sensor=scene.sensors()[1], spp=4)
    np.testing.assert_allclose(by_index, by_object, rtol=1e-4)
    assert by_index.shape != image(bdpt, scene, spp=4).shape
    by_mitsuba = mi.render(scene, integrator=bdpt, sensor=1, spp=4)
    np.testing.assert_allclose(np.array(by_mitsuba), by_index, rtol=1e-4)
    with pytest.raises(ValueError, match="sensor=2 does not exist.*2 sensor"):
        bdpt.render(scene, sensor=2)


# -- passes, timeout, interruption ------------------------------------------------------------


@pytest.mark.parametrize("parameters", [{"skip": "none"}, {"skip": "none", "light_paths": 0}], ids=str)
def test_passes_do_not_change_the_image(parameters):
    """Expected: one image up to rounding, without roulette, which takes its scale from the first pass."""
    scene = lamp_in_a_sphere()
    images = []
    for size, expected in ((0, [12]), (1, [1] * 12), (5, [5, 5, 2]), (12, [12]), (99, [12])):
        bdpt = integrator(max_depth=4, spp_per_pass=size, **parameters)
        images.append(image(bdpt, scene, spp=12))
        assert bdpt.statistics["passes"] == expected
    for other in images[1:]:
        np.testing.assert_allclose(other, images[0], rtol=1e-4)


def test_row_bands_equal_one_launch(monkeypatch):
    """An image too large for one launch is cut into bands of rows."""
    scene = lamp_in_a_sphere()
    bdpt = integrator(max_depth=3, skip="none", light_paths=0)
    whole = image(bdpt, scene, spp=4)
    monkeypatch.setattr(schedule, "LAUNCH_SAMPLES", 16 * 3)
    np.testing.assert_allclose(image(bdpt, scene, spp=4), whole, rtol=1e-4)


def test_timeout_stops_after_a_pass(monkeypatch):
    """Expected: after passes of one second the image is normalised by what was done: 0.5 exactly, without
    light subpaths."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(statistics_module, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    for timeout, count in ((2.5, 3), (0, 1), (-1, 10), (100, 10), (float("inf"), 10)):
        bdpt = integrator(max_depth=1, light_paths=0, skip="none", spp_per_pass=1, timeout=timeout)

        def tick(report):
            clock.now += 1

        bdpt.on_pass = tick
        result = image(bdpt, glowing_sphere(), spp=10)
        assert bdpt.statistics["passes"] == [1] * count
        np.testing.assert_allclose(result, 0.5, rtol=1e-5)


@pytest.mark.parametrize("cancel", [False, True])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_interruption_keeps_what_is_done(rfilter, cancel):
    """Expected: after Ctrl-C, and after `cancel`, the film holds two of five passes, normalised (0.5 exactly
    for direct light; with splats 1 within four standard errors), and the next render is whole."""

    def stop(report):
        if report.spp_done >= 8:
            if not cancel:
                raise KeyboardInterrupt
            bdpt.cancel()

    for scene, parameters, expected, tolerance in (
        (glowing_sphere(rfilter=rfilter), {"max_depth": 1, "light_paths": 0}, 0.5, 1e-5),
        (lamp_in_a_sphere(rfilter=rfilter, size=32), {}, 1, 0.05),
    ):
        bdpt = integrator(skip="none", spp_per_pass=4, **parameters)
        bdpt.on_pass = stop
        with nullcontext() if cancel else pytest.raises(KeyboardInterrupt):
            bdpt.render(scene, spp=20)
        assert bdpt.statistics["passes"] == [4, 4]
        result = np.array(scene.sensors()[0].film().develop(), dtype=np.float64)
        assert abs(result.mean() - expected) < tolerance
        bdpt.on_pass = None
        assert abs(image(bdpt, scene, spp=20).mean() - expected) < tolerance
        assert sum(bdpt.statistics["passes"]) == 20


def test_an_interruption_while_a_kernel_is_recorded(monkeypatch):
    """Rationale: Dr.Jit makes a RuntimeError of all that is raised while a pass records its loops. Expected:
    KeyboardInterrupt, the first pass in the film (tolerance: see above), and the next render is whole."""
    original, calls = techniques.splat, []

    def splat(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return original(*arguments)

    scene = lamp_in_a_sphere(size=32)
    bdpt, parameters = integrator(skip="none", spp_per_pass=4), {"seed": 2, "spp": 12}
    with monkeypatch.context() as patch:
        patch.setattr(techniques, "splat", splat)
        with pytest.raises(KeyboardInterrupt):
            bdpt.render(scene, **parameters)
    assert bdpt.statistics["passes"] == [4]
    assert abs(np.array(scene.sensors()[0].film().develop()).mean() - 1) < 0.05
    expected = image(integrator(skip="none", spp_per_pass=4), scene, **parameters)
    np.testing.assert_allclose(image(bdpt, scene, **parameters), expected, rtol=1e-4)


# -- one integrator, many renders -------------------------------------------------------------


def test_scenes_one_after_the_other():
    """Rationale: an integrator's cached state served a second scene (a defect of Mitsuba's own)."""
    a, b = lamp_in_a_sphere(), glowing_sphere()
    bdpt = integrator(max_depth=3, skip="none")
    first = image(bdpt, a, spp=4)
    second = image(bdpt, b, spp=4)
    np.testing.assert_allclose(second, image(integrator(max_depth=3, skip="none"), b, spp=4), rtol=1e-4)
    np.testing.assert_allclose(image(bdpt, a, spp=4), first, rtol=1e-4)
    params = mi.traverse(a)
    key = next(k for k in params.keys() if "intensity" in k)
    params[key] = params[key] * 3
    params.update()
    np.testing.assert_allclose(image(bdpt, a, spp=4), 3 * first, rtol=1e-4)


def test_statistics():
    """Expected: plain values, replaced whole by each render; counts that the scene implies. (Keys and types:
    `test_statistics_are_of_their_declared_type`.)"""
    bdpt = integrator(max_depth=4, skip="none", rr_depth=10)
    bdpt.render(lamp_in_a_sphere(), spp=4)
    first = bdpt.statistics
    json.dumps(first)
    assert set(first["seconds"]) >= {"compile", "pilot", "render", "total"}
    assert first["seconds"]["total"] > 0 and first["peak_memory"] > 0
    n = 16 * 16 * 4
    rays = first["rays"]
    # All edges of camera subpaths up to depth 4; the lamp needs its own edge, so light has 3.
    assert rays["camera"] == 4 * n or rays["camera"] == 3 * n
    assert rays["light"] == 3 * n
    assert rays["shadow_s1"] == 3 * n
    # Pairs (y, z) with at most 4 edges: (1,1), (1,2), (2,1); all are lit inside a sphere.
    connections = first["connections"]
    assert connections["traced"] == rays["shadow_inner"] == 3 * n
    assert connections["rouletted"] == 0
    assert connections["evaluated"] == connections["traced"] + connections["zero"]
    assert first["passes"] == [4] and first["non_finite"] == 0
    bdpt.render(lamp_in_a_sphere(), spp=2)
    assert bdpt.statistics is not first
    assert bdpt.statistics["passes"] == [2]
    assert bdpt.statistics["rays"]["shadow_s1"] == first["rays"]["shadow_s1"] / 2


class Poison(mi.BSDF):
    """Diffuse, but a sampled direction's weight is NaN for a quarter of the samples."""

    def __init__(self, props):
        super().__init__(props)
        self.inner = mi.load_dict(diffuse())
        self.m_flags = self.inner.flags()
        self.m_components = [self.m_flags]

    def sample(self, ctx, si, u1, u2, active=True):
        bs, weight = self.inner.sample(ctx, si, u1, u2, active)
        bs.pdf = dr.select(u1 < 0.25, dr.nan, bs.pdf)
        return bs, dr.select(u1 < 0.25, dr.nan, weight)

    def eval(self, *arguments):
        return self.inner.eval(*arguments)

    def pdf(self, *arguments):
        return self.inner.pdf(*arguments)

    def eval_pdf(self, *arguments):
        return self.inner.eval_pdf(*arguments)

    def to_string(self):
        return "Poison[]"


@pytest.mark.parametrize("light_paths", [0, 1])
def test_walks_without_a_finite_throughput_are_counted(light_paths):
    """Expected: of camera subpaths a quarter ends at the first vertex, of the rest a quarter at the second
    (7/16); of light subpaths, which end an edge earlier, a quarter. Tolerance: five standard errors."""
    mi.register_bsdf("spoiled", Poison)
    scene = lamp_in_a_sphere(bsdf={"type": "spoiled"})
    bdpt = integrator(max_depth=3, skip="none", light_paths=light_paths, points="independent")
    result = image(bdpt, scene, spp=64)
    assert np.isfinite(result).all() and result.max() > 0
    expected = (7 / 16 + light_paths / 4) * 64 * 16 * 16
    assert abs(bdpt.statistics["non_finite"] - expected) < 0.05 * expected


RECOMPILED = """
import sys, mitsuba_bdpt, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
change, skip, size, spp = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "gaussian"}}
wall = {"type": "sphere", "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}}
sensor = {"type": "perspective", "film": film}
scene = mi.load_dict({"type": "scene", "wall": wall, "lamp": {"type": "point"}, "sensor": sensor})
bdpt = mi.load_dict({"type": "bdpt", "max_depth": 4, "skip": skip})
params, seed = mi.traverse(scene), 1
bdpt.render(scene, spp=spp, seed=seed)
first = bdpt.statistics["kernels"]["compiled"]
exec(change)
params.update()
bdpt.render(scene, spp=spp, seed=seed)
print(first, bdpt.statistics["kernels"]["compiled"])
"""


def compiled_for(folder, change, skip="impossible", size=16, spp=4):
    """How many kernels a second render compiles after ``change`` (Python code) with an empty cache."""
    found = run(RECOMPILED, change, skip, str(size), str(spp), DRJIT_CACHE_DIR=str(folder))
    first, second = (int(x) for x in found.split())
    assert first > 0
    return second


@pytest.mark.parametrize(
    "change",
    [
        "spp, seed = 9, 2",
        "spp = 20_000",
        "params['lamp.position'] = mi.Point3f(0.1, 0.2, 0.3)",
        "params['sensor.film.size'] = [600, 900]",
        "params['sensor.to_world'] = mi.Transform4f().look_at([0, 0.2, 0.4], [0, 0, -1], [0, 1, 0])",
    ],
)
def test_no_recompilation(tmp_path, change):
    """Rationale: literals in a kernel compile it anew, 0.3 to 1 s each time."""
    assert compiled_for(tmp_path, change) == 0


LAMPS = """
import mitsuba_bdpt, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
T = mi.ScalarTransform4f
def lamp(x):
    place = T().translate([x, 1, 0]).rotate([1, 0, 0], 90).scale(0.4)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}
for offset, count in ((0, 40), (5, 40)):
    scene = {"type": "scene", "floor": {"type": "sphere"}, "sensor": {"type": "perspective", "film": {
        "type": "hdrfilm", "width": 16, "height": 16}}}
    scene = mi.load_dict(scene | {f"lamp{i}": lamp(offset + i) for i in range(count)})
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 4, "skip": "impossible"})
    bdpt.render(scene, spp=4)
    print(bdpt.statistics["kernels"]["compiled"])
"""


def test_lamps_share_their_code(tmp_path):
    """Rationale: rectangles hold their place as constants, so that each lamp is a function of its own in a
    kernel (300 lamps: 5.7 s to the first image instead of 2)."""
    first, second = (int(x) for x in run(LAMPS, DRJIT_CACHE_DIR=str(tmp_path)).split())
    assert first >= 1 and second == 0


@pytest.mark.parametrize("change", ["spp = 90", "params['sensor.film.size'] = [80, 72]"])
def test_no_recompilation_with_a_pilot(tmp_path, change):
    assert compiled_for(tmp_path, change, skip="auto", size=64, spp=64) == 0


@pytest.mark.parametrize(
    "scene, parameters, words",
    [
        (lamp_in_a_sphere, {"max_depth": 1}, ["no emitter that a ray can hit", "allows no such path"]),
        (glowing_sphere, {}, ["camera subpaths per light subpath: 16", "(one)"]),
        (glowing_sphere, {"light_paths": 0}, ["light_paths=0", "no light subpaths"]),
        (glowing_sphere, {"connections": "none"}, ["connections=none"]),
        (glowing_sphere, {"hide_emitters": True}, ["hide_emitters"]),
        (glowing_sphere, {"skip": "none"}, ["limited: paths of more than 64 edges use s=0 and s=1 only"]),
        (lambda: scenes.load(sensor=sensor()), {}, ["no emitter"]),
    ],
)
def test_explain(scene, parameters, words):
    text = integrator(**parameters).explain(scene(), sensor=0)
    assert all(word in text for word in words), text
    if parameters == {"skip": "none"}:
        for name in ("s=0", "s=1", "t=1", "(1,1)", "inner connections s,t>=2 (all)"):
            assert any(line.startswith(f"used: {name}") for line in text.splitlines()), name


BEAM = {"type": "rectangle", "emitter": {"type": "directionalarea", "radiance": 1.0}}
GLASS_LAMP = {"type": "point"}
METER = {"type": "rectangle"}


@pytest.mark.parametrize(
    "lamp, area, parameters, expected",
    [
        (GLASS_LAMP, False, {}, ["SDS: no connectible edge"]),
        (GLASS_LAMP, False, {"light_paths": 0}, ["needs t=1", "needs inner", "SDS"]),
        (GLASS_LAMP, False, {"connections": "none"}, ["needs inner", "SDS"]),
        (GLASS_LAMP, True, {}, []),
        (
            GLASS_LAMP,
            True,
            {"light_paths": 0},
            ["t=1", "inner", "SDS", "t=0", r"emitter - sensor .needs \(1,1\)"],
        ),
        (BEAM, False, {}, []),
        (BEAM, False, {"light_paths": 0}, ["directionalarea.*needs t=1", "directionalarea.*needs inner"]),
        (BEAM, False, {"connections": "none"}, ["directionalarea.*needs inner"]),
        (BEAM, True, {"light_paths": 0}, ["needs t=1", "needs inner", "directionalarea - sensor .needs t=0"]),
    ],
)
def test_explain_says_what_is_lost(lamp, area, parameters, expected):
    """Expected: a line for each sort of path that no strategy in use can make, and no other. A glass ball
    stands beside a lamp; the directional area, which no camera ray finds, has no glass."""
    eye = {"meter": METER | {"sensor": scenes.meter()}} if area else {"eye": sensor()}
    ball = {"type": "sphere", "bsdf": {"type": "dielectric"} if lamp is GLASS_LAMP else diffuse()}
    wall = {"type": "sphere", "radius": 3, "bsdf": diffuse()}
    scene = scenes.load(lamp=lamp, ball=ball, wall=wall, **eye)
    text = integrator(max_depth=32, **parameters).explain(scene)
    lost = [line for line in text.splitlines() if line.startswith("not sampled: ")]
    assert len(lost) == len(expected), text
    for line, pattern in zip(lost, expected, strict=True):
        assert re.search(pattern, line), text


def test_null_surfaces_hide_no_light():
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5}

    def lost(surface):
        ball = {"type": "sphere", "bsdf": {"type": surface}}
        eye = sensor() | {"medium": fog}
        wall = {"type": "sphere", "radius": 3, "bsdf": diffuse()}
        scene = scenes.load(lamp=GLASS_LAMP, ball=ball, wall=wall, eye=eye)
        return integrator(max_depth=32).explain(scene).count("not sampled: ")

    assert lost("dielectric") == 1 and lost("null") == 0


def test_connections_that_are_zero_are_those_of_either_way():
    """Expected: as many whether all light vertices are connected or one is drawn, with a ball in the way."""
    lamp = {"type": "point", "position": [0, 1.5, 0]}
    ball = {"type": "sphere", "bsdf": diffuse(), "to_world": mi.ScalarTransform4f().scale(0.5)}
    wall = {"type": "sphere", "radius": 3, "bsdf": diffuse(), "flip_normals": True}
    scene = scenes.load(lamp=lamp, ball=ball, wall=wall, eye=sensor())
    found = []
    for connections in ("all", "one"):
        bdpt = integrator(max_depth=5, light_paths=1, connections=connections)
        bdpt.render(scene, seed=1, spp=16)
        found.append(bdpt.statistics["connections"])
    assert found[0]["evaluated"] == found[1]["evaluated"] > 0
    assert found[0]["zero"] == found[1]["zero"] < found[0]["evaluated"]
    assert found[0]["traced"] == found[0]["evaluated"] - found[0]["zero"]


# -- strategy images --------------------------------------------------------------------------


def test_strategy_images_name_every_strategy():
    bdpt = integrator(max_depth=3, layers="strategies", skip="none")
    names = bdpt.aov_names()
    expected = {
        f"{kind}.s{s}t{k + 1 - s}.{c}"
        for kind in ("weighted", "unweighted")
        for k in (1, 2, 3)
        for s in range(k + 2)
        for c in "RGB"
    }
    assert set(names) == expected and len(names) == len(expected)
    result = image(bdpt, glowing_sphere(), spp=8)
    assert result.shape == (16, 16, 3 + len(names))
    total = sum(
        result[..., 3 + i] for i, n in enumerate(names) if n.startswith("weighted") and n.endswith("R")
    )
    np.testing.assert_allclose(total, result[..., 0], rtol=1e-4, atol=1e-5)
    assert integrator(max_depth=3).aov_names() == []


# -- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("width", "height", "words"),
    [
        (0, 8, "of 0 x 8 has no pixels"),
        (8, 0, "of 8 x 0 has no pixels"),
        (1 << 16, 1 << 14, "of 65536 x 16384 pixels takes about 192 GiB of memory"),
        (100_000, 100_000, "of 100000 x 100000 pixels takes .* crop windows"),
    ],
)
def test_films_that_are_refused(width, height, words):
    """No pixels, or sums beyond memory or indices of 32 bits. A crop window of a large film is fine."""
    with pytest.raises(ValueError, match=f"bdpt: the film {words}"):
        integrator().render(glowing_sphere(width=width, height=height), spp=1)
    if width > 1000:
        crop = {"crop_offset_x": 500, "crop_width": 4, "crop_offset_y": 600, "crop_height": 3}
        scene = glowing_sphere(width=width, height=height, **crop)
        assert image(integrator(), scene, spp=1).shape == (3, 4, 3)


@pytest.mark.parametrize("parameters", [{"skip": "none"}, {}], ids=["all", "default"])
def test_gradients_of_any_scene_do_not_matter(parameters):
    """Rationale: virtual calls visit emitters of other scenes too; one with gradients made Dr.Jit raise."""
    scene, other = lamp_in_a_sphere(size=16), lamp_in_a_sphere(size=16)
    bdpt = integrator(max_depth=4, **parameters)
    plain = image(bdpt, scene, spp=16)
    for touched in (other, scene):
        params = mi.traverse(touched)
        names = list(params.keys())
        key = next(name for name in names if name.endswith(("radiance.value", "intensity.value")))
        dr.enable_grad(params[key])
        params.update()
        assert same(image(bdpt, scene, spp=16), plain)


def test_layers_count_among_what_a_film_takes(monkeypatch):
    """Expected: on a machine that has memory for the film alone, features and `variance` raise an error."""
    monkeypatch.setattr(memory, "available", lambda: memory.Available(300 * 64 * 64, "the machine's memory"))
    monkeypatch.setattr("mitsuba_bdpt.image.film_limits.SMALL", 0)
    scene = glowing_sphere(size=64)
    assert image(integrator(), scene, spp=8).shape == (64, 64, 3)
    for more in ({"layers": "variance"}, {"aovs": "a:albedo,n:sh_normal,p:position,x:dp_du,y:dp_dv"}):
        with pytest.raises(ValueError, match="the film of 64 x 64 pixels takes .* GiB .the machine's memory"):
            integrator(**more).render(scene, spp=8)


def test_scenes_that_are_refused():
    bdpt = integrator()
    density = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2, 1), dtype=np.float32))}
    fog = {"type": "homogeneous", "id": "fog", "sigma_t": density}
    cloud = {"type": "sphere", "bsdf": {"type": "null"}, "interior": fog}
    for scene in (
        scenes.load(sensor=sensor(), lamp={"type": "point"}, cloud=cloud),
        grouped(cloud=cloud),
    ):
        with pytest.raises(NotImplementedError, match="sigma_t of class GridVolume.*heterogeneous"):
            bdpt.render(scene)
        with pytest.raises(NotImplementedError, match="heterogeneous"):
            bdpt.explain(scene)
    with pytest.raises(ValueError, match="no sensor"):
        bdpt.render(scenes.load(lamp={"type": "point"}))


@pytest.mark.parametrize("call", ["render", "explain", "decide"])
@pytest.mark.parametrize("scene", ["a.xml", {"type": "scene"}, None])
def test_what_is_not_yet_a_scene_is_loaded_first(call, scene):
    with pytest.raises(TypeError, match="must be a scene, of mi.load_file or mi.load_dict"):
        getattr(integrator(), call)(scene)


def test_parameters_cannot_be_set_later():
    """Expected: an error that says where parameters belong; documented attributes, and those of users'
    subclasses, can be set."""
    bdpt = mi.load_dict({"type": "bdpt"})
    for name, value in (("merging", True), ("max_depth", 3), ("hide_emitters", True)):
        with pytest.raises(AttributeError, match=rf"load_dict\({{'type': 'bdpt', '{name}': {value}}}\)"):
            setattr(bdpt, name, value)
    assert not bdpt.settings.hide_emitters and not bdpt.hide_emitters
    with pytest.raises(AttributeError, match="max_dept cannot be set.*did you mean max_depth"):
        bdpt.max_dept = 3
    bdpt.on_pass, bdpt.statistics = print, {"passes": []}

    class Own(type(bdpt)):
        def __init__(self, props):
            super().__init__(props)
            self.mine = 1

    mi.register_integrator("own_bdpt", Own)
    own = mi.load_dict({"type": "own_bdpt", "max_depth": 4})
    assert (own.mine, own.max_depth) == (1, 4)
    with pytest.raises(AttributeError, match="merging"):
        own.merging = True


def grouped(**shapes):
    """A scene with an instance of a group of ``shapes``."""
    group = {"type": "shapegroup", **shapes}
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    return scenes.load(sensor=sensor(), lamp={"type": "point"}, group=group, instance=instance)


def test_materials_in_groups_are_known():
    """Expected: BSDFs of shapes in groups count, the one that Mitsuba gives to every instance does not."""
    mixture = {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "plastic"}}
    for bsdf, smooth, delta, refracts in (
        ({"type": "dielectric"}, False, True, True),
        ({"type": "conductor"}, False, True, False),
        ({"type": "roughdielectric"}, True, False, True),
        (mixture, True, True, False),
    ):
        scene = grouped(ball={"type": "sphere", "bsdf": bsdf})
        world = PreparedScene(scene, scene.sensors()[0])
        assert (world.smooth, world.delta, world.refracts) == (smooth, delta, refracts), bsdf["type"]
        assert world.traits.full_pdf == (bsdf is mixture)


def curve(folder):
    """A file of one B-spline curve."""
    file = folder / "curve.txt"
    file.write_text("".join(f"{x} 0 0 0.1\n" for x in range(5)))
    return {"type": "bsplinecurve", "filename": str(file)}


def meter_on(shape, **film):
    meter = scenes.meter()
    return {"meter": shape | {"sensor": meter | {"film": meter["film"] | film}}}


def lamp_on(kind, **keys):
    return {"lamp": {"type": kind, "emitter": scenes.area(1.0)} | keys}


def placed(kind, to_world, **keys):
    return {"lamp": {"type": kind, "to_world": to_world} | keys}


GAUSSIAN = {"rfilter": {"type": "gaussian"}, "sample_border": True}
STRETCHED = T().scale([1, 2, 1])
MIRRORED = T().scale([1, 1, -1])
# The columns are of length 1.
LONG_AXIS = T().rotate([1, 1, 1], 40)  # shears, and its inverse is wrong
GRID = {"type": "sdfgrid", "grid": mi.TensorXf(np.arange(-3, 5).reshape(2, 2, 2, 1))}
GROUP = {"type": "shapegroup", "box": {"type": "cube"}}
BOXES = {"type": "instance", "to_world": LONG_AXIS, "group": {"type": "ref", "id": "group"}}
BATCH = {"type": "batch", "film": {"type": "hdrfilm"} | GAUSSIAN, "a": {"type": "perspective"}}
SKY = {"bitmap": mi.Bitmap(np.ones((4, 8, 3), dtype=np.float32))}
AXIS = ".*give rotate an axis of length 1"

# Parts of a scene, or a function of a folder that makes them, and the error.
REFUSED_PARTS = {
    "curve lamp": (
        lambda folder: {"lamp": curve(folder) | {"emitter": scenes.area(1.0)}},
        "emitter '.*' is on a curve .*use a cylinder or a mesh",
    ),
    "mirrored cylinder": (lamp_on("cylinder", to_world=MIRRORED), "'lamp'.* mirrors it.*the negative scale"),
    "meter on a mirrored cylinder": (
        meter_on({"type": "cylinder", "to_world": MIRRORED}),
        "irradiance meter '.*' is on a cylinder .*'meter'.* mirrors it.*flip_normals turns normals",
    ),
    "sphere turned about a long axis": (
        lamp_on("sphere", to_world=LONG_AXIS),
        f"emitter '.*' is on a sphere .*'lamp'.* whose to_world {AXIS}",
    ),
    "instance turned about a long axis": (
        {"group": GROUP, "boxes": BOXES},
        "to_world of instance 'boxes' has another inverse .* different surfaces.* axis of length 1",
    ),
    "cylinder turned about a long axis": (placed("cylinder", LONG_AXIS), f"cylinder 'lamp' .*{AXIS}"),
    "grid turned about a long axis": ({"ball": GRID | {"to_world": LONG_AXIS}}, f"sdfgrid 'ball' .*{AXIS}"),
    "squashed cylinder": (lamp_on("cylinder", to_world=STRETCHED), "squashes or shears it .*1, 2, 1.*mesh"),
    "ellipsoid": (lamp_on("sphere", to_world=STRETCHED), "'lamp'.* stretches or shears .*1, 2, 1.*mesh"),
    "meter on a sheared disk": (meter_on({"type": "disk", "to_world": LONG_AXIS}), f"'meter'.*{AXIS}"),
    "projector": (placed("projector", STRETCHED), "projector 'lamp' distorts angles .*1, 2, 1.*set fov"),
    "long spot": (placed("spot", T().scale([1, 1, 2])), "'lamp' distorts angles .*1, 1, 2.*set cutoff_angle"),
    "narrow spot": (
        {"lamp": {"type": "spot", "cutoff_angle": 0.013}},
        "spot 'lamp' has cutoff_angle=0.013, a cone without width .*make it 0.02 degrees or more",
    ),
    "sunsky": (placed("sunsky", STRETCHED), "sunsky 'lamp' is not a rotation .*leave out scaling"),
    "sheared envmap": (placed("envmap", T().rotate([1, 2, 3], 77), **SKY), "'lamp' is not a rotation"),
    "batch border": ({"eye": BATCH}, "film of batch sensor 'eye' has sample_border.*set it to false"),
    "meter border": (meter_on({"type": "disk"}, **GAUSSIAN), "meter '.*' has sample_border.*set it to false"),
    "meter on a grid": (meter_on(GRID), "irradiance meter '.*' is on a SDFGrid.*put it on another shape"),
}


@pytest.mark.parametrize("name", REFUSED_PARTS)
def test_endpoints_that_are_refused(name, tmp_path):
    parts, message = REFUSED_PARTS[name]
    parts = parts(tmp_path) if callable(parts) else parts
    if not {"eye", "meter"} & parts.keys():
        parts = {"eye": sensor()} | parts
    scene = scenes.load(**parts)
    with pytest.raises((NotImplementedError, ValueError), match=message):
        integrator().render(scene, spp=1)


def test_mirrored_shapes_that_are_fine():
    """Only cylinders have contradicting normals, and only where their points are sampled."""
    turned = lamp_on("cylinder", to_world=T().rotate([1, 0, 0], 180).scale(0.1))
    parts = turned | {
        "eye": sensor(),
        "pipe": {"type": "cylinder", "to_world": MIRRORED},
        "flipped": turned["lamp"] | {"flip_normals": True},
        "backwards": lamp_on("cylinder", p0=[0, 0, 1], p1=[0, 0, 0.5])["lamp"],
    }
    for kind in ("rectangle", "disk", "sphere", "cube"):
        parts[kind] = lamp_on(kind, to_world=MIRRORED)["lamp"]
    assert np.isfinite(image(integrator(max_depth=2), scenes.load(**parts), spp=1)).all()


@pytest.mark.parametrize(
    "positions, face, normals, words",
    [
        # Mitsuba reads beyond its memory.
        (
            [0, 0, 0, 1, 0, 0, 0, 1, 0],
            [0, 1, 3],
            [0, 0, 1, 0, 1, 0, 0, 0, 1],
            "'mesh' has a face with vertex 3 of 3",
        ),
        # An infinite density.
        ([0, 0, 0, 0, 0, 0, 1, 0, 0], [0, 1, 2], None, "is on a shape without area"),
    ],
    ids=["face of no vertex", "no area"],
)
def test_broken_emitting_meshes_are_refused(positions, face, normals, words):
    props = mi.Properties()
    props["emitter"] = mi.load_dict({"type": "area"})
    mesh = mi.Mesh("triangle", 3, 1, has_vertex_normals=normals is not None, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = [float(x) for x in positions], face
    if normals:
        params["vertex_normals"] = [float(x) for x in normals]
    params.update()
    with pytest.raises(ValueError, match=words):
        integrator().render(scenes.load(sensor=sensor(), mesh=mesh), spp=1)


def test_derivatives_are_refused():
    scene, bdpt = lamp_in_a_sphere(), integrator()
    for call in (
        lambda: bdpt.render_forward(scene, None),
        lambda: bdpt.render_backward(scene, None, None),
    ):
        with pytest.raises(NotImplementedError, match="prb"):
            call()


@pytest.mark.parametrize("method", ["render", "decide", "explain"])
def test_frozen_functions_are_refused_in_words(method):
    """Expected: as within a function under dr.freeze, which sets this flag."""
    scene, bdpt = glowing_sphere(), integrator(max_depth=2)
    flag, words = dr.JitFlag.FreezingScope, "dr.freeze is not supported.*call render outside"
    with dr.scoped_set_flag(flag, True), pytest.raises(NotImplementedError, match=words):
        getattr(bdpt, method)(scene, spp=1)


def test_variants():
    """Expected: scalar variants raise an error; all others of this machine render the sphere (radiance 1)."""
    seen = []
    for variant in mi.variants():
        if variant.startswith("cuda"):
            continue
        mi.set_variant(variant)
        if variant.startswith("scalar"):
            with pytest.raises((NotImplementedError, RuntimeError), match="not supported.*llvm_ad_rgb"):
                mi.load_dict({"type": "bdpt"})
        else:
            intensity = {"type": "uniform", "value": float(np.pi)} if mi.is_spectral else float(np.pi)
            bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
            scene = lamp_in_a_sphere(bsdf, intensity)
            result = np.array(mi.load_dict({"type": "bdpt"}).render(scene, spp=256))
            expected = 1
            if mi.is_spectral:  # a flat spectrum is not white in sRGB
                path = mi.load_dict({"type": "path"})
                expected = np.array(path.render(scene, spp=256)).mean()
            assert abs(result.mean() / expected - 1) < 0.05, variant
            seen.append(variant)
    assert {"llvm_ad_rgb", "llvm_ad_spectral_polarized"} <= set(seen)


# -- registration -----------------------------------------------------------------------------


def test_registration_after_the_variant_is_set():
    """Plugins are registered per variant. (A process of its own.)"""
    script = """import mitsuba as mi
for variant in ("llvm_ad_rgb", "scalar_rgb", "llvm_ad_rgb"):
    mi.set_variant(variant)
    import mitsuba_bdpt
print(type(mi.load_dict({"type": "bdpt"})).__name__)"""
    found = run(script, DRJIT_LIBLLVM_PATH=str(mitsuba_bdpt.llvm_choice.path))
    assert found.strip() == "BDPTIntegrator"


# -- what users try ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lightImage", "sampleDirect"])
def test_scene_files_of_mitsuba_06_are_told_what_became_of_parameters(name):
    text = f'<boolean name="{name}" value="false"/>'
    with pytest.raises(RuntimeError, match=r"is not a parameter; it is of Mitsuba 0\.6"):
        mi.load_string(f'<scene version="0.6.0"><integrator type="bdpt">{text}</integrator></scene>')


def test_numpy_integers_are_integers():
    scene, bdpt = glowing_sphere(), integrator(max_depth=1)
    expected = image(bdpt, scene, spp=2, seed=7)
    given = image(bdpt, scene, spp=np.int32(2), seed=np.uint32(7), sensor=np.int64(0))
    np.testing.assert_allclose(given, expected, rtol=1e-5)
    for name in ("spp", "sensor", "seed"):
        with pytest.raises(TypeError, match=f"{name}=.*True"):
            bdpt.render(scene, **{"spp": 2, name: np.bool_(True)})


def test_another_variant_is_refused_in_words():
    scene, bdpt = glowing_sphere(), integrator(max_depth=1)
    mi.set_variant("llvm_ad_mono")
    with pytest.raises(TypeError, match="integrator=.*load it again after mi.set_variant"):
        bdpt.render(scene, spp=1)
    with pytest.raises(TypeError, match="scene=.*load it again after mi.set_variant"):
        integrator(max_depth=1).render(scene, spp=1)


def test_passes_are_short_under_a_timeout(monkeypatch):
    """Expected: after the first pass of one sample in one second (a clock of our own), 0.2 s of it
    compilation, passes of a tenth of 40 seconds: 4 / 0.8 = 5 samples, then 4 · 6 / 5.8 = 4."""
    bdpt = integrator(max_depth=2, timeout=40.0)
    clock = [0.0]
    compilation = [
        {"type": dr.KernelType.JIT, "cache_hit": False, "codegen_time": 50.0, "backend_time": 150.0}
    ]
    monkeypatch.setattr(statistics_module.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(dr, "kernel_history", lambda: [compilation.pop()] if compilation else [])
    bdpt.on_pass = lambda report: clock.__setitem__(0, float(report.spp_done))
    bdpt.render(lamp_in_a_sphere(), spp=1000)
    passes = bdpt.statistics["passes"]
    assert passes[:3] == [1, 5, 4] and 40 <= sum(passes) <= 44


def test_many_samples_per_pixel_keep_their_precision():
    """Rationale: a float32 sum of 2^20 samples is off by 6e-4 or more. Tolerance: 2^12 are summed at a time;
    n positive numbers lose at most n 2^-24 in any order."""
    scene = scenes.load(sensor=sensor(size=1), sky={"type": "constant", "radiance": 0.7})
    result = image(integrator(max_depth=1, light_paths=0), scene, spp=1 << 20)
    np.testing.assert_allclose(result, 0.7, rtol=2.0**-12)


@pytest.mark.parametrize("strategy_images", [False, True])
def test_a_small_lamp_keeps_its_light_however_many_splats_it_has(strategy_images):
    """Rationale: by (1,1) all light subpaths of a pass may fall on one pixel, and 2^21 equal numbers added in
    single precision are off by 0.3 %. Expected: one pass of 2^21 samples gives the image of 64 of 2^15.
    Tolerance: camera samples are summed in single precision, 512 in a pixel."""
    to_world = T().look_at([0.02, 0.015, -1], [0, 0, 4], [0, 1, 0]).scale(0.005)
    lamp = {"type": "disk", "to_world": to_world, "emitter": scenes.area(400.0)}
    scene = scenes.load(sensor=sensor(size=64), lamp=lamp)
    keys = {"max_depth": 1, "skip": "none", "layers": "strategies" if strategy_images else ""}
    one, many = (image(integrator(spp_per_pass=n, **keys), scene, spp=512) for n in (512, 8))
    assert 0 < (one[..., 0] > 1).sum() < 5
    np.testing.assert_allclose(one, many, rtol=1e-4, atol=1e-5)
