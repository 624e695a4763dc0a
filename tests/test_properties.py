"""The plugin's contract: parameters, errors, passes, seeds, interruptions, statistics.

Noise is kept out where possible: the inside of a glowing unit sphere (radiance and reflectance 1/2) has
exact pixel values for light that is seen directly. Where noise decides, the statistic is named.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import internals
import mitsuba as mi
import mitsuba_bdpt
import numpy as np
import pytest
import scene_parts as parts
from mitsuba_bdpt.host import memory
from mitsuba_bdpt.properties import check_variant
from mitsuba_bdpt.run import schedule
from mitsuba_bdpt.run import statistics as statistics_module
from mitsuba_bdpt.scene.prepared import PreparedScene
from mitsuba_bdpt.transport import techniques
from rendered import same

T = mi.ScalarTransform4f


def integrator(**parameters):
    return internals.bdpt(**parameters)


def diffuse(reflectance=0.5):
    return {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [reflectance] * 3}},
    }


def sensor(size=16, spp=4, sampler="independent", keys=None, **film):
    return {
        "type": "perspective",
        "fov": 60,
        "near_clip": 1e-3,
        "to_world": T().look_at([0, 0, 0.5], [0.2, 0.1, -1], [0, 1, 0]),
        "sampler": {"type": sampler, "sample_count": spp},
        "film": parts.film(size, **film),
    } | (keys or {})


def glowing_sphere(**keys):
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(**keys),
            "wall": {
                "type": "sphere",
                "flip_normals": True,
                "bsdf": diffuse(),
                "emitter": {"type": "area", "radiance": 0.5},
            },
        }
    )


def lamp_in_a_sphere(bsdf=None, **keys):
    """Radiance 1 everywhere, 2^-m after m reflections."""
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(**keys),
            "wall": {"type": "sphere", "bsdf": bsdf or diffuse()},
            "lamp": {"type": "point", "intensity": float(np.pi)},
        }
    )


def image(bdpt, scene, **keywords):
    return np.array(bdpt.render(scene, **keywords), dtype=np.float64)


# -- parameters -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters, message",
    [
        ({"max_depth": -2}, "max_depth=-2"),
        ({"max_depth": 1.5}, "max_depth=1.5"),
        ({"max_depth": "deep"}, "max_depth='deep'"),
        ({"max_depth": True}, "max_depth=True"),
        ({"rr_depth": 0}, "rr_depth=0"),
        ({"hide_emitters": 1}, "hide_emitters=1"),
        ({"heuristic": "best"}, "heuristic='best'.*balance, power"),
        ({"skip": "all"}, "skip='all'.*auto, impossible, none"),
        ({"light_paths": 3}, "light_paths=3.*1/16"),
        ({"light_paths": "1/3"}, "light_paths='1/3'"),
        ({"light_paths": "many"}, "light_paths='many'"),
        ({"light_paths": "1/0"}, "light_paths='1/0'"),
        ({"light_paths": -1}, "light_paths=-1"),
        ({"connections": "two"}, "connections='two'.*all, one, none"),
        ({"points": "halton"}, "points='halton'.*sobol, independent"),
        ({"spp_per_pass": -1}, "spp_per_pass=-1"),
        ({"timeout": "soon"}, "timeout='soon'"),
        ({"timeout": float("nan")}, "timeout=nan"),
        ({"layers": "strategies"}, "layers=strategies.*max_depth"),
        ({"layers": "strategies", "max_depth": 0}, "layers=strategies.*max_depth"),
        ({"merging": "yes"}, "merging='yes'"),
        ({"max_deph": 3}, "max_deph=3 is not a parameter; did you mean max_depth.*rr_depth"),
        ({"samples_per_pass": 3}, "samples_per_pass=3.*use spp_per_pass"),
        ({"lightImage": False}, "lightImage=False is not a parameter; it is of Mitsuba 0.6.*light_paths=0"),
        ({"light_image": False}, "light_image=False is not a parameter; it is of Mitsuba 0.6.*light_paths=0"),
        ({"sampleDirect": True}, "sampleDirect=True is not a parameter; it is of Mitsuba 0.6.*always.*leave"),
        (
            {"sample_direct": True},
            "sample_direct=True is not a parameter; it is of Mitsuba 0.6.*always.*leave",
        ),
        ({"light_paths": "1/"}, "light_paths='1/'.*1/16"),
        ({"light_paths": "nan"}, "light_paths='nan'"),
        ({"skip": 3}, "skip=3 must be a string, one of auto"),
        ({"skip": [1, 2, 3]}, r"skip=\[1, 2, 3\] must be a string, one of auto"),
        ({"light_paths": [1, 2, 3]}, r"light_paths=\[1, 2, 3\] must be a number or 'auto'"),
        ({"inner": {"type": "path"}}, r"inner \(PathIntegrator\) cannot be nested in it.*take it out"),
    ],
    ids=str,
)
def test_bad_values_are_named(parameters, message):
    """Expected: an error that names the parameter and the value, and what can be used instead."""
    with pytest.raises((ValueError, TypeError, RuntimeError), match=f"(?s){message}"):
        integrator(**parameters)


@pytest.mark.parametrize("value", ["auto", 0, 1, 1.0, 0.5, "1/2", "0.25", "1/8", 1 / 16, "1/16"])
def test_light_paths_are_read(value):
    """Expected: numbers and fractions alike."""
    settings = integrator(light_paths=value).settings
    assert settings.light_paths == "auto" or settings.light_paths in (0, 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)


def test_defaults():
    """The contract's defaults, and that printing shows the parameters."""
    bdpt = integrator()
    s = bdpt.settings
    assert (bdpt.max_depth, bdpt.rr_depth, s.hide_emitters, s.heuristic) == (-1, 5, False, "balance")
    assert (s.skip, s.light_paths, s.connections, s.points) == ("auto", "auto", "auto", "sobol")
    assert (s.layers, s.spp_per_pass, s.timeout) == ((), 0, -1)
    assert bdpt.statistics == {}
    assert "max_depth = -1" in str(integrator()) and "skip = none" in str(integrator(skip="none"))


@pytest.mark.parametrize("depth, expected", [(0, 0), (1, 0.5), (2, 0.75), (3, 0.875), (-1, 1)])
@pytest.mark.parametrize("skip", ["none", "auto"])
def test_max_depth_counts_edges(depth, expected, skip):
    """Expected: the partial sums of 2^-k, as with `path`; depth 0 is exactly black. Tolerance: 2 %, some
    five standard errors of one render.
    """
    result = image(integrator(max_depth=depth, skip=skip), glowing_sphere(), spp=256)
    assert abs(result.mean() - expected) <= 0.02 * expected
    path = image(mi.load_dict({"type": "path", "max_depth": depth}), glowing_sphere(), spp=256)
    assert abs(path.mean() - expected) <= 0.02 * expected


