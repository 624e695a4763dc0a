"""Merging the vertices of isolated paths: photons near a camera vertex stand for paths through it.

Source: Georgiev 2012, see `mis`; of its vertex merging what no connection can do. An edge is *joined* if a
strategy in use makes paths by connecting its ends: neither is a delta event, and their class has a
coefficient (the edge to a point of an emitter by next-event estimation, to the sensor by t = 1, others by
inner connections). A path is *isolated* if no edge of it is joined: lamp, glass, wall, glass, camera. Only
s = 0 and t = 0 make those, and merging: the light side and the camera side of the path are traced, each up to
the same vertex, whose event is not delta, and a photon that is near enough counts as if it were there.

With n photons' subpaths, discs of radius r(x) about camera vertices, area measure, p-> from the light's side
and p<- from the camera's::

    n p_m = eta prod_{i<=m} p->_i prod_{m<=i<k} p<-_i,    eta = n pi r(x_m)^2

and kappa n p_m in the weights.

The estimate is consistent, not unbiased: what lies within r is taken for what lies at the vertex.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...sampling import sobol
from ...sampling.points import Purpose, Stream, sequential
from .. import bsdf, mis, spectra
from ..contribution import Contribution, size_of
from ..inputs import Kernel
from ..walk import Vertex, Walk, may_merge
from .aim import Aim
from .columns import Columns
from .merge_radius import Radius
from .wavelength_sets import SET_BITS, WavelengthSets

# Bits of a bucket's number in the hash table, and of each coordinate of a cell.
BUCKET_BITS = 18
_CELL_BITS = 20

# Cosine between geometric normals, and distance from the tangent plane over the radius, up to which a photon
# is taken to lie on the surface of the camera vertex.
_SAME_SIDE, _FLAT = 0.8, 0.25


@dataclass
class Merging:
    """What a pass knows of merging.

    ``radius``, ``count`` of photons' subpaths that a camera subpath can meet, `Photons` (None while they are
    traced), and ``kappa``, with which merges enter all weights: all camera vertices in one disc meet the same
    photons, so that many merges are worth as much as one, see `coefficient`. Numbers are opaque ``Float``.
    ``aim`` of the photons, an `Aim`; in spectral variants ``wavelengths``, a `WavelengthSets`: subpaths meet
    those of the same set.
    """

    radius: Radius
    count: mi.Float
    kappa: mi.Float
    aim: Aim
    photons: Any = None
    wavelengths: WavelengthSets | None = None

    def eta(self, p: mi.Point3f) -> mi.Float:
        """Number of subpaths times the area of the disc at ``p`` (scene units squared)."""
        return self.count * dr.pi * dr.square(self.radius.at(p))

    def weighed(self, p: mi.Point3f) -> mi.Float:
        """`eta` with its coefficient, as it enters weights."""
        return self.kappa * self.eta(p)


def coefficient(samples: float, radius: float) -> float:
    """kappa of merges in discs of this ``radius`` in pixels, if so many ``samples`` per pixel share photons.

    One over the number of camera vertices that share the photons of a disc. Without it merges under a sky,
    where s = 0 is good, took nearly all of the weight: 183 times the variance at 256 samples per pixel.
    """
    return min(1.0, 1 / (samples * math.pi * radius**2))


@dataclass
class Photon(Columns):
    """A light vertex that may be merged.

    ``p`` position, ``d`` unit direction towards the light's side, ``n`` geometric normal, ``flux`` the
    throughput (over the number of subpaths it is the light's), ``older`` the partial sums of all alternatives
    of fewer light vertices, in the area measure; ``aim`` the emitter's own density of the first direction
    over that of `Aim`; ``edges`` up to it; ``lane`` of its subpath.
    """

    p: mi.Point3f
    d: mi.Vector3f
    n: mi.Normal3f
    flux: mi.Spectrum
    older: mi.Float
    aim: mi.Float
    edges: mi.UInt32
    lane: mi.UInt32

    @staticmethod
    def types():
        return mi.Point3f, mi.Vector3f, mi.Normal3f, mi.Spectrum, mi.Float, mi.Float, mi.UInt32, mi.UInt32


@dataclass
class Photons:
    """The photons of a pass, ``found`` (a `Photon` of arrays), one after the other by the buckets of cells.

    ``cell`` of each, see `cell_at`; ``starts``: the first photon of each bucket, and the end of the last.
    """

    found: Photon
    cell: mi.UInt64
    starts: mi.UInt32


def level_of(radius: Radius, r: mi.Float) -> mi.UInt32:
    """Which of the grids, whose cells double in size, is that of photons with the radius ``r``."""
    return mi.UInt32(dr.maximum(dr.floor(dr.log2(r / radius.low)), 0))


def cell_at(radius: Radius, p: mi.Point3f, level: mi.UInt32, wavelength_set=None, corner=None) -> mi.UInt64:
    """The number of the cell at ``p`` in the grid ``level``, of this set of wavelengths (or None).

    Cells are at least as wide as the discs of the photons in it and of camera vertices near to them, so that
    a disc meets two at most in each direction: ``corner`` (0 to 7) chooses among those that the one at ``p``
    meets. Coordinates are taken modulo 2^20: cells of the same number lie far apart, and so do those of the
    same number that are of different sets.
    """
    width = radius.low * (1 + 2 * radius.angle) * mi.Float(mi.UInt32(4) << level)
    if corner is not None:
        p = p - radius.at(p)
    cell, number = mi.Point3i(dr.floor(p / width)), mi.UInt64(level)
    for axis in range(3):
        index = mi.UInt32(cell[axis])
        if corner is not None:
            index += (corner >> axis) & 1
        if axis == 0 and wavelength_set is not None:
            index += wavelength_set << (_CELL_BITS - SET_BITS)
        number = (number << _CELL_BITS) | mi.UInt64(index & ((1 << _CELL_BITS) - 1))
    return number


def bucket_of(cell: mi.UInt64) -> mi.UInt32:
    """The bucket of a cell in the hash table."""
    word = sobol.mix(mi.UInt32(cell) ^ sobol.mix(mi.UInt32(cell >> 32)))
    return word >> (32 - BUCKET_BITS)


def possible(kernel: Kernel, z: Vertex, walk: Walk) -> mi.Bool:
    """Mask: photons may be merged at the camera vertex ``z``; ``walk`` as it was before it arrived."""
    return may_merge(kernel, kernel.kappa.splat, walk, z) & (z.edges < kernel.max_depth)


def merge(kernel: Kernel, z: Vertex, stream: Stream, wavelength_set=None) -> Contribution:
    """The camera vertex ``z`` merged with a photon near it, drawn by its flux for all of them.

    Of those of its ``wavelength_set``, see `inputs.Shared`.
    """
    h, merging = kernel.heuristic, kernel.merging
    word = kernel.points.series(stream, Purpose.CONNECTION, z.event, mi.UInt32(1))
    chosen, total = _draw(kernel, z, word, wavelength_set)
    active = z.hit & (total > 0)
    photon = merging.photons.found.at(chosen, active)
    f = bsdf.evaluate(z.bsdf, z.si, z.si.to_local(photon.d), active, kernel.traits)
    eta = merging.eta(z.si.p)
    # Per area of the surface: what the disc receives, f |cos| being per solid angle.
    estimate = (photon.flux / size_of(photon.flux)) * (total / (eta * dr.abs(dr.dot(z.si.n, photon.d))))
    value = z.throughput * f.value * estimate
    active &= ~spectra.is_zero(value)
    light_side = h.scale(photon.older, f.pdf_fwd_w)
    # Of longer paths t = 0, the oldest alternative of the camera's side, makes none.
    older = mis.choose(kernel.within_store(photon.edges + z.edges), z.partial.d_vc, 0)
    older = h.scale(older, photon.aim)  # and not as photons are aimed
    camera_side = h.scale(h.combine(older, z.partial.d_vm), f.pdf_rev_w)
    weight, shares = h.weigh(h.start(merging.weighed(z.si.p)), light_side, camera_side)
    return Contribution(value, weight, photon.edges + 1, z.edges, active, shares, "merge")


@dr.syntax
def _draw(kernel: Kernel, z: Vertex, word: mi.UInt32, wavelength_set):
    """Draw one of the photons in the disc at ``z`` in proportion to its flux: its place, and their total."""
    radius, photons = kernel.merging.radius, kernel.merging.photons
    r = radius.at(z.si.p)
    lowest = level_of(radius, r * (1 - 1.01 * radius.angle))
    corners = (level_of(radius, r * (1 + 1.01 * radius.angle)) - lowest + 1) * 8
    corner, place, end = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
    cell, chosen, total = mi.UInt64(0), mi.UInt32(0), mi.Float(0)
    most = kernel.max_depth - z.edges
    while dr.hint(
        (corner < corners) | (place < end),
        label="photons near a camera vertex",
        exclude=[kernel, z, wavelength_set, radius, photons, r, lowest, corners, most],
    ):
        through = place >= end  # the next cell
        there = cell_at(radius, z.si.p, lowest + (corner >> 3), wavelength_set, corner & 7)
        bucket = bucket_of(there)
        place = dr.select(through, dr.gather(mi.UInt32, photons.starts, bucket, through), place)
        end = dr.select(through, dr.gather(mi.UInt32, photons.starts, bucket + 1, through), end)
        cell = dr.select(through, there, cell)
        corner += dr.select(through, mi.UInt32(1), 0)

        tried = place < end
        photon = photons.found.at(place, tried)
        near = tried & (dr.gather(mi.UInt64, photons.cell, place, tried) == cell)  # others share its bucket
        near &= _is_near(photon, z, r) & (photon.edges <= most)
        size = dr.select(near, size_of(photon.flux), 0)
        total += size
        u, after = sequential(word)
        take = tried & (u * total < size)
        word = dr.select(tried, after, word)
        chosen = dr.select(take, place, chosen)
        place += dr.select(tried, mi.UInt32(1), 0)
    return chosen, total


def _is_near(photon: Photon, z: Vertex, r: mi.Float) -> mi.Bool:
    """Mask: the ``photon`` counts as if it were at ``z``."""
    off = photon.p - z.si.p
    within = dr.squared_norm(off) < dr.square(r)
    flat = dr.abs(dr.dot(off, z.si.n)) < _FLAT * r
    return within & flat & (dr.dot(photon.n, z.si.n) > _SAME_SIDE)
