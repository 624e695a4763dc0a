"""Visibility and transmittance between the ends of a connection."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import polarization, rays
from ..sampling.points import Purpose, Stream
from .contribution import Contribution, Counters
from .inputs import Kernel

# Largest optical depth of a connection's approximate transmittance, in the medium that it starts in:
# connections of less actual depth are drawn at most e^2 times too rarely.
_GUESSED_DEPTH = 2.0


@dataclass
class ShadowRay:
    """The shadow ``ray`` of a connection and its end (`rays.Own` or None).

    With media also the index of the ``medium`` in which the ray starts, and the first ``word`` of its random
    numbers; ``hidden``: emitters do not block it.
    """

    ray: mi.Ray3f
    own: rays.Own | None = None
    medium: mi.UInt32 | None = None
    word: mi.UInt32 | None = None
    hidden: bool = False

    def numbered(self, kernel: Kernel, stream: Stream, event: mi.UInt32, number=0) -> ShadowRay:
        """With random numbers of connection ``number`` at the vertex of ``event``."""
        if kernel.space is None or not kernel.space.media.grids:
            return replace(self, word=mi.UInt32(0))
        return replace(self, word=kernel.points.series(stream, Purpose.TRACKING, event, 1 + number))


def seen(kernel: Kernel, c: Contribution, shadow_ray: ShadowRay) -> Contribution:
    """Deactivate ``c`` if blocked; in media apply transmittance, and T~ in the weight."""
    if kernel.space is None:
        return replace(c, active=c.active & ~_blocked(kernel, shadow_ray, c.active))
    crossing = kernel.space.between(
        shadow_ray.ray,
        shadow_ray.medium,
        c.active,
        shadow_ray.own,
        shadow_ray.word,
        shadow_ray.hidden,
    )
    weight, shares = kernel.heuristic.weigh(*c.sides, crossing.tr)
    return replace(
        c,
        value=polarization.scaled(c.value, crossing.transmittance),
        weight=weight,
        shares=shares,
        active=c.active & crossing.visible,
        counted=c.counted + Counters(segments=crossing.segments, collisions=crossing.collisions),
    )


def _blocked(kernel: Kernel, shadow_ray: ShadowRay, active):
    if not shadow_ray.hidden:
        return rays.occluded(kernel.scene, shadow_ray.ray, active, shadow_ray.own)
    pi, _ = rays.intersect_past_emitters(
        kernel.scene, kernel.shape_errors, shadow_ray.ray, active, coherent=False
    )
    return pi.is_valid()


def guessed(kernel: Kernel, medium: mi.UInt32 | None, distance: mi.Float) -> mi.Float:
    """Approximate transmittance over ``distance`` in ``medium``, for draws."""
    if kernel.space is None:
        return mi.Float(1)
    return dr.exp(-dr.minimum(kernel.space.media.mean(medium) * distance, _GUESSED_DEPTH))
