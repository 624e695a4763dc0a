"""Camera endpoints: the implementation for each kind of sensor."""

from __future__ import annotations

import mitsuba as mi

from ..errors import UnsupportedError
from ..geometry.rounding import ShapeErrors
from ..host.introspection import children, named
from . import cameras, checks
from .others import Distant, IrradianceMeter, Orthographic, RayOnlySensor
from .records import Sensor

# Sensors whose film has no border to sample, and why.
_WITHOUT_BORDER = {
    "BatchSensor": "has no meaning beside the views of a batch",
    "IrradianceMeter": "needs points beyond its shape",
}


def prepare(sensor: mi.Sensor, shape_errors: ShapeErrors, scene: mi.Scene) -> Sensor:
    """Return the sensor for one render; ``UnsupportedError`` for those that Mitsuba cannot render."""
    kind = sensor.class_name()
    if kind in _WITHOUT_BORDER and sensor.film().sample_border():
        text = f"film of {checks.called(sensor)} has sample_border, which {_WITHOUT_BORDER[kind]}"
        raise UnsupportedError(f"{text}; set it to false")
    if kind in cameras.KINDS:
        return cameras.Camera(sensor, [sensor])
    if kind == "OrthographicCamera":
        return Orthographic(sensor)
    if kind == "BatchSensor":
        return _batch(sensor, shape_errors)
    if kind == "IrradianceMeter":
        shape = sensor.get_shape()
        return IrradianceMeter(sensor, shape_errors, in_scene=any(shape is other for other in scene.shapes()))
    if kind == "RadianceMeter":
        return _by_rays(
            sensor, "a radiance meter has one ray, which a light vertex is on with probability zero"
        )
    if kind == "DistantSensorImpl":
        # Only the text of a distant sensor distinguishes its three kinds.
        if "target = none" in str(sensor):
            return Distant(sensor) if scene.shapes() else RayOnlySensor(sensor, "the scene has no surface")
        return _by_rays(sensor, "the target of a distant sensor is out of a plugin's reach")
    return _by_rays(sensor, f"of the class {kind} nothing but its camera rays is known")


def _by_rays(sensor: mi.Sensor, reason: str, views: list[mi.Sensor] | None = None) -> Sensor:
    """Return a sensor that uses its camera rays alone, after checking them."""
    for view in views or [sensor]:
        checks.check_rays(view)
    return RayOnlySensor(sensor, reason, views)


def _batch(sensor: mi.Sensor, shape_errors: ShapeErrors) -> Sensor:
    views = checks.views(sensor)
    if mi.is_spectral and any("srf" in children(view) for view in views):
        raise UnsupportedError(
            f"a view of batch sensor {named(sensor)} has an srf of its own, but wavelengths are "
            "sampled before the view is known; render the views one by one"
        )
    kinds = {view.class_name() for view in views}
    if len(kinds) == 1 and kinds <= set(cameras.KINDS):
        return cameras.Camera(sensor, views)
    if kinds == {"IrradianceMeter"}:
        return IrradianceMeter(sensor, shape_errors, views)
    why = "the views of the batch are not all perspective, all thinlens or all irradiance meters"
    return _by_rays(sensor, why, views)
