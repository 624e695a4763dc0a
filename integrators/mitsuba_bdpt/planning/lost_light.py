"""Estimates the share of an image's light on SDS paths that no strategy samples.

Such a path leaves a delta emitter, passes delta surfaces, one diffuse or glossy surface, delta surfaces, and
reaches the sensor; no two neighbouring vertices can be connected. `possible.unreachable_paths` decides
whether such paths are possible. The estimate is a small photon map: a few thousand subpaths from either end
that follow delta events only. It leaves out paths with several non-delta surfaces that are not neighbours,
and lamps seen in a mirror. Glossy surfaces count as diffuse with equal albedo.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import rays
from ..host import renamed
from ..host.jit import evaluated_mode, gc_paused
from ..host.notices import warn_once
from ..scene.prepared import PreparedScene
from ..sensors.records import Sensor
from ..settings import Settings
from ..transport import spectra
from ..transport.inputs import Shared
from ..transport.photons.photon import same_surface
from ..transport.plan import Plan
from .possible import Start, unreachable_paths

if TYPE_CHECKING:
    from drjit.auto.ad import PCG32  # Mitsuba's class, missing in its stubs

# Subpaths from either end, and the most that are compared of those that arrive. The noise of the estimate
# suffices for `WORTH_A_WORD`, not for a figure to rely on; see experiments, "Vertex merging".
SUBPATHS, COMPARED = 1 << 13, 1 << 11

# Light subpaths tested for hits of a sensor: about two hit 10 cm^2 at a distance of 3 m from a lamp.
HITTING = 1 << 18

# Most edges of a subpath of delta events (twelve panes).
LONGEST = 24

# Radius of the disk around a seen point in which photons count, in distances between such points: disks
# overlap, and remain small relative to the image.
RADIUS = 1.5

# Share of an image's light from which on a warning is given.
WORTH_A_WORD = 0.01

# Most lamps named in a message.
NAMED = 3

SEED = 0x6C6F7374

_PLUGINS = {
    "PointLight": "point light",
    "SpotLight": "spot",
    "Projector": "projector",
    "DirectionalEmitter": "directional light",
    "DirectionalArea": "directionalarea",
}


@dataclass
class _Ends:
    """Ends of subpaths: the first surface with a lobe that is not delta.

    ``p``: position; ``n``: geometric normal on the incident side; ``through``: the surface transmits;
    ``weight`` and ``reflectance`` as `_carried`; ``distance`` travelled (from the sensor: radius of the disk,
    see `_seen`); ``through_shape``: index of the first shape with a delta event.
    """

    p: mi.Point3f
    n: mi.Normal3f
    through: mi.Bool
    weight: mi.UnpolarizedSpectrum
    edges: mi.UInt32
    distance: mi.Float
    reflectance: mi.UnpolarizedSpectrum
    through_shape: mi.UInt32
    active: mi.Bool

    def some(self):
        """Return at most `COMPARED` active ends, their indices, and ends per returned end.

        The ends are None if there is none.
        """
        dr.eval(self)
        index = dr.compress(self.active)
        found = dr.width(index)
        if not found:
            return None, index, 0
        kept = min(found, COMPARED)
        place = dr.arange(mi.UInt64, kept) * dr.opaque(mi.UInt64, found) // dr.opaque(mi.UInt64, kept)
        index = dr.gather(mi.UInt32, index, mi.UInt32(place))
        ends = dr.gather(_Ends, self, index)
        dr.eval(ends, index)
        return ends, index, found / kept


@dataclass
class _Walk:
    """State of a subpath.

    Fields as in `_Ends`; ``distance``: travelled.
    """

    ray: mi.Ray3f
    weight: mi.UnpolarizedSpectrum
    edges: mi.UInt32
    distance: mi.Float
    through_shape: mi.UInt32
    active: mi.Bool


@dataclass(frozen=True)
class LostLight:
    """Unsampled light: mean over the film by emitter index.

    ``through``: ids of the shapes through which most of it is seen, the brightest first.
    """

    colours: dict[int, np.ndarray]
    through: tuple[str, ...] = ()

    @property
    def radiance(self) -> dict[int, float]:
        """Brightest colour of the sum, divided in proportion to each lamp's brightest."""
        single = {i: float(colour.max()) for i, colour in self.colours.items()}
        brightest = float(sum(self.colours.values()).max()) if single else 0.0
        scale = brightest / max(sum(single.values()), np.finfo(float).tiny)
        return {i: radiance * scale for i, radiance in single.items()}

    @property
    def intensity(self) -> float:
        """Mean over the colours, the measure of images in pilots."""
        return float(sum(colour.mean() for colour in self.colours.values()))


