"""A pilot: a few thousand bidirectional samples that estimate all variances.

docs/method/skipping.md derives the second moment of a candidate of `CANDIDATES` from samples that use all
strategies (S = 1, all inner connections, balance heuristic with kappa = 1); symbols are as there. The
candidate's own estimate of a path is (w f / p) kappa_own / (n_own sum_i kappa_i s_i). The samples use neither
roulette nor a drawn connection; unshadowed contributions give the variance of the draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import components
from ..sampling.points import Points
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport import connections, mis
from ..transport.batch import Batch
from ..transport.contribution import COUNTERS, Counters
from ..transport.inputs import Kernel
from ..transport.kernel import trace
from ..transport.photons.guided_hits import Unguided
from ..transport.plan import Plan
from . import moments
from .configuration import CANDIDATES
from .moments import (
    EMISSION_TILES,
    FINE,
    GROUPS,
    PER_PIXEL,
    SAMPLE,
    SPLAT,
    SUMS,
    GuidableLight,
    Layout,
    Moments,
)

if TYPE_CHECKING:
    from ..guided_emission import EmissionStatistics
    from ..sampling.points import Stream
    from ..sensors.records import CameraStart, Region
    from ..transport.contribution import Contribution
    from ..transport.inputs import Shared
    from ..transport.kernel import Lane
    from ..transport.subpaths import CameraSample
    from ..transport.walk import Vertex

    # One number for each of the last candidates; a camera sample has one by name of a part of its row.
    Row = list[mi.Float64]
    Total = dict[str, Row | mi.UInt32]

# A path counts as if a candidate sampled it at least once per RAREST samples of it by the pilot, or per as
# many as a pilot's sample represents: what a render is unlikely to sample is missing light, not noise. See
# experiments, "Choice of strategies".
RAREST = 1024

# Factor of the squared size of a path that a candidate cannot sample; `moments.RULED_OUT` then rules out
# candidates that miss a millionth of a pixel or more. Smaller misses must pass: rounding leaves cosines of
# 1e-20 between points of one plane, and densities that are 0 in single precision.
LOST = 1e30

# Light subpaths per camera sample, most without one: they are cheap, and few hit a small caster of a caustic.
LIGHT_TIMES = 4

# What Sobol' points leave of the variance of direct illumination (paths of two edges) due to camera samples:
# they stratify few dimensions well. See experiments, "Choice of strategies".
DIRECT = 1 / 64

# Lanes that run a loop together.
PACKET = 16

_WITH_INNER = tuple(candidate for candidate in CANDIDATES if candidate.connections != "none")

# `Counters` of light subpaths only.
_OF_LIGHT = ("light", "shadow_t1")


class Pilot:
    """Sink (see `image.sink`) of a pilot's contributions, with or without ``media``.

    In a ``batch`` each `PER_PIXEL` consecutive camera samples are of one pixel. ``direct``: see `DIRECT`;
    ``emission`` accumulates emission statistics.
    """

    alpha = False

    def __init__(
        self,
        region: Region,
        batch: Batch,
        rarest: float,
        direct: float = 1.0,
        media: bool = False,
        emission: EmissionStatistics | None = None,
    ):
        self._emission = emission
        # Weight of a splat relative to a camera sample.
        self._weight = batch.size / batch.lanes
        self._region, self._lanes, self._media = region, batch.lanes, media
        self._direct = direct
        self._least = dr.opaque(mi.Float64, 1 / rarest)
        self._samples = dr.zeros(mi.Float64, batch.size * SAMPLE.width)
        self._splats = dr.zeros(mi.Float64, GROUPS * FINE**2 * SPLAT.width)
        dr.make_opaque(self._samples, self._splats)

    def begin(self) -> Total:
        """Zero totals."""
        evaluated: Total = {"evaluated": mi.UInt32(0)} if self._media else {}
        return {name: _none(SAMPLE.parts[name]) for name in SUMS} | evaluated

    def add(self, kernel: Kernel, c: Contribution, total: Total, start: CameraStart, shared: Shared) -> Total:
        """Accumulate a contribution with t >= 2."""
        size = self._size(c)
        self._add_emission(c, size, start.position, c.active)
        own, squares = self._parts(size, c)
        new = {"estimate": own, **squares, "brightness": [size]}
        return total | {name: _sums(total[name], more) for name, more in new.items()}

    def connect(
        self, kernel: Kernel, z: Vertex, lane: Lane, stream: Stream, total: Total, start: CameraStart
    ) -> tuple[Total, Counters]:
        """Connect the camera vertex ``z`` with all light vertices of its lane."""

        def add(c: Contribution, seen: Contribution, total: dict[str, Row]) -> dict[str, Row]:
            size = self._size(c)
            own, squares = self._parts(size, c)
            unshadowed = own
            if kernel.has_media:  # its weight depends on the medium
                c, size = seen, self._size(seen)
                own, squares = self._parts(size, seen)
            self._add_emission(replace(c, emission=lane.emission), size, start.position, seen.active)
            found = {"visible": own, **squares}
            new = {n: [dr.select(seen.active, x, 0) for x in v] for n, v in found.items()}
            new = {"unshadowed": unshadowed} | new
            if kernel.has_media:
                new["drawn"] = [_drawn(a, b) for a, b in zip(new["visible"], unshadowed, strict=True)]
            return {name: _sums(sums, new[name]) for name, sums in total.items()}

        names = ("unshadowed", "visible", "drawn") if kernel.has_media else ("unshadowed", "visible")
        found = {name: _none(SAMPLE.parts["draw"]) for name in names}
        found |= {name: total[name] for name in ("moment", "light", "peak")}
        found, counted = connections.connect_all(kernel, z, lane.path, stream, found, add)
        unshadowed, seen = found.pop("unshadowed"), found.pop("visible")
        # A connection drawn in proportion to its unshadowed size represents all: its second moment is the sum
        # of all sizes times that of seen^2 / size, without media the sum of the visible ones; that of all
        # connections is the square of what is seen.
        drawn = found.pop("drawn", seen)
        rows = zip(_WITH_INNER, total["draw"], unshadowed, drawn, seen, strict=True)
        draw = [d + (b * q - a * a) / candidate.counts["inner"] for candidate, d, b, q, a in rows]
        several = [a for candidate, a in zip(_WITH_INNER, seen, strict=True) if candidate.joined > 1]
        # In the order of `begin`, as the state of a loop requires.
        found |= {"estimate": _sums(total["estimate"], seen), "draw": draw}
        found["several"] = _sums(total["several"], several)
        found["brightness"] = _sums(total["brightness"], seen[-1:])
        if self._media:
            found["evaluated"] = total["evaluated"] + counted.evaluated
        return total | found, counted

    def splat(self, kernel: Kernel, c: Contribution, shared: Shared, stream: Stream) -> Counters:
        """Accumulate a contribution with t <= 1."""
        size = self._size(c)
        row = moments.group(dr.arange(mi.UInt32, self._lanes)) * FINE**2 + self._region.tile(c.position, FINE)
        _, found = self._parts(size, c)
        found = {"size": [size], **found}
        _add(self._splats, SPLAT, found, row, size > 0)
        self._add_emission(c, size * np.sqrt(self._weight), c.position, c.active)
        return Counters()

    def end(self, kernel: Kernel, lane: Lane, sample: CameraSample, total: Total, seen: mi.Bool) -> Counters:
        """Accumulate a camera sample."""
        slot = dr.arange(mi.UInt32, self._lanes)
        others = {"tile": self._region.tile(sample.start.position, FINE)}
        others["evaluated"] = total["evaluated"] if self._media else 0
        found = total | {name: [mi.Float64(value)] for name, value in others.items()}
        _add(self._samples, SAMPLE, found, slot, sample.covered)
        return Counters()

    def _add_emission(self, c: Contribution, size: mi.Float64, position: mi.Point2f, active: mi.Bool):
        if self._emission is not None:
            lane = dr.arange(mi.UInt32, self._lanes)
            half = moments.group(lane) % 2  # samples of a pixel are in one
            tile = self._region.tile(position, EMISSION_TILES)
            square, active = dr.square(size), active & (size > 0)
            self._emission.accumulate(c.shares, c.emission, tile, half, square, active)

    def evaluate(self, counts: mi.UInt64):
        """Evaluate the recorded kernel together with ``counts``."""
        dr.eval(self._samples, self._splats, counts)

    def moments(self, counts: dict[str, int], spp: float, guidable: GuidableLight) -> Moments:
        """The pilot's moments for a render of ``spp`` samples per pixel.

        ``counts`` of the lanes' counters; ``guidable`` light is in no sample.
        """
        rows = np.array(self._samples).reshape(-1, SAMPLE.width)
        sums = np.array(self._splats).reshape(GROUPS, FINE**2, SPLAT.width)
        splats = moments.Splats(sums, self._lanes)
        rays = {
            name: count / (self._lanes if name in _OF_LIGHT else len(rows)) for name, count in counts.items()
        }
        evaluated = SAMPLE.of(rows, "evaluated")[: len(rows) // PACKET * PACKET]
        if self._media and len(evaluated):
            rays["packets"] = float(evaluated.reshape(-1, PACKET).max(1).mean())
        rays["guidable"] = guidable.vertices
        emission = self._emission.evaluated() if self._emission is not None else None
        return moments.moments(moments.Samples.of_rows(rows), splats, rays, spp, guidable, emission)

    def _parts(self, size: mi.Float64, c: Contribution) -> tuple[Row, dict[str, Row]]:
        """What a contribution ``c`` of weighted ``size`` adds.

        Estimates of the candidates that use its class, and a dictionary of what it adds to ``moment``,
        ``light`` and ``peak``, see `moments.SAMPLE`.
        """
        shares = _shares(size, c)
        lost = LOST * dr.square(size)
        # Direct illumination by other strategies than light tracing.
        gain = 1 if c.kind == "inner" else dr.select(c.s + c.t == 3, mi.Float64(self._direct), 1)
        own, squares, lights, peaks = [], [], [], []
        for candidate in CANDIDATES:
            weights, counts = candidate.weights, candidate.counts
            second = {kind: w and w**2 / counts[kind] for kind, w in weights.items()}
            fourth = {kind: w and w**4 / counts[kind] ** 3 for kind, w in weights.items()}
            total = _dot(weights, shares)
            # With inner connections all classes are in use; others may be unable to sample the path.
            possible = mi.Bool(True) if weights["inner"] else total > 0
            # Rate of the path relative to the pilot: see `RAREST`.
            seldom = dr.maximum(1, self._least / _rate(weights, shares))
            scale = size / (total * seldom)
            square = dr.square(scale) * seldom
            moment = dr.select(possible, square * gain * _dot(second, shares | {"light": 0}), lost)
            peak = dr.square(gain) * _dot(fourth, shares | {"light": 0})
            if light := fourth["light"]:
                peak += light * shares["light"]
            peak = dr.select(possible, square * dr.square(scale) * peak, 0)
            if weight := weights[c.kind]:
                estimate = scale if weight == 1 else weight * scale
                if c.kind != "light":
                    estimate *= dr.sqrt(gain)
                    moment -= dr.square(estimate) / counts[c.kind]
                    peak -= dr.square(dr.square(estimate)) / counts[c.kind] ** 3
                own.append(estimate)
            squares.append(moment)
            peaks.append(peak)
            if light := second["light"]:
                lights.append(dr.select(possible, square * (light * shares["light"]), 0))
        return own, {"moment": squares, "light": lights, "peak": peaks}

    def _size(self, c: Contribution) -> mi.Float64:
        """Weighted size of a contribution that counts, in double precision.

        Its square overflows or underflows single precision in some units of radiance.

        Directly seen emitters do not count: their edges would outweigh all else relative to their
        surroundings, and are equally noisy in all configurations.
        """
        return dr.select(c.active & (c.s + c.t > 2), mi.Float64(_mean_colour(c)), 0)


def measure(
    prepared: PreparedScene,
    plan: Plan,
    settings: Settings,
    seed: mi.UInt32,
    lanes: int,
    stands_for: float = RAREST,
    guidable: GuidableLight | None = None,
) -> Moments:
    """Run a pilot of about ``lanes`` camera samples, spread over the image.

    Each represents ``stands_for`` samples of the render. ``guidable``: light that the samples leave out: its
    outliers would hide the differences of the candidates. None if it was not measured.
    """
    everything = replace(
        plan,
        merging=False,
        connections="none" if plan.connections == "none" else "all",
        camera_paths_per_light_path=1,
        joined=1,
        kappa_light=1.0,
        kappa_direct=1.0,
        roulette=False,
    )
    kernel = Kernel(prepared, everything, settings, mis.ByClass())
    if everything.guidable and (prepared.delta if guidable is None else guidable.second.any()):
        kernel = kernel.replaced(sds=Unguided(kernel.near_specular and guidable is not None))
    region, emission = prepared.camera.region, None
    if everything.teachable and everything.emission is None:
        cells = components.guided_emission.Cells(prepared.emitters)
        kernel = kernel.replaced(cells=cells, emitters=cells.emitters)
        emission = components.guided_emission.EmissionStatistics(EMISSION_TILES**2, cells.count)
    pixels = int(region.size.prod())
    samples = PER_PIXEL * max(1, lanes // (PER_PIXEL * pixels))
    chosen = min(lanes // samples, pixels)
    batch = Batch(0, chosen, 0, samples, spread=pixels, light=LIGHT_TIMES)
    direct = DIRECT if settings.points == "sobol" else 1.0
    pilot = Pilot(region, batch, max(stands_for, RAREST), direct, prepared.space is not None, emission)
    # Independent numbers in each sample: products of samples give the squared mean.
    points = Points(settings.points, seed)
    counts = trace(kernel, pilot, batch, points, samples)
    pilot.evaluate(counts)
    counted = dict(zip(COUNTERS, counts.numpy().tolist(), strict=True))
    return pilot.moments(counted, max(stands_for * batch.size / pixels, 1), guidable or GuidableLight())


def _add(target: mi.Float64, layout: Layout, found: Mapping[str, Row], row: mi.UInt32, active: mi.Bool):
    """Add ``found`` to a row of ``target`` as a packet.

    `dr.scatter` would evaluate the recorded computations.
    """
    values = layout.row(found)
    packet = mi.ArrayXd(values + [mi.Float64(0)] * (layout.width - len(values)))
    dr.scatter_reduce(dr.ReduceOp.Add, target, packet, row, active)


def _shares(size: mi.Float64, c: Contribution) -> dict[str, mi.Float | int]:
    """Shares of the classes in the sum of all densities.

    May be 0 / 0 where ``size`` is 0.
    """
    return dict(zip(mis.CLASSES, dr.select(size > 0, c.shares, 1), strict=True))


def _mean_colour(c: Contribution) -> mi.Float64:
    """Mean over the colours in double precision; additive, unlike the maximum."""
    colours = [mi.Float64(dr.abs(colour)) for colour in mi.unpolarized_spectrum(c.value)]
    return sum(colours) / len(colours) * mi.Float64(c.weight)


def _drawn(seen: mi.Float64, size: mi.Float64) -> mi.Float64:
    """seen^2 / size; 0 where both are 0."""
    return dr.select(size > 0, dr.square(seen) / size, 0)


def _none(n: int) -> Row:
    return [mi.Float64(0) for _ in range(n)]


def _sums(total: Row, more: Row) -> Row:
    """Add ``more``, of the last candidates only, to ``total``.

    Entries without an addend stay the same object, so that loops do not store them (see `walk.Walk`).
    """
    first = len(total) - len(more)
    return total[:first] + [a + b for a, b in zip(total[first:], more, strict=True)]


def _dot(factors: Mapping[str, float], shares: Mapping[str, mi.Float | int]):
    """sum_i factor_i share_i over the classes in use."""
    terms = [(factors[kind], share) for kind, share in shares.items()]
    used = [
        share if factor == 1 else factor * share
        for factor, share in terms
        if factor and not mis.is_absent(share)
    ]
    return sum(used[1:], used[0]) if used else mi.Float64(0)


def _rate(weights: Mapping[str, float], shares: Mapping[str, mi.Float | int]):
    """Share of the classes in use in the sum of all densities."""
    return _dot({kind: float(weight > 0) for kind, weight in weights.items()}, shares)
