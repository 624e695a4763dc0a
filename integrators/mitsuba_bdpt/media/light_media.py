"""The medium in which light subpaths start.

Scenes seldom declare it: an area light on a shape without exterior medium may stand in a ball of milk. It is
determined by the ray of each emission: the near side of the first boundary that it meets, or the medium that
surrounds the scene. Kernels trace it only for emitters whose rays start in several media.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.emitters import Emitters
from ..geometry import rays
from ..geometry.boxes import known_box, points_in, scene_box
from ..geometry.directions import random_directions
from ..host.introspection import is_instance, named
from ..transport.inputs import Shared
from .phase import asymmetry
from .space import Space
from .transmittance import through_surfaces

# Rays around the sensor, lines from outside of the scene, rays that may end at the far plane.
_AROUND, _LINES, _CAMERA_RAYS = 64, 1 << 12, 1 << 12

# Emissions per emitter, and of all, that find emitters in several media; fewest that settle one.
_EMISSIONS, _ALL_EMISSIONS, _FEWEST = 1 << 12, 1 << 20, 32

_MOST_SHAPES = 1024  # most shapes that bound media at which lines aim
_TOLERATED = 0.01  # largest share of rays around the sensor that may disagree with it (rounding, edges)
_SYMMETRIC = 1e-3  # largest mean relative difference of sigma_t rho and its reverse due to rounding
_REFLECTIONS = 64  # most reflections at opaque surfaces; among walls without a boundary a ray would never end


class LightMedia:
    """The medium of every emitter; made for each render.

    ``outside``: number of the medium that surrounds the scene, see `_outside`; ``contradiction``: why light
    and camera subpaths would disagree on the media, or empty; ``hides_infinity``: light from infinity does
    not arrive; ``far``: see `medium_at_far_plane`; ``about`` as in `known_box`.
    """

    def __init__(self, space: Space, emitters: Emitters, sensor: mi.Sensor, far: int, about: Callable):
        self._space, self._emitters = space, emitters
        around = _near_sides(space, _rays_around(sensor))
        lines = _lines(space, about)
        self.outside = outside = _outside(space, around, lines)
        self._outside = dr.opaque(mi.UInt32, outside)
        # An endless homogeneous medium absorbs all light from infinity.
        endless = space.media.properties[outside - 1] if outside else None
        self.hides_infinity = endless is not None and endless.homogeneous and endless.least > 0
        self.contradiction = (
            _contradiction_of_sensor(space, sensor, around)
            or _contradiction_of_phases(space)
            or (_contradiction_at_infinity(space, outside, lines) if emitters.at_infinity else "")
            or _contradiction_at_far_plane(space, sensor, 0 if far == outside else far)
        )
        number_of, bounded = space.media.number_of, lines is not None  # else all is in one medium

        def start(emitter: mi.Emitter) -> tuple[int, int, bool]:
            """Its medium in front and at the back, and whether rays decide instead."""
            shape = emitter.get_shape()
            if shape is not None and shape.is_medium_transition():
                return number_of(shape.exterior_medium()), number_of(shape.interior_medium()), False
            infinite = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
            unknown = space.media.sensor if bounded else outside
            return unknown, unknown, bounded and not infinite and emitter.sampling_weight() > 0

        self._settled = False
        self._tabulate(np.array([start(emitter) for emitter in emitters.objects] or [(0, 0, False)]))

    def _tabulate(self, starts: np.ndarray):
        """Store the results of `start`, one row per emitter."""
        self._starts, self._any_traced = starts, bool(starts[:, 2].any())
        self._sides, self._by_ray = mi.UInt32(starts[:, :2].ravel()), mi.Bool(starts[:, 2] != 0)
        dr.make_opaque(self._sides, self._by_ray)

    def settle(self):
        """Find the emitters whose emissions all start in one medium; to be called before `at` is recorded."""
        if self._settled or not self._any_traced:
            return
        self._settled, count = True, self._emitters.count
        u = np.random.default_rng(0).random((4, min(_EMISSIONS * count, _ALL_EMISSIONS)))
        wavelengths = dr.zeros(mi.UnpolarizedSpectrum, u.shape[1]) + 550 if mi.is_spectral else mi.Color0f()
        shared = Shared(mi.Float(0), wavelengths, mi.UnpolarizedSpectrum(1), mi.Float(0.5))
        e = self._emitters.sample_emission(mi.Point2f(u[:2]), mi.Point2f(u[2:]), shared, mi.Bool(True))
        number, known, index = _arrays(u.shape[1], *self._traced(e), e.index)
        media = len(self._space.media.properties) + 1
        found = np.bincount((index * media + number)[known], minlength=count * media).reshape(count, media)
        starts, total, most = self._starts.copy(), found.sum(axis=1), found.max(axis=1)
        settled = (starts[:, 2] != 0) & (total > 0)
        starts[settled, :2] = found.argmax(axis=1)[settled, None]
        starts[settled & (total >= _FEWEST) & (most == total), 2] = False
        self._tabulate(starts)

    def at(self, e) -> mi.UInt32:
        """Number of the medium in which the first ray of an `emitters.Emission` starts.

        The medium that the emitter's shape declares on the side of the direction; otherwise the near side of
        the first boundary along the ray. Of a ray that stays among opaque surfaces the medium of most other
        rays of its emitter, see `settle`, or that of the sensor.
        """
        return self._traced(e)[0]

    def _traced(self, e) -> tuple[mi.UInt32, mi.Bool]:
        """The medium of an emission, and whether it is known."""
        known = mi.Bool(True)
        outwards = dr.dot(e.anchor.n, e.d) >= 0
        number = dr.gather(mi.UInt32, self._sides, 2 * e.index + dr.select(outwards, mi.UInt32(0), 1))
        if self._any_traced:
            traced = dr.gather(mi.Bool, self._by_ray, e.index)
            ray = mi.Ray3f(e.anchor.towards(e.d), e.d)
            near, found, escaped = near_side(self._space, ray, traced)
            known = ~traced | found | escaped
            unless_found = dr.select(escaped, self._outside, number)
            number = dr.select(traced, dr.select(found, near, unless_found), number)
        return dr.select(e.infinite, self._outside, number), known


@dr.syntax
def near_side(space: Space, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool, mi.Bool]:
    """Find the first boundary along ``ray`` whose near side light may leave.

    Returns the number of the medium before it, and two masks: it was found; the ray left the scene without
    meeting one. Neither holds for a ray that stays among opaque surfaces.

    Scenes leave other sides undeclared, such as that within a wall or at the back of a light. Rays pass
    straight through such sides and surfaces that bound no medium if they transmit. Opaque ones reflect the
    ray as a mirror, so that it stays where light can go.
    """
    o, d, number = mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.UInt32(0)
    found, escaped, reflections = mi.Bool(False), mi.Bool(False), mi.UInt32(0)
    going = mi.Bool(active)
    while dr.hint(going, label="the first boundary", exclude=[space, ray, active]):
        segment = mi.Ray3f(o, d, ray.time, ray.wavelengths)
        si = space.scene.ray_intersect(segment, mi.RayFlags.All, coherent=False, active=going)
        hit = going & si.is_valid()
        bounds = hit & si.is_medium_transition() & _may_leave(si, -d)
        number = dr.select(bounds, space.media.number(si.target_medium(-d)), number)
        found |= bounds
        escaped |= going & ~hit
        transmits = (si.bsdf().flags() & int(mi.BSDFFlags.Transmission)) != 0
        opaque = hit & ~bounds & ~transmits
        d = dr.select(opaque, d - si.n * (2 * dr.dot(d, si.n)), d)
        straight = segment(rays.passed(segment, si, space.shape_errors))
        mirrored = rays.surface_anchor(si, segment, space.shape_errors).towards(d)
        o = dr.select(opaque, mirrored, straight)
        reflections += dr.select(opaque, mi.UInt32(1), 0)
        going = hit & ~bounds & (reflections < _REFLECTIONS)
    return number, found, escaped


def _may_leave(si, d) -> mi.Bool:
    """Mask: light may leave the surface ``si`` along ``d``, by emission or scattering.

    A BSDF without side flags may scatter to both sides.
    """
    front = dr.dot(si.sh_frame.n, d) > 0
    sides = mi.UInt32(int(mi.BSDFFlags.FrontSide)), mi.UInt32(int(mi.BSDFFlags.BackSide))
    flags = si.bsdf().flags()
    scatters = (flags & dr.select(front, *sides)) != 0
    unstated = (flags & (sides[0] | sides[1])) == 0
    return scatters | unstated | (front & (si.shape.emitter() != dr.zeros(mi.EmitterPtr)))


def _arrays(count: int, *values) -> list[np.ndarray]:
    """``values`` of ``count`` lanes as NumPy arrays; one kernel."""
    dr.eval(values)
    return [np.broadcast_to(np.array(value), count) for value in values]


def _near_sides(space: Space, ray: mi.Ray3f) -> list[np.ndarray]:
    return _arrays(dr.width(ray.o), *near_side(space, ray, mi.Bool(True)))


def _lines(space: Space, about: Callable) -> mi.Ray3f | None:
    """`_LINES` random lines from outside of the scene to shapes that bound media; None without any."""
    shapes = [s for s in space.scene.shapes() if s.is_medium_transition() or is_instance(s)]
    boxes = [box for s in shapes if (box := known_box(s, about)) is not None][:_MOST_SHAPES]
    if not boxes:
        return None
    points = np.random.default_rng(1).random((_LINES, 3))
    through = points_in(boxes, np.arange(_LINES) % len(boxes), points)
    d = random_directions(np.random.default_rng(2), _LINES)
    size = float(np.linalg.norm(np.array(scene_box(space.scene, about).extents())))
    return mi.Ray3f(through - d * (size * 1.1), d)


def _outside(space: Space, around: list[np.ndarray], lines: mi.Ray3f | None) -> int:
    """The medium that surrounds the scene.

    The most frequent medium of two sets of rays: rays from the sensor that escape (the sensor's medium), and
    ``lines`` from outside (the near side of the first boundary). The sensor's if there are none.
    """
    numbers = np.full(around[2].sum(), space.media.sensor)
    if lines is not None:
        near, found, _ = _near_sides(space, lines)
        numbers = np.concatenate([numbers, near[found]])
    return int(np.bincount(numbers).argmax()) if len(numbers) else space.media.sensor


def _rays_around(sensor: mi.Sensor) -> mi.Ray3f:
    """Rays from the sensor's origins; in all directions if these are near one point."""
    own, u = _camera_rays(sensor, _AROUND, 0)
    at_one_point = sensor.class_name() in ("PerspectiveCamera", "ThinLensCamera", "RadianceMeter")
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1])) if at_one_point else own.d
    return mi.Ray3f(own.o + dr.zeros(mi.Point3f, _AROUND), d)


