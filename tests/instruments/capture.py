"""Paths that the kernel itself makes, vertex by vertex, with the weights that it gives them. The kernel runs
unchanged, its loops step by step. Densities of each path from both sides are evaluated anew: BSDFs by their
``pdf``, endpoints in closed form (`endpoints`)."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, fields

import drjit as dr
import numpy as np
from mitsuba_bdpt.emitters.area import PLAIN
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.emitters.infinite import SKY_BINS
from mitsuba_bdpt.emitters.tables import cell_at, in_order
from mitsuba_bdpt.geometry import rays
from mitsuba_bdpt.geometry.smooth_meshes import is_flat
from mitsuba_bdpt.host.jit import evaluated_mode, gc_paused
from mitsuba_bdpt.run import rendering
from mitsuba_bdpt.sampling.points import Points, Purpose
from mitsuba_bdpt.transport import bsdf, kernel, techniques
from mitsuba_bdpt.transport.batch import Batch

import mitsuba as mi  # isort: skip

from mitsuba_bdpt.transport import connections
from mitsuba_bdpt.transport.contribution import Counters
from mitsuba_bdpt.transport.inputs import Observer

from .chains import recursion
from .endpoints import Camera, disks_of, dot, lamps_of, length2
from .oracle import AREA, DIRECTIONAL, ENVIRONMENT, Coefficients, Explicit, Paths

# Angle over cosine between the ray along an edge, which starts beside its surface, and the line between the
# edge's vertices. Both serve as its direction.
MOST_TURNED = 1e-3


@dataclass
class Point:
    """A vertex of paths: position, geometric normal, densities of the directions to both neighbours, whether
    its event is a delta one."""

    p: np.ndarray
    n: np.ndarray
    to_camera: np.ndarray
    to_light: np.ndarray
    delta: np.ndarray


POINT = tuple(f.name for f in fields(Point))


@dataclass
class Walked:
    """A walk from vertex 1 on: ``vertices``, directions ``d`` of the edges to them, `Point` where the walk
    went on; ``origin`` vertex 0."""

    origin: object = None
    vertices: list = field(default_factory=list)
    d: list = field(default_factory=list)
    points: list = field(default_factory=list)


@dataclass
class Made:
    """Paths with ``s`` light vertices and their ``weights`` by the kernel. ``unsure`` counts those left out,
    where rounding decides which disk light from infinity has started on, whether a point lies on a lamp, the
    density of an environment map at its poles, or the cosines of a short edge (`MOST_TURNED`)."""

    s: int
    weights: np.ndarray
    paths: Paths
    unsure: int


def float64(x) -> np.ndarray:
    """Without NumPy warnings for NaN in masked lanes."""
    with np.errstate(invalid="ignore"):
        return np.array(x, dtype=np.float64)


@contextlib.contextmanager
def stepwise(kernel_):
    """Dr.Jit runs loops and branches of a kernel step by step, so that their state can be read. As for a
    render the cycle collector is paused, and calls go step by step where an emitter needs it."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(gc_paused())
        stack.enter_context(evaluated_mode(kernel_.emitters.evaluated))
        for flag in (dr.JitFlag.SymbolicLoops, dr.JitFlag.SymbolicConditionals):
            stack.enter_context(dr.scoped_set_flag(flag, False))
        yield


def run(kernel_, recorder, seed: int):
    """Trace ``recorder.lanes`` lanes; the recorder is sink and observer."""
    pixels = int(np.prod(kernel_.camera.region.size))
    # So many that each of the lanes has a light subpath of its own.
    samples = -(-recorder.lanes * kernel_.plan.camera_paths_per_light_path // pixels)
    batch = Batch(0, pixels, 0, samples)
    points = Points("independent", dr.opaque(mi.UInt32, seed))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, False), stepwise(kernel_):
        dr.eval(kernel.trace(kernel_, recorder, batch, points, samples, recorder))


def rows(v) -> np.ndarray:
    return float64(v).T


