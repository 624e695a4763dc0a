"""The radius of vertex merging: in a pass a function of position alone, smaller from pass to pass."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry.boxes import scene_box
from ..geometry.rounding import OFFSET_ULPS, offset_at
from ..host.introspection import world_matrix

_PROBES = 64  # columns and rows of camera rays that measure the size of pixels in the scene

# Bounds of the radius in multiples of its median over the first hits of camera rays.
_LOWEST, _HIGHEST = 1 / 8, 8

# Radius in diagonals of the scene where no pixels can be measured (meters, custom sensors, empty views).
_OF_DIAGONAL = 1 / 64

# Samples per pixel after which discs have the radius of the parameters, and balls in media `BALLS` times it.
_OF_SAMPLES, BALLS = 64, 3.0

# Bound of a ball's radius in mean free paths; see experiments, "Merging in media".
MEAN_FREE_PATHS = 0.2


def after(radius: float, samples: float, dimensions: int = 2) -> float:
    """Radius of a pass that ends after ``samples`` per pixel; ``radius`` after `_OF_SAMPLES`.

    Variance is proportional to 1 / (samples radius^``dimensions``), squared bias to radius^4. The least sum
    has a radius of samples^(-1 / (dimensions + 4)): alpha = 2/3 in discs, 4/7 in balls (C. Knaus and
    M. Zwicker, "Progressive Photon Mapping: A Probabilistic Approach", 2011, eq. 15).
    """
    return radius * (samples / _OF_SAMPLES) ** (-1 / (dimensions + 4))


def film_pixels(sensor: mi.Sensor) -> int:
    """Number of pixels of the whole film: photons reach the scene beyond the crop window too."""
    return math.prod(sensor.film().size())


# Most change of the radius per distance: bounds the widths of cells and, by 3, the levels of one search.
_STEEPEST = 0.5

# Most change per distance of the rounding error of a position, the least radius.
_STEEPEST_ROUNDING = OFFSET_ULPS * 2.0**-24


@dataclass
class Radius:
    """``base`` + ``angle`` * distance from ``centre``, within ``low`` and ``high`` (scene units).

    At least the rounding error of the position, since smaller discs contain too few photons, or too many.
    Fields are opaque, so that passes share one kernel.
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
    def median(self) -> mi.Float:
        """Radius of the median pixel over the first hits of camera rays (scene units)."""
        return self.high / _HIGHEST

    @property
    def steepest(self) -> mi.Float:
        """Upper bound of the change of the radius per distance."""
        return dr.maximum(self.angle, _STEEPEST_ROUNDING)


@dataclass
class Balls:
    """The ``radius`` in participating ``media``, in harmonic sum with `MEAN_FREE_PATHS`."""

    radius: Radius
    media: Any

    def at(self, p: mi.Point3f, medium: mi.UInt32, discs: Radius) -> tuple[mi.Float, Radius]:
        """Radius at ``p`` (scene units) of a ball in ``medium``, or on a surface (0) of ``discs``.

        Also the `Radius` without the bound by mean free paths, which is at least as large.
        """
        radius = dr.select(medium != 0, self.radius, discs)
        r = dr.rcp(dr.rcp(radius.at(p)) + self.media.mean(medium) / MEAN_FREE_PATHS)
        return dr.maximum(r, offset_at(dr.max(dr.abs(p)))), radius


@dataclass(frozen=True)
class Footprints:
    """Size of a pixel (scene units): ``base`` + ``angle`` times the distance from ``centre``.

    ``median`` over the first hits of camera rays; without ``measured`` pixels `_OF_DIAGONAL`.
    """

    centre: tuple[float, float, float]
    base: float
    angle: float
    median: float
    measured: bool = True

    def radius(self, factor: float) -> Radius:
        """The radius of ``factor`` pixels."""
        angle = min(self.angle * factor, _STEEPEST)
        low, high = self.median * factor * _LOWEST, self.median * factor * _HIGHEST
        sizes = (mi.Float(x) for x in (self.base * factor, angle, low, high))
        radius = Radius(mi.Point3f(*self.centre), *sizes)
        dr.make_opaque(radius)
        return radius

    def balls(self, factor: float, space) -> Balls | None:
        """The radius of ``factor`` pixels in the media of ``space`` (a `Vacuum`); None if none scatters."""
        return None if space.phase is None else Balls(self.radius(factor), space.media)

    @staticmethod
    def of(scene: mi.Scene, sensor: mi.Sensor) -> Footprints:
        """Measure pixels by camera rays, with differentials where available."""
        grid = (np.arange(_PROBES) + 0.5) / _PROBES
        film = mi.Point2f(np.tile(grid, _PROBES), np.repeat(grid, _PROBES))
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, film, mi.Point2f(0.5))
        si = scene.ray_intersect(mi.Ray3f(ray))
        size = np.array(dr.norm(ray.o_x - ray.o + (ray.d_x - ray.d) * si.t))[np.isfinite(np.array(si.t))]
        median = float(np.median(size)) if ray.has_differentials and len(size) else 0.0
        if median == 0:  # a sensor of one ray has differentials of 0
            box = scene_box(scene)
            diagonal = math.dist([*box.min], [*box.max])
            size = diagonal * _OF_DIAGONAL if 0 < diagonal < math.inf else 1.0
            return Footprints((0.0, 0.0, 0.0), size, 0.0, size, measured=False)
        angle = float(np.median(np.array(dr.norm(ray.d_x - ray.d))))
        if not isinstance(sensor, mi.ProjectiveCamera) or angle == 0:  # of one size, or from several origins
            return Footprints((0.0, 0.0, 0.0), median, 0.0, median)
        centre = world_matrix(sensor)[:3, 3]
        return Footprints(tuple(centre.tolist()), 0.0, angle, median)
