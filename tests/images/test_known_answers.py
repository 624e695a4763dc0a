"""Scenes whose radiance is known in closed form.

Unit sphere, reflectance 1/2: light that has been reflected m times has the radiance 2^-m, so every
path length can be tested alone, in every strategy. White furnace: white objects in a constant unit
environment are invisible. Where images are random, the statistic is the t-test of the mean over
seeds (each seed an independent render) against the known value, with Sidak's correction for the
number of values tested at once. Seeds are fixed, so a test passes or fails always.
"""

from functools import partial

import internals
import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
import welch as st

# Systematic error that float32 is allowed, relative: sums of some 1e3 terms, ray offsets.
ROUNDING = 3e-5

T = mi.ScalarTransform4f


check = partial(st.check_known, rounding=ROUNDING)


def camera(origin=(0, 0, 0.5), target=(0.2, 0.1, -1), fov=60, size=16, rfilter="box", **film):
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-3,
        "to_world": T().look_at(list(origin), list(target), [0, 1, 0]),
        "sampler": {"type": "independent"},
        "film": parts.film(size, rfilter, **film),
    }


def diffuse(reflectance):
    """Two-sided: inside and outside of a shape look alike."""
    return {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [reflectance] * 3}},
    }


def sphere_lit_by(kind, sensor=None):
    """Unit sphere of reflectance 1/2 in which light reflected m times has the radiance 2^-m.

    Returns the scene and the radiance of the paths of k edges, as a function of k.
    """
    wall = {"type": "sphere", "bsdf": diffuse(0.5)}
    scene = {"type": "scene", "sensor": sensor or camera(), "wall": wall}
    if kind == "point":
        scene["lamp"] = {"type": "point", "intensity": float(np.pi)}
        return mi.load_dict(scene), lambda k: 0.5 ** (k - 1) if k >= 2 else 0.0
    wall["flip_normals"] = True
    wall["emitter"] = {"type": "area", "radiance": 0.5}
    return mi.load_dict(scene), lambda k: 0.5**k


def integrator(**parameters):
    return internals.bdpt(**parameters)


def render(scene, bdpt, seeds, spp):
    """Images, stacked: (seeds, height, width, channels)."""
    return np.stack([np.array(bdpt.render(scene, seed=seed, spp=spp), dtype=np.float64) for seed in seeds])


def layers(images, bdpt, base=3):
    """Channels by name, averaged over the pixels and RGB: {(kind, s, t): (seeds,)}."""
    found = {}
    for i, name in enumerate(bdpt.aov_names()):
        kind, strategy, _ = name.split(".")
        s, t = (int(x) for x in strategy[1:].split("t"))
        found.setdefault((kind, s, t), []).append(images[..., base + i])
    return {key: np.mean(value, axis=(0, -1, -2)) for key, value in found.items()}


# Parameters, and what error the weighted sums can show.
CONFIGURATIONS = {
    "everything": ({"skip": "none"}, 3e-3),
    "K=2": ({"skip": "none", "stored_vertices": 2}, 3e-3),
    "light_paths=1/4": ({"skip": "impossible", "light_paths": "1/4"}, 3e-3),
    "power": ({"skip": "none", "heuristic": "power"}, 3e-3),
    "K=3": ({"skip": "none", "stored_vertices": 3}, 3e-3),
    "light_paths=1": ({"skip": "impossible", "light_paths": 1}, 3e-3),
    "light_paths=0": ({"skip": "none", "light_paths": 0}, 3e-3),
    "no connections": ({"skip": "none", "connections": "none"}, 5e-3),
    "power, 1/2": ({"skip": "impossible", "heuristic": "power", "light_paths": 0.5}, 3e-3),
}


