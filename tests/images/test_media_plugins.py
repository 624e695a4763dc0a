"""Plugins that take part in media: phase functions, boundaries, sensors, and media of users, beside
``volpath``.

Statistic: Welch's t-test of tile means over seeds with Sidak's correction, level 1e-3 (`welch`); our
images, once with all strategies and once by default, against one of ``volpath``. (No test of uniformity:
there are as few as one value.) The image's mean is known to `ERROR`, else the test fails too. Seeds are
fixed.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import scene_parts
import welch as st

CHANNELS = np.array([0.5, 1.0, 1.5])
SEEDS, DEPTH = 10, 4

# Largest standard error of the difference of the images' means, over the mean.
ERROR = 0.005


def tiles(scene, method, spp, seed):
    """(seeds, tiles); of films of one pixel the pixel, of batches the views' tiles."""
    images = parts.images(scene, method, spp, seed, SEEDS)[..., :3]
    count = parts.TILES if images.shape[1] > 1 else 1
    return np.stack([st.tile_means(image, count) for image in images]) @ CHANNELS


def volpath(scene, spp=256):
    return tiles(scene, parts.integrator("volpath", max_depth=DEPTH), spp, 5000)


def assert_agrees(scene, reference, spp=64, **parameters):
    """Ours, in both ways, have the mean of the ``reference``."""
    for seed, skip in ((1000, "none"), (2000, "auto")):
        method = parts.integrator(skip=skip, max_depth=DEPTH, **parameters)
        ours = tiles(scene, method, spp, seed)
        found = st.compare_images(ours, reference, skip)
        worst = found.labels[int(found.p.argmin())]
        assert st.sidak(found.p) >= st.LEVEL, f"p={st.sidak(found.p):.2g} over {len(found.p)}: {worst}"
        whole = [x.mean(1) for x in (ours, reference)]
        error = np.sqrt(sum(x.var(ddof=1) / len(x) for x in whole))
        assert error < ERROR * whole[1].mean(), f"{skip}: too noisy, {error / whole[1].mean():.2%}"
        if skip == "none":
            assert method.statistics["rays"].get("light"), "no light subpath was traced"


# -- phase functions -----------------------------------------------------------------------------------

_registered = set()


def register():
    """Register ``own_phase`` and ``own_fog`` for the current variant."""
    if mi.variant() in _registered:
        return
    _registered.add(mi.variant())

    class OwnPhase(mi.PhaseFunction):
        """(1 + a cos) / 4 pi, cos of the angle that light is turned by."""

        def __init__(self, props):
            super().__init__(props)
            self.a = mi.Float(props.get("a", 0.8))
            self.m_flags = mi.PhaseFunctionFlags.Anisotropic

        def eval_pdf(self, ctx, mei, wo, active=True):
            density = (1 - self.a * dr.dot(mei.wi, wo)) / (4 * dr.pi)
            return mi.Spectrum(density), density

        def sample(self, ctx, mei, sample1, sample2, active=True):
            cos = (dr.sqrt(dr.square(1 - self.a) + 4 * self.a * sample2.x) - 1) / self.a
            sin, phi = dr.safe_sqrt(1 - cos * cos), 2 * dr.pi * sample2.y
            d = mi.Vector3f(sin * dr.cos(phi), sin * dr.sin(phi), cos)
            wo = mi.Frame3f(-mei.wi).to_world(d)
            return wo, mi.Spectrum(1), (1 + self.a * cos) / (4 * dr.pi)

    class OwnFog(mi.Medium):
        """Gray and homogeneous, by the calls that ``volpath`` makes."""

        def __init__(self, props):
            super().__init__(props)
            self.extinction, self.albedo = (mi.Float(props.get(name)) for name in ("extinction", "albedo"))
            self.m_is_homogeneous, self.m_has_spectral_extinction = True, False
            self.m_sample_emitters = True

        def intersect_aabb(self, ray):
            return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)

        def get_majorant(self, mei, active=True):
            return mi.Spectrum(self.extinction)

        def get_scattering_coefficients(self, mei, active=True):
            sigma_t = mi.Spectrum(self.extinction)
            return sigma_t * self.albedo, mi.Spectrum(0), sigma_t

    mi.register_phase("own_phase", OwnPhase)
    mi.register_medium("own_fog", OwnFog)


def hg(g):
    return {"type": "hg", "g": g}


PHASES = {
    "isotropic": {"type": "isotropic"},
    "rayleigh": {"type": "rayleigh"},
    "tabphase": {"type": "tabphase", "values": "0.2, 0.1, 0.5, 1.5, 0.4"},
    "blendphase": {"type": "blendphase", "weight": 0.3, "a": hg(0.7), "b": hg(-0.5)},
    "own_phase": {"type": "own_phase"},
}


def in_fog(phase):
    """Thick fog around a lamp: much of the image is light scattered once."""
    register()
    medium = parts.fog(1.5, 0.9) | {"phase": phase}
    return mi.load_dict(parts.foggy(medium))


@cache
def by_volpath(name):
    return volpath(in_fog(PHASES.get(name) or hg(0.8)))