@pytest.mark.parametrize("rr_depth", [1, 2, 4])
def test_roulette_starts_at_rr_depth(rr_depth):
    """Rationale: both subpaths play roulette from `rr_depth` on, as `path` does. In the sphere of
    reflectance 1/2 a subpath has r + 2 * 2^-r edges in the mean. Expected: the counted rays.
    Tolerance: five standard errors (the number of edges has a variance below 6).
    """
    bdpt = integrator(rr_depth=rr_depth, skip="none")
    result = image(bdpt, glowing_sphere(), spp=64)
    n = 16 * 16 * 64
    expected = rr_depth + 2 * 0.5**rr_depth
    rays = bdpt.statistics["rays"]
    assert abs(rays["camera"] / n - expected) < 5 * np.sqrt(6 / n)
    assert abs(rays["light"] / n - expected) < 5 * np.sqrt(6 / n)
    assert abs(result.mean() - 1) < 0.03


def test_light_roulette_does_not_depend_on_the_unit_of_radiance():
    """Rationale: roulette on the throughput itself ends all light subpaths of a dim lamp at once; noise
    must not depend on the unit. Expected: radiance x 1e-6 and x 1e6 give the same image times that, pixel
    by pixel, up to rounding (1e-3: the threshold of roulette on connections is rounded to powers of two, so
    skip=none here), and the same number of rays.
    """
    images, rays = [], []
    for scale in (1e-6, 1.0, 1e6):
        scene = mi.load_dict(
            {
                "type": "scene",
                "sensor": sensor(),
                "wall": {"type": "sphere", "bsdf": diffuse()},
                "lamp": {"type": "point", "intensity": float(np.pi) * scale},
            }
        )
        bdpt = integrator(skip="none", rr_depth=2)
        images.append(image(bdpt, scene, spp=16) / scale)
        rays.append(bdpt.statistics["rays"]["light"])
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3)
    np.testing.assert_allclose(images[2], images[1], rtol=1e-3)
    assert max(rays) - min(rays) < 1e-3 * max(rays)


# -- samples, seeds, sensors ------------------------------------------------------------------


def test_spp_of_zero_is_the_samplers_count():
    """Expected: the sampler's sample_count, in the statistics and in the image."""
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
    """Expected: the same seed gives the same image up to rounding (1e-4: atomic sums have no fixed
    order); the noise of different seeds is uncorrelated. Statistic: correlation of 2,304 pixels, five
    standard deviations.
    """
    scene = lamp_in_a_sphere(size=48)
    bdpt = integrator(skip=skip, max_depth=3)
    a, b, c = (image(bdpt, scene, seed=seed, spp=8)[..., 0] for seed in (1, 1, 2))
    np.testing.assert_allclose(a, b, rtol=1e-4)
    assert abs(np.corrcoef(a.ravel(), c.ravel())[0, 1]) < 5 / np.sqrt(a.size)
    d = image(bdpt, scene, seed=mi.UInt32(1), spp=8)[..., 0]
    np.testing.assert_allclose(a, d, rtol=1e-4)


@pytest.mark.parametrize("points", ["sobol", "independent"])
def test_points_are_unbiased(points):
    """Expected: every kind of points gives radiance 7/8 at depth 4 in the lamp's sphere. Statistic: t-test
    over 12 seeds, five standard errors, below 1 %.
    """
    scene = lamp_in_a_sphere()
    bdpt = integrator(points=points, max_depth=4)
    means = np.array([image(bdpt, scene, seed=seed, spp=64).mean() for seed in range(12)])
    error = means.std(ddof=1) / np.sqrt(12)
    assert error < 2e-3
    assert abs(means.mean() - 0.875) < 5 * error + 1e-4