@pytest.mark.parametrize("kind", ["point", "emission"])
@pytest.mark.parametrize(
    "name",
    [
        *list(CONFIGURATIONS)[:4],
        *(pytest.param(name, marks=pytest.mark.slow) for name in list(CONFIGURATIONS)[4:]),
    ],
)
def test_every_path_length_in_the_unit_sphere(kind, name):
    """Rationale: inside a sphere the geometry term is constant, so each strategy alone has finite
    variance and each path length a known radiance. Expected: per path length k the weighted
    strategies add up to 2^-m, and so does each unweighted one that can make the path; both with
    stored vertices short of the path length (longer paths by s = 0 and s = 1 only). Tolerance: the
    confidence interval, 1e-3 or so (bounded in `CONFIGURATIONS`); 5e-2 for unweighted t = 1.
    Statistic: t-test over 16 seeds, Sidak over the path lengths.
    """
    depth, (parameters, tolerance) = 5, CONFIGURATIONS[name]
    scene, answer = sphere_lit_by(kind)
    bdpt = integrator(max_depth=depth, rr_depth=100, layers="strategies", **parameters)
    images = render(scene, bdpt, range(16), 256)
    found = layers(images, bdpt)
    lengths = range(1 if kind == "emission" else 2, depth + 1)
    sums = np.stack([sum(found["weighted", s, k + 1 - s] for s in range(k + 1)) for k in lengths], axis=1)
    check(sums, [answer(k) for k in lengths], tolerance)
    # The layers add up to the image.
    np.testing.assert_allclose(sums.sum(1), images[..., :3].mean((1, 2, 3)), rtol=1e-4)
    stored = parameters.get("stored_vertices", 64)
    for (sort, s, t), values in found.items():
        k = s + t - 1
        if sort == "weighted" or answer(k) == 0:
            continue
        off = (
            t == 0  # a pinhole
            or ((s == 0 or (s == 1 and t == 1)) and kind == "point")
            or ((s >= 2 or (s, t) == (1, 1)) and (name == "light_paths=0" or k > stored))
            or (name == "no connections" and s >= 2 and t >= 2)
        )
        if off:
            assert np.all(values == 0), (s, t)
        else:
            check(values, answer(k), 5e-2)


def meter():
    """An irradiance meter for the shape that holds it."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    return {"type": "irradiancemeter", "film": film | {"component_format": "float32"}}


def metered_sphere(kind):
    """The sphere of `sphere_lit_by`, itself the meter of what its inside receives; also the irradiance by
    paths of k edges. (Light of radiance L from everywhere: pi L. The lamp alone: pi / 1^2.)"""
    wall = {"type": "sphere", "bsdf": diffuse(0.5), "flip_normals": True, "sensor": meter()}
    scene = {"type": "scene", "wall": wall}
    if kind == "point":
        scene["lamp"] = {"type": "point", "intensity": float(np.pi)}
    else:
        wall["emitter"] = {"type": "area", "radiance": 0.5}
    return mi.load_dict(scene), lambda k: np.pi * 0.5 ** (k - 1 if kind == "point" else k)


def wide_lens(kind):
    """The sphere of `sphere_lit_by` and a thin lens that a hundredth of all light hits within its view."""
    sensor = camera(size=4) | {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 1.0}
    scene, answer = sphere_lit_by(kind, sensor)
    return scene, lambda k: None if kind == "point" and k == 1 else answer(k)


@pytest.mark.parametrize("kind", ["point", "emission"])
@pytest.mark.parametrize("heuristic", ["balance", "power"])
@pytest.mark.parametrize("sensor", [metered_sphere, wide_lens])
def test_all_strategies_of_sensors_with_area(sensor, heuristic, kind):
    """Rationale: with t = 0, light that hits the sensor, a path of k edges has k + 2 strategies.
    Expected: for k = 1, 2, 3 the weighted ones add up to the known radiance (irradiance), and so does each
    unweighted one that can make the path, t = 0 among them. (The lens sees the point lamp itself as a disk
    out of focus, of which only a part is on the film: k = 1 is left out there.) Tolerance: the confidence
    interval, below 2e-2 for sums and 0.15 for single strategies. Statistic: t-test over 16 seeds.
    """
    scene, answer = sensor(kind)
    bdpt = integrator(max_depth=3, rr_depth=100, layers="strategies", skip="none", heuristic=heuristic)
    spp = 1 << 15 if sensor is metered_sphere else 1 << 13
    images = render(scene, bdpt, range(16), spp)
    found = layers(images, bdpt)
    for k in (1, 2, 3):
        expected = answer(k)
        if expected is None:
            continue
        check(sum(found["weighted", s, k + 1 - s] for s in range(k + 2)), expected, 2e-2)
        for s in range(1 if kind == "point" else 0, k + 2):
            check(found["unweighted", s, k + 1 - s], expected, 0.15)


def test_a_lamp_in_glass_reaches_the_meter_around_it():
    """Rationale: a delta lamp, delta surfaces, the sensor: t = 0 alone makes such paths. Expected: all light
    of a point lamp in a glass ball, which absorbs nothing, falls on the black sphere of radius 3 around
    both: I / 9; paths of more than 12 edges carry 0.04^5 of it at most. Tolerance: 1e-3, the confidence
    interval and what is left out. Statistic: t-test over 16 seeds.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "lamp": {"type": "point", "intensity": 1.0},
            "ball": {"type": "sphere", "bsdf": {"type": "dielectric"}},
            "wall": {
                "type": "sphere",
                "radius": 3,
                "flip_normals": True,
                "bsdf": diffuse(0),
                "sensor": meter(),
            },
        }
    )
    for skip in ("none", "auto"):
        images = render(scene, integrator(max_depth=12, skip=skip), range(16), 4096)
        check(images.mean((1, 2, 3)), 1 / 9, 1e-3)


