"""Every strategy alone and all together: technique images, statistically.

Unweighted images of one path length k estimate the same integral in k + 1 ways: that they agree tests
throughputs, densities, adjoint factors, film normalisation, counts. It needs scenes in which the geometry
term is bounded (two points of the wall of a unit sphere have G = 1/4; between convex bodies distances stay
away from zero), else a strategy has infinite variance. Weighted images of one k add up to `path` (`volpath`,
and `volpathmis` in chromatic media) limited to that k: this tests the weights.

Connections of two volume vertices have 1 / d^2 and no bound: a single inner strategy has infinite variance,
and its mean over a render is as a rule a few percent low. So in media images of s = 0, s = 1 and t = 1 alone
are compared tile by tile, those of inner strategies by the image's mean with a tolerance, and inner
strategies also in pairs with s = 0, weighted between these two only.

The sample is the mean of a 4x4-pixel tile in one render; the two images compared never come from the same
seeds, for strategies of one render share subpaths. Welch's t per tile with Šidák's correction over all tiles,
strategies and lengths of a scene, and uniformity of the p-values by Kolmogorov-Smirnov, both at 1e-3. There
is no tolerance besides: an error is found at about 5 standard errors of a tile, which is 1 % of a tile's
value for most strategies here, and 0.3 % for the image. Roulette is off.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import media_parts as fogs
import mitsuba as mi
import numpy as np
import pytest
import variants
import welch as st
from mitsuba_bdpt.image.layers import strategies
from mitsuba_bdpt.planning import planner
from mitsuba_bdpt.transport import inputs, light_path

from scenes import area, ball, camera, integrator, matte, square, thinlens, transform

TILES = 4
CHANNELS = np.array([0.5, 1.0, 1.5])  # one number per pixel that sees every channel


class Scene(NamedTuple):
    """``alone``: the largest k at which technique images alone are compared. ``judge``: Mitsuba's integrator,
    or empty where it is none."""

    parts: Callable
    alone: int = 5
    judge: str = "path"
    variant: str = "rgb"
    depth: int = 5
    seeds: int = 32


# -- scenes of surfaces -------------------------------------------------------------------------

POINT = {"type": "point", "position": [0.2, 0.3, -0.1], "intensity": 1.0}
ROUGH = {"type": "roughconductor", "alpha": 0.4, "distribution": "ggx", "specular_reflectance": 0.9}
MATTE = (0.7, 0.5, 0.3)


def inside(sensor=camera, **more):
    """Inside of the wall, with other things well apart."""
    return {"sensor": sensor(), "wall": fogs.wall(), **more}


def beside_a_ball(left, right=None):
    more = {"lamp": fogs.lamp(), "left": ball(left, 0.3, [-0.35, -0.25, -0.25])}
    return inside(**more, **({"right": ball(right, 0.2, [0.3, -0.3, -0.2])} if right else {}))


def outside(**more):
    """Three separated balls in the open."""
    return {
        "sensor": camera(origin=(0, 0.3, 4), target=(0, 0, 0), fov=35),
        "a": ball(matte(*MATTE), 0.5, [-0.75, 0, 0]),
        "b": ball(ROUGH, 0.5, [0.65, 0.2, -0.3]),
        "c": ball(matte(*MATTE), 0.8, [0, -1.6, -0.2]),
        **more,
    }


def squares():
    disk = transform().translate([-0.3, -0.4, -0.2]).rotate([1, 0, 0], -80).scale(0.25)
    emitter = area(4.0) | {"sampling_weight": 2.5}
    lamp = square((-0.2, 0.45, -0.2), ([1, 0, 0], 70), 0.25, matte(0), emitter=area(6.0))
    return inside(lamp=lamp, other={"type": "disk", "bsdf": matte(0), "to_world": disk, "emitter": emitter})


def spot():
    look = transform().look_at([0.1, 0.3, 0.1], [-0.3, -0.5, -1], [0, 1, 0])
    return {"type": "spot", "intensity": 4.0, "cutoff_angle": 50, "beam_width": 30, "to_world": look}


def gold():
    """Under a lamp of another colour."""
    glow = {"type": "spectrum", "value": [(400, 1), (500, 3), (600, 6), (700, 8)]}
    metal = {"type": "roughconductor", "material": "Au", "alpha": 0.3}
    return inside(lamp=fogs.lamp(emitter=area(glow)), gold=ball(metal, 0.3, [-0.35, -0.25, -0.25]))


def open_air():
    lamp = ball(matte(0), 0.4, [0, 1.4, 0.6], emitter=area(8.0))
    return outside(sky=fogs.sky(), sun=fogs.sun(), lamp=lamp)


GLASS = {"type": "dielectric", "int_ior": 1.5}
PLASTIC = {"type": "plastic", "diffuse_reflectance": 0.6}

# In the open, longer paths come in lumps too rare for tile means to be normal; beside delta surfaces none is
# compared. On the glowing wall `path` is 0.25 % too bright: it samples a sphere's inside by an area density,
# and takes back another.
SURFACES = {
    "quad and disk lamps": Scene(squares),
    "glowing wall": Scene(lambda: {"sensor": camera(), "wall": fogs.wall(emitter=area(0.5))}, judge=""),
    "spot": Scene(lambda: inside(lamp=spot())),
    "point and thin lens": Scene(lambda: inside(thinlens, lamp=POINT)),
    "ball lamp and thin lens": Scene(lambda: inside(thinlens, lamp=fogs.lamp())),
    "rough metal": Scene(lambda: beside_a_ball(ROUGH)),
    "sky": Scene(lambda: outside(sky=fogs.sky()), 3),
    "sun, sky and lamp": Scene(open_air, 2),
    "glass and plastic": Scene(lambda: beside_a_ball(GLASS, PLASTIC), 0),
    "glass and metal": Scene(lambda: beside_a_ball(GLASS, ROUGH), 0, judge=""),
    "gold in mono": Scene(gold, 4, "", "mono", 4),
    "gold in spectral": Scene(gold, 4, "", "spectral", 4),
}

# -- scenes of media ----------------------------------------------------------------------------


def microflakes():
    """A phase function whose matrix is no multiple of the identity."""
    matrix = np.array([0.6, 0.2, 0.9, 0.05, -0.1, 0.02], dtype=np.float32)
    values = mi.VolumeGrid(np.tile(matrix, (2, 2, 2, 1)))
    return {"type": "sggx", "S": {"type": "gridvolume", "raw": True, "grid": values}}


def lit(**more):
    return fogs.room(light=fogs.point(), **more)


def nested():
    """A ball of dense fog in one of thin fog."""
    thin = {"type": "ref", "id": "thin"}
    inner = fogs.ball(radius=0.15, interior=fogs.fog(8, 0.6), exterior=thin)
    return {"thin": fogs.fog(2, 0.9, id="thin"), **lit(ball=fogs.ball(interior=thin), inner=inner)}


def lamp_in_milk():
    """The lamp's shape says nothing about the milk around it."""
    return fogs.room(milk=fogs.ball(radius=0.4, center=(0.25, 0.3, -0.2), interior=fogs.fog(4, 0.9)))


