"""The weights: the recursion of the core against explicit densities (Veach's ratios). ``test_recursion_*``:
``mis.py`` alone, on random numbers. ``test_kernel_*``: the unchanged kernel in a scripted world, whose
stand-ins walk each lane along a path drawn beforehand and answer with densities drawn beforehand; positions
and normals are real. Densities of real scenes: ``tests/emitters``, ``tests/sensors``; images:
``test_strategies.py``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import variants
from mitsuba_bdpt import settings
from mitsuba_bdpt.emitters import emitters
from mitsuba_bdpt.geometry import rays, rounding
from mitsuba_bdpt.geometry.hits import Hits
from mitsuba_bdpt.image import sink
from mitsuba_bdpt.sensors import records as sensor_records
from mitsuba_bdpt.transport import (
    bsdf,
    connections,
    inputs,
    kernel,
    light_path,
    mis,
    near_specular,
    sds,
    subpaths,
    techniques,
)
from mitsuba_bdpt.transport.contribution import Counters
from mitsuba_bdpt.transport.inputs import Observer, Shared
from mitsuba_bdpt.transport.path_layers import CAUSTIC, DIRECT, INDIRECT, NAMES
from mitsuba_bdpt.transport.photons import guided_hits, photon_guide, photon_pass
from mitsuba_bdpt.transport.vacuum import Vacuum

from instruments import oracle
from instruments.chains import COEFFICIENTS, columns, random_paths, recursion
from instruments.oracle import AREA, ENVIRONMENT, POSITION, Coefficients

# -- layer 1: arithmetic ---------------------------------------------------------------------------


def check(explicit, name, weights, relative, sure=slice(None)):
    """The ``weights`` of paths are the ``explicit`` ones, where these are ``sure``, and sum to 1."""
    used, weights, expected = (x[sure] for x in (explicit.used, weights, explicit.weights(name)))
    weights = np.where(used, weights, 0)
    # A relative bound tests small weights as sharply as large ones; below 1e-30 float32 ends.
    np.testing.assert_allclose(weights, expected, rtol=relative, atol=1e-30)
    np.testing.assert_allclose(weights[used.any(1)].sum(1), 1, atol=1e-4)


def check_merged(explicit, name, weights, relative, delta):
    """As `check`, and 0 for merges that do not count at vertices that are not ``delta``. Left out: paths on
    which a comparison is closer than 0.1 %, which rounding may decide either way."""
    sure, first = ~explicit.near, len(delta[0]) + 1
    assert explicit.near.mean() < 0.05
    check(explicit, name, weights, relative, sure)
    others = ~explicit.used[:, first:] & ~delta[:, 1:-1] & sure[:, None]
    assert not weights[:, first:][others].any()


@pytest.mark.parametrize("name", settings.HEURISTICS)
@pytest.mark.parametrize("classes", COEFFICIENTS)
def test_recursion_agrees_with_explicit_densities(name, classes):
    """1,000 random paths each of k = 1 ... 8 edges, densities over 6 orders of magnitude, a fifth of the
    vertices delta, all kinds of emitters and sensors. Tolerance: float32 sums of positive terms, some ten
    roundings of 6e-8 per vertex."""
    rng = np.random.default_rng(1)
    for k in range(1, 9):
        paths = random_paths(rng, 1000, k)
        weights = recursion(paths, COEFFICIENTS[classes], name)
        check(oracle.Explicit(paths, COEFFICIENTS[classes]), name, weights, relative=1e-4)


@pytest.mark.parametrize("least", [0.0, 1.0, 30.0])
@pytest.mark.parametrize("name", settings.HEURISTICS)
@pytest.mark.parametrize("classes", COEFFICIENTS)
def test_recursion_with_merges(name, classes, least, monkeypatch):
    """As above, eta over six orders of magnitude; B = 0 merges at all vertices that are not delta (the whole
    of Georgiev's method). Paths that are not merged have their weights without merging, to the bit."""
    monkeypatch.setattr(mis, "MERGE_DOMINATED", least)
    rng, total, plain = np.random.default_rng(6), 0, 0
    for k in range(2, 8):
        paths = random_paths(rng, 1000, k)
        eta = (10.0 ** rng.uniform(-3, 3, (1000, k + 1))).astype(np.float32)
        explicit = oracle.Merged(paths, COEFFICIENTS[classes], eta, least, name)
        weights = recursion(paths, COEFFICIENTS[classes], name, eta)
        check_merged(explicit, name, weights, 1e-4, paths.delta)
        sure = ~explicit.near
        without, easy = recursion(paths, COEFFICIENTS[classes], name), sure & ~explicit.merged
        np.testing.assert_array_equal(
            np.where(explicit.used, weights, 0)[easy, : k + 2],
            np.where(explicit.used[:, : k + 2], without, 0)[easy],
        )
        total, plain = total + (explicit.merged & sure).sum(), plain + easy.sum()
    assert total > 200 and plain > 200


@pytest.mark.parametrize("name", settings.HEURISTICS)
@pytest.mark.parametrize("classes", ["n1c1", "odd", "n0c0"])
def test_recursion_extreme_densities(name, classes):
    """No overflow, underflow or inf * 0: densities are 1e-30, 1e30, 1 or log-uniform between, cosines down to
    1e-3. Partial sums saturate at 1e37: equality is asked only of paths of one and two edges whose densities
    but one are moderate, where no ratio passes 1e34."""
    rng = np.random.default_rng(2)
    kappa = COEFFICIENTS[classes]
    for k in range(1, 9):
        paths = random_paths(rng, 2000, k, decades=30)
        for field in ("to_camera", "to_light", "first", "second", "direct", "sensor_pdf"):
            x = getattr(paths, field)
            corner = rng.choice(np.float32([1e-30, 1e30, 1]), x.shape)
            x[:] = np.where(rng.random(x.shape) < 0.7, corner, x)
        weights = recursion(paths, kappa, name)
        assert ((weights >= 0) & (weights <= 1)).all()

    for k in (1, 2):
        for field in ("to_camera", "to_light", "first", "second", "direct", "sensor_pdf"):
            paths = random_paths(rng, 500, k, decades=1)
            getattr(paths, field)[:] *= rng.choice(np.float32([1e-29, 1e29]))
            check(oracle.Explicit(paths, kappa), name, recursion(paths, kappa, name), relative=1e-4)


# -- layer 2: the real kernel in a scripted world ----------------------------------------------------


class World:
    """Random paths in space, and stand-ins for everything that the kernel asks. Distances and cosines of
    ``paths`` are those of random positions and normals, in float64."""

    def __init__(self, rng, n, k, lens, delta=0.2):
        self.rng, self.n, self.k, self.lens = rng, n, k, lens
        paths = random_paths(rng, n, k, decades=2, delta=delta)
        paths.lens[:] = lens
        if k == 1 and not lens:
            paths.kind[:] = rng.choice([AREA, ENVIRONMENT], n)
        self.paths = paths
        position = rng.normal(size=(n, k + 1, 3)).astype(np.float32)
        step = position[:, 1:].astype(np.float64) - position[:, :-1]
        paths.dist2 = (step**2).sum(2)
        direction = step / np.sqrt(paths.dist2)[..., None]
        normal = self._normals(direction)
        on_area = paths.kind == AREA
        self.normal, self.position, self.direction = normal, position, direction
        paths.cos_light = np.abs((normal[:, :-1] * direction).sum(2))
        paths.cos_camera = np.abs((normal[:, 1:] * direction).sum(2))
        paths.cos_light[~on_area, 0] = 1
        paths.dist2[paths.infinite, 0] = 1
        # Mixed vertices: a delta event on a BSDF that could also be joined.
        self.mixed = rng.random((n, k + 1)) < 0.5
        # In polarized variants the matrices of light towards the camera, and of light the other way.
        others = 0.2 * np.random.default_rng(9).normal(size=(2, k + 1, n, 4, 4))
        others[..., 0, 0] = 1
        self.matrices, self.backwards = others
        self.values, self.layers = {}, {}  # of each s
        self.path_layers = False
        self.demands = []  # masks that must hold
        self.scene, self.merged = Scene(self), {}

    def _normals(self, direction):
        """Normals that no edge grazes: rounding stays near 1e-5."""
        n, k = self.n, self.k
        normal = np.empty((n, k + 1, 3))
        todo = np.ones((n, k + 1), dtype=bool)
        while todo.any():
            trial = self.rng.normal(size=(n, k + 1, 3))
            trial /= np.linalg.norm(trial, axis=2, keepdims=True)
            normal[todo] = trial[todo]
            least = np.ones((n, k + 1))
            least[:, :-1] = np.abs((normal[:, :-1] * direction).sum(2))
            least[:, 1:] = np.minimum(least[:, 1:], np.abs((normal[:, 1:] * direction).sum(2)))
            todo = least < 0.1
        return normal.astype(np.float32).astype(np.float64)

    def f(self, x):
        return mi.Float(np.ascontiguousarray(x, dtype=np.float32))

    def v(self, kind, x):
        return kind(*(self.f(x[:, i]) for i in range(3)))

    def point(self, i):
        return self.v(mi.Point3f, self.position[:, i])

    def towards(self, i, j):
        """Unit direction from x_i to its neighbour x_j."""
        return self.v(mi.Vector3f, self.direction[:, i] if j > i else -self.direction[:, j])

    def interaction(self, i, from_light):
        """The surface interaction at x_i, seen from the light's or the camera's side."""
        si = interaction_kind(mi.variant())()
        si.script = self, i
        si.p, si.n = self.point(i), self.v(mi.Normal3f, self.normal[:, i])
        # A shading frame that has nothing to do with the geometric normal.
        si.sh_frame = mi.Frame3f(dr.normalize(self.v(mi.Normal3f, self.rng.normal(size=(self.n, 3)))))
        si.t = mi.Float(1)
        if i == 0:
            si.t = dr.select(mi.Bool(self.paths.infinite), dr.inf, 1)
        si.time, si.wavelengths = mi.Float(0), mi.Color0f()
        if (0 < i) if from_light else (i < self.k):
            si.wi = si.to_local(self.towards(i, i - 1 if from_light else i + 1))
        return si


@cache
def interaction_kind(variant):
    """A surface interaction of the current variant whose BSDF is scripted."""

    class Interaction(mi.SurfaceInteraction3f):
        def bsdf(self, *_):
            return Scattering(*self.script)

    return Interaction


def lobe(which, flag):
    """``flag`` in the lanes ``which``, delta reflection in the others."""
    return dr.select(mi.Bool(which), *(mi.UInt32(int(x)) for x in (flag, mi.BSDFFlags.DeltaReflection)))


class Scattering:
    """The BSDF at x_i: value 1, or matrices, and densities from the script, by the direction."""

    def __init__(self, world, i):
        self.world, self.i = world, i

    def _choose(self, si, w, camera, light):
        if not 0 < self.i < self.world.k:
            return mi.Float(1)
        w = si.to_world(w)
        near = dr.dot(w, self.world.towards(self.i, self.i + 1)) > dr.dot(
            w, self.world.towards(self.i, self.i - 1)
        )
        return dr.select(near, camera, light)

    def _pdf(self, si, wo):
        paths = self.world.paths
        return self._choose(si, wo, *(self.world.f(x[:, self.i]) for x in (paths.to_camera, paths.to_light)))

    def _value(self, si, wo):
        """1, or the local matrix of light that arrives from ``wo`` and leaves to ``si.wi``."""
        if not mi.is_polarized:
            return mi.Spectrum(1)
        to_camera = self._choose(si, si.wi, mi.Float(1), mi.Float(0)) > 0
        value = mi.Spectrum(0)
        for row, column in np.ndindex(4, 4):
            there, back = (m[self.i, :, row, column] for m in (self.world.matrices, self.world.backwards))
            value[row, column] = dr.select(to_camera, self.world.f(there), self.world.f(back))
        ends = []
        for local in (-wo, si.wi):
            d = si.to_world(local)
            basis = mi.mueller.stokes_basis
            ends += [d, basis(d), si.to_world(basis(local))]
        return mi.mueller.rotate_mueller_basis(value, *ends)

    def flags(self):
        joinable = ~self.world.paths.delta[:, self.i] | self.world.mixed[:, self.i]
        return lobe(joinable, mi.BSDFFlags.Smooth)

    def pdf(self, ctx, si, wo, active=True):
        return self._pdf(si, wo)

    def eval_pdf(self, ctx, si, wo, active=True):
        assert ctx.mode == mi.TransportMode.Radiance
        return self._value(si, wo), self._pdf(si, wo)

    def sample(self, ctx, si, u1, u2, active=True):
        bs = dr.zeros(mi.BSDFSample3f)
        w, i = self.world, self.i
        if 0 < i < w.k:
            onward = self._choose(si, si.wi, mi.Float(0), mi.Float(1)) > 0
            bs.wo = si.to_local(dr.select(onward, w.towards(i, i + 1), w.towards(i, i - 1)))
        delta = mi.Bool(w.paths.delta[:, i])
        # Probabilities of delta events mean nothing to the weights.
        bs.pdf = dr.select(delta, 0.125, self._pdf(si, bs.wo))
        bs.eta = mi.Float(1)
        bs.sampled_type = lobe(~delta, mi.BSDFFlags.GlossyReflection)
        return bs, self._value(si, bs.wo)


class Hit:
    """The preliminary hit of the walk's next vertex."""

    def __init__(self, world, i, from_light):
        self.arguments = world, i, from_light

    def compute_surface_interaction(self, ray, flags, active):
        world, i, from_light = self.arguments
        return world.interaction(i, from_light)


class Scene:
    """Rays find the script's next vertex; nothing is ever in the way."""

    def __init__(self, world):
        self.world, self.from_light, self.at = world, None, 0

    def begin(self, from_light):
        self.from_light, self.at = from_light, 0

    def ray_intersect_preliminary(self, ray, coherent, active):
        self.at = min(self.at + 1, self.world.k)
        i = self.at if self.from_light else self.world.k - self.at
        return Hit(self.world, i, self.from_light)

    def ray_test(self, ray, active):
        return mi.Bool(False)

    def environment(self):
        return None


class Lights:
    """Stand-in for `emitters.Emitters`."""

    def __init__(self, world):
        w, paths = world, world.paths
        self.world, self.count = world, 1
        self.area, self.at = mi.Bool(paths.kind == AREA), mi.Bool(paths.kind == POSITION)
        self.infinite, self.delta = mi.Bool(paths.infinite), mi.Bool(paths.delta_emitter)
        self.first, self.second, self.direct = w.f(paths.first), w.f(paths.second), w.f(paths.direct)
        self.cos, self.dist2 = w.f(paths.cos_light[:, 0]), w.f(paths.dist2[:, 0])
        at_point = dr.select(self.at, self.direct * self.dist2, self.direct)
        self.complete = dr.select(self.area, self.direct * self.cos, at_point)

    def sample_emission(self, *_):
        w = self.world
        n = dr.select(self.area, w.v(mi.Normal3f, w.normal[:, 0]), 0)
        return emitters.Emission(
            weight=mi.Spectrum(1),
            d=w.towards(0, 1),
            anchor=rays.Anchor(w.point(0), n, mi.Float(0), mi.Float(0)),
            cos=self.cos,
            pdf_first=self.first,
            pdf_second=self.second,
            infinite=self.infinite,
            delta=self.delta,
            beam=mi.Bool(False),
            index=mi.UInt32(0),
            si=w.interaction(0, from_light=True),
        )

    def connection_density(self, emission, si, active):
        return self.complete

    at_infinity = True

    def covers(self, p, d):
        return mi.Bool(True)

    def direction_density(self, emission, p, d, active):
        return self.second

    def radiance_towards(self, emission, d, active):
        return mi.Spectrum(1)

    def emitted(self, si, active):
        return mi.Spectrum(1)

    def hit_densities(self, si, previous, active):
        if self.world.k > 1 and si.script[1] == 0:  # next-event estimation is done from x_1
            self.world.demands.append(dr.all(previous == self.world.point(1)))
        connected = dr.select(self.area, self.direct * self.cos / self.dist2, self.direct)
        return connected, self.first, self.second

    def sample_direct(self, si, u, active):
        w = self.world
        return emitters.Direct(
            weight=mi.Spectrum(1),
            pdf_w=self.direct,
            d=w.towards(1, 0),
            anchor=rays.free_anchor(w.point(0)),
            infinite=self.infinite,
            delta=self.delta,
            emission_ratio=self.first * self.second / self.complete,
        )


class Sensor:
    """Stand-in for a sensor of `sensors.prepare`."""

    parallel = needs_film_sample = False

    def __init__(self, world):
        self.world, self.lens, self.delta = world, world.lens, not world.lens
        self.needs_aperture_sample = self.lens
        self.density, self.lens_pdf = world.f(world.paths.sensor_pdf), world.f(world.paths.lens_pdf)
        self.cos = world.f(world.paths.cos_camera[:, -1])
        self.dist2 = world.f(world.paths.dist2[:, -1])

    def start(self, pixel, u_film, u_lens, like):
        w = self.world
        ray = mi.Ray3f(w.point(w.k), w.towards(w.k, w.k - 1), mi.Float(0), mi.Color0f())
        return sensor_records.CameraStart(
            ray=ray,
            p=w.point(w.k),
            pdf_w=self.density,
            weight=mi.Float(1),
            arrival=self.cos / (self.lens_pdf * self.density),
            position=mi.Point2f(0.5),
            counted=mi.Point2f(0.5),
        )

    def connect(self, p, u_lens, u_film):
        w = self.world
        return sensor_records.CameraConnection(
            p=w.point(w.k),
            anchor=rays.free_anchor(w.point(w.k)),
            d=w.towards(w.k - 1, w.k),
            dist2=self.dist2,
            importance=self.density,
            pdf_w=self.density,
            arrival=self.cos / (self.dist2 * self.lens_pdf),
            position=mi.Point2f(0.5),
            reach=mi.Float(dr.inf),
            valid=mi.Bool(True),
        )

    def connect_direction(self, d, u_lens, u_film):
        connection = self.connect(None, u_lens, u_film)
        connection.dist2 = mi.Float(1)
        return connection

    def hit(self, walk, vertex, distant):
        return sensor_records.SensorHit(
            dist2=self.dist2,
            cos=self.cos,
            pdf_a=self.lens_pdf,
            pdf_w=self.density,
            importance=mi.Float(1),
            position=mi.Point2f(0.5),
            active=mi.Bool(self.lens),
        )


class Flat:
    """Stand-in for `rounding.ShapeErrors`: no shape is curved, or far larger than the distances to it."""

    any = small = False

    def at(self, *_):
        return rounding.Errors(mi.Float(0), mi.Float(0), mi.Float(0))


class Directly:
    """`bsdf.BSDFDispatch` without virtual calls: stand-ins answer themselves."""

    apart = shared = False

    def __call__(self, plugin, question, *args):
        return question(plugin, *args)


class Nothing:
    """Accepts any call: film, and points (every number is a half)."""

    alpha = False
    features = stokes = None
    layers = 0
    rfilter = SimpleNamespace(is_box_filter=lambda: True)

    def colour(self, value, _):
        return mi.Color3f(value) if not mi.is_polarized else mi.Color3f(value[0, 0].x)

    def put_camera(self, *_):
        pass

    put_light = put_camera

    def stream(self, *_):
        return SimpleNamespace(rng=None)

    def series(self, *_):
        return mi.UInt32(1)

    def draw_1d(self, *_):
        return mi.Float(0.5)

    def draw_2d(self, *_):
        return mi.Point2f(0.5)


def python_loop(times):
    """``dr.while_loop`` as Python, for stand-ins that are no Dr.Jit types."""

    def loop(state, cond, body, **_):
        for _ in range(times):
            state = body(*state)
        return state

    return loop


class Inputs(SimpleNamespace):
    """Stand-in for `inputs.TraceContext`."""

    replaced, bound = inputs.TraceContext.replaced, inputs.TraceContext.bound


class Guide(guided_hits.Guiding):
    """Guides every path along itself, with ``density`` (n, k + 1) at each vertex."""

    def __init__(self, world, density, near_specular):
        super().__init__(self, near_specular)
        self.world, self.script, self.at, self.active = world, density, 0, mi.Bool(False)
        self.start = 0  # the vertex that guides

    def _evaluated(self, kernel_, vertex, d, active):
        self.at = vertex.si.script[1]
        density = dr.select(active, self.density(kernel_, vertex.si.p, 0, d), 0)
        return sds.Advice(active, mi.UInt32(0), density)

    def density(self, kernel_, p, found, d):
        return self.world.f(self.script[:, self.at])

    def visit(self, kernel_, z, walk, stream, shared, add, state):
        scene, at = self.world.scene, self.world.scene.at
        self.at, self.active = self.world.k - int(z.edges[0]), z.advice.active
        self.start = self.at
        if self.at:
            total, counters = state
            given = total, counters.non_finite, counters.guided
            with mock.patch.object(dr, "while_loop", python_loop(self.at)):
                guided_hits._follow_one(kernel_, self, z, stream, shared, add, given)
        scene.at = at
        return state

    def draw(self, p, found, u1, u2):
        """Stands in for `photon_guide.draw`."""
        return self.world.towards(self.at, self.at - 1), self.active


def kernel_weights(
    world: World, kappa: Coefficients, name: str, monkeypatch, merges=None, guide: Guide | None = None
) -> np.ndarray:
    """Weights of all strategies of the world's paths, by the unchanged kernel. With ``merges``, a
    `merging.Merging` without photons, those of the k - 1 merges follow, and `World.merged` has what was
    merged. With a ``guide`` those of guided s = 0 and s = 1 follow, see `oracle.Guided`; all are 0 where
    inactive."""
    k, scene = world.k, world.scene
    u32, f = mi.UInt32, mi.Float
    plan = SimpleNamespace(
        **dict.fromkeys(("hit", "direct", "light"), True),
        **dict.fromkeys(("roulette", "hide_emitters"), False),
        splat=kappa.splat > 0,
        endpoints=kappa.endpoints > 0,
        arrival=kappa.arrival > 0 and world.lens,
        connections="all" if kappa.inner > 0 else "none",
        camera_paths_per_light_path=1,
    )
    k_ = Inputs(
        scene=scene,
        camera=Sensor(world),
        emitters=Lights(world),
        plan=plan,
        heuristic=mis.Heuristic(name),
        traits=bsdf.Traits(full_pdf=False, round_trip=False, dispatch=Directly()),
        reverse=True,
        strategy_images=False,
        store_size=64,
        surfaces=True,
        observer=Observer(),
        max_depth=u32(k),
        rr_depth=u32(10**6),
        reach=u32(k),
        last_light=u32(k if plan.arrival else k - 1),
        last_merged=u32(k),
        count_light=f(1),
        kappa=inputs.Coefficients(
            hit=f(1),
            direct=f(1),
            splat=f(kappa.splat) if plan.splat else 0,
            endpoints=f(kappa.endpoints) if plan.endpoints else 0,
            arrival=f(kappa.arrival) if plan.arrival else 0,
            inner=f(kappa.inner) if kappa.inner > 0 else 0,
            splat_prime=f(kappa.splat_prime) if plan.splat else 0,
        ),
        refracts=True,
        points=Nothing(),
        shape_errors=Flat(),
        hits=Hits(scene, None),
        has_media=False,
        space=Vacuum(scene, Flat()),
        sds=sds.PhotonStrategy(),
        light_group=lambda index, active: None,
        path_layers=world.path_layers,
        **dict.fromkeys(("light_media", "cells", "light_groups", "sensor_medium")),
    )
    shared = Shared(mi.Float(0), mi.Color0f(), mi.Spectrum(1), mi.Float(0.5))
    if merges is not None:
        k_.sds = traced_photons(world, k_, merges, shared, monkeypatch)
        record_merges(world, monkeypatch)
    result = [f(0)] * (k + 2 + (0 if guide is None else 2 * (k - 2)))
    stored = []
    if guide is not None:
        k_.sds = guide
        monkeypatch.setattr(photon_guide, "draw", Guide.draw)

    def record(function, edges_of):
        def recorded(kernel_, *arguments):
            out = function(kernel_, *arguments)
            s, edges = edges_of(*arguments)
            if edges == k:
                result[s] = out.weight
                world.values[s], world.layers[s] = out.value, out.path_layer
                weight, value, row = out.weight, out.value, s
                if guide is not None:
                    weight, value = dr.select(out.active, weight, 0), dr.select(out.active, value, 0)
                if isinstance(arguments[-1], guided_hits._Guided):
                    row += k + 2 + 2 * (guide.start - 2)
                if row >= k + 2 or not isinstance(arguments[-1], guided_hits._Guided):
                    result[row], world.values[row] = weight, value
                world.demands.append((out.s == s) & (out.t == k + 1 - s))
            return out

        return recorded

    def edges(vertex):
        return int(vertex.edges[0])

    def connect_all(kernel_, z, path, stream, total, add):
        for y in stored:
            # Other pairs are not neighbours on a path of k edges.
            if edges(y) + edges(z) + 1 == k:
                connections.inner(kernel_, z, y)
        return total, Counters()

    for function, edges_of in (
        (techniques.hit_emitter, lambda z, *_: (0, edges(z))),
        (techniques.next_event, lambda z, *_: (1, edges(z) + 1)),
        (techniques.connect_endpoints, lambda *_: (1, 1)),
        (techniques.splat, lambda y, *_: (edges(y) + 1, edges(y) + 1)),
        (techniques.hit_sensor, lambda e, y, walk: (edges(walk) + 1, edges(walk))),
        (connections.inner, lambda z, y: (edges(y) + 1, edges(y) + edges(z) + 1)),
    ):
        monkeypatch.setattr(sys.modules[function.__module__], function.__name__, record(function, edges_of))
    monkeypatch.setattr(light_path, "store_light_vertex", lambda kernel_, y, path: stored.append(y))
    monkeypatch.setattr(connections, "connect_all", connect_all)
    monkeypatch.setattr(techniques, "sees_emitter", lambda kernel_, z: z.active)
    monkeypatch.setattr(dr, "if_stmt", lambda state, mask, then, other, **_: then(*state))

    scene.begin(from_light=True)
    monkeypatch.setattr(dr, "while_loop", python_loop(k if plan.arrival else k - 1))
    path, _, _ = kernel._light_subpath(k_, sink.Image(Nothing()), k_.points.stream(), shared, None)
    scene.begin(from_light=False)
    monkeypatch.setattr(dr, "while_loop", python_loop(k))
    place = SimpleNamespace(index=lambda i: i, pixel=lambda _: mi.Point2i(0), strip=lambda _: mi.UInt32(0))
    lane = kernel.Lane(place, shared, path)
    kernel._camera_subpath(k_, sink.Image(Nothing()), lane, u32(0), mi.Bool(True))
    dr.eval(result, world.demands)
    assert all(dr.all(x) for x in world.demands)
    if merges is not None:
        result += [world.merged[m].weight for m in range(1, k)]
    return columns(result, world.n)


@dataclass
class Unaimed:
    """A stand-in for `aim.Aim`: photons set out by the emitter's own density."""

    no_sky: bool = False

    def emission(self, emitters, u_point, u_direction, shared):
        return emitters.sample_emission(u_point, u_direction, shared, mi.Bool(True)), mi.Float(1)

    def density(self, emission, number=None):
        return emission.pdf_second


def traced_photons(world: World, k_, merges, shared, monkeypatch):
    """The photons of one light subpath for each path, by the unchanged code."""
    from mitsuba_bdpt.merging import passes  # a component, see test_components

    with monkeypatch.context() as patch:
        patch.setattr(photon_pass, "_CAPACITY", float(world.k))  # else they are traced again
        patch.setattr(subpaths, "begin_lane", lambda *_: (k_.points.stream(), shared))
        patch.setattr(dr, "while_loop", python_loop(world.k - 1))
        world.scene.begin(from_light=True)
        return passes.trace(k_, merges, Unaimed(), k_.points, world.n)[0]


def record_merges(world: World, monkeypatch):
    """Keep in ``world.merged`` the `Contribution` merged at each x_m."""
    from mitsuba_bdpt.merging import merging

    kind, draw, loop, mask = merging.Merging, merging._draw, dr.while_loop, {}
    is_merged, merged = kind.is_merged, kind.merged
    world.merged = {}

    def recorded_mask(self, kernel_, z, stream):
        mask[0] = is_merged(self, kernel_, z, stream)
        return mask[0]

    def recorded_merge(self, kernel_, z, *more):
        out, m = merged(self, kernel_, z, *more), world.k - int(z.edges[0])
        out.active = out.active & mask[0]
        out.weight = dr.select(out.active, out.weight, 0)
        world.merged[m] = out
        world.demands.append(~out.active | ((out.s == m + 1) & (out.t == world.k - m)))
        return out

    def drawn(*arguments):
        with monkeypatch.context() as patch:
            patch.setattr(dr, "while_loop", loop)
            return draw(*arguments)

    monkeypatch.setattr(kind, "is_merged", recorded_mask)
    monkeypatch.setattr(kind, "merged", recorded_merge)
    monkeypatch.setattr(merging, "_draw", drawn)


@pytest.mark.parametrize(
    "name, classes",
    [
        *((name, "odd") for name in settings.HEURISTICS),
        *(("balance", classes) for classes in ("n1c1", "n1c0-half", "n0c1", "n0c0")),
    ],
)
@pytest.mark.parametrize("lens", [False, True], ids=["pinhole", "lens"])
def test_kernel_agrees_with_explicit_densities(name, classes, lens, monkeypatch):
    """200 random paths each, a fifth of the vertices delta, half of these with a BSDF that has other lobes
    too, shading frames unrelated to geometric normals. Tolerance: cosines of at least 0.1, computed in
    float32 through a change of frame, carry 1e-5 each; up to 20 enter a weight."""
    kappa = COEFFICIENTS[classes]
    rng = np.random.default_rng(3)
    for k in (1, 2, 3, 4, 6):
        world = World(rng, 200, k, lens)
        with monkeypatch.context() as patch:
            weights = kernel_weights(world, kappa, name, patch)
        check(oracle.Explicit(world.paths, kappa), name, weights, relative=1e-3)


def test_kernel_multiplies_matrices_in_their_order(monkeypatch):
    """Throughputs of polarized variants are products of matrices. Surfaces have one random matrix for light
    towards the camera and another for light the other way. Expected: every strategy's Stokes vector is that
    of the product of the former, to 2e-3 of its intensity (changes of frames in single precision)."""
    mi.set_variant(variants.of("mono_polarized"))
    rng = np.random.default_rng(3)
    for k in (1, 2, 3, 4, 6):
        world = World(rng, 200, k, lens=True)
        with monkeypatch.context() as patch:
            kernel_weights(world, COEFFICIENTS["odd"], "balance", patch)
        expected = np.broadcast_to([1.0, 0, 0, 0], (200, 4))
        for i in range(1, k):
            expected = np.einsum("nij,nj->ni", world.matrices[i], expected)
        assert set(world.values) == set(range(k + 2))
        for s, value in world.values.items():
            vector = np.stack([np.broadcast_to(np.array(value[i, 0]).ravel(), 200) for i in range(4)], axis=1)
            used = np.isfinite(vector).all(1) & (vector[:, 0] != 0)
            assert used.sum() > 20
            found = vector[used] / vector[used, :1]
            np.testing.assert_allclose(
                found, expected[used] / expected[used, :1], atol=2e-3, err_msg=f"s={s}"
            )


@pytest.mark.parametrize(
    "name, classes, lens, least",
    [
        ("balance", "odd", True, 0.0),
        ("balance", "odd", True, 1.0),
        ("balance", "n0c0", True, 1.0),
        ("power", "quarter", True, 1.0),
        ("balance", "n1c0-half", False, 1.0),
        ("power", "n1c1", False, 0.0),
    ],
)
def test_kernel_with_merges(name, classes, lens, least, monkeypatch):
    """As above, with merges on paths that connections sample too. Bounds from one side that are not exact are
    off (`merging.SLACK`), eta is spread over three orders of magnitude. A merge's estimate is the photon's
    flux over eta and the cosine towards the light's side; the flux is 1 / density of the events before it,
    times their adjoint factors."""
    from mitsuba_bdpt.merging import merging
    from mitsuba_bdpt.merging.radius import Radius

    monkeypatch.setattr(mis, "MERGE_DOMINATED", least)
    monkeypatch.setattr(merging, "SLACK", 1e30)
    kappa, rng, share, total = COEFFICIENTS[classes], np.random.default_rng(9), 0.3, 0
    for k in (2, 3, 5):
        world = World(rng, 1000, k, lens)
        centre, angle, low, high, count = (0.2, -0.1, 0.3), 1e-3, 2.5e-4, 2e-3, 10.0 ** (3 + k / 2)
        radius = Radius(mi.Point3f(*centre), *(mi.Float(x) for x in (0.0, angle, low, high)))
        with monkeypatch.context() as patch:
            merges = merging.Merging(radius, mi.Float(count), mi.Float(share))
            weights = kernel_weights(world, kappa, name, patch, merges)
        distance = np.linalg.norm(world.position.astype(np.float64) - centre, axis=2)
        eta = share * count * np.pi * np.clip(angle * distance, low, high) ** 2
        volume = np.zeros_like(world.paths.delta)
        explicit = oracle.Merged(world.paths, kappa, eta, least, name, volume)
        check_merged(explicit, name, weights, 1e-3, world.paths.delta)
        sure, paths, inner = ~explicit.near, world.paths, slice(1, k)
        towards_light = paths.cos_camera[:, : k - 1]  # at x_1 ... x_{k-1}
        flux = np.where(paths.delta, 1, paths.to_camera)[:, inner]
        flux = np.cumprod(paths.cos_light[:, inner] / towards_light / flux, axis=1)
        flux = np.concatenate([np.ones((1000, 1)), flux[:, :-1]], axis=1)
        at = explicit.used[:, k + 2 :] & sure[:, None]
        value = columns([world.merged[m].value[0] for m in range(1, k)], 1000)
        np.testing.assert_allclose(value[at], (share * flux / (eta[:, inner] * towards_light))[at], rtol=1e-3)
        total += (explicit.merged & sure).sum()
    assert total > 100


def layers_of(paths) -> np.ndarray:
    """Path layers by definition: by rough events, and those beyond the first one."""
    densities = np.minimum(paths.to_camera, paths.to_light)[:, 1 : paths.k]
    specular = paths.delta[:, 1 : paths.k] | (densities >= near_specular.NARROW)
    found = []
    for events in specular:  # from the emitter to the camera
        (rough,) = np.nonzero(~events)
        lit = "direct" if 0 in rough else "caustic"
        name = ("emission", lit, "indirect")[min(len(rough), 2)]
        found.append(NAMES.index(name))
    return np.array(found)


@pytest.mark.parametrize("kind", ["alone", "merging"])
def test_strategies_agree_on_path_layers(kind, monkeypatch):
    """Each strategy knows the events of two halves of a path. Half of the vertices are delta, the others
    near-specular at half of the densities."""
    from mitsuba_bdpt.merging.merging import Merging
    from mitsuba_bdpt.merging.radius import Radius

    monkeypatch.setattr(near_specular, "NARROW", 0.3)
    monkeypatch.setattr(mis, "MERGE_DOMINATED", 0.0)
    rng, met = np.random.default_rng(4), np.zeros((len(NAMES), 2), dtype=int)
    for k in {"alone": (1, 2, 3, 4, 5), "merging": (3,)}[kind]:
        world, merges = World(rng, 800, k, True, delta=0.5), None
        world.path_layers = True
        if kind != "alone":
            radius = Radius(mi.Point3f(0.0), *(mi.Float(x) for x in (0.0, 1e-3, 2.5e-4, 2e-3)))
            merges = Merging(radius, mi.Float(1e4), mi.Float(0.3))
        with monkeypatch.context() as patch:
            kernel_weights(world, COEFFICIENTS["odd"], "balance", patch, merges)
        expected, paths = layers_of(world.paths), world.paths
        used = oracle.Explicit(paths, COEFFICIENTS["odd"]).used
        found = [(f"s={s}", layer, used[:, s]) for s, layer in world.layers.items()]
        assert len(found) == k + 2
        for m, c in world.merged.items():
            # Where the event is delta on a BSDF with other lobes, a merge samples another path.
            found.append((f"merge at {m}", c.path_layer, c.active.numpy() & ~paths.delta[:, m]))
        for strategy, layer, sampled in found:
            layer = np.broadcast_to(layer.numpy(), len(expected))
            np.testing.assert_array_equal(layer[sampled], expected[sampled], err_msg=f"{k}, {strategy}")
            met[:, int(strategy.startswith("merge"))] += np.bincount(layer[sampled], minlength=len(NAMES))
    merged = {"alone": (), "merging": (DIRECT, INDIRECT, CAUSTIC)}[kind]
    assert (met[:, 0] > 20).all() and (met[merged, 1] > 20).all()


def guided_estimates(world: World, weights) -> np.ndarray:
    """Weighted estimates of guided s = 0 and s = 1, over those without the guide."""
    first, found = world.k + 2, []
    for s in range(first, weights.shape[1]):
        value, plain = (np.array(world.values.get(i, [0])[0]) for i in (s, (s - first) % 2))
        found.append(weights[:, s] * value / np.where(plain > 0, plain, 1))
    return np.array(found).reshape(-1, len(weights)).T


@pytest.mark.parametrize(
    "name, classes, lens, near",
    [
        ("balance", "n1c1", True, True),
        ("balance", "odd", False, True),
        ("power", "quarter", True, True),
        ("balance", "n1c0-half", True, True),
        ("balance", "n0c0", False, True),
        ("balance", "odd", False, False),
        ("balance", "odd", True, False),
        ("power", "quarter", True, False),
    ],
)
def test_kernel_guides_through_specular_events(name, classes, lens, near, monkeypatch):
    """Which paths are SDS paths is decided by every strategy from its own subpaths. Guided subpaths are
    traced by the unchanged code, as if from a guide of densities over four orders of magnitude. Of 1,000
    paths a tenth of the vertices are delta, half of the others specular by their densities; of 300 more than
    half are delta, and all others specular. Unless ``near`` half are delta, none of the others is
    specular, and a tenth of the lamps can only be hit. Expected: weights to 1e-3, 0 where the oracle has
    none; guided estimates times weights are the oracle's weights over the guide's density (stand-ins of BSDFs
    have value 1)."""
    kappa, rng, total, pure = COEFFICIENTS[classes], np.random.default_rng(12), 0, 0
    least = near_specular.SPECULAR if near else np.inf
    for k in (3, 4, 5):
        world = World(rng, 1000, k, lens, delta=0.1 if near else 0.5)
        if not near:
            world.paths.first[::10] = world.paths.direct[::10] = 0
        world.mixed[:] = False  # the guide would follow the other lobes of these
        density = (10.0 ** rng.uniform(-2, 2, (1000, k + 1))).astype(np.float32)
        chosen = rng.random((1000, k + 1)) < 0.5
        world.paths.delta[:300, 1:k] = rng.random((300, k - 1)) < 0.6
        chosen[:300] = True
        for pdf in (world.paths.to_camera, world.paths.to_light):
            pdf[chosen] = np.maximum(pdf[chosen], 1.1 * near_specular.SPECULAR)
        with monkeypatch.context() as patch:
            weights = kernel_weights(world, kappa, name, patch, guide=Guide(world, density, near))
        explicit = oracle.Guided(world.paths, kappa, density, least)
        expected, used = explicit.weights(name), explicit.used
        own = slice(None), slice(k + 2)
        weights[:, k + 2 :] = guided_estimates(world, weights)
        expected[:, k + 2 :] /= np.repeat(density[:, 2:k], 2, axis=1)
        np.testing.assert_allclose(
            np.where(used, weights, 0), expected, rtol=1e-3, atol=1e-30, err_msg=f"k={k}"
        )
        possible = oracle.Explicit(world.paths, kappa).used  # others end at delta events
        assert not weights[own][possible & ~used[own]].any()
        assert not weights[:, k + 2 :][~used[:, k + 2 :] & ~world.paths.delta_emitter[:, None]].any()
        total, pure = total + explicit.sds.sum(), pure + explicit.pure.sum()
    assert total > 100 and (pure > 30 or not near)
