"""A path found anew from its vertices, with Mitsuba's own calls alone, and the densities of all strategies.
Rays are aimed at the next vertex where a strategy may connect vertices, and go where the BSDF sends them at
delta events. Densities by `oracle`; those of emitters are the plugin's, but of directional ones the closed
form of `endpoints`."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_bdpt.host.introspection import world_matrix
from mitsuba_bdpt.measure.scenes import has_media
from mitsuba_bdpt.transport import draws

from . import endpoints, oracle

# Lobes of a delta BSDF are looked for with these numbers; a direction is the same up to this cosine, a vertex
# is the same up to this part of the edge to it.
LOBES, SAME_DIRECTION, SAME_PLACE = (1e-4, 1 - 1e-4, 0.5, 0.2, 0.8), 1 - 1e-5, 1e-2

# Rays start so far on the way to the next vertex: Mitsuba's own offset is too large for short edges.
STEP = 1e-3


class Lost(ValueError):
    """The path cannot be found anew; the text says where it differs."""


@dataclass(frozen=True)
class Rebuilt:
    """``f``: three colours, without the factors that change directions to areas. Of the k + 2 strategies, s =
    0 first, ``log_p`` over these factors as the weights compare them, and ``log_turned``, the logarithm of
    what their delta events on the light side add to f / p: these count in solid angle on the light's side, a
    light subpath has them on the camera's."""

    f: np.ndarray
    log_p: np.ndarray
    log_turned: np.ndarray

    def estimate(self, s: int) -> np.ndarray:
        """f / p of a strategy."""
        return self.f * np.exp(self.log_turned[s] - self.log_p[s])

    def relative(self, s: int) -> np.ndarray:
        """Densities of all strategies over that of one."""
        return _ratios(self.log_p - self.log_turned, s)

    def compared(self, s: int) -> np.ndarray:
        """As the weights see them: both solid angles of a refraction are equal (Georgiev, eqs. 53, 54)."""
        return _ratios(self.log_p, s)


def _ratios(log_p, s: int) -> np.ndarray:
    return np.exp(np.minimum(log_p - log_p[s], 700))


@dataclass(frozen=True)
class _Event:
    """f cos (of delta events over their probability), densities of going on to the light and to the camera,
    cosines with the geometric normal on the two sides, solid angle of a delta event on the camera's side over
    that on the light's (``turned``)."""

    value: np.ndarray
    to_light: float
    to_camera: float
    cos_light: float
    cos_camera: float
    turned: float


@dataclass(frozen=True)
class _Source:
    """The emitter's end: ``radiance`` (irradiance of a directional one), cosine with the geometric normal;
    ``kind`` and densities as in `oracle.Paths`."""

    radiance: np.ndarray
    kind: int
    cos: float
    first: float
    second: float
    direct: float


def rebuild(scene, emitters, path) -> Rebuilt:
    """The `recording.Path` found anew; ``emitters`` of the render know their densities. Raises `Lost`, always
    in media."""
    for i in range(1, len(path.p) - 1):
        if not path.shapes[i]:
            raise Lost(f"vertex {i} lies in a medium, where paths are not followed")
    if has_media(scene):
        raise Lost("the scene has media, through which edges are not followed")
    events, end = _follow(scene, path)
    hit = int(dr.reinterpret_array(mi.UInt32, end.emitter(scene))[0]) != 0
    source = _hit_source(scene, emitters, path, end) if hit else _directional_source(scene, emitters, path)
    radiance = source.radiance
    if not radiance.any():
        raise Lost("the last vertex emits nothing")
    paths, sensor = _densities(scene, path, events, source)
    log_p = oracle.log_densities(paths)[0]
    to_area = np.log(paths.cos_light[0]) - np.log(paths.dist2[0])
    if path.infinite:
        to_area[0] = 0
    log_f = to_area.sum() + sensor
    # Of the events at x_1 ... x_{s-1}: where a strategy joins vertices they are 1.
    log_turned = np.cumsum([0, 0, *(np.log(e.turned) for e in events[::-1]), 0])
    return Rebuilt(radiance * np.prod([e.value for e in events], axis=0), log_p - log_f, log_turned)