def test_sensor_is_an_index_or_an_object():
    """Expected: both name the same view; another index another view; a wrong one is named."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "a": sensor(),
            "b": sensor(size=8),
            "wall": {"type": "sphere", "bsdf": diffuse()},
            "lamp": {"type": "point", "intensity": 1.0},
        }
    )
    bdpt = integrator(max_depth=2, skip="none")
    by_index = image(bdpt, scene, sensor=1, spp=4)
    by_object = image(bdpt, scene, sensor=scene.sensors()[1], spp=4)
    np.testing.assert_allclose(by_index, by_object, rtol=1e-4)
    assert by_index.shape != image(bdpt, scene, spp=4).shape
    np.testing.assert_allclose(
        np.array(mi.render(scene, integrator=bdpt, sensor=1, spp=4)), by_index, rtol=1e-4
    )
    with pytest.raises(ValueError, match="sensor=2 does not exist.*2 sensor"):
        bdpt.render(scene, sensor=2)


def test_results_may_stay_in_the_film():
    """Expected: develop=False returns an empty tensor and leaves the image in the film; evaluate=False
    returns the same values.
    """
    scene = lamp_in_a_sphere()
    bdpt = integrator(max_depth=2, skip="none")
    a = image(bdpt, scene, spp=4)
    empty = bdpt.render(scene, spp=4, develop=False)
    assert np.array(empty).size == 0
    film = scene.sensors()[0].film()
    np.testing.assert_allclose(np.array(film.develop()), a, rtol=1e-4)
    np.testing.assert_allclose(np.array(film.bitmap()), a, rtol=1e-4)
    np.testing.assert_allclose(image(bdpt, scene, spp=4, evaluate=False), a, rtol=1e-4)


def test_users_sampler_is_left_as_it_was():
    """Expected: the numbers that the sensor's sampler gives after a render are those it would have given
    without, and its sample_count is unchanged.
    """
    scene = lamp_in_a_sphere(sampler="stratified", spp=9)
    sampler = scene.sensors()[0].sampler()
    sampler.seed(3, 64)
    sampler.next_1d()
    expected = np.array(sampler.next_2d())
    sampler.seed(3, 64)
    sampler.next_1d()
    integrator(max_depth=2).render(scene, spp=4)
    assert sampler.sample_count() == 9
    np.testing.assert_array_equal(np.array(sampler.next_2d()), expected)


def test_crop_window_is_the_region_of_the_whole():
    """Expected: with default parameters too, a crop has the region's radiance: 1. The noise of splats
    differs, for a crop has light subpaths of its own. Tolerance: 2 %, five standard errors of 8
    renders of 96 pixels.
    """
    scene = lamp_in_a_sphere(crop_offset_x=3, crop_offset_y=2, crop_width=12, crop_height=8)
    means = [image(integrator(), scene, seed=seed, spp=256) for seed in range(8)]
    assert means[0].shape == (8, 12, 3)
    assert abs(np.mean(means) - 1) < 0.02


# -- passes, timeout, interruption ------------------------------------------------------------


@pytest.mark.parametrize("parameters", [{"skip": "none"}, {"skip": "none", "light_paths": 0}], ids=str)
def test_passes_do_not_change_the_image(parameters):
    """Rationale: passes continue one point sequence. Expected: without roulette, which takes its scale
    from the first pass, 12 samples cut into passes of 1, 5 or 12 give the same image up to rounding (1e-4),
    and the statistics name the passes.
    """
    scene = lamp_in_a_sphere()
    images = []
    for size, expected in ((0, [12]), (1, [1] * 12), (5, [5, 5, 2]), (12, [12]), (99, [12])):
        bdpt = integrator(max_depth=4, spp_per_pass=size, **parameters)
        images.append(image(bdpt, scene, spp=12))
        assert bdpt.statistics["passes"] == expected
    for other in images[1:]:
        np.testing.assert_allclose(other, images[0], rtol=1e-4)


def test_passes_with_roulette_are_unbiased():
    """Expected: radiance 7/8 however a render is cut. Statistic: t-test over 12 seeds, five standard
    errors, below 1 %.
    """
    scene = lamp_in_a_sphere()
    for size in (1, 7):
        bdpt = integrator(max_depth=4, spp_per_pass=size)
        means = np.array([image(bdpt, scene, seed=seed, spp=15).mean() for seed in range(12)])
        assert sum(bdpt.statistics["passes"]) == 15
        error = means.std(ddof=1) / np.sqrt(12)
        assert error < 5e-3
        assert abs(means.mean() - 0.875) < 5 * error


def test_row_bands_equal_one_launch(monkeypatch):
    """Rationale: an image too large for one launch is cut into bands of rows. Expected: the camera
    side is the same up to rounding (1e-4).
    """
    scene = lamp_in_a_sphere()
    bdpt = integrator(max_depth=3, skip="none", light_paths=0)
    whole = image(bdpt, scene, spp=4)
    monkeypatch.setattr(schedule, "LAUNCH_SAMPLES", 16 * 3)
    np.testing.assert_allclose(image(bdpt, scene, spp=4), whole, rtol=1e-4)


class Clock:
    """A clock that a pass advances by one second."""

    def __init__(self):
        self.now = 100.0

    def perf_counter(self):
        return self.now


def test_timeout_stops_after_a_pass(monkeypatch):
    """Expected: with passes of one second and a timeout of 2.5 seconds three passes are done, the result is
    normalised by what was done (0.5 exactly, without light subpaths), and timeout=0 does one pass.
    """
    clock = Clock()
    monkeypatch.setattr(statistics_module, "time", SimpleNamespace(perf_counter=clock.perf_counter))
    for timeout, count in ((2.5, 3), (0, 1), (-1, 10), (100, 10), (float("inf"), 10)):
        bdpt = integrator(max_depth=1, light_paths=0, skip="none", spp_per_pass=1, timeout=timeout)

        def tick(report):
            clock.now += 1

        bdpt.on_pass = tick
        result = image(bdpt, glowing_sphere(), spp=10)
        assert bdpt.statistics["passes"] == [1] * count
        np.testing.assert_allclose(result, 0.5, rtol=1e-5)


def test_progress_is_reported():
    """Expected: one report per pass, with growing samples, seconds and rays."""
    reports = []
    bdpt = integrator(max_depth=2, skip="none", spp_per_pass=2)
    bdpt.on_pass = reports.append
    bdpt.render(lamp_in_a_sphere(), spp=6)
    assert [(r.spp_done, r.spp_total) for r in reports] == [(2, 6), (4, 6), (6, 6)]
    assert 0 < reports[0].rays < reports[1].rays < reports[2].rays
    assert 0 < reports[0].seconds < reports[2].seconds


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_interruption_keeps_what_is_done(rfilter):
    """Rationale: Ctrl-C arrives between passes. Expected: KeyboardInterrupt is raised again, the film
    holds the first two of five passes correctly normalised (0.5 exactly for direct light; with splats
    the radiance 1 within 5 %, four standard errors), statistics say so, and the next render is whole.
    """

    def interrupt(report):
        if report.spp_done >= 8:
            raise KeyboardInterrupt

    for scene, parameters, expected, tolerance in (
        (glowing_sphere(rfilter=rfilter), {"max_depth": 1, "light_paths": 0}, 0.5, 1e-5),
        (lamp_in_a_sphere(rfilter=rfilter, size=32), {}, 1, 0.05),
    ):
        bdpt = integrator(skip="none", spp_per_pass=4, **parameters)
        bdpt.on_pass = interrupt
        with pytest.raises(KeyboardInterrupt):
            bdpt.render(scene, spp=20)
        assert bdpt.statistics["passes"] == [4, 4]
        result = np.array(scene.sensors()[0].film().develop(), dtype=np.float64)
        assert abs(result.mean() - expected) < tolerance
        bdpt.on_pass = None
        assert abs(image(bdpt, scene, spp=20).mean() - expected) < tolerance
        assert sum(bdpt.statistics["passes"]) == 20


def test_an_interruption_while_a_kernel_is_recorded(monkeypatch):
    """Rationale: every pass records its loops anew, and Dr.Jit makes a RuntimeError of all that is raised
    there; the command took that for a mistake and wrote no image. Expected: KeyboardInterrupt, and the first
    of the passes (radiance 1 within 5 %, see above) in the film; the next render is whole, the same as by an
    integrator that was not interrupted, up to rounding.
    """
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
    """Rationale: state cached on an integrator serves a second scene the first one's (a defect of
    Mitsuba's own). Expected: rendering scene B after A gives what a fresh integrator gives; and an edited
    scene is seen as edited.
    """
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


def test_moving_lamp_and_camera_are_seen():
    """Expected: after an edit of positions through mi.traverse the image is that of a scene built so."""

    def scene(lamp, eye):
        return mi.load_dict(
            {
                "type": "scene",
                "wall": {"type": "sphere", "bsdf": diffuse()},
                "sensor": sensor(keys={"to_world": T().look_at(eye, [0, 0, -1], [0, 1, 0])}),
                "lamp": {"type": "point", "position": lamp, "intensity": 1.0},
            }
        )

    bdpt = integrator(max_depth=3, skip="none")
    moved = scene([0, 0, 0], [0, 0, 0.5])
    bdpt.render(moved, spp=1)
    params = mi.traverse(moved)
    for key in params.keys():
        if key.endswith("position"):
            params[key] = mi.Point3f(0.3, 0.2, 0.1)
        if key.endswith("sensor.to_world"):
            params[key] = mi.Transform4f().look_at([0, 0.2, 0.4], [0, 0, -1], [0, 1, 0])
    params.update()
    built = scene([0.3, 0.2, 0.1], [0, 0.2, 0.4])
    np.testing.assert_allclose(image(bdpt, moved, spp=8), image(bdpt, built, spp=8), rtol=2e-3, atol=1e-4)


KEYS = {
    "seconds",
    "rays",
    "connections",
    "skipped",
    "decisions",
    "passes",
    "non_finite",
    "kernels",
    "peak_memory",
}


def test_statistics():
    """Expected: the contract's keys and types, plain values only (JSON can hold them), replaced whole by
    each render; counts that the scene implies.
    """
    bdpt = integrator(max_depth=4, skip="none", rr_depth=10)
    bdpt.render(lamp_in_a_sphere(), spp=4)
    first = bdpt.statistics
    assert set(first) >= KEYS
    json.dumps(first)
    assert set(first["seconds"]) >= {"compile", "pilot", "render", "total"}
    assert first["seconds"]["total"] > 0
    n = 16 * 16 * 4
    rays = first["rays"]
    assert set(rays) >= {"camera", "light", "shadow_s1", "shadow_t1", "shadow_inner"}
    # All edges of camera subpaths up to depth 4; the lamp needs its own edge, so light has 3.
    assert rays["camera"] == 4 * n or rays["camera"] == 3 * n
    assert rays["light"] == 3 * n
    assert rays["shadow_s1"] == 3 * n
    assert set(first["connections"]) >= {"evaluated", "zero", "rouletted", "traced"}
    # Pairs (y, z) with at most 4 edges: (1,1), (1,2), (2,1); all are lit inside a sphere.
    connections = first["connections"]
    assert connections["traced"] == rays["shadow_inner"] == 3 * n
    assert connections["rouletted"] == 0
    assert connections["evaluated"] == connections["traced"] + connections["zero"]
    assert first["passes"] == [4] and first["non_finite"] == 0
    assert set(first["kernels"]) >= {"compiled", "cached"}
    assert first["peak_memory"] > 0
    assert all(set(s) >= {"class", "level", "why"} for s in first["skipped"])
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

    def eval(self, ctx, si, wo, active=True):
        return self.inner.eval(ctx, si, wo, active)

    def pdf(self, ctx, si, wo, active=True):
        return self.inner.pdf(ctx, si, wo, active)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.inner.eval_pdf(ctx, si, wo, active)

    def to_string(self):
        return "Poison[]"


@pytest.mark.parametrize("light_paths", [0, 1])
def test_walks_without_a_finite_throughput_are_counted(light_paths):
    """Rationale: what is not finite counts as zero, and the user is told how often. Expected: a BSDF
    that spoils a quarter of the sampled directions leaves a finite image, and `non_finite` counts
    every such walk: of the camera's a quarter lost at the first vertex, of the rest a quarter at the second,
    no third (7/16 of 64 per pixel); of light subpaths, which end an edge earlier, a quarter. Tolerance: 5 %,
    five standard errors of the count.
    """
    mi.register_bsdf("spoiled", Poison)
    scene = lamp_in_a_sphere(bsdf={"type": "spoiled"})
    bdpt = integrator(max_depth=3, skip="none", light_paths=light_paths, points="independent")
    result = image(bdpt, scene, spp=64)
    assert np.isfinite(result).all() and result.max() > 0
    expected = (7 / 16 + light_paths / 4) * 64 * 16 * 16
    assert abs(bdpt.statistics["non_finite"] - expected) < 0.05 * expected


def compiled_for(tmp_path, change, skip="impossible", size=16, spp=4):
    """How many kernels a second render compiles after ``change`` (Python code) with an empty cache."""
    script = f"""
