"""Scene files and BSDFs drawn at random: do all strategies find the same light, and `path`'s?

More of them, which is how bugs are looked for: `python -m stress_cases.by_chance NAME FIRST LAST`, in
the folder tests, with the name of a case and two seeds; it prints those that are not as expected, and
their XML.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from mitsuba_bdpt.measure.agreement import Sample, sidak, welch
from scipy import stats

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

from mitsuba_bdpt.transport import bsdf, spectra

from .agreement import LEVEL, smallest_seen, tiles
from .case import Outcome, of_section
from .light_side import evaluate_adjoint, sample_adjoint
from .random_files import Generator, write_assets

SEEDS = 8

# Of the image's mean, by how much tiles and the image may be off: joins of surfaces that touch, and the
# normals of coarse meshes, of which strategies see different parts.
TOLERANCE, OF_IMAGE = 0.005, 0.001

# Samples per pixel, and how many times as many where there is a suspicion: a p-value below `SUSPICION`. Rare
# large samples, of which a t-test of eight renders knows nothing, are no finding.
SPP, AGAIN = 48, 8
SUSPICION = 0.02

# What must agree with all strategies. (Camera subpaths alone do not reach a delta emitter through a mask.)
WAYS = {"default parameters": {}, "no inner connections": {"skip": "none", "connections": "none"}}


@dataclass(frozen=True)
class Kind:
    """Of which scenes: with or without media, plain ones also beside `path`; in which variant."""

    media: bool = False
    plain: bool = False
    variant: str = "llvm_ad_rgb"


@dataclass(frozen=True)
class Difference:
    """p-value of differences beyond the tolerance, the largest of them, and what of the mean would be seen.

    The p-value is Sidak's of all tiles and the image, the differences are relative to the image's mean, and
    of the image's mean an error of ``seen`` has a chance of one half to be found at `LEVEL`.
    """

    p: float
    gap: float
    seen: float


def _differ(ours, theirs) -> Difference:
    """Welch's test of tiles, and of the image in the last column. Raises ``ValueError`` for NaN and black."""
    if not (np.isfinite(ours).all() and np.isfinite(theirs).all()):
        raise ValueError("values that are not finite")
    mean = theirs[:, -1].mean()
    if not mean > 0:
        raise ValueError("a black image")
    found = welch(Sample.of(ours), Sample.of(theirs))
    allowed = np.where(np.arange(len(found.p)) == len(found.p) - 1, OF_IMAGE, TOLERANCE) * mean
    beyond = np.maximum(np.abs(found.value) - allowed, 0)
    with np.errstate(all="ignore"):
        p = np.where(found.p < 1, 2 * stats.t.sf(np.nan_to_num(beyond / found.error), found.freedom), 1.0)
    seen = OF_IMAGE + smallest_seen(found, mean)
    return Difference(min(sidak(np.minimum(p, 1)), 1.0), float((beyond / mean).max()), seen)


def _compared(scene, plain, spp: int, first_seed: int) -> dict[str, Difference]:
    """`_differ` of each of the `WAYS`, and of Mitsuba's integrator in ``plain`` if it is a scene."""
    rest, first = {"max_depth": 4, "rr_depth": 50}, range(first_seed, first_seed + SEEDS)
    everything = tiles(scene, {"type": "bdpt", "skip": "none", **rest}, first, spp)
    seeds = range(first_seed + SEEDS, first_seed + 2 * SEEDS)
    found = {
        name: _differ(tiles(scene, {"type": "bdpt", **parameters, **rest}, seeds, spp), everything)
        for name, parameters in WAYS.items()
    }
    if plain is not None:
        found["`path`"] = _differ(tiles(plain, {"type": "path", **rest}, seeds, 4 * spp), everything)
    return found


@dataclass(frozen=True)
class Tried:
    """What is ``wrong`` with a file, if anything; its XML; the smallest relative error that would be seen."""

    wrong: str
    xml: str
    seen: float


