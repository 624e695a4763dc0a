"""Participating media: every strategy alone, and all together beside ``volpath``.

As in ``test_strategies.py``, with volume vertices. Weighted images of one k add up to ``volpath`` limited to
that k (``volpathmis`` in chromatic media, which `volpath` samples by one channel's density): this tests
transmittances, albedos, phase functions and weights together. Unweighted images of one k estimate the same
integral in k + 1 ways.

Joins of two volume vertices have 1 / d^2 and no bound: a single inner strategy has infinite variance, and its
mean over a render is as a rule a few percent low. So images of s = 0, s = 1 and t = 1 alone are compared tile
by tile, those of inner strategies by the image's mean with a tolerance, and inner strategies also in pairs
with s = 0, weighted between these two only: then whatever is wrong with their values is no longer hidden
behind the other classes' small weights.

Statistics: Welch's t per tile with Sidak's correction and uniformity of p-values, as in
``test_strategies.py``, both at 1e-3; seeds are fixed, and differ between the two sides. Roulette is off.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache

import drjit as dr
import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import variants
import welch as st
from mitsuba_bdpt.image.layers import strategies
from mitsuba_bdpt.media.media import interaction
from mitsuba_bdpt.planning import planner
from mitsuba_bdpt.transport import inputs, light_path
from scipy import stats

DEPTH = 4
SEEDS = 12  # which see all planted bugs (scripts/mutants.py media)
CHANNELS = np.array([0.5, 1.0, 1.5])  # one number per pixel that sees every channel


def cloud():
    return np.random.default_rng(0).random((6, 6, 6))


def microflakes():
    """A phase function whose matrix is no multiple of the identity."""
    matrix = np.array([0.6, 0.2, 0.9, 0.05, -0.1, 0.02], dtype=np.float32)
    values = mi.VolumeGrid(np.tile(matrix, (2, 2, 2, 1)))
    return {"type": "sggx", "S": {"type": "gridvolume", "raw": True, "grid": values}}


def nested():
    """A ball of dense fog in one of thin fog."""
    thin = parts.fog(2, 0.9)
    inner = parts.ball(radius=0.15, interior=parts.fog(8, 0.6), exterior={"type": "ref", "id": "thin"})
    return {
        "thin": thin | {"id": "thin"},
        "ball": parts.ball(interior={"type": "ref", "id": "thin"}),
        "inner": inner,
    }


def mask():
    return {"type": "mask", "opacity": 0.4, "bsdf": parts.matte(0.7, 0.5, 0.3)}


def lamp_in_milk():
    """The lamp's shape says nothing about the milk around it."""
    milk = parts.ball(radius=0.4, center=(0.25, 0.3, -0.2), interior=parts.fog(4, 0.9))
    return parts.room(milk=milk)


def rough_in_fog():
    """A rough boundary with fog on both of its sides, the outer one that of sensor and lamp."""
    around = {"type": "ref", "id": "around"}
    frosted = {"type": "roughdielectric", "alpha": 0.3}
    ball = parts.ball(frosted, interior=parts.fog(6, 0.9), exterior=around)
    return {"around": parts.fog(id="around"), **parts.foggy(around, ball=ball)}


def cloud_box():
    return parts.box(interior=parts.grid(cloud(), parts.LOW, parts.EDGE))


