"""Scene files and BSDFs drawn at random: do all strategies find the same light, and `path`'s?

More of them, which is how bugs are looked for: `python -m stress_cases.by_chance NAME FIRST LAST`, in
the folder scripts, with the name of a case and two seeds; it prints those that are not as expected, and
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

from .agreement import LEVEL, tiles
from .case import Outcome, of_section
from .random_files import Generator, write_assets

SEEDS = 8

# Of the image's mean, by how much a tile may be off: joins of surfaces that touch, and the normals of coarse
# meshes, of which strategies see different parts.
TOLERANCE = 0.005

# Samples per pixel, and how many times as many where there is a suspicion. Rare large samples, of which a
# t-test of eight renders knows nothing, are no finding.
SPP, AGAIN = 48, 8

# What must agree with all strategies. (Camera subpaths alone do not reach a delta emitter through a mask.)
WAYS = {"default parameters": {}, "no inner connections": {"skip": "none", "connections": "none"}}


@dataclass(frozen=True)
class Kind:
    """Of which scenes: with or without media, plain ones also beside `path`; in which variant."""

    media: bool = False
    plain: bool = False
    variant: str = "llvm_ad_rgb"


def _differ(a, b) -> tuple[float, float]:
    """p-value after Sidak's correction, and the largest difference of tiles with a small one, by the mean.

    The last of the columns is the image, which may be off by a quarter of what a tile may.
    """
    found = welch(Sample.of(a), Sample.of(b))
    gap = np.abs(found.value) / max(abs(b[:, -1].mean()), 1e-30)
    p = np.where(gap > TOLERANCE / np.where(np.arange(len(gap)) == len(gap) - 1, 4, 1), found.p, 1.0)
    return sidak(p), float(np.where(p < LEVEL, gap, 0).max())


def _compared(scene, plain, spp: int, first_seed: int, depth: int = 4) -> dict[str, tuple[float, float]]:
    """`_differ` of each of the `WAYS`, and of Mitsuba's integrator in ``plain`` if it is a scene."""
    rest, seeds = {"max_depth": depth, "rr_depth": 50}, range(first_seed, first_seed + SEEDS)
    everything = tiles(scene, {"type": "bdpt", "skip": "none", **rest}, seeds, spp)
    found = {}
    for name, parameters in WAYS.items():
        found[name] = _differ(tiles(scene, {"type": "bdpt", **parameters, **rest}, seeds, spp), everything)
    if plain is not None:
        other = tiles(plain, {"type": "path", **rest}, seeds, 4 * spp)
        found["`path`"] = _differ(other, everything)
    return found


def _loaded(path: Path) -> mi.Scene:
    """The scene of a file; its shapes are left apart where Mitsuba fails to merge them (some of one BSDF)."""
    try:
        return mi.load_file(str(path))
    except RuntimeError as error:
        if "Mesh::merge()" not in str(error):
            raise
        return mi.load_file(str(path), optimize=False)


def _file(kind: Kind, folder: Path, seed: int) -> tuple[str, str]:
    """What is wrong with the scene file of a seed, or an empty text; and its XML."""
    xml = Generator(seed, folder, kind.plain).scene(kind.media)
    path = folder / f"{seed}.xml"
    path.write_text(xml)
    scene = _loaded(path)
    # Mitsuba's merged rectangles have no box, and `path` is too bright beside them.
    plain = mi.load_file(str(path), optimize=False) if kind.plain else None
    found = _compared(scene, plain, SPP, 0)
    if min(p for p, _ in found.values()) < LEVEL / 10:
        found = _compared(scene, plain, AGAIN * SPP, 100)
    wrong = [
        f"{name} off by {100 * gap:.2g} %, p = {p:.1g}" for name, (p, gap) in found.items() if p < LEVEL / 10
    ]
    return "; ".join(wrong), xml


# -- BSDFs ------------------------------------------------------------------------------------------------

# Directions of each comparison.
DIRECTIONS = 1 << 19


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


def _bsdf(folder: Path, seed: int) -> tuple[str, str]:
    """Whether what steps of a BSDF carry is an integral of its evaluation, from either side; and its XML."""
    xml = Generator(seed, folder).bsdf(maps=False, version="3.0.0")
    plugin = mi.load_string(xml)
    traits, wrong = bsdf.Traits.of([plugin]), []
    for take, evaluate in ((bsdf.sample, bsdf.evaluate), (bsdf.sample_adjoint, bsdf.evaluate_adjoint)):
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
        p = [
            stats.ttest_ind(a, b, equal_var=False).pvalue
            for a, b in zip(steps, f, strict=True)
            if a.any() or b.any()
        ]
        ratio = steps.mean() / max(f.mean(), 1e-30)
        if p and min(p) < LEVEL / 100:
            wrong.append(f"{take.__name__}: steps / evaluation = {ratio:.4f}, p = {min(p):.1g}")
    return "; ".join(wrong), xml


def _tried(try_one: Callable[[Path, int], tuple[str, str]], seeds, show=False) -> Outcome:
    """Try one file or BSDF for each of the ``seeds``."""
    wrong = []
    with tempfile.TemporaryDirectory() as name:
        write_assets(Path(name))
        for seed in seeds:
            text, xml = try_one(Path(name), seed)
            if text:
                wrong.append(f"{seed}: {text}")
                if show:
                    print(f"{seed}: {text}\n{xml}\n", flush=True)
    return Outcome(not wrong, f"{len(seeds)} tried; " + ("; ".join(wrong) or "nothing differs"))


def _files(kind: Kind, seeds, show=False) -> Outcome:
    mi.set_variant(kind.variant)
    return _tried(partial(_file, kind), seeds, show)


def _bsdfs(seeds, show=False) -> Outcome:
    return _tried(_bsdf, seeds, show)


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
    "chance-bsdfs": "300 BSDFs without bump and normal maps, nested up to four times",
}

_SAME = (
    f"the image with all strategies is that of others: {', '.join(WAYS)}. t-tests of 4 x 4 tiles over "
    f"{SEEDS} renders; one that differs is rendered again with other seeds and {AGAIN} times the samples. "
    f"Differences below {100 * TOLERANCE:g} % of the mean are none: rounding where surfaces touch"
)
_STEPS = (
    "what is carried by steps, less their delta events, is the integral of the evaluation, for camera and "
    "light subpaths: t-tests of 2^19 directions, which see errors of 1 %, level 1e-5"
)

_case = of_section("Files by chance")

CASES = tuple(
    _case(name, TRIED[name], _STEPS if name == "chance-bsdfs" else _SAME, partial(run, seeds))
    for name, (run, seeds) in RUNS.items()
)

if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    run, _ = RUNS[sys.argv[1]]
    print(run(range(int(sys.argv[2]), int(sys.argv[3])), show=True).happened)
