"""Every strategy alone and all together: technique images, statistically.

Unweighted images of one path length k estimate the same integral by k + 1 different ways: that they
agree tests throughputs, densities, adjoint factors, film normalisation, counts. It needs scenes in
which the geometry term is bounded (inside a unit sphere two wall points have G = 1/4; between
separated convex bodies distances stay away from zero), else a single strategy has infinite variance.
Weighted images of one k add up to ``path`` limited to that k: this tests the weights.

Statistics (see ``statistics.py``): the sample is the mean of a 4x4-pixel tile (16 of them, and the
image) in one render; 32 renders per side with seeds of their own; the two images compared never come
from the same seeds, for strategies of one render share subpaths. Welch's t per tile with Sidak's
correction over all tiles, strategies and lengths of a scene, and uniformity of the p-values by
Kolmogorov-Smirnov, both at 1e-3; seeds are fixed. There is no tolerance besides: an error counts as
found at about 5 standard errors of a tile, which is about 1 % of a tile's value for most strategies
here, and 0.3 % for the image.

Roulette is off (``rr_depth`` 100) except where it is the subject.
"""

from __future__ import annotations

import itertools
from functools import cache

import internals
import mitsuba as mi
import numpy as np
import pytest
import welch as st
from mitsuba_bdpt.image.layers import strategies
from views import camera as sensor
from views import thinlens

DEPTH = 5
SEEDS = 32
SIZE, TILES = 16, 4
CHANNELS = np.array([0.5, 1.0, 1.5])  # one number per pixel that sees every channel

T = mi.ScalarTransform4f


def gray(x):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": x}}


WALL = {"type": "sphere", "flip_normals": True, "bsdf": gray([0.7, 0.5, 0.3])}
BALL_LAMP = {
    "type": "sphere",
    "center": [0.25, 0.3, -0.2],
    "radius": 0.2,
    "bsdf": gray(0.0),
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [5, 4, 3]}},
}
QUAD_LAMP = {
    "type": "rectangle",
    "bsdf": gray(0.0),
    "to_world": T().translate([-0.2, 0.45, -0.2]).rotate([1, 0, 0], 70).scale(0.25),
    "emitter": {"type": "area", "radiance": 6.0},
}
DISK_LAMP = {
    "type": "disk",
    "bsdf": gray(0.0),
    "to_world": T().translate([-0.3, -0.4, -0.2]).rotate([1, 0, 0], -80).scale(0.25),
    "emitter": {"type": "area", "radiance": 4.0, "sampling_weight": 2.5},
}
POINT = {"type": "point", "position": [0.2, 0.3, -0.1], "intensity": 1.0}
SPOT = {
    "type": "spot",
    "intensity": 4.0,
    "cutoff_angle": 50,
    "beam_width": 30,
    "to_world": T().look_at([0.1, 0.3, 0.1], [-0.3, -0.5, -1], [0, 1, 0]),
}
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.8, 1.1]}}
SUN = {"type": "directional", "direction": [0.3, -1, -0.5], "irradiance": 3.0}


MATTE = gray([0.7, 0.5, 0.3])
ROUGH = {"type": "roughconductor", "alpha": 0.4, "distribution": "ggx", "specular_reflectance": 0.9}
GLASS = {"type": "dielectric", "int_ior": 1.5}
PLASTIC = {"type": "plastic", "diffuse_reflectance": 0.6}
NEAR_LAMP = {
    "type": "sphere",
    "center": [0, 1.4, 0.6],
    "radius": 0.4,
    "bsdf": gray(0.0),
    "emitter": {"type": "area", "radiance": 8.0},
}


def inside(left, right=None):
    """Inside the wall with a ball lamp and one or two more balls, all well apart."""
    scene = {
        "sensor": sensor(),
        "wall": WALL,
        "lamp": BALL_LAMP,
        "left": {"type": "sphere", "center": [-0.35, -0.25, -0.25], "radius": 0.3, "bsdf": left},
    }
    if right:
        scene["right"] = {"type": "sphere", "center": [0.3, -0.3, -0.2], "radius": 0.2, "bsdf": right}
    return scene


