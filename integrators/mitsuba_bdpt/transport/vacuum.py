"""The space between vertices; in scenes with media `media.space.Space` overrides it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import mitsuba as mi

from ..geometry import rays
from ..geometry.rounding import ShapeErrors
from ..sampling.points import Stream


@dataclass
class ShadowRay:
    """The shadow ray of connection ``number`` of ``vertex`` in direction ``d``, and its end.

    From the sensor if ``vertex`` is None; ``stream`` of random numbers; ``hidden``: emitters do not block it.
    """

    ray: mi.Ray3f
    stream: Stream
    vertex: Any = None
    d: mi.Vector3f | None = None
    number: mi.UInt32 | int = 0
    own: rays.Own | None = None
    hidden: bool = False


@dataclass(frozen=True)
class Vacuum:
    """The space between the vertices of ``scene``, with rounding errors of shapes.

    ``phase``: `media.phase.PhaseFunctions`, None if no medium scatters; ``counters``: names of the `Counters`
    of edges.
    """

    scene: mi.Scene
    shape_errors: ShapeErrors

    phase: ClassVar[Any] = None
    counters: ClassVar[tuple[str, ...]] = ()

    def arrive(self, kernel, side, walk, /) -> tuple[mi.SurfaceInteraction3f, mi.Ray3f, mi.Bool, Any, Any]:
        """Follow the edge of a ``walk`` to its end, a surface or a point without normal in a volume.

        Returns the interaction, the last segment's ray, the mask of volumes (here a literal, so that Dr.Jit
        leaves out what only media need), the throughput, and the edge (a `media.flight.Edge`).
        """
        ray = mi.Ray3f(walk.o, walk.d, side.shared.time, side.shared.wavelengths)
        si = kernel.hits.at(walk.pi, ray, walk.active)
        return si, ray, mi.Bool(False), walk.throughput, None

    def begin(self, kernel, side: str, stream: Stream, ray: mi.Ray3f, emission=None, /) -> Any:
        """The first edge of a subpath along ``ray``, from its ``emission`` or the sensor."""
        return None

    def depart(self, kernel, side, vertex, passes: mi.Bool, ray: mi.Ray3f, /) -> tuple[Any, mi.Ray3f]:
        """The edge along ``ray`` after an event, and its ray; the edge goes on where it ``passes``."""
        return None, ray

    def allows_next_event(self, vertex) -> mi.Bool:
        """Mask: next-event estimation is allowed at ``vertex``."""
        return mi.Bool(True)

    def before_event(self, vertex, d: mi.Vector3f) -> tuple[mi.Spectrum, Any]:
        """`Photon.flux` and `Photon.medium` of ``vertex``, reached along unit ``d``, before its event."""
        return vertex.throughput, None

    def guessed(self, vertex, between: mi.Vector3f) -> mi.Float:
        """Approximate transmittance from ``vertex`` along ``between``, for draws."""
        return mi.Float(1)

    def seen(self, kernel, c):
        """The `Contribution` ``c`` after its shadow ray, with T in the value and T~ in the weight."""
        ray, active = c.shadow_ray.ray, c.active
        if not c.shadow_ray.hidden:
            blocked = rays.occluded(self.scene, self.shape_errors, ray, active, c.shadow_ray.own)
            return replace(c, active=active & ~blocked)
        pi, _ = rays.intersect_past_emitters(self.scene, self.shape_errors, ray, active, coherent=False)
        return replace(c, active=active & ~pi.is_valid())

    def up_to_sensor(self, walk, y, z, active: mi.Bool, /) -> tuple[mi.Bool, mi.Spectrum, Any]:
        """The edge of a light subpath that ends at ``y``, up to the point ``z`` on the sensor.

        Returns whether it reaches ``z``, its throughput and T~ there.
        """
        return mi.Bool(True), walk.throughput, None

    def clear(self, ray: mi.Ray3f, medium: mi.UInt32 | None, active: mi.Bool) -> Any:
        """Mask: no surface blocks ``ray``, which starts in ``medium``."""
        return ~rays.occluded(self.scene, self.shape_errors, ray, active)
