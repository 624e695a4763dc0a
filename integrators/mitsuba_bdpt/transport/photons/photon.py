"""The record of a photon."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, get_type_hints

import drjit as dr
import mitsuba as mi


@dataclass
class Photon:
    """A stored light vertex, or arrays of many.

    ``p``: position; ``d``: unit direction towards the light's side; ``n``: geometric normal, 0 in a volume;
    ``flux``: throughput, not divided by the number of subpaths, in a volume times mean extinction over
    sigma_s (in gray homogeneous media the throughput before scattering); ``medium``: number of that of a
    volume, 0 on surfaces, None if no medium scatters. Partial sums, see `mis`: ``connection`` (c), its
    ``d_vcm`` times the coefficient of the connection of the last edge; ``d_vc``, ``d_vm``, ``d_vm_newest``.
    ``aim``: the emitter's own density of the first direction over that of `Aim`; ``distance``: length of the
    edge to it; ``edges`` up to it; ``lane``: index of its subpath; ``emitter``: index in the scene; ``layer``
    of its subpath before the event at it, see `path_layers`.
    """

    p: mi.Point3f
    d: mi.Vector3f
    n: mi.Normal3f
    flux: mi.Spectrum
    connection: mi.Float
    d_vc: mi.Float
    d_vm: mi.Float
    d_vm_newest: mi.Float
    aim: mi.Float
    distance: mi.Float
    edges: mi.UInt32
    lane: mi.UInt32
    emitter: mi.UInt32
    layer: mi.UInt32
    medium: Any = None

    @staticmethod
    def zeros(count: int, media: bool = False) -> Photon:
        """Memory for ``count`` photons; ``media``: some medium of the scene scatters."""
        # Dr.Jit would keep the types of the first variant in use.
        kinds = get_type_hints(Photon) | {"medium": mi.UInt32 if media else None}
        return Photon(**{name: kind and dr.zeros(kind, count) for name, kind in kinds.items()})

    def at(self, index: mi.UInt32, active: mi.Bool | bool = True) -> Photon:
        """The photons at ``index``."""
        gathered = {name: dr.gather(type(x), x, index, active) for name, x in self._stored().items()}
        return replace(self, **gathered)

    def put(self, photon: Photon, index: mi.UInt32, active: mi.Bool):
        """Store ``photon`` at ``index``."""
        dr.scatter(self._stored(), photon._stored(), index, active)

    def _stored(self) -> dict:
        return {name: x for name, x in vars(self).items() if x is not None}