import mitsuba_bdpt, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict({{
    "type": "scene", "wall": {{"type": "sphere", "bsdf": {{"type": "twosided", "b": {{"type": "diffuse"}}}}}},
    "lamp": {{"type": "point"}},
    "sensor": {{"type": "perspective", "film": {{
        "type": "hdrfilm", "width": {size}, "height": {size}, "rfilter": {{"type": "gaussian"}}}}}}}})
bdpt = mi.load_dict({{"type": "bdpt", "max_depth": 4, "skip": "{skip}"}})
params = mi.traverse(scene)
spp, seed = {spp}, 1
bdpt.render(scene, spp=spp, seed=seed)
first = bdpt.statistics["kernels"]["compiled"]
{change}
params.update()
bdpt.render(scene, spp=spp, seed=seed)
print(first, bdpt.statistics["kernels"]["compiled"])
"""
    environment = os.environ | {"DRJIT_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    first, second = (int(x) for x in done.stdout.split())
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
    """Rationale: literals in a kernel compile it anew, 0.3 to 1 s each time. Expected: spp, seed,
    positions and the film's size are run-time values. (A process of its own with an empty kernel cache.)
    """
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
    kernel (300 lamps: 5.7 s to the first image instead of 2). Expected: what was compiled for some serves as
    many in other places."""
    environment = os.environ | {"DRJIT_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", LAMPS], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    first, second = (int(x) for x in done.stdout.split())
    assert first >= 1 and second == 0


@pytest.mark.parametrize("change", ["spp = 90", "params['sensor.film.size'] = [80, 72]"])
def test_no_recompilation_with_a_pilot(tmp_path, change):
    """Expected: the same with default parameters and a pilot, whose lanes follow the number of samples."""
    assert compiled_for(tmp_path, change, skip="auto", size=64, spp=64) == 0


def test_explain():
    """Expected: the strategies in use, what is skipped and why, what is lost."""
    text = integrator(max_depth=1).explain(lamp_in_a_sphere())
    assert "no emitter that a ray can hit" in text and "max_depth=1 allows no such path" in text
    text = integrator(skip="none").explain(glowing_sphere())
    for name in ("s=0", "s=1", "t=1", "(1,1)", "inner connections s,t>=2 (all)"):
        assert any(line.startswith(f"used: {name}") for line in text.splitlines()), name
    assert "limited: paths of more than 64 edges use s=0 and s=1 only" in text
    text = integrator().explain(glowing_sphere(), sensor=0)
    assert "camera subpaths per light subpath: 16" in text and "(one)" in text
    text = integrator(light_paths=0).explain(glowing_sphere())
    assert "light_paths=0" in text and "no light subpaths" in text
    text = integrator(connections="none").explain(glowing_sphere())
    assert "connections=none" in text
    text = integrator(hide_emitters=True).explain(glowing_sphere())
    assert "hide_emitters" in text
    scene = mi.load_dict({"type": "scene", "sensor": sensor()})
    assert "no emitter" in integrator().explain(scene)
    glass = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(),
            "lamp": {"type": "point"},
            "ball": {"type": "sphere", "bsdf": {"type": "dielectric"}},
            "wall": {"type": "sphere", "radius": 3, "bsdf": diffuse()},
        }
    )
    assert "not sampled: " in integrator(light_paths=0).explain(glass)


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
            ["needs t=1", "needs inner", "SDS", "needs t=0", r"delta emitter - sensor .needs \(1,1\)"],
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
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    eye = (
        {"meter": METER | {"sensor": {"type": "irradiancemeter", "film": film}}}
        if area
        else {"eye": sensor()}
    )
    ball = {"type": "sphere", "bsdf": {"type": "dielectric"} if lamp is GLASS_LAMP else diffuse()}
    wall = {"type": "sphere", "radius": 3, "bsdf": diffuse()}
    scene = mi.load_dict({"type": "scene", "lamp": lamp, "ball": ball, "wall": wall, **eye})
    text = integrator(max_depth=32, **parameters).explain(scene)
    lost = [line for line in text.splitlines() if line.startswith("not sampled: ")]
    assert len(lost) == len(expected), text
    for line, pattern in zip(lost, expected, strict=True):
        assert re.search(pattern, line), text


def test_null_surfaces_hide_no_light():
    """Expected: of a point light in fog beside a ball SDS paths are not sampled if the ball is of glass, and
    nothing is missing if its surface is null."""
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5}

    def lost(surface):
        ball = {"type": "sphere", "bsdf": {"type": surface}}
        eye = sensor() | {"medium": fog}
        wall = {"type": "sphere", "radius": 3, "bsdf": diffuse()}
        scene = mi.load_dict({"type": "scene", "lamp": GLASS_LAMP, "ball": ball, "wall": wall, "eye": eye})
        return integrator(max_depth=32).explain(scene).count("not sampled: ")

    assert lost("dielectric") == 1 and lost("null") == 0


