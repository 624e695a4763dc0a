"""Predicts the gain of photon-guided BSDF sampling from photons.

A pilot's samples rarely hit an emitter behind glass, and each hit is a firefly. So the light that arrives at
a camera vertex z where s = 0 can be guided (see `guided_hits`) is estimated from the photons in a disc of
radius R about it, as in `merging`. With the throughput T of z, a photon's flux Phi, N photon subpaths and the
estimate f / p_0 of s = 0 of the path through the photon::

    second moment of s = 0          sum over photons of  T f / |n.d| Phi / (N pi R^2) * f / p_0
    the same with n guided samples  ... / (1 + n p_g / p_bsdf)

With near-specular events S, the sum of kappa p of all strategies, takes the place of p_0 in the former, and
that of s = 0 and s = 1 in the latter, since guiding leaves out the others (`sds`).

The photons of the guide are independent of those of the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...sampling.points import Points, Purpose, Stream, sequential
from ...sampling.reservoir import offer
from .. import bsdf, subpaths
from ..alternatives import is_sds_vertex, newest_connection
from ..batch import Batch, Places
from ..contribution import size_of
from ..inputs import Kernel, Observer
from ..plan import GUIDED
from ..sds import is_specular
from ..walk import Vertex, Walk, random_walk
from . import photon_guide
from .photon import same_surface
from .photon_guide import WINDOW, Guide


@dataclass
class Estimator:
    """``photons`` of ``count`` subpaths, and the ``guide`` whose benefit is estimated.

    ``most``: estimates of a path beyond ``most`` times the arriving light are dropped.
    """

    photons: Guide
    guide: Guide
    count: mi.Float
    most: mi.Float


@dataclass
class Found:
    """SDS light at a vertex, mean over the colours; ``vertices``: 1 if s = 0 can be guided.

    ``arriving``: its mean; ``unguided``, ``guided``: second moments.
    """

    arriving: mi.Float64
    unguided: mi.Float64
    guided: mi.Float64
    vertices: mi.UInt32


def nothing() -> Found:
    """`Found` of a vertex where s = 0 cannot be guided."""
    return Found(mi.Float64(0), mi.Float64(0), mi.Float64(0), mi.UInt32(0))


def trace(kernel: Kernel, estimator: Estimator, batch: Batch, points: Points, add):
    """Evaluate the ``estimator`` at the SDS vertices of a pilot's camera subpaths.

    ``add(lane, position, found)`` accumulates the sum of a lane's `Found`.
    """
    kernel = kernel.bound(points, 1.0, Observer())
    index = dr.arange(mi.UInt32, batch.size)
    place = Places(kernel, batch, batch.samples)
    in_sequence = place.index(index)
    shared = subpaths.shared_by_lane(kernel, points.stream("light", in_sequence), in_sequence)
    sample = subpaths.camera_sample(kernel, place, shared, index, mi.Bool(True))
    walk = subpaths.camera_walk(kernel, sample, mi.Bool(True) & (kernel.max_depth >= 1))
    side = replace(subpaths.camera_side(kernel, sample, shared, walk), connect=None, isolated=True, sds=None)

    def visit(z, total, walk):
        found = estimate(kernel, estimator, z, walk, sample.stream)
        return Found(
            total.arriving + found.arriving,
            total.unguided + found.unguided,
            total.guided + found.guided,
            total.vertices + found.vertices,
        )

    found, walk = random_walk(kernel, side, walk, visit, nothing())
    add(index, sample.start.position, found)


def estimate(kernel: Kernel, estimator: Estimator, z: Vertex, walk: Walk, stream: Stream) -> Found:
    """Estimate the moments at the camera vertex ``z``; ``walk`` as before its arrival."""
    possible = is_sds_vertex(kernel, kernel.kappa.splat, walk, z)

    def measure(z):
        place = photon_guide.find(estimator.photons, z.si.p)
        word = kernel.points.series(stream, Purpose.CONNECTION, z.event, mi.UInt32(1))
        chosen, total, radius = _draw(estimator.photons, z, place, word, kernel.max_depth - z.edges)
        active = total > 0
        y = photon_guide.photon(estimator.photons, place, chosen, active)
        f = bsdf.evaluate(z.bsdf, z.si, z.si.to_local(y.d), active, kernel.traits)
        cos = dr.abs(dr.dot(z.si.n, y.d))
        value = _mean(z.throughput * f.value * y.flux) / cos
        active &= (value > 0) & (f.pdf_fwd_w > 0) & dr.isfinite(value)
        if kernel.near_specular:
            active &= ~is_specular(f) | (z.sds.only_delta & y.only_delta)
        # All photons in the disc, represented by the drawn one. Double precision: radiance is squared.
        arriving = mi.Float64(value / size_of(y.flux) * total / (estimator.count * dr.pi * dr.square(radius)))
        found = [
            dr.select(each <= estimator.most * arriving, each, 0)
            for each in (mi.Float64(value / s) for s in _sums(kernel, z, y, f))
        ]
        there = photon_guide.find(estimator.guide, z.si.p)
        pdf = photon_guide.density(estimator.guide, z.si.p, there, y.d)
        ratio = dr.select(active, pdf / f.pdf_fwd_w, 0)
        found = [dr.select(active, arriving * each, 0) for each in found]
        arriving = dr.select(active, arriving, 0)
        goes_on = mi.UInt32(1)
        if kernel.near_specular:  # guided samples of other directions end at once
            goes_on = dr.select((total > 0) & ~active, mi.UInt32(0), 1)
        return Found(arriving, found[0], found[1] / (1 + GUIDED * ratio), goes_on)

    return dr.if_stmt((z,), possible, measure, lambda z: nothing(), label="SDS light")


def _sums(kernel: Kernel, z: Vertex, y, f) -> tuple[mi.Float, mi.Float]:
    """Sums of kappa p of the strategies without and with guiding, guided ones excluded, over the photons'.

    ``f``: the BSDF of the camera vertex ``z`` towards the photon ``y``.
    """
    if not kernel.near_specular:
        by_hit = y.older * f.pdf_fwd_w
        return by_hit, by_hit
    every = y.connection + y.older * f.pdf_fwd_w
    every += newest_connection(kernel, kernel.kappa.splat, z) + z.partial.d_vc * f.pdf_rev_w
    # Weights do not know of the aim.
    return every * y.aim, y.unconnected * f.pdf_fwd_w * y.aim


def _mean(colours: mi.Spectrum) -> mi.Float:
    found = mi.unpolarized_spectrum(colours)
    return mi.Float(sum(found) / len(found))


@dr.syntax
def _draw(photons: Guide, z: Vertex, place: mi.UInt32, word: mi.UInt32, most: mi.UInt32):
    """Draw a photon near ``z`` with at most ``most`` edges, in proportion to its flux.

    Returns its index in the window, the total flux, and R: the geometric mean of the window's distances.
    """
    k, logs = mi.UInt32(0), mi.Float(0)
    while dr.hint(k < len(WINDOW), label="distances of a window", exclude=[photons, z, place]):
        y = photon_guide.photon(photons, place, k)
        logs += dr.log(dr.maximum(dr.norm(y.p - z.si.p), 1e-30))
        k += 1
    radius = dr.exp(logs / len(WINDOW))

    k = mi.UInt32(0)
    chosen, total = mi.UInt32(0), mi.Float(0)
    while dr.hint(k < len(WINDOW), label="photons of a disc", exclude=[photons, z, place, radius, most]):
        y = photon_guide.photon(photons, place, k)
        near = (dr.norm(y.p - z.si.p) <= radius) & same_surface(y.n, z.si.n)
        near &= photon_guide.exists(photons, place, k) & (y.edges <= most)
        size = dr.select(near, size_of(y.flux) * dr.gather(mi.Float, photons.stands_for, k), 0)
        u, word = sequential(word)
        total, take, _ = offer(total, size, u)
        chosen = dr.select(take, k, chosen)
        k += 1
    return chosen, total, radius