@pytest.mark.parametrize("far_clip", [100.0, 5.5], ids=["", "far plane"])
def test_a_lens_outside_the_scene_sees_the_whole_sky(far_clip):
    """Rationale: light subpaths from infinity start on a disk that covers the scene's shapes, and the lens is
    none: past it they do not come, so t = 0 must not be counted there (0.7 % of the sky was lost); nor where
    an object behind the far plane, which camera rays do not see, stands in their way. Expected: radiance 1 in
    every pixel, from a white ball and from the sky beside it. Tolerance: the confidence interval, below 1e-2
    (3e-3 beside the ball). Statistic: t-test over 16 seeds, Sidak over tiles of 4 x 4 pixels.
    """
    lens = camera(origin=(6, 0, 0), target=(0, 0, 0), fov=40) | {
        "type": "thinlens",
        "aperture_radius": 0.8,
        "focus_distance": 6.0,
        "far_clip": far_clip,
    }
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    sky = {"type": "constant", "radiance": 1.0}
    scene = mi.load_dict(
        {"type": "scene", "eye": lens, "ball": {"type": "sphere", "bsdf": white}, "sky": sky}
    )
    images = render(scene, integrator(skip="none"), range(16), 512)
    check(images.reshape(16, 4, 4, 4, 4, 3).mean((2, 4, 5)), 1.0, 1e-2)


def test_t_0_is_explained():
    """Expected: used where the sensor has an area, skipped with the reason elsewhere."""
    scene, _ = metered_sphere("point")
    assert "used: t=0" in integrator().explain(scene)
    parallel = {key: value for key, value in camera().items() if key != "fov"} | {"type": "orthographic"}
    for sensor, why in ((camera(), "pinhole"), (parallel, "one direction")):
        scene, _ = sphere_lit_by("point", sensor)
        (line,) = (x for x in integrator().explain(scene).splitlines() if ": t=0:" in x)
        assert line.startswith("skipped (impossible): t=0") and why in line


@pytest.mark.parametrize("kind", ["point", "emission"])
@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"skip": "none"},
        {"skip": "none", "stored_vertices": 2},
        {"points": "independent"},
        {"skip": "impossible", "light_paths": "1/16", "connections": "all", "heuristic": "power"},
    ],
    ids=lambda p: ",".join(f"{k}={v}" for k, v in p.items()) or "default",
)
def test_all_bounces_in_the_unit_sphere_add_up_to_one(kind, parameters):
    """Rationale: the whole estimator as users run it: unlimited depth, Russian roulette in both
    walks and before visibility, one connection drawn. Expected: 1 everywhere. Tolerance: the
    confidence interval, below 3e-3 for the mean, 2e-2 for rows and columns. Statistic: t-test over
    16 seeds, Sidak over rows and columns.
    """
    scene, _ = sphere_lit_by(kind)
    images = render(scene, integrator(**parameters), range(16), 128)[..., :3].mean(-1)
    check(images.mean((1, 2)), 1, 3e-3)
    check(np.concatenate([images.mean(1), images.mean(2)], axis=1), 1, 2e-2)


