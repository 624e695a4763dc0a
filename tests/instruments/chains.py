"""Random chains of densities, and the weights of all strategies by the recursion."""

from __future__ import annotations

from dataclasses import astuple, replace
from types import SimpleNamespace

import drjit as dr
import numpy as np
from mitsuba_bdpt.transport import mis

import mitsuba as mi  # isort: skip

from .oracle import AREA, DIRECTIONAL, ENVIRONMENT, POSITION, Coefficients, Paths

# n c: all classes, kappa different from every count, and classes left out.
COEFFICIENTS = {
    "n1c1": Coefficients(1, 1, 1, 1),
    "quarter": Coefficients(0.25, 0.0625, 1, 0.25, 1.0),
    "odd": Coefficients(3.7, 0.013, 42.0, 0.21, 0.02),
    "n1c0": Coefficients(1, 1, 0, 1),
    "n1c0-half": Coefficients(0.5, 0.3, 0, 0, 0.6),
    "n0c1": Coefficients(0, 0, 0.7, 0, 0),
    "n0c0": Coefficients(0, 0, 0, 0, 0),
}


def random_paths(rng, n, k, decades=3.0, geometry=1.0, delta=0.2) -> Paths:
    """Densities spread over ``2 decades`` orders of magnitude, squared distances over ``2 geometry``, a share
    ``delta`` of delta vertices, all kinds of emitters and sensors. All numbers are float32 exactly."""

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


def recursion(paths: Paths, kappa: Coefficients, name: str, eta=None) -> np.ndarray:
    """Weights of all strategies by ``mis.py``, (n, k + 2); meaningful where in use. With ``eta``, see
    `oracle.log_merges`, those of the k - 1 merges follow."""
    # Values that kernels look up, so that they are compiled once for all; 0 is a class not in use.
    kappa = Coefficients(*(dr.opaque(mi.Float, x) if x else 0 for x in astuple(kappa)))
    discs = None if eta is None else [mi.Float(x) for x in eta.astype(np.float32).T]
    chain = Recursion(arrays(paths), kappa, mis.Heuristic(name), discs)
    weights = {0: chain.hit(), 1: chain.endpoints() if paths.k == 1 else chain.next_event()}
    if paths.k > 1:
        weights |= {s: chain.inner(s) for s in range(2, paths.k)} | {paths.k: chain.splat()}
    weights[paths.k + 1] = chain.arrive()
    if eta is not None:
        weights |= {paths.k + 1 + m: chain.merge(m) for m in range(1, paths.k)}
    return columns([weights[s] for s in range(len(weights))], len(paths.kind))


def arrays(paths: Paths) -> SimpleNamespace:
    """`Paths` as Dr.Jit arrays: a list of one for each edge or vertex; masks of the kinds of emitters in
    place of ``kind``, and ``ratio``, see `emitters.Direct.emission_ratio`."""

    def number(x):
        with np.errstate(over="ignore"):
            return mi.Float(x.astype(np.float32))

    area, position, transmittance = paths.kind == AREA, paths.kind == POSITION, paths.transmittance
    ratio = paths.first.astype(np.float64) * paths.second / paths.direct
    ratio /= np.where(area, paths.cos_light[:, 0], np.where(position, paths.dist2[:, 0], 1))
    edges = ("dist2", "cos_light", "cos_camera", "to_camera", "to_light")
    single = ("first", "second", "direct", "lens_pdf", "sensor_pdf")
    masks = {"lens": paths.lens, "area": area, "position": position}
    masks |= {"infinite": paths.infinite, "unhittable": paths.delta_emitter}
    return SimpleNamespace(
        k=paths.k,
        **{name: [number(x) for x in getattr(paths, name).T] for name in edges},
        **{name: number(getattr(paths, name)) for name in single},
        **{name: mi.Bool(mask) for name, mask in masks.items()},
        delta=[mi.Bool(x) for x in paths.delta.T],
        ratio=number(ratio),
        transmittance=[None] * paths.k if transmittance is None else [number(x) for x in transmittance.T],
    )


