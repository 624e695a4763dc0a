"""The paths behind the worst values of a scene's renders.

Takes the samples of renders with default parameters that are off by more than ``level`` times the value of
their pixel, traces them again (`recording`), finds each path anew (`reconstruct`), and prints one line for
each kind of path:

* error: their share of the squared error of all renders; largest: in values of the pixel; samples: of those
  examined (``top`` of each render).
* path: P. Heckbert's letters, S for delta events, G for rough ones, D for diffuse ones, V in a medium; `¦` is
  where the strategy connects.
* other strategies: the densest one, with its density over that of the strategy that made the path.
* `path`: what Mitsuba's `path` adds with the same path (s = 0 and s = 1, balance heuristic) over what was
  added. Roulette is counted where s = 0 or 1 made the path.
* found anew: with the same estimate and weight; in scenes with media none is.
"""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_bdpt.host.jit import evaluated_mode
from mitsuba_bdpt.measure.making import Job, obtained
from mitsuba_bdpt.measure.metrics import TRIM, rel_mse, rel_mse_epsilon
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.scenes import MeasuredScene, integrator_of
from mitsuba_bdpt.measure.showing import steps
from mitsuba_bdpt.measure.tables import table

from . import oracle, reconstruct, recording

# Estimates and weights are the same up to this.
AGREE = 1e-2


@dataclass(frozen=True)
class Firefly:
    """A sample that stands out, with the path that adds most to it. ``off`` by so many values of its pixel,
    ``error`` its sum of squared relative errors; ``kappa`` of the k + 2 strategies; ``rebuilt`` None if the
    path could not be found anew, ``doubt`` why, or in what it then differed from what the render says."""

    path: recording.Path
    letters: str
    names: str
    off: float
    error: float
    kappa: np.ndarray
    rebuilt: reconstruct.Rebuilt | None
    doubt: str

    @property
    def kind(self) -> tuple:
        """What one line of the table is about."""
        return (self.path.s, self.path.t), self.letters, self.names


class Names:
    def __init__(self, scene):
        self._shapes = {
            int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]): shape for shape in scene.shapes()
        }

    def letters(self, path) -> str:
        """Heckbert's letters from the lamp to the eye, `¦` where the strategy connects."""
        found = ["E"] + ["S" if d else "?" for d in path.delta[1:-1]] + ["L"]
        for i, letter in enumerate(found):
            if letter == "?" and not path.shapes[i]:
                found[i] = "V"
            elif letter == "?":
                flags = self._shapes[path.shapes[i]].bsdf().flags()
                found[i] = "D" if mi.has_flag(flags, mi.BSDFFlags.Diffuse) else "G"
        if path.s and path.t:
            found.insert(path.t, "¦")
        return " ".join(found[::-1])

    def vertices(self, path) -> str:
        """The materials between lamp and eye, by class where they have no name."""
        bsdfs = (self._shapes[number].bsdf() if number else None for number in path.shapes[-2:0:-1])
        return ", ".join("medium" if b is None else b.id() or b.class_name() for b in bsdfs)


def fireflies(scene, integrator, target, spp: int, seed: int, level: float, top: int):
    scale = np.sqrt(target**2 + rel_mse_epsilon(target))
    image, outliers = recording.render(scene, integrator, level * spp * scale, spp, seed)
    names, found = Names(scene), []
    outliers = outliers[:top]
    for outlier, paths in zip(outliers, recording.replay(outliers), strict=True):
        off = outlier.value / spp / scale[outlier.y, outlier.x]
        path = paths[0]
        kernel = outlier.launch.kernel
        kappa = coefficients(kernel.plan, path.s + path.t - 1)
        said = names.letters(path), names.vertices(path), off.max(), float(off @ off), kappa
        found.append(Firefly(path, *said, *_found_anew(scene, kernel, kappa, path)))
    return image, found


def _found_anew(scene, kernel, kappa, path):
    """The path found anew, and what speaks against it."""
    try:
        with evaluated_mode(kernel.emitters.evaluated):
            rebuilt = reconstruct.rebuild(scene, kernel.emitters, path)
    except reconstruct.Lost as why:
        return None, str(why)
    # The estimate is divided by the class's count and by the probability that roulette let the path live.
    count = (1 / kernel.plan.camera_paths_per_light_path if path.t <= 1 else 1.0) * path.survival
    ratio = path.estimate.max() * count / rebuilt.estimate(path.s).max()
    if abs(ratio - 1) > AGREE:
        return rebuilt, f"the estimate is {ratio:.3g} times that of the path"
    weight = kappa[path.s] / (kappa @ rebuilt.compared(path.s))
    if abs(weight - path.weight) > AGREE * path.weight:
        return rebuilt, f"the weight is {path.weight:.3g}, that of the path {weight:.3g}"
    return rebuilt, ""