def _loaded(path: Path) -> mi.Scene:
    """The scene of a file; its shapes are left apart where Mitsuba fails to merge them (some of one BSDF)."""
    try:
        return mi.load_file(str(path))
    except RuntimeError as error:
        if "Mesh::merge()" not in str(error):
            raise
        return mi.load_file(str(path), optimize=False)


def _file(kind: Kind, folder: Path, seed: int) -> Tried:
    """The scene file of a seed."""
    xml = Generator(seed, folder, kind.plain).scene(kind.media)
    path = folder / f"{seed}.xml"
    path.write_text(xml)
    scene = _loaded(path)
    # Mitsuba's merged rectangles have no box, and `path` is too bright beside them.
    plain = mi.load_file(str(path), optimize=False) if kind.plain else None
    try:
        found = _compared(scene, plain, SPP, 0)
        if min(f.p for f in found.values()) < SUSPICION:
            found = _compared(scene, plain, AGAIN * SPP, 100)
    except ValueError as error:
        return Tried(str(error), xml, np.inf)
    wrong = [
        f"{name} off by {100 * f.gap:.2g} % more than it may, p = {f.p:.1g}"
        for name, f in found.items()
        if f.p < LEVEL
    ]
    return Tried("; ".join(wrong), xml, max(f.seen for f in found.values()))


# -- BSDFs ------------------------------------------------------------------------------------------------

# Directions of each comparison, and its level: 300 BSDFs have 1800 of them.
DIRECTIONS = 1 << 19
STEPS_LEVEL = 1e-6


class _Numbers:
    """Independent numbers of `DIRECTIONS` lanes."""

    def __init__(self, seed: int):
        self._rng = mi.PCG32(DIRECTIONS, seed)

    def one(self):
        return self._rng.next_float32()

    def two(self):
        return mi.Point2f(self.one(), self.one())


def _surface(numbers: _Numbers):
    """Hits on a plane from all around, at random texture coordinates."""
    si = dr.zeros(mi.SurfaceInteraction3f, DIRECTIONS)
    si.t, si.uv = dr.full(mi.Float, 1, DIRECTIONS), numbers.two()
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    wi = mi.warp.square_to_uniform_sphere(numbers.two())
    si.wi = dr.select(wi.z == 0, mi.Vector3f(0, 0, 1), wi)  # of cosines of 0 BSDFs say nothing
    return si


def _seen(w):
    """A smooth function of directions without symmetry."""
    return dr.exp(0.8 * w.x - 0.5 * w.y + 0.4 * w.z)


def _bsdf(folder: Path, seed: int) -> Tried:
    """Whether what steps of a BSDF carry is an integral of its evaluation, from either side."""
    xml = Generator(seed, folder).bsdf(maps=False, version="3.0.0")
    plugin = mi.load_string(xml)
    traits, wrong, seen = bsdf.Traits.of([plugin]), [], 0.0
    for take, evaluate in ((bsdf.sample, bsdf.evaluate), (sample_adjoint, evaluate_adjoint)):
        numbers = _Numbers(seed)
        si = _surface(numbers)
        step, _ = take(plugin, si, numbers.one(), numbers.two(), mi.Bool(True), traits)
        steps = dr.select(step.delta | spectra.is_zero(step.weight), 0, step.weight * _seen(step.wo))
        wo = mi.warp.square_to_uniform_sphere(numbers.two())
        f = evaluate(plugin, si, wo, mi.Bool(True), traits).value * _seen(wo) / dr.inv_four_pi
        steps, f = (np.broadcast_to(np.array(x, dtype=np.float64), (3, DIRECTIONS)) for x in (steps, f))
        if not (np.isfinite(steps).all() and np.isfinite(f).all()):
            wrong.append(f"{take.__name__}: values that are not finite")
            continue
        mean, error = f.mean(1), np.hypot(steps.std(1), f.std(1)) / np.sqrt(DIRECTIONS)
        lit = error > 0
        z = np.abs(steps.mean(1) - mean)[lit] / error[lit]
        seen = max([seen, *(stats.norm.isf(STEPS_LEVEL / 2) * error[lit] / np.maximum(mean[lit], 1e-30))])
        if (z > stats.norm.isf(STEPS_LEVEL / 2)).any():
            ratio = steps.mean() / max(f.mean(), 1e-30)
            wrong.append(f"{take.__name__}: steps / evaluation = {ratio:.4f}, {z.max():.1f} sigma")
    return Tried("; ".join(wrong), xml, seen)


