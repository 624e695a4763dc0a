"""Launches that later renders of an unchanged scene replay, see `mitsuba_bdpt.run.kept`."""

import gc
from contextlib import suppress

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_parts import blend, bumps, picture, tilted
from mitsuba_bdpt.host.jit import registered_emitters
from mitsuba_bdpt.run.kept import Kept
from plugins import register_plugins
from scene_parts import EMITTERS, SENSORS, room

from scenes import ball, both_sides, floor

ROUGH = {"type": "roughconductor", "alpha": 0.3}
BSDFS = (
    {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
    {"type": "diffuse", "reflectance": picture(np.full((4, 4, 3), 0.4))},
    {"type": "conductor"},
    ROUGH,
    {"type": "dielectric"},
    {"type": "roughdielectric", "alpha": 0.3},
    {"type": "thindielectric"},
    {"type": "plastic", "diffuse_reflectance": picture(np.full((4, 4, 3), 0.6))},
    {"type": "roughplastic", "alpha": 0.3},
    {"type": "principled", "clearcoat": 0.3, "spec_tint": 0.2, "sheen": 0.1, "flatness": 0.1},
    {"type": "principledthin", "spec_trans": 0.4, "diff_trans": 0.5},
    {"type": "hair"},
    {"type": "mask", "opacity": 0.6, "nested": {"type": "plastic"}},
    {"type": "twosided", "nested": blend(0.3, {"type": "diffuse"}, ROUGH)},
    bumps({"type": "plastic"}),
    tilted(ROUGH),
)
"""Of Mitsuba's BSDFs each; a scene has every second."""

LAMPS = {
    "perspective": ("textured sphere", "point", "constant"),
    "thinlens": ("smooth mesh", "textured spot", "envmap"),
}
"""Emitters by the sensor that sees them."""


@pytest.fixture
def kept(monkeypatch):
    """Whether launches may be kept, as ``on``, and how many were recorded or replayed, as ``count``."""

    class Watch:
        on, count = True, 0

    run, watch = Kept.run, Watch()

    def watched(self, launch, *args):
        found = run(self, launch, *args) if watch.on else launch()
        watch.count += watch.on and not self._refused
        return found

    monkeypatch.setattr(Kept, "run", watched)
    return watch


def image(scene, seed=0, **parameters):
    """A small image by path tracing alone, whose sums have one order."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 2, "light_paths": 0} | parameters)
    return np.array(integrator.render(scene, seed=seed, spp=2))


def known(parameters, name):
    """A parameter's value; None for what Mitsuba shows without one, as some of ``principledthin``."""
    with suppress(TypeError):
        return parameters[name]


def changed(value):
    """Another value of a parameter, or None."""
    if isinstance(value, float):
        return value * 0.9
    if value is not None and dr.is_float_v(value):
        return value * 0.9 if dr.width(value) else None
    if "Transform4f" in type(value).__name__:
        return type(value)().translate([0.01, 0.02, 0.03]) @ value
    return None


@pytest.mark.parametrize("sensor", LAMPS)
def test_every_parameter_may_be_edited(sensor, kept):
    """Rationale: numbers of C++ objects that are no arrays are part of a recording (``eta`` of ``plastic``).
    Every parameter that ``mi.traverse`` shows, of all plugins. Expected: after an edit the image that is
    rendered when nothing is kept, to the bit, by the render that records and by the one that replays."""
    lamps = {f"lamp{i}": EMITTERS[name]() for i, name in enumerate(LAMPS[sensor])}
    first = list(LAMPS).index(sensor)
    balls = {f"b{i}": ball(b, 0.3, (i - 1.5, 0.5, 1)) for i, b in enumerate(BSDFS[first :: len(LAMPS)])}
    part = {sensor: SENSORS[sensor](), "floor": floor(bsdf=both_sides(0.6))}
    scene = mi.load_dict({"type": "scene", **part, **lamps, **balls})
    parameters = mi.traverse(scene)
    names = [name for name in parameters.keys() if changed(known(parameters, name)) is not None]
    arrays = [parameters[name] for name in names if not isinstance(parameters[name], float)]
    dr.make_opaque(arrays)  # else each edit compiles a kernel
    parameters.update()
    for name in sorted(names, key=lambda name: "sampling_weight" in name):  # unequal ones are not kept
        new = changed(parameters[name])
        dr.make_opaque(new)
        parameters[name] = new
        parameters.update()
        kept.on = False
        expected = image(scene)
        kept.on = True
        for number in range(2):
            np.testing.assert_array_equal(image(scene), expected, err_msg=f"{name}, {number}")
    assert kept.count > len(names)


def test_seeds_parameters_and_other_scenes(kept):
    """Expected: one recording serves all seeds, beside other scenes too, and no other parameters; it keeps no
    scene alive."""
    gc.collect()
    before = registered_emitters()
    scene = mi.load_dict(room(lamp=EMITTERS["rectangle"]()))
    seeds = [image(scene, seed) for seed in (0, 1, 2, 1, 0)]
    assert kept.count == 4
    np.testing.assert_array_equal(seeds[3:], seeds[1::-1])
    assert not np.array_equal(seeds[0], seeds[1])
    other = mi.load_dict(room(lamp=EMITTERS["sphere"](), sky=EMITTERS["envmap"]()))
    images = [image(world, seed) for world in (other, scene) for seed in (0, 1, 0, 1)]
    del other
    gc.collect()
    for again in (images[4:6], [image(scene, seed) for seed in (0, 1)]):
        np.testing.assert_array_equal(again, seeds[:2])
    assert image(scene, hide_emitters=True).shape == seeds[0].shape
    del scene
    gc.collect()
    assert registered_emitters() == before


def test_what_cannot_be_kept_is_recorded_anew(kept):
    """Arrays that Dr.Jit does not reach (``hg``), and plugins in Python. Expected: images as before."""
    register_plugins()
    fog = {"type": "homogeneous", "phase": {"type": "hg", "g": 0.5}}
    cloud = ball({"type": "null"}, 0.5, (0, 1, 1)) | {"interior": fog}
    for more in ({"fog": cloud}, {"own": EMITTERS["own lamp"]()}):
        scene = mi.load_dict(room(lamp=EMITTERS["rectangle"](), **more))
        images = [image(scene) for _ in range(3)]
        np.testing.assert_array_equal(images, images[:1] * 3)
    assert kept.count <= 1