def outside():
    """Three separated balls in the open."""
    return {
        "sensor": sensor(origin=(0, 0.3, 4), target=(0, 0, 0), fov=35),
        "a": {"type": "sphere", "center": [-0.75, 0, 0], "radius": 0.5, "bsdf": MATTE},
        "b": {"type": "sphere", "center": [0.65, 0.2, -0.3], "radius": 0.5, "bsdf": ROUGH},
        "c": {"type": "sphere", "center": [0, -1.6, -0.2], "radius": 0.8, "bsdf": MATTE},
    }


# name: (scene, largest k at which technique images alone are compared). In the open, longer paths
# come in lumps too rare for tile means to be normal; beside delta surfaces none is compared.
SCENES = {
    "quad and disk lamps": (
        {"sensor": sensor(), "wall": WALL, "lamp": QUAD_LAMP, "other": DISK_LAMP},
        5,
    ),
    "glowing wall": (
        {"sensor": sensor(), "wall": WALL | {"emitter": {"type": "area", "radiance": 0.5}}},
        5,
    ),
    "spot": ({"sensor": sensor(), "wall": WALL, "lamp": SPOT}, 5),
    "point and thin lens": ({"sensor": thinlens(), "wall": WALL, "lamp": POINT}, 5),
    "ball lamp and thin lens": ({"sensor": thinlens(), "wall": WALL, "lamp": BALL_LAMP}, 5),
    "rough metal": (inside(ROUGH), 5),
    "sky": (outside() | {"sky": SKY}, 3),
    "sun, sky and lamp": (outside() | {"sky": SKY, "sun": SUN, "lamp": NEAR_LAMP}, 2),
    "glass and plastic": (inside(GLASS, PLASTIC), 0),
    "glass and metal": (inside(GLASS, ROUGH), 0),
}


@cache
def load(name):
    return mi.load_dict({"type": "scene", **SCENES[name][0]})


def bdpt(**more):
    return internals.bdpt(**{"skip": "none", "rr_depth": 100, "max_depth": DEPTH, **more})


def renders(scene, integrator, spp, first_seed, seeds=SEEDS):
    """Tile means of ``seeds`` renders, (seeds, tiles, channels)."""
    return np.stack(
        [
            st.tile_means(mi.render(scene, integrator=integrator, spp=spp, seed=first_seed + i), TILES)
            for i in range(seeds)
        ]
    )


def layers(tiles):
    """``{(k, s, t): (weighted, unweighted)}`` of (seeds, tiles) from the layers behind RGB."""
    parts = tiles[..., 3:].reshape(*tiles.shape[:2], -1, 2, 3) @ CHANNELS
    return {kst: (parts[:, :, i, 0], parts[:, :, i, 1]) for i, kst in enumerate(strategies(DEPTH))}


@cache
def techniques(name, side, options=()):
    """Layers of 32 renders with technique images; sides 0 and 1 have different seeds."""
    integrator = bdpt(layers="strategies", **dict(options))
    return layers(renders(load(name), integrator, 64, 1000 + 1000 * side))


@cache
def path_lengths(name):
    """``path`` limited to k edges, k = 1 ... 5, (seeds, tiles) each.

    It is max_depth k minus max_depth k - 1 of the *same* seed, which draw the same numbers: the
    difference holds paths of k edges only, without the noise of shorter ones. The seeds are none of
    `techniques`. Four times its samples: in faint tiles `path`'s means of few are lumps, not normal.
    """
    tiles = [0] + [
        renders(load(name), mi.load_dict({"type": "path", "max_depth": k, "rr_depth": 100}), 256, 5000)
        @ CHANNELS
        for k in range(1, DEPTH + 1)
    ]
    return {k: tiles[k] - tiles[k - 1] for k in range(1, DEPTH + 1)}


def possible(name, k, s):
    """Whether the strategy can make all paths of ``k`` edges in this scene of no delta surfaces."""
    parts = SCENES[name][0].values()
    hittable = any("emitter" in p or p["type"] == "constant" for p in parts)
    delta = any(p["type"] in ("point", "spot", "directional") for p in parts)
    lens = SCENES[name][0]["sensor"]["type"] == "thinlens"
    if k == 1:  # delta emitters are seen by a lens only, and hit by nothing
        return (hittable and not (delta and lens)) if s == 0 else (hittable or lens)
    return hittable and not delta if s == 0 else True