def _camera_rays(sensor: mi.Sensor, count: int, seed: int):
    """``count`` random rays of a sensor, and their random numbers, (5, count)."""
    u = np.random.default_rng(seed).random((5, count))
    film, aperture = mi.Point2f(u[2], u[3]), mi.Point2f(u[0], u[1])
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), mi.Float(u[4]), film, aperture)
    return ray, u


def _contradiction_of_sensor(space: Space, sensor: mi.Sensor, around: list[np.ndarray]) -> str:
    """Why the sensor is not in the medium of the boundaries ``around`` it; empty if it is."""
    near, found, _ = around
    numbers = near[found]
    others = numbers[numbers != space.media.sensor]
    if len(others) <= _TOLERATED * len(numbers):
        return ""
    says, there = (_called(space, n) for n in (space.media.sensor, int(np.bincount(others).argmax())))
    return (
        f"sensor {named(sensor)} declares {says}, but the boundaries around it say that it is in {there}: "
        "let it refer to that (name medium), or mend the media of the shapes around it"
    )


def _called(space: Space, number: int) -> str:
    return f"the medium {named(space.media.properties[number - 1].medium)}" if number else "no medium"


def _contradiction_of_phases(space: Space) -> str:
    """Why scattering is not reciprocal; empty if it is."""
    for medium in (p.medium for p in space.media.properties):
        if asymmetry(medium) > _SYMMETRIC:
            return (
                f"the phase function of medium {named(medium)} ({medium.phase_function().class_name()}) "
                "times the extinction along the direction of arrival is not symmetric"
            )
    return ""


