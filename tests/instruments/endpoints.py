"""Densities of emitters and cameras in closed form: rows are paths, float64. Independent of the package, but
for the disks on which light from infinity starts."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_bdpt.emitters.tables import in_order
from mitsuba_bdpt.host.introspection import matrix_of, world_matrix

from .oracle import AREA, DIRECTIONAL, ENVIRONMENT, POSITION

KINDS = {
    "AreaLight": AREA,
    "PointLight": POSITION,
    "SpotLight": POSITION,
    "ConstantBackgroundEmitter": ENVIRONMENT,
    "EnvironmentMapEmitter": ENVIRONMENT,
    "DirectionalEmitter": DIRECTIONAL,
}


# Sine of the angle to a pole of an environment map below which `Lamp.unsure` is true.
NEAR_POLE = 0.01


def dot(a, b):
    return (a * b).sum(-1)


def length2(a):
    return dot(a, a)


@dataclass
class Lamp:
    """``probability`` of being chosen, ``area`` of its shape, ``center`` and ``radius`` of a sphere that
    shines outwards (0 of other shapes), solid angle ``cone`` into which it shines from a point, direction of
    an environment map's ``pole``."""

    emitter: mi.Emitter
    kind: int
    probability: float
    area: float = 1.0
    center: np.ndarray | None = None
    radius: float = 0.0
    cone: float = 4 * np.pi
    pole: np.ndarray | None = None

    def of_direction(self, towards):
        """Density of the direction ``towards`` an environment, without the choice."""
        if self.kind == DIRECTIONAL:
            return np.ones(len(towards))
        if self.emitter.class_name() == "ConstantBackgroundEmitter":
            return np.full(len(towards), 1 / (4 * np.pi))
        ds, it = dr.zeros(mi.DirectionSample3f), dr.zeros(mi.Interaction3f)
        ds.d = mi.Vector3f(np.ascontiguousarray(towards.T, dtype=np.float32))
        return np.array(self.emitter.pdf_direction(it, ds), dtype=np.float64)

    def first(self, d):
        """Of x_0 in emission; ``d`` the direction in which light leaves it."""
        if self.kind == AREA:
            return np.full(len(d), self.probability / self.area)
        if self.kind == POSITION:
            return np.full(len(d), self.probability)
        return self.probability * self.of_direction(-d)

    def second(self, cos, x1, d, disks):
        """Of x_1 in emission: a solid angle, from infinity an area across ``d``."""
        if self.kind == AREA:
            return cos / np.pi
        if self.kind == POSITION:
            return np.full(len(d), 1 / self.cone)
        return disks.density(x1, d)

    def direct(self, cos, dist2, x1, d):
        """Of x_0 in next-event estimation from ``x1``, solid angle; a probability for delta emitters."""
        if self.kind in (POSITION, DIRECTIONAL):
            return np.full(len(d), self.probability)
        if self.kind == ENVIRONMENT:
            return self.probability * self.of_direction(-d)
        by_area = dist2 / (cos * self.area)
        if self.radius:
            # Mitsuba samples the cone of a sphere that is seen from outside.
            sin2 = np.minimum(self._sin2(x1), 1)
            return self.probability * (1 + np.sqrt(1 - sin2)) / (2 * np.pi * sin2)
        return self.probability * by_area

    def _sin2(self, x1):
        """Of half the angle under which a sphere is seen."""
        return self.radius**2 / length2(x1 - self.center)

    def unsure(self, x1, d):
        """Rounding decides the density: at the rim of a sphere of whether it is seen from outside, and near
        the poles of an environment map, where the density is off by 6e-8 over the squared angle."""
        if self.pole is not None:
            return 1 - np.square(d @ self.pole) < NEAR_POLE**2
        return self._sin2(x1) > 1 - 1e-4 if self.radius else np.zeros(len(x1), dtype=bool)


