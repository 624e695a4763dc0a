"""Warns of unsampled light of delta emitters that falls on a sensor with area.

It arrives directly or by delta events (mirrors, glass). Camera subpaths do not hit such an emitter and
next-event estimation starts at a surface: only (1,1), of direct light, and t = 0 sample it. Without them,
shadow rays or light subpaths find the emitters whose light arrives.
"""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import rays
from ..host.jit import evaluated_mode, gc_paused
from ..sampling.points import Purpose
from ..scene.prepared import PreparedScene
from ..sensors import checks, kinds
from ..sensors.records import CameraConnection, Sensor
from ..settings import Settings
from ..transport import subpaths, techniques
from ..transport.inputs import Kernel, Observer
from ..transport.photons import unsampled
from ..transport.plan import Plan
from .findings import SceneCache
from .possible import Rest, Start, UnsampledPaths, unsampled_paths
from .unsampled_light import NAMED, called, delta_kernel, points

# Points on the sensor to which each emitter is connected.
POINTS = 1 << 10

# Light subpaths tested for hits of a sensor: about two hit 10 cm^2 at a distance of 3 m from a lamp.
HITTING = 1 << 18


def warnings(prepared: PreparedScene, plan: Plan, settings: Settings, findings: SceneCache) -> list[str]:
    """Warnings about such light, direct and by delta events; empty if all is sampled."""
    unsampled = [paths for paths in unsampled_paths(prepared, plan, settings) if paths.rest is Rest.SENSOR]
    return [_warning(prepared, plan, settings, findings, paths) for paths in unsampled]


def _warning(prepared, plan, settings, findings, paths: UnsampledPaths) -> str:
    """Warning about light of ``paths`` that end at the sensor; empty if none arrives."""
    direct = Start.DIRECT_DELTA_EMITTER in paths.starts
    look = partial(_arriving, prepared, plan, settings, direct)
    key = direct, settings.max_depth, settings.hide_emitters
    found, _ = findings.find("missed direct light", key, look)
    if not found:
        return ""
    emitters = [prepared.emitters.objects[i] for i in found[:NAMED]]
    lamps = " and ".join(map(called, emitters)) + (" and others" if len(found) > NAMED else "")
    shine = "shines" if len(found) == 1 else "shine"
    how = "directly" if direct or not prepared.delta else "through glass or mirrors"
    why, remedy = _cause(prepared, plan, settings, paths.needs)
    sensor = checks.called(prepared.camera.sensor)
    return f"bdpt: not sampled: {lamps} {shine} {how} on {sensor} ({why}); {remedy}"


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
    return "the choice of strategies leaves out light subpaths", "set light_paths"


def _arriving(prepared: PreparedScene, plan: Plan, settings: Settings, direct: bool) -> tuple[int, ...]:
    """Indices of at most `NAMED` + 1 delta emitters whose light arrives at the sensor.

    Directly if ``direct``, else by delta events.
    """
    kernel, emitters = delta_kernel(prepared, plan, settings), prepared.emitters.objects
    found: set[int] = set()
    for view in _with_area(prepared):
        kernel.camera = view
        if direct:
            found |= {i for i in prepared.emitters.unhittable_connectible if _arrives(kernel, emitters[i])}
        elif prepared.emitters.traced:
            with gc_paused(), evaluated_mode(prepared.emitters.evaluated):
                arriving = unsampled.arriving(kernel, points("sobol"), HITTING)
            found |= set(np.flatnonzero(np.array(arriving)).tolist())
    return tuple(sorted(found)[: NAMED + 1])


def _with_area(prepared: PreparedScene) -> list[Sensor]:
    """The sensor, or the views of a batch, that have area and can be connected."""
    camera = prepared.camera
    views = checks.views(camera.sensor)
    found = [kinds.prepare(view, prepared.emitters.shape_errors, prepared.scene) for view in views]
    return [view for view in found or [camera] if view.connectible and not view.delta]


def _arrives(kernel: Kernel, emitter: mi.Emitter) -> bool:
    """Whether light of a delta ``emitter`` arrives at the kernel's sensor unoccluded."""
    index, drawn = mi.UInt64(dr.arange(mi.UInt32, POINTS)), points("sobol")
    stream, sensor = drawn.stream("light", index), kernel.camera
    u_lens, u_film = (drawn.draw_2d("light", stream, use) for use in (Purpose.LENS, Purpose.FILM))
    shared = subpaths.shared_by_lane(kernel.bound(drawn, 1.0, Observer()), stream, index)
    infinite = mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)
    seen_from = dr.zeros(mi.SurfaceInteraction3f, POINTS)
    ds, _ = emitter.sample_direction(seen_from, mi.Point2f(0.5))
    if infinite:
        connection = sensor.connect_direction(-ds.d, u_lens, u_film)
    else:
        connection = sensor.connect(ds.p, u_lens, u_film)
    seen_from.p, seen_from.time, seen_from.wavelengths = connection.p, shared.time, shared.wavelengths
    ds, weight = emitter.sample_direction(seen_from, mi.Point2f(0.5))
    lit = connection.valid & dr.any(mi.unpolarized_spectrum(weight) != 0)
    return bool(np.any(np.array(lit & ~_occluded(kernel, connection, ds, infinite, shared))))


def _occluded(kernel: Kernel, connection: CameraConnection, ds: mi.DirectionSample3f, infinite: bool, shared):
    """Mask: a surface blocks the edge."""
    if infinite:
        ray = rays.spawn(connection.anchor, -connection.d, shared)
        ray.maxt = connection.reach
    else:
        ray = rays.segment_to(connection.anchor, ds.p, shared)
    return techniques.hidden(kernel, ray, connection.valid)
