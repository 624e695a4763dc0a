"""The weights of all strategies that could have made one path: they sum to 1.

Two layers. Chains: densities drawn at random, all weights by the recursion. Paths of the kernel: vertices of
paths that it made in random scenes, the weight it gave them, and those of all other strategies by the
recursion from densities that are asked of the scene anew.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from mitsuba_bdpt.settings import HEURISTICS

import mitsuba as mi  # isort: skip

from .capture import Capture
from .case import Case, Outcome
from .chains import COEFFICIENTS, random_paths, recursion
from .random_scenes import LAMPS, SHAPES, T, diffuse, kinds_of, renders, shining, sides
from instruments import oracle
from instruments.oracle import Paths

SECTION = "Weights"
TOLERANCE = 1e-3
LENGTH = 6  # edges of the longest path of the kernel


# Share of the kernel's paths that may be left out since rounding decides; 0.4 to 1.3 % are, nearly all for
# their short edges: where the sky lights, rays are long, and offsets grow with them.
MOST_UNSURE = 0.02

# Orders of magnitude between densities of one path that call it wide, and the share of such chains at least;
# 1 to 2 % are.
WIDE, LEAST_WIDE = 60, 0.005


@dataclass
class Tally:
    """What the weights of ``paths`` were.

    Sums that are ``off`` by more than the tolerance and the ``worst`` error of one; paths with a weight that
    is negative, above 1 or not finite are ``bad``; ``ties``: left out because rounding decides which density
    is the largest; ``span``: most orders of magnitude between two densities of one path, ``wide`` paths with
    more than `WIDE`. Of the kernel: ``differ``: its largest difference from the weight by explicit densities,
    and how many weights are ``wrong`` by more than the tolerance; ``unsure`` see `capture.Made`.
    """

    paths: int = 0
    off: int = 0
    worst: float = 0.0
    bad: int = 0
    span: float = 0.0
    wide: int = 0
    differ: float = 0.0
    wrong: int = 0
    unsure: int = 0

    def add(self, weights, used):
        """Weights of paths, (n, k + 2), and which strategies can make them."""
        self.bad += int((used & ~((weights >= 0) & (weights <= 1))).any(1).sum())
        error = np.abs(np.where(used, weights, 0).sum(1) - 1)[used.any(1)]
        self.paths += len(error)
        self.off += int((~(error <= TOLERANCE)).sum())
        self.worst = max(self.worst, float(error.max(initial=0)))

    def compare(self, weights, expected):
        """The kernel's ``weights`` with those by explicit densities."""
        off = np.abs(weights - expected)
        self.wrong += int((~(off <= TOLERANCE)).sum())
        self.differ = max(self.differ, float(np.nan_to_num(off, nan=np.inf).max(initial=0)))

    def outcome(self, more="", least=1) -> Outcome:
        """Whether all sums of at ``least`` so many paths are 1, and what was seen."""
        text = f"{self.paths:,} paths, sums off by {self.worst:.1e} at most"
        text += f", {self.bad} with a weight outside [0, 1]"
        text += f", {self.off} sums off by more than {TOLERANCE}" if self.off else ""
        text += f", {self.wrong} weights wrong by more than {TOLERANCE}" if self.wrong else ""
        judged = self.unsure <= MOST_UNSURE * self.paths  # else a fault may hide there
        return Outcome(
            self.bad == self.off == self.wrong == 0 and judged and self.paths >= least, text + more
        )


# -- chains ---------------------------------------------------------------------------------------


def wide_paths(rng, n: int, k: int) -> Paths:
    """Random paths with densities so different that their strategies are far apart.

    Each density is over twelve orders of magnitude at most, but larger from one end than from the other all
    along a path.
    """
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
        tally.add(weights, explicit.used)
        orders = span(explicit.size)
        tally.span, tally.wide = max(tally.span, orders.max()), tally.wide + int((orders > WIDE).sum())
    more = (
        f"; densities of a path up to 10^{tally.span:.0f} apart, more than 10^{WIDE} in {tally.wide:,} paths"
    )
    outcome = tally.outcome(more)
    return replace(outcome, ok=outcome.ok and tally.wide >= LEAST_WIDE * tally.paths)


EXTREMES = ("to_camera", "to_light", "first", "second", "direct", "sensor_pdf")

# Orders of magnitude of products on the way that float32 certainly holds: it ends at 1e38, single densities
# are up to 1e30, lengths, cosines and coefficients are worth five, and below 1e-38 digits are lost.
HELD = 32

# Of the paths with extreme densities, those with all products within these: about a third are.
LEAST_HELD = 0.3


