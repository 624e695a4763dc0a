"""What the installed Mitsuba does with media, as far as the package relies on it or differs from it.

A failure here says that Mitsuba has changed: then the place named in the test has to be looked at again.
"""

from __future__ import annotations

import drjit as dr
import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import variants
from mitsuba_bdpt.media.media import interaction

N = 4096


def directions(seed):
    u = np.random.default_rng(seed).random((2, N))
    return mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))


def asked(wi):
    return interaction(mi.Point3f(0) + dr.zeros(mi.Point3f, N), -wi, dr.zeros(mi.Ray3f))


def rendered(scene, kind, spp=1024, seed=1, **parameters):
    scene = mi.load_dict(scene) if isinstance(scene, dict) else scene
    method = parts.integrator(kind, **parameters)
    return np.array(mi.render(scene, integrator=method, spp=spp, seed=seed)).mean()


@pytest.mark.parametrize("variant", [variants.of("rgb"), variants.of("mono"), variants.of("spectral")])
def test_media_can_be_indexed(variant):
    """For `media.media`: a `MediumPtr` is a number in the registry, 0 for none; its calls answer in a
    ``dr.dispatch`` with one call per medium; a homogeneous majorant is sigma_t, a grid's one number for all
    channels, its largest voxel.
    """
    mi.set_variant(variant)
    homogeneous = mi.load_dict(parts.coloured())
    grid = mi.load_dict(parts.grid(np.arange(8.0).reshape(2, 2, 2), [0, 0, 0], 1.0, scale=2.0))
    pointers = mi.MediumPtr([homogeneous, grid])
    numbers = dr.reinterpret_array(mi.UInt32, pointers).numpy()
    assert (numbers > 0).all() and len(set(numbers)) == 2
    assert dr.reinterpret_array(mi.UInt32, dr.zeros(mi.MediumPtr))[0] == 0
    mei = dr.zeros(mi.MediumInteraction3f, 2)
    if mi.is_spectral:
        mei.wavelengths = mi.Spectrum(500)

    def ask(medium, mei):
        return mi.Spectrum(medium.get_majorant(mei)), mi.Bool(medium.is_homogeneous())

    majorants, kinds = dr.dispatch(pointers, ask, mei)
    assert kinds.numpy().tolist() == [True, False]
    majorants = np.array(majorants)
    sigma = np.array(homogeneous.get_scattering_coefficients(mei)[2])[:, 0]
    np.testing.assert_allclose(majorants[:, 0], sigma, rtol=1e-6)
    np.testing.assert_allclose(majorants[:, 1], 14.0, rtol=1e-6)


def test_flights_are_exponential():
    """For `media.flight`: Mitsuba flies -ln(1 - u) / majorant too, infinitely far beyond the ray's end."""
    medium = mi.load_dict(parts.fog(2.0))
    u = mi.Float(np.linspace(0, 0.99, N))
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))
    ray.maxt = mi.Float(1)
    mei = medium.sample_interaction(ray, u, 0, True)
    t = -np.log(1 - np.array(u)) / 2
    np.testing.assert_allclose(np.array(mei.t)[t < 1], t[t < 1], rtol=1e-5, atol=1e-7)
    assert np.isinf(np.array(mei.t)[t > 1]).all()


HG = {"type": "hg", "g": 0.7}
PHASES = {
    "isotropic": {"type": "isotropic"},
    "hg": HG,
    "rayleigh": {"type": "rayleigh"},
    "tabphase": {"type": "tabphase", "values": "0.5, 1.0, 1.5, 3.0"},
    "blendphase": {"type": "blendphase", "weight": 0.3, "a": HG, "b": {"type": "rayleigh"}},
}


@pytest.mark.parametrize("name", PHASES)
def test_phase_functions_are_symmetric_densities(name):
    """For `media.phase._SYMMETRIC`: the value is the density, the same in reverse (to rounding); a sample
    has weight 1 and the density that it says, to 1e-4.
    """
    phase, ctx = mi.load_dict(PHASES[name]), mi.PhaseFunctionContext(None)
    a, b = directions(1), directions(2)
    value, pdf = phase.eval_pdf(ctx, asked(a), b)
    _, back = phase.eval_pdf(ctx, asked(b), a)
    np.testing.assert_array_equal(np.array(mi.Spectrum(value))[0] + 0 * np.array(pdf), np.array(pdf))
    np.testing.assert_allclose(np.array(pdf), np.array(back), rtol=2e-6)
    u = np.random.default_rng(3).random((3, N))
    mei = asked(a)
    wo, weight, said = phase.sample(ctx, mei, mi.Float(u[0]), mi.Point2f(u[1], u[2]))
    assert np.allclose(np.array(mi.Spectrum(weight)), 1, rtol=1e-4)
    _, of_sample = phase.eval_pdf(ctx, mei, wo)
    np.testing.assert_allclose(np.array(said), np.array(of_sample), rtol=1e-4)


