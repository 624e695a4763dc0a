"""Vertex merging (photon mapping) of paths that merges dominate; consistent, not unbiased.

Source: Georgiev 2012, see `mis`; in media docs/method/merging_in_media.md. A photon within a radius of the
camera vertex counts as if it were there. Two bounds from one side leave out most photons and camera vertices
of other paths, without bias (docs/method/sds_paths.md, "Bounds"):

* A merge counts if its kappa eta is at least B times c of both adjacent edges, one from each side, and the
  camera's subpath has no diffuse event before it (`sds.is_diffuse`).
* Photons, photon subpaths and camera vertices play Russian roulette with the ratio of the merge to the older
  alternatives of their side at a diffuse surface, in volumes at isotropic scattering. The estimate of a
  merge is then at most 1 / SLACK times that there: its density, and with it its BSDF, is as small as the
  probability.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..sampling import sobol
from ..sampling.points import Purpose, Stream, sequential
from ..sampling.reservoir import offer
from ..transport import mis, path_layers, scattering, spectra
from ..transport.alternatives import newest_connection
from ..transport.contribution import Contribution, one, size_of
from ..transport.inputs import TraceContext
from ..transport.photons.photon import Photon
from ..transport.photons.photon_pass import PhotonPolicy
from ..transport.sds import PhotonStrategy, State, is_diffuse
from ..transport.walk import Vertex
from .radius import Balls, Radius
from .wavelength_sets import SET_BITS, WavelengthSets

# Bits of a bucket's index in the hash table, and of the number of edges in sort keys and tags.
BUCKET_BITS, EDGES_BITS = 20, 12

# Factors of a cell's coordinates; M. Teschner et al., "Optimized Spatial Hashing for Collision Detection of
# Deformable Objects", 2003, section 4.1.
_PRIMES = 73856093, 19349663, 83492791

# Roulette begins where a merge at a diffuse surface has 1 / SLACK of B times the older alternatives.
SLACK = 0.2

# Index of the series of hashed numbers, of a camera vertex, that play this roulette; merges use the first.
_OF_QUERIES = 3

# Most distance of a merged photon from the tangent plane of the camera vertex, over the radius; least cosine
# between the geometric normals of both, which excludes edges and thin walls.
_FLAT, _SAME_SURFACE = 0.25, 0.8


@dataclass
class Merging(PhotonStrategy, PhotonPolicy):
    """Vertex merging in one pass; stores photons at all vertices where merges may count.

    ``radius`` of discs (surfaces); ``count``: photon subpaths that merge with a camera subpath; ``kappa``:
    coefficient of merges in all weights, see `coefficient`; ``tested``: most photons of a cell that a search
    tests; ``photons``: `Photons`, None while they are traced; ``wavelengths``: `WavelengthSets` in spectral
    variants, where photons merge with camera subpaths of the same set; ``balls``: radius in media, None if no
    medium scatters. Numbers are opaque ``Float``.
    """

    radius: Radius
    count: mi.Float
    kappa: mi.Float
    tested: mi.Float | float = dr.inf
    photons: Any = None
    wavelengths: WavelengthSets | None = None
    balls: Balls | None = None

    counters = ("merges",)
    merges = True
    only_specular = 0.0

    def around(self, p: mi.Point3f, volume: mi.Bool, medium) -> tuple[mi.Float, Radius]:
        """Radius at ``p`` (scene units) of a disc, in a ``volume`` of a ball; the `Radius` that bounds it."""
        if self.balls is None:
            return self.radius.at(p), self.radius
        return self.balls.at(p, dr.select(volume, medium, mi.UInt32(0)), self.radius)

    def eta(self, vertex) -> mi.Float:
        """n pi r^2 at a ``vertex`` on a surface, n 4/3 pi r^3 times mean extinction in a volume.

        In scene units squared; n: ``count``. See docs/method/merging_in_media.md.
        """
        r, _ = self.around(vertex.si.p, vertex.volume, vertex.medium)
        disc = self.count * dr.pi * dr.square(r)
        if self.balls is None:
            return disc
        in_ball = 4 / 3 * r * self.balls.media.mean(vertex.medium)
        return disc * dr.select(vertex.volume, in_ball, 1)

    def kappa_eta(self, vertex):
        disc = self.kappa * (self.count * dr.pi * dr.square(self.radius.at(vertex.si.p)))
        if self.balls is not None:  # kappa of a ball: a disc's over the probability of a collision, at most 1
            disc = dr.select(vertex.volume, dr.minimum(self.eta(vertex), disc), disc)
        if vertex.sds is not None and vertex.sds.behind_diffuse is not None:
            disc = dr.select(vertex.sds.behind_diffuse, 0, disc)
        return dr.minimum(disc, mis.SATURATION)

    def begin_light(self, kernel, walk):
        zero = kernel.heuristic.zero()
        return replace(walk, partial=replace(walk.partial, d_vm=zero, d_vm_newest=zero))

    def begin_camera(self, kernel, walk):
        return replace(self.begin_light(kernel, walk), sds=State(behind_diffuse=mi.Bool(False)))

    def begin(self, kernel, e, walk):
        return replace(walk, sds=State(survived=mi.Float(1)))

    def survival(self, state, partial, vertex):
        # Also at the median radius: the subpath may go on to where discs are larger.
        median = self.kappa * self.count * dr.pi * dr.square(self.radius.median)
        most = dr.maximum(self.kappa_eta(vertex), median)
        in_media = mi.Bool(self.balls is not None)  # the next vertex may lie in a volume
        survived = dr.minimum(state.survived, _probability(partial.d_vc, most, in_media))
        return survived / state.survived, State(survived=survived)

    def may_merge(self, kernel: TraceContext, vertex, connection: mis.PartialSum) -> mi.Bool:
        """Mask: by its side alone a merge at ``vertex`` may count; ``connection``: c of the edge to it."""
        absorbed = vertex.volume & spectra.is_zero(vertex.throughput)
        possible = vertex.hit & vertex.connectible() & (vertex.edges < kernel.last_merged) & ~absorbed
        merge = self.kappa_eta(vertex)
        return possible & (merge > 0) & mis.exceeds(merge, connection)

    def kept(self, kernel: TraceContext, vertex, survived: mi.Float | float = 1.0) -> mi.Float:
        """Probability of sampling merges at ``vertex``, over that with which its subpath ``survived``."""
        d_vc = kernel.heuristic.scale(vertex.partial.d_vc, vertex.cos)  # before the edge to it
        return dr.minimum(_probability(d_vc, self.kappa_eta(vertex), vertex.volume) / survived, 1)

    def stored(self, kernel, y, stream):
        keep = self.may_merge(kernel, y, newest_connection(kernel, y, adjoint=True))
        probability = self.kept(kernel, y, y.sds.survived)
        u = kernel.points.draw_1d("light", stream, Purpose.CONNECTION, y.event)
        return keep & (u < probability), probability

    def inside(self, y, *planes):
        r, _ = self.around(y.si.p, y.volume, y.medium)
        part = mi.Float(1)
        for p, n in planes:
            h = dr.minimum(dr.abs(dr.dot(n, y.si.p - p)) / r, 1)
            part *= dr.select(dr.squared_norm(n) > 0, 1 - dr.square(1 - h) * (2 + h) / 4, 1)
        return dr.select(y.volume, part, 1)

    def is_merged(self, kernel, z, stream):
        word = kernel.points.series(stream, Purpose.CONNECTION, z.event, mi.UInt32(_OF_QUERIES))
        possible = self.may_merge(kernel, z, _connection(kernel, z))
        return possible & (sequential(word)[0] < self.kept(kernel, z))

    def merged(self, kernel: TraceContext, z: Vertex, stream: Stream, wavelength_set=None) -> Contribution:
        drawn = sample(kernel, self, z, stream, wavelength_set)
        y, f = drawn.photon, drawn.f
        diffuse = is_diffuse(kernel, f)
        before = (dr.select(diffuse, 0, x) for x in (y.d_vm, y.d_vm_newest))
        light = mis.Partial(0, y.d_vc, *before), y.connection, f.pdf_fwd_w
        camera = z.partial, _connection(kernel, z), f.pdf_rev_w
        h = kernel.heuristic
        connections = h.combine(y.connection, newest_connection(kernel, z, adjoint=False))
        weight = mis.weigh_merge(h, self.kappa_eta(z), light, camera, connections)
        active = drawn.active & ~(weight == 0)
        value = drawn.value / self.kept(kernel, z)
        of_camera = path_layers.evaluated(z.layer, f, adjoint=False)
        path_layer = path_layers.joined(of_camera, y.layer)
        c = Contribution(value, weight, y.edges + 1, z.edges, active, None, "merge")
        return replace(c, light_group=kernel.light_group(y.emitter, active), path_layer=path_layer)

    def visit(self, kernel, z, walk, stream, shared, add, state):
        total, counters = state

        def merged(z, total, lost, merges):
            c = self.merged(kernel, z, stream, shared.wavelength_set)
            return *add(c, total, lost), merges + one(c.active)

        # A separate branch: few lanes are on such a path.
        total, lost, merges = dr.if_stmt(
            (z, total, counters.non_finite, counters.merges),
            self.is_merged(kernel, z, stream),
            merged,
            lambda z, total, lost, merges: (total, lost, merges),
            label="merges",
        )
        return total, replace(counters, non_finite=lost, merges=merges)


def _connection(kernel: TraceContext, z: Vertex) -> mis.PartialSum:
    """c of the edge to the camera vertex ``z``."""
    return newest_connection(kernel, z, adjoint=False, prime=True)


def _probability(d_vc: mis.PartialSum, merge: mi.Float, volume: mi.Bool) -> mi.Float:
    """Probability of sampling a ``merge`` of this partial sum; ``d_vc`` before the edge to it."""
    if mis.is_absent(d_vc):
        return mi.Float(1)
    measure = dr.select(volume, 4 * dr.pi, dr.pi)
    return dr.minimum(SLACK * measure * merge / (mis.MERGE_DOMINATED * d_vc), 1)


def coefficient(samples: float, radius: float) -> float:
    """kappa of merges in discs of ``radius`` pixels.

    One over the number of camera vertices that share the photons of a disc, with ``samples`` samples per
    pixel: their merges are correlated, and weights by densities alone would treat them as independent.
    """
    return min(1.0, 1 / (samples * math.pi * radius**2))


@dataclass
class Photons:
    """The photons of a pass, ``found`` (a `Photon` of arrays), sorted by bucket.

    ``searched``: 8 numbers of each (position, flux; normal, `tag_of`), read by two packet loads;
    ``starts``: the first photon of each bucket, and the end of the last.
    """

    found: Photon
    searched: mi.Float
    starts: mi.UInt32

    @staticmethod
    def of(found: Photon, tag: mi.UInt32, starts: mi.UInt32) -> Photons:
        """The photons ``found``, sorted, with their ``tag``."""
        rows = [*found.p, size_of(found.flux), *found.n, dr.reinterpret_array(mi.Float, tag)]
        return Photons(found, dr.ravel(mi.ArrayXf(rows)), starts)


def tag_of(edges: mi.UInt32, wavelength_set: Any, medium: Any) -> mi.UInt32:
    """Medium (0 on surfaces) and wavelength set of a photon, above `EDGES_BITS` of its number of edges."""
    kind = mi.UInt32(0) if medium is None else medium << SET_BITS
    if wavelength_set is not None:
        kind |= wavelength_set
    return (kind << EDGES_BITS) | dr.minimum(edges, (1 << EDGES_BITS) - 1)


def level_of(radius: Radius, r: mi.Float) -> mi.UInt32:
    """Level of the grid for photons of radius ``r``; cell sizes double by level."""
    return mi.UInt32(dr.maximum(dr.floor(dr.log2(r / radius.low)), 0))


def width_of(radius: Radius, level: mi.UInt32) -> mi.Float:
    """Width of the cells of a ``level``: at least the radius of nearby camera vertices and of its photons."""
    return radius.low * (1 + 2 * radius.steepest) * mi.Float(mi.UInt32(2) << level)


def bucket_of(cell: mi.Point3i, level: mi.UInt32, tag: mi.UInt32) -> mi.UInt32:
    """The bucket of a ``cell`` in the hash table, for photons of the kind of ``tag``.

    Low bits: level and coordinates modulo 4, different in all cells of one search (3 levels, 3 per axis).
    """
    word, low = tag >> EDGES_BITS, level & 3
    for axis, prime in enumerate(_PRIMES):
        index = mi.UInt32(cell[axis])
        word, low = word ^ ((index >> 2) * prime), (low << 2) | (index & 3)
    return ((sobol.mix(word) << 8) | low) & ((1 << BUCKET_BITS) - 1)


@dataclass
class Sample:
    """A photon drawn for a camera vertex.

    ``f``: BSDF or phase function (an `Evaluation`) towards it; ``value``: estimate of all merges of the
    vertex, without weight; ``number``: estimate of the number of photons near it.
    """

    photon: Photon
    f: Any
    value: mi.Spectrum
    active: mi.Bool
    number: mi.Float


def sample(kernel: TraceContext, merging: Merging, z: Vertex, stream: Stream, wavelength_set=None) -> Sample:
    """Draw a photon near the camera vertex ``z`` in proportion to its flux.

    `Sample.value` estimates the merges with all photons of the ``wavelength_set``, see `inputs.Shared`.
    """
    word = kernel.points.series(stream, Purpose.CONNECTION, z.event, mi.UInt32(1))
    chosen, total = _draw(merging, z, kernel.last_merged - z.edges, word, wavelength_set)
    active = z.hit & (total > 0)
    photon = merging.photons.found.at(chosen, active)
    f = scattering.evaluate(kernel, z, z.si.to_local(photon.d), active)
    eta = merging.eta(z)
    # The value of a BSDF contains |cos|, as the flux through a disc does; both are 1 in a volume.
    estimate = (photon.flux / size_of(photon.flux)) * (total / (eta * z.cosine(photon.d)))
    value = z.throughput * f.value * estimate
    return Sample(photon, f, value, active & ~spectra.is_zero(value), total / size_of(photon.flux))


@dr.syntax
def _draw(merging: Merging, z: Vertex, most: mi.UInt32, word: mi.UInt32, wavelength_set):
    """Draw a photon of up to ``most`` edges in the disc or ball at ``z`` by flux; its index, total flux."""
    photons, tested, chosen, total = merging.photons, merging.tested, mi.UInt32(0), mi.Float(0)
    r, radius = merging.around(z.si.p, z.volume, z.medium)
    level = level_of(radius, r * (1 - 1.01 * radius.steepest))
    last = level_of(radius, r * (1 + 1.01 * radius.steepest))
    medium = None if merging.balls is None else dr.select(z.volume, z.medium, 0)
    tag = tag_of(most, wavelength_set, medium)
    offset = sequential(~word)[0]
    while dr.hint(
        level <= last, label="grids of photons", exclude=[z, photons, tested, r, radius, tag, last, offset]
    ):
        first, cells = _overlapped(z, r, width_of(radius, level))
        place, end, step = mi.UInt32(0), mi.UInt32(0), mi.UInt32(1)
        while dr.hint(
            (cells != 0) | (place < end),
            label="photons near a camera vertex",
            exclude=[z, photons, tested, r, radius, tag, last, offset, level, first],
        ):
            through = place >= end  # the next cell
            bucket = bucket_of(_neighbour(first, dr.tzcnt(cells)), level, tag)
            start = dr.gather(mi.UInt32, photons.starts, bucket, through)
            end = dr.select(through, dr.gather(mi.UInt32, photons.starts, bucket + 1, through), end)
            cells = dr.select(through, cells & (cells - 1), cells)
            # Of many photons one in ``step``, from a random one on.
            many = dr.maximum(dr.ceil(mi.Float(end - start) / tested), 1)
            step = dr.select(through, mi.UInt32(many), step)
            place = dr.select(through, start + mi.UInt32(offset * mi.Float(step)), place)

            tried = place < end
            size = _flux_near(photons, place, z, r, tag, tried) * mi.Float(step)
            u, after = sequential(word)
            total, take, _ = offer(total, size, u)
            take &= tried
            word = dr.select(tried, after, word)
            chosen = dr.select(take, place, chosen)
            place += dr.select(tried, step, 0)
        level += 1
    return chosen, total


def _overlapped(z: Vertex, r: mi.Float, width: mi.Float) -> tuple[mi.Point3i, mi.UInt32]:
    """Cells that the disc or ball of radius ``r`` at ``z`` overlaps: the lowest of 27, and a bit for each."""
    p, n = z.si.p, z.si.n  # in volumes 0
    first = mi.Point3i(dr.floor((p - r) / width))
    lows = [mi.Vector3f(first + i) * width - p for i in range(3)]
    squares = [dr.square(dr.maximum(dr.maximum(low, -low - width), 0)) for low in lows]
    heights = [n * (low + width / 2) for low in lows]
    most = _FLAT * r + 2 * z.anchor.offset + width / 2 * dr.sum(dr.abs(n))
    cells = mi.UInt32(0)
    for number in range(27):
        x, y, k = number % 3, number // 3 % 3, number // 9
        within = squares[x].x + squares[y].y + squares[k].z <= dr.square(r)
        within &= dr.abs(heights[x].x + heights[y].y + heights[k].z) <= most
        cells |= dr.select(within, mi.UInt32(1 << number), 0)
    return first, cells


def _neighbour(first: mi.Point3i, number: mi.UInt32) -> mi.Point3i:
    """The cell of a bit of `_overlapped`."""
    return first + mi.Point3i(mi.Int32(number % 3), mi.Int32(number // 3 % 3), mi.Int32(number // 9))


def _flux_near(photons: Photons, index: mi.UInt32, z: Vertex, r, tag: mi.UInt32, active) -> mi.Float:
    """Flux of the photon ``index`` if it is merged at ``z``, else 0."""
    first = dr.gather(mi.Vector4f, photons.searched, 2 * index, active)
    second = dr.gather(mi.Vector4f, photons.searched, 2 * index + 1, active)
    own = dr.reinterpret_array(mi.UInt32, second.w)
    # Of the same kind, with few enough edges.
    near = active & ((own >> EDGES_BITS) == (tag >> EDGES_BITS)) & (own <= tag)
    near &= _is_near(mi.Point3f(first.xyz), mi.Normal3f(second.xyz), z, r)
    return dr.select(near, mi.Float(first.w), 0)


def _is_near(p: mi.Point3f, n: mi.Normal3f, z: Vertex, r: mi.Float) -> mi.Bool:
    """Mask: a photon at ``p``, with normal ``n``, lies in the disc or ball at ``z``."""
    off = p - z.si.p
    height = dr.abs(dr.dot(off, z.si.n))  # in volumes normals are 0
    # Each position may lie off its surface by the rounding error of its hit.
    beyond_rounding = dr.maximum(height - 2 * z.anchor.offset, 0)
    within = dr.squared_norm(off) - dr.square(height) + dr.square(beyond_rounding) < dr.square(r)
    return within & (beyond_rounding < _FLAT * r) & (z.volume | (dr.dot(n, z.si.n) > _SAME_SURFACE))