def _all(try_one: Callable[[Path, int], Tried], seeds, show=False) -> Outcome:
    """Try one file or BSDF for each of the ``seeds``; ``show`` what is wrong, with the XML."""
    wrong, seen = [], []
    with tempfile.TemporaryDirectory() as name:
        write_assets(Path(name))
        for seed in seeds:
            tried = try_one(Path(name), seed)
            seen.append(tried.seen)
            if tried.wrong:
                wrong.append(f"{seed}: {tried.wrong}")
                if show:
                    print(f"{seed}: {tried.wrong}\n{tried.xml}\n", flush=True)
    half, most = np.quantile(seen, [0.5, 0.9])
    text = f"half of {len(seen)} see errors of {100 * half:.2g} %, nine in ten of {100 * most:.2g} %; "
    return Outcome(not wrong, text + ("; ".join(wrong) or "nothing differs"))


def _files(kind: Kind, seeds, show=False) -> Outcome:
    mi.set_variant(kind.variant)
    return _all(partial(_file, kind), seeds, show)


def _bsdfs(seeds, show=False) -> Outcome:
    return _all(_bsdf, seeds, show)


RUNS = {
    "chance-surfaces": (partial(_files, Kind()), range(12)),
    "chance-path": (partial(_files, Kind(plain=True)), range(12)),
    "chance-spectral": (partial(_files, Kind(plain=True, variant="llvm_ad_spectral")), range(4)),
    "chance-media": (partial(_files, Kind(media=True)), range(8)),
    "chance-bsdfs": (_bsdfs, range(300)),
}

TRIED = {
    "chance-surfaces": "shapes, groups, instances, lamps and nested BSDFs of twelve files",
    "chance-path": "twelve files of what `path` renders right: no masks and blends, convex lamps",
    "chance-spectral": "four of those in `llvm_ad_spectral`",
    "chance-media": "eight files with two bodies of homogeneous media and grids",
    "chance-bsdfs": "300 BSDFs without bump and normal maps, nested up to three times",
}


def _expected(name: str) -> str:
    """What is expected of the case, in words."""
    if name == "chance-bsdfs":
        return (
            "what is carried by steps, less their delta events, is the integral of the evaluation, for "
            f"camera and light subpaths: means of 2^19 directions, level {STEPS_LEVEL:g} each"
        )
    others = ", ".join([*WAYS, *(["`path`"] if name in ("chance-path", "chance-spectral") else [])])
    return (
        f"the image with all strategies is that of others: {others}. t-tests of 4 x 4 tiles over {SEEDS} "
        f"renders, level {LEVEL:g} a comparison; where p < {SUSPICION:g} the scene is rendered again with "
        f"other seeds and {AGAIN} times the samples. Tiles may be off by {100 * TOLERANCE:g} % of the mean, "
        f"the image by {100 * OF_IMAGE:g} %: rounding where surfaces touch"
    )


_case = of_section("Files by chance")

CASES = tuple(
    _case(name, TRIED[name], _expected(name), partial(run, seeds)) for name, (run, seeds) in RUNS.items()
)

if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    run, _ = RUNS[sys.argv[1]]
    print(run(range(int(sys.argv[2]), int(sys.argv[3])), show=True).happened)