def densities(si, to_light, to_camera):
    """Solid-angle densities with which the BSDF samples each of two local directions from the other:
    ``to_camera``, then ``to_light``."""
    ctx, plugin = mi.BSDFContext(), si.bsdf()
    forward = plugin.pdf(ctx, bsdf.with_wi(si, to_light), to_camera)
    return forward, plugin.pdf(ctx, bsdf.with_wi(si, to_camera), to_light)


class Tables:
    """Densities of guided emission in closed form; frames and what is flat are the package's."""

    def __init__(self, scene, tables):
        self.tables, self.side = tables.densities(), tables.side
        world = Emitters(scene)
        self.emitters, self.counts, self.disks = world.objects, world.tables, world.disks

    def second(self, number, own, x1, d):
        """That of x_1 from the emitter ``number``, whose density without tables is ``own``."""
        emitter, name = self.emitters[number], self.emitters[number].class_name()
        shape, v = emitter.get_shape(), mi.Vector3f(*(mi.Float(np.float32(x)) for x in d.T))
        if not self.counts[number]:
            return own
        if name == "SpotLight":
            turn = mi.traverse(emitter)["to_world"]
            cutoff = dr.cos(dr.deg2rad(mi.Float(mi.traverse(emitter)["cutoff_angle"])))
            local = dr.normalize(turn.inverse() @ v)
            return own * self._density(number, mi.warp.uniform_cone_to_square(local, cutoff))
        if name == "PointLight":
            return own * self._density(number, mi.warp.uniform_cone_to_square(v, mi.Float(-1)))
        if shape is None:
            p = mi.Point3f(*(mi.Float(np.float32(x)) for x in x1.T))
            u = mi.warp.uniform_sphere_to_square(v)
            bins = 0 if name == "DirectionalEmitter" else cell_at(u, SKY_BINS)
            return own * self._density(number, self.disks.place(p, v), bins)
        if is_flat(shape):
            n = mi.Vector3f(shape.sample_position(0, mi.Point2f(0.5)).n)
            u = mi.warp.cosine_hemisphere_to_square(mi.Frame3f(n).to_local(v))
            return own * self._density(number, u)
        u = mi.warp.uniform_hemisphere_to_square(dr.select(v.z < 0, -v, v))
        return PLAIN * own + (1 - PLAIN) * (own > 0) * self._density(number, u) / (2 * np.pi)

    def _density(self, number, u, bins=0):
        first = sum(self.counts[:number])
        cells = np.minimum((np.clip(np.array(u), 0, 1) * self.side).astype(int), self.side - 1)
        return self.tables[first + np.array(bins), cells[1], cells[0]]


