"""Directional area lights: light that leaves a shape along its normals only."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..host.introspection import children
from .group import Context, Group
from .records import Chosen, Emission
from .surfaces import Surfaces


class DirectionalAreaEmitters(Group):
    """Directional area lights.

    Emission: y_0 uniform on the shape (area measure), the direction is the shading normal. No connection
    reaches y_0.
    """

    limits = "its light leaves in one direction only"

    def __init__(self, emitters, context: Context):
        self._surfaces = Surfaces(emitters, context)
        # Only the texture gives the radiance.
        self._radiances = [(i, children(e)["radiance"]) for i, e in enumerate(emitters) if e is not None]

    def sample_emission(self, chosen: Chosen, u_point, u_direction, shared, active) -> Emission:
        ps, n = self._surfaces.sample(chosen, u_point, shared, active)
        d = mi.Vector3f(ps.n)
        si = mi.SurfaceInteraction3f(ps, shared.wavelengths)
        si.t, si.wi = mi.Float(0), mi.Vector3f(0, 0, 1)
        radiance = dr.zeros(mi.Spectrum)
        for place, texture in self._radiances:
            mask = active & (chosen.index == place)
            radiance = dr.select(mask, mi.Spectrum(texture.eval(si, mask)), radiance)
        return Emission(
            weight=dr.select(ps.pdf == 0, 0, radiance / ps.pdf),  # without cosine, as in Mitsuba
            d=d,
            anchor=self._surfaces.anchor(chosen, ps.p, n, active),
            cos=dr.abs(dr.dot(n, d)),
            pdf_first=ps.pdf,
            pdf_second=mi.Float(1),
            delta=mi.Bool(True),
            beam=mi.Bool(True),
            index=chosen.index,
            si=si,
        )

    def connection_density(self, chosen: Chosen, emission: Emission, si, active):
        return mi.Float(0)
