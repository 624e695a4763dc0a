"""Proxy vertices: approximate the size of an inner connection without its BSDFs.

A lane that stores the vertices of several light subpaths draws one of them for each camera vertex
(`connections`). Evaluating both BSDFs of every candidate would cost the gain, so candidates are weighed by an
approximation of the weighted contribution (eqs. 37, 40, 41),

    f_z f_y cos_z cos_y / d^2 / (kappa + others_y p_z cos_y / d^2 + others_z p_y cos_z / d^2),

with diffuse BSDFs as bright as the true one towards the normal, and for glossy BSDFs a lobe about the mirror
direction, as wide as its density there implies (GGX: B. Walter et al. 2007, eq. 33). The estimate divides the
drawn contribution by its probability and is unbiased for any approximation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from . import bsdf, scattering, spectra

# Factor of an approximation on a side to which the BSDF does not scatter: shading normals and bumps may.
WRONG_SIDE = 0.0002

# Least cosine by which densities over area are divided.
_LEAST_COS = 0.01

# Least magnitude of numbers whose sign is a flag.
_LEAST_SIZE = 1e-30

# Bounds of the squared width of a lobe, and the least density and cosine that it is fitted to.
_NARROW, _LEAST_PDF, _LEAST_Z = 1e-5, 1e-3, 1e-3


@dataclass
class Lobes:
    """A BSDF: brightness and density of a diffuse part, and of a lobe at its peak.

    Diffuse ones over cos / pi; ``width2``: squared roughness of the lobe.
    """

    diffuse: mi.Float
    diffuse_pdf: mi.Float
    peak: mi.Float
    peak_pdf: mi.Float
    width2: mi.Float

    @staticmethod
    def plain() -> Lobes:
        """A diffuse BSDF of unit brightness."""
        return Lobes(mi.Float(1), mi.Float(1), mi.Float(0), mi.Float(0), mi.Float(1))


@dataclass
class ProxyVertex:
    """Proxy of a vertex.

    ``p``: position; ``n``: geometric normal on the incident side; ``both``: scatters to both sides; ``wi``:
    incident direction, ``shading``: shading normal, both in world space; ``others``: partial sums of the
    other strategies over the density from the other side, of the diffuse part; ``peak_others``: of the lobe.
    """

    p: mi.Point3f
    n: mi.Vector3f
    both: mi.Bool
    glossy: mi.Bool
    lobes: Lobes
    wi: mi.Vector3f
    shading: mi.Vector3f
    others: mi.Float
    peak_others: mi.Float

    @staticmethod
    def of(kernel, vertex, coefficient, active: mi.Bool, alone: bool) -> ProxyVertex:
        """The proxy of ``vertex``; ``coefficient`` of its newest alternative's class.

        ``alone``: the brightness matters, as it is not common to all compared connections.
        """
        si, partial = vertex.si, vertex.partial
        wi, n = si.to_world(si.wi), mi.Vector3f(si.n)
        glossy = active & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Glossy)
        lobes = _lobes(kernel, vertex, glossy, active, alone)
        density = partial.d_vc * vertex.cos
        return ProxyVertex(
            p=mi.Point3f(si.p),
            n=dr.mulsign(n, dr.dot(n, wi)),
            both=mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Transmission),
            glossy=glossy,
            lobes=lobes,
            wi=wi,
            shading=mi.Vector3f(si.sh_frame.n),
            others=partial.d_vcm * coefficient + density * (lobes.diffuse_pdf * dr.inv_pi),
            peak_others=density * lobes.peak_pdf,
        )

    def towards(self, kernel, d: mi.Vector3f) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
        """For direction ``d``: brightness times cosine, density, ``others``, and cosine."""
        signed = dr.dot(self.n, d)
        cos = dr.abs(signed)
        part = cos * dr.inv_pi
        found = part * self.lobes.diffuse, part * self.lobes.diffuse_pdf, self.others
        if kernel.traits.glossy:
            found = dr.if_stmt(
                found,
                self.glossy,
                lambda *diffuse: self._with_lobe(d, cos, *diffuse),
                lambda *diffuse: diffuse,
            )
        size, pdf_w, others = found
        size *= dr.select(self.both | (signed > 0), mi.Float(1), WRONG_SIDE)
        return size, pdf_w, others, mi.Float(cos)

    def _with_lobe(self, d, cos, size, pdf_w, others):
        half = self.wi + d
        cos2 = dr.square(dr.dot(self.shading, half)) / dr.maximum(dr.squared_norm(half), 1e-12)
        shape = _shape(cos2, self.lobes.width2)
        return (
            size + self.lobes.peak * shape,
            pdf_w + self.lobes.peak_pdf * shape,
            others + self.peak_others * shape / dr.maximum(cos, _LEAST_COS),
        )


def guess(kernel, z: ProxyVertex, y: ProxyVertex) -> mi.Float:
    """Approximate size of the connection of ``z`` and ``y``, up to a factor of ``z``."""
    between = y.p - z.p
    dist2 = dr.squared_norm(between)
    inverse = dr.rcp(dist2)
    d = between * dr.sqrt(inverse)
    size_z, pdf_z, others_z, cos_z = z.towards(kernel, d)
    size_y, pdf_y, others_y, cos_y = y.towards(kernel, -d)
    others = others_y * (pdf_z * cos_y) + others_z * (pdf_y * cos_z)
    size = size_z * size_y * inverse / (kernel.kappa.inner + others * inverse)
    return dr.select((dist2 > 0) & dr.isfinite(size), size, 0)


def _shape(cos2: mi.Float, width2: mi.Float) -> mi.Float:
    """Microfacet distribution over its peak; ``cos2`` of half vector and normal."""
    return dr.square(width2 / (cos2 * (width2 - 1) + 1))


def _lobes(kernel, vertex, glossy: mi.Bool, active: mi.Bool, alone: bool) -> Lobes:
    """Fit to evaluations towards the normal and, if glossy, in the mirror direction."""
    evaluate = partial(scattering.evaluate, kernel, vertex, reverse=False)
    wi = vertex.si.wi
    up = mi.Vector3f(0, 0, dr.sign(wi.z))
    throughput = mi.unpolarized_spectrum(vertex.throughput)
    lobes = Lobes.plain()
    if alone:
        lobes.diffuse = spectra.brightest(throughput * _intensity(evaluate(up, active))) * dr.pi
    if not kernel.traits.glossy:
        return lobes

    def fit(lobes: Lobes) -> Lobes:
        f, mirror = evaluate(up, glossy), evaluate(mi.Vector3f(-wi.x, -wi.y, wi.z), glossy)
        pdf_w = dr.maximum(mirror.pdf_fwd_w, _LEAST_PDF)
        width2 = dr.clip(1 / (4 * dr.pi * pdf_w * dr.maximum(dr.abs(wi.z), _LEAST_Z)), _NARROW, 1)
        shape = _shape(dr.square(1 + dr.abs(wi.z)) / dr.squared_norm(wi + up), width2)
        diffuse = dr.maximum(_intensity(f) - _intensity(mirror) * shape, 0)
        return Lobes(
            spectra.brightest(throughput * diffuse) * dr.pi,
            dr.maximum(f.pdf_fwd_w - mirror.pdf_fwd_w * shape, 0) * dr.pi,
            spectra.brightest(throughput * _intensity(mirror)),
            mi.Float(mirror.pdf_fwd_w),
            width2,
        )

    return dr.if_stmt((lobes,), glossy, fit, lambda lobes: lobes)


def _intensity(f: bsdf.Evaluation) -> mi.UnpolarizedSpectrum:
    """Value for unpolarized light."""
    return mi.unpolarized_spectrum(f.value)


@dataclass
class ProxyVertices:
    """Proxies of a lane's light vertices in local memory, without positions.

    No field is a Bool (LLVM code generation aborts). ``normal`` with the diffuse brightness, negative if it
    scatters to both sides; ``others``, negative if glossy; in scenes with glossy BSDFs ``lobe``: peak, its
    density, squared width and ``peak_others``; ``wi`` with the diffuse density; ``shading``.
    """

    normal: dr.Local[mi.Vector4f]
    others: dr.Local[mi.Float]
    lobe: Any = None
    wi: Any = None
    shading: Any = None

    @staticmethod
    def allocate(kernel, size: int) -> ProxyVertices:
        """Local memory for ``size`` proxies."""
        made = ProxyVertices(dr.alloc_local(mi.Vector4f, size), dr.alloc_local(mi.Float, size))
        if kernel.traits.glossy:
            made.lobe, made.wi = dr.alloc_local(mi.Vector4f, size), dr.alloc_local(mi.Vector4f, size)
            made.shading = dr.alloc_local(mi.Vector3f, size)
        return made

    def write(self, y: ProxyVertex, slot: mi.UInt32, keep: mi.Bool):
        """Store a proxy in ``slot`` where ``keep``."""
        size, n = dr.maximum(y.lobes.diffuse, _LEAST_SIZE), y.n  # its sign is a flag
        self.normal.write(mi.Vector4f(n.x, n.y, n.z, dr.select(y.both, -size, size)), slot, keep)
        others = y.others
        if self.lobe is not None:
            others = dr.select(y.glossy, -dr.maximum(others, _LEAST_SIZE), others)
            lobe = mi.Vector4f(y.lobes.peak, y.lobes.peak_pdf, y.lobes.width2, y.peak_others)
            self.lobe.write(lobe, slot, keep)
            self.wi.write(mi.Vector4f(y.wi.x, y.wi.y, y.wi.z, y.lobes.diffuse_pdf), slot, keep)
            self.shading.write(y.shading, slot, keep)
        self.others.write(others, slot, keep)

    def read(self, p: mi.Point3f, slot: mi.UInt32) -> ProxyVertex:
        """The proxy in ``slot`` of a vertex at ``p``."""
        normal, others = self.normal[slot], self.others[slot]
        lobes, wi, shading, peak_others = Lobes.plain(), mi.Vector3f(0), mi.Vector3f(0), mi.Float(0)
        lobes.diffuse = dr.abs(normal.w)
        if self.lobe is not None:
            lobe, wi, shading = self.lobe[slot], self.wi[slot], self.shading[slot]
            lobes = Lobes(lobes.diffuse, wi.w, lobe.x, lobe.y, lobe.z)
            wi, peak_others = mi.Vector3f(wi.x, wi.y, wi.z), lobe.w
        return ProxyVertex(
            p=p,
            n=mi.Vector3f(normal.x, normal.y, normal.z),
            both=normal.w < 0,
            glossy=others < 0,
            lobes=lobes,
            wi=wi,
            shading=shading,
            others=dr.abs(others),
            peak_others=peak_others,
        )