def is_possible(prepared: PreparedScene, plan: Plan, settings: Settings) -> bool:
    """Whether emitters, surfaces and sensor of the scene allow such paths."""
    if plan.arrival or not prepared.emitters.traced:  # the estimate traces light subpaths
        return False
    if plan.merging:  # which samples these paths
        return False
    if prepared.space is not None:  # the estimate does not support media
        return False
    lost = unreachable_paths(prepared, plan, settings)  # light without a vertex in between: `missed_direct`
    return any(Start.DIRECT_DELTA_EMITTER not in paths.starts for paths in lost)


def estimate(prepared: PreparedScene, plan: Plan, max_depth: int) -> LostLight:
    """Estimate the unsampled light.

    ``max_depth``: see `Settings`. Skips emitters whose estimate or emitted direction is non-finite and warns;
    the render itself may not meet that value.
    """
    total = np.zeros((len(prepared.scene.emitters()), len(mi.UnpolarizedSpectrum())))
    through: tuple[str, ...] = ()
    with gc_paused(), evaluated_mode(prepared.emitters.evaluated):
        points, _, times = _seen(prepared, plan, max_depth).some()
        if points is None:
            return LostLight({})
        light, lamp, astray = _lit(prepared, plan, max_depth)
        total[dr.gather(mi.UInt32, lamp, dr.compress(astray)).numpy()] = np.nan
        photons, index, more = light.some()
        if photons is not None:
            found, shapes = _meetings(photons, points, max_depth)
            found *= times * more / SUBPATHS**2
            lamps = dr.gather(mi.UInt32, lamp, index)
            dr.eval(found, shapes, lamps)
            through = _ids(shapes, found)
            for colour, values in zip(total.T, found, strict=True):
                colour += np.bincount(lamps.numpy(), values.numpy(), len(colour))
    finite = np.isfinite(total).all(axis=1)
    if not finite.all():
        _warn_of_not_finite(prepared, np.flatnonzero(~finite))
    total = np.where(finite[:, None], total, 0)
    return LostLight({int(i): total[i] for i in np.flatnonzero(total.any(axis=1))}, through)


def _ids(shapes: mi.UInt32, found: mi.UnpolarizedSpectrum) -> tuple[str, ...]:
    """Ids of at most `NAMED` ``shapes`` through which most of ``found`` is seen."""
    values = np.sum([np.array(colour) for colour in found], axis=0)
    amounts = np.bincount(shapes.numpy(), np.where(np.isfinite(values), values, 0))
    order = [i for i in np.argsort(-amounts) if i and amounts[i] >= WORTH_A_WORD * amounts.sum()]
    names = [dr.reinterpret_array(mi.ShapePtr, mi.UInt32(int(i)))[0].id() for i in order[:NAMED]]
    # Shapes without an id, and merged shapes, have none or one made up by Mitsuba.
    return tuple(name for name in names if name and not name.startswith("_unnamed_"))


