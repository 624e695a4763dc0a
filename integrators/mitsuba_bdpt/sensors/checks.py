"""Checks of sensors' parameters before a render.

Mitsuba loads invalid sensors, and renders black or NaN, or ends the process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError, UsageError
from ..geometry.to_world import check_to_world
from ..host.introspection import children, named, number, own_parameters, world_matrix

_NAMES = {
    "PerspectiveCamera": "perspective camera",
    "ThinLensCamera": "thinlens camera",
    "OrthographicCamera": "orthographic camera",
    "RadianceMeter": "radiance meter",
    "IrradianceMeter": "irradiance meter",
    "DistantSensorImpl": "distant sensor",
    "BatchSensor": "batch sensor",
}

_TRIED = 64  # test rays of sensors for which only Mitsuba generates rays


def called(sensor: mi.Sensor) -> str:
    """Kind and id of a sensor, for messages."""
    return f"{_NAMES.get(sensor.class_name(), 'sensor')} {named(sensor)}"


def check_sensor(sensor: mi.Sensor, of_scene: Sequence[mi.Sensor]):
    """Raise ``UsageError`` or ``UnsupportedError`` if ``sensor`` or a view has no camera rays."""
    kind = sensor.class_name()
    if kind == "BatchSensor":
        for view in views(sensor):
            check_sensor(view, of_scene)
    elif kind == "IrradianceMeter":
        _check_meter(sensor)
    elif kind in _NAMES:
        _check_numbers(sensor)
    if kind == "DistantSensorImpl" and not any(sensor is other for other in of_scene):
        raise UnsupportedError(
            f"{called(sensor)} is not one of the scene's own sensors, the only ones that Mitsuba gives the "
            "extent of the scene; make it a sensor of the scene, not a view of a batch"
        )


def views(sensor: mi.Sensor) -> list[mi.Sensor]:
    """Return the views of a batch sensor, from left to right."""
    return [view for view in children(sensor).values() if isinstance(view, mi.Sensor)]


def _check_meter(sensor: mi.Sensor):
    shape: mi.Shape | None = sensor.get_shape()
    meter = called(sensor)
    if shape is None:
        raise UsageError(
            f"{meter} is on no shape; nest it in the shape whose irradiance it measures, for example in a "
            "rectangle"
        )
    if number(shape.sample_position(0, mi.Point2f(0.5)).pdf) == 0:
        raise UnsupportedError(
            f"{meter} is on a {shape.class_name()} ({named(shape)}), of which Mitsuba samples no points; put "
            "it on another shape"
        )
    if not number(shape.surface_area()) > 0:
        raise UsageError(f"{meter} is on a shape without area ({named(shape)}); give the shape some")
    check_to_world(shape, meter)


def _check_numbers(sensor: mi.Sensor):
    """Raise ``UsageError`` for non-finite parameters and singular transformations."""
    for name, value in _numbers(sensor).items():
        if not math.isfinite(value):
            raise UsageError(f"{name}={value} of {called(sensor)} must be finite; give another number")
    matrix = world_matrix(sensor)
    if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix[:3, :3]) < 3:
        raise UsageError(
            f"to_world of {called(sensor)} is not finite, or cannot be inverted ({_rows(matrix)}); give it a "
            "direction that is not zero and a scale that is not 0"
        )
    focus = number(sensor.focus_distance()) if sensor.class_name() == "ThinLensCamera" else 1
    if not focus > 0:
        raise UsageError(
            f"focus_distance={focus:g} of {called(sensor)} must be greater than 0: it is the "
            "distance of the plane that is in focus"
        )


def _numbers(sensor: mi.Sensor) -> dict[str, float]:
    found = own_parameters(sensor)
    return {k: number(v) for k, v in found.items() if isinstance(v, float) or type(v) is mi.Float}


def _rows(matrix: np.ndarray) -> str:
    return "; ".join(" ".join(f"{x:g}" for x in row) for row in matrix[:3])


def rays_of(sensor: mi.Sensor, film: mi.Point2f, lens: mi.Point2f) -> tuple[np.ndarray, np.ndarray, mi.Ray3f]:
    """Origins and directions (3, n), and the camera rays; ``UsageError`` if one is not finite."""
    ray, _ = sensor.sample_ray(0, 0.5, film, lens)
    o, d = (np.array(v, dtype=np.float64) for v in (ray.o, ray.d))
    if not (np.isfinite(o).all() and np.isfinite(d).all() and d.any(axis=0).all()):
        raise UsageError(f"camera rays of {called(sensor)} are not finite; look at {_parameters(sensor)}")
    return o, d, ray


def inverse(matrix: np.ndarray, sensor: mi.Sensor) -> np.ndarray:
    """Inverse of a matrix of camera rays; raises ``UsageError`` if it is singular."""
    if np.linalg.matrix_rank(matrix) < len(matrix):
        raise UsageError(
            f"all camera rays of {called(sensor)} are the same in single precision; look at "
            f"{_parameters(sensor)}"
        )
    return np.linalg.inv(matrix)


def _parameters(sensor: mi.Sensor) -> str:
    numbers = [f"{name}={value:g}" for name, value in _numbers(sensor).items()]
    return ", ".join([*numbers, f"to_world=({_rows(world_matrix(sensor))})"])


def check_rays(sensor: mi.Sensor):
    """Raise an error if Mitsuba generates no finite camera rays for ``sensor``."""
    u = mi.Point2f(*(mi.Float((np.arange(_TRIED) * step + 0.5) % 1) for step in (0.5698403, 0.7548777)))
    try:
        ray, weight = sensor.sample_ray_differential(0, 0.5, u, mi.Point2f(u.y, u.x))
    except RuntimeError as error:
        if "not implemented" not in str(error):
            raise
        raise UnsupportedError(f"Mitsuba makes no camera rays of {called(sensor)}: {error}") from error
    parts = [*ray.o, *ray.d, *mi.unpolarized_spectrum(weight)]
    finite = np.all([np.isfinite(np.broadcast_to(np.array(mi.Float(x)), _TRIED)) for x in parts], axis=0)
    if not finite.any():
        raise UsageError(
            f"camera rays of {called(sensor)} are not finite, or their weights are not; look at its "
            "parameters (of a distant sensor: at the area of its target)"
        )