class Capture(Observer):
    """One run of the kernel over ``lanes`` pairs of subpaths, of which it is sink and observer."""

    def __init__(self, scene, integrator, lanes: int, seed: int):
        self.scene, self.lanes = scene, lanes
        render = rendering.Render(scene, scene.sensors()[0], integrator.settings, seed, 1)
        render.decide()  # what is decided by hand, if anything is
        self.world, self.plan = render.prepared, render.plan
        self.depth = integrator.settings.max_depth
        self.lamps, self.camera = lamps_of(scene), Camera.of(scene.sensors()[0])
        self.disks = disks_of(self.world.emitters.disks)
        tables = self.plan.emission
        if tables is not None and self.disks is not None and not self.world.emitters.disks.share(tables.side):
            # Tables do what the disk of the details does.
            self.disks.spheres = [(*self.disks.spheres[0][:2], 1.0)]
        self.tables = None if self.plan.emission is None else Tables(scene, self.plan.emission)
        self.walked = {"light": Walked(), "camera": Walked()}
        self.found, self.endpoint = {}, {}
        run(render.kernel, self, seed)

    @property
    def coefficients(self) -> Coefficients:
        kappa = self.kernel.kappa
        names = ("endpoints", "splat", "inner", "arrival")
        return Coefficients(*(float(np.array(getattr(kappa, name)).ravel()[0]) for name in names))

    # -- what the kernel shows an `Observer` ---------------------------------------------------

    def emitted(self, emission):
        dr.eval(emission)
        self.emission = emission

    def started(self, bound, side, walk):
        self.kernel, self.stream, self.walking = bound, side.stream, self.walked[side.name]
        self.walking.origin = mi.Point3f(walk.previous)
        dr.eval(self.walking.origin)
        if side.adjoint and self.plan.endpoints:
            u = techniques._sensor_points(bound, side.stream)
            connection = bound.camera.connect(self.emission.si.p, *u)
            if not bound.camera.parallel:
                distant = bound.camera.connect_direction(self.emission.d, *u)
                connection = dr.select(self.emission.infinite, distant, connection)
            self._keep_endpoint(1, 1, connection)

    def vertex(self, side, walk, vertex, step):
        pair = (vertex.si.wi, step.wo) if side.adjoint else (step.wo, vertex.si.wi)
        asked = densities(vertex.si, *pair)
        dr.eval(vertex, step, asked, walk)
        self.walking.vertices.append(vertex)
        self.walking.d.append(self._wide(rows(walk.d)))
        self.walking.points.append(self._point(vertex.si, *(rows(x) for x in asked), np.array(step.delta)))
        reached = len(self.walking.vertices)
        if side.adjoint and self.plan.arrival:
            self._keep_endpoint(reached + 1, 0, self._on_lens(vertex, walk))
        if not side.adjoint and self.plan.direct:
            u = self.kernel.points.draw_2d("camera", self.stream, Purpose.EMITTER, vertex.edges)
            self._keep_endpoint(1, reached + 1, u)

    def _keep_endpoint(self, s, t, endpoint):
        dr.eval(endpoint)
        self.endpoint[s, t] = endpoint

    # Where the kernel puts contributions: it has a sink, see `sink`.

    alpha = False

    def begin(self):
        return mi.Float(0)

    def add(self, kernel_, c, total, start, shared):
        """s = 0 and s = 1."""
        self._keep(0 if c.kind == "hit" else 1, len(self.walking.vertices) + 1, c)
        return total

    def connect(self, kernel_, z, lane, stream, total, start):
        """Inner connections are made afterwards, see `made`."""
        return total, Counters()

    def splat(self, kernel_, c, shared, stream):
        """(1,1), t = 1 and t = 0."""
        self._keep(len(self.walked["light"].vertices) + 1, int(c.t[0]), c)
        return Counters()

    def end(self, *_):
        return Counters()

    def _keep(self, s, t, c):
        dr.eval(c)
        self.found[s, t] = c

    def _point(self, si, to_camera, to_light, delta=False) -> Point:
        arrays = (np.broadcast_to(x, self.lanes) for x in (to_camera, to_light, delta))
        return Point(self._wide(rows(si.p)), self._wide(rows(si.n)), *arrays)

    def _on_lens(self, vertex, walk):
        distance2 = self.kernel.camera.hit(walk, vertex, mi.Bool(False)).dist2
        return walk.previous + walk.d * dr.sqrt(distance2)

    # -- paths ------------------------------------------------------------------------------

    def made(self):
        """All paths, by s and number of edges."""
        for (s, t), c in sorted(self.found.items()):
            if s + t <= self.depth + 1:
                yield self._made(s, t, c)
        if self.plan.connections == "none":
            return
        # Of "one" too: all are weighed, whichever is then drawn.
        lights, cameras = (len(self.walked[name].vertices) for name in ("light", "camera"))
        for s in range(2, min(self.depth, lights + 2)):
            for t in range(2, min(self.depth + 2 - s, cameras + 2)):
                yield self._inner(s, t)

    def _inner(self, s, t):
        y, z = self.walked["light"].vertices[s - 2], self.walked["camera"].vertices[t - 2]
        c = connections.inner(self.kernel, z, y)
        c.active &= y.hit & bsdf.connectible(y.bsdf) & bsdf.connectible(z.bsdf)
        ray = rays.segment(z.anchor, y.anchor, z.si)
        c.active &= ~self.scene.ray_test(ray, active=c.active)
        return self._made(s, t, c)

    def _made(self, s, t, c) -> Made:
        points, d = self._joined(s, t)
        index = self._index(s, t)
        keep = np.flatnonzero(np.broadcast_to(np.array(c.active), self.lanes))
        weights = np.broadcast_to(np.array(c.weight), self.lanes)[keep]
        stacked = [np.stack([getattr(v, name)[keep] for v in points], axis=1) for name in POINT]
        paths, sure = self._paths(index[keep], stacked, np.stack([edge[keep] for edge in d], axis=1))
        return Made(s, weights[sure], paths.of(sure), int((~sure).sum()))

    def _paths(self, index, stacked, d):
        """The `Paths` through vertices (``stacked``: fields of `Point` side by side) along the directions
        ``d``; and where their densities are certain."""
        x, n, *pdfs = stacked
        kind = np.array([lamp.kind for lamp in self.lamps])[index]
        infinite = (kind == ENVIRONMENT) | (kind == DIRECTIONAL)
        between = x[:, 1:] - x[:, :-1]
        dist2 = length2(between)
        turned = np.sqrt(length2(between / np.sqrt(dist2)[..., None] - d))
        turned[infinite, 0] = 0
        cos_light, cos_camera = np.abs(dot(n[:, :-1], d)), np.abs(dot(n[:, 1:], d))
        dist2[infinite, 0], cos_light[kind != AREA, 0] = 1, 1
        cos_camera[:, -1] = np.abs(d[:, -1] @ self.camera.axis)
        ends = self._ends(index, x, d, dist2, cos_light)
        lens = np.full(len(d), self.camera.radius > 0)
        lens_pdf = np.full(len(d), self.camera.lens_density())
        camera = lens, lens_pdf, self.camera.density(d[:, -1])
        sure = (turned < MOST_TURNED * np.minimum(cos_light, cos_camera)).all(1)
        if self.disks is not None:
            sure &= ~(infinite & self.disks.unsure(x[:, 1], d[:, 0]))
        for number, lamp in enumerate(self.lamps):
            sure &= ~((index == number) & lamp.unsure(x[:, 1], d[:, 0]))
        return Paths(dist2, cos_light, cos_camera, *pdfs, kind, *ends, *camera), sure

    def _ends(self, index, x, d, dist2, cos_light):
        """Densities of the emitter's strategies: ``first``, ``second``, ``direct``."""
        first, second, direct = (np.zeros(len(index)) for _ in range(3))
        for number, lamp in enumerate(self.lamps):
            of = index == number
            if not of.any():
                continue
            x1, leaving, cos = x[of, 1], d[of, 0], cos_light[of, 0]
            first[of] = lamp.first(leaving)
            second[of] = lamp.second(cos, x1, leaving, self.disks)
            if self.tables is not None:
                second[of] = self.tables.second(number, second[of], x1, leaving)
            direct[of] = lamp.direct(cos, dist2[of, 0], x1, leaving)
            if lamp.kind in (ENVIRONMENT, DIRECTIONAL) and x.shape[1] == 2:
                second[of] *= self.disks.covers(x1, leaving)
        return first, second, direct

    def _index(self, s, t):
        if s >= 2 or (s, t) == (1, 1):
            found = np.array(self.emission.index)
        elif s == 1:
            chosen, _ = Emitters(self.scene)._select(self.endpoint[s, t].x, mi.Bool(True))
            found = np.array(chosen.index)
        else:
            pointers = np.array(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(in_order(self.scene))))
            hit = self.walked["camera"].vertices[t - 2].si.emitter(self.scene)
            ids = np.array(dr.reinterpret_array(mi.UInt32, hit))
            found = np.argmax(ids[:, None] == pointers, axis=1)
        return np.broadcast_to(found, self.lanes).astype(int)

    def _joined(self, s, t):
        """All vertices as `Point` from the light on, and the directions of light along the edges."""
        light, camera = self.walked["light"], self.walked["camera"]
        towards, between, first, last = None, [], [], []
        y = light.vertices[s - 2] if s >= 2 and t else None
        z = camera.vertices[t - 2] if t >= 2 and s else None
        if s == 0:
            first = [self._free(camera.vertices[t - 2].si.p, camera.vertices[t - 2].si.n)]
        elif s == 1 and t >= 2:
            first = [self._free(z.endpoint.anchor.p, z.endpoint.anchor.n)]
            towards = -z.endpoint.d
        else:
            first = [self._free(self.emission.si.p, self.emission.anchor.n)]
        if t >= 2:
            last = [self._free(camera.origin)]
        elif t == 1:
            connection = y.endpoint if y is not None else self.endpoint[1, 1]
            last, towards = [self._free(connection.p)], connection.d
        else:
            last = [self._free(self.endpoint[s, 0])]
        if y is not None and z is not None:
            towards = dr.normalize(z.si.p - y.si.p)
        if towards is not None:
            between = [self._wide(rows(towards))]
        middle = [*light.points[: max(s - 2, 0)]]
        middle += [self._at(y.si, y.si.wi, y.si.to_local(towards))] if y is not None else []
        middle += [self._at(z.si, z.si.to_local(-towards), z.si.wi)] if z is not None else []
        middle += camera.points[: max(t - 2, 0)][::-1]
        back = [-d for d in camera.d[: max(t - 1, 0)]][::-1]
        return [*first, *middle, *last], [*light.d[: max(s - 1, 0)], *between, *back]

    def _free(self, p, n=(0, 0, 0)) -> Point:
        zeros = np.zeros(self.lanes)
        return Point(self._wide(rows(p)), self._wide(rows(n)), zeros, zeros, zeros.astype(bool))

    def _at(self, si, to_light, to_camera) -> Point:
        """A surface's point at an end of the connecting edge."""
        asked = densities(si, to_light, to_camera)
        dr.eval(asked)
        return self._point(si, *(rows(x) for x in asked))

    def _wide(self, array):
        return np.broadcast_to(array, (self.lanes, 3))


