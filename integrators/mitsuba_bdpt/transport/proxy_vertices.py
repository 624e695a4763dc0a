"""Proxy vertices: approximate the size of an inner connection without its BSDFs.

A lane that stores the vertices of several light subpaths draws one of them for each camera vertex
(`connections`) by an approximation of the weighted contribution (eqs. 37, 40, 41),

    f_z f_y cos_z cos_y / d^2 / (kappa + others_y p_z cos_y / d^2 + others_z p_y cos_z / d^2),

with diffuse BSDFs as bright as the true one towards the normal, and for glossy BSDFs a lobe about the mirror
direction, as wide as its density there implies (GGX: B. Walter et al. 2007, eq. 33).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from . import scattering, spectra
from .alternatives import newest_coefficient

# Factor of an approximation on a side to which the BSDF does not scatter: shading normals and bumps may.
WRONG_SIDE = 0.0002

_LEAST_COS = 0.01  # least cosine by which densities over area are divided

# Least brightness of a light vertex, among which black ones are drawn by their other factors.
_LEAST_SIZE = 1e-30

# Bounds of the squared width of a lobe, and the least density and cosine that it is fitted to.
_NARROW, _LEAST_PDF, _LEAST_Z = 1e-5, 1e-3, 1e-3


@dataclass
class Lobe:
    """The lobe of a glossy BSDF in a proxy, and the density of its diffuse part over cos / pi.

    ``wi``: incident direction, ``shading``: shading normal, both in world space; ``peak`` brightness, density
    and ``others`` (see `Diffuse`) at the peak; ``width2``: squared roughness, above 1 without a lobe.
    """

    wi: mi.Vector3f
    shading: mi.Vector3f
    diffuse_pdf: mi.Float
    peak: mi.Float
    pdf: mi.Float
    width2: mi.Float
    others: mi.Float

    def added(self, d, cos, size, pdf_w, others) -> tuple:
        """The results of `ProxyVertex.towards` with the lobe, from those of the diffuse part."""
        half = self.wi + d
        cos2 = dr.square(dr.dot(self.shading, half)) / dr.maximum(dr.squared_norm(half), 1e-12)
        shape = _shape(cos2, self.width2)
        return (
            size + self.peak * shape,
            pdf_w * self.diffuse_pdf + self.pdf * shape,
            others + self.others * shape / dr.maximum(cos, _LEAST_COS),
        )


@dataclass
class Diffuse:
    """The diffuse part of a BSDF in a proxy. No field is a Bool: in local memory LLVM fails.

    ``n``: geometric normal on the incident side; ``size``: brightness over cos / pi; ``behind``: its factor
    on the other side; ``others``: partial sums of the other strategies over the density from the other side.
    """

    n: mi.Vector3f
    size: mi.Float
    behind: mi.Float
    others: mi.Float


@dataclass
class ProxyVertex:
    """Proxy of a vertex at ``p``; ``lobe``: None in scenes without glossy BSDFs."""

    p: mi.Point3f
    diffuse: Diffuse
    lobe: Lobe | None = None

    @staticmethod
    def of(kernel, vertex, active: mi.Bool, adjoint: bool) -> ProxyVertex:
        """The proxy of ``vertex``; that of a camera vertex, common to all candidates, has no brightness."""
        si, partial, flags = vertex.si, vertex.partial, vertex.bsdf.flags()
        wi, n, size = si.to_world(si.wi), mi.Vector3f(si.n), mi.Float(1)
        density, diffuse_pdf, lobe = partial.d_vc * vertex.cos, mi.Float(1), None
        if adjoint:
            up = mi.Vector3f(0, 0, dr.sign(si.wi.z))
            f = scattering.evaluate(kernel, vertex, up, active, reverse=False)
            size = _brightness(vertex, f.value) * dr.pi
        if kernel.traits.glossy:
            size, diffuse_pdf, peak, pdf, width2 = dr.if_stmt(
                (size,),
                active & mi.has_flag(flags, mi.BSDFFlags.Glossy),
                lambda size: _fitted(kernel, vertex, active),
                lambda size: (size, mi.Float(1), mi.Float(0), mi.Float(0), mi.Float(2)),
            )
            lobe = Lobe(wi, mi.Vector3f(si.sh_frame.n), diffuse_pdf, peak, pdf, width2, density * pdf)
        size = dr.maximum(size, _LEAST_SIZE if adjoint else 0)
        behind = dr.select(mi.has_flag(flags, mi.BSDFFlags.Transmission), 1, mi.Float(WRONG_SIDE))
        newest = newest_coefficient(kernel, vertex, adjoint)
        others = partial.d_vcm * newest + density * (diffuse_pdf * dr.inv_pi)
        diffuse = Diffuse(dr.mulsign(n, dr.dot(n, wi)), size, behind, others)
        return ProxyVertex(mi.Point3f(si.p), diffuse, lobe)

    def towards(self, d: mi.Vector3f) -> tuple:
        """For direction ``d``: brightness times cosine, density, ``others``, and cosine."""
        signed = dr.dot(self.diffuse.n, d)
        cos = dr.abs(signed)
        part = cos * dr.inv_pi
        found = part * self.diffuse.size, part, self.diffuse.others
        if (lobe := self.lobe) is not None:
            found = dr.if_stmt(found, lobe.width2 <= 1, partial(lobe.added, d, cos), lambda *diffuse: diffuse)
        bright, pdf_w, others = found
        bright *= dr.select(signed > 0, 1, self.diffuse.behind)
        return bright, pdf_w, others, mi.Float(cos)


def guess(kernel, z: ProxyVertex, y: ProxyVertex) -> mi.Float:
    """Approximate size of the connection of ``z`` and ``y``, up to a factor of ``z``."""
    between = y.p - z.p
    dist2 = dr.squared_norm(between)
    inverse = dr.rcp(dist2)
    d = between * dr.sqrt(inverse)
    size_z, pdf_z, others_z, cos_z = z.towards(d)
    size_y, pdf_y, others_y, cos_y = y.towards(-d)
    others = others_y * (pdf_z * cos_y) + others_z * (pdf_y * cos_z)
    size = size_z * size_y * inverse / (kernel.kappa.inner + others * inverse)
    return dr.select((dist2 > 0) & dr.isfinite(size), size, 0)


def _shape(cos2: mi.Float, width2: mi.Float) -> mi.Float:
    """Microfacet distribution over its peak; ``cos2`` of half vector and normal."""
    return dr.square(width2 / (cos2 * (width2 - 1) + 1))


def _fitted(kernel, vertex, active: mi.Bool) -> tuple:
    """Fit a diffuse part and a lobe to evaluations towards the normal and in the mirror direction.

    Returns ``size`` and ``diffuse_pdf``, and of the lobe ``peak``, ``pdf`` and ``width2``.
    """
    evaluate = partial(scattering.evaluate, kernel, vertex, reverse=False)
    wi = vertex.si.wi
    up = mi.Vector3f(0, 0, dr.sign(wi.z))
    f, mirror = evaluate(up, active), evaluate(mi.Vector3f(-wi.x, -wi.y, wi.z), active)
    pdf_w = dr.maximum(mirror.pdf_fwd_w, _LEAST_PDF)
    width2 = dr.clip(1 / (4 * dr.pi * pdf_w * dr.maximum(dr.abs(wi.z), _LEAST_Z)), _NARROW, 1)
    shape = _shape(dr.square(1 + dr.abs(wi.z)) / dr.squared_norm(wi + up), width2)
    towards_normal, towards_mirror = (mi.unpolarized_spectrum(e.value) for e in (f, mirror))
    return (
        _brightness(vertex, dr.maximum(towards_normal - towards_mirror * shape, 0)) * dr.pi,
        dr.maximum(f.pdf_fwd_w - mirror.pdf_fwd_w * shape, 0) * dr.pi,
        _brightness(vertex, mirror.value),
        mi.Float(mirror.pdf_fwd_w),
        width2,
    )


def _brightness(vertex, value: mi.Spectrum):
    """Size of unpolarized light that reaches ``vertex`` and is scattered with the BSDF ``value``."""
    return spectra.brightest(mi.unpolarized_spectrum(vertex.throughput) * mi.unpolarized_spectrum(value))
