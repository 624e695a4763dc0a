"""Starts of both subpaths: time, wavelengths, endpoint, first edge, partial sums.

The state of a subpath is a `walk.Walk`; what is constant along it a `walk.Side`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import rays
from ..sampling.points import Purpose, Stream
from ..sensors.records import CameraStart
from . import mis, spectra, techniques
from .batch import Places
from .inputs import Shared, TraceContext
from .sds import PhotonStrategy
from .walk import Side, Walk, not_finite


@dataclass
class CameraSample:
    """A camera sample; ``covered``: it exists; ``strip``: see `Places.strip`."""

    start: CameraStart
    stream: Stream
    u_lens: mi.Point2f
    covered: mi.Bool
    strip: mi.UInt32


def begin_lane(kernel: TraceContext, index: mi.UInt64) -> tuple[Stream, Shared]:
    """Random numbers of the light subpath ``index``, and time and wavelengths of its lane's subpaths."""
    sensor, points = kernel.camera.sensor, kernel.points
    stream = points.stream("light", index)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        u = points.draw_1d("light", stream, Purpose.TIME)
        time += u * sensor.shutter_open_time()
    if not mi.is_spectral:
        return stream, Shared(time, mi.Color0f(), mi.UnpolarizedSpectrum(1), mi.Float(0.5))
    number = None
    if kernel.sds.wavelengths is None:
        u = points.draw_1d("light", stream, Purpose.WAVELENGTH)
    else:
        number = kernel.sds.wavelengths.number(index)
        u = kernel.sds.wavelengths.u(number)
    wavelengths, weight = sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), u)
    return stream, Shared(time, wavelengths, mi.unpolarized_spectrum(weight), u, number)


# -- the light subpath -------------------------------------------------------------------------


def emission(kernel: TraceContext, stream, shared):
    """Sample y_0 and the first direction, an `emitters.Emission`."""
    points = kernel.points
    e = kernel.emitters.sample_emission(
        points.draw_2d("light", stream, Purpose.EMISSION_POINT),
        points.draw_2d("light", stream, Purpose.EMISSION_DIRECTION),
        shared,
        mi.Bool(True),
    )
    if kernel.light_media is not None and kernel.light_media.hides_infinity:
        e = replace(e, weight=dr.select(e.infinite, 0, e.weight))
    kernel.observer.emitted(e)
    return e


def light_subpath(kernel: TraceContext, e, stream, shared, sds: PhotonStrategy) -> tuple[Walk, Side]:
    """A light subpath on its first edge (eqs. 31, 32); ``sds``: the strategy beside t = 0 on SDS paths."""
    h = kernel.heuristic
    active = ~spectra.is_zero(e.weight) & (kernel.last_light >= 1)
    broken = not_finite(active, e.weight)
    active &= ~broken
    inverse_pdf = dr.rcp(e.pdf_first * e.pdf_second)
    ray = rays.spawn(e.anchor, e.d, shared)
    pi = kernel.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    # s = 0, which samples y_0 by a hit, is an older alternative.
    hit = h.scale(h.start(dr.select(e.delta, 0, e.cos * inverse_pdf)), kernel.kappa.hit)
    partial = mis.Partial(h.start(inverse_pdf), h.present(hit))
    edge = kernel.space.begin(kernel, "light", stream, ray, e)
    walk = Walk.begin(kernel, pi, ray, e.si.p, mi.Spectrum(e.weight), partial, active, edge)
    return sds.begin_light(kernel, replace(walk, broken=broken)), Side(
        "light",
        stream,
        shared,
        True,
        kernel.last_light,
        sds,
        complete=lambda si, first: kernel.emitters.connection_density(e, si, first),
        connect=(lambda y: techniques.look_at_sensor(kernel, y, stream)) if kernel.plan.splat else None,
    )


# -- a camera subpath --------------------------------------------------------------------------


def camera_subpath(
    kernel: TraceContext, place: Places, shared, slot, active, alpha=False
) -> tuple[CameraSample, Walk, Side]:
    """Sample z_0 and the first direction; returns the sample, and its camera subpath on the first edge."""
    points = kernel.points
    stream = points.stream("camera", place.index(slot))
    u_film = points.draw_2d("camera", stream, Purpose.FILM)
    u_lens = mi.Point2f(0.5)
    if kernel.camera.needs_aperture_sample:
        u_lens = points.draw_2d("camera", stream, Purpose.APERTURE)
    start = kernel.camera.start(place.pixel(slot), u_film, u_lens, shared)
    sample = CameraSample(start, stream, u_lens, active, place.strip(slot))
    active = active & (kernel.max_depth >= 1)  # `&=` would also change the sample's
    walk = _camera_walk(kernel, sample, active)
    side = Side(
        "camera",
        stream,
        shared,
        False,
        kernel.max_depth,
        kernel.sds,
        alpha=alpha,
        connect=(lambda z: techniques.choose_emitter(kernel, z, stream)) if kernel.plan.direct else None,
    )
    return sample, walk, side


def _camera_walk(kernel: TraceContext, sample: CameraSample, active) -> Walk:
    start, ray = sample.start, sample.start.ray
    edge = kernel.space.begin(kernel, "camera", sample.stream, ray)
    if kernel.plan.hide_emitters and edge is None:
        pi, ray = rays.intersect_past_emitters(kernel.scene, kernel.shape_errors, ray, active, coherent=True)
    else:
        pi = kernel.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    partial = _first_partial(kernel, start)
    walk = Walk.begin(kernel, pi, ray, start.p, mi.Spectrum(start.weight), partial, active, edge)
    return kernel.sds.begin_camera(kernel, walk)


def _first_partial(kernel: TraceContext, start):
    """Partial sums of a camera subpath's first edge (eqs. 31, 32): t = 1 is newest, t = 0 older."""
    h = kernel.heuristic
    arrival = h.scale(h.start(start.arrival), kernel.kappa.arrival)
    if not (mis.is_absent(kernel.kappa.splat) and mis.is_absent(kernel.kappa.inner)):
        arrival = h.present(arrival)
    return mis.Partial(h.start(dr.rcp(start.pdf_w)), arrival)
