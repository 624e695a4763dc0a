"""Samples of a render that stand out, and the paths that made them. `render` keeps which camera samples and
splats are large; `replay` traces these again, loop by loop, with the code and the random numbers of the
render, and records every vertex and contribution."""

from __future__ import annotations

import contextlib
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import pairwise
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.geometry import polarization
from mitsuba_bdpt.host.jit import evaluated_mode, gc_paused
from mitsuba_bdpt.image import sink
from mitsuba_bdpt.planning import planner
from mitsuba_bdpt.run import rendering
from mitsuba_bdpt.sampling.points import Points
from mitsuba_bdpt.transport import connections, kernel
from mitsuba_bdpt.transport.batch import Batch
from mitsuba_bdpt.transport.contribution import Counters
from mitsuba_bdpt.transport.inputs import Observer, TraceContext

# Outliers kept of one launch, and what is kept of each: lane, pixel, colours, strategy of a splat.
CAPACITY, COLUMNS = 1 << 16, 8
MOST_LANES = 1 << 24  # exact in single precision


def float64(x) -> np.ndarray:
    """Without NumPy warnings for NaN in masked lanes."""
    with np.errstate(invalid="ignore"):
        return np.array(x, dtype=np.float64)


@dataclass(frozen=True)
class Launch:
    """The arguments of `kernel.trace`, with the kernel as it was then, and the width of the film."""

    kernel: TraceContext
    batch: Batch
    points: Points
    spp: int
    width: int


@dataclass(frozen=True)
class Outlier:
    """A sample that adds ``value`` (three colours) over the pixel's samples to the pixel (``x``, ``y``): the
    camera sample ``slot`` of a ``launch``, or a splat of its light subpath; ``s`` and ``t`` of a splat, 0 for
    camera samples."""

    launch: Launch
    slot: int
    x: int
    y: int
    value: np.ndarray
    s: int
    t: int


class Collector(sink.Image):
    """The sink of a render; keeps what is larger than ``least`` (three numbers for each pixel). Raises
    ``CommandError`` for a launch of too many ``lanes``."""

    def __init__(self, film, least, lanes: int):
        super().__init__(film)
        if lanes > MOST_LANES:
            raise CommandError(
                f"{lanes} lanes in a launch, more than {MOST_LANES}: set a smaller spp_per_pass"
            )
        self._least, self._lanes, self._width = mi.Float(least.ravel()), lanes, film.size[0]
        dr.make_opaque(self._least)
        # A number and rows for each place that keeps: Dr.Jit cannot count twice in one loop.
        self.kept = []

    def splat(self, kernel, c, shared, stream):
        self._keep(c.position, polarization.scaled(c.weighted(), shared.weight), shared, (c.s, c.t), c.active)
        return super().splat(kernel, c, shared, stream)

    def end(self, kernel, lane, sample, total, seen):
        value = polarization.scaled(total, lane.shared.weight)
        self._keep(sample.start.counted, value, lane.shared, (0, 0), sample.covered)
        return super().end(kernel, lane, sample, total, seen)

    def _keep(self, position, value, shared, strategy, active):
        colours = mi.Color3f(*self._film.colour(value, shared.wavelengths))
        pixel = mi.Point2i(dr.floor(position)) - mi.Point2i(self._film.offset)
        active = active & dr.all((pixel >= 0) & (pixel < mi.Point2i(self._film.size)))
        index = mi.UInt32(pixel.y * self._width + pixel.x)
        active &= dr.any(colours > dr.gather(mi.Color3f, self._least, index, active))
        count, rows = dr.zeros(mi.UInt32, 1), dr.zeros(mi.Float, CAPACITY * COLUMNS)
        dr.make_opaque(count, rows)
        self.kept.append((count, rows))
        row = dr.scatter_inc(count, mi.UInt32(0), active)
        values = [dr.arange(mi.UInt32, self._lanes), pixel.x, pixel.y, *colours, *strategy]
        packet = mi.ArrayXf([mi.Float(x) for x in values])
        dr.scatter_reduce(dr.ReduceOp.Add, rows, packet, row, active & (row < CAPACITY))

    def found(self, launch: Launch) -> list[Outlier]:
        """What was kept; raises ``CommandError`` if that was too much."""
        found = []
        for number, rows in self.kept:
            count = int(number[0])
            if count > CAPACITY:
                raise CommandError(f"{count} samples stand out, more than {CAPACITY}: raise the level")
            numbers = np.array(rows, dtype=float).reshape(-1, COLUMNS)[:count]
            for row, slot in zip(numbers, _slots(launch, numbers), strict=True):
                x, y, s, t = (int(row[i]) for i in (1, 2, 6, 7))
                found.append(Outlier(launch, slot, x, y, row[3:6], s, t))
        return found


