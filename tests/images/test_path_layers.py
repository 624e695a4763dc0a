"""Path layers: layers of the image by the events between emitter and camera."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import variants
import welch
from internals import bdpt
from layered import JOINED, LAMPS, check_sum, layers, scene
from media_parts import fog
from mitsuba_bdpt.transport.near_specular import NARROW
from mitsuba_bdpt.transport.path_layers import NAMES
from snapshots import ROUNDING, stopped

from scenes import camera, square

ROUGH_GLASS = {"type": "roughdielectric", "alpha": 0.1}
POLISHED = {"type": "roughconductor", "alpha": 0.05}
# Scenes by their surfaces: delta lobes, near-specular ones, and null events.
SURFACES = {
    "glass": {},
    "near-specular": {"ball": ROUGH_GLASS, "wall": POLISHED},
    "null": {
        "ball": {"type": "thindielectric"},
        "wall": {"type": "mask", "opacity": 0.7, "bsdf": {"type": "plastic"}},
    },
}


def integrator(**parameters):
    return bdpt(**{"max_depth": 5, "path_layers": True} | parameters)


def divided(method, target, **more):
    return layers(method, target, kind="path", **more)


GLOSSY = SURFACES["near-specular"]
OTHERS = {"hide_emitters": True, "layers": "variance", "aovs": "n:sh_normal"}
# Parameters, and what the scene has.
RENDERS = {
    "one": ({"skip": "none", "connections": "one"}, {"crop_width": 6, "crop_offset_x": 1}),
    "all": ({"skip": "none", "connections": "all"}, GLOSSY),
    "drawn": ({"skip": "none", "connections": "one"}, GLOSSY),
    "path tracing": ({"light_paths": 0}, GLOSSY),
    "pilot": ({}, {"rfilter": "box"}),
    "merging": ({"merging": True}, {}),
    "merged paths": ({"merging": True}, GLOSSY),
    "other layers": (OTHERS, SURFACES["null"]),
    "strategies": ({"max_depth": 3, "layers": "strategies"}, {}),
    "guiding": ({"guiding": "always"}, {}),
    "joined": ({"decisions": JOINED}, GLOSSY),
    "fog": ({"connections": "all"}, {"medium": fog()} | GLOSSY),
}


@pytest.mark.parametrize(("parameters", "of_scene"), RENDERS.values(), ids=RENDERS)
def test_layers_add_up_to_the_image(parameters, of_scene):
    """With what else a render may do, and so do light groups beside them."""
    method, target = integrator(light_groups="auto", **parameters), scene(**of_scene)
    image, found = divided(method, target)
    assert tuple(found) == NAMES
    check_sum(image, found)
    check_sum(*layers(method, target))


@pytest.mark.parametrize("parameters", [{"skip": "none"}, {"light_paths": 0}], ids=["all", "path tracing"])
def test_layers_change_nothing_else(parameters):
    """Tolerance: order of atomic additions."""
    target, parameters = scene(**SURFACES["near-specular"]), parameters | {"light_groups": "auto"}
    image, _ = divided(integrator(**parameters), target)
    _, groups = layers(integrator(**parameters), target)
    expected, alone = layers(bdpt(max_depth=5, **parameters), target)
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=2e-5 * image.max())
    for name, layer in alone.items():
        np.testing.assert_allclose(groups[name], layer, rtol=1e-4, atol=2e-5 * image.max())


def test_layers_of_bands_and_of_stokes_vectors():
    """On a ``specfilm`` a layer has each band; in polarized variants layers add up to the intensity."""
    mi.set_variant(variants.of("spectral"))
    low, high = ({"type": "spectrum", "value": v} for v in ([(400, 1), (500, 1)], [(500, 1), (700, 1)]))
    film = {"type": "specfilm", "width": 4, "height": 4, "low": low, "high": high}
    box = mi.cornell_box() | {"bulb": {"type": "point", "position": [0, 0, 0.5]}}
    box["sensor"]["film"] = film
    method = integrator(light_groups="lamp: light")
    image, found = divided(method, mi.load_dict(box))
    names = *(f"groups.{name}" for name in ("lamp", "rest")), *(f"path.{name}" for name in NAMES)
    assert method.aov_names() == [f"{name}.{band}" for name in names for band in ("low", "high")]
    check_sum(image, found)
    check_sum(*layers(method, mi.load_dict(box)))
    mi.set_variant(variants.of("mono_polarized"))
    box["sensor"]["film"] = {"type": "hdrfilm", "width": 4, "height": 4, "component_format": "float32"}
    image, found = divided(integrator(layers="stokes", light_groups="auto"), mi.load_dict(box))
    check_sum(np.broadcast_to(image, (4, 4, 3)), found)


def by_sampling(target, count, seed, depth):
    """Means of path layers, (layers, colours), of ``count`` paths by BSDF sampling with Mitsuba's calls."""
    rng = mi.PCG32(count, seed)
    u = lambda: mi.Point2f(rng.next_float32(), rng.next_float32())  # noqa: E731
    ray, weight = target.sensors()[0].sample_ray(mi.Float(0), mi.Float(0.5), u(), mi.Point2f(0.5))
    throughput, rough, beyond = mi.Spectrum(weight), mi.UInt32(0), mi.Bool(False)
    total, edges = [mi.Spectrum(0) for _ in NAMES], mi.UInt32(1)
    context = mi.BSDFContext()
    for _ in range(depth + 4):  # null events are edges for `path` too, but not for layers
        si = target.ray_intersect(ray)
        light = throughput * dr.select(edges <= depth, si.emitter(target).eval(si), 0)
        of_one = dr.select(beyond, NAMES.index("caustic"), NAMES.index("direct"))
        layer = dr.select(rough == 0, NAMES.index("emission"), NAMES.index("indirect"))
        layer = dr.select(rough == 1, of_one, layer)
        total = [t + dr.select(layer == i, light, 0) for i, t in enumerate(total)]
        bsdf = si.bsdf()
        bs, weight = bsdf.sample(context, si, rng.next_float32(), u(), si.is_valid())
        turned = mi.SurfaceInteraction3f(si)
        turned.wi = bs.wo
        density = dr.minimum(bsdf.pdf(context, si, bs.wo), bsdf.pdf(context, turned, si.wi))
        delta, null = (mi.has_flag(bs.sampled_type, f) for f in (mi.BSDFFlags.Delta, mi.BSDFFlags.Null))
        specular = delta | (density >= NARROW)
        beyond = dr.select(null, beyond, specular & (rough == 1))
        rough += dr.select(specular | null, mi.UInt32(0), 1)
        throughput = dr.select(si.is_valid(), throughput * weight, 0)
        ray, edges = si.spawn_ray(si.to_world(bs.wo)), edges + 1
        dr.eval(ray, throughput, rough, beyond, total, rng, edges)
    return np.array([np.array(t).mean(1) for t in total])


