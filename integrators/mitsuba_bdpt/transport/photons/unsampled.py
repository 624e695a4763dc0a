"""Emitters whose light reaches the sensor by delta events only."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ...sampling.points import Points
from .. import subpaths, techniques
from ..inputs import Kernel, Observer
from ..walk import random_walk


def arriving(kernel: Kernel, points: Points, count: int) -> mi.Bool:
    """Mask of the delta emitters whose light reaches the sensor by delta events only.

    Tests ``count`` light subpaths. Direct light counts only if no connection can sample it (of beams).
    """
    kernel = kernel.bound(points, 1.0, Observer())
    index = mi.UInt64(dr.arange(mi.UInt32, count))
    stream = points.stream("light", index)
    shared = subpaths.shared_by_lane(kernel, stream, index)
    e = subpaths.emission(kernel, stream, shared)
    walk = subpaths.light_walk(kernel, e, stream, shared, None)
    walk = replace(walk, active=walk.active & e.delta)
    side = replace(subpaths.light_side(kernel, e, stream, shared, walk, None), connect=None, only_delta=True)

    def visit(y, arrived, walk):
        hit = techniques.hit_sensor(kernel, e, y, walk).active
        return arrived | (hit & ((walk.edges > 1) | e.beam))

    arrived, _ = random_walk(kernel, side, walk, stream, visit, mi.Bool(False))
    found = dr.zeros(mi.Bool, kernel.emitters.count)
    dr.scatter(found, mi.Bool(True), e.index, arrived)
    dr.eval(found)
    return found
