"""Random chains of densities, and the weights of all strategies by the recursion.

What tests/test_oracle.py and the stress cases share; the truth is in `oracle`.
"""

from __future__ import annotations

from dataclasses import astuple
from types import SimpleNamespace

import drjit as dr
import numpy as np
from mitsuba_bdpt import mis

import mitsuba as mi  # isort: skip

from .oracle import AREA, DIRECTIONAL, ENVIRONMENT, POSITION, Coefficients, Paths

# n c: all classes, kappa different from every count, and classes left out.
COEFFICIENTS = {
    "n1c1": Coefficients(1, 1, 1, 1),
    "quarter": Coefficients(0.25, 0.0625, 1, 0.25),
    "odd": Coefficients(3.7, 0.013, 42.0, 0.21),
    "n1c0": Coefficients(1, 1, 0, 1),
    "n1c0-half": Coefficients(0.5, 0.3, 0, 0),
    "n0c1": Coefficients(0, 0, 0.7, 0),
    "n0c0": Coefficients(0, 0, 0, 0),
}


def random_paths(rng, n, k, decades=3.0, geometry=1.0, delta=0.2) -> Paths:
    """``n`` random paths: densities spread over ``2 decades`` orders of magnitude, squared
    distances over ``2 geometry``, a share ``delta`` of delta vertices, all kinds of emitters and
    both kinds of sensors. All numbers are float32 exactly."""

    def spread(shape, width):
        return (10.0 ** rng.uniform(-width, width, shape)).astype(np.float32)

    def cosines():
        return np.maximum(rng.random((n, k)), 1e-3).astype(np.float32)

    kind = rng.integers(0, 4, n)
    lens = rng.random(n) < 0.5
    infinite = (kind == ENVIRONMENT) | (kind == DIRECTIONAL)
    if k == 1:  # a delta emitter and a pinhole share no path
        lens |= (kind == POSITION) | (kind == DIRECTIONAL)
    flags = rng.random((n, k + 1)) < delta
    flags[:, [0, k]] = False
    dist2 = spread((n, k), geometry)
    dist2[infinite, 0] = 1
    cos_light = cosines()
    cos_light[kind != AREA, 0] = 1
    return Paths(
        dist2=dist2,
        cos_light=cos_light,
        cos_camera=cosines(),
        to_camera=spread((n, k + 1), decades),
        to_light=spread((n, k + 1), decades),
        delta=flags,
        kind=kind,
        first=spread(n, decades),
        second=spread(n, decades),
        direct=spread(n, decades),
        lens=lens,
        lens_pdf=np.where(lens, spread(n, decades), 1),
        sensor_pdf=spread(n, decades),
    )


