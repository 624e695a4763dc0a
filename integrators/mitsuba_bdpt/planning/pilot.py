"""A pilot: a few thousand bidirectional samples that estimate all variances.

docs/method/skipping.md derives the second moment of a candidate of `CANDIDATES` from samples that use all
strategies (S = 1, all inner connections, balance heuristic with kappa = 1); symbols are as there. The
candidate's own estimate of a path is (w f / p) kappa_own / (n_own sum_i kappa_i s_i). The samples use neither
roulette nor a drawn connection; unshadowed contributions give the variance of the draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import components
from ..sampling.points import Points, Stream
from ..scene.prepared import PreparedScene
from ..sensors.records import CameraStart, Region
from ..settings import Settings
from ..transport import connections, mis
from ..transport.batch import Batch
from ..transport.contribution import COUNTERS, Contribution, Counters
from ..transport.inputs import Shared, TraceContext
from ..transport.kernel import Lane, trace
from ..transport.photons.guided_hits import Unguided
from ..transport.plan import Plan
from ..transport.subpaths import CameraSample
from ..transport.walk import Vertex
from . import moments
from .configuration import CANDIDATES
from .moments import GuidableLight, Moments

if TYPE_CHECKING:
    # Row: a number for each candidate, or for the last ones; Total: rows of a camera sample by part.
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

PACKET = 16  # lanes that run a loop together


@dataclass
class Pilot:
    """Sink (see `image.sink`) of a pilot's contributions, with or without ``media``.

    In a ``batch`` each `PER_PIXEL` consecutive camera samples are of one pixel. ``rarest``: see `RAREST`;
    ``direct``: see `DIRECT`; ``emission`` accumulates emission statistics.
    """

    region: Region
    batch: Batch
    rarest: float
    direct: float = 1.0
    media: bool = False
    emission: Any = None  # `guided_emission.EmissionStatistics`
    alpha = False

    def __post_init__(self):
        self._least = dr.opaque(mi.Float64, 1 / self.rarest)
        self._samples = dr.zeros(mi.Float64, self.batch.size * moments.width(moments.SAMPLE))
        self._splats = dr.zeros(mi.Float64, moments.GROUPS * moments.FINE**2 * moments.width(moments.SPLAT))
        dr.make_opaque(self._samples, self._splats)

    def begin(self) -> Total:
        """Zero totals."""
        evaluated: Total = {"evaluated": mi.UInt32(0)} if self.media else {}
        return {name: [mi.Float64(0) for _ in range(n)] for name, n in moments.SUMS.items()} | evaluated

    def add(
        self, kernel: TraceContext, c: Contribution, total: Total, start: CameraStart, shared: Shared
    ) -> Total:
        """Accumulate a contribution with t >= 2."""
        size = _size(c)
        self._add_emission(c, size, start.position, c.active)
        new = self._parts(size, c) | {"brightness": [size]}
        return total | {name: _sums(total[name], more) for name, more in new.items()}

    def connect(
        self, kernel: TraceContext, z: Vertex, lane: Lane, stream: Stream, total: Total, start: CameraStart
    ) -> tuple[Total, Counters]:
        """Connect the camera vertex ``z`` with all light vertices of its lane."""

        def add(c: Contribution, seen: Contribution, total: dict[str, Row]) -> dict[str, Row]:
            size = _size(c)
            parts = self._parts(size, c)
            unshadowed = parts["estimate"]
            if kernel.has_media:  # its weight depends on the medium
                c, size = seen, _size(seen)
                parts = self._parts(size, c)
            self._add_emission(replace(c, emission=lane.emission), size, start.position, seen.active)
            new = {name: [dr.select(seen.active, x, 0) for x in part] for name, part in parts.items()}
            pairs = zip(new["estimate"], unshadowed, strict=True)
            drawn = [dr.select(b > 0, dr.square(a) / b, 0) for a, b in pairs]  # 0 where both are 0
            new |= {"unshadowed": unshadowed, "drawn": drawn}
            return {name: _sums(sums, new[name]) for name, sums in total.items()}

        names = ("unshadowed", "estimate", "drawn") if kernel.has_media else ("unshadowed", "estimate")
        found = {name: [mi.Float64(0) for _ in moments.WITH_INNER] for name in names}
        found |= {name: total[name] for name in ("moment", "peak", "light")}
        found, counted = connections.connect_all(kernel, z, lane.path, stream, found, add)
        unshadowed, seen = found.pop("unshadowed"), found["estimate"]
        # A connection drawn in proportion to its unshadowed size represents all: its second moment is the sum
        # of all sizes times that of seen^2 / size, without media the sum of the visible ones; that of all
        # connections is the square of what is seen.
        drawn = found.pop("drawn", seen)
        rows = zip(moments.WITH_INNER, total["draw"], unshadowed, drawn, seen, strict=True)
        found["draw"] = [d + (b * q - a * a) / candidate.counts["inner"] for candidate, d, b, q, a in rows]
        several = [a for candidate, a in zip(moments.WITH_INNER, seen, strict=True) if candidate.joined > 1]
        for name, more in (("estimate", seen), ("several", several), ("brightness", seen[-1:])):
            found[name] = _sums(total[name], more)
        if self.media:
            found["evaluated"] = total["evaluated"] + counted.evaluated
        return total | found, counted

    def splat(self, kernel: TraceContext, c: Contribution, shared: Shared, stream: Stream) -> Counters:
        """Accumulate a contribution with t <= 1."""
        size, lanes, tile = _size(c), self.batch.lanes, self.region.tile(c.position, moments.FINE)
        row = moments.group(dr.arange(mi.UInt32, lanes)) * moments.FINE**2 + tile
        _add(self._splats, moments.SPLAT, {"size": [size], **self._parts(size, c)}, row, size > 0)
        # Weight of a splat relative to a camera sample.
        self._add_emission(c, size * np.sqrt(self.batch.size / lanes), c.position, c.active)
        return Counters()

    def end(
        self, kernel: TraceContext, lane: Lane, sample: CameraSample, total: Total, seen: mi.Bool
    ) -> Counters:
        """Accumulate a camera sample."""
        slot = dr.arange(mi.UInt32, self.batch.lanes)
        tile, evaluated = self.region.tile(sample.start.position, moments.FINE), total.get("evaluated", 0)
        found = total | {"tile": [mi.Float64(tile)], "evaluated": [mi.Float64(evaluated)]}
        _add(self._samples, moments.SAMPLE, found, slot, sample.covered)
        return Counters()

    def _add_emission(self, c: Contribution, size: mi.Float64, position: mi.Point2f, active: mi.Bool):
        if self.emission is not None:
            half = moments.group(dr.arange(mi.UInt32, self.batch.lanes)) % 2  # samples of a pixel are in one
            tile = self.region.tile(position, moments.EMISSION_TILES)
            self.emission.accumulate(c.shares, c.emission, tile, half, dr.square(size), active & (size > 0))

    def moments(self, counts: mi.UInt64, spp: float, guidable: GuidableLight) -> Moments:
        """Evaluate the recorded kernel and its ``counts``: moments for a render of ``spp``."""
        dr.eval(self._samples, self._splats, counts)
        samples = moments.split(np.array(self._samples), moments.SAMPLE)
        splats = moments.split(np.array(self._splats) / self.batch.lanes, moments.SPLAT)
        numbers = dict(zip(COUNTERS, counts.numpy().tolist(), strict=True))
        size, lanes = self.batch.size, self.batch.lanes
        of_light = ("light", "shadow_t1")
        rays = {name: count / (lanes if name in of_light else size) for name, count in numbers.items()}
        evaluated = samples["evaluated"][: size // PACKET * PACKET]
        if self.media and len(evaluated):
            rays["packets"] = float(evaluated.reshape(-1, PACKET).max(1).mean())
        rays["guidable"] = float(guidable.vertices.sum())
        emission = self.emission.evaluated() if self.emission is not None else None
        return moments.moments(samples, splats, rays, spp, guidable, emission)

    def _parts(self, size: mi.Float64, c: Contribution) -> dict[str, Row]:
        """What a contribution ``c`` of weighted ``size`` adds to `moments.SUMS`."""
        # Shares of the classes in the sum of all densities; may be 0 / 0 where `size` is 0.
        shares = dict(zip(mis.CLASSES, dr.select(size > 0, c.shares, 1), strict=True))
        lost = LOST * dr.square(size)
        # Direct illumination by other strategies than light tracing.
        gain = 1 if c.kind == "inner" else dr.select(c.s + c.t == 3, mi.Float64(self.direct), 1)
        of_light, others = {"light": shares["light"]}, shares | {"light": 0}
        parts: dict[str, Row] = {"estimate": [], "moment": [], "peak": []}
        for candidate in CANDIDATES:
            weights, counts = candidate.weights, candidate.counts
            second = {kind: w and w**2 / counts[kind] for kind, w in weights.items()}
            fourth = {kind: w and w**4 / counts[kind] ** 3 for kind, w in weights.items()}
            total = _dot(weights, shares)
            # With inner connections all classes are in use; others may be unable to sample the path.
            possible = mi.Bool(True) if weights["inner"] else total > 0
            # Rate of the path relative to the pilot (see `RAREST`): share of the classes in use.
            rate = _dot({kind: float(weight > 0) for kind, weight in weights.items()}, shares)
            seldom = dr.maximum(1, self._least / rate)
            scale = size / (total * seldom)
            square = dr.square(scale) * seldom
            light = square * _dot(second, of_light)
            moment = dr.select(possible, square * gain * _dot(second, others) + light, lost)
            peak = dr.square(gain) * _dot(fourth, others) + _dot(fourth, of_light)
            peak = dr.select(possible, square * dr.square(scale) * peak, 0)
            if weight := weights[c.kind]:
                estimate = scale if weight == 1 else weight * scale
                if c.kind != "light":
                    estimate *= dr.sqrt(gain)
                    moment -= dr.square(estimate) / counts[c.kind]
                    peak -= dr.square(dr.square(estimate)) / counts[c.kind] ** 3
                parts["estimate"].append(estimate)
            parts["moment"].append(moment)
            parts["peak"].append(peak)
        return parts | {"light": [light]}


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
    everything = replace(CANDIDATES[-1].plan(plan), merging=False, roulette=False)
    if plan.connections != "none":
        everything = replace(everything, connections="all")
    kernel = TraceContext(prepared, everything, settings, mis.ByClass())
    if everything.guidable and (prepared.delta if guidable is None else guidable.second.any()):
        kernel = kernel.replaced(sds=Unguided(kernel.near_specular and guidable is not None))
    region, emission = prepared.camera.region, None
    if everything.teachable:
        cells = components.guided_emission.Cells(prepared.emitters)
        kernel = kernel.replaced(cells=cells, emitters=cells.emitters)
        emission = components.guided_emission.EmissionStatistics(moments.EMISSION_TILES**2, cells.count)
    pixels = int(region.size.prod())
    samples = moments.PER_PIXEL * max(1, lanes // (moments.PER_PIXEL * pixels))
    batch = Batch(0, min(lanes // samples, pixels), 0, samples, spread=pixels, light=LIGHT_TIMES)
    direct = DIRECT if settings.points == "sobol" else 1.0
    pilot = Pilot(region, batch, max(stands_for, RAREST), direct, prepared.space is not None, emission)
    # Independent numbers in each sample: products of samples give the squared mean.
    counts = trace(kernel, pilot, batch, Points(settings.points, seed), samples)
    guidable = guidable or GuidableLight(*np.zeros((len(GuidableLight._fields), moments.FINE**2)))
    return pilot.moments(counts, max(stands_for * batch.size / pixels, 1), guidable)


def _add(
    target: mi.Float64, parts: dict[str, int], found: Mapping[str, Row], row: mi.UInt32, active: mi.Bool
):
    """Add ``found`` to a row of ``target`` as a packet; `dr.scatter` would evaluate what is recorded."""
    values = [x for name in parts for x in found[name]]
    packet = mi.ArrayXd(values + [mi.Float64(0)] * (moments.width(parts) - len(values)))
    dr.scatter_reduce(dr.ReduceOp.Add, target, packet, row, active)


def _size(c: Contribution) -> mi.Float64:
    """Mean over the colours of a weighted contribution; additive, unlike the maximum.

    In double precision, since its square overflows or underflows single precision in some units of radiance.
    Directly seen emitters do not count: their edges would outweigh all else relative to their surroundings,
    and are equally noisy in all configurations.
    """
    colours = [mi.Float64(dr.abs(colour)) for colour in mi.unpolarized_spectrum(c.value)]
    return dr.select(c.active & (c.s + c.t > 2), sum(colours) / len(colours) * mi.Float64(c.weight), 0)


def _sums(total: Row, more: Row) -> Row:
    """Add ``more`` to the last of ``total``; loops do not store the others (see `walk.Walk`)."""
    first = len(total) - len(more)
    return total[:first] + [a + b for a, b in zip(total[first:], more, strict=True)]


def _dot(factors: Mapping[str, float], shares: Mapping[str, mi.Float | int]):
    """sum_i factor_i share_i over the classes in use."""
    used = [(factors[kind], x) for kind, x in shares.items() if factors[kind] and not mis.is_absent(x)]
    used = [x if factor == 1 else factor * x for factor, x in used]
    return sum(used[1:], used[0]) if used else mi.Float64(0)