# Balls and boxes with a boundary of plugin null are lit by a point: `volpath` is .6 % too dark behind
# them under a lamp of some area, see `test_media_known_answers.test_fog_lit_by_a_lamp`.
SCENES = {
    "fog": parts.foggy,
    "fog, lens": lambda: parts.foggy(camera=parts.thinlens),
    "rough": lambda: parts.room(
        ball=parts.ball({"type": "roughdielectric", "alpha": 0.3}, interior=parts.fog(6, 0.9))
    ),
    "rough in fog": rough_in_fog,
    "chromatic": lambda: parts.foggy(parts.coloured()),
    "mask": lambda: parts.room(light=parts.point(), ball=parts.ball(mask(), interior=parts.fog(3, 0.7))),
    "nested": lambda: parts.room(light=parts.point(), **nested()),
    "grid": lambda: parts.room(light=parts.point(), ball=cloud_box()),
    "sun and sky": lambda: parts.outdoors(sun=parts.sun(), sky=parts.sky()),
    "glass": lambda: parts.room(ball=parts.ball("dielectric", interior=parts.fog(3, 0.7))),
    "chromatic ball": lambda: parts.room(light=parts.point(), ball=parts.ball(interior=parts.coloured(6.0))),
    "grid and chromatic": lambda: parts.room(
        light=parts.point(),
        ball=cloud_box(),
        other=parts.ball(radius=0.2, center=(0.3, -0.3, -0.2), interior=parts.coloured(4.0)),
    ),
    "ball": lambda: parts.room(ball=parts.ball(interior=parts.fog(4, 0.9))),
    "lamp in milk": lamp_in_milk,
    "microflakes": lambda: parts.room(
        light=parts.point(), ball=parts.ball(interior=parts.fog(4, 0.9) | {"phase": microflakes()})
    ),
}
# Where `volpath` is no reference, and why.
NO_REFERENCE = {
    "ball": "a lamp of some area behind a null boundary, see above",
    "lamp in milk": "so is its lamp",
    "microflakes": "Mitsuba samples another distribution than their density, see the end of this file",
}
CHROMATIC = ("chromatic", "chromatic ball", "grid and chromatic")
SLOW = ("glass", "chromatic ball", "grid and chromatic")


def named(*names):
    """Parameters of a test, those of `SLOW` scenes marked."""
    return [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in names]


@cache
def load(name):
    return mi.load_dict(SCENES[name]())


def bdpt(**more):
    return parts.integrator(skip="none", max_depth=DEPTH, **more)


def layers(tiles):
    """``{(k, s, t): (weighted, unweighted)}`` of (seeds, tiles) from the layers behind RGB."""
    split = tiles[..., 3:].reshape(*tiles.shape[:2], -1, 2, 3) @ CHANNELS
    return {kst: (split[:, :, i, 0], split[:, :, i, 1]) for i, kst in enumerate(strategies(DEPTH))}


@cache
def techniques(name, side):
    """Layers of renders with technique images; sides 0 and 1 have different seeds."""
    return layers(parts.tile_means(load(name), bdpt(layers="strategies"), 64, 1000 + 1000 * side, SEEDS))


@cache
def path_lengths(name):
    """``volpath`` limited to k edges, k = 2 ... `DEPTH`, (seeds, tiles) each.

    It is max_depth k minus max_depth k - 1 of the *same* seed: paths of k edges only.
    """
    kind = "volpathmis" if name in CHROMATIC else "volpath"
    tiles = {
        k: parts.tile_means(load(name), parts.integrator(kind, max_depth=k), 192, 5000, SEEDS) @ CHANNELS
        for k in range(1, DEPTH + 1)
    }
    return {k: tiles[k] - tiles[k - 1] for k in range(2, DEPTH + 1)}


def weighted_sum(found, k):
    return sum(found[k, s, k + 1 - s][0] for s in range(k + 2))


@pytest.mark.parametrize("name", named(*(name for name in SCENES if name not in NO_REFERENCE)))
def test_weighted_strategies_add_up_to_volpath(name):
    """Rationale: see the module. Statistic: Welch per tile, Sidak; Kolmogorov-Smirnov.

    Expected: for k = 2, 3, 4 the weighted images add up to ``volpath`` limited to k.
    """
    shorter, family = path_lengths(name), []
    for k in range(2, DEPTH + 1):
        ours = np.concatenate([weighted_sum(techniques(name, side), k) for side in (0, 1)])
        family.append(st.compare_images(ours, shorter[k], f"k={k}"))
    st.assert_agree(st.Comparisons.join(family), at_least=30)


