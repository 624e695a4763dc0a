"""The weights of all strategies that could have made one path: they sum to 1.

Two layers. Chains: densities drawn at random, all weights by the recursion. Paths of the kernel: vertices of
paths that it made in random scenes, the weight it gave them, and those of all other strategies by the
recursion from densities that are asked of the scene anew.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings

import mitsuba as mi  # isort: skip

from . import oracle
from .capture import Capture
from .case import Case, Outcome
from .chains import COEFFICIENTS, random_paths, recursion
from .oracle import Paths
from .random_scenes import renders

SECTION = "Weights"
TOLERANCE = 1e-3
LENGTH = 6  # edges of the longest path of the kernel


# Share of the kernel's paths that may be left out since rounding decides; 0.4 % are.
MOST_UNSURE = 0.01


@dataclass
class Tally:
    """What the weights of ``paths`` were: sums that are ``off`` by more than the tolerance and the ``worst``
    error of one; paths with a weight that is negative, above 1 or not finite are ``bad``; ``ties``: left out
    because rounding decides which density is the largest; ``span``: most orders of magnitude between two
    densities of one path, ``wide`` paths with more than 60. Of the kernel: ``differ``: its largest difference
    from the weight by explicit densities; ``unsure`` see `capture.Made`."""

    paths: int = 0
    off: int = 0
    worst: float = 0.0
    bad: int = 0
    ties: int = 0
    span: float = 0.0
    wide: int = 0
    differ: float = 0.0
    unsure: int = 0

    def add(self, weights, used, tied=None):
        """Weights of paths, (n, k + 2); which strategies can make them; which paths do not count."""
        self.bad += int((used & ~((weights >= 0) & (weights <= 1))).any(1).sum())
        counted = used.any(1) if tied is None else used.any(1) & ~tied
        error = np.abs(np.where(used, weights, 0).sum(1) - 1)[counted]
        self.ties += 0 if tied is None else int((tied & used.any(1)).sum())
        self.paths += len(error)
        self.off += int((~(error <= TOLERANCE)).sum())
        self.worst = max(self.worst, float(error.max(initial=0)))

    def outcome(self, more="", least=1) -> Outcome:
        """Whether all sums of at ``least`` so many paths are 1, and what was seen."""
        text = f"{self.paths:,} paths, sums off by {self.worst:.1e} at most"
        text += f", {self.bad} with a weight outside [0, 1]"
        text += f", {self.off} sums off by more than {TOLERANCE}" if self.off else ""
        text += f", {self.ties} ties left out" if self.ties else ""
        judged = self.unsure <= MOST_UNSURE * self.paths  # else a fault may hide there
        return Outcome(self.bad == self.off == 0 and judged and self.paths >= least, text + more)


# -- chains ---------------------------------------------------------------------------------------


def wide_paths(rng, n: int, k: int) -> Paths:
    """Random paths, each density over twelve orders of magnitude at most, but larger from one end than from
    the other all along a path, so that those of its strategies are far apart."""
    paths = random_paths(rng, n, k, decades=rng.choice([1.0, 3.0, 6.0]))
    drift = 10 ** rng.uniform(-5, 5, (n, 1))
    paths.to_camera = (paths.to_camera * drift).astype(np.float32)
    paths.to_light = (paths.to_light / drift).astype(np.float32)
    return paths


def span(size) -> np.ndarray:
    """Orders of magnitude between the largest and the smallest of the logarithms in each row."""
    used = np.isfinite(size)
    low, high = np.where(used, size, np.inf).min(1), np.where(used, size, -np.inf).max(1)
    return np.where(used.any(1), high - low, 0) / np.log(10)


def chains(heuristic: str, batches: int, size: int) -> Outcome:
    """Sums of the recursion's weights over ``batches`` of so many chains of 1 to 8 edges."""
    rng, tally, kappas = np.random.default_rng(7), Tally(), list(COEFFICIENTS.values())
    for batch in range(batches):
        k, kappa = 8 - batch % 8, kappas[batch % len(kappas)]
        paths = wide_paths(rng, size, k)
        weights = recursion(paths, kappa, heuristic)
        explicit = oracle.Explicit(paths, kappa)
        tally.add(weights, explicit.used, explicit.ambiguous if heuristic == "maximum" else None)
        orders = span(explicit.size)
        tally.span, tally.wide = max(tally.span, orders.max()), tally.wide + int((orders > 60).sum())
    more = f"; densities of a path up to 10^{tally.span:.0f} apart, more than 10^60 in {tally.wide:,} paths"
    return tally.outcome(more)


EXTREMES = ("to_camera", "to_light", "first", "second", "direct", "sensor_pdf")