def test_connections_that_are_zero_are_those_of_either_way():
    """Rationale: what a connection adds is counted as zero before its ray is traced, whoever adds up the
    others. Expected: exactly as many whether all light vertices are joined or one is drawn, on the same
    subpaths; and a ball in the way, so that some of the others are not visible.
    """
    lamp = {"type": "point", "position": [0, 1.5, 0]}
    ball = {"type": "sphere", "bsdf": diffuse(), "to_world": mi.ScalarTransform4f().scale(0.5)}
    wall = {"type": "sphere", "radius": 3, "bsdf": diffuse(), "flip_normals": True}
    scene = mi.load_dict({"type": "scene", "lamp": lamp, "ball": ball, "wall": wall, "eye": sensor()})
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
    """Expected: weighted and unweighted RGB layers for each (s, t) up to max_depth, k + 2 of each length
    k, in the film and in aov_names(); weighted ones add up to the image (1e-4).
    """
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


def test_strategy_images_check_their_memory():
    """Expected: refused in words before anything is rendered."""
    bdpt = integrator(max_depth=30, layers="strategies")
    with pytest.raises(ValueError, match="2048x2048 with max_depth=30 needs about .* GiB"):
        bdpt.render(glowing_sphere(size=2048), spp=1)


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
    """Rationale: none has a pixel, or its sums are more than the machine has memory for, or than Dr.Jit's
    indices of 32 bits can count. Expected: said before anything is rendered; a small crop window of a large
    film is fine."""
    with pytest.raises(ValueError, match=f"bdpt: the film {words}"):
        integrator().render(glowing_sphere(width=width, height=height), spp=1)
    if width > 1000:
        crop = {"crop_offset_x": 500, "crop_width": 4, "crop_offset_y": 600, "crop_height": 3}
        scene = glowing_sphere(width=width, height=height, **crop)
        assert image(integrator(), scene, spp=1).shape == (3, 4, 3)


@pytest.mark.parametrize("parameters", [{"skip": "none"}, {}], ids=["all", "default"])
def test_gradients_of_any_scene_do_not_matter(parameters):
    """Rationale: virtual calls visit emitters of other scenes too; one with gradients made Dr.Jit refuse
    local memory in its own words. Expected: the image as without, also if the scene itself has some."""
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


def test_gradients_do_not_matter_to_what_is_told():
    """Rationale: as above. Expected: what `decide`, `explain` and `assemble` give is the same with gradients
    as without, also where a pilot is asked (2^17 samples)."""
    scene, bdpt = lamp_in_a_sphere(size=16), integrator(max_depth=4)
    kept = []
    bdpt.on_pass = lambda report: kept.append(report.snapshot())
    bdpt.render(scene, spp=1)
    bdpt.on_pass = None

    def told():
        image = np.array(bdpt.assemble(kept[0], scene))
        return bdpt.decide(scene, spp=512), bdpt.explain(scene, spp=512), image.tolist()

    plain = told()
    assert "pilot:" in plain[1]
    params = mi.traverse(scene)
    dr.enable_grad(params["lamp.intensity.value"])
    params.update()
    assert told() == plain


def test_layers_count_among_what_a_film_takes(monkeypatch):
    """Rationale: features add to the sums of camera samples, `variance` keeps sums and images of its own.
    Expected: on a machine that has room for the film alone, each of them is refused in words."""
    monkeypatch.setattr(memory, "available", lambda: memory.Available(300 * 64 * 64, "the machine's memory"))
    scene = glowing_sphere(size=64)
    assert image(integrator(), scene, spp=8).shape == (64, 64, 3)
    for more in ({"layers": "variance"}, {"aovs": "a:albedo,n:sh_normal,p:position,x:dp_du,y:dp_dv"}):
        with pytest.raises(
            ValueError, match="bdpt: the film of 64 x 64 pixels takes .* GiB .the machine's memory.; render"
        ):
            integrator(**more).render(scene, spp=8)


def test_scenes_that_are_refused():
    """Expected: one sentence that names the object and what to do."""
    bdpt = integrator()
    density = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2, 1), dtype=np.float32))}
    fog = {"type": "homogeneous", "id": "fog", "sigma_t": density}
    cloud = {"type": "sphere", "bsdf": {"type": "null"}, "interior": fog}
    for scene in (
        mi.load_dict({"type": "scene", "sensor": sensor(), "lamp": {"type": "point"}, "cloud": cloud}),
        grouped({"cloud": cloud}),
    ):
        with pytest.raises(NotImplementedError, match="sigma_t of class GridVolume.*heterogeneous"):
            bdpt.render(scene)
        with pytest.raises(NotImplementedError, match="heterogeneous"):
            bdpt.explain(scene)
    empty = mi.load_dict({"type": "scene", "lamp": {"type": "point"}})
    with pytest.raises(ValueError, match="no sensor"):
        bdpt.render(empty)


@pytest.mark.parametrize("call", ["render", "explain", "decide"])
def test_what_is_not_yet_a_scene_is_loaded_first(call):
    """Expected: the function of Mitsuba that loads it, not another variant."""
    unloaded = (("a.xml", "load_file"), (Path("a.xml"), "load_file"), ({"type": "scene"}, "load_dict"))
    for scene, remedy in (*unloaded, (None, "must be a scene"), (mi.load_dict(diffuse()), "BSDF must")):
        with pytest.raises(TypeError, match=remedy):
            getattr(integrator(), call)(scene)


def test_parameters_cannot_be_set_later():
    """Rationale: they were accepted, and ignored. Expected: an error that says where they belong, also of the
    base class's `hide_emitters` and of names that do not exist; other attributes as documented, and those of
    users' subclasses, can be set."""
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


def grouped(shapes):
    """A scene with an instance of a group of ``shapes``."""
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(),
            "lamp": {"type": "point"},
            "group": {"type": "shapegroup", **shapes},
            "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        }
    )


def test_materials_in_groups_are_known():
    """Rationale: what a scene's BSDFs do decides which densities are asked for and which paths are possible.
    Expected: those of shapes in groups count, the one that Mitsuba gives to every instance does not."""
    mixture = {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "plastic"}}
    for bsdf, smooth, delta, refracts in (
        ({"type": "dielectric"}, False, True, True),
        ({"type": "conductor"}, False, True, False),
        ({"type": "roughdielectric"}, True, False, True),
        (mixture, True, True, False),
    ):
        scene = grouped({"ball": {"type": "sphere", "bsdf": bsdf}})
        world = PreparedScene(scene, scene.sensors()[0])
        assert (world.smooth, world.delta, world.refracts) == (smooth, delta, refracts), bsdf["type"]
        assert world.traits.full_pdf == (bsdf is mixture)


def curve(folder):
    """A file of one B-spline curve."""
    file = folder / "curve.txt"
    file.write_text("".join(f"{x} 0 0 0.1\n" for x in range(5)))
    return {"type": "bsplinecurve", "filename": str(file)}