@pytest.mark.parametrize("connections", ["one", "all"])
def test_many_stored_vertices(connections):
    """Rationale: in dark rooms few light subpaths have more than a dozen vertices. In a white sphere whose
    centre is a point lamp light that was reflected m times has the radiance 1, for every m. Expected: of
    paths of up to 60 edges 59, with a light subpath of 58 stored vertices among which one is drawn, and with
    all of them. Tolerance: the confidence interval, below 1e-2. Statistic: t-test over 16 seeds.
    """
    lamp = {"type": "point", "intensity": float(np.pi)}
    wall = {"type": "sphere", "bsdf": diffuse(1.0)}
    scene = mi.load_dict({"type": "scene", "sensor": camera(size=8), "wall": wall, "lamp": lamp})
    bdpt = integrator(max_depth=60, rr_depth=100, skip="impossible", light_paths=1, connections=connections)
    check(render(scene, bdpt, range(16), 16)[..., :3].mean((1, 2, 3)), 59.0, 1e-2)


@pytest.mark.parametrize("depth", [2, 3, 4])
@pytest.mark.parametrize("parameters", [{}, {"stored_vertices": 2}], ids=["default", "K=2"])
def test_partial_sums_with_drawn_connections_and_roulette(depth, parameters):
    """Rationale: strategy images switch the drawn connection and the roulette off; this test has
    them on. Expected: the partial sums of 2^-m up to ``max_depth``. Tolerance: the
    confidence interval, below 3e-3. Statistic: t-test of the image mean over 16 seeds.
    """
    scene, answer = sphere_lit_by("point")
    images = render(scene, integrator(max_depth=depth, **parameters), range(16), 128)
    check(images[..., :3].mean((1, 2, 3)), sum(answer(k) for k in range(depth + 1)), 3e-3)


# -- white furnace ----------------------------------------------------------------------------


def furnace(shapes, **film):
    scene = {
        "type": "scene",
        "sensor": camera((0, 0, 4), (0, 0, 0), fov=50, **film),
        "environment": {"type": "constant", "radiance": 1.0},
    }
    return mi.load_dict(scene | shapes)


WHITE = {
    "diffuse": {
        "ball": {"type": "sphere", "radius": 0.8, "center": [-0.7, 0.3, 0], "bsdf": diffuse(1)},
        "box": {
            "type": "cube",
            "bsdf": diffuse(1),
            "to_world": T().translate([0.9, -0.4, 0.3]).rotate([0.70710678, 0.70710678, 0], 30).scale(0.5),
        },
        "floor": {
            "type": "rectangle",
            "bsdf": diffuse(1),
            "to_world": T().translate([0, -1.2, 0]).rotate([1, 0, 0], -90).scale(3),
        },
    },
    "glass": {
        "ball": {
            "type": "sphere",
            "radius": 0.8,
            "center": [-0.7, 0.3, 0],
            "bsdf": {"type": "dielectric", "int_ior": 1.5},
        },
        "mirror": {
            "type": "sphere",
            "radius": 0.6,
            "center": [0.9, 0, 0],
            "bsdf": {"type": "conductor", "material": "none"},
        },
        "pane": {
            "type": "rectangle",
            "bsdf": {"type": "thindielectric"},
            "to_world": T().translate([0.3, 0.4, 1]).rotate([0, 1, 0], 30).scale(0.6),
        },
        "floor": {
            "type": "rectangle",
            "bsdf": diffuse(1),
            "to_world": T().translate([0, -1.2, 0]).rotate([1, 0, 0], -90).scale(3),
        },
    },
}