def extremes(batches: int, size: int) -> Outcome:
    """Every density 1e-30, 1 or 1e30: weights of all heuristics are numbers in [0, 1]."""
    rng, tally = np.random.default_rng(8), Tally()
    for batch in range(batches):
        paths = random_paths(rng, size, 8 - batch % 8)
        for field in EXTREMES:
            shape = getattr(paths, field).shape
            setattr(paths, field, rng.choice(np.float32([1e-30, 1, 1e30]), shape))
        kappa = COEFFICIENTS["odd"]
        used = oracle.Explicit(paths, kappa).used
        tally.add(recursion(paths, kappa, ("balance", "power", "maximum", "uniform")[batch // 8 % 4]), used)
    share = tally.off / tally.paths
    text = f"{tally.paths:,} paths, {tally.bad} weights outside [0, 1]; {share:.0%} of the sums are not 1"
    return Outcome(tally.bad == 0, text)


# -- paths of the kernel --------------------------------------------------------------------------


def weigh(tally: Tally, capture: Capture, heuristic: str):
    """Add the paths of a run: the kernel's own weight of the strategy that made a path, with those of the
    others by the recursion."""
    made = [m for m in capture.made() if len(m.weights)]
    for k in sorted({m.paths.k for m in made}):
        group = [m for m in made if m.paths.k == k]
        paths = Paths.joined([m.paths for m in group])
        own = np.concatenate([m.weights for m in group])
        at = np.arange(len(own)), np.repeat([m.s for m in group], [len(m.weights) for m in group])
        explicit = oracle.Explicit(paths, capture.coefficients)
        expected = explicit.weights(heuristic)
        maximum = heuristic == "maximum"
        weights, used = recursion(paths, capture.coefficients, heuristic), explicit.used.copy()
        weights[at], used[at] = own, True
        tally.add(weights, used, explicit.ambiguous if maximum else None)
        differ = np.abs(own - expected[at])[~(maximum & explicit.tied)]
        tally.differ = max(tally.differ, float(differ.max(initial=0)))
        tally.unsure += sum(m.unsure for m in group)


def of_the_kernel(heuristic: str, count: int, lanes: int, number: int, least: int) -> Outcome:
    """At ``least`` so many paths of the kernel in ``count`` random scenes; ``number`` is the seed."""
    tally, failed = Tally(), []

    @seed(number)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(renders())
    def check(render):
        scene, parameters = render
        before = tally.off, tally.bad
        integrator = {"type": "bdpt", "max_depth": LENGTH, "heuristic": heuristic} | parameters
        capture = Capture(mi.load_dict(scene), mi.load_dict(integrator), lanes, number)
        weigh(tally, capture, heuristic)
        if (tally.off, tally.bad) != before:
            failed.append(render)

    check()
    more = (
        f"; {count} scenes; the kernel's weight differs by {tally.differ:.1e} at most from that by explicit "
    )
    more += "densities"
    more += f"; {tally.unsure} paths left out where rounding decides" if tally.unsure else ""
    more += f"; first scene that fails: {failed[0]}" if failed else ""
    return tally.outcome(more, least)


# -- cases ----------------------------------------------------------------------------------------

SUMS = (
    "every sum is 1 within 1e-3 and no weight is negative, above 1 or not finite; float32 alone is off by "
    "1e-6: some ten roundings of 6e-8 per vertex"
)
TIES = {
    "maximum": "; paths with a density 5e-5 to 2e-4 below the largest are left out: below 1e-4 the kernel "
    "takes densities for equal"
}


def _chains(heuristic: str, batches: int, size: int, quick=False) -> Case:
    return Case(
        f"weights-chains-{heuristic}",
        SECTION,
        f"`{heuristic}`: weights of all strategies of random chains of 1 to 8 edges by the recursion, "
        "densities over up to 12 orders of magnitude each, larger from one end all along a path",
        SUMS + TIES.get(heuristic, ""),
        partial(chains, heuristic, batches, size),
        quick,
    )


def _paths(name: str, heuristic: str, count: int, lanes: int, number: int, least: int) -> Case:
    left_out = (
        "paths left out: at the rim of a disk on which light from the sky starts, on the surface of a lamp, "
    )
    left_out += "along edges so short that the offset of rays turns them by more than 1e-3 of a cosine"
    return Case(
        f"weights-paths-{name}",
        SECTION,
        f"`{heuristic}`: paths that the kernel makes in random scenes (hypothesis: shapes, BSDFs, emitters, "
        "sensors, coefficients); its own weight, and those of all other strategies from densities asked of "
        "the scene anew",
        SUMS + TIES.get(heuristic, "") + f"; {least:,} paths at least; {left_out}",
        partial(of_the_kernel, heuristic, count, lanes, number, least),
        quick=name == "few",
    )


CASES = (
    _paths("balance", "balance", 20, 1 << 17, 3, 10**7),
    _paths("power", "power", 8, 1 << 16, 4, 10**6),
    _paths("maximum", "maximum", 8, 1 << 16, 5, 5 * 10**5),
    _paths("uniform", "uniform", 4, 1 << 14, 6, 10**5),
    _paths("few", "balance", 3, 1 << 11, 7, 10**4),
    _chains("balance", 26, 1 << 17),
    _chains("power", 26, 1 << 17),
    _chains("maximum", 26, 1 << 17),
    _chains("uniform", 4, 1 << 14, quick=True),
    Case(
        "weights-extremes",
        SECTION,
        "each density 1e-30, 1 or 1e30, whatever its neighbours are, all heuristics",
        "no weight is negative, above 1 or not finite. (Sums are not asked for: products leave the range of "
        "float32, and what passes 1e37 on the way is cut there)",
        partial(extremes, 32, 1 << 12),
        quick=True,
    ),
)