def _warn_of_not_finite(prepared: PreparedScene, indices: np.ndarray):
    """Warn of emitters whose unsampled light cannot be estimated."""
    emitters = prepared.scene.emitters()
    lamps = " and ".join(called(emitters[i]) for i in indices[:NAMED])
    text = (
        f"bdpt: how much light of {lamps} is missing cannot be told, since the estimate is NaN or infinite; "
        "look for such numbers, or very large ones, in the lamp and in the BSDFs that its light meets"
    )
    warn_once(prepared.scene, prepared.camera.sensor, text)


def shares(lost: LostLight, mean: float) -> dict[int, float]:
    """Shares of the image's light by emitter index.

    ``mean`` of the image's brightest colour.
    """
    whole = mean + sum(lost.radiance.values())
    return {i: radiance / whole for i, radiance in lost.radiance.items()}


def predicted_shares(lost: LostLight, mean: float) -> dict[int, float]:
    """`shares` before the first pass, from the ``mean`` intensity of a pilot.

    Empty if their sum is below twice `WORTH_A_WORD`: a pilot's estimate may be twice too large.
    """
    share = lost.intensity / (mean + lost.intensity)
    if not share >= 2 * WORTH_A_WORD:
        return {}
    whole = sum(lost.radiance.values())
    return {i: share * radiance / whole for i, radiance in lost.radiance.items()}


def in_words(prepared: PreparedScene, plan: Plan, shares: dict[int, float], through: Iterable[str]) -> str:
    """Warning about missing light with its remedy; empty below `WORTH_A_WORD`.

    ``shares`` of the image's light by emitter index; ``through``: see `LostLight`.
    """
    lost = sum(shares.values())
    if not lost >= WORTH_A_WORD:
        return ""
    emitters = prepared.scene.emitters()
    order = sorted(shares, key=shares.get, reverse=True)
    lamps = [emitters[i] for i in order if shares[i] >= WORTH_A_WORD * lost][:NAMED]
    what = " and ".join(map(called, lamps)) + (" shine" if len(lamps) > 1 else " shines")
    what += " through glass or mirrors" if prepared.delta else " on what is seen"
    why, remedy = "a lamp without area cannot be found that way", _remedy(lamps)
    if plan.splat:
        what += f" on what is seen through {' and '.join(map(repr, through)) or 'them'}"
    elif not prepared.camera.connectible:
        why = f"no light can be traced to the sensor: {prepared.camera.reason}"
    else:
        why = "the render does without light tracing (t=1)"
        remedy = f"leave light_paths and decisions to the integrator, or {remedy}"
    share = "nearly all" if lost > 0.99 else f"about {100 * lost:.0f} %"
    return f"bdpt: {what}: this light, {share} of the image's, is missing, because {why}; {remedy}"


def called(emitter: mi.Emitter) -> str:
    """Name an emitter by its kind and nearest id."""
    kind, shape = _PLUGINS.get(emitter.class_name(), "emitter"), emitter.get_shape()
    if emitter.id():
        return f"{kind} '{emitter.id()}'"
    on_shape = shape is not None and shape.id()
    return f"the {kind} on shape '{shape.id()}'" if on_shape else f"a {kind} without id"


def _remedy(emitters: Iterable[mi.Emitter]) -> str:
    if any(emitter.class_name() == "DirectionalEmitter" for emitter in emitters):
        return "set merging=true, or give the sun a disk: sunsky, an envmap, or an area light far away"
    return "set merging=true, or give it a small area: an area light on a small sphere or disk"


def shared_sample(prepared: PreparedScene, generator: PCG32) -> Shared:
    """Sample time and wavelengths of subpaths."""
    sensor = prepared.camera.sensor
    time = sensor.shutter_open() + generator.next_float32() * sensor.shutter_open_time()
    if not mi.is_spectral:
        return Shared(time, mi.Color0f(), mi.UnpolarizedSpectrum(1), mi.Float(0.5))
    u = generator.next_float32()
    wavelengths, weight = sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), u)
    return Shared(time, wavelengths, mi.unpolarized_spectrum(weight), u)