def held(paths: Paths) -> np.ndarray:
    """Mask of paths all of whose products of densities stay within `HELD` orders of magnitude.

    The products are those that the recursion forms along either subpath.
    """
    light, camera, direct = oracle.log_steps(paths)
    towards, last = np.log(paths.direct.astype(np.float64)), paths.k
    largest = np.abs(light[:, 0] + light[:, 1] - towards)  # of emission over next-event estimation
    for start in (light[:, 0], direct):
        first = np.column_stack([start, light[:, 1:]])
        for forward, reverse in ((first, camera), (camera[:, ::-1], first[:, ::-1])):
            for j in range(last + 1):
                for e in range(j, last + 1):
                    # 1 / (densities of the vertices j ... e), and the reverse ones but for up to two.
                    inverse = -forward[:, j : e + 1].sum(1)
                    for behind in (e + 1, e, e - 1):
                        product = inverse + reverse[:, j : max(behind, j)].sum(1)
                        largest = np.maximum(largest, np.abs(product))
    return largest < HELD * np.log(10)


def extreme_paths(rng, n: int, k: int, extreme: float) -> Paths:
    """Random paths of which each density is ``extreme``, 1 or its inverse."""
    paths = random_paths(rng, n, k)
    for field in EXTREMES:
        shape = getattr(paths, field).shape
        setattr(paths, field, rng.choice(np.float32([1 / extreme, 1, extreme]), shape))
    return paths


def extremes(batches: int, size: int) -> Outcome:
    """Weights of all heuristics for densities of the ends of single precision.

    Every density 1e-30, 1 or 1e30, or 1e-10, 1 or 1e10: weights are numbers in [0, 1], and sum to 1 where the
    products of the densities are numbers of single precision.
    """
    rng, tally, sound, kappa = np.random.default_rng(8), Tally(), Tally(), COEFFICIENTS["odd"]
    for batch in range(batches):
        heuristic = HEURISTICS[batch // 8 % len(HEURISTICS)]
        for extreme in (1e30, 1e10):
            paths = extreme_paths(rng, size, 8 - batch % 8, extreme)
            explicit, within = oracle.Explicit(paths, kappa), held(paths)
            weights = recursion(paths, kappa, heuristic)
            tally.add(weights, explicit.used)
            sound.add(weights[within], explicit.used[within])
    text = (
        f"{tally.paths:,} paths, {tally.bad} weights outside [0, 1]; of {sound.paths:,} whose products are "
    )
    text += f"within 10^{HELD} {sound.off} sums are not 1, the worst off by {sound.worst:.1e}; "
    text += f"of all {tally.off / tally.paths:.0%}"
    return Outcome(tally.bad == sound.off == 0 and sound.paths >= LEAST_HELD * tally.paths, text)


# -- paths of the kernel --------------------------------------------------------------------------


def weigh(tally: Tally, capture: Capture, heuristic: str):
    """Add the paths of a run to the ``tally``.

    The kernel's own weight of the strategy that made a path, with those of the others by the recursion.
    """
    made = [m for m in capture.made() if len(m.weights)]
    for k in sorted({m.paths.k for m in made}):
        group = [m for m in made if m.paths.k == k]
        paths = Paths.joined([m.paths for m in group])
        own = np.concatenate([m.weights for m in group])
        at = np.arange(len(own)), np.repeat([m.s for m in group], [len(m.weights) for m in group])
        explicit = oracle.Explicit(paths, capture.coefficients)
        expected = explicit.weights(heuristic)
        weights, used = recursion(paths, capture.coefficients, heuristic), explicit.used.copy()
        weights[at], used[at] = own, True
        tally.add(weights, used)
        tally.compare(own, expected[at])
        tally.unsure += sum(m.unsure for m in group)


def of_the_kernel(heuristic: str, count: int, lanes: int, number: int, least: int) -> Outcome:
    """At ``least`` so many paths of the kernel in ``count`` random scenes.

    With all kinds of lamps where there are as many scenes; ``number`` is the seed, and that of the first
    kind.
    """
    tally, failed, seen = Tally(), [], Counter()
    kinds = [*LAMPS][number:] + [*LAMPS][:number]

    @seed(number)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(renders(cycle(kinds)))
    def check(render):
        scene, parameters = render
        seen.update([*kinds_of(scene), parameters["connections"]])
        before = tally.off, tally.bad, tally.wrong
        integrator = {"type": "bdpt", "max_depth": LENGTH, "heuristic": heuristic} | parameters
        capture = Capture(mi.load_dict(scene), mi.load_dict(integrator), lanes, number)
        weigh(tally, capture, heuristic)
        if (tally.off, tally.bad, tally.wrong) != before:
            failed.append(render)

    check()
    more = f"; {_counted(seen, ('all', 'one'))} connections in {seen['all'] + seen['one']} scenes; lamps: "
    more += (
        f"{_counted(seen, LAMPS)}; the kernel's weight differs by {tally.differ:.1e} at most from that by "
    )
    more += "explicit densities"
    more += f"; {tally.unsure} paths left out where rounding decides" if tally.unsure else ""
    more += f"; first scene that fails: {failed[0]}" if failed else ""
    outcome = tally.outcome(more, least)
    return replace(outcome, ok=outcome.ok and (count < len(LAMPS) or all(seen[kind] for kind in LAMPS)))


def _counted(seen: Counter, names) -> str:
    return ", ".join(f"{seen[name]} {name}" for name in names if seen[name])


def glint(lanes: int, least: int) -> Outcome:
    """At ``least`` so many paths of the kernel around a small lamp.

    The lamp is on a sphere of radius 1e-3, above a diffuse box and floor.
    """
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = T().look_at([0, 0.5, 4], [0, -0.3, 0], [0, 1, 0])
    below = T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4)
    matte = sides(diffuse())
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 50.0, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": below, "bsdf": matte},
        "box": SHAPES["cube"]([0, -0.6, 0], 0, 0.4) | {"bsdf": matte},
        "lamp": shining({"type": "sphere", "radius": 1e-3}),
    }
    tally, integrator = Tally(), mi.load_dict({"type": "bdpt", "max_depth": 4, "skip": "none"})
    weigh(tally, Capture(mi.load_dict(scene), integrator, lanes, 9), "balance")
    more = f"; the kernel's weight differs by {tally.differ:.1e} at most from that by explicit densities"
    return tally.outcome(more, least)


