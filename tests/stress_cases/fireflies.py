"""The worst samples of a render: whether each is what its path says, and whether others would do."""

from __future__ import annotations

from functools import partial

import numpy as np
from repository import benchmark_depth, load_reference, load_scene

from instruments import fireflies

import mitsuba as mi  # isort: skip

from .case import Case, Outcome

SECTION = "Fireflies"
RESOLUTION, SPP, SEEDS, TOP = 32, 32, 2, 32
LEVEL = 0.1

# Samples that are off by more than so many values of their pixel (where those of a Cornell box are not).
LARGE = 3.0


def _target(name: str, depth: int) -> np.ndarray:
    """The scene's reference in a lower resolution: its filter is a box."""
    image = load_reference(name, 128, depth).image.astype(float)
    width = 128 // RESOLUTION
    return image.reshape(RESOLUTION, width, RESOLUTION, width, 3).mean(axis=(1, 3))


def _undrawn(firefly) -> float:
    """By how many values of its pixel a sample would be off without the draw of a connection and roulette."""
    path = firefly.path
    return firefly.off * (path.estimate * path.weight).max() / path.value.max()


def _explained(name: str) -> Outcome:
    """The worst samples of a scene found anew."""
    depth = benchmark_depth(name)
    scene = load_scene(name, resolution=RESOLUTION)
    unguided = {"guiding": "never"}
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth} | unguided)
    target = _target(name, depth)
    found = []
    for seed in range(1, SEEDS + 1):
        found += fireflies.fireflies(scene, integrator, target, SPP, seed, LEVEL, TOP)[1]
    doubts = sorted({f.doubt for f in found} - {""})
    large = [f for f in found if f.off > LARGE]
    avoidable = [f for f in large if fireflies.in_use(f).sum() > 1 and _undrawn(f) > LARGE]
    strategies = {(f.path.s, f.path.t) for f in found}
    text = f"{len(found)} samples by {len(strategies)} strategies, {len(large)} off by more than {LARGE:g}"
    if doubts:
        text += f"; {doubts[0]}"
    if avoidable:
        text += f"; {avoidable[0].letters} has other strategies"
    return Outcome(len(found) >= TOP and not doubts and not avoidable, text)


def _case(name: str, quick: bool = False) -> Case:
    return Case(
        f"explained-{name.replace('_', '-')}",
        SECTION,
        f"`{name}`, {RESOLUTION}², {SPP} samples per pixel: the {TOP} worst samples of each of {SEEDS} "
        "renders, each path found anew with Mitsuba's calls, densities of all strategies written out",
        "all have the estimate and the weight that follow from their vertices (1 %: float32 directions at "
        f"rough surfaces); those that are off by more than {LARGE:g} values of their pixel, also without the "
        "draw of a connection and its roulette, can be made by one strategy alone",
        partial(_explained, name),
        quick,
    )


CASES = (
    _case("glass_caustics", quick=True),
    _case("cornell_box"),
    _case("smallvcm_cornell_lamp"),
    _case("smallvcm_cornell_sun"),
)