@pytest.mark.parametrize("objects", WHITE)
@pytest.mark.parametrize(
    "parameters", [{"skip": "none"}, {"heuristic": "power"}], ids=["everything", "power"]
)
def test_white_furnace(objects, parameters):
    """Rationale: an error in any weight, density or adjoint makes white objects visible in front of
    a white environment. Expected: 1 in every pixel. Tolerance: the confidence interval,
    below 5e-3 for the image's mean, 0.15 for a single pixel. Statistic: t-test over 16 seeds, Sidak
    over the pixels.
    """
    scene = furnace(WHITE[objects])
    images = render(scene, integrator(**parameters), range(16), 128)[..., :3].mean(-1)
    check(images.mean((1, 2)), 1, 5e-3)
    check(images, 1, 0.15)


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "mitchell"])
@pytest.mark.parametrize("border", [False, True], ids=["", "sample_border"])
def test_borders_of_a_furnace_are_flat(rfilter, border):
    """Rationale: splats near the border get less of their filter's weight from inside the image
    than splats elsewhere (LuxCore 237 and 239: dark or bright rows). In the sphere lit by a point
    light, t = 1 alone must give 2^-m in each row and column. Expected: the unweighted layers
    s2t1 and s3t1 are flat, the outermost rows and columns included. Tolerance: the confidence interval, below
    0.12 for a row or column, 3e-2 for the ring of border pixels, 5e-3 for the ring of the image
    with all strategies. Statistic: t-test over 16 seeds.
    """
    scene, answer = sphere_lit_by("point", camera(rfilter=rfilter, size=16, sample_border=border))
    bdpt = integrator(max_depth=3, layers="strategies", skip="none")
    images = render(scene, bdpt, range(16), 320)
    ring = np.ones((16, 16), dtype=bool)
    ring[1:-1, 1:-1] = False
    names = bdpt.aov_names()
    for k, s in ((2, 2), (3, 3)):
        layer = images[..., 3 + names.index(f"unweighted.s{s}t1.G")]
        check(np.concatenate([layer.mean(1), layer.mean(2)], axis=1), answer(k), 0.12)
        check(layer[:, ring].mean(1), answer(k), 3e-2)
    total = images[..., :3].mean(-1)
    check(total[:, ring].mean(1), answer(2) + answer(3), 5e-3)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_borders_of_the_white_furnace_are_flat(rfilter):
    """Rationale: as above, with an environment seen at the border, where (1,1) splats. Expected: 1
    in the ring of border pixels and inside it. Tolerance: the confidence interval, below
    1.5e-2 a border, 6e-3 inside. Statistic: t-test over 16 seeds.
    """
    scene = furnace(WHITE["diffuse"], rfilter=rfilter)
    images = render(scene, integrator(skip="none"), range(16), 128)[..., :3].mean(-1)
    rows = [
        images[:, 0].mean(1),
        images[:, -1].mean(1),
        images[:, :, 0].mean(1),
        images[:, :, -1].mean(1),
    ]
    check(np.stack(rows, axis=1), 1, 1.5e-2)
    check(images[:, 1:-1, 1:-1].mean((1, 2)), 1, 6e-3)


# -- nothing to see ---------------------------------------------------------------------------