def meter_on(shape, **film):
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}} | film
    return shape | {"sensor": {"type": "irradiancemeter", "film": film}}


AREA_LIGHT = {"type": "area", "radiance": 1.0}
GAUSSIAN = {"rfilter": {"type": "gaussian"}, "sample_border": True}
STRETCHED = mi.ScalarTransform4f().scale([1, 2, 1])
MIRRORED = mi.ScalarTransform4f().scale([1, 1, -1])
# The columns are of length 1.
SHEARED = mi.ScalarTransform4f([[1, 0.6, 0, 0], [0, 0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
LONG_AXIS = mi.ScalarTransform4f().rotate([1, 1, 1], 40)  # shears, and its inverse is wrong
GRID = {"type": "sdfgrid", "grid": mi.TensorXf(np.arange(-3, 5).reshape(2, 2, 2, 1))}

REFUSED_PARTS = {
    "curve lamp": (
        lambda folder: {"lamp": curve(folder) | {"emitter": AREA_LIGHT}},
        "emitter '.*' is on a curve .*use a cylinder or a mesh",
    ),
    "mesh of ellipsoids": (
        lambda _: {
            "lamp": {
                "type": "ellipsoidsmesh",
                "centers": mi.TensorXf(np.zeros((1, 3), dtype=np.float32)),
                "scales": mi.TensorXf(np.full((1, 3), 0.3, dtype=np.float32)),
                "quaternions": mi.TensorXf(np.array([[0, 0, 0, 1]], dtype=np.float32)),
                "emitter": AREA_LIGHT,
            }
        },
        "emitter '.*' is on a shape that Mitsuba does not name .*use shape type ellipsoids, or a mesh",
    ),
    "mirrored cylinder": (
        lambda _: {"lamp": {"type": "cylinder", "to_world": MIRRORED, "emitter": AREA_LIGHT}},
        "emitter '.*' is on a cylinder .*'lamp'.* mirrors it.*leave out the negative scale",
    ),
    "mirrored cylinder of beams": (
        lambda _: {
            "lamp": {"type": "cylinder", "to_world": MIRRORED, "emitter": {"type": "directionalarea"}}
        },
        "emitter '.*' is on a cylinder .*'lamp'.* mirrors it",
    ),
    "meter on a mirrored cylinder": (
        lambda _: {"meter": meter_on({"type": "cylinder", "to_world": MIRRORED})},
        "irradiance meter '.*' is on a cylinder .*'meter'.* mirrors it.*flip_normals turns normals",
    ),
    **{
        f"{kind} turned about a long axis": (
            lambda _, kind=kind: {"lamp": {"type": kind, "to_world": LONG_AXIS, "emitter": AREA_LIGHT}},
            f"emitter '.*' is on a {kind} .*'lamp'.* whose to_world .*give rotate an axis of length 1",
        )
        for kind in ("rectangle", "disk", "sphere")
    },
    "instance turned about a long axis": (
        lambda _: {
            "group": {"type": "shapegroup", "box": {"type": "cube"}},
            "boxes": {"type": "instance", "to_world": LONG_AXIS, "group": {"type": "ref", "id": "group"}},
        },
        "to_world of instance 'boxes' has another inverse .* different surfaces.* axis of length 1",
    ),
    "cylinder turned about a long axis": (
        lambda _: {"post": {"type": "cylinder", "to_world": LONG_AXIS}},
        "to_world of cylinder 'post' has another inverse .*give rotate an axis of length 1",
    ),
    "grid turned about a long axis": (
        lambda _: {"ball": GRID | {"to_world": LONG_AXIS}},
        "to_world of sdfgrid 'ball' has another inverse .*give rotate an axis of length 1",
    ),
    "squashed cylinder": (
        lambda _: {"lamp": {"type": "cylinder", "to_world": STRETCHED, "emitter": AREA_LIGHT}},
        "is on a cylinder .*'lamp'.* squashes or shears it .*1, 2, 1.* or use a mesh",
    ),
    "ellipsoid": (
        lambda _: {"lamp": {"type": "sphere", "to_world": STRETCHED, "emitter": AREA_LIGHT}},
        "is on a sphere .*'lamp'.* stretches or shears it .*1, 2, 1.* or use a mesh",
    ),
    "meter on a sheared disk": (
        lambda _: {"meter": meter_on({"type": "disk", "to_world": LONG_AXIS})},
        "irradiance meter '.*' is on a disk .*'meter'.* give rotate an axis of length 1",
    ),
    "projector": (
        lambda _: {"lamp": {"type": "projector", "to_world": STRETCHED}},
        "to_world of projector 'lamp' distorts angles .*1, 2, 1.*set fov instead",
    ),
    "stretched spot": (
        lambda _: {"lamp": {"type": "spot", "to_world": STRETCHED}},
        "to_world of spot 'lamp' distorts angles .*1, 2, 1.*set cutoff_angle instead",
    ),
    "long spot": (
        lambda _: {"lamp": {"type": "spot", "to_world": mi.ScalarTransform4f().scale([1, 1, 2])}},
        "to_world of spot 'lamp' distorts angles .*1, 1, 2.*set cutoff_angle instead",
    ),
    "sheared spot": (
        lambda _: {"lamp": {"type": "spot", "to_world": SHEARED}},
        "to_world of spot 'lamp' distorts angles .*leave out scaling and shear",
    ),
    "narrow spot": (
        lambda _: {"lamp": {"type": "spot", "cutoff_angle": 0.013}},
        "spot 'lamp' has cutoff_angle=0.013, a cone without width .*make it 0.02 degrees or more",
    ),
    "sunsky": (
        lambda _: {"lamp": {"type": "sunsky", "to_world": STRETCHED}},
        "to_world of sunsky 'lamp' is not a rotation .*leave out scaling",
    ),
    "batch border": (
        lambda _: {
            "eye": {"type": "batch", "film": {"type": "hdrfilm"} | GAUSSIAN, "a": {"type": "perspective"}}
        },
        "film of batch sensor 'eye' has sample_border.*set it to false",
    ),
    "meter border": (
        lambda _: {"meter": meter_on({"type": "disk"}, **GAUSSIAN)},
        "irradiance meter '.*' has sample_border.*set it to false",
    ),
    "meter on a grid": (
        lambda _: {"meter": meter_on(GRID)},
        "irradiance meter '.*' is on a SDFGrid.*put it on another shape",
    ),
}


@pytest.mark.parametrize("name", REFUSED_PARTS)
def test_endpoints_that_are_refused(name, tmp_path):
    """Expected: one sentence that names the object, what is wrong and what to do, before anything is
    rendered."""
    make, message = REFUSED_PARTS[name]
    made = make(tmp_path)
    scene = {"type": "scene", **made}
    if not name.startswith(("batch", "meter")):
        scene["eye"] = sensor()
    scene = mi.load_dict(scene)
    with pytest.raises((NotImplementedError, ValueError), match=message):
        integrator().render(scene, spp=1)


def test_mirrored_shapes_that_are_fine():
    """Rationale: only cylinders have contradicting normals, and only where their points are sampled.
    Expected: a mirrored cylinder that reflects, emitting ones that are turned, scaled or have their normals
    flipped, and other shapes that are mirrored and emit, are rendered."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale(0.1)
    lamp = {"type": "cylinder", "to_world": turned, "emitter": AREA_LIGHT}
    scene = {
        "type": "scene",
        "eye": sensor(),
        "pipe": {"type": "cylinder", "to_world": MIRRORED},
        "lamp": lamp,
        "flipped": lamp | {"flip_normals": True},
        "backwards": {"type": "cylinder", "p0": [0, 0, 1], "p1": [0, 0, 0.5], "emitter": AREA_LIGHT},
    }
    for kind in ("rectangle", "disk", "sphere", "cube"):
        scene[kind] = {"type": kind, "to_world": MIRRORED, "emitter": AREA_LIGHT}
    assert np.isfinite(image(integrator(max_depth=2), mi.load_dict(scene), spp=1)).all()


def triangle_lamp(positions, face, **attributes):
    """A scene with an emitting mesh of one face and three vertices, and other attributes of these."""
    mesh = mi.Mesh("triangle", 3, 1, has_vertex_normals="vertex_normals" in attributes, props=emitting())
    params = mi.traverse(mesh)
    for name, values in ({"vertex_positions": positions} | attributes).items():
        params[name] = [float(value) for value in values]
    params["faces"] = face
    params.update()
    return mi.load_dict({"type": "scene", "sensor": sensor(), "mesh": mesh})


def test_a_broken_emitting_mesh_is_refused():
    """Rationale: Mitsuba loads faces of vertices that do not exist, and reads beyond its memory. Expected:
    said in words where we read the mesh ourselves, which is where it emits and has normals of its own."""
    positions, normals = [0, 0, 0, 1, 0, 0, 0, 1, 0], [0, 0, 1, 0, 1, 0, 0, 0, 1]
    scene = triangle_lamp(positions, [0, 1, 3], vertex_normals=normals)
    with pytest.raises(ValueError, match="bdpt: the emitting mesh 'mesh' has a face with vertex 3 of 3"):
        integrator().render(scene, spp=1)


def test_a_lamp_without_area_is_refused():
    """Rationale: its points have an infinite density, and every sample of them is NaN. Expected: said in
    words."""
    scene = triangle_lamp([0, 0, 0, 0, 0, 0, 1, 0, 0], [0, 1, 2])
    with pytest.raises(ValueError, match="is on a shape without area"):
        integrator().render(scene, spp=1)


def emitting():
    """Properties of a shape that emits."""
    props = mi.Properties()
    props["emitter"] = mi.load_dict({"type": "area"})
    return props


def test_derivatives_are_refused():
    """Expected: a sentence that names what to use, for both modes."""
    scene, bdpt = lamp_in_a_sphere(), integrator()
    for call in (
        lambda: bdpt.render_forward(scene, None),
        lambda: bdpt.render_backward(scene, None, None),
    ):
        with pytest.raises(NotImplementedError, match="prb"):
            call()


# What a constructor raises reaches the caller of load_dict inside Mitsuba's RuntimeError.
REFUSED = (NotImplementedError, RuntimeError)


FROZEN = """
import sys, drjit as dr
import mitsuba_bdpt, mitsuba as mi

mi.set_variant("llvm_ad_rgb")
film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
wall = {"type": "sphere", "flip_normals": True, "emitter": {"type": "area"}}
scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film}, "wall": wall})
method = getattr(mi.load_dict({"type": "bdpt", "max_depth": 2}), sys.argv[1])