def test_null_surfaces_are_no_edges_for_volpath():
    """For `walk`: through an empty null box ``volpath`` sees a sky at ``max_depth`` 1, ``path`` does not."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=5),
            "box": parts.box([-0.5] * 3, 1.0),
            "sky": {"type": "constant", "radiance": 1.0},
        }
    )
    assert rendered(scene, "volpath", max_depth=1) == pytest.approx(1, abs=1e-4)
    assert rendered(scene, "path", max_depth=1) == 0


def test_visibility_rays_of_volpath_are_analog_in_homogeneous_media():
    """For the comparisons: next-event estimation through a layer of fog of optical depth 3.5 above a plate,
    which the sensor sees from below the fog, estimates its transmittance by 0 or 1. Expected: light in all
    pixels of ours, in some three of a hundred of ``volpath``'s (one sample each).
    """
    to_world = parts.transform().translate([0, 0, 1]).scale([5, 5, 0.5])
    fog = {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": parts.fog(3.5, 0.0)}
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(3, 0, 0.3), target=(0, 0, 0), fov=1, size=32),
        "plate": {"type": "rectangle", "bsdf": parts.matte(0.5, 0.5, 0.5)},
        "lamp": {"type": "point", "position": [0, 0, 2]},
        "fog": fog,
    }
    scene = mi.load_dict(scene)
    ours, theirs = (
        parts.images(scene, parts.integrator(kind, max_depth=2, **more), 1, 0, 1)[..., 0] > 0
        for kind, more in (("bdpt", {"light_paths": 0}), ("volpath", {}))
    )
    assert ours.all() and 0.01 < theirs.mean() < 0.06


def test_a_camera_in_undeclared_fog_is_not_attenuated():
    """For `light_media`: in a box of fog a sensor that declares none sees 1 instead of e^-1.35 (the near
    plane is at .1).
    """
    box = parts.box([-2] * 3, 3.0, interior=parts.fog(1.5, 0.0))
    eye = parts.sensor(origin=(-0.5, -0.5, 0), target=(-0.5, -0.5, 1), fov=0.1)
    scene = {"type": "scene", "sensor": eye, "box": box, "sky": {"type": "constant", "radiance": 1.0}}
    assert rendered(scene, "volpath", spp=256) == pytest.approx(1, abs=1e-4)
    inside = {"box": box | {"interior": parts.fog(1.5, 0.0, id="m")}}
    inside["sensor"] = eye | {"medium": {"type": "ref", "id": "m"}}
    ordered = {"type": "scene", "box": inside["box"], "sky": scene["sky"], "sensor": inside["sensor"]}
    assert rendered(ordered, "volpath", spp=4096) == pytest.approx(np.exp(-1.35), rel=0.02)


def test_light_from_infinity_arrives_through_endless_fog_in_volpath():
    """For the page on the method: ``volpath`` joins with a sky at the edge of the scene; ours is black."""
    plate = {"type": "rectangle", "bsdf": parts.matte(0.5, 0.5, 0.5)}
    eye = parts.sensor(origin=(0, 0, 1), target=(0, 0, 0), fov=10, medium=parts.fog(1.0, 0.0))
    scene = {"type": "scene", "sensor": eye, "plate": plate, "sky": {"type": "constant", "radiance": 1.0}}
    assert rendered(scene, "volpath", max_depth=2) > 1e-3
    assert rendered(scene, "bdpt", max_depth=2) == 0


def test_grids_do_not_move_with_instances():
    """For the page on coverage: an instance moved by 2 has its box there, and its grid where it was."""
    medium = parts.grid(np.ones((2, 2, 2)), [-0.5] * 3, 1.0, 3.0, 0.0)
    group = {"type": "shapegroup", "box": parts.box([-0.5] * 3, 1.0, interior=medium)}
    to_world = parts.transform().translate([2, 0, 0])
    scene = {
        "type": "scene",
        "group": group,
        "instance": {"type": "instance", "g": {"type": "ref", "id": "group"}, "to_world": to_world},
        "sensor": parts.sensor(origin=(2, 0, 3), target=(2, 0, 0), fov=1),
        "sky": {"type": "constant", "radiance": 1.0},
    }
    assert rendered(scene, "volpath", spp=64) == pytest.approx(1, abs=1e-4)
    assert rendered(scene, "bdpt", spp=64) == pytest.approx(1, abs=1e-4)


def test_next_event_estimation_in_a_white_furnace():
    """For the comparisons: ``volpath`` shows no bias in fog of albedo 1 under an even sky: 1 to 0.5 %."""
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=15),
        "ball": parts.ball(radius=0.5, center=(0, 0, 0), interior=parts.fog(4, 1.0)),
        "sky": {"type": "constant", "radiance": 1.0},
    }
    assert rendered(scene, "volpath", rr_depth=1000) == pytest.approx(1, rel=0.005)


def test_media_do_not_emit():
    """For `techniques.hit_emitter`: media have no emission that s = 0 would have to see."""
    assert not [name for name in dir(mi.Medium) if "emission" in name.lower() or "radiance" in name.lower()]


def test_area_lights_do_not_know_the_medium_around_them():
    """For `light_media`: an emitter tells the medium that it declares, not that of its shape's exterior."""
    lamp = parts.lamp(exterior=parts.fog())
    scene = mi.load_dict({"type": "scene", "lamp": lamp})
    emitter, shape = scene.emitters()[0], scene.shapes()[0]
    assert emitter.get_medium() is None and shape.exterior_medium() is not None
