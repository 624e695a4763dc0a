"""Scenes and BSDFs drawn at random: do all strategies find the same light, and `path`'s?

`CHANCE=10` in the environment tries ten times as many, which is how bugs are looked for.
"""

import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import strategies as st
from light_side import evaluate_adjoint, sample_adjoint
from mitsuba_bdpt.measure.agreement import Sample, sidak, welch
from mitsuba_bdpt.transport import bsdf, spectra
from scipy import stats

from .chance import by_chance
from .compare import LEVEL, tiles
from .generator import Generator

TIMES = int(os.environ.get("CHANCE", "1"))
RANDOM = st.randoms(use_true_random=True)
SEEDS = 8

# Of the image's mean, by how much tiles and the image may be off: joins of surfaces that touch, and the
# normals of coarse meshes, of which strategies see different parts.
TOLERANCE, OF_IMAGE = 0.005, 0.001

# Samples per pixel, and how many times as many where there is a suspicion: a p-value below `SUSPICION`. Rare
# large samples, of which a t-test of eight renders knows nothing, are no finding.
SPP, AGAIN = 48, 8
SUSPICION = 0.02

# What must agree with all strategies. (Camera subpaths alone do not reach a delta emitter through a mask.)
OTHERS = {"defaults": {}, "no inner connections": {"skip": "none", "connections": "none"}}


def p_value(ours, theirs) -> float:
    """Welch's test of differences beyond the tolerance, of tiles and of the image in the last column."""
    assert np.isfinite(ours).all()
    assert np.isfinite(theirs).all()
    mean = theirs[:, -1].mean()
    assert mean > 0
    found = welch(Sample.of(ours), Sample.of(theirs))
    allowed = np.where(np.arange(len(found.p)) == len(found.p) - 1, OF_IMAGE, TOLERANCE) * mean
    beyond = np.maximum(np.abs(found.value) - allowed, 0)
    with np.errstate(all="ignore"):
        p = np.where(found.p < 1, 2 * stats.t.sf(np.nan_to_num(beyond / found.error), found.freedom), 1.0)
    return min(sidak(np.minimum(p, 1)), 1.0)


def compared(scene, beside_path: bool, spp: int, first: int) -> dict[str, float]:
    """`p_value` of each of the `OTHERS` beside all strategies, and of `path`."""
    rest, seeds = {"max_depth": 4, "rr_depth": 50}, range(first + SEEDS, first + 2 * SEEDS)
    everything = tiles(scene, rest | {"skip": "none"}, range(first, first + SEEDS), spp)
    found = {
        name: p_value(tiles(scene, rest | parameters, seeds, spp), everything)
        for name, parameters in OTHERS.items()
    }
    if beside_path:
        found["path"] = p_value(tiles(scene, rest | {"type": "path"}, seeds, 4 * spp), everything)
    return found


@pytest.mark.parametrize(
    "media, beside_path, variant, count",
    [
        (False, False, "llvm_ad_rgb", 6),
        (False, True, "llvm_ad_rgb", 6),
        (False, True, "llvm_ad_spectral", 2),
        (True, False, "llvm_ad_rgb", 4),
    ],
    ids=["surfaces", "path", "spectral", "media"],
)
def test_scenes(media, beside_path, variant, count):
    """Shapes, groups, instances, lamps and nested BSDFs of six scenes; six of what `path` renders right
    (no masks and blends, convex lamps), and two in `llvm_ad_spectral`; four with two bodies of homogeneous
    media and grids.

    Expected: the image with all strategies is that by default, without inner connections and, where it
    renders right, by `path`. t-tests of 4 x 4 tiles over 8 renders, level 1e-3 a comparison; where p < 0.02
    the scene is rendered again with other seeds and 8 times the samples. Tiles may be off by 0.5 % of the
    mean, the image by 0.1 %: rounding where surfaces touch.
    """
    mi.set_variant(variant)

    def check(rng):
        made = Generator(rng, beside_path).scene(media)
        scene = mi.load_dict(made, optimize=False)
        found = compared(scene, beside_path, SPP, 0)
        if min(found.values()) < SUSPICION:
            found = compared(scene, beside_path, AGAIN * SPP, 100)
        print(found)
        assert min(found.values()) >= LEVEL, made

    by_chance(RANDOM, check, count * TIMES)


# Directions of each comparison, and its level: 300 BSDFs have 1800 of them.
DIRECTIONS = 1 << 19
STEPS_LEVEL = 1e-6


def surface(numbers: mi.PCG32):
    """Hits on a plane from all around, at random texture coordinates."""
    si = dr.zeros(mi.SurfaceInteraction3f, DIRECTIONS)
    si.t, si.uv = dr.full(mi.Float, 1, DIRECTIONS), two(numbers)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    wi = mi.warp.square_to_uniform_sphere(two(numbers))
    si.wi = dr.select(wi.z == 0, mi.Vector3f(0, 0, 1), wi)  # of cosines of 0 BSDFs say nothing
    return si


def two(numbers: mi.PCG32):
    return mi.Point2f(numbers.next_float32(), numbers.next_float32())


def seen(w):
    """A smooth function of directions without symmetry."""
    return dr.exp(0.8 * w.x - 0.5 * w.y + 0.4 * w.z)


def test_bsdfs_by_chance():
    """100 BSDFs without bump and normal maps, nested up to three times.

    Expected: what is carried by steps, less their delta events, is the integral of the evaluation, for camera
    and light subpaths: means of 2^19 directions, level 1e-6 each.
    """

    def check(rng):
        made = Generator(rng).bsdf(maps=False)
        plugin = mi.load_dict(made)
        traits = bsdf.Traits.of([plugin])
        for take, evaluate in ((bsdf.sample, bsdf.evaluate), (sample_adjoint, evaluate_adjoint)):
            numbers = mi.PCG32(DIRECTIONS, rng.randrange(1 << 32))
            si = surface(numbers)
            step, _ = take(plugin, si, numbers.next_float32(), two(numbers), mi.Bool(True), traits)
            steps = dr.select(step.delta | spectra.is_zero(step.weight), 0, step.weight * seen(step.wo))
            wo = mi.warp.square_to_uniform_sphere(two(numbers))
            f = evaluate(plugin, si, wo, mi.Bool(True), traits).value * seen(wo) / dr.inv_four_pi
            steps, f = (np.broadcast_to(np.array(x, dtype=np.float64), (3, DIRECTIONS)) for x in (steps, f))
            assert np.isfinite(steps).all(), made
            assert np.isfinite(f).all(), made
            error = np.hypot(steps.std(1), f.std(1)) / np.sqrt(DIRECTIONS)
            off = np.abs(steps.mean(1) - f.mean(1))
            assert (off <= stats.norm.isf(STEPS_LEVEL / 2) * error).all(), (steps.mean(1), f.mean(1), made)

    by_chance(RANDOM, check, 100 * TIMES)