def recursion(paths: Paths, kappa: Coefficients, name: str) -> np.ndarray:
    """Weights of all strategies by ``mis.py``, shape (n, k + 2); meaningful where in use."""
    k, h, f = paths.k, mis.Heuristic(name), mi.Float
    # Values that kernels look up, so that they are compiled once for all; 0 is a class not in use.
    kappa = Coefficients(*(dr.opaque(f, x) if x else 0 for x in astuple(kappa)))
    ratio = paths.first.astype(np.float64) * paths.second / paths.direct
    ratio /= np.where(
        paths.kind == AREA,
        paths.cos_light[:, 0],
        np.where(paths.kind == POSITION, paths.dist2[:, 0], 1),
    )
    with np.errstate(over="ignore"):
        ratio = f(ratio.astype(np.float32))
    column = {
        field: [f(getattr(paths, field)[:, i].astype(np.float32)) for i in range(width)]
        for field, width in (
            ("dist2", k),
            ("cos_light", k),
            ("cos_camera", k),
            ("to_camera", k + 1),
            ("to_light", k + 1),
        )
    }
    d2, cl, cc = column["dist2"], column["cos_light"], column["cos_camera"]
    to_camera, to_light = column["to_camera"], column["to_light"]
    delta = [mi.Bool(paths.delta[:, i]) for i in range(k + 1)]
    first, second, direct, sensor = (
        f(x.astype(np.float32)) for x in (paths.first, paths.second, paths.direct, paths.sensor_pdf)
    )
    area, position = mi.Bool(paths.kind == AREA), mi.Bool(paths.kind == POSITION)
    infinite, unhittable = mi.Bool(paths.infinite), mi.Bool(paths.delta_emitter)
    lens_pdf = f(paths.lens_pdf.astype(np.float32))
    arrival = dr.select(mi.Bool(paths.lens), kappa.arrival, f(0))

    def fold(partial, coefficient, pdf_fwd_w, pdf_rev_w, cos_out, is_delta):
        # At a delta vertex the densities are unset: zeros must not get through.
        step = SimpleNamespace(
            pdf_fwd_w=dr.select(is_delta, 0, pdf_fwd_w),
            pdf_rev_w=dr.select(is_delta, 0, pdf_rev_w),
            cos_out=cos_out,
            delta=is_delta,
        )
        return mis.scatter(h, partial, coefficient, step)

    # Light subpath (kernel._light_subpath, subpath._arrive and _leave): light[e] at y_e = x_e.
    inverse = dr.rcp(first * second)
    partial = mis.Partial(h.start(inverse), dr.select(unhittable, 0, h.start(cl[0] * inverse)))
    complete = dr.select(area, direct * cl[0], dr.select(position, direct * d2[0], direct))
    light = [None]
    for e in range(1, k + 1):
        before = partial
        if e == k:
            break
        if e == 1:
            partial = mis.Partial(h.scale(partial.d_vcm, complete), partial.d_vc)
        partial = mis.arrive(h, partial, 1 if e == 1 else d2[e - 1], cc[e - 1])
        light.append(partial)
        partial = fold(partial, 1.0 if e == 1 else kappa.inner, to_camera[e], to_light[e], cl[e], delta[e])
    # Camera subpath: camera[e] at z_e = x_{k-e}.
    partial = mis.Partial(h.start(dr.rcp(sensor)), h.scale(h.start(cc[k - 1] / (lens_pdf * sensor)), arrival))
    camera = [None]
    for e in range(1, k + 1):
        x = k - e
        arrived = mis.arrive(h, partial, d2[x], cl[x])
        partial = dr.select(infinite, partial, arrived) if e == k else arrived
        camera.append(partial)
        if e < k:
            partial = fold(
                partial,
                kappa.splat if e == 1 else kappa.inner,
                to_light[x],
                to_camera[x],
                cc[x - 1],
                delta[x],
            )

    def of_light(e):
        return 1.0 if e == 1 else kappa.inner

    def of_camera(e):
        return kappa.splat if e == 1 else kappa.inner

    result = [f(0)] * (k + 2)
    if not mis.is_absent(kappa.arrival):  # t = 0 (connect.arrive)
        if k == 1:
            before = mis.Partial(h.scale(before.d_vcm, first), before.d_vc)
        arrived = mis.arrive(h, before, d2[k - 1], cc[k - 1])
        newest = kappa.endpoints if k == 1 else kappa.splat
        light_side = mis.alternatives(h, arrived, newest, sensor, lens_pdf)
        result[k + 1] = h.weight(kappa.arrival, light_side, f(0))
    # s = 0 (connect.hit_emitter)
    connected = dr.select(area, direct * cl[0] / d2[0], direct)
    newest = kappa.endpoints * first if k == 1 else connected
    camera_side = h.combine(h.scale(camera[k].d_vcm, newest), h.scale(camera[k].d_vc, first * second))
    result[0] = h.weight(1, f(0), camera_side)
    if k == 1:  # connect.join_endpoints
        geometry = dr.select(infinite, 1, cl[0] / d2[0])
        light_side = h.start(dr.select(unhittable, 0, sensor * geometry / first))
        if not mis.is_absent(kappa.endpoints):
            camera_side = h.scale(h.start(second * cc[0] / (d2[0] * lens_pdf)), arrival)
            result[1] = h.weight(kappa.endpoints, light_side, camera_side)
        return columns(result, len(paths.kind))
    # s = 1 (connect.next_event)
    light_side = h.start(dr.select(unhittable, 0, to_light[1] / direct))
    camera_side = mis.alternatives(h, camera[k - 1], of_camera(k - 1), to_camera[1], ratio * cc[0])
    result[1] = h.weight(1, light_side, camera_side)
    for s in range(2, k):  # connect.inner
        if mis.is_absent(kappa.inner):
            break
        light_side = mis.alternatives(
            h, light[s - 1], of_light(s - 1), to_light[s - 1], to_light[s] * cl[s - 1] / d2[s - 1]
        )
        camera_side = mis.alternatives(
            h, camera[k - s], of_camera(k - s), to_camera[s], to_camera[s - 1] * cc[s - 1] / d2[s - 1]
        )
        result[s] = h.weight(kappa.inner, light_side, camera_side)
    if not mis.is_absent(kappa.splat):  # t = 1 (connect.splat)
        light_side = mis.alternatives(
            h, light[k - 1], of_light(k - 1), to_light[k - 1], sensor * cl[k - 1] / d2[k - 1]
        )
        to_sensor = to_camera[k - 1] * cc[k - 1] / (d2[k - 1] * lens_pdf)
        camera_side = h.scale(h.start(to_sensor), arrival)
        result[k] = h.weight(kappa.splat, light_side, camera_side)
    return columns(result, len(paths.kind))


def columns(values, n) -> np.ndarray:
    """Dr.Jit arrays side by side, evaluated as one kernel."""
    dr.eval(values)
    return np.stack([np.broadcast_to(x.numpy(), n) for x in values], axis=1).astype(np.float64)