# -- cases ----------------------------------------------------------------------------------------

SUMS = (
    "every sum is 1 within 1e-3 and no weight is negative, above 1 or not finite; float32 alone is off by "
    "1e-6: some ten roundings of 6e-8 per vertex"
)
OWN = (
    "; the kernel's own weight is that by explicit densities within 1e-3: edges may be turned by 1e-3 of a "
    "cosine, and what they say of densities is off by as much"
)


def _chains(heuristic: str, batches: int, size: int, quick=False) -> Case:
    return Case(
        f"weights-chains-{heuristic}",
        SECTION,
        f"`{heuristic}`: weights of all strategies of random chains of 1 to 8 edges by the recursion, "
        "densities over up to 12 orders of magnitude each, larger from one end all along a path",
        SUMS + f"; densities of {LEAST_WIDE:.1%} of the paths at least are more than 10^{WIDE} apart",
        partial(chains, heuristic, batches, size),
        quick,
    )


def _paths(name: str, heuristic: str, count: int, lanes: int, number: int, least: int) -> Case:
    asked = f"; {least:,} paths at least" + ", every kind of lamp" * (count >= len(LAMPS))
    left_out = (
        "paths left out: at the rim of a disk on which light from the sky starts, at the poles of an "
        "`envmap`, on the surface of a lamp, "
    )
    left_out += "along edges so short that the offset of rays turns them by more than 1e-3 of a cosine"
    return Case(
        f"weights-paths-{name}",
        SECTION,
        f"`{heuristic}`: paths that the kernel makes in random scenes (hypothesis: shapes, BSDFs, emitters, "
        "sensors, coefficients, all connections or one); its own weight, and those of all other strategies "
        "from densities asked of the scene anew",
        SUMS + OWN + f"{asked}; {left_out}",
        partial(of_the_kernel, heuristic, count, lanes, number, least),
        quick=name == "few",
    )


CASES = (
    _paths("balance", "balance", 26, 150_000, 3, 10**7),
    _paths("power", "power", 8, 3 << 14, 4, 10**6),
    _paths("few", "balance", 3, 1 << 11, 7, 10**4),
    Case(
        "weights-glint",
        SECTION,
        "`balance`: paths that the kernel makes around a lamp on a sphere of radius 1e-3, 0.2 above a box "
        "and 1 above a floor, both diffuse; Mitsuba's density for the cone towards it is off by 0.4 % there "
        "and more",
        SUMS + OWN + "; 20,000 paths at least",
        partial(glint, 1 << 15, 20_000),
        quick=True,
    ),
    _chains("balance", 26, 1 << 17),
    _chains("power", 26, 1 << 17),
    Case(
        "weights-extremes",
        SECTION,
        "each density 1e-30, 1 or 1e30, or 1e-10, 1 or 1e10, whatever its neighbours are, all heuristics",
        "no weight is negative, above 1 or not finite; sums are 1 within 1e-3 where all products on the way "
        f"are within 10^{HELD}, which {LEAST_HELD:.0%} of the paths are at least (what passes 1e37 is cut)",
        partial(extremes, 32, 1 << 12),
        quick=True,
    ),
)
