"""Checks of the arguments of a render."""

from __future__ import annotations

import mitsuba as mi

from ..errors import UsageError, UsageTypeError
from ..host.introspection import named
from ..properties import integer, is_index
from .schedule import REPLICATES
from .snapshot import Snapshot


def check_made_for(integrator, scene):
    """Raise ``UsageTypeError`` unless ``scene`` is a scene, and both are of the present variant."""
    if type(scene).__name__ != mi.Scene.__name__:
        raise UsageTypeError(f"scene={type(scene).__name__} must be a scene, of mi.load_file or mi.load_dict")
    for name, thing, kind in (("integrator", integrator, mi.Integrator), ("scene", scene, mi.Scene)):
        if not isinstance(thing, kind):
            raise UsageTypeError(
                f"{name}={type(thing).__name__} was not loaded under the present variant "
                f"{mi.variant()}; load it again after mi.set_variant"
            )


def check_resumable(start):
    """Raise `UsageError` or `UsageTypeError` if ``start`` cannot be continued."""
    if not isinstance(start, Snapshot):
        raise UsageTypeError(f"start={type(start).__name__} must be a snapshot from a PassReport")
    if not start.progress.whole:
        raise UsageError("start=... was joined or reduced for joining; only assemble() can use it")


def resolve_sensor(scene, sensor):
    """Return the sensor for an index or a sensor; raises `UsageError` and `UsageTypeError`."""
    if isinstance(sensor, mi.Sensor):
        return sensor
    if not is_index(sensor):
        raise UsageTypeError(f"sensor={sensor!r} must be an index or one of scene.sensors()")
    sensors = scene.sensors()
    if not sensors:
        raise UsageError("the scene has no sensor; add one, for example of type perspective")
    if not 0 <= sensor < len(sensors):
        raise UsageError(f"sensor={sensor} does not exist; the scene has {len(sensors)} sensor(s)")
    return sensors[int(sensor)]


def samples_per_pixel(sensor, spp, settings) -> int:
    """Return the samples per pixel for the argument ``spp``; 0 is the sampler's count."""
    spp = integer(spp, "spp", 0) or int(sensor.sampler().sample_count())
    if not spp:
        raise UsageError(
            f"spp=0 stands for the sample_count of the sampler of sensor {named(sensor)}, which is 0 "
            "too; set one of them to 1 or more"
        )
    if settings.variance and spp < REPLICATES:
        of = "layers=variance" if "variance" in settings.layers else f"target_error={settings.target_error:g}"
        raise UsageError(
            f"{of} with spp={spp} is not possible; the variance needs at least {REPLICATES} "
            "samples per pixel, one for each replicate (independent part of the render)"
        )
    return spp