@pytest.mark.parametrize("skip", ["none", "auto"])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_an_environment_without_shapes_is_the_environment(rfilter, skip):
    """Rationale: Mitsuba 0.6 (80) was black without shapes. Expected: 0.7 in every pixel; for a
    constant environment s = 0 and (1,1) meet in each pixel, each with noise of its own. Tolerance: the
    confidence interval, below 5e-3 for the mean, 0.1 a pixel. Statistic: t-test over 16 seeds.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera(rfilter=rfilter),
            "environment": {"type": "constant", "radiance": 0.7},
        }
    )
    images = render(scene, integrator(skip=skip), range(16), 128)[..., :3].mean(-1)
    check(images.mean((1, 2)), 0.7, 5e-3)
    check(images, 0.7, 0.1)


@pytest.mark.parametrize("skip", ["none", "auto"])
@pytest.mark.parametrize("shapes", [{}, WHITE["diffuse"]], ids=["empty", "shapes"])
def test_a_scene_without_emitters_is_black(shapes, skip):
    """Rationale and expected: no error, exactly 0 everywhere."""
    scene = mi.load_dict({"type": "scene", "sensor": camera()} | shapes)
    image = np.array(integrator(skip=skip, max_depth=4).render(scene, spp=4))
    assert image.shape == (16, 16, 3)
    assert np.all(image == 0)


# -- images that only splats can make ---------------------------------------------------------


def glass_lamp(**film):
    """A spot light at the centre of a glass ball at the centre of the unit sphere, seen from
    beside the ball. Light leaves the ball unbent; with max_depth 3 only t = 1 can make the image.
    The wall's radiance is 1."""
    transmittance = 1 - ((1.5 - 1) / (1.5 + 1)) ** 2
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, 0, -0.4), (0, 0, -1), fov=60, **film),
            "wall": {"type": "sphere", "bsdf": diffuse(0.5)},
            "glass": {
                "type": "sphere",
                "radius": 0.3,
                "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0},
            },
            "lamp": {
                "type": "spot",
                "cutoff_angle": 40,
                "beam_width": 39.99,
                "intensity": float(2 * np.pi / transmittance),
                "to_world": T().look_at([0, 0, 0], [0, 0, -1], [0, 1, 0]),
            },
        }
    )