def unweighted_family(a, b, name):
    """Each strategy of seeds ``a`` against the next of the same k of seeds ``b``: no image serves
    twice."""
    family = []
    for k in range(1, SCENES[name][1] + 1):
        usable = [s for s in range(k + 1) if possible(name, k, s)]
        family += [
            st.compare_images(a[k, s, k + 1 - s][1], b[k, u, k + 1 - u][1], f"k={k} s={s} vs s={u}")
            for s, u in itertools.pairwise(usable)
        ]
    return st.Comparisons.join(family)


def weighted_sum(images, k):
    return sum(images[k, s, k + 1 - s][0] for s in range(k + 2))


@pytest.mark.parametrize("name", [name for name, (_, k) in SCENES.items() if k])
def test_unweighted_strategies_agree(name):
    """Rationale: see the module. Statistic: Welch per tile, Sidak; Kolmogorov-Smirnov.

    Expected: for k = 1 ... 5 (as far as bounded) each strategy's own estimate has the mean of the
    next one's.
    """
    family = unweighted_family(techniques(name, 0), techniques(name, 1), name)
    st.assert_agree(family, at_least=25)


@pytest.mark.parametrize("name", [name for name in SCENES if name not in ("glowing wall", "glass and metal")])
def test_weighted_strategies_add_up_to_path(name):
    """Rationale: see the module. Statistic: Welch per tile, Sidak; Kolmogorov-Smirnov.

    Expected: for k = 1 ... 5 the weighted images of 64 renders add up to ``path`` limited to k.
    Left out are k = 1 with a point light and a lens, which ``path`` does not see, and the glowing
    wall, where ``path`` itself is 0.25 % too bright (it samples a sphere's inside by an area
    density and takes back another); its values are known, see the next test.
    """
    shorter = path_lengths(name)
    family = []
    for k in range(2 if name == "point and thin lens" else 1, DEPTH + 1):
        ours = np.concatenate([weighted_sum(techniques(name, side), k) for side in (0, 1)])
        family.append(st.compare_images(ours, shorter[k], f"k={k}"))
    st.assert_agree(st.Comparisons.join(family), at_least=40)


def test_glowing_wall_is_known():
    """Rationale: agreement with each other does not exclude a common factor.

    A unit sphere of reflectance r that emits 0.5 has exactly 0.5 r^(k-1) from paths of k edges,
    everywhere. Expected: each unweighted strategy and the weighted sum have this mean. Statistic:
    Student's t per tile, Sidak; Kolmogorov-Smirnov.
    """
    images, family = techniques("glowing wall", 0), []
    for k in range(1, DEPTH + 1):
        known = 0.5 * np.array([0.7, 0.5, 0.3]) ** (k - 1) @ CHANNELS
        family.append(st.compare_known(weighted_sum(images, k), known, f"k={k} weighted"))
        family += [st.compare_known(images[k, s, k + 1 - s][1], known, f"k={k} s={s}") for s in range(k + 1)]
    st.assert_agree(st.Comparisons.join(family), at_least=100)


# What changes counts, coefficients, weights and roulette, but no expectation.
OPTIONS = {
    "power": {"heuristic": "power"},
    "one quarter": {"light_paths": 0.25},
    "n1c0": {"connections": "none"},
    "n0c0": {"light_paths": 0},
    "two vertices": {"stored_vertices": 2},
    "three vertices": {"stored_vertices": 3, "light_paths": 0.25},
    "one connection": {"connections": "one"},
    "impossible": {"skip": "impossible"},
    "impossible, power": {"skip": "impossible", "heuristic": "power", "connections": "all"},
    "independent": {"points": "independent", "light_paths": 0.5},
}


@cache
def path_image(name):
    """``path`` of up to 5 edges, (seeds, tiles)."""
    integrator = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": 100})
    return renders(load(name), integrator, 128, 7000, 48) @ CHANNELS


LONGER = ("three vertices", "impossible, power", "independent")  # each a variation of another


@pytest.mark.parametrize(
    "options",
    [pytest.param(name, marks=[pytest.mark.slow] if name in LONGER else []) for name in OPTIONS],
)
def test_images_agree_with_path(options):
    """Rationale: any heuristic, counts, coefficients and roulette leave the image's mean alone.

    Glass makes paths that only some classes can make. Expected: the mean of 32 renders equals
    ``path``'s of other seeds. Statistic: Welch per tile, Sidak; Kolmogorov-Smirnov.
    """
    name = "glass and metal"
    ours = renders(load(name), bdpt(**OPTIONS[options]), 64, 9000) @ CHANNELS
    st.assert_agree(st.compare_images(ours, path_image(name)), at_least=16)