# Of the weight of a strategy, and of the sum of all of a path: float32 alone is off by 1e-6, some ten
# roundings of 6e-8 per vertex; edges may be turned by 1e-3 of a cosine, and densities by as much.
TOLERANCE = 1e-3


@dataclass
class Weighed:
    """``bad`` paths have a weight that is negative, above 1 or not finite, ``off`` ones a sum, with the
    weights of other strategies by the recursion, that is not 1; ``wrong``: weights by the kernel that differ
    from those by explicit densities, ``differ`` the largest difference; ``unsure`` see `Made`."""

    paths: int = 0
    bad: int = 0
    off: int = 0
    wrong: int = 0
    unsure: int = 0
    differ: float = 0.0

    def add(self, capture: Capture, heuristic: str) -> None:
        for m in capture.made():
            if not len(m.weights):
                continue
            explicit = Explicit(m.paths, capture.coefficients)
            weights, used = recursion(m.paths, capture.coefficients, heuristic), explicit.used.copy()
            weights[:, m.s], used[:, m.s] = m.weights, True
            gap = np.abs(m.weights - explicit.weights(heuristic)[:, m.s])
            self.paths += len(m.weights)
            self.bad += int((used & ~((weights >= 0) & (weights <= 1))).any(1).sum())
            self.off += int((~(np.abs(np.where(used, weights, 0).sum(1) - 1) <= TOLERANCE)).sum())
            self.wrong += int((~(gap <= TOLERANCE)).sum())
            self.unsure += m.unsure
            self.differ = max(self.differ, float(np.nan_to_num(gap, nan=np.inf).max()))