@dataclass
class Disks:
    """Where light from infinity starts: outlines of ``spheres`` (centre, radius, share); a single one is
    taken to be passed by all light."""

    spheres: list

    def passes(self, x, d):
        """For each sphere: lines through ``x`` along ``d`` that meet it, and those so close to the rim that
        rounding decides."""
        for center, radius, _ in self.spheres:
            away = x - center
            miss = np.sqrt(np.maximum(length2(away - dot(away, d)[:, None] * d), 0))
            yield miss <= radius, np.abs(miss - radius) < 1e-3 * radius

    def density(self, x, d):
        passed = [met for met, _ in self.passes(x, d)]
        if len(passed) == 1:
            passed = [np.ones(len(x), dtype=bool)]
        parts = zip(passed, self.spheres, strict=True)
        return sum(met * share / (np.pi * radius**2) for met, (_, radius, share) in parts)

    def covers(self, x, d):
        """Whether light along ``d`` comes by ``x`` after it has started."""
        center, radius, _ = self.spheres[0]
        met = np.any([met for met, _ in self.passes(x, d)], axis=0)
        return met & (dot(x - center, d) >= -radius)

    def unsure(self, x, d):
        return np.any([rim for _, rim in self.passes(x, d)], axis=0)


def disks_of(found) -> Disks | None:
    if found is None:
        return None
    spheres = [s for s in (found.scene, found.details) if s is not None]
    shares = [1.0] if len(spheres) == 1 else [0.5, 0.5]
    centers = [np.array(s.center, dtype=np.float64).ravel() for s in spheres]
    radii = [float(s.radius[0]) for s in spheres]
    return Disks(list(zip(centers, radii, shares, strict=True)))


def lamps_of(scene) -> list[Lamp]:
    """In the package's order."""
    lamps = in_order(scene)
    weights = np.array([float(np.array(e.sampling_weight()).ravel()[0]) for e in lamps])
    return [_lamp(e, p) for e, p in zip(lamps, (weights / weights.sum()).tolist(), strict=True)]


def _lamp(emitter, probability) -> Lamp:
    name, shape = emitter.class_name(), emitter.get_shape()
    lamp = Lamp(emitter, KINDS[name], probability)
    if name == "SpotLight":
        cutoff = np.deg2rad(float(np.array(mi.traverse(emitter)["cutoff_angle"]).ravel()[0]))
        lamp.cone = 2 * np.pi * (1 - np.cos(cutoff))
    if name == "EnvironmentMapEmitter":
        lamp.pole = matrix_of(emitter)[:3, 1]
    if shape is not None:
        lamp.area = float(np.array(shape.surface_area()).ravel()[0])
        if shape.class_name() == "Sphere":
            matrix = matrix_of(shape)
            if _faces_outwards(shape, matrix[:3, 3]):
                lamp.center, lamp.radius = matrix[:3, 3], np.linalg.norm(matrix[:3, 0])
    return lamp


def _faces_outwards(sphere, center) -> bool:
    hit = sphere.ray_intersect(mi.Ray3f(mi.Point3f(center.tolist()), mi.Vector3f(1, 0, 0)))
    return float(np.array(hit.n).ravel()[0]) > 0


@dataclass
class Camera:
    """A perspective camera, or with a ``radius`` of its lens a thin lens; ``area`` of the film at distance
    1."""

    axis: np.ndarray
    area: float
    radius: float

    @staticmethod
    def of(sensor) -> Camera:
        """Of a film without crop window, ``fov`` across its width."""
        params = mi.traverse(sensor)
        width, height = sensor.film().size()
        across = 2 * np.tan(np.deg2rad(float(np.array(params["x_fov"]).ravel()[0])) / 2)
        lens = sensor.class_name() == "ThinLensCamera"
        radius = float(np.array(params["aperture_radius"]).ravel()[0]) if lens else 0.0
        axis = world_matrix(sensor)[:3, 2]
        return Camera(axis / np.linalg.norm(axis), across**2 * height / width, radius)

    def density(self, d):
        """Solid-angle density of the camera ray against ``d``, the direction of light."""
        return 1 / (self.area * np.abs(d @ self.axis) ** 3)

    def lens_density(self):
        """Of a point of the lens; 1 without area."""
        return 1 / (np.pi * self.radius**2) if self.radius else 1.0