@pytest.mark.parametrize(
    "name", named("fog", "fog, lens", "ball", "chromatic", "grid", "lamp in milk", "microflakes")
)
def test_unweighted_strategies_agree(name):
    """Rationale: see the module. Lamps in milk say nothing about it, microflakes have a density that is not
    symmetric.

    Expected: for k = 2, 3, 4 the images of s = 0, s = 1 and t = 1, each alone, and the weighted sum have the
    same mean: each is compared with the next one, of other seeds. So has each inner strategy for the whole
    image, within 12 %: the largest difference seen is 7 %, too dark, in milk. Statistic: Welch per tile,
    Sidak; Kolmogorov-Smirnov.
    """
    a, b = techniques(name, 0), techniques(name, 1)
    family, hittable = [], "emitter" in SCENES[name]()["lamp"]
    for k in range(2, DEPTH + 1):
        alone = (0, 1, k) if hittable else (1, k)
        family += [
            st.compare_images(a[k, s, k + 1 - s][1], b[k, u, k + 1 - u][1], f"k={k} s={s} vs s={u}")
            for s, u in itertools.pairwise(alone)
        ]
        expected = b[k, 1, k][1]
        family.append(st.compare_images(weighted_sum(a, k), expected, f"k={k} weighted"))
        for s in range(2, k):
            inner = np.mean([a[k, s, k + 1 - s][1], b[k, s, k + 1 - s][1]])
            assert inner == pytest.approx(expected.mean(), rel=0.12), f"k={k} s={s}"
    st.assert_agree(st.Comparisons.join(family), at_least=30)


# Classes of which the others are left out; with s = 0, which can make all paths here.
PAIRS = {
    "s=1": {"splat": False, "endpoints": False, "arrival": False, "connections": "none"},
    "t=1": {"direct": False, "arrival": False, "connections": "none"},
    "inner": {"direct": False, "splat": False, "endpoints": False, "arrival": False},
    "t=0": {"direct": False, "splat": False, "endpoints": False, "connections": "none"},
}


@pytest.mark.parametrize(
    "name, pair",
    [
        ("fog", "s=1"),
        ("fog", "t=1"),
        ("chromatic", "t=1"),
        ("fog", "inner"),
        ("chromatic", "inner"),
        ("rough", "inner"),
        ("rough in fog", "t=1"),
        ("fog, lens", "t=0"),
    ],
)
def test_each_class_with_hits(name, pair, monkeypatch):
    """Rationale: see the module. Expected: the weighted images of s = 0 and one other class, all others left
    out, add up to ``volpath`` limited to k, k = 2, 3, 4 (for inner joins from k = 3 on, where there are any).
    Statistic: Welch per tile, Sidak; Kolmogorov-Smirnov.
    """
    original = planner.plan
    monkeypatch.setattr(planner, "plan", lambda *args: replace(original(*args), **PAIRS[pair]))
    ours = layers(parts.tile_means(load(name), bdpt(layers="strategies"), 64, 9000, SEEDS))
    family = [
        st.compare_images(weighted_sum(ours, k), path_lengths(name)[k], f"k={k}")
        for k in range(3 if pair == "inner" else 2, DEPTH + 1)
    ]
    st.assert_agree(st.Comparisons.join(family), at_least=30)


def test_thinned_light_subpaths(monkeypatch):
    """Rationale: of long light subpaths in media some vertices are kept, for the others too. Expected: with 2
    vertices kept at most instead of 64 inner strategies and hits, all others left out, add up to ``volpath``
    limited to k, k = 3, 4. Statistic: Welch per tile, Sidak; Kolmogorov-Smirnov.
    """
    original = planner.plan
    monkeypatch.setattr(planner, "plan", lambda *args: replace(original(*args), **PAIRS["inner"]))
    for module in (inputs, light_path):
        monkeypatch.setattr(module, "KEPT", 2)
    ours = layers(parts.tile_means(load("fog"), bdpt(layers="strategies"), 64, 12000, SEEDS))
    family = [st.compare_images(weighted_sum(ours, k), path_lengths("fog")[k], f"k={k}") for k in (3, 4)]
    st.assert_agree(st.Comparisons.join(family), at_least=20)