@pytest.mark.parametrize(
    "rfilter, border",
    [
        ("gaussian", False),
        ("gaussian", True),
        ("mitchell", False),
        ("mitchell", True),
        ("lanczos", True),
        pytest.param("box", False, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(
    "spp, size, seeds, tolerance", [(1, 128, 16, 2e-2), (4, 128, 24, 6e-3), (10, 192, 16, 2.5e-3)]
)
def test_splats_alone_are_unbiased_at_few_samples(spp, size, seeds, tolerance, rfilter, border):
    """Rationale: a splat divided by the sum of the camera samples' filter weights is biased, for
    E[1/W] > 1/E[W]: by +5.7, +1.3 and +0.5 % at 1, 4 and 10 spp with the gaussian filter, +11 % at
    1 spp with mitchell. Expected: radiance 1 in an image that only t = 1 can make, at every sample
    count, in the border rows too. Tolerance: the confidence interval, below half the known bias.
    Statistic: t-test over seeds.
    """
    scene = glass_lamp(rfilter=rfilter, size=size, sample_border=border)
    images = render(scene, integrator(max_depth=3, skip="none"), range(seeds), spp)
    images = images[..., :3].mean(-1)
    ring = np.ones((size, size), dtype=bool)
    ring[1:-1, 1:-1] = False
    check(images.mean((1, 2)), 1, tolerance)
    check(images[:, ring].mean(1), 1, 10 * tolerance)


# -- parallel plates --------------------------------------------------------------------------


def squares_form_factor(h):
    """Between two unit squares, parallel and coaxial, at the distance ``h``."""
    x = 1 / h
    root = np.sqrt(1 + x * x)
    return (
        2
        / (np.pi * x * x)
        * (
            np.log((1 + x * x) / np.sqrt(1 + 2 * x * x))
            + 2 * x * root * np.arctan(x / root)
            - 2 * x * np.arctan(x)
        )
    )


@pytest.mark.parametrize(
    "parameters, h",
    [*(({"skip": "none"}, h) for h in (1e-3, 1e-2, 1, 100)), ({"heuristic": "power"}, 1e-2), ({}, 0.1)],
    ids=str,
)
def test_form_factor_of_parallel_plates(parameters, h):
    """Rationale: from touching plates (only hits of the emitter work) to distant ones (only its
    samples do), and brightness must not depend on the scale of the distance. A white plate is seen
    through the emitting one, which hide_emitters makes transparent to the camera, in a film that it
    fills exactly. Expected: the mean is the form factor. Tolerance: the confidence
    interval, below 6e-3. Statistic: t-test over 16 seeds.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, 0, 2), (0, 0, 0), fov=float(np.rad2deg(2 * np.arctan(0.25)))),
            "plate": {"type": "rectangle", "to_world": T().scale(0.5), "bsdf": diffuse(1)},
            "lamp": {
                "type": "rectangle",
                "emitter": {"type": "area", "radiance": 1.0},
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
                "to_world": T().translate([0, 0, h]).rotate([1, 0, 0], 180).scale(0.5),
            },
        }
    )
    bdpt = integrator(max_depth=2, hide_emitters=True, **parameters)
    images = render(scene, bdpt, range(16), 256)
    check(images[..., :3].mean((1, 2, 3)), squares_form_factor(h), 6e-3)


def test_a_near_plane_hides_what_stands_before_it_from_light():
    """Rationale: camera rays start at the near plane, so light that flies to the lens (t = 0) passes what is
    between the two. Expected: in a sphere whose inside emits 1/2, a black disk before the near plane of a
    wide lens, which would cover the whole view, is not there: 1/2 in the mean. Tolerance: the confidence
    interval, below 2e-3; with a disk that hides the lens from light the image is 0.5 % too dark. Statistic:
    t-test over 16 seeds.
    """
    sensor = camera(size=4) | {
        "type": "thinlens",
        "aperture_radius": 0.3,
        "focus_distance": 1.0,
        "near_clip": 0.25,
    }
    forwards = T().look_at([0, 0, 0.5], [0.2, 0.1, -1], [0, 1, 0])
    emitter = {"type": "area", "radiance": 0.5}
    wall = {"type": "sphere", "flip_normals": True, "bsdf": diffuse(0), "emitter": emitter}
    black = {"type": "disk", "bsdf": diffuse(0), "to_world": forwards @ T().translate([0, 0, 0.2]).scale(0.6)}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "wall": wall, "black": black})
    images = render(scene, integrator(max_depth=1, skip="none"), range(16), 1024)
    check(images.mean((1, 2, 3)), 0.5, 2e-3)


@pytest.mark.parametrize("side", ["camera", "light"])
def test_lobes_and_roulette_are_independent(side):
    """Rationale: the number that chooses a lobe is small or large once the lobe is known; were it used for
    roulette as well, one lobe would survive too often. Expected: a ball of which 1/10 is transparent and the
    rest black, around the camera in a sphere that emits 1/2 (or around a point lamp in the sphere where that
    makes the radiance 1/2), with roulette from the first vertex on, lets 1/10 of it through: 1/20. Tolerance:
    the confidence interval, below 3e-2; with one number for both the camera sees 1/38. Statistic: t-test over
    16 seeds.
    """
    black = {"type": "diffuse", "reflectance": 0.0}
    ball = {"type": "sphere", "radius": 0.2, "bsdf": {"type": "mask", "opacity": 0.9, "bsdf": black}}
    wall = {"type": "sphere", "bsdf": diffuse(0.5)}
    if side == "camera":
        sensor = camera((0, 0, 0))
        wall |= {"flip_normals": True, "emitter": {"type": "area", "radiance": 0.5}}
        lamp, depth = {}, 2
    else:
        sensor = camera((0, 0, -0.3), (0, 0, -1))
        lamp = {"lamp": {"type": "point", "intensity": float(np.pi)}}
        depth = 3
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "wall": wall, "ball": ball} | lamp)
    images = render(scene, integrator(max_depth=depth, rr_depth=1, skip="none"), range(16), 1024)
    check(images.mean((1, 2, 3)), 0.05, 3e-2)


def test_seeds_are_evaluated():
    """The helper that decides here can fail: it sees an error of one percent and refuses noise."""
    rng = np.random.default_rng(1)
    values = 1 + 1e-3 * rng.standard_normal((24, 5))
    check(values, 1, 3e-3)
    with pytest.raises(AssertionError, match="expected"):
        check(values, 1.01, 3e-3)
    with pytest.raises(AssertionError, match="noisy"):
        check(1 + rng.standard_normal((24, 5)), 1, 3e-3)
