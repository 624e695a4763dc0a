"""The medium in which light subpaths start.

Scenes seldom declare it: an area light on a shape without exterior medium may stand in a ball of milk. It is
determined by the ray of each emission: the near side of the first boundary that it meets, or the medium that
surrounds the scene. Kernels trace it only for emitters whose rays start in several media.
"""

from __future__ import annotations

import dataclasses
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
from . import boundaries
from .phase import asymmetry
from .space import Space

# Rays around the sensor, lines from outside of the scene, rays that may end at the far plane.
_AROUND, _LINES, _CAMERA_RAYS = 64, 1 << 12, 1 << 12

# Emissions per emitter, and of all, that find emitters in several media; fewest that settle one.
_EMISSIONS, _ALL_EMISSIONS, _FEWEST = 1 << 12, 1 << 20, 32

# Most shapes that bound media at which lines aim.
_MOST_SHAPES = 1024

# Largest share of rays around the sensor that may disagree with it (rounding, edges).
_TOLERATED = 0.01

# Largest mean relative difference of sigma_t rho and its reverse due to rounding.
_SYMMETRIC = 1e-3


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
        endless = space.media.objects[outside - 1] if outside else None
        self.hides_infinity = (
            endless is not None and endless.is_homogeneous() and space.media.looks[outside - 1].least > 0
        )
        self.contradiction = (
            _contradiction_of_sensor(space, sensor, around)
            or _contradiction_of_phases(space)
            or (_contradiction_at_infinity(space, outside, lines) if emitters.at_infinity else "")
            or _contradiction_at_far_plane(space, sensor, 0 if far == outside else far)
        )
        shapes = [emitter.get_shape() for emitter in emitters.objects]
        declared = [shape is not None and shape.is_medium_transition() for shape in shapes]
        number_of, bounds = space.media.number_of, list(zip(shapes, declared, strict=True))
        unknown = space.media.sensor if lines is not None else outside
        front = [number_of(shape.exterior_medium()) if known else unknown for shape, known in bounds]
        back = [number_of(shape.interior_medium()) if known else unknown for shape, known in bounds]
        self._front, self._back = mi.UInt32(front or [0]), mi.UInt32(back or [0])
        infinite = (mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in emitters.objects)
        chosen = (emitter.sampling_weight() > 0 for emitter in emitters.objects)
        bounded = lines is not None  # else all is in one medium
        asked = [
            bounded and may and not (known or away)
            for known, away, may in zip(declared, infinite, chosen, strict=True)
        ]
        self._settled, self._any_asked, self._asked = False, any(asked), mi.Bool(asked or [False])
        dr.make_opaque(self._front, self._back, self._asked)

    def settle(self):
        """Find the emitters whose emissions all start in one medium; to be called before `at` is recorded."""
        if self._settled or not self._any_asked:
            return
        self._settled, count = True, self._emitters.count
        u = np.random.default_rng(0).random((4, min(_EMISSIONS * count, _ALL_EMISSIONS)))
        wavelengths = dr.zeros(mi.UnpolarizedSpectrum, u.shape[1]) + 550 if mi.is_spectral else mi.Color0f()
        shared = Shared(mi.Float(0), wavelengths, mi.UnpolarizedSpectrum(1), mi.Float(0.5))
        e = self._emitters.sample_emission(mi.Point2f(u[:2]), mi.Point2f(u[2:]), shared, mi.Bool(True))
        number, known = self._traced(e)
        dr.eval(number, known, e.index)  # one kernel
        known = np.broadcast_to(np.array(known), u.shape[1])
        index, number = (np.broadcast_to(np.array(x), u.shape[1])[known] for x in (e.index, number))
        media = len(self._space.media.objects) + 1
        found = np.bincount(index * media + number, minlength=count * media).reshape(count, media)
        front, back, asked = (np.array(table) for table in (self._front, self._back, self._asked))
        total, told = found.sum(axis=1), asked & found.any(axis=1)
        front[told] = back[told] = found.argmax(axis=1)[told]
        asked &= (total < _FEWEST) | (found.max(axis=1) < total)
        self._front, self._back, self._asked = mi.UInt32(front), mi.UInt32(back), mi.Bool(asked)
        self._any_asked = bool(asked.any())
        dr.make_opaque(self._front, self._back, self._asked)

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
        number = dr.select(
            outwards, dr.gather(mi.UInt32, self._front, e.index), dr.gather(mi.UInt32, self._back, e.index)
        )
        if self._any_asked:
            asked = dr.gather(mi.Bool, self._asked, e.index)
            met = boundaries.near_side(self._space, mi.Ray3f(e.anchor.towards(e.d), e.d), asked)
            known = ~asked | met.found | met.escaped
            unless_found = dr.select(met.escaped, self._outside, number)
            number = dr.select(asked, dr.select(met.found, met.number, unless_found), number)
        return dr.select(e.infinite, self._outside, number), known


