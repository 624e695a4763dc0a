"""Whether a strategy's two ends see each other, and what passes between them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import polarization, rays
from ..media import transmittance
from ..sampling.points import Purpose, Stream
from .contribution import Contribution, Counters
from .inputs import Kernel

# Optical depth up to which a join's transmittance is guessed before its ray is traced, from the medium that
# it starts in: a join that in truth passes through less is drawn e^2 times too rarely at most.
_GUESSED_DEPTH = 2.0


@dataclass
class Sight:
    """The visibility ``ray`` of a join and what it ends at (`rays.Own` or None).

    In scenes with media also the number of the ``medium`` in which the ray starts, and the ``word`` of its
    random numbers; ``hidden``: emitters do not block it.
    """

    ray: mi.Ray3f
    own: rays.Own | None = None
    medium: mi.UInt32 | None = None
    word: mi.UInt32 | None = None
    hidden: bool = False

    def numbered(self, kernel: Kernel, stream: Stream, event: mi.UInt32, number=0) -> Sight:
        """With random numbers of the ``number``-th join at a vertex, whose ``event`` names them."""
        if kernel.space is None or not kernel.space.media.grids:
            return replace(self, word=mi.UInt32(0))
        return replace(self, word=kernel.points.series(stream, Purpose.TRACKING, event, 1 + number))


def seen(kernel: Kernel, c: Contribution, sight: Sight) -> Contribution:
    """``c``, active where nothing blocks it; in media times the transmittance, and weighted with its T~."""
    if kernel.space is None:
        return replace(c, active=c.active & ~_blocked(kernel, sight, c.active))
    crossing = transmittance.between(
        kernel.space, sight.ray, sight.medium, c.active, sight.own, sight.word, sight.hidden
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


def _blocked(kernel: Kernel, sight: Sight, active):
    if not sight.hidden:
        return rays.occluded(kernel.scene, sight.ray, active, sight.own)
    pi, _ = rays.intersect_past_emitters(kernel.scene, kernel.shape_errors, sight.ray, active, coherent=False)
    return pi.is_valid()


def guessed(kernel: Kernel, medium: mi.UInt32 | None, distance: mi.Float) -> mi.Float:
    """A guess of the transmittance over a ``distance`` from a point in ``medium``, for draws."""
    if kernel.space is None:
        return mi.Float(1)
    return dr.exp(-dr.minimum(kernel.space.media.mean(medium) * distance, _GUESSED_DEPTH))
