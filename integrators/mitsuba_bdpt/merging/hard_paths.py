"""Vertex merging of hard paths, in scenes with near-specular lobes.

A path is hard if merges sample it better than all other strategies together, see `mis`: SDS paths, and paths
through lobes so narrow that connections rarely succeed. The weights need no flags of delta events.

Photons and camera vertices of other paths would cost time for nothing. Bounds from one side leave out most:

* A merge needs B times the connections of both of its own edges, each of which one side knows. Exact.
* It needs B times all older alternatives of either side, ``d_vc`` times the density ``pdf_rev_w`` of the
  reverse direction. That is known with the BSDF alone; on a diffuse surface it is the cosine over pi. `SLACK`
  allows for others. Merges at smaller densities are lost, as are those of photon subpaths that ended by the
  same bound.

Photons may be aimed, but weights take the emitter's own density of first directions: weights may be any
function of the path, and S and V then differ by densities that every strategy knows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..sampling.points import Stream
from ..transport import mis
from ..transport.contribution import Contribution
from ..transport.inputs import Kernel
from ..transport.sds import begun
from ..transport.walk import Vertex, newest_coefficient
from .merging import Merging, sample

# Least reverse density for which no photon is left out, relative to that of a diffuse surface: 1 / SLACK
# (experiments, "Nearly specular light").
SLACK = 4.0


@dataclass
class HardMerging(Merging):
    """Vertex merging of hard paths in one pass."""

    hard = True

    def __post_init__(self):
        # Densities decide where the light of an even sky is merged.
        self.aim = replace(self.aim, no_sky=False)

    def begin_light(self, kernel, walk):
        return begun(walk, None, kernel.heuristic.zero(), kernel.heuristic.zero())

    begin_camera = begin_light

    def merge(self, kernel, vertex, isolated) -> mis.Merge:
        return mis.Merge(kernel.heuristic.start(self.weighed(vertex.si.p)), None)

    def hit(self, kernel, z, connectible, densities, sides, active):
        return sides, active

    def longest(self, kernel):
        return kernel.last_merged

    def goes_on(self, state, partial, p):
        return self._may_be_hard(partial.d_vc, p)

    def _may_be_hard(self, d_vc: mis.PartialSum, p: mi.Point3f) -> mi.Bool:
        """Mask: older alternatives are few enough; ``d_vc`` before the edge to a diffuse surface."""
        if mis.is_absent(d_vc):
            return mi.Bool(True)
        return mis.HARD * d_vc <= SLACK * dr.pi * self.weighed(p)

    def may_merge(self, kernel: Kernel, vertex, connection: mis.PartialSum) -> mi.Bool:
        possible = vertex.hit & vertex.connectible() & (vertex.edges < kernel.last_merged)
        possible &= mis.exceeds(self.weighed(vertex.si.p), connection)
        return possible & self._may_be_hard(
            kernel.heuristic.scale(vertex.partial.d_vc, vertex.cos), vertex.si.p
        )

    def _connection(self, kernel: Kernel, z: Vertex) -> mis.PartialSum:
        newest = newest_coefficient(kernel, kernel.kappa.splat, z.edges)
        return kernel.heuristic.scale(z.partial.d_vcm, newest)

    def is_merged(self, kernel, z, walk):
        return self.photons.exist & self.may_merge(kernel, z, self._connection(kernel, z))

    def merged(self, kernel: Kernel, z: Vertex, stream: Stream, wavelength_set=None) -> Contribution:
        drawn = sample(kernel, self, z, stream, wavelength_set)
        y, f = drawn.photon, drawn.f
        light = mis.Partial(0, y.older, y.d_vm, y.d_vn), y.connection, f.pdf_fwd_w
        camera = z.partial, self._connection(kernel, z), f.pdf_rev_w
        h = kernel.heuristic
        weight = mis.weigh_merge(h, h.start(self.weighed(z.si.p)), light, camera)
        active = drawn.active & ~(weight == 0)
        c = Contribution(drawn.value, weight, y.edges + 1, z.edges, active, None, "merge")
        return replace(c, light_group=kernel.light_group(y.emitter, active))