def coefficients(plan, k: int) -> np.ndarray:
    """kappa of the k + 2 strategies of paths of ``k`` edges, 0 for those that are not in use."""
    light = plan.kappa_light / plan.camera_paths_per_light_path
    inner = math.sqrt(plan.joined) * (plan.connections != "none")
    of = oracle.Coefficients(light * plan.endpoints, light * plan.splat, inner, light * plan.arrival)
    kappa = np.array([of.of(s, k) for s in range(k + 2)])
    if plan.direct and k > 1:
        kappa[1] = plan.kappa_direct
    return kappa


def in_use(firefly: Firefly) -> np.ndarray:
    """Densities times coefficients of the strategies in use, over that of the one that made the path. Raises
    ``ValueError`` for a path that was not found anew."""
    if firefly.rebuilt is None:
        raise ValueError(f"a path that was not found anew: {firefly.doubt}")
    return firefly.kappa * firefly.rebuilt.relative(firefly.path.s)


def line(name: str, found: list[Firefly], total: float, examined: int) -> list[str]:
    """The row of one kind of path; ``total`` squared error of all renders."""
    by_size = sorted(found, key=lambda firefly: -firefly.off)
    worst = by_size[0]
    path = worst.path
    return [
        f"`{name}`",
        f"{100 * sum(f.error for f in found) / total:.3g} %",
        f"{worst.off:.3g}",
        f"{len(found)} of {examined}",
        f"s = {path.s}, t = {path.t}",
        f"`{worst.letters}`: {worst.names}",
        *_elsewhere(next((f for f in by_size if not f.doubt), worst)),
        _doubts(found),
    ]


def _doubts(found: list[Firefly]) -> str:
    doubts = {f.doubt for f in found} - {""}
    text = f"{sum(not f.doubt for f in found)} of {len(found)}"
    return text + (f" ({'; '.join(sorted(doubts))})" if doubts else "")


def _elsewhere(firefly: Firefly) -> tuple[str, str]:
    """The densest other strategy, and what `path` adds with the path."""
    if firefly.rebuilt is None:
        return "not known", "not known"
    path = firefly.path
    density = firefly.rebuilt.relative(path.s)
    others = np.where(np.arange(len(density)) == path.s, 0, density)
    best = int(others.argmax())
    text = "none"
    if others[best] > 0:
        text = f"s = {best}, t = {len(density) - 1 - best}: {others[best]:.2g}x"
    by_path = density[:2].sum()
    if not by_path > 0:
        return text, "cannot make it"
    # `path` adds f / (p_0 + p_1), the render what it says: divided by its count, its roulette and its draw.
    # Along a camera subpath the roulette is that of `path`; how it would treat a light subpath is not known.
    survival = path.survival if path.s <= 1 else 1.0
    estimate = firefly.rebuilt.estimate(path.s).max()
    return text, f"{estimate / (by_path * survival * path.value.max()):.3g}x"


HEAD = "scene,error,largest,samples,strategy,path,other strategies,`path`,found anew".split(",")


def lines(project: Project, file: MeasuredScene, options: Namespace) -> tuple[list, str]:
    name, seconds = file.name, options.reference_seconds
    job = Job(project, file, options.resolution, options.max_depth, options.spp, seconds)
    target, scene = obtained(job).image, file.load(options.resolution)
    integrator = integrator_of({"type": "bdpt"}, job.depth)
    kinds, errors, examined = {}, [], 0
    with steps(options.seeds) as step:
        for seed in range(1, options.seeds + 1):
            step(f"{name}, seed {seed}")
            image, found = fireflies(scene, integrator, target, options.spp, seed, options.level, options.top)
            errors.append((rel_mse(image, target), rel_mse(image, target, TRIM)))
            examined += len(found)
            for firefly in found:
                kinds.setdefault(firefly.kind, []).append(firefly)
    total = sum(raw for raw, _ in errors) * target.size
    rows = sorted(kinds.values(), key=lambda found: -sum(f.error for f in found))
    pairs = ", ".join(f"{raw:.3g} ({trimmed:.2g})" for raw, trimmed in errors)
    anew = sum(not f.doubt for found in rows for f in found)
    return [
        line(name, found, total, examined) for found in rows[: options.lines]
    ], f"`{name}`: {pairs}, found anew {anew} of {examined}"


def text(project: Project, names: Sequence[str], options: Namespace) -> str:
    rows, said = [], []
    for scene in [project.scene(name) for name in names]:
        more, errors = lines(project, scene, options)
        rows, said = rows + more, [*said, errors]
    return f"{table(HEAD, rows)}\nrelMSE of the renders (trimmed): {'; '.join(said)}"