def rough_in_fog():
    """A rough boundary with fog on both of its sides, the outer one that of sensor and lamp."""
    around, frosted = {"type": "ref", "id": "around"}, {"type": "roughdielectric", "alpha": 0.3}
    shell = fogs.ball(frosted, interior=fogs.fog(6, 0.9), exterior=around)
    return {"around": fogs.fog(id="around"), **fogs.foggy(around, ball=shell)}


def cloud():
    values = np.random.default_rng(0).random((6, 6, 6))
    return fogs.box(interior=fogs.grid(values, fogs.LOW, fogs.EDGE))


def chromatic_cloud():
    other = fogs.ball(radius=0.2, center=(0.3, -0.3, -0.2), interior=fogs.coloured(4.0))
    return lit(ball=cloud(), other=other)


def in_a_ball(medium, bsdf="null", light=fogs.point):
    return fogs.room(light=light(), ball=fogs.ball(bsdf, interior=medium))


def mask():
    return in_a_ball(fogs.fog(3, 0.7), {"type": "mask", "opacity": 0.4, "bsdf": matte(*MATTE)})


def frosted():
    return in_a_ball(fogs.fog(6, 0.9), {"type": "roughdielectric", "alpha": 0.3}, fogs.lamp)


def in_fog(parts, alone=0, judge="volpath"):
    return Scene(parts, alone, judge, depth=4, seeds=12)  # which see all planted bugs


