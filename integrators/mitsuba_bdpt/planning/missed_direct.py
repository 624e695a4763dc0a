"""Warns of unsampled light of delta emitters that falls on a sensor with area.

It arrives directly or by delta events (mirrors, glass). Camera subpaths do not hit such an emitter and
next-event estimation starts at a surface: only (1,1), of direct light, and t = 0 sample it. Without them,
shadow rays or light subpaths find the emitters whose light arrives.
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
from ..sensors.records import CameraConnection, Sensor
from ..settings import Settings
from ..transport.plan import Plan
from . import lost_light
from .findings import Findings
from .lost_light import NAMED, called, shared_sample
from .possible import Rest, Start, UnreachablePaths, unreachable_paths

# Points on the sensor to which each emitter is connected.
POINTS = 1 << 10


def warnings(prepared: PreparedScene, plan: Plan, settings: Settings, findings: Findings) -> list[str]:
    """Warnings about such light, direct and by delta events; empty if none is missing."""
    lost = [paths for paths in unreachable_paths(prepared, plan, settings) if paths.rest is Rest.SENSOR]
    return [_warning(prepared, plan, settings, findings, paths) for paths in lost]


def _warning(prepared, plan, settings, findings, paths: UnreachablePaths) -> str:
    """Warning about light of ``paths`` that end at the sensor; empty if none arrives."""
    direct = Start.DIRECT_DELTA_EMITTER in paths.starts
    look = partial(_arriving, prepared, direct, settings.max_depth)
    found, _ = findings.find("missed direct light", (direct, settings.max_depth), look)
    if not found:
        return ""
    emitters = [prepared.scene.emitters()[i] for i in found[:NAMED]]
    lamps = " and ".join(map(called, emitters)) + (" and others" if len(found) > NAMED else "")
    shine = "shines" if len(found) == 1 else "shine"
    how = "directly" if direct or not prepared.delta else "through glass or mirrors"
    why, remedy = _cause(prepared, plan, settings, paths.needs)
    sensor = checks.called(prepared.camera.sensor)
    return f"bdpt: {lamps} {shine} {how} on {sensor}: this light is missing, because {why}; {remedy}"


def _cause(prepared: PreparedScene, plan: Plan, settings: Settings, strategy: str) -> tuple[str, str]:
    """Why ``strategy`` is not in use, and the remedy."""
    is_batch = prepared.camera.sensor.class_name() == "BatchSensor"
    if not prepared.camera.connectible:
        remedy = "render the views one by one" if is_batch else "use an area light"
        return f"no light can be traced to the sensor: {prepared.camera.reason}", remedy
    if settings.light_paths == 0:
        return "light_paths=0 leaves out light subpaths", "leave light_paths at auto"
    for skipped in plan.skipped:
        if strategy in skipped["class"]:
            remedy = "render the views one by one" if is_batch else "mend that, or use an area light"
            return skipped["why"], remedy
    return "decisions leave out light subpaths", "leave decisions to the integrator"


def _arriving(prepared: PreparedScene, direct: bool, max_depth: int) -> tuple[int, ...]:
    """Indices of at most `NAMED` + 1 delta emitters whose light arrives at the sensor.

    Directly if ``direct``, else by delta events.
    """
    views = _with_area(prepared)
    if not direct:
        # `lost_light` supports neither media nor emitters without light subpaths.
        if prepared.space is not None or not prepared.emitters.traced:
            return ()
        found = {i for view in views for i in lost_light.arriving(prepared, view, max_depth)}
        return tuple(sorted(found)[: NAMED + 1])
    emitters = prepared.scene.emitters()
    arriving = (
        i
        for i in prepared.emitters.unhittable_connectible
        if any(_arrives(prepared, view, emitters[i]) for view in views)
    )
    return tuple(islice(arriving, NAMED + 1))


def _with_area(prepared: PreparedScene) -> list[Sensor]:
    """The sensor, or the views of a batch, that have area and can be connected."""
    camera = prepared.camera
    views = checks.views(camera.sensor)
    found = [kinds.prepare(view, prepared.emitters.shape_errors, prepared.scene) for view in views]
    return [view for view in found or [camera] if view.connectible and not view.delta]


def _arrives(prepared: PreparedScene, sensor: Sensor, emitter: mi.Emitter) -> bool:
    """Whether light of a delta ``emitter`` arrives at the ``sensor`` unoccluded."""
    generator = mi.PCG32(POINTS)
    u_lens, u_film = (mi.Point2f(generator.next_float32(), generator.next_float32()) for _ in range(2))
    shared = shared_sample(prepared, generator)
    infinite = mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)
    seen_from = dr.zeros(mi.SurfaceInteraction3f, POINTS)
    ds, _ = emitter.sample_direction(seen_from, mi.Point2f(0.5))
    if infinite:
        join = sensor.connect_direction(-ds.d, u_lens, u_film)
    else:
        join = sensor.connect(ds.p, u_lens, u_film)
    seen_from.p, seen_from.time, seen_from.wavelengths = join.p, shared.time, shared.wavelengths
    ds, weight = emitter.sample_direction(seen_from, mi.Point2f(0.5))
    lit = join.valid & dr.any(mi.unpolarized_spectrum(weight) != 0)
    return bool(np.any(np.array(lit & ~_occluded(prepared, join, ds, infinite, shared))))


def _occluded(
    prepared: PreparedScene, join: CameraConnection, ds: mi.DirectionSample3f, infinite: bool, shared
):
    """Mask: a surface blocks the edge; with media False, as boundaries are surfaces."""
    if prepared.space is not None:
        return mi.Bool(False)
    if infinite:
        ray = rays.spawn(join.anchor, -join.d, shared)
        ray.maxt = join.reach
    else:
        ray = rays.segment_to(join.anchor, ds.p, shared)
    return rays.occluded(prepared.scene, ray, join.valid)
