"""Inner connections: s and t at least 2."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import rays, rounding
from ..sampling.points import Purpose, Stream, sequential
from ..sampling.reservoir import offer
from . import path_layers, scattering, spectra
from .alternatives import newest_coefficient, side_of
from .contribution import Contribution, Counters, drop_non_finite, one, roulette, size_of
from .inputs import TraceContext
from .light_path import LightPath, read_light_vertex, read_proxy
from .proxy_vertices import ProxyVertex, guess
from .sds import connects_sds_path, is_diffuse
from .vacuum import ShadowRay
from .walk import PathVertex, Vertex


def inner(kernel: TraceContext, z: Vertex, y: PathVertex) -> Contribution:
    """s, t >= 2: connect two vertices, before visibility (eqs. 40, 41).

    ``active`` where the contribution is nonzero. Throughputs contain the edges to the vertices; that of ``y``
    is divided by its cosine of incidence, so that only |n.d| of its adjoint factor is missing.
    """
    h = kernel.heuristic
    k = z.edges + y.edges + 1
    active = z.hit & (k <= kernel.reach)
    between = y.si.p - z.si.p
    dist2 = dr.squared_norm(between)
    active &= dist2 > 0
    inverse = dr.rcp(dist2)
    d = between * dr.sqrt(inverse)
    wo_z, wo_y = z.si.to_local(d), y.si.to_local(-d)
    cos_z, cos_y = z.cosine(d), y.cosine(d)
    f_z = scattering.evaluate(kernel, z, wo_z, active)
    f_y = scattering.evaluate(kernel, y, wo_y, active, cos_y)
    value = (z.throughput * f_z.value) * (f_y.value * (y.throughput / y.cos)) * inverse
    active &= ~spectra.is_zero(value)

    own = kernel.kappa.inner
    behind_diffuse = kernel.sds.merges and z.sds.behind_diffuse | is_diffuse(kernel, f_z)
    pdf_y = f_z.pdf_fwd_w * cos_y * inverse
    light_side, merges_y = side_of(kernel, y, True, f_y, pdf_y, behind_diffuse)
    camera_side, merges_z = side_of(kernel, z, False, f_z, f_y.pdf_fwd_w * cos_z * inverse)
    if kernel.sds.near_specular:
        newest_y, newest_z = newest_coefficient(kernel, y, True), newest_coefficient(kernel, z, False)
        active &= ~connects_sds_path(k, (y.sds, f_y, newest_y), (z.sds, f_z, newest_z))
    sides = own, light_side, camera_side, merges_y + merges_z, own
    weight, shares = h.weigh(*sides)
    c = Contribution(value, weight, y.edges + 1, z.edges + 1, active, shares, "inner", sides=sides)
    of_camera = path_layers.evaluated(z.layer, f_z, adjoint=False)
    of_light = path_layers.evaluated(y.layer, f_y, adjoint=True)
    return replace(c, light_group=y.light_group, path_layer=path_layers.joined(of_camera, of_light))


@dr.syntax
def connect_all(kernel: TraceContext, z: Vertex, path: LightPath, stream: Stream, total, add):
    """Connect ``z`` with every stored light vertex, with a shadow ray each.

    ``add(contribution, seen, total)`` accumulates a contribution, before and after visibility, and returns
    the new ``total``. Returns ``total`` and `Counters`.
    """
    candidates = candidate_count(kernel, z, path)
    slot, nonzero = mi.UInt32(0), mi.UInt32(0)
    counters = Counters.zeros("non_finite", *kernel.space.counters)
    while dr.hint(
        slot < candidates, label="inner connections", exclude=[kernel, z, path, stream, add, candidates]
    ):
        y = read_light_vertex(kernel, path, slot)
        c = drop_non_finite(inner(kernel, z, y))
        nonzero += one(c.active)
        visible = _seen(kernel, z, c, *_shadow_ray(kernel, z, y), stream, slot + 1)
        total = add(_as_drawn(kernel, z, y, c), visible, total)
        counters = counters + visible.counted
        slot += 1
    return total, counters + Counters(shadow_inner=nonzero, evaluated=candidates, zero=candidates - nonzero)


def connect_one(kernel: TraceContext, z: Vertex, path: LightPath, stream: Stream) -> Contribution:
    """Connect ``z`` with one light vertex, drawn by weighted unshadowed contribution.

    Estimates the sum over all vertices; its weight is part of the value.
    """
    u = kernel.points.draw_1d("camera", stream, Purpose.CONNECTION, z.event)
    drawn = _draw_by_guess(kernel, z, path, u, stream) if path.guesses else _draw(kernel, z, path, u)
    # In this order: total / size is infinite for tiny drawn values.
    value = (drawn.value / size_of(drawn.value)) * drawn.total
    if kernel.plan.joined > 1:  # each light subpath is a separate estimate
        value = value / kernel.plan.joined
    active, survival, rouletted = roulette(kernel, value, drawn.u, drawn.total > 0)
    own, sides, estimate = None, None, value / survival
    if kernel.shape_errors.small:
        ray, own = _shadow_ray(kernel, z, read_light_vertex(kernel, path, drawn.end))
    else:
        ray = rays.segment_to(z.anchor, drawn.end, z.si)
    if drawn.unweighted is not None:
        unweighted, *others, size = drawn.unweighted
        estimate = unweighted * (drawn.total / size / survival)
        sides = kernel.kappa.inner, *others, kernel.kappa.inner
    c = Contribution(estimate, mi.Float(1), z.edges, z.edges, active, sides=sides)
    c.light_group, c.path_layer = drawn.light_group, drawn.path_layer
    c.counted = drawn.counted + rouletted + Counters(shadow_inner=one(active))
    c = _seen(kernel, z, c, ray, own, stream, 1)
    return c if sides is None else drop_non_finite(c)  # only now with its weight


EVENLY = 0.005  # probability of a uniform draw, so that connections of approximate size 0 are drawn too
_OF_GUESSES = 2  # index of the series of hashed numbers of draws by approximation; merges use the first


@dataclass
class _Drawn:
    """A drawn inner connection: its weighted ``value``, and the ``total`` size of all.

    ``end`` of its shadow ray (its slot if `ShapeErrors.small`), rescaled random number ``u``. In scenes with
    media, where the weight is known after the shadow ray, ``unweighted``: value, light and camera side,
    merges, size.
    """

    value: mi.Spectrum
    total: mi.Float
    end: mi.Point3f | mi.UInt32
    u: mi.Float
    counted: Counters
    light_group: mi.UInt32 | None
    path_layer: mi.UInt32 | None
    unweighted: tuple | None = None


@dr.syntax
def _draw(kernel: TraceContext, z: Vertex, path: LightPath, u) -> _Drawn:
    """Draw one of the inner connections of ``z`` in proportion to its size."""
    candidates, small = candidate_count(kernel, z, path), kernel.shape_errors.small
    slot, value, total = mi.UInt32(0), dr.zeros(mi.Spectrum), mi.Float(0)
    end = mi.UInt32(0) if small else mi.Point3f(z.si.p)
    nonzero, lost = mi.UInt32(0), mi.UInt32(0)
    kept = path_layer = None
    if kernel.path_layers:  # as wide as the lanes, see `Walk.begin`
        path_layer = dr.full(mi.UInt32, path_layers.INDIRECT, dr.width(candidates))
    if kernel.has_media:
        empty = kernel.heuristic.zero()
        merges = ((empty, empty),) * 2 if kernel.sds.merges else ()
        kept = dr.zeros(mi.Spectrum), empty, empty, merges, mi.Float(0)
    while dr.hint(
        slot < candidates, label="draw an inner connection", exclude=[kernel, z, path, candidates, small]
    ):
        y = read_light_vertex(kernel, path, slot)
        c = drop_non_finite(inner(kernel, z, y))
        of_this = _as_drawn(kernel, z, y, c).weighted()
        size = size_of(of_this)
        total, take, u = offer(total, size, u)
        value = dr.select(take, of_this, value)
        kept = None if kept is None else dr.select(take, (c.value, *c.sides[1:4], size), kept)
        path_layer = None if path_layer is None else dr.select(take, c.path_layer, path_layer)
        # Stores the end of the shadow ray, not the slot: a lookup by lane costs more.
        end = dr.select(take, slot if small else rays.end_point(z.anchor, y.anchor), end)
        nonzero += one(c.active)
        lost += c.counted.non_finite
        slot += 1
    counted = Counters(evaluated=candidates, zero=candidates - nonzero, non_finite=lost)
    # One light subpath: all vertices are of one emitter.
    return _Drawn(value, total, end, u, counted, path.light_group, path_layer, kept)


@dr.syntax
def _draw_by_guess(kernel: TraceContext, z: Vertex, path: LightPath, u, stream: Stream) -> _Drawn:
    """Like `_draw`, from several light subpaths, by approximate size (`proxy_vertices.guess`).

    Evaluates only the BSDFs of the drawn connection. Draws uniformly with probability `EVENLY`, and where all
    approximations are 0. ``total`` is the size of the estimate.
    """
    candidates = candidate_count(kernel, z, path)
    some = candidates > 0
    at_z = ProxyVertex.of(kernel, z, some, adjoint=False)
    count = mi.Float(candidates)
    word = kernel.points.series(stream, Purpose.CONNECTION, z.event, mi.UInt32(_OF_GUESSES))
    u_evenly, word = sequential(word)
    u_even, word = sequential(word)
    left, _ = sequential(word)
    even = dr.minimum(mi.UInt32(u_even * count), dr.maximum(candidates, 1) - 1)
    slot, total = mi.UInt32(0), mi.Float(0)
    chosen, of_chosen, of_even = mi.UInt32(0), mi.Float(0), mi.Float(0)
    while dr.hint(
        slot < candidates, label="guess inner connections", exclude=[kernel, z, path, candidates, at_z, even]
    ):
        y, edges = read_proxy(path, slot)
        reached = z.edges + edges + 1 <= kernel.reach
        size = dr.select(reached, guess(kernel, at_z, y), 0)
        total, take, u = offer(total, size, u)
        chosen, of_chosen = dr.select(take, slot, chosen), dr.select(take, size, of_chosen)
        of_even = dr.select(slot == even, size, of_even)
        slot += 1
    guessed = (total > 0) & dr.isfinite(total)
    evenly = (u_evenly < EVENLY) | ~guessed
    drawn = dr.select(some, dr.select(evenly, even, chosen), 0)
    size = dr.select(evenly, of_even, of_chosen)
    probability = dr.select(guessed, EVENLY / count + (1 - EVENLY) * size / total, 1 / count)
    y = read_light_vertex(kernel, path, drawn, some)
    c = drop_non_finite(inner(kernel, replace(z, hit=z.hit & some), y))
    value = dr.select(some & c.active, c.weighted() / probability, 0)
    end = rays.end_point(z.anchor, y.anchor)
    counted = c.counted + Counters(evaluated=one(some), zero=one(some & ~c.active))
    return _Drawn(value, size_of(value), end, left, counted, c.light_group, c.path_layer)


def _as_drawn(kernel: TraceContext, z: Vertex, y: PathVertex, c: Contribution) -> Contribution:
    """The connection ``c`` as drawn: in media with an approximate transmittance."""
    return replace(c, value=c.value * kernel.space.guessed(z, y.si.p - z.si.p))


def _seen(kernel: TraceContext, z: Vertex, c: Contribution, ray: mi.Ray3f, own, stream: Stream, number):
    """The connection ``c`` of ``z`` after its shadow ray; ``number``: of its random numbers, from 1."""
    return kernel.space.seen(kernel, replace(c, shadow_ray=ShadowRay(ray, stream, z, ray.d, number, own)))


def _shadow_ray(kernel: TraceContext, z: Vertex, y: PathVertex) -> tuple[mi.Ray3f, rays.Own | None]:
    """Shadow ray from ``z`` to the light vertex ``y``, see `rays.shadow_ray`."""
    met = rounding.met(y.si.shape, y.si.instance)
    return rays.shadow_ray(kernel.shape_errors, z.anchor, y.anchor, met, z.si)


def candidate_count(kernel: TraceContext, z: Vertex, path: LightPath) -> mi.UInt32:
    """Number of light vertices to connect with ``z``; slot i holds y_{i+1} or a later one.

    With media (null events are no edges), or several light subpaths, slots may hold vertices of one number.
    """
    possible = z.hit & z.connectible() & (z.edges + 2 <= kernel.reach)
    if kernel.has_media or path.guesses:
        return dr.select(possible, path.count, 0)
    return dr.select(possible, dr.minimum(path.count, kernel.reach - z.edges - 1), 0)