@pytest.mark.parametrize("name", PHASES)
def test_phase_functions(name):
    """Rationale: phase functions are asked in both directions by calls of their own, whose conventions
    (which way ``wi`` points, normalisation, frames) each could take otherwise. Expected: images agree
    with ``volpath``, see the module, and are not those of another phase function, by the same test.
    """
    assert_agrees(in_fog(PHASES[name]), by_volpath(name))
    other = by_volpath("isotropic" if name != "isotropic" else "hg")
    assert st.sidak(st.compare_images(by_volpath(name), other).p) < 1e-6


# -- boundaries ----------------------------------------------------------------------------------------


def mixed():
    """Lets three rays of five pass, as a mask."""
    return {"type": "blendbsdf", "weight": 0.4, "a": {"type": "null"}, "b": parts.matte(0.7, 0.5, 0.3)}


# With a point `volpath` would miss the light that `thindielectric` reflects, with a lamp of some area it
# loses light behind null lobes.
BOUNDARIES = {
    "thindielectric": lambda: parts.room(ball=parts.ball("thindielectric", interior=parts.fog(3, 0.7))),
    "blendbsdf": lambda: parts.room(
        light=parts.point(), ball=parts.ball(mixed(), interior=parts.fog(3, 0.7))
    ),
}


@pytest.mark.parametrize("name", BOUNDARIES)
def test_boundaries(name):
    """Rationale: lobes that pass straight on are transmittance to a join and no vertex to a walk; where
    they are one lobe of several the weights of both have to agree. Expected: images agree with
    ``volpath``, see the module.
    """
    scene = mi.load_dict(BOUNDARIES[name]())
    assert_agrees(scene, volpath(scene))


# -- lamps ---------------------------------------------------------------------------------------------


def test_sample_emitters_off():
    """Rationale: without next-event estimation in a medium s = 1 and (1,1) are other strategies there
    than on surfaces. Expected: images agree with ``volpath``, which honours ``sample_emitters`` too; ours
    trace fewer rays to lamps than with it.
    """
    scenes = [
        mi.load_dict(parts.foggy(parts.fog(1.5, 0.9, sample_emitters=value))) for value in (False, True)
    ]
    assert_agrees(scenes[0], volpath(scenes[0]))
    method, rays = parts.integrator(skip="none", max_depth=DEPTH), []
    for scene in scenes:
        method.render(scene, spp=16)
        rays.append(method.statistics["rays"]["shadow_s1"])
    assert 0 < rays[0] < 0.8 * rays[1]


# -- sensors -------------------------------------------------------------------------------------------


def orthographic():
    look = parts.transform().look_at([0.1, -0.05, 0.5], [0, 0, -1], [0, 1, 0]).scale([0.5, 0.5, 1])
    return {"sensor": scene_parts.sensor("orthographic", {"to_world": look, "medium": FOG})}


def irradiancemeter():
    """A plate that faces the lamp."""
    look = parts.transform().look_at([-0.05, 0, 0], [0.25, 0.3, -0.2], [0, 0, 1]).scale(0.1)
    sensor = scene_parts.sensor("irradiancemeter", {"medium": FOG}, size=1)
    return {"plate": {"type": "rectangle", "to_world": look, "bsdf": parts.matte(0, 0, 0), "sensor": sensor}}


def batch():
    views = parts.sensor(), parts.sensor(origin=(-0.5, 0.1, 0.4))
    return {"sensor": scene_parts.batch(*views) | {"medium": FOG}}


FOG = {"type": "ref", "id": "fog"}
SENSORS = {"orthographic": orthographic, "irradiancemeter": irradiancemeter, "batch": batch}


@pytest.mark.parametrize("name", SENSORS)
def test_sensors_in_fog(name):
    """Rationale: rays start at the near plane, on the sensor's shape or by view, and their transmittance
    with them. Expected: images agree with ``volpath``, see the module.
    """
    scene = parts.room() | {"fog": parts.fog(0.8, 0.8, id="fog")}
    del scene["sensor"]
    scene = mi.load_dict({"fog": scene.pop("fog"), **scene, **SENSORS[name]()})
    spp = 128 if name == "irradiancemeter" else 1  # of the one pixel
    assert_agrees(scene, volpath(scene, 256 * spp), 64 * spp)


# -- media of users ------------------------------------------------------------------------------------


def test_media_in_python():
    """Rationale: what a medium is like is asked of it, not read from its class. Expected: a ball of fog
    that is a class in Python has the image that ``volpath`` has of a homogeneous one, see the module; and
    so has ``volpath``'s of the same, or there would be no such media.
    """
    register()
    own = {"type": "own_fog", "extinction": 4.0, "albedo": 0.9, "phase": hg(0.3)}
    scene, uniform = (
        mi.load_dict(parts.room(light=parts.point(), ball=parts.ball(interior=medium)))
        for medium in (own, parts.fog(4, 0.9))
    )
    reference = volpath(uniform)
    assert_agrees(scene, reference)
    theirs = tiles(scene, parts.integrator("volpath", max_depth=DEPTH), 64, 9000)
    assert st.sidak(st.compare_images(theirs, reference).p) >= st.LEVEL