def call(number):
    return method(scene, spp=1), number + 1

try:
    dr.freeze(call)(mi.Float(1, 2))
except RuntimeError as error:
    print(type(error.__cause__).__name__, error.__cause__)
call(mi.Float(1, 2))
dr.freeze(call, enabled=False)(mi.Float(1, 2))
print("done")
"""


@pytest.mark.parametrize("method", ["render", "decide", "explain"])
def test_frozen_functions_are_refused_in_words(method):
    """Rationale: Dr.Jit's own words are "reading from evaluated variables while recording a frozen function",
    of a number deep inside. Expected: a cause and a remedy, of which each is tried: outside of the function,
    and where freezing is switched off, the render goes as ever. (In a process of its own: dr.freeze takes
    every object of Mitsuba's that lives in the process as an input, those that other tests left behind too,
    and ended the process there once.)"""
    done = subprocess.run([sys.executable, "-c", FROZEN, method], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    refused, last = done.stdout.splitlines()
    assert re.match("UnsupportedError bdpt: .*dr.freeze is not supported.*call render outside", refused)
    assert last == "done"


def test_variants():
    """Expected: scalar variants are refused in words; the other ones of this machine, if compiled in, render
    the sphere (radiance 1 within 5 %)."""
    seen = []
    for variant in mi.variants():
        if variant.startswith("cuda"):
            continue
        mi.set_variant(variant)
        if variant.startswith("scalar"):
            with pytest.raises((NotImplementedError, RuntimeError), match="is scalar.*llvm_ad_rgb"):
                mi.load_dict({"type": "bdpt"})
        else:
            scene = mi.load_dict(
                {
                    "type": "scene",
                    "sensor": sensor()
                    | {"to_world": mi.ScalarTransform4f().look_at([0, 0, 0.5], [0.2, 0.1, -1], [0, 1, 0])},
                    "wall": {
                        "type": "sphere",
                        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
                    },
                    "lamp": {
                        "type": "point",
                        "intensity": {"type": "uniform", "value": float(np.pi)}
                        if mi.is_spectral
                        else float(np.pi),
                    },
                }
            )
            result = np.array(mi.load_dict({"type": "bdpt"}).render(scene, spp=256))
            expected = 1
            if mi.is_spectral:  # a flat spectrum is not white in sRGB
                path = mi.load_dict({"type": "path"})
                expected = np.array(path.render(scene, spp=256)).mean()
            assert abs(result.mean() / expected - 1) < 0.05, variant
            seen.append(variant)
    assert {"llvm_ad_rgb", "llvm_ad_spectral_polarized"} <= set(seen)


@pytest.mark.parametrize("variant", ["metal_ad_rgb", "metal_ad_spectral"])
def test_variants_on_metal_are_not_called_scalar(monkeypatch, variant):
    """Rationale: Mitsuba may have them on macOS; they are vectorised. (None can be loaded on Linux.)"""
    monkeypatch.setattr(mi, "variant", lambda: variant)
    with pytest.raises(NotImplementedError, match=f"variant {variant} runs on metal.*llvm_ad_rgb") as caught:
        check_variant()
    assert "scalar" not in str(caught.value)


# -- registration -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "code",
    [
        "import mitsuba_bdpt, mitsuba as mi; mi.set_variant('llvm_ad_rgb')",
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import mitsuba_bdpt",
        (
            "import mitsuba_bdpt, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); mi.set_variant('scalar_rgb');"
            " mi.set_variant('llvm_ad_rgb')"
        ),
    ],
    ids=["import first", "import last", "back and forth"],
)
def test_registration(code):
    """Rationale: plugins are registered per variant. Expected: the plugin loads whenever the package was
    imported, before or after the variant was set. (A process of its own for each order.)
    """
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(mitsuba_bdpt.llvm_choice.path)}
    script = f"{code}\nprint(type(mi.load_dict({{'type': 'bdpt'}})).__name__)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "BDPTIntegrator", done.stderr


def test_xml():
    """Expected: the plugin in a scene file, typed parameters and `$` defaults included."""
    scene = mi.load_string(
        """
        <scene version="3.0.0">
            <default name="depth" value="2"/>
            <integrator type="bdpt">
                <integer name="max_depth" value="$depth"/>
                <string name="skip" value="none"/>
                <string name="light_paths" value="1/2"/>
                <boolean name="hide_emitters" value="true"/>
            </integrator>
            <sensor type="perspective">
                <film type="hdrfilm">
                    <integer name="width" value="4"/><integer name="height" value="4"/>
                </film>
            </sensor>
            <shape type="sphere"><emitter type="area"/></shape>
        </scene>""",
        depth=3,
    )
    bdpt = scene.integrator()
    assert bdpt.max_depth == 3 and bdpt.settings.light_paths == 0.5
    assert bdpt.settings.hide_emitters
    assert np.array(mi.render(scene, spp=1)).shape == (4, 4, 3)


# -- what users try ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lightImage", "sampleDirect"])
def test_scene_files_of_mitsuba_06_are_told_what_became_of_parameters(name):
    """Rationale: Mitsuba's upgrade of an old file writes their names with underscores."""
    text = f'<boolean name="{name}" value="false"/>'
    with pytest.raises(RuntimeError, match=r"is not a parameter; it is of Mitsuba 0\.6"):
        mi.load_string(f'<scene version="0.6.0"><integrator type="bdpt">{text}</integrator></scene>')