def _near_sides(space: Space, ray: mi.Ray3f) -> boundaries.NearSide:
    """Near sides of rays as NumPy arrays."""
    side, count = boundaries.near_side(space, ray, mi.Bool(True)), dr.width(ray.o)
    dr.eval(side)  # one kernel
    parts = (getattr(side, part.name) for part in dataclasses.fields(side))
    return boundaries.NearSide(*(np.broadcast_to(np.array(part), count) for part in parts))


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


def _outside(space: Space, around: boundaries.NearSide, lines: mi.Ray3f | None) -> int:
    """The medium that surrounds the scene.

    The most frequent medium of two sets of rays: rays from the sensor that escape (the sensor's medium), and
    ``lines`` from outside (the near side of the first boundary). The sensor's if there are none.
    """
    numbers = np.full(around.escaped.sum(), space.media.sensor)
    if lines is not None:
        met = _near_sides(space, lines)
        numbers = np.concatenate([numbers, met.number[met.found]])
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


def _contradiction_of_sensor(space: Space, sensor: mi.Sensor, around: boundaries.NearSide) -> str:
    """Why the sensor is not in the medium of the boundaries ``around`` it; empty if it is."""
    numbers = around.number[around.found]
    others = numbers[numbers != space.media.sensor]
    if len(others) <= _TOLERATED * len(numbers):
        return ""
    says, there = (_called(space, n) for n in (space.media.sensor, int(np.bincount(others).argmax())))
    return (
        f"sensor {named(sensor)} declares {says}, but the boundaries around it say that it is in {there}: "
        "let it refer to that (name medium), or mend the media of the shapes around it"
    )


def _called(space: Space, number: int) -> str:
    return f"the medium {named(space.media.objects[number - 1])}" if number else "no medium"


def _contradiction_of_phases(space: Space) -> str:
    """Why scattering is not reciprocal; empty if it is."""
    for medium in space.media.objects:
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
        entered, number = (np.array(x) for x in (si.is_valid() & si.is_medium_transition(), number))
        escaped = entered & _near_sides(space, onwards).escaped
        wrong = number[escaped & (number != outside)]
        if len(wrong) > _TOLERATED * entered.sum():
            return (
                f"rays leave the scene in {_called(space, int(np.bincount(wrong).argmax()))}, others "
                f"in {_called(space, outside)}: close the boundary between them"
            )
    if not outside:
        return ""
    medium, look = space.media.objects[outside - 1], space.media.looks[outside - 1]
    if not medium.is_homogeneous():
        return (
            f"the grid of medium {named(medium)} has no boundary, so that light from infinity starts within "
            "it: put a shape with a null BSDF around it"
        )
    if look.least == 0 and look.majorant.max() > 0:
        return (
            f"medium {named(medium)} has no end and lets some wavelengths of light from infinity through, "
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
    number, arrived = (
        np.array(x) for x in boundaries.behind(space, mi.Ray3f(ray), mi.UInt32(space.media.sensor))
    )
    clipped = arrived & (number > 0)
    return int(np.bincount(number[clipped]).argmax()) if clipped.any() else 0


def _contradiction_at_far_plane(space: Space, sensor: mi.Sensor, far: int) -> str:
    """Why camera rays that end in the medium ``far`` disagree with light; or empty."""
    if not far:
        return ""
    return (
        f"the far plane of sensor {named(sensor)} lies in the medium {named(space.media.objects[far - 1])}, "
        "through the rest of which light from infinity has to come: raise far_clip"
    )