def _contradiction_at_infinity(space: Space, outside: int, lines: mi.Ray3f | None) -> str:
    """Why light from infinity differs from the camera's side in ``outside``; or empty."""
    if lines is not None:
        si = space.scene.ray_intersect(lines)
        number = space.media.number(si.target_medium(lines.d))
        onwards = mi.Ray3f(lines(rays.passed(lines, si, space.shape_errors)), lines.d)
        entered, number = _arrays(_LINES, si.is_valid() & si.is_medium_transition(), number)
        escaped = entered & _near_sides(space, onwards)[2]
        wrong = number[escaped & (number != outside)]
        if len(wrong) > _TOLERATED * entered.sum():
            return (
                f"rays leave the scene in {_called(space, int(np.bincount(wrong).argmax()))}, others "
                f"in {_called(space, outside)}: close the boundary between them"
            )
    if not outside:
        return ""
    endless = space.media.properties[outside - 1]
    name = named(endless.medium)
    if not endless.homogeneous:
        return (
            f"the grid of medium {name} has no boundary, so that light from infinity starts within "
            "it: put a shape with a null BSDF around it"
        )
    if endless.least == 0 and endless.majorant.max() > 0:
        return (
            f"medium {name} has no end and lets some wavelengths of light from infinity through, "
            "but not others: put a shape with a null BSDF around it"
        )
    return ""


def medium_at_far_plane(space: Space, sensor: mi.Sensor) -> int:
    """Number of the medium in which most clipped camera rays end at the far plane.

    0 if none ends in a medium, without emitters at infinity, and for sensors without far plane.
    """
    infinite = any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in space.scene.emitters())
    if not infinite or not isinstance(sensor, mi.ProjectiveCamera):
        return 0
    ray, _ = _camera_rays(sensor, _CAMERA_RAYS, 3)
    end = through_surfaces(space, mi.Ray3f(ray), mi.UInt32(space.media.sensor), mi.Bool(True))
    number, arrived = _arrays(_CAMERA_RAYS, end.medium, end.clear)
    clipped = arrived & (number > 0)
    return int(np.bincount(number[clipped]).argmax()) if clipped.any() else 0


def _contradiction_at_far_plane(space: Space, sensor: mi.Sensor, far: int) -> str:
    """Why camera rays that end in the medium ``far`` disagree with light; or empty."""
    if not far:
        return ""
    return (
        f"the far plane of sensor {named(sensor)} lies in {_called(space, far)}, "
        "through the rest of which light from infinity has to come: raise far_clip"
    )
