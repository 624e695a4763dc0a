"""Emitters at infinity: environments and directional emitters."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import rays
from ..geometry.to_world import check_rotation
from ..host.introspection import own_parameters
from .disks import AIMED, Disks
from .group import Context, Group, emitting_point, weight_over
from .records import Chosen, Direct, Emission, Factor, Place
from .tables import Mask, cell_at, rows

SKY_BINS = 4  # bins per dimension of an environment's directions, each with a square of points on a disk
_QUICKLY_READ = 1 << 20  # largest environment map (values) whose contrast is computed


class InfiniteEmitters(Group):
    """Environments and directional emitters.

    Emission: the direction as in Mitsuba's next-event estimation (solid angle; fixed for a directional
    emitter), then a point on `Disks` across it (area). Both densities of the direction are thus equal,
    whatever the lit vertex. ``disks``: where light subpaths start.
    """

    at_infinity = True

    @classmethod
    def of(cls, emitter) -> type[Group]:
        if not _is_directional(emitter) and "to_world" in own_parameters(emitter):
            check_rotation(emitter)
        return cls

    @classmethod
    def is_hittable(cls, emitter) -> bool:
        return not _is_directional(emitter)

    @classmethod
    def tables(cls, emitter) -> int:
        return 1 if _is_directional(emitter) else SKY_BINS**2

    def __init__(self, emitters, context: Context):
        self.disks = Disks(context.scene, context.facts.about)
        self._directional = Mask(rows(emitters, None, _is_directional))

    def _bin(self, index, d, active):
        """Index of the emitter's table for light along ``d``."""
        directional = self._directional.at(index, active)
        return dr.select(directional, 0, cell_at(mi.warp.uniform_sphere_to_square(d), SKY_BINS))

    def place(self, index, p, d, active) -> Place:
        return Place(self._bin(index, d, active), self.disks.place(p, d))

    def factor(self, index, p, d, cos, side, active) -> Factor:
        return self.disks.factor(p, d, self.disks.share(side))

    def _share(self, guide, index, active):
        """Share of subpaths aimed at details, for emitters with and without a table."""
        return dr.select(guide.is_guided(index, active), self.disks.share(guide.side), AIMED)

    def _point_pdf_a(self, index, p, d, active, sign=1):
        """Density (area across ``d``) of a subpath along ``d * sign`` passing ``p``."""
        if self.guide is None:
            return self.disks.pdf_a(p, d)
        density = self.guide.density(index, self.place(index, p, d * sign, active), active)
        return self.disks.pdf_a(p, d, density, self._share(self.guide, index, active))

    def _sample_point(self, index, d, u, active):
        """Sample the start of a subpath along ``d``, and its density (area across ``d``)."""
        guide = self.guide
        if guide is None:
            return self.disks.start(d, u)

        def warp(u):
            return guide.warp(index, self._bin(index, d, active), u, active)

        def density_at(p):
            return guide.density(index, self.place(index, p, d, active), active)

        return self.disks.start(d, u, self._share(guide, index, active), warp, density_at)

    def sample_emission(self, chosen: Chosen, u_point, u_direction, shared, active) -> Emission:
        it = dr.zeros(mi.Interaction3f)
        it.p, it.time, it.wavelengths = mi.Point3f(self.disks.scene.center), shared.time, shared.wavelengths
        ds, weight = chosen.emitter.sample_direction(it, u_direction, active)
        directional = self._directional.at(chosen.index, active)
        d = -ds.d
        p, pdf_a = self._sample_point(chosen.index, d, u_point, active)
        weight = dr.select(ds.pdf == 0, 0, weight / pdf_a)
        pdf_w = dr.select(directional, 1, ds.pdf)
        si = emitting_point(p, shared)
        si.wi = d
        anchor, infinite = rays.free_anchor(p), mi.Bool(True)
        return Emission(
            weight, d, anchor, mi.Float(1), pdf_w, pdf_a, chosen.index, si, infinite, delta=directional
        )

    def direction_density(self, chosen: Chosen, emission: Emission, p, d, active):
        return self._point_pdf_a(chosen.index, p, d, active)

    def connection_density(self, chosen: Chosen, emission: Emission, si, active):
        return mi.Float(emission.pdf_first)

    def radiance_towards(self, chosen: Chosen, emission: Emission, d, active):
        value = dr.zeros(mi.Spectrum)
        directional = self._directional.at(chosen.index, active)
        if not self._directional.all:
            si = mi.SurfaceInteraction3f(emission.si)
            si.t = mi.Float(dr.inf)
            value = chosen.emitter.eval(si, active & ~directional)
        if self._directional.any:
            # weight = E / (pdf_first pdf_second), selection included
            density = emission.pdf_first * emission.pdf_second
            value = dr.select(directional, emission.weight * density, value)
        return value

    def complete_direct(self, chosen: Chosen, ds, weight, si, u, active) -> Direct:
        directional = self._directional.at(chosen.index, active)
        return Direct(
            weight=weight_over(chosen.pmf, weight, ds.pdf),
            pdf_w=dr.select(directional, 1, ds.pdf) * chosen.pmf,
            d=ds.d,
            anchor=rays.free_anchor(ds.p),
            infinite=mi.Bool(True),
            delta=directional,
            emission_ratio=self._point_pdf_a(chosen.index, si.p, ds.d, active, -1),
        )

    def hit_densities(self, chosen: Chosen, si, previous, ds, active):
        pdf_w = chosen.pmf * chosen.emitter.pdf_direction(previous, ds, active)
        return pdf_w, mi.Float(pdf_w), self._point_pdf_a(chosen.index, previous.p, ds.d, active, -1)


def _is_directional(emitter) -> bool:
    return emitter.class_name() == "DirectionalEmitter"


def contrast(emitter) -> float:
    """Ratio of an environment's largest radiance to its mean; infinite if unknown.

    Infinite for other emitters, for large maps, and where the values of an ``envmap`` are not radiances or
    not finite. 1 if it is black.
    """
    kind = emitter.class_name()
    if kind == "ConstantBackgroundEmitter":
        return 1.0
    if kind != "EnvironmentMapEmitter" or mi.is_spectral:
        return math.inf
    data = own_parameters(emitter)["data"]
    if dr.width(data) > _QUICKLY_READ:
        return math.inf
    pixels = np.array(data).max(axis=-1)
    rings = np.sin(np.pi * (np.arange(len(pixels)) + 0.5) / len(pixels))
    mean = float((pixels.mean(axis=1) @ rings) / rings.sum())
    if not pixels.any():
        return 1.0
    return float(pixels.max()) / mean if 0 < mean < math.inf else math.inf