@pytest.mark.parametrize("variant", [variants.of("mono"), variants.of("spectral")])
def test_colours_agree_with_volpathmis(variant):
    """Rationale: monochromatic variants have one channel, spectral ones four wavelengths that differ from
    sample to sample, for which a medium has no table. Expected: a chromatic ball and a chromatic room beside
    ``volpathmis``, with all strategies and with the default. Statistic: Welch per tile, Sidak;
    Kolmogorov-Smirnov.
    """
    mi.set_variant(variant)
    channels = 1 if mi.is_monochromatic else CHANNELS
    for scene in (
        parts.foggy(parts.coloured()),
        parts.room(light=parts.point(), ball=parts.ball(interior=parts.coloured(6.0))),
    ):
        scene = mi.load_dict(scene)
        reference = parts.tile_means(scene, parts.integrator("volpathmis", max_depth=3), 256, 5000, SEEDS)
        for seed, skip in ((1000, "none"), (2000, "auto")):
            method = parts.integrator(skip=skip, max_depth=3)
            ours = parts.tile_means(scene, method, 128, seed, SEEDS)
            family = st.compare_images((ours * channels).sum(-1), (reference * channels).sum(-1), skip)
            st.assert_agree(family, at_least=10)


# -- densities of microflakes ------------------------------------------------------------------------


def test_microflakes_are_symmetric_with_their_extinction():
    """Rationale: no adjoint factor stands in joins of microflakes, whose density is not symmetric; nor in
    weights, which leave sigma_t out. Expected: for 4,096 pairs of directions sigma_t(w) rho(w -> w') is
    sigma_t(w') rho(w' -> w) to 1e-5 (rounding of float32), while rho alone differs by more than a half for
    some.
    """
    medium = mi.load_dict(parts.fog(4, 0.9) | {"phase": microflakes()})
    rng = np.random.default_rng(3)
    a, b = (mi.warp.square_to_uniform_sphere(mi.Point2f(*rng.random((2, 4096)))) for _ in range(2))

    def asked(wi, wo):
        mei = interaction(mi.Point3f(0) + dr.zeros(mi.Point3f, 4096), -wi, dr.zeros(mi.Ray3f))
        _, density = medium.phase_function().eval_pdf(mi.PhaseFunctionContext(None), mei, wo)
        return np.array(density), np.array(medium.get_majorant(mei))[0]

    (there, sigma_a), (back, sigma_b) = asked(a, b), asked(b, a)
    np.testing.assert_allclose(sigma_a * there, sigma_b * back, rtol=1e-5)
    assert np.abs(there / back - 1).max() > 0.5


def test_our_frames_make_microflakes_sample_their_density():
    """Rationale: Mitsuba 3.9.1's ``sggx`` samples with the transpose of the frame's matrix, which is another
    distribution than its density unless the frame is its own transpose. Expected: for 24 directions of
    arrival the directions sampled have the means of eight functions under the density, in
    `media.interaction`'s frame, and in Mitsuba's own frame they have not (else the frame is needed no more).
    Statistic: z of each mean (65,536 samples and as many uniform directions for the density), chi-squared of
    all of them, level 1e-3.
    """
    phase, ctx, n = mi.load_dict(microflakes()), mi.PhaseFunctionContext(None), 65536
    rng = mi.PCG32(n)

    def pair():
        return mi.Point2f(rng.next_float32(), rng.next_float32())

    def functions(d):
        x, y, z = np.array(d, dtype=np.float64)
        return np.array([x, y, z, x * y, y * z, x * z, x * x, y * y])

    def chi2(frame):
        total = 0.0
        for wi in np.random.default_rng(1).normal(size=(24, 3)):
            wi = mi.Vector3f((wi / np.linalg.norm(wi)).tolist())
            like = dr.zeros(mi.Ray3f)
            mei = interaction(mi.Point3f(0) + dr.zeros(mi.Point3f, n), -wi, like)
            if frame is not None:
                mei.sh_frame = frame(wi)
            sampled, _, _ = phase.sample(ctx, mei, rng.next_float32(), pair())
            uniform = mi.warp.square_to_uniform_sphere(pair())
            _, pdf = phase.eval_pdf(ctx, mei, uniform)
            f, g = functions(sampled), functions(uniform) * np.array(pdf) * 4 * np.pi
            gap = f.mean(1) - g.mean(1)
            # Correlated functions: Mahalanobis.
            covariance = (np.cov(f) + np.cov(g)) / n
            total += gap @ np.linalg.pinv(covariance) @ gap
        return total

    # x^2 + y^2 + z^2 = 1 does not bind the eight functions.
    limit = stats.chi2.isf(1e-3, 24 * 8)
    assert chi2(None) < limit
    assert chi2(mi.Frame3f) > limit
