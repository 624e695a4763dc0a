"""Layers of the Stokes vector, as in Mitsuba's integrator ``stokes``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..geometry.polarization import basis
from ..host.introspection import world_transform

NAMES = tuple(f"S{i}.{channel}" for i in range(4) for channel in "RGB")
"""Of the layers."""

POLARIZED = 9
"""Numbers of a sample besides its colours, which are the intensity S0: S1, S2 and S3 in linear sRGB."""


class Stokes:
    """Stokes vectors of samples, in the frame of a ``sensor`` with horizontal x axis.

    S1 > 0: horizontal; S2 > 0: +45 degrees; S3 > 0: right circular polarization.
    """

    def __init__(self, sensor: mi.Sensor, rgb):
        self._vertical = world_transform(sensor) @ mi.Vector3f(0, 1, 0)
        dr.make_opaque(self._vertical)
        self._rgb = rgb

    def __call__(self, value: mi.Spectrum, wavelengths, towards: mi.Vector3f) -> list[mi.Float]:
        """Return S1, S2 and S3 of light that travels along ``towards`` to the sensor.

        The first column of the Mueller matrix ``value`` is the Stokes vector in the frame
        `polarization.basis`.
        """
        target = dr.cross(-towards, self._vertical)
        turned = mi.mueller.rotate_stokes_basis(towards, basis(towards), target)
        vector = [sum(turned[i, j] * value[j, 0] for j in range(1, 4)) for i in range(1, 4)]
        return [number for entry in vector for number in self._rgb(entry, wavelengths)]