class Recursion:
    """Partial sums along both subpaths of each path, and the weight of each strategy from them, in the order
    of calls of ``walk.py`` and ``techniques.py``."""

    def __init__(self, path: SimpleNamespace, kappa: Coefficients, heuristic: mis.Heuristic, eta=None):
        self.path, self.kappa, self.h, self.eta = path, kappa, heuristic, eta
        self._no_merges = 0 if eta is None else heuristic.zero()
        self.arrival = dr.select(path.lens, kappa.arrival, mi.Float(0))
        self.light, self._last = self._along_light()
        self.camera = self._along_camera()

    # -- subpaths -----------------------------------------------------------------------------

    def _fold(self, partial, coefficient, kappa_prime, pdf_fwd_w, pdf_rev_w, cos_out, i):
        is_delta = self.path.delta[i]
        # At a delta vertex the densities are unset: zeros must not get through.
        step = SimpleNamespace(
            pdf_fwd_w=dr.select(is_delta, 0, pdf_fwd_w),
            pdf_rev_w=dr.select(is_delta, 0, pdf_rev_w),
            cos_out=cos_out,
            delta=is_delta,
        )
        after = mis.scatter(self.h, partial, coefficient, step)
        if self.eta is None:
            return after
        merges = mis.scattered_merges(self.h, partial, step, self.h.start(self.eta[i]), kappa_prime)
        return mis.Partial(after.d_vcm, after.d_vc, *merges)

    def _along_light(self):
        """At y_e = x_e, and those with which the last edge sets out (subpaths.light_subpath, walk._vertex and
        _scatter)."""
        x, h = self.path, self.h
        inverse = dr.rcp(x.first * x.second)
        start = dr.select(x.unhittable, 0, h.start(x.cos_light[0] * inverse))
        partial = mis.Partial(h.start(inverse), start, self._no_merges, self._no_merges)
        at_point = dr.select(x.position, x.direct * x.dist2[0], x.direct)
        complete = dr.select(x.area, x.direct * x.cos_light[0], at_point)
        found = [None]
        for e in range(1, x.k):
            if e == 1:
                partial = replace(partial, d_vcm=h.scale(partial.d_vcm, complete))
            dist2 = 1 if e == 1 else x.dist2[e - 1]
            partial = mis.to_area(h, partial, dist2, x.cos_camera[e - 1], x.transmittance[e - 1])
            found.append(partial)
            densities = x.to_camera[e], x.to_light[e]
            partial = self._fold(partial, *[self._of_light(e)] * 2, *densities, x.cos_light[e], e)
        return found, partial

    def _along_camera(self):
        """At z_e = x_{k-e}."""
        x, h, k = self.path, self.h, self.path.k
        from_lens = h.start(x.cos_camera[k - 1] / (x.lens_pdf * x.sensor_pdf))
        arrival = h.scale(from_lens, self.arrival)
        partial = mis.Partial(h.start(dr.rcp(x.sensor_pdf)), arrival, self._no_merges, self._no_merges)
        found = [None]
        for e in range(1, k + 1):
            i = k - e
            arrived = mis.to_area(h, partial, x.dist2[i], x.cos_light[i], x.transmittance[i])
            if x.transmittance[i] is not None:
                partial = replace(partial, d_vcm=h.scale(partial.d_vcm, dr.rcp(x.transmittance[i])))
            partial = dr.select(x.infinite, partial, arrived) if e == k else arrived
            found.append(partial)
            if e < k:
                densities = x.to_light[i], x.to_camera[i]
                kappa = self._of_camera(e), self._kappa_prime(e)
                partial = self._fold(partial, *kappa, *densities, x.cos_camera[i - 1], i)
        return found

    def _of_light(self, e):
        return 1.0 if e == 1 else self.kappa.inner

    def _of_camera(self, e):
        return self.kappa.splat if e == 1 else self.kappa.inner

    def _kappa_prime(self, e):
        """The coefficient beside which a merge at z_e has to count."""
        return self.kappa.splat_prime if e == 1 else self.kappa.inner

    # -- strategies ---------------------------------------------------------------------------

    def arrive(self):
        """t = 0 (techniques.hit_sensor)."""
        x, h, k, kappa, before = self.path, self.h, self.path.k, self.kappa, self._last
        if mis.is_absent(kappa.arrival):
            return mi.Float(0)
        if k == 1:
            before = replace(before, d_vcm=h.scale(before.d_vcm, x.first))
        arrived = mis.to_area(h, before, x.dist2[k - 1], x.cos_camera[k - 1], x.transmittance[k - 1])
        newest = kappa.endpoints if k == 1 else kappa.splat
        light_side = mis.alternatives(h, arrived, newest, x.sensor_pdf, x.lens_pdf)
        kappa_prime = kappa.endpoints if k == 1 else kappa.splat_prime
        merges = h.scale(self._before_end(arrived, kappa_prime, x.sensor_pdf), x.lens_pdf)
        return h.weigh(kappa.arrival, light_side, mi.Float(0), ((0, merges),))[0]

    def _before_end(self, partial, coefficient, pdf):
        """Merges at the vertices before the end of a subpath, an emitter or the sensor."""
        if self.eta is None:
            return 0
        return mis.older_merges(self.h, partial, self.h.scale(partial.d_vcm, coefficient), pdf)

    def _of_side(self, partial, coefficient, pdf_rev_w, pdf_a, i):
        """Merges at the vertices of a subpath connected at x_i (alternatives.side_of)."""
        if self.eta is None:
            return ()
        return (mis.merges(self.h, partial, coefficient, pdf_rev_w, pdf_a, self.h.start(self.eta[i])),)

    def merge(self, m):
        """Both subpaths up to x_m (merging.merge)."""
        x, h, e = self.path, self.h, self.path.k - m
        y, z = self.light[m], self.camera[e]
        light = y, h.scale(y.d_vcm, self._of_light(m)), x.to_light[m]
        camera = z, h.scale(z.d_vcm, self._kappa_prime(e)), x.to_camera[m]
        connections = h.combine(light[1], h.scale(z.d_vcm, self._of_camera(e)))
        return mis.weigh_merge(h, h.start(self.eta[m]), light, camera, connections)

    def hit(self):
        """s = 0 (techniques.hit_emitter)."""
        x, h, last = self.path, self.h, self.camera[-1]
        connected = dr.select(x.area, x.direct * x.cos_light[0] / x.dist2[0], x.direct)
        newest = self.kappa.endpoints * x.first if x.k == 1 else connected
        camera_side = h.combine(h.scale(last.d_vcm, newest), h.scale(last.d_vc, x.first * x.second))
        merges = self._before_end(last, newest, x.first * x.second)
        return h.weigh(1, mi.Float(0), camera_side, ((0, merges),))[0]

    def _joined(self, kappa, light_side, camera_side, edge, merges=(), own=0):
        """The weight of a strategy that joins this edge (Space.seen)."""
        return self.h.weigh(kappa, light_side, camera_side, merges, own, self.path.transmittance[edge])[0]

    def endpoints(self):
        """(1,1) (techniques.connect_endpoints)."""
        x, h, kappa = self.path, self.h, self.kappa
        if mis.is_absent(kappa.endpoints):
            return mi.Float(0)
        geometry = dr.select(x.infinite, 1, x.cos_light[0] / x.dist2[0])
        light_side = h.start(dr.select(x.unhittable, 0, x.sensor_pdf * geometry / x.first))
        camera_side = h.start(x.second * x.cos_camera[0] / (x.dist2[0] * x.lens_pdf))
        return self._joined(kappa.endpoints, light_side, h.scale(camera_side, self.arrival), 0)

    def next_event(self):
        """s = 1 (techniques.next_event)."""
        x, h, k = self.path, self.h, self.path.k
        light_side = h.start(dr.select(x.unhittable, 0, x.to_light[1] / x.direct))
        density = x.ratio * x.cos_camera[0]
        z, densities = self.camera[k - 1], (x.to_camera[1], density)
        merges = self._of_side(z, self._kappa_prime(k - 1), *densities, 1)
        camera_side = mis.alternatives(h, z, self._of_camera(k - 1), *densities)
        return self._joined(1, light_side, camera_side, 0, merges, 1.0)

    def inner(self, s):
        """s and t >= 2 (connections.inner)."""
        x, h, k, kappa = self.path, self.h, self.path.k, self.kappa
        if mis.is_absent(kappa.inner):
            return mi.Float(0)
        from_camera = x.to_light[s] * x.cos_light[s - 1] / x.dist2[s - 1]
        from_light = x.to_camera[s - 1] * x.cos_camera[s - 1] / x.dist2[s - 1]
        y = self.light[s - 1], self._of_light(s - 1), x.to_light[s - 1], from_camera
        z = self.camera[k - s], self._of_camera(k - s), x.to_camera[s], from_light
        merges = self._of_side(*y, s - 1) + self._of_side(z[0], self._kappa_prime(k - s), *z[2:], s)
        sides = mis.alternatives(h, *y), mis.alternatives(h, *z)
        return self._joined(kappa.inner, *sides, s - 1, merges, kappa.inner)

    def splat(self):
        """t = 1 (techniques.splat)."""
        x, h, k, kappa = self.path, self.h, self.path.k, self.kappa
        if mis.is_absent(kappa.splat):
            return mi.Float(0)
        from_camera = x.sensor_pdf * x.cos_light[k - 1] / x.dist2[k - 1]
        y = self.light[k - 1], self._of_light(k - 1), x.to_light[k - 1], from_camera
        to_sensor = x.to_camera[k - 1] * x.cos_camera[k - 1] / (x.dist2[k - 1] * x.lens_pdf)
        camera_side = h.scale(h.start(to_sensor), self.arrival)
        merges = self._of_side(*y, k - 1)
        sides = mis.alternatives(h, *y), camera_side
        return self._joined(kappa.splat, *sides, k - 1, merges, kappa.splat_prime)


def columns(values, n) -> np.ndarray:
    """Dr.Jit arrays side by side, evaluated as one kernel."""
    dr.eval(values)
    return np.stack([np.broadcast_to(x.numpy(), n) for x in values], axis=1).astype(np.float64)
