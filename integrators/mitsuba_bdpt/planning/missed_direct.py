"""Light of delta emitters that falls directly on a sensor with area and that no strategy in use samples.

Camera subpaths do not hit such an emitter and next-event estimation starts at a surface: only (1,1) and t = 0
sample it. Where a render does without both, the emitters whose light arrives are found with shadow rays.
"""

from __future__ import annotations

from functools import partial
from itertools import islice

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import rays
from ..scene.prepared import PreparedScene
from ..sensors import checks, kinds
from ..sensors.records import CameraJoin, Sensor
from ..settings import Settings
from ..transport.plan import Plan
from .findings import Findings
from .lost_light import NAMED, called, shared_sample
from .possible import Start, unreachable_paths

# Points of the sensor to which each emitter is connected.
POINTS = 1 << 10


def warning(prepared: PreparedScene, plan: Plan, settings: Settings, findings: Findings) -> str:
    """The warning about such light; empty if none is missing."""
    lost = unreachable_paths(prepared, plan, settings)
    if not any(Start.DIRECT_DELTA_EMITTER in paths.starts for paths in lost):
        return ""
    found, _ = findings.find("missed direct light", (), partial(_arriving, prepared))
    if not found:
        return ""
    emitters = [prepared.scene.emitters()[i] for i in found[:NAMED]]
    lamps = " and ".join(map(called, emitters)) + (" and others" if len(found) > NAMED else "")
    shine = "shines" if len(found) == 1 else "shine"
    why, remedy = _cause(prepared, plan, settings)
    sensor = checks.called(prepared.camera.sensor)
    return f"bdpt: {lamps} {shine} directly on {sensor}: this light is missing, because {why}; {remedy}"


def _cause(prepared: PreparedScene, plan: Plan, settings: Settings) -> tuple[str, str]:
    """Why (1,1) is not in use, and what to do."""
    if not prepared.camera.connectible:
        one_by_one = prepared.camera.sensor.class_name() == "BatchSensor"
        remedy = "render the views one by one" if one_by_one else "use an area light"
        return f"no light can be traced to the sensor: {prepared.camera.reason}", remedy
    if settings.light_paths == 0:
        return "light_paths=0 leaves out light subpaths", "leave light_paths at auto"
    for skipped in plan.skipped:
        if "(1,1)" in skipped["class"]:
            return skipped["why"], "mend that, or use an area light"
    return "decisions leave out light subpaths", "leave decisions to the integrator"


def _arriving(prepared: PreparedScene) -> tuple[int, ...]:
    """Indices of the first delta emitters whose light arrives at the sensor directly, `NAMED` + 1 at most."""
    views = _with_area(prepared)
    emitters = prepared.scene.emitters()
    arriving = (
        i
        for i in prepared.emitters.unhittable_connectible
        if any(_arrives(prepared, view, emitters[i]) for view in views)
    )
    return tuple(islice(arriving, NAMED + 1))


def _with_area(prepared: PreparedScene) -> list[Sensor]:
    """The sensor, or the views of a batch, as far as they have area and can be connected."""
    camera = prepared.camera
    if camera.connectible:
        return [camera]
    views = checks.views(camera.sensor)
    found = [kinds.prepare(view, prepared.emitters.shape_errors, prepared.scene) for view in views]
    return [view for view in found if view.connectible and not view.delta]


def _arrives(prepared: PreparedScene, sensor: Sensor, emitter: mi.Emitter) -> bool:
    """Whether light of a delta ``emitter`` arrives at the ``sensor`` unoccluded."""
    generator = mi.PCG32(POINTS)
    u_lens, u_film = (mi.Point2f(generator.next_float32(), generator.next_float32()) for _ in range(2))
    shared = shared_sample(prepared, generator)
    infinite = mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)
    seen_from = dr.zeros(mi.SurfaceInteraction3f, POINTS)
    ds, _ = emitter.sample_direction(seen_from, mi.Point2f(0.5))
    if infinite:
        join = sensor.join_direction(-ds.d, u_lens, u_film)
    else:
        join = sensor.join(ds.p, u_lens, u_film)
    seen_from.p, seen_from.time, seen_from.wavelengths = join.p, shared.time, shared.wavelengths
    ds, weight = emitter.sample_direction(seen_from, mi.Point2f(0.5))
    lit = join.valid & dr.any(mi.unpolarized_spectrum(weight) != 0)
    return bool(np.any(np.array(lit & ~_occluded(prepared, join, ds, infinite, shared))))


def _occluded(prepared: PreparedScene, join: CameraJoin, ds: mi.DirectionSample3f, infinite: bool, shared):
    """Mask: a surface is in between; none counts in scenes with media, whose boundaries are surfaces."""
    if prepared.space is not None:
        return mi.Bool(False)
    if infinite:
        ray = rays.spawn(join.anchor, -join.d, shared)
        ray.maxt = join.reach
    else:
        ray = rays.segment_to(join.anchor, ds.p, shared)
    return rays.occluded(prepared.scene, ray, join.valid)