def _two(generator: PCG32) -> mi.Point2f:
    return mi.Point2f(generator.next_float32(), generator.next_float32())


def _carried(value: mi.Spectrum):
    """Colour carried by a subpath.

    In spectral variants the mean over its wavelengths, since the other end has different ones.
    """
    colour = mi.unpolarized_spectrum(value)
    return dr.mean(colour) + dr.zeros(mi.UnpolarizedSpectrum) if mi.is_spectral else colour


def _lit(prepared: PreparedScene, plan: Plan, max_depth: int) -> tuple[_Ends, mi.UInt32, mi.Bool]:
    """Where light of delta emitters arrives that next-event estimation does not find.

    Also the emitters' indices, and the mask of subpaths with a non-finite ray, which hit nothing.
    """
    ray, weight, active, beam, index, generator = _emitted(prepared, SUBPATHS)
    astray = active & ~(dr.all(dr.isfinite(ray.o)) & dr.all(dr.isfinite(ray.d)))
    ends = _follow(prepared, ray, weight, active, generator, max_depth, True)
    if plan.direct:
        ends.active &= (ends.edges > 1) | beam
    return ends, index, astray


def _emitted(prepared: PreparedScene, count: int):
    """Sample the first rays of ``count`` light subpaths.

    Returns rays, weights, masks of delta emitters and of beams, emitter indices, and the generator.
    """
    generator = mi.PCG32(count, SEED, 1)
    shared = shared_sample(prepared, generator)
    e = prepared.emitters.sample_emission(_two(generator), _two(generator), shared, mi.Bool(True))
    active = e.delta & ~spectra.is_zero(e.weight)  # non-finite values are kept for the warning
    ray, beam = rays.spawn(e.anchor, e.d, shared), mi.Bool(e.beam)
    weight, index = mi.UnpolarizedSpectrum(mi.unpolarized_spectrum(e.weight)), e.index
    ray.maxt = dr.full(mi.Float, dr.inf, count)  # as wide as the sensor's, for the same kernel
    dr.make_opaque(ray, weight, active, beam, index, generator)
    return ray, weight, active, beam, index, generator


def arriving(prepared: PreparedScene, sensor: Sensor, max_depth: int) -> list[int]:
    """Indices of the delta emitters with light on ``sensor`` by delta events only.

    Includes direct light only of beams.
    """
    with gc_paused(), evaluated_mode(prepared.emitters.evaluated):
        ray, weight, active, beam, index, generator = _emitted(prepared, HITTING)
        found = _follow(prepared, ray, weight, active, generator, max_depth, True, sensor)
        hits = found.active & ((found.edges > 1) | beam)
        return np.unique(dr.gather(mi.UInt32, index, dr.compress(hits)).numpy()).tolist()


def _seen(prepared: PreparedScene, plan: Plan, max_depth: int) -> _Ends:
    """Points seen through delta events that t = 1 does not sample.

    Weights multiply irradiance; distances are the radii of the points' disks.
    """
    generator = mi.PCG32(SUBPATHS, SEED, 2)
    shared, camera = shared_sample(prepared, generator), prepared.camera
    pixels = int(camera.region.size.prod())
    place = (dr.arange(mi.Float, SUBPATHS) + generator.next_float32()) * dr.opaque(
        mi.Float, pixels / SUBPATHS
    )
    pixel = camera.region.pixel(dr.minimum(mi.UInt32(place), pixels - 1))
    start = camera.start(pixel, _two(generator), _two(generator), shared)
    ray, pdf_w = mi.Ray3f(start.ray), mi.Float(start.pdf_w)
    weight = mi.unpolarized_spectrum(start.weight) * dr.opaque(mi.UnpolarizedSpectrum, 1, SUBPATHS)
    active = dr.full(mi.Bool, True, SUBPATHS)
    dr.make_opaque(ray, weight, active, pdf_w, generator)
    ends = _follow(prepared, ray, weight, active, generator, max_depth, False)
    if plan.splat:
        ends.active &= ends.edges > 1
    ends.weight *= ends.reflectance * dr.inv_pi
    across = RADIUS * dr.rsqrt(pdf_w * SUBPATHS)
    ends.distance = across if camera.parallel else across * ends.distance
    return ends


