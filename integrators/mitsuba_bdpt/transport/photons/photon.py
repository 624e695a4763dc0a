"""The record of a photon, and whether two points lie on one surface."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Self, get_type_hints

import drjit as dr
import mitsuba as mi

# Least cosine between geometric normals of two points of one surface: excludes edges and thin walls.
SAME_SURFACE = 0.8


@dataclass
class Photon:
    """A stored light vertex, or arrays of many.

    ``p``: position; ``d``: unit direction towards the light's side; ``n``: geometric normal; ``flux``:
    throughput, not divided by the number of subpaths; ``older``: partial sum of all alternatives with fewer
    light vertices (area measure); ``aim``: the emitter's own density of the first direction over that of
    `Aim`; ``distance``: length of the edge to it; ``edges`` up to it; ``lane``: index of its subpath;
    ``emitter``: index in the scene; ``layer`` of its subpath before the event at it, see `path_layers`, None
    without such layers.
    """

    p: mi.Point3f
    d: mi.Vector3f
    n: mi.Normal3f
    flux: mi.Spectrum
    older: mi.Float
    aim: mi.Float
    distance: mi.Float
    edges: mi.UInt32
    lane: mi.UInt32
    emitter: mi.UInt32
    layer: mi.UInt32 | None = field(default=None, kw_only=True)

    @classmethod
    def types(cls) -> tuple[Any, ...]:
        """Types of the fields but ``layer`` in the current variant, in order.

        Dr.Jit would keep the types of the first variant in use.
        """
        hints = get_type_hints(cls)
        return tuple(hints[field.name] for field in fields(cls) if not field.kw_only)

    @classmethod
    def zeros(cls, count: int, layered: bool = False) -> Self:
        """Memory for ``count`` photons, ``layered`` with path layers."""
        layer = dr.zeros(mi.UInt32, count) if layered else None
        return cls(*(dr.zeros(kind, count) for kind in cls.types()), layer=layer)

    def at(self, index: mi.UInt32, active: mi.Bool | bool = True) -> Self:
        """The photons at ``index``."""
        present = self._present().items()
        return replace(
            self, **{name: dr.gather(type(values), values, index, active) for name, values in present}
        )

    def put(self, photon: Self, index: mi.UInt32, active: mi.Bool):
        """Store ``photon`` at ``index``."""
        dr.scatter(self._present(), photon._present(), index, active)

    def _present(self) -> dict[str, Any]:
        """Its fields by name; Dr.Jit scatters no None."""
        return {name: values for name, values in vars(self).items() if values is not None}


@dataclass
class ConnectedPhoton(Photon):
    """A photon whose path may also be sampled by connections; ``older`` is its ``d_vc``.

    ``connection``: its ``d_vcm`` times the coefficient of the connection of the last edge. All partial sums
    are those of a light subpath, whose first direction is not aimed. ``hittable``: a ray can hit its emitter.
    """

    connection: mi.Float
    hittable: mi.Bool


@dataclass
class MergedPhoton(Photon):
    """A photon for merging, see `mis`; ``older`` is its ``d_vc``.

    ``connection`` as of a `ConnectedPhoton`; ``d_vm``, ``d_vm_newest``: its partial sums of merges.
    """

    connection: mi.Float
    d_vm: mi.Float
    d_vm_newest: mi.Float


def same_surface(a: mi.Normal3f, b: mi.Normal3f):
    """Mask: points with geometric normals ``a`` and ``b`` count as on one surface."""
    return dr.dot(a, b) > SAME_SURFACE