@cache
def expected_layers(surfaces, seeds=12):
    """`by_sampling` for each seed, in the scene of these surfaces."""
    target = scene(lit=("panel", "globe", "sky"), rfilter="box", **SURFACES[surfaces])
    return np.array([by_sampling(target, 2**15, seed, 4).ravel() for seed in range(seeds)])


def means(target, spp, seeds=12, **parameters):
    """Means of the layers' colours, (seeds, layers x colours)."""
    method, found = integrator(max_depth=4, rr_depth=100, **parameters), []
    for seed in range(seeds):
        _, parts = divided(method, target, spp=spp, seed=seed)
        found.append(np.concatenate([parts[name].mean((0, 1)) for name in NAMES]))
    return np.array(found)


LABELS = [f"{name} {colour}" for name in NAMES for colour in "RGB"]


@pytest.mark.parametrize(
    ("surfaces", "parameters"),
    [
        ("glass", {"skip": "none", "connections": "one"}),
        ("glass", {"guiding": "always", "light_paths": 0}),
        ("near-specular", {"skip": "none", "connections": "all"}),
        ("near-specular", {"skip": "none", "connections": "one"}),
        ("near-specular", {"decisions": JOINED}),
        ("near-specular", {"light_paths": 0}),
        ("null", {"skip": "none", "connections": "one"}),
        ("null", {"light_paths": 0}),
    ],
    ids=["glass", "guiding", "all", "drawn", "joined", "path tracing", "null", "null by path tracing"],
)
def test_layers_are_those_of_paths_by_bsdf_sampling(surfaces, parameters):
    """Each layer's mean, by Welch's t-test of the means of 12 renders; that of the image within 1 %."""
    target = scene(lit=("panel", "globe", "sky"), rfilter="box", **SURFACES[surfaces])
    expected, found = expected_layers(surfaces), means(target, 32, **parameters)
    welch.assert_agree(welch.welch(found, expected, labels=LABELS), at_least=8)
    assert found.mean(0).sum() == pytest.approx(expected.mean(0).sum(), rel=0.01)


def test_other_objects_do_not_change_layers():
    """Whether metal of alpha .07 could be near-specular depended on what else was in the scene: here an
    unseen polished ball."""
    eye = camera(origin=(-3, 0, 0.4), target=(0, 0, 0), up=(0, 0, 1), fov=1, size=4)
    metal = {"type": "roughconductor", "alpha": 0.07}
    room = {"type": "scene", "sensor": eye, "floor": square(bsdf=metal), "sky": {"type": "constant"}}
    ball = {"type": "sphere", "center": [0, 0, -50], "bsdf": metal | {"alpha": 0.01}}
    alone, beside = (
        divided(integrator(light_paths=0), mi.load_dict(objects, optimize=False))[1]
        for objects in (room, room | {"ball": ball})
    )
    assert min(alone["emission"].mean(), alone["direct"].mean()) > 0.05
    for name in NAMES:
        np.testing.assert_allclose(beside[name], alone[name], rtol=1e-4, atol=1e-5)


def test_layers_in_fog():
    """By all strategies and by path tracing, by Welch's t-test of the means of 12 renders; ``indirect``
    within 5 %."""
    target = scene(lit=("panel", "globe", "sky"), medium=fog(), rfilter="box", **SURFACES["near-specular"])
    found = means(target, 32, skip="none", connections="all")
    expected = means(target, 64, light_paths=0)
    welch.assert_agree(welch.welch(found, expected, labels=LABELS), at_least=8)
    assert (np.abs(found.mean(0) / expected.mean(0) - 1)[6:9] < 0.05).all()


def test_a_resumed_and_a_joined_render_keep_the_layers():
    """And those of light groups. Tolerance: rounding."""
    target = scene(rfilter="box")
    method = integrator(skip="none", spp_per_pass=4, light_groups="auto")
    whole = np.array(method.render(target, spp=8, seed=3))
    known = method.statistics["light_groups"]
    assert sorted(ids[0] for lamps in known.values() for ids in lamps) == sorted(LAMPS)
    start = stopped(method, target, 1, spp=8, seed=3)
    resumed = np.array(method.render(target, spp=8, seed=3, start=start))
    np.testing.assert_allclose(resumed, whole, **ROUNDING)
    parts = [stopped(method, target, None, spp=8, seed=seed) for seed in (3, 4)]
    joined = np.array(method.assemble(parts[0].joined(parts[1]), target), dtype=np.float64)
    other = np.array(method.render(target, spp=8, seed=4))
    np.testing.assert_allclose(joined, (resumed + other) / 2, **ROUNDING)