def _follow(
    prepared: PreparedScene,
    ray: mi.Ray3f,
    weight: mi.UnpolarizedSpectrum,
    active: mi.Bool,
    generator: PCG32,
    max_depth: int,
    adjoint: bool,
    sensor: Sensor | None = None,
) -> _Ends:
    """Follow rays by delta events to the first surface with another lobe.

    Traces intensity only. Chooses with probability 1/2 where a surface has both. One kernel for both sides.
    With a ``sensor``: follows rays to where they hit it.
    """
    context = mi.BSDFContext(mi.TransportMode.Radiance, +mi.BSDFFlags.Delta)
    last, is_adjoint = dr.opaque(mi.UInt32, min(max_depth, LONGEST)), dr.opaque(mi.Bool, adjoint)

    def body(walk: _Walk, generator: PCG32, ends: _Ends) -> tuple[_Walk, PCG32, _Ends]:
        ray, weight = walk.ray, walk.weight
        si = prepared.scene.ray_intersect(ray, renamed.hit_flags(), coherent=False, active=walk.active)
        active = walk.active & si.is_valid()
        distance = walk.distance + dr.select(active, si.t, 0)
        surface = si.bsdf()
        smooth, delta = (_has(surface, kind) for kind in (mi.BSDFFlags.Smooth, mi.BSDFFlags.Delta))
        both = active & smooth & delta
        here = active & smooth & (~both | (generator.next_float32() < 0.5))
        weight = dr.select(both, weight * 2, weight)
        if sensor is not None:
            here = _hits(sensor, ray, si, walk.active)
        reflectance = _reflectance(si, surface, generator, here)
        arrived = replace(walk, weight=weight, distance=distance, active=here)
        end = _end(si, surface, arrived, reflectance)
        if sensor is not None:
            end.active = here
        ends = dr.select(here, end, ends)
        active = active & ~here & delta & (walk.edges < last)
        first = active & (walk.edges == 1)
        through = dr.select(first, dr.reinterpret_array(mi.UInt32, si.shape), walk.through_shape)
        bs, factor = surface.sample(context, si, generator.next_float32(), _two(generator), active)
        active &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        factor = mi.unpolarized_spectrum(factor)
        factor *= dr.select(is_adjoint, dr.square(bs.eta), 1)  # refraction scales radiance only
        weight = dr.select(active, weight * factor, weight)
        active &= ~spectra.is_zero(weight)
        anchor = rays.surface_anchor(si, ray, prepared.emitters.shape_errors)
        edges = walk.edges + dr.select(active, mi.UInt32(1), 0)
        ray = rays.spawn(anchor, si.to_world(bs.wo), ray)
        return _Walk(ray, weight, edges, distance, through, active), generator, ends

    walk = _Walk(ray, weight, mi.UInt32(1), mi.Float(0), mi.UInt32(0), active)
    *_, ends = dr.while_loop(
        (walk, generator, _nowhere()), lambda walk, *_: walk.active, body, label="delta events"
    )
    dr.eval(ends)
    return ends