# Balls and boxes with a boundary of plugin null are lit by a point: `volpath` is .6 % too dark behind them
# under a lamp of some area. Mitsuba samples microflakes by another distribution than their density, see
# `test_media`.
MEDIA = {
    "fog": in_fog(fogs.foggy, 4),
    "fog, lens": in_fog(lambda: fogs.foggy(camera=fogs.thinlens), 4),
    "rough": in_fog(frosted),
    "rough in fog": in_fog(rough_in_fog),
    "chromatic": in_fog(lambda: fogs.foggy(fogs.coloured()), 4, "volpathmis"),
    "mask": in_fog(mask),
    "nested": in_fog(nested),
    "grid": in_fog(lambda: lit(ball=cloud()), 4),
    "chromatic ball": in_fog(lambda: in_a_ball(fogs.coloured(6.0)), 0, "volpathmis"),
    "grid and chromatic": in_fog(chromatic_cloud, 0, "volpathmis"),
    "ball": in_fog(lambda: in_a_ball(fogs.fog(4, 0.9), light=fogs.lamp), 4, ""),
    "lamp in milk": in_fog(lamp_in_milk, 4, ""),
    "microflakes": in_fog(lambda: in_a_ball(fogs.fog(4, 0.9) | {"phase": microflakes()}), 4, ""),
}
SCENES = SURFACES | MEDIA


@cache
def load(name):
    mi.set_variant(variants.of(SCENES[name].variant))
    return mi.load_dict({"type": "scene"} | SCENES[name].parts())


def bdpt(name, **more):
    return integrator(**{"skip": "none", "max_depth": SCENES[name].depth} | more)


def tile_means(name, method, spp, first_seed):
    """Tile means of renders, (seeds, tiles, channels)."""
    scene = load(name)
    return np.stack(
        [
            st.tile_means(mi.render(scene, integrator=method, spp=spp, seed=first_seed + i), TILES)
            for i in range(SCENES[name].seeds)
        ]
    )


@cache
def techniques(name, side, **options):
    """``{(k, s): (weighted, unweighted)}`` of (seeds, tiles); sides 0 and 1 have different seeds."""
    load(name)  # in its variant
    found = tile_means(name, bdpt(name, layers="strategies", **options), 64, 1000 + 1000 * side)
    every = strategies(SCENES[name].depth)
    split = found[..., -6 * len(every) :].reshape(*found.shape[:2], -1, 2, 3) @ CHANNELS
    return {(k, s): (split[:, :, i, 0], split[:, :, i, 1]) for i, (k, s, _) in enumerate(every)}


@cache
def path_lengths(name):
    """The judge limited to k edges, (seeds, tiles) each.

    It is max_depth k minus max_depth k - 1 of the *same* seed, which draw the same numbers. Three or four
    times the samples of `techniques`: in faint tiles means of few are lumps, not normal.
    """
    depth, spp, tiles = SCENES[name].depth, 192 if name in MEDIA else 256, {0: 0}
    for k in range(1, depth + 1):
        tiles[k] = tile_means(name, integrator(SCENES[name].judge, max_depth=k), spp, 5000) @ CHANNELS
    return {k: tiles[k] - tiles[k - 1] for k in range(1, depth + 1)}


def weighted_sum(images, k):
    return sum(images[k, s][0] for s in range(k + 2) if (k, s) in images)


def possible(name, k, s):
    """Whether the strategy can make all paths of ``k`` edges in this scene of no delta surfaces."""
    parts = SCENES[name].parts().values()
    hittable = any("emitter" in p or p["type"] == "constant" for p in parts)
    delta = any(p["type"] in ("point", "spot", "directional") for p in parts)
    lens = any(p["type"] == "thinlens" for p in parts)
    if k == 1:  # delta emitters are seen by a lens only, and hit by nothing
        return (hittable and not (delta and lens)) if s == 0 else (hittable or lens)
    return hittable and not delta if s == 0 else True


def assert_agree(family, at_least):
    st.assert_agree(st.Comparisons.join(family), at_least=at_least)


@pytest.mark.parametrize("name", [name for name, scene in SURFACES.items() if scene.alone])
def test_unweighted_strategies_agree(name):
    """Each strategy against the next of the same k and of other seeds: no image serves twice."""
    a, b, family = techniques(name, 0), techniques(name, 1), []
    for k in range(1, SCENES[name].alone + 1):
        usable = [s for s in range(k + 1) if possible(name, k, s)]
        family += [
            st.compare_images(a[k, s][1], b[k, u][1], f"k={k} s={s} vs s={u}")
            for s, u in itertools.pairwise(usable)
        ]
    assert_agree(family, 25)


