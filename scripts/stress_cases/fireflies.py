"""How large a single contribution can be.

Under the balance heuristic w f / p <= f / p_0 for every strategy, p_0 being the density of the path when the
camera subpath hits the lamp: no strategy can add more than that one, which adds the lamp's radiance times
reflectances. A weight that is wrong by a factor, for one strategy on a rare path, is a firefly beyond this bound.
"""

from __future__ import annotations

from functools import partial
from unittest import mock

import drjit as dr
import numpy as np
import reference
from mitsuba_bdpt import kernel, rendering, sinks
from mitsuba_bdpt.strategies import strategies, strategy_count, strategy_index

import mitsuba as mi  # isort: skip

from .case import Case, Outcome

SECTION = "Fireflies"
RESOLUTION, SPP, SEEDS = 48, 16, 2

# float32: a product of twenty factors is off by 1e-6, directions between close vertices by 1e-4.
ROUNDING = 1e-3


class Largest(sinks.Image):
    """A sink that also keeps the largest weighted contribution of each strategy, over ``unit``."""

    def __init__(self, film, unit, depth: int):
        super().__init__(film)
        self._unit = unit
        self.found = dr.zeros(mi.Float, strategy_count(depth))
        dr.make_opaque(self.found)

    def add(self, kernel, c, total, start, shared):
        """Add a contribution with t >= 2."""
        self._keep(c)
        return super().add(kernel, c, total, start, shared)

    def splat(self, kernel, c, position, shared, counters):
        """Add a contribution with t <= 1."""
        self._keep(c)
        super().splat(kernel, c, position, shared, counters)

    def _keep(self, c):
        size = dr.max(c.weighted() / self._unit)
        dr.scatter_reduce(dr.ReduceOp.Max, self.found, size, strategy_index(c.s, c.t), c.active)


def largest(scene, unit, seed: int, depth: int, **parameters) -> np.ndarray:
    """The largest contribution of each of `strategies` in a render without roulette and with all
    connections."""
    found = np.zeros(strategy_count(depth))

    def trace(traced, image, batch, points, spp):
        sink = Largest(image._film, unit, depth)
        counts = kernel.trace(traced, sink, batch, points, spp)
        image._film.evaluate(counts, sink.found)
        np.maximum(found, sink.found, out=found)
        return counts

    plain = {"type": "bdpt", "max_depth": depth, "rr_depth": 1000, "skip": "none", "light_paths": 1.0}
    with mock.patch.object(rendering, "trace", trace):
        mi.load_dict(plain | parameters).render(scene, spp=SPP, seed=seed)
    return found


def radiance(scene) -> mi.Color3f:
    """The largest radiance of the scene's lamps, for each colour."""
    values = [np.array(mi.traverse(e)["radiance.value"], dtype=float).ravel() for e in scene.emitters()]
    return mi.Color3f(*(float(x) for x in np.max(values, axis=0)))


def _bounded(name: str, heuristic: str) -> Outcome:
    """No contribution to a scene of the benchmark is above the radiance of its brightest lamp."""
    scene = reference.load_scene(name, resolution=RESOLUTION)
    depth = reference.default_depth(name)
    unit = radiance(scene)
    found = [largest(scene, unit, seed, depth, heuristic=heuristic) for seed in range(SEEDS)]
    sizes = np.max(found, axis=0)
    order = list(strategies(depth))
    others = [size if s else 0 for size, (_, s, _) in zip(sizes, order, strict=True)]
    best = int(np.argmax(others))
    _, s, t = order[best]
    text = f"at most {sizes.max():.5g} of the lamp's radiance; of strategies other than s = 0 {max(others):.5g}"
    return Outcome(bool(sizes.max() <= 1 + ROUNDING), f"{text} (s = {s}, t = {t})")


def _case(name: str, heuristic: str = "balance", quick: bool = False) -> Case:
    return Case(
        f"bounded-{name.replace('_', '-')}-{heuristic}",
        SECTION,
        f"`{name}`, {heuristic} heuristic, everything switched on, no roulette, all connections: the largest "
        f"weighted contribution of each strategy in {SEEDS} renders",
        "none above the radiance of the brightest lamp: w f/p ≤ f/p_0, which is radiance times reflectances; "
        "0.1 % for rounding",
        partial(_bounded, name, heuristic),
        quick,
    )


CASES = (
    _case("glass_caustics", quick=True),
    _case("ajar_door"),
    _case("thin_lens"),
    _case("smallvcm_cornell_lamp"),
    _case("veach_bidir", "power"),
)