def test_numpy_integers_are_integers():
    """Expected: `spp`, `sensor` and `seed` may be NumPy's integers; booleans may not."""
    scene, bdpt = glowing_sphere(), integrator(max_depth=1)
    expected = image(bdpt, scene, spp=2, seed=7)
    given = image(bdpt, scene, spp=np.int32(2), seed=np.uint32(7), sensor=np.int64(0))
    np.testing.assert_allclose(given, expected, rtol=1e-5)
    for name in ("spp", "sensor", "seed"):
        with pytest.raises(TypeError, match=f"{name}=.*True"):
            bdpt.render(scene, **{"spp": 2, name: np.bool_(True)})


def test_another_variant_is_refused_in_words():
    """Expected: a scene or integrator loaded under another variant is named, with the remedy."""
    scene, bdpt = glowing_sphere(), integrator(max_depth=1)
    mi.set_variant("llvm_ad_mono")
    with pytest.raises(TypeError, match="integrator=.*load it again after mi.set_variant"):
        bdpt.render(scene, spp=1)
    with pytest.raises(TypeError, match="scene=.*load it again after mi.set_variant"):
        integrator(max_depth=1).render(scene, spp=1)


def test_cancel_ends_a_render_after_its_pass():
    """Expected: two of five passes, correctly normalised (exactly 0.5), and the next render is whole."""
    scene, bdpt = glowing_sphere(), integrator(max_depth=1, light_paths=0, skip="none", spp_per_pass=4)
    bdpt.on_pass = lambda report: report.spp_done >= 8 and bdpt.cancel()
    np.testing.assert_allclose(image(bdpt, scene, spp=20), 0.5, rtol=1e-5)
    assert bdpt.statistics["passes"] == [4, 4]
    bdpt.on_pass = None
    image(bdpt, scene, spp=20)
    assert sum(bdpt.statistics["passes"]) == 20


def test_passes_are_short_under_a_timeout(monkeypatch):
    """Rationale: a pass that takes longer than the whole timeout makes it worthless. Expected: after the
    first pass of one sample in one second (a clock of our own), 0.2 s of it compilation, passes of a tenth
    of 40 seconds: 4 / 0.8 = 5 samples, then 4 · 6 / 5.8 = 4.
    """
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
    """Rationale: a float32 sum of 2^20 samples is off by 6e-4 or more, the same in every pass. Expected: a
    single pixel with 2^20 samples of exactly 0.7 is 0.7. Tolerance: 2^12 are summed at a time, in an order
    that depends on the machine; n positive numbers lose at most n 2^-24 in any.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(size=1),
            "sky": {"type": "constant", "radiance": 0.7},
        }
    )
    result = image(integrator(max_depth=1, light_paths=0), scene, spp=1 << 20)
    np.testing.assert_allclose(result, 0.7, rtol=2.0**-12)


@pytest.mark.parametrize("strategy_images", [False, True])
def test_a_small_lamp_keeps_its_light_however_many_splats_it_has(strategy_images):
    """Rationale: by (1,1) all light subpaths of a pass may fall on the pixel of a small lamp, and 2^21 equal
    numbers added in single precision are off by 0.3 %. Expected: one pass of 2^21 samples gives the same
    image as 64 of 2^15, whose samples are the same. Tolerance: 1e-4 of each value, for camera samples are
    summed in single precision, 512 in a pixel.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(size=64),
            "lamp": {
                "type": "disk",
                "to_world": T().look_at([0.02, 0.015, -1], [0, 0, 4], [0, 1, 0]).scale(0.005),
                "emitter": {"type": "area", "radiance": 400.0},
            },
        }
    )
    keys = {"max_depth": 1, "skip": "none", "layers": "strategies" if strategy_images else ""}
    one, many = (image(integrator(spp_per_pass=n, **keys), scene, spp=512) for n in (512, 8))
    assert 0 < (one[..., 0] > 1).sum() < 5
    np.testing.assert_allclose(one, many, rtol=1e-4, atol=1e-5)


def test_negative_radiance_is_that_of_path():
    """Rationale: light subpaths with negative weight must not end while the weights count them.
    Expected: radiance -1 gives minus the image of radiance 1, sample by sample.
    """
    images = []
    for sign in (1, -1):
        scene = mi.load_dict(
            {
                "type": "scene",
                "sensor": sensor(),
                "wall": {"type": "sphere", "flip_normals": True, "bsdf": diffuse()},
                "lamp": {
                    "type": "sphere",
                    "radius": 0.1,
                    "center": [0, 0.3, -0.3],
                    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [sign * 5.0] * 3}},
                },
            }
        )
        images.append(image(integrator(max_depth=4, skip="none"), scene, spp=4, seed=3))
    np.testing.assert_allclose(images[0], -images[1], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("edit", ["scale", "axis"])
def test_an_envmap_that_is_not_rotated_is_refused(edit):
    """Rationale: with any other matrix Mitsuba's own calls disagree with each other; `rotate` about an axis
    that is not of length 1 shears. Expected: named."""
    to_world = T().scale(2) if edit == "scale" else T().rotate([1, 2, 3], 77)
    sky = {"type": "envmap", "to_world": to_world, "bitmap": mi.Bitmap(np.ones((4, 8, 3), dtype=np.float32))}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(), "sky": sky})
    with pytest.raises(ValueError, match="to_world of envmap 'sky' is not a rotation"):
        integrator().render(scene, spp=1)