def _hits(sensor: Sensor, ray: mi.Ray3f, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
    """Mask: the last edge, after a delta event or from a beam, hits ``sensor``."""
    cos = dr.abs(dr.dot(si.n, ray.d))
    walk = SimpleNamespace(previous=ray.o, d=ray.d, pi=si, active=active)
    vertex = SimpleNamespace(si=si, hit=active & si.is_valid(), cos=cos)
    return sensor.hit(walk, vertex, mi.Bool(False)).active


def _nowhere() -> _Ends:
    no = mi.Bool(False)
    black = mi.UnpolarizedSpectrum(0)
    none = mi.UInt32(0)
    return _Ends(mi.Point3f(0), mi.Normal3f(0), no, black, mi.UInt32(0), mi.Float(0), black, none, no)


def _reflectance(si: mi.SurfaceInteraction3f, surface: mi.BSDFPtr, generator: PCG32, active: mi.Bool):
    """Albedo of a surface for the direction from which ``si`` is seen.

    Evaluated for diffuse BSDFs; of others a one-sample estimate.
    """
    even = mi.unpolarized_spectrum(surface.eval_diffuse_reflectance(si, active))
    flags = mi.BSDFFlags.Smooth
    context = mi.BSDFContext(mi.TransportMode.Radiance, +flags)
    _, glossy = surface.sample(context, si, generator.next_float32(), _two(generator), active)
    diffuse = _has(surface, mi.BSDFFlags.Diffuse)
    # Mitsuba's default of `eval_diffuse_reflectance` is a BSDF value in one direction, which is unbounded.
    return _carried(dr.select(diffuse, dr.minimum(even, 1), mi.unpolarized_spectrum(glossy)))


def _end(
    si: mi.SurfaceInteraction3f, surface: mi.BSDFPtr, walk: _Walk, reflectance: mi.UnpolarizedSpectrum
) -> _Ends:
    """The end of a subpath at ``si``."""
    kinds = (mi.BSDFFlags.DiffuseTransmission, mi.BSDFFlags.GlossyTransmission)
    front, back = (_has(surface, side) for side in (mi.BSDFFlags.FrontSide, mi.BSDFFlags.BackSide))
    seen = dr.select(mi.Frame3f.cos_theta(si.wi) > 0, front, back)  # most BSDFs are black on the other side
    # `mask` returns the reflectance of its nested BSDF.
    opacity = 1 - mi.unpolarized_spectrum(surface.eval_null_transmission(si, walk.active))
    return _Ends(
        p=mi.Point3f(si.p),
        n=mi.Normal3f(dr.mulsign(si.n, -dr.dot(si.n, walk.ray.d))),
        through=_has(surface, kinds[0]) | _has(surface, kinds[1]),
        weight=_carried(walk.weight),
        edges=walk.edges,
        distance=walk.distance,
        reflectance=reflectance * opacity,
        through_shape=walk.through_shape,
        active=walk.active & seen,
    )


def _has(surface: mi.BSDFPtr, kind: mi.BSDFFlags):
    return mi.has_flag(surface.flags(), kind)


def _meetings(photons: _Ends, points: _Ends, max_depth: int):
    """Contribution of each photon to the points around it, and a shape in between."""
    count = dr.opaque(mi.UInt32, dr.width(points.p))
    longest = dr.opaque(mi.UInt32, max_depth)

    def body(
        i: mi.UInt32, total: mi.UnpolarizedSpectrum, shape: mi.UInt32
    ) -> tuple[mi.UInt32, mi.UnpolarizedSpectrum, mi.UInt32]:
        point = dr.gather(_Ends, points, i)
        same = same_surface(point.n, photons.n) | (point.through & same_surface(-point.n, photons.n))
        r2 = dr.square(point.distance)
        near = (dr.squared_norm(point.p - photons.p) < r2) & same
        near &= point.edges + photons.edges <= longest
        shape = dr.select(near, point.through_shape, shape)
        return i + 1, total + dr.select(near, point.weight / (dr.pi * r2), 0), shape

    width = dr.width(photons.p)
    state = mi.UInt32(0), dr.zeros(mi.UnpolarizedSpectrum, width), dr.zeros(mi.UInt32, width)
    _, total, shape = dr.while_loop(state, lambda i, *_: i < count, body, label="meetings")
    # A photon without neighbours contributes 0 even if its weight is non-finite.
    return dr.select(spectra.is_zero(total), 0, total * photons.weight), shape