def _slots(launch: Launch, rows) -> list[int]:
    """The camera samples that outliers are of: of those that share a lane that in the outlier's pixel, for
    splats that of the first part, whose slot is the lane."""
    if not len(rows):
        return []
    batch = launch.batch
    lane, x, y, splat = (rows[:, i].astype(int) for i in (0, 1, 2, 6))
    pixel = y * launch.width + x - batch.first_pixel
    sharing = kernel.shared_by(launch.kernel, batch, launch.points)
    slots, slot = sharing.slots(mi.UInt32(lane)), mi.UInt32(lane)
    for part in range(launch.kernel.plan.camera_paths):
        taken = slots(mi.UInt32(part))
        here = (taken // batch.samples == mi.UInt32(pixel)) & mi.Mask(splat == 0)
        slot = dr.select(here, taken, slot)
    return np.broadcast_to(np.array(slot), len(rows)).tolist()


def render(scene, integrator, least, spp: int, seed: int):
    """The image of a render, and the `Outlier` objects larger than ``least`` (of the image's shape) in one of
    the colours, largest first. Lanes keep one light subpath each (`Plan.joined`), and ``merging=auto`` does
    not merge. Raises ``CommandError`` for a film of other colours, for ``merging=true``, where s = 0 or
    emission is guided, and for decisions that join more."""
    film = scene.sensors()[0].film()
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        raise CommandError(f"film '{film.id()}' of class {film.class_name()} is not RGB; use hdrfilm")
    if integrator.settings.merging is True:
        raise CommandError("merging=true: paths that are merged are not looked at; leave out merging")
    outliers = []

    def trace(traced, image, batch, points, of):
        if traced.plan.guided:
            raise CommandError("paths that are guided are not looked at; set guiding=never")
        if traced.plan.emission is not None:  # whose densities nobody but the kernel knows
            raise CommandError("paths whose emission is guided are not looked at; set guiding=photons")
        if traced.plan.joined > 1:
            raise CommandError(
                "decisions: lanes with several light subpaths are not looked at; set joined=1 in them"
            )
        launch = Launch(copy(traced), batch, points, of, int(film.crop_size()[0]))
        collector = Collector(image._film, least, kernel.shared_by(traced, batch, points).lanes)
        counts = kernel.trace(traced, collector, batch, points, of)
        image._film.evaluate(counts, collector.kept)
        outliers.extend(collector.found(launch))
        return counts

    one = mock.patch.object(planner, "JOINED", (1,))  # of which cached results know
    each = mock.patch.object(planner.Planner, "_is_worth_joining", return_value=False)
    unmerged = mock.patch.object(integrator, "settings", replace(integrator.settings, merging=False))
    with one, each, unmerged, mock.patch.object(rendering, "trace", trace):
        image = np.array(integrator.render(scene, spp=spp, seed=seed))[..., :3]
    outliers.sort(key=lambda found: -(found.value / least[found.y, found.x]).max())
    return image, outliers


# -- replaying --------------------------------------------------------------------------------


@dataclass
class Path:
    """A path by its vertices, z_0 first and y_0 last, and what it adds. Positions ``p`` (k + 1, 3), of an
    emitter at infinity the direction to it (``infinite``); ``shapes`` numbers of Dr.Jit, 0 for none;
    ``delta``: the event was a delta event. ``value`` (three colours) what the strategy adds with the
    ``weight``, roulette and the draw of a connection included; ``estimate`` without these, unweighted.
    ``pdf_w`` of the sensor's direction. ``survival``: probability with which roulette let both subpaths
    live."""

    s: int
    t: int
    value: np.ndarray
    estimate: np.ndarray
    weight: float
    pdf_w: float
    p: np.ndarray
    shapes: list
    delta: list
    infinite: bool
    survival: float = 1.0


@dataclass
class _Visit:
    """What a walk left at a vertex, arrays of the lanes. ``number`` of the vertex in its subpath, 1 after the
    endpoint (kept where a surface is passed); ``departed``: throughput with which the edge to it began;
    ``joined``: position (or direction, where ``infinite``) of the endpoint connected to; ``pdf_w`` of the
    sensor's direction there."""

    p: np.ndarray
    shape: np.ndarray
    delta: np.ndarray
    hit: np.ndarray
    throughput: np.ndarray
    weight: np.ndarray
    number: np.ndarray
    departed: np.ndarray
    joined: np.ndarray | None = None
    infinite: np.ndarray | None = None
    pdf_w: np.ndarray | None = None


@dataclass
class _Subpath:
    """Position of its endpoint (``start``, where ``infinite`` the direction to it), and the further
    vertices."""

    start: np.ndarray
    infinite: np.ndarray
    visits: list = field(default_factory=list)

    def chain(self, count: int, i: int, before: int | None = None) -> list[int]:
        """Places in ``visits`` of the ``count`` - 1 vertices after the endpoint in lane ``i``, in order: the
        last vertex is the latest of its number ``before`` a place, each other one before the next. Fewer if
        there are not so many."""
        found, before = [], len(self.visits) if before is None else before
        for number in range(count - 1, 0, -1):
            places = [k for k in range(before) if self.visits[k].number[i] == number]
            if places:
                found.append(before := places[-1])
        return found[::-1]

    def ends_at(self, s: int, i: int):
        """Position of the vertex ``s`` - 1 in lane ``i``; infinite if there is none."""
        places = self.chain(s, i)
        return self.visits[places[-1]].p[:, i] if len(places) == s - 1 > 0 else np.full(3, np.inf)


@contextlib.contextmanager
def stepwise(traced: TraceContext):
    """Dr.Jit runs loops and branches of a kernel step by step, so that their state can be read. As for a
    render the cycle collector is paused, and calls go step by step where an emitter needs it."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(gc_paused())
        stack.enter_context(evaluated_mode(traced.emitters.evaluated))
        for flag in (dr.JitFlag.SymbolicLoops, dr.JitFlag.SymbolicConditionals):
            stack.enter_context(dr.scoped_set_flag(flag, False))
        yield


class Recorder(Observer):
    """Sink (see `sink`) of a replay of ``count`` samples, and its `Observer`."""

    alpha = False

    def __init__(self, count: int):
        self._count, self._drawn = count, None
        self.camera, self.light = self._begun(np.zeros((3, count))), self._begun(np.zeros((3, count)))
        self.pdf_w = np.zeros(count)
        self.contributions = []

    def emitted(self, emission):
        start = dr.select(emission.infinite, mi.Point3f(-emission.d), mi.Point3f(emission.si.p))
        self.light = _Subpath(self._numbers(start, 3), self._numbers(emission.infinite).astype(bool))

    def started(self, traced, side, walk):
        """Of the light subpath `emitted` knows more."""
        if not side.adjoint:
            self.camera = self._begun(self._numbers(walk.previous, 3))

    def _begun(self, start) -> _Subpath:
        return _Subpath(start, np.zeros(self._count, dtype=bool))

    def vertex(self, side, walk, vertex, step):
        subpath = self.light if side.adjoint else self.camera
        subpath.visits.append(self._visit(side, walk, vertex, step))

    def drawn(self, end):
        self._drawn = self._numbers(end, 3)

    @staticmethod
    def _survival(subpath, places: list[int], i: int) -> float:
        """Probability with which roulette let a subpath come to the last of these ``places``: it is played
        where a subpath only passes a surface too; what media take on the way is none of it."""
        found = 1.0
        for a, b in pairwise(subpath.visits[: places[-1] + 1] if places else []):
            found *= (a.throughput[:, i] * a.weight[:, i]).max() / b.departed[:, i].max()
        return found

    def _visit(self, side, walk, vertex, step) -> _Visit:
        shape = dr.reinterpret_array(mi.UInt32, vertex.si.shape)
        away = mi.Point3f(-vertex.si.wi)  # of rays that have left the scene: their direction, in world space
        delta = mi.Bool(False) if step is None else step.delta
        found = _Visit(
            self._numbers(dr.select(vertex.hit, mi.Point3f(vertex.si.p), away), 3),
            self._numbers(dr.select(vertex.hit, shape, 0)).astype(int),
            self._numbers(delta).astype(bool),
            self._numbers(vertex.hit).astype(bool),
            self._numbers(vertex.throughput, 3),
            self._numbers(1.0 if step is None else step.weight, 3),
            self._numbers(walk.edges).astype(int),
            self._numbers(walk.throughput, 3),
        )
        end = vertex.endpoint
        if end is not None and side.adjoint:
            found.joined, found.pdf_w = self._numbers(end.p, 3), self._numbers(end.pdf_w)
        elif end is not None:
            found.infinite = self._numbers(end.infinite).astype(bool)
            joined = dr.select(end.infinite, mi.Point3f(end.d), mi.Point3f(end.anchor.p))
            found.joined = self._numbers(joined, 3)
        return found

    def _numbers(self, x, rows: int = 0):
        shape = (rows, self._count) if rows else (self._count,)
        return np.broadcast_to(float64(x).reshape(*shape[:-1], -1), shape).copy()

    def begin(self):
        return dr.zeros(mi.Spectrum)

    def add(self, traced, c, total, start, shared):
        self._note(c, c.weighted())
        return total + c.weighted()

    def splat(self, traced, c, shared, stream):
        self._note(c, c.weighted())
        return Counters()

    def connect(self, traced, z, lane, stream, total, start):
        found = []

        def add(_, seen, total):
            found.append(seen)
            return total

        _, counted = connections.connect_all(traced, z, lane.path, stream, total, add)
        if traced.plan.connections == "all":
            for c in found:
                total = self.add(traced, c, total, start, lane.shared)
            return total, counted
        one = connections.connect_one(traced, z, lane.path, stream)
        drawn = np.argmin([self._distances(c, self._drawn) for c in found], axis=0) if found else None
        for i, c in enumerate(found):
            self._note(c, dr.select(mi.Bool(drawn == i), one.weighted(), 0))
        return total + one.weighted(), one.counted

    def _distances(self, c, end):
        """How far the light vertex of a connection is from the ``end`` of a visibility ray, in each lane.
        Rays end short of the vertex drawn, by an offset that depends on the scene: it is the nearest one. One
        that is not seen adds nothing, drawn or not."""
        y = np.array([self.light.ends_at(int(s), i) for i, s in enumerate(self._numbers(c.s))])
        return np.where(self._numbers(c.active) > 0, np.linalg.norm(end.T - y, axis=1), np.inf)

    def end(self, traced, lane, sample, total, seen):
        self.pdf_w = self._numbers(sample.start.pdf_w)
        return Counters()

    def _note(self, c, value):
        numbers = {name: self._numbers(getattr(c, name)) for name in ("s", "t", "weight", "active")}
        numbers |= {"value": self._numbers(value, 3), "estimate": self._numbers(c.value, 3)}
        # Of the subpath that is being made, so far.
        numbers["visits"] = np.full((2, self._count), [[len(self.camera.visits)], [len(self.light.visits)]])
        self.contributions.append(numbers)

    def paths(self, i: int) -> list[Path]:
        """Of sample ``i``, those that add most first."""
        found = [
            self._path(i, {name: x[..., i] for name, x in c.items()})
            for c in self.contributions
            if c["active"][i] and c["value"][:, i].any()
        ]
        return sorted(found, key=lambda path: -path.value.max())

    def _path(self, i: int, c) -> Path:
        s, t = int(c["s"]), int(c["t"])
        camera, light = self.camera.chain(t, i, c["visits"][0]), self.light.chain(s, i, c["visits"][1])
        towards, pdf_w = self._vertices(self.camera, t, i, camera, joined=s > 0), self.pdf_w[i]
        if s == 0:
            back, infinite = [], not self.camera.visits[camera[-1]].hit[i]
        elif s == 1 and t > 1:  # next-event estimation has a point of its own
            last = self.camera.visits[camera[-1]]
            back, infinite = [(last.joined[:, i], 0, False)], bool(last.infinite[i])
        else:
            back = self._vertices(self.light, s, i, light, joined=True)[::-1]
            infinite = bool(self.light.infinite[i])
        if t == 1 and s > 1:  # and so has light tracing
            last = self.light.visits[light[-1]]
            towards, pdf_w = [(last.joined[:, i], 0, False)], last.pdf_w[i]
        p, shapes, delta = zip(*towards, *back, strict=True)
        numbers = (c["value"], c["estimate"], float(c["weight"]))
        survival = self._survival(self.camera, camera, i) * self._survival(self.light, light, i)
        return Path(s, t, *numbers, pdf_w, np.array(p), list(shapes), list(delta), infinite, survival)

    @staticmethod
    def _vertices(subpath, count: int, i: int, places: list[int], joined: bool) -> list:
        """Position, shape, and whether the event was a delta event, of ``count`` vertices of a subpath, in
        ``places``: none at the endpoint, and none of delta where it is ``joined``."""
        if not count:
            return []
        found = [(subpath.start[:, i], 0, False)]
        visits = (subpath.visits[place] for place in places)
        found += [(v.p[:, i], int(v.shape[i]), bool(v.delta[i])) for v in visits]
        if joined or count > 1:
            found[-1] = (*found[-1][:2], False)
        return found


def replay(outliers: list[Outlier]) -> list[list[Path]]:
    """The paths in each outlier, those that add most first: of camera samples all with t >= 2, of splats
    those of the same strategy."""
    found: list[list[Path]] = [[] for _ in outliers]
    for launch in {id(o.launch): o.launch for o in outliers}.values():
        numbers = [i for i, o in enumerate(outliers) if o.launch is launch]
        slots = [outliers[i].slot for i in numbers]
        slots += slots[:1]  # Dr.Jit takes arrays of width 1 for constants
        recorder = Recorder(len(slots))
        with stepwise(launch.kernel):
            drawn = launch.kernel, recorder, launch.batch, launch.points, launch.spp
            dr.eval(kernel.trace(*drawn, mi.UInt32(slots), recorder))
        for lane, i in enumerate(numbers):
            o = outliers[i]
            wanted = (lambda p, o=o: (p.s, p.t) == (o.s, o.t)) if o.s else (lambda p: p.t >= 2)
            found[i] = [path for path in recorder.paths(lane) if wanted(path)]
    return found