def _follow(scene, path):
    """The `_Event` of each inner vertex, z_1 first, and where the last ray ends."""
    k = len(path.p) - 1
    ray = mi.Ray3f(_point(path.p[0]), _vector(_direction(path, 0)))
    events = []
    for i in range(1, k):
        si = scene.ray_intersect(ray)
        dr.eval(si)
        _check_place(si, path, i)
        event, d = _scatter(si, _direction(path, i), path.delta[i], i)
        events.append(event)
        # From the vertex that was written down, so that a chain of reflections does not enlarge the rounding.
        length = 1.0 if path.infinite and i == k - 1 else np.linalg.norm(path.p[i + 1] - path.p[i])
        ray = mi.Ray3f(_point(path.p[i]) + d * dr.opaque(mi.Float, STEP * length), d)
    end = scene.ray_intersect(ray)
    dr.eval(end)
    if not path.infinite:
        _check_place(end, path, k)
    elif bool(end.is_valid()[0]):
        raise Lost("a shape is in the way of light from infinity")
    return events, end


def _hit_source(scene, emitters, path, end) -> _Source:
    radiance = np.array(end.emitter(scene).eval(end), dtype=float).ravel()
    cos = 1.0 if path.infinite else float(dr.abs(dr.dot(end.n, end.to_world(end.wi)))[0])
    densities = emitters.hit_densities(end, _point(path.p[-2]), mi.Bool(True))
    dr.eval(densities)
    connect, first, second = (float(x[0]) for x in densities)
    dist2 = np.sum((path.p[-1] - path.p[-2]) ** 2)
    direct = connect if path.infinite else connect * dist2 / cos
    kind = oracle.ENVIRONMENT if path.infinite else oracle.AREA
    return _Source(radiance, kind, cos, first, second, direct)


def _directional_source(scene, emitters, path) -> _Source:
    """By its direction: no ray can meet it."""
    it = dr.zeros(mi.Interaction3f)
    it.p = _point(path.p[-2])
    for lamp in endpoints.lamps_of(scene) if path.infinite else ():
        if lamp.kind != oracle.DIRECTIONAL:
            continue
        ds, irradiance = lamp.emitter.sample_direction(it, mi.Point2f(0.5))
        dr.eval(ds.d, irradiance)
        if np.array(ds.d).ravel() @ _direction(path, len(path.p) - 2) < SAME_DIRECTION:
            continue
        x1, d = path.p[-2][None].astype(float), -path.p[-1][None].astype(float)
        disks = endpoints.disks_of(emitters.disks)
        one = np.ones(1)
        densities = lamp.first(d), lamp.second(one, x1, d, disks), lamp.direct(one, one, x1, d)
        return _Source(np.array(irradiance, dtype=float).ravel(), lamp.kind, 1.0, *(x[0] for x in densities))
    raise Lost("the last vertex is on no emitter that can be hit, nor in the direction of one")


def _direction(path, i: int):
    last = path.infinite and i == len(path.p) - 2
    d = path.p[-1] if last else path.p[i + 1] - path.p[i]
    return d / np.linalg.norm(d)


def _check_place(si, path, i: int):
    end = ", where the emitter is (one without area cannot be hit)" if i == len(path.p) - 1 else ""
    if not bool(si.is_valid()[0]):
        raise Lost(f"nothing is hit at vertex {i}{end}")
    edge = np.linalg.norm(path.p[i] - path.p[i - 1])
    off = np.linalg.norm(np.array(si.p).ravel() - path.p[i]) / edge
    if off > SAME_PLACE:
        raise Lost(f"vertex {i} is off by {off:.2g} of the edge to it{end}")