def test_unweighted_strategies_ignore_counts_and_coefficients():
    """Rationale: an unweighted layer is the strategy's own estimate, whatever the settings.

    Expected: with a quarter of the light subpaths and kappa = n / 4 it has the mean that it has
    with all of them. Statistic: Welch per tile, Sidak; Kolmogorov-Smirnov.
    """
    thinned = bdpt(layers="strategies", light_paths=0.25, skip="impossible")
    thinned = layers(renders(load("rough metal"), thinned, 64, 11000))
    full = techniques("rough metal", 0)
    family = [
        st.compare_images(thinned[key][1], full[key][1], f"s={key[1]} t={key[2]}")
        for key in strategies(DEPTH)
        if key[2] > 0  # a pinhole has no t = 0
    ]
    st.assert_agree(st.Comparisons.join(family), at_least=100)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"light_paths": 0.25},
        {"heuristic": "power"},
        {"skip": "impossible"},
        {"light_paths": 0},
        {"connections": "none"},
    ],
)
def test_weighted_layers_are_the_image(options):
    """Rationale: layers and image are two records of the same contributions.

    Expected: in one render RGB equals the sum of the weighted layers to 1e-4 of the image's mean
    (sums of 64 x 30 float32 numbers per pixel, in another order). No statistic.
    """
    integrator = bdpt(layers="strategies", **options)
    image = mi.render(load("glass and metal"), integrator=integrator, spp=64, seed=3)
    image = np.array(image, dtype=float)
    parts = image[..., 3:].reshape(SIZE, SIZE, -1, 2, 3)[..., 0, :]
    np.testing.assert_allclose(parts.sum(2), image[..., :3], atol=1e-4 * image[..., :3].mean())
    assert len(integrator.aov_names()) == image.shape[2] - 3


# -- the statistics themselves -----------------------------------------------------------------------


def test_statistics_find_what_they_should_and_no_more():
    """Rationale: a test that cannot fail, or fails at random, tests nothing.

    Normal samples of unequal variance, 200 families of 50 comparisons: Expected: families of equal
    means fall below a level of 5 % in 5 % of the cases (10 of 200; between 2 and 22 with a chance
    of 99.9 %), p-values are uniform; a shift of 6 standard errors in one tile of 50 is found, and
    so is one of 0.7 standard errors in all of them; zero noise and equal means is no finding, zero
    noise and unequal means is.
    """
    rng = np.random.default_rng(4)
    a, b = rng.normal(1, 0.1, (200, 32, 50)), rng.normal(1, 0.3, (200, 40, 50))
    families = [st.welch(x, y) for x, y in zip(a, b, strict=True)]
    assert 2 <= sum(st.sidak(f.p) < 0.05 for f in families) <= 22
    assert st.uniformity(np.concatenate([f.p for f in families])) > 1e-3
    st.assert_agree(families[0])

    error = np.hypot(0.1 / 32**0.5, 0.3 / 40**0.5)
    one = a[0].copy()
    one[:, 7] += 6 * error
    everywhere = a[0] + 0.7 * error
    for shifted in (st.compare_images(one, b[0]), st.compare_images(everywhere, b[0])):
        with pytest.raises(AssertionError, match="Sidak"):
            st.assert_agree(shifted)
    constant = np.ones((32, 4))
    assert (st.welch(constant, constant * (1 + 1e-6)).p == 1).all()
    assert (st.welch(constant, constant * 1.001).p == 0).all()
    with pytest.raises(AssertionError, match="noise"):
        st.assert_agree(st.welch(constant, constant))
    with pytest.raises(AssertionError, match="uniform"):  # one image compared with itself
        st.assert_agree(st.welch(a[0], a[0] + rng.normal(0, 1e-3, a[0].shape)))


def test_tile_means():
    """Expected: tiles in row order, each the mean of its pixels and channels apart."""
    image = np.arange(4 * 8 * 2, dtype=float).reshape(4, 8, 2)
    tiles = st.tile_means(image, 2)
    assert tiles.shape == (4, 2)
    np.testing.assert_allclose(tiles[1], image[:2, 4:].mean((0, 1)))
