"""How near to each other the vertices lie that are merged: a function of position alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...geometry.boxes import scene_box
from ...geometry.rounding import OFFSET_ULPS, offset_at
from ...host.introspection import world_matrix

# Camera rays by which a scene is asked for the size of its pixels: so many columns and rows of them.
_PROBES = 64

# The radius is between these multiples of its median over what camera rays meet first.
_LOWEST, _HIGHEST = 1 / 8, 8

# Without pixels to measure (meters, a sensor of one's own, nothing in view): of the scene's diagonal.
_OF_DIAGONAL = 1 / 512

# Radii of passes: that of the i-th over the first is i^((alpha - 1) / 2), with this alpha (C. Knaus and
# M. Zwicker, "Progressive Photon Mapping: A Probabilistic Approach", 2011, eq. 15).
SHRINKING = 2 / 3

# Most change of the radius per distance: the widths of cells allow for it (`merging.cell_at`).
_STEEPEST = 0.5

# Most change of the rounding error of a position, the least radius, per distance.
_STEEPEST_ROUNDING = OFFSET_ULPS * 2.0**-24


@dataclass
class Radius:
    """``base`` + ``angle`` times the distance from ``centre``, between ``low`` and ``high`` (scene units).

    At least the rounding error of the position: smaller discs contain too few photons, or too many. All
    opaque, so that passes of any radius are one kernel. Photons and camera vertices find the same at the same
    place, or weights would not sum to 1.
    """

    centre: mi.Point3f
    base: mi.Float
    angle: mi.Float
    low: mi.Float
    high: mi.Float

    def at(self, p: mi.Point3f) -> mi.Float:
        """The radius at ``p`` (scene units)."""
        of_pixels = dr.clip(self.base + self.angle * dr.norm(p - self.centre), self.low, self.high)
        return dr.maximum(of_pixels, offset_at(dr.max(dr.abs(p))))

    @property
    def steepest(self) -> mi.Float:
        """Upper bound of the change of the radius per distance."""
        return dr.maximum(self.angle, _STEEPEST_ROUNDING)


@dataclass(frozen=True)
class Footprints:
    """The size of pixels in a scene: ``base`` + ``angle`` times the distance from ``centre``; ``median``."""

    centre: tuple[float, float, float]
    base: float
    angle: float
    median: float

    def radius(self, factor: float) -> Radius:
        """The radius that is ``factor`` pixels."""
        angle = min(self.angle * factor, _STEEPEST)
        low, high = self.median * factor * _LOWEST, self.median * factor * _HIGHEST
        radius = Radius(
            mi.Point3f(*self.centre), *(mi.Float(x) for x in (self.base * factor, angle, low, high))
        )
        dr.make_opaque(radius)
        return radius

    @staticmethod
    def of(scene: mi.Scene, sensor: mi.Sensor) -> Footprints:
        """Measured by camera rays and their differentials, where the sensor has some."""
        grid = (np.arange(_PROBES) + 0.5) / _PROBES
        film = mi.Point2f(np.tile(grid, _PROBES), np.repeat(grid, _PROBES))
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, film, mi.Point2f(0.5))
        si = scene.ray_intersect(mi.Ray3f(ray))
        found = np.isfinite(np.array(si.t))
        if not ray.has_differentials or not found.any():
            return Footprints._without_pixels(scene)
        spread = dr.norm(ray.d_x - ray.d)
        size = np.array(dr.norm(ray.o_x - ray.o + (ray.d_x - ray.d) * si.t))
        median, angle = float(np.median(size[found])), float(np.median(np.array(spread)))
        if not isinstance(sensor, mi.ProjectiveCamera) or angle == 0:  # of one size, or from several places
            return Footprints((0.0, 0.0, 0.0), median, 0.0, median)
        centre = world_matrix(sensor)[:3, 3]
        return Footprints(tuple(centre.tolist()), 0.0, angle, median)

    @staticmethod
    def _without_pixels(scene: mi.Scene) -> Footprints:
        box = scene_box(scene)
        diagonal = math.dist([*box.min], [*box.max])
        size = diagonal * _OF_DIAGONAL if 0 < diagonal < math.inf else 1.0
        return Footprints((0.0, 0.0, 0.0), size, 0.0, size)
