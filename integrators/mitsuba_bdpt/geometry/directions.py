"""Random directions, and frames about directions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def random_directions(rng, count: int) -> mi.Vector3f:
    return mi.warp.square_to_uniform_sphere(mi.Point2f(rng.random((2, count))))


def symmetric_frame(n: mi.Vector3f) -> mi.Frame3f:
    """Frame about unit ``n`` whose matrix equals its transpose.

    It is a half-turn or a reflection of the z axis. Mitsuba 3.9.1's ``sggx`` samples with the transposed
    frame: another distribution than its density.
    """
    sign = dr.select(n.z >= 0, mi.Float(1), mi.Float(-1))
    h = dr.normalize(n + mi.Vector3f(0, 0, sign))
    s, t = h * (2 * h.x) - mi.Vector3f(1, 0, 0), h * (2 * h.y) - mi.Vector3f(0, 1, 0)
    frame = dr.zeros(mi.Frame3f)
    frame.s, frame.t, frame.n = s * sign, t * sign, mi.Vector3f(n)
    return frame
