"""A pilot: a few thousand bidirectional samples that tell the variance of every way to render.

Whether light subpaths and inner connections pay is decided per image (`choose`), by cost times
variance of each `Candidate`: path tracing alone, with light tracing, with inner connections, each with
several numbers S of camera subpaths per light subpath and several coefficients.

All variances come from the *same* samples, which use every strategy (S = 1, all inner connections, balance
heuristic with kappa = 1), so that a candidate is not judged by the samples that it would have
missed. For a contribution f / p of the pilot with weight w and shares s_i of the classes i in the sum of
all densities, and a candidate with counts n_i and coefficients kappa_i (E. Veach 1997, section 9.2),

* the candidate's own estimate of the path is (w f / p) kappa_own / (n_own sum_i kappa_i s_i);
* its second moment is the pilot's mean of (w f / p)^2 sum_i (kappa_i^2 s_i / n_i) / (sum_i kappa_i s_i)^2.

To the second moments come the products of different contributions within a camera sample, and off goes the
squared mean of the pixel, estimated without bias from two independent samples of it. The samples use
neither roulette on connections nor the draw of one connection; what the draw adds to the variance is known
from the unshadowed contributions. Points that are better than independent ones lower the variance of all
candidates; see `choice.STRATIFIED_SPLATS` for what that leaves to ask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from . import connect, mis, rays
from .kernel import COUNTERS, Batch, Kernel, trace
from .points import Points

# Tiles of the image over which brightness and variance are averaged, in each direction.
TILES = 8

# Independent parts of the pilot, among which outliers are looked for.
GROUPS = 16

# Camera samples of a pixel whose products give its squared mean (more of them where there are few pixels).
PER_PIXEL = 2


@dataclass(frozen=True)
class Weighting:
    """Coefficients kappa of the classes `mis.CLASSES`, relative to the densities of one sample each."""

    hit: float
    direct: float
    light: float
    inner: float

    @property
    def kappas(self) -> tuple:
        """In the order of `mis.CLASSES`."""
        return self.hit, self.direct, self.light, self.inner

    def of(self, kind: str) -> float:
        """kappa of a class."""
        return getattr(self, kind)

    @property
    def combination(self) -> str:
        """``n0c0`` path tracing alone, ``n1c0`` with light tracing, ``n1c1`` with inner connections."""
        return f"n{int(self.light > 0)}c{int(self.inner > 0)}"


WEIGHTINGS = (
    *(Weighting(1, direct, 0, 0) for direct in (1 / 16, 1 / 4, 1, 4)),
    *(Weighting(1, 1, light, 0) for light in (1 / 64, 1 / 16, 1 / 4)),
    *(Weighting(1, 1, light, 1) for light in (1 / 64, 1 / 16, 1 / 4, 1)),
)
_INNER = tuple(i for i, w in enumerate(WEIGHTINGS) if w.inner)


def _even(n: int) -> int:
    return n + n % 2


# What a lane keeps: its estimate by each weighting; the estimate's square, less the squares of single
# contributions, plus their second moments without t <= 1; those of t <= 1; and for each weighting with inner
# connections what drawing one of them adds; then the number of its vertices that were joined, and its tile.
_COLUMNS = _even(3 * len(WEIGHTINGS) + len(_INNER) + 2)
_SPLAT_COLUMNS = _even(2 * len(WEIGHTINGS) + 1)


@dataclass(frozen=True)
class Moments:
    """What a pilot found, in units of the image's relative squared error per sample and pixel.

    ``base``, ``light`` and ``draw`` have the shape (`GROUPS`, weightings): variance is ``base`` + S
    ``light``, plus ``draw`` where one inner connection is drawn. ``mean`` of the image (mean of the
    colours, emitters seen directly left out; the median of the groups', so that no outlier sets it);
    ``rays`` and connections per camera sample and kind, with one light subpath each; ``lanes``: number of
    camera samples.
    """

    base: np.ndarray
    light: np.ndarray
    draw: np.ndarray
    mean: float
    rays: dict
    lanes: int

    def variance(self, drawn: bool, factor: float = 1.0) -> np.ndarray:
        """Relative variance per sample, shape (`GROUPS`, 2, weightings): what does not depend on S, and what
        grows with it, that of splats. The latter counts by ``factor``, for points that lower it less."""
        return np.stack([self.base + (self.draw if drawn else 0), factor * self.light], axis=1)

    def joined(self, other: Moments) -> Moments:
        """This pilot and another, of which each counts by its number of ``lanes``."""
        share = self.lanes / (self.lanes + other.lanes)

        def mean(a, b):
            return share * a + (1 - share) * b

        return Moments(
            **{n: mean(getattr(self, n), getattr(other, n)) for n in ("base", "light", "draw", "mean")},
            rays={n: mean(self.rays[n], other.rays[n]) for n in self.rays},
            lanes=self.lanes + other.lanes,
        )


class Pilot:
    """Sink (see `sinks`) of a pilot's contributions: ``lanes`` samples, of which each `PER_PIXEL` that follow
    one another are of the same pixel."""

    alpha = False

    def __init__(self, region, lanes: int):
        self._region, self._lanes = region, lanes
        self._samples = dr.zeros(mi.Float, lanes * _COLUMNS)
        self._splats = dr.zeros(mi.Float, GROUPS * TILES**2 * _SPLAT_COLUMNS)
        dr.make_opaque(self._samples, self._splats)

    def begin(self):
        """Nothing found yet."""
        return {
            "estimate": [mi.Float(0) for _ in WEIGHTINGS],
            "moment": [mi.Float(0) for _ in WEIGHTINGS],
            "light": [mi.Float(0) for _ in WEIGHTINGS],
            "draw": [mi.Float(0) for _ in _INNER],
            "joined": mi.UInt32(0),
        }

    def add(self, kernel, c, total, start, shared):
        """Add a contribution with t >= 2."""
        return self._added(c.kind, _parts(self._size(c), c.shares), total)

    def _added(self, kind: str, parts, total):
        """``total`` with the `_parts` of a contribution of a class of camera samples."""
        estimates = [w.of(kind) * p.scale for w, p in zip(WEIGHTINGS, parts, strict=True)]
        return total | {
            "estimate": [a + b for a, b in zip(total["estimate"], estimates, strict=True)],
            "moment": [
                a + p.moment - dr.square(b) for a, p, b in zip(total["moment"], parts, estimates, strict=True)
            ],
            "light": [a + p.light for a, p in zip(total["light"], parts, strict=True)],
        }

    def connect(self, kernel, z, lane, stream, counters, total, start):
        """Join the camera vertex ``z`` with all light vertices of its lane."""

        def body(slot, total, before, after, nonzero):
            y = connect.read_light_vertex(kernel, lane.path, slot)
            c = connect.inner(kernel, z, y)
            size = self._size(c)
            nonzero = nonzero + dr.select(c.active, mi.UInt32(1), 0)
            ray = rays.segment(z.anchor, y.anchor, z.si)
            visible = c.active & ~rays.occluded(kernel.scene, ray, c.active)
            parts = _parts(size, c.shares)
            drawn = [WEIGHTINGS[i].inner * parts[i].scale for i in _INNER]
            before = [a + b for a, b in zip(before, drawn, strict=True)]
            after = [a + dr.select(visible, b, 0) for a, b in zip(after, drawn, strict=True)]
            total = self._added(c.kind, [p.where(visible) for p in parts], total)
            return slot + 1, total, before, after, nonzero

        candidates = connect.candidate_count(kernel, z, lane.path)
        none = [mi.Float(0) for _ in _INNER]
        _, total, before, after, nonzero = dr.while_loop(
            (mi.UInt32(0), total, none, list(none), mi.UInt32(0)),
            lambda slot, *_: slot < candidates,
            body,
            label="inner connections of a pilot",
        )
        counters["evaluated"] += candidates
        counters["zero"] += candidates - nonzero
        counters["shadow_inner"] += nonzero
        draw = [d + a * (b - a) for d, b, a in zip(total["draw"], before, after, strict=True)]
        joined = total["joined"] + dr.select(nonzero > 0, mi.UInt32(1), 0)
        return total | {"draw": draw, "joined": joined}

    def splat(self, kernel, c, position, shared, counters):
        """Add a contribution with t <= 1."""
        size = self._size(c)
        row = self._group(dr.arange(mi.UInt32, self._lanes)) * TILES**2 + self._tile(position)
        values = [size]
        for part in _parts(size, c.shares):
            values += [part.moment, part.light]
        _add(self._splats, _SPLAT_COLUMNS, values, row, size > 0)

    def end(self, kernel, lane, sample, total, seen, counters):
        """Add a camera sample."""
        columns = []
        for estimate, moment, light in zip(total["estimate"], total["moment"], total["light"], strict=True):
            columns += [estimate, dr.square(estimate) + moment, light]
        slot = dr.arange(mi.UInt32, self._lanes)
        columns += [*total["draw"], mi.Float(total["joined"]), mi.Float(self._tile(sample.start.position))]
        _add(self._samples, _COLUMNS, columns, slot, sample.covered)

    def evaluate(self, counts):
        """Run what was recorded, and ``counts`` with it."""
        dr.eval(self._samples, self._splats, counts)

    def moments(self, counts: dict) -> Moments:
        """What was found; ``counts`` what the lanes counted."""
        lanes = self._lanes
        samples = np.array(self._samples, dtype=np.float64).reshape(lanes, _COLUMNS)
        n = 3 * len(WEIGHTINGS)
        joined, tiles = samples[:, n + len(_INNER)], samples[:, n + len(_INNER) + 1].astype(int)
        splats = np.array(self._splats, dtype=np.float64).reshape(GROUPS, TILES**2, _SPLAT_COLUMNS)
        estimate, square, light = samples[:, :n:3], samples[:, 1:n:3], samples[:, 2:n:3]
        other = estimate.reshape(-1, PER_PIXEL, len(WEIGHTINGS))[:, ::-1].reshape(lanes, -1)
        with np.errstate(invalid="ignore"):
            base = square - estimate * other
        group = self._group(np.arange(lanes))
        # Camera samples over those of the tile, splats over the samples of an average tile.
        in_tile = np.maximum(np.bincount(tiles, minlength=TILES**2), 1)
        brightness = np.bincount(tiles, estimate[:, -1], TILES**2) / in_tile
        brightness += splats[:, :, 0].sum(axis=0) * (TILES**2 / lanes)
        by_group = np.stack([estimate[group == g, -1].sum() + splats[g, :, 0].sum() for g in range(GROUPS)])
        by_group *= GROUPS / lanes
        norm = brightness**2 + 0.01 * brightness.mean() ** 2
        norm = np.where(norm > 0, norm, np.inf)

        def summed(values, of_splats=0):
            weighted = values / norm[tiles][:, None]
            total = np.stack([weighted[group == g].sum(axis=0) for g in range(GROUPS)])
            return (total + of_splats) * (GROUPS / lanes)

        splat_base = (splats[:, :, 1 : 2 * len(WEIGHTINGS) : 2] / norm[:, None]).sum(axis=1)
        splat_light = (splats[:, :, 2 : 2 * len(WEIGHTINGS) + 1 : 2] / norm[:, None]).sum(axis=1)
        draw = np.zeros_like(estimate)
        draw[:, _INNER] = samples[:, n : n + len(_INNER)]
        return Moments(
            base=summed(base, splat_base),
            light=summed(light, splat_light),
            draw=summed(draw),
            mean=float(np.median(by_group)),
            rays={name: count / lanes for name, count in counts.items()} | {"joined": joined.mean()},
            lanes=lanes,
        )

    def _size(self, c):
        """Weighted size of a contribution: the mean of its colours, which adds up unlike the largest.

        Emitters seen directly do not count: relative to what is around them their edges would outweigh all
        else, and they are as noisy in any way of rendering, but for lamps much smaller than a pixel, which
        (1,1) finds and path tracing alone hardly.
        """
        size = dr.mean(dr.abs(mi.unpolarized_spectrum(c.value))) * c.weight
        return dr.select(c.active & (c.s + c.t > 2) & dr.isfinite(size), size, 0)

    def _group(self, lane):
        return lane // PER_PIXEL % GROUPS

    def _tile(self, position):
        uv = dr.clip(self._region.to_uv(position), 0, 1)
        xy = dr.minimum(mi.Point2u(uv * TILES), TILES - 1)
        return xy.y * TILES + xy.x


def measure(world, plan, settings, seed, lanes: int) -> Moments:
    """Run a pilot of about ``lanes`` camera samples, spread over the image."""
    everything = replace(
        plan,
        connections="none" if plan.connections == "none" else "all",
        served=1,
        splat_coefficient=1.0,
        direct_coefficient=1.0,
        roulette=False,
    )
    kernel = Kernel(world, everything, settings, mis.ByClass())
    region = world.camera.region
    pixels = int(region.size.prod())
    samples = PER_PIXEL * max(1, lanes // (PER_PIXEL * pixels))
    chosen = min(lanes // samples, pixels)
    stride = pixels // chosen
    batch = Batch(0, chosen, 0, samples, stride)
    pilot = Pilot(region, chosen * samples)
    # Independent numbers: the squared mean follows from products of samples.
    counts = trace(kernel, pilot, batch, Points("independent", seed), samples)
    pilot.evaluate(counts)
    return pilot.moments(dict(zip(COUNTERS, counts.numpy().tolist(), strict=True)))


def _add(target, columns: int, values, row, active):
    """Add ``values`` to a row of ``target``; as a packet, which takes an even number of them. (`dr.scatter`
    would evaluate what was recorded so far.)"""
    packet = mi.ArrayXf(values + [mi.Float(0)] * (columns - len(values)))
    dr.scatter_reduce(dr.ReduceOp.Add, target, packet, row, active)


@dataclass
class _Part:
    """A contribution under a weighting: ``scale`` times the coefficient of its class is its estimate;
    ``moment`` and ``light`` its second moment without and by t <= 1."""

    scale: object
    moment: object
    light: object

    def where(self, mask) -> _Part:
        """The same where ``mask``, else nothing."""
        return _Part(*(dr.select(mask, value, 0) for value in (self.scale, self.moment, self.light)))


def _parts(size, shares):
    return [_part(w, size, shares) for w in WEIGHTINGS]


def _part(w: Weighting, size, shares) -> _Part:
    kappas = w.kappas
    total = _dot(kappas, shares)
    scale = size / total
    squares = [k**2 for k in kappas]
    camera = _dot([*squares[:2], 0, squares[3]], shares)
    # A path that the candidate cannot make at all rules it out.
    possible = total > 0
    return _Part(
        scale=dr.select((size > 0) & possible, scale, 0),
        moment=dr.select(size > 0, dr.select(possible, dr.square(scale) * camera, dr.inf), 0),
        light=dr.select((size > 0) & possible, dr.square(scale) * _dot([0, 0, squares[2], 0], shares), 0),
    )


def _dot(weights, shares):
    """sum_i weights_i shares_i."""
    total = mi.Float(0)
    for weight, share in zip(weights, shares, strict=True):
        if weight:
            total += weight * share
    return total