def _scatter(si, d, delta: bool, i: int):
    """The `_Event` at a vertex that goes on along ``d``, and the direction in which it really goes on."""
    ctx, bsdf, wo = mi.BSDFContext(), si.bsdf(), si.to_local(_vector(d))
    to_light = to_camera = turned = 1.0
    if delta:
        wo, value, turned = _lobe(bsdf[0], si, wo, i)
    else:
        back = mi.SurfaceInteraction3f(si)
        back.wi = wo
        value, *pdfs = bsdf.eval(ctx, si, wo), bsdf.pdf(ctx, si, wo), bsdf.pdf(ctx, back, si.wi)
        dr.eval(value, pdfs)
        value, to_light, to_camera = np.array(value, dtype=float).ravel(), *(float(x[0]) for x in pdfs)
    out = si.to_world(wo)
    cosines = dr.abs(dr.dot(si.n, out)), dr.abs(dr.dot(si.n, si.to_world(si.wi)))
    dr.eval(out, cosines)
    return _Event(value, to_light, to_camera, *(float(x[0]) for x in cosines), turned), out


def _lobe(bsdf, si, wo, i: int):
    """Direction and weight of the delta lobe along ``wo``."""
    found = draws.draw(bsdf, si, mi.Float(LOBES), mi.Point2f(0.5), mi.Bool(True))
    bs, weight = found.bs, found.weight
    leads = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (dr.dot(bs.wo, wo) > SAME_DIRECTION)
    turned = _turned(si, bs)
    dr.eval(bs.wo, weight, leads, turned)
    found = np.flatnonzero(np.array(leads))
    if not len(found):
        raise Lost(f"no delta lobe at vertex {i} leads to the next vertex")
    lobe = mi.UInt32(int(found[0]))
    weights, turned = np.array(weight, dtype=float).reshape(3, -1), np.array(turned, dtype=float)
    chosen = weights[:, found[0] % weights.shape[1]], turned[found[0] % len(turned)]
    return dr.gather(mi.Vector3f, bs.wo, lobe), *chosen


def _turned(si, bs):
    """Solid angle on the camera's side of a delta event over that on the light's. Refraction keeps eta^2
    |m.w| dw, m the normal about which it refracts (along eta_c c + eta_l l)."""
    m = si.wi + bs.eta * bs.wo  # bs.eta = eta_l / eta_c
    ratio = dr.square(bs.eta) * dr.abs(dr.dot(m, bs.wo) / dr.dot(m, si.wi))
    refracted = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission) & (dr.abs(bs.eta - 1) > 1e-5)
    return dr.select(refracted, ratio, 1)


def _densities(scene, path, events, source):
    """What the oracle needs, and log of the sensor's importance, which includes its cosine and the density of
    its point."""
    sensor = scene.sensors()[0]
    lens, lens_pdf = sensor.class_name() == "ThinLensCamera", 1.0
    if lens:
        lens_pdf = 1 / (np.pi * float(mi.traverse(sensor)["aperture_radius"][0]) ** 2)
    axis = world_matrix(sensor)[:3, 2]
    cos_sensor = abs(axis @ _direction(path, 0)) / np.linalg.norm(axis)
    k = len(path.p) - 1
    dist2 = [np.sum((path.p[i + 1] - path.p[i]) ** 2) for i in range(k)]
    if path.infinite:
        dist2[-1] = 1.0
    events = events[::-1]  # x_1 first

    def row(*values):
        return np.array([values], dtype=float)

    paths = oracle.Paths(
        dist2=row(*dist2[::-1]),
        cos_light=row(source.cos, *(e.cos_camera for e in events)),
        cos_camera=row(*(e.cos_light for e in events), cos_sensor),
        to_camera=row(1, *(e.to_camera for e in events), 1),
        to_light=row(1, *(e.to_light for e in events), 1),
        delta=np.array([path.delta[::-1]]),
        kind=np.array([source.kind]),
        first=np.array([source.first]),
        second=np.array([source.second]),
        direct=np.array([source.direct]),
        lens=np.array([lens]),
        lens_pdf=np.array([lens_pdf]),
        sensor_pdf=np.array([path.pdf_w]),
    )
    return paths, np.log(lens_pdf) + np.log(path.pdf_w)


def _point(p):
    # A literal would make each vertex a kernel of its own.
    return dr.opaque(mi.Point3f, [float(x) for x in p])


def _vector(d):
    return dr.opaque(mi.Vector3f, [float(x) for x in d])
