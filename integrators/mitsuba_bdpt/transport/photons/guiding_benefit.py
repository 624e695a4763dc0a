"""What s = 0 costs on paths where it might be guided: second moments of its estimates, by photons.

Few samples of a pilot meet a lamp behind glass by chance, and one that does is a firefly. Photons tell of
each vertex z where s = 0 can be guided (see `guided_hits`) what light arrives there: those near it, in a disc
of radius R, stand for an integral over directions, as in `merging`. With the throughput T of z, a photon's
flux Phi, N photons' subpaths and f / p_0 the estimate of s = 0 of the path through it::

    second moment of s = 0          sum over photons of  T f / |n.d| Phi / (N pi R^2) * f / p_0
    the same with n guided samples  ... / (1 + n p_g / p_bsdf)

The photons of the guide are others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...sampling.points import Points, Purpose, Stream, sequential
from .. import bsdf, subpaths
from ..batch import Batch, Places
from ..contribution import size_of
from ..inputs import Kernel
from ..observer import Observer
from ..plan import GUIDED
from ..walk import Vertex, Walk, may_merge, random_walk
from . import photon_guide
from .photon_guide import WINDOW, Guide

# How many moments a vertex has, see `Found`.
MOMENTS = 2 + len(GUIDED)

# Cosine between normals from which on a photon is taken to lie on the surface of the vertex.
_SAME_SIDE = 0.8


@dataclass
class Gauge:
    """Photons to measure with, those of the ``guide``, and how many subpaths made the former (``count``).

    ``most``: estimates of s = 0 that are larger than so many times what arrives do not count.
    """

    photons: Guide
    guide: Guide
    count: mi.Float
    most: mi.Float


@dataclass
class Found:
    """Moments (of the mean of the colours) at a vertex, and 1 where s = 0 may be guided (``aimed``).

    ``moments``: the first, and the second if s = 0 is not guided and with each number of samples (`GUIDED`).
    """

    moments: list[mi.Float64]
    aimed: mi.UInt32


def nothing() -> Found:
    """Of a vertex where s = 0 cannot be guided."""
    return Found([mi.Float64(0) for _ in range(MOMENTS)], mi.UInt32(0))


def trace(kernel: Kernel, gauge: Gauge, batch: Batch, points: Points, add):
    """Follow a pilot's camera subpaths along SDS paths, and evaluate the ``gauge`` at their vertices.

    ``add(lane, position, found)`` gets what each lane found, see `Found`.
    """
    kernel = kernel.bound(points, 1.0, Observer())
    index = dr.arange(mi.UInt32, batch.size)
    place = Places(kernel, batch, batch.samples)
    in_sequence = place.index(index)
    shared = subpaths.shared_by_lane(kernel, points.stream("light", in_sequence, index), in_sequence)
    sample = subpaths.camera_sample(kernel, place, shared, index, mi.Bool(True))
    walk = subpaths.camera_walk(kernel, sample, mi.Bool(True) & (kernel.max_depth >= 1))
    side = replace(subpaths.camera_side(kernel, sample, shared, walk), join=None, isolated=True)

    def visit(z, state, walk):
        found = look(kernel, gauge, z, walk, sample.stream)
        moments = [a + b for a, b in zip(state.moments, found.moments, strict=True)]
        return Found(moments, state.aimed + found.aimed)

    found, walk = random_walk(kernel, side, walk, sample.stream, visit, nothing())
    add(index, sample.start.position, found)


def look(kernel: Kernel, gauge: Gauge, z: Vertex, walk: Walk, stream: Stream) -> Found:
    """What the ``gauge`` says of the camera vertex ``z``; ``walk`` as it was before it arrived."""
    possible = may_merge(kernel, kernel.kappa.splat, walk, z) & (z.edges < kernel.max_depth)

    def measure(z):
        place = photon_guide.find(gauge.photons, z.si.p)
        word = kernel.points.series(stream, Purpose.CONNECTION, z.event, mi.UInt32(1))
        chosen, total, radius = _draw(gauge.photons, z, place, word, kernel.max_depth - z.edges)
        active = total > 0
        y = photon_guide.photon(gauge.photons, place, chosen, active)
        f = bsdf.evaluate(z.bsdf, z.si, z.si.to_local(y.d), active, kernel.traits)
        cos = dr.abs(dr.dot(z.si.n, y.d))
        value = _mean(z.throughput * f.value * y.flux) / cos
        active &= (value > 0) & (f.pdf_fwd_w > 0) & dr.isfinite(value)
        # Of all photons in the disc, for which this one stands.
        # Squares, in any unit of radiance, are too large or too small for single precision.
        arriving = mi.Float64(value / size_of(y.flux) * total / (gauge.count * dr.pi * dr.square(radius)))
        by_hit = mi.Float64(value / (y.hit * f.pdf_fwd_w))
        by_hit = dr.select(by_hit <= gauge.most * arriving, by_hit, 0)
        there = photon_guide.find(gauge.guide, z.si.p)
        pdf = photon_guide.density(gauge.guide, z.si.p, there, y.d)
        ratio = dr.select(active, pdf / f.pdf_fwd_w, 0)
        alone = dr.select(active, arriving * by_hit, 0)
        first = dr.select(active, arriving, 0)
        return Found([first, *(alone / (1 + n * ratio) for n in (0, *GUIDED))], mi.UInt32(1))

    return dr.if_stmt((z,), possible, measure, lambda z: nothing(), label="isolated light")


def _mean(colours: mi.Spectrum) -> mi.Float:
    found = mi.unpolarized_spectrum(colours)
    return mi.Float(sum(found) / len(found))


@dr.syntax
def _draw(photons: Guide, z: Vertex, place: mi.UInt32, word: mi.UInt32, most: mi.UInt32):
    """One of the photons near ``z``, of ``most`` edges, in proportion to its flux, and those it stands for.

    Its number in the window, their total, and R: the geometric mean of the window's distances.
    """
    k, logs = mi.UInt32(0), mi.Float(0)
    while dr.hint(k < len(WINDOW), label="distances of a window", exclude=[photons, z, place]):
        y = photon_guide.photon(photons, place, k, True)
        logs += dr.log(dr.maximum(dr.norm(y.p - z.si.p), 1e-30))
        k += 1
    radius = dr.exp(logs / len(WINDOW))

    k = mi.UInt32(0)
    chosen, total = mi.UInt32(0), mi.Float(0)
    while dr.hint(k < len(WINDOW), label="photons of a disc", exclude=[photons, z, place, radius, most]):
        y = photon_guide.photon(photons, place, k, True)
        near = (dr.norm(y.p - z.si.p) <= radius) & (dr.dot(y.n, z.si.n) > _SAME_SIDE)
        near &= photon_guide.exists(photons, place, k) & (y.edges <= most)
        size = dr.select(near, size_of(y.flux) * dr.gather(mi.Float, photons.stands_for, k), 0)
        total += size
        u, word = sequential(word)
        chosen = dr.select(u * total < size, k, chosen)
        k += 1
    return chosen, total, radius
