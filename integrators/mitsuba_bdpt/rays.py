"""The one place where rays start.

Mitsuba offsets ray origins by 8.9e-5 (1 + max|p|), which swallows small scenes whole and leaves
gaps in large ones. Here the offset along the geometric normal follows from the rounding error of
the hit itself: ``OFFSET_ULPS * 2^-24 * max(|p|, |o|, t)`` with maximum norms, where ``o`` and ``t``
belong to the ray that found ``p``. It scales with the scene. Visibility rays end short of their
target by the target's own offset, not by a fraction of the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

# Measured: from 16 on, no hit on any of Mitsuba's shapes finds its own start (4 fails on up to
# 1 % of hits on cylinders); 32 keeps a factor of two in hand.
OFFSET_ULPS = 32


@dataclass
class Anchor:
    """A point that rays may start from or end at.

    ``p`` position, ``n`` geometric normal of unit length (zero for a point in free space),
    ``offset`` distance in scene units by which a ray leaves the surface along ``n``.
    """

    p: object
    n: object
    offset: object

    def towards(self, d):
        """The start of a ray that leaves into direction ``d`` (any length)."""
        return self.p + self.n * dr.mulsign(self.offset, dr.dot(self.n, d))


def rounding_offset(p, o, t):
    """Offset that clears the rounding error of a hit ``p`` found from ``o`` at distance ``t``."""
    magnitude = dr.maximum(dr.max(dr.abs(p)), dr.max(dr.abs(o)))
    return (OFFSET_ULPS * 2.0**-24) * dr.maximum(magnitude, t)


def surface_anchor(si, ray) -> Anchor:
    """Anchor of the hit ``si`` that ``ray`` found."""
    return Anchor(mi.Point3f(si.p), mi.Normal3f(si.n), rounding_offset(si.p, ray.o, si.t))


def sampled_anchor(p, n, reference) -> Anchor:
    """Anchor of a point sampled on a surface, to be joined with the point ``reference``."""
    return Anchor(
        mi.Point3f(p), mi.Normal3f(n), rounding_offset(p, reference, dr.norm(p - reference)))


def free_anchor(p) -> Anchor:
    """Anchor of a point without surface: a point light, a pinhole, a point of a lens."""
    return Anchor(mi.Point3f(p), mi.Normal3f(0), mi.Float(0))


def spawn(anchor: Anchor, d, like) -> mi.Ray3f:
    """Unbounded ray from ``anchor`` along unit ``d``; time and wavelengths as in ``like``."""
    return mi.Ray3f(anchor.towards(d), d, like.time, like.wavelengths)


def segment(a: Anchor, b: Anchor, like) -> mi.Ray3f:
    """Ray from ``a`` that ends just before ``b``; time and wavelengths as in ``like``."""
    between = b.p - a.p
    o = a.towards(between)
    to_target = b.towards(-between) - o
    dist = dr.norm(to_target)
    return mi.Ray3f(o, to_target / dist, dist, like.time, like.wavelengths)


def occluded(scene, ray, active):
    """Whether any surface, null surfaces included (as in ``path``), blocks ``ray``."""
    return scene.ray_test(ray, active=active)


def intersect_past_emitters(scene, ray, active, coherent):
    """First hit along ``ray`` on a shape that does not emit, and the ray that found it.

    This is how ``path`` treats camera rays under ``hide_emitters``.
    """

    def body(ray, pi, active):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        onward = mi.Ray3f(ray)
        onward.o = surface_anchor(si, ray).towards(ray.d)
        # maxt bounds a segment: what was travelled is taken off (infinity stays infinity).
        onward.maxt = ray.maxt - dr.dot(onward.o - ray.o, ray.d)
        onward = dr.select(active, onward, ray)
        found = scene.ray_intersect_preliminary(onward, coherent=coherent, active=active)
        pi = dr.select(active, found, pi)
        return onward, pi, active & on_emitter(pi)

    def on_emitter(pi):
        return pi.is_valid() & (pi.shape.emitter() != dr.zeros(mi.EmitterPtr))

    pi = scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
    ray, pi, _ = dr.while_loop(
        (mi.Ray3f(ray), pi, active & on_emitter(pi)),
        lambda ray, pi, active: active,
        body,
        label="past emitters",
    )
    return pi, ray