@pytest.mark.parametrize("name", [name for name, scene in MEDIA.items() if scene.alone])
def test_unweighted_strategies_agree_in_media(name):
    """s = 0, s = 1 and t = 1, each alone, and the weighted sum; each inner strategy for the whole image,
    within 12 %: the largest difference seen is 7 %, too dark, in milk."""
    a, b, family = techniques(name, 0), techniques(name, 1), []
    hittable = "emitter" in MEDIA[name].parts()["lamp"]
    for k in range(2, MEDIA[name].depth + 1):
        alone = (0, 1, k) if hittable else (1, k)
        family += [
            st.compare_images(a[k, s][1], b[k, u][1], f"k={k} s={s} vs s={u}")
            for s, u in itertools.pairwise(alone)
        ]
        expected = b[k, 1][1]
        family.append(st.compare_images(weighted_sum(a, k), expected, f"k={k} weighted"))
        for s in range(2, k):
            found = np.mean([a[k, s][1], b[k, s][1]])
            assert found == pytest.approx(expected.mean(), rel=0.12), f"k={k} s={s}"
    assert_agree(family, 30)


@pytest.mark.parametrize("name", [name for name, scene in SCENES.items() if scene.judge])
def test_weighted_strategies_add_up(name):
    """To the judge's image of each path length. `path` does not see a point through a lens (k = 1)."""
    shorter, family = path_lengths(name), []
    for k in range(2 if name == "point and thin lens" or name in MEDIA else 1, SCENES[name].depth + 1):
        ours = np.concatenate([weighted_sum(techniques(name, side), k) for side in (0, 1)])
        family.append(st.compare_images(ours, shorter[k], f"k={k}"))
    assert_agree(family, 30)


def test_glowing_wall_is_known():
    """Agreement with each other does not exclude a common factor: 0.5 r^(k-1) everywhere."""
    images, family = techniques("glowing wall", 0), []
    for k in range(1, 6):
        known = 0.5 * np.array(MATTE) ** (k - 1) @ CHANNELS
        family.append(st.compare_known(weighted_sum(images, k), known, f"k={k} weighted"))
        family += [st.compare_known(images[k, s][1], known, f"k={k} s={s}") for s in range(k + 1)]
    assert_agree(family, 100)


@pytest.mark.parametrize(
    "options",
    [{}, {"light_paths": 0.25}, {"heuristic": "power"}, {"light_paths": 0}, {"connections": "none"}],
    ids=str,
)
def test_weighted_layers_are_the_image(options):
    """To 1e-4 of the image's mean: sums of 64 x 30 numbers per pixel, in another order."""
    method = bdpt("glass and metal", layers="strategies", **options)
    image = np.array(mi.render(load("glass and metal"), integrator=method, spp=64, seed=3), dtype=float)
    parts = image[..., 3:].reshape(16, 16, -1, 2, 3)[..., 0, :]
    np.testing.assert_allclose(parts.sum(2), image[..., :3], atol=1e-4 * image[..., :3].mean())
    assert len(method.aov_names()) == image.shape[2] - 3


# Classes of which the others are left out; with s = 0, which can make all paths here.
PAIRS = {
    "s=1": {"splat": False, "endpoints": False, "arrival": False, "connections": "none"},
    "t=1": {"direct": False, "arrival": False, "connections": "none"},
    "inner": {"direct": False, "splat": False, "endpoints": False, "arrival": False},
    "t=0": {"direct": False, "splat": False, "endpoints": False, "connections": "none"},
}


@pytest.mark.parametrize(
    "name, pair, kept",
    [
        *(("fog", pair, None) for pair in ("s=1", "t=1", "inner")),
        *(("chromatic", pair, None) for pair in ("t=1", "inner")),
        ("rough", "inner", None),
        ("rough in fog", "t=1", None),
        ("fog, lens", "t=0", None),
        ("fog", "inner", 2),
    ],
)
def test_each_class_with_hits(name, pair, kept, monkeypatch):
    """s = 0 and one other class, all others left out, add up to the judge (inner connections from k = 3 on);
    also where of long light subpaths in media only ``kept`` vertices are kept, for the others too."""
    original = planner.plan
    monkeypatch.setattr(planner, "plan", lambda *args: replace(original(*args), **PAIRS[pair]))
    for module in (inputs, light_path) if kept else ():
        monkeypatch.setattr(module, "KEPT", kept)
    ours = techniques.__wrapped__(name, 8)
    lengths = range(3 if pair == "inner" else 2, 5)
    assert_agree(
        [st.compare_images(weighted_sum(ours, k), path_lengths(name)[k], f"k={k}") for k in lengths], 20
    )


def test_statistics_find_what_they_should_and_no_more():
    """Normal samples of unequal variance, 200 families of 50 comparisons: families of equal means fall below
    a level of 5 % in 5 % of the cases (10 of 200; between 2 and 22 with a chance of 99.9 %), p-values are
    uniform; a shift of 6 standard errors in one tile of 50 is found, and one of 0.7 in all of them; zero
    noise and equal means is no finding, zero noise and unequal means is."""
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
