"""Vertex merging of hard paths, in scenes with near-specular lobes.

A path is hard if merges sample it better than all other strategies together, see `mis`: SDS paths, and paths
through lobes so narrow that connections rarely succeed. The weights need no flags of delta events.

Photons and camera vertices of other paths would cost time for nothing. Two bounds from one side leave out
most, without bias:

* A merge needs B times the connections of both of its own edges, each of which one side knows.
* Where it has less than B times all older alternatives of its side, ``d_vc`` times the density ``pdf_rev_w``
  of the reverse direction, it has little of the weight. That density is known with the other side alone; on a
  diffuse surface it is the cosine over pi, and elsewhere, or if the path has further merges, the path may be
  hard all the same. So photons, photon subpaths and camera vertices play Russian roulette, with the ratio to
  that of a diffuse surface. Where one side plays, the estimate of a merge on a hard path is then at most
  about that at a diffuse surface: its density, and with it its BSDF, is as small as the probability.

Photons may be aimed, but weights take the emitter's own density of first directions: weights may be any
function of the path, and S and V then differ by densities that every strategy knows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..sampling.points import Purpose, Stream, sequential
from ..transport import mis
from ..transport.alternatives import newest_connection
from ..transport.contribution import Contribution
from ..transport.inputs import Kernel
from ..transport.sds import State, begun
from ..transport.walk import Vertex
from .merging import Merging, sample, with_layers

# Roulette begins where a merge at a diffuse surface has 1 / SLACK of B times the older alternatives.
SLACK = 2.0

# Index of the series of hashed numbers, of a camera vertex, that play this roulette; merges use the first.
_OF_QUERIES = 3


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

    def survival(self, state, partial, p):
        # Whichever is larger, since it may go on to where pixels are larger.
        eta = dr.maximum(self.weighed(p), self.weighed_in(self.radius.median))
        survived = dr.minimum(state.survived, _probability(partial.d_vc, eta))
        return survived / state.survived, State(survived=survived)

    def may_merge(self, kernel: Kernel, vertex, connection: mis.PartialSum) -> mi.Bool:
        possible = vertex.hit & vertex.connectible() & (vertex.edges < kernel.last_merged)
        return possible & mis.exceeds(self.weighed(vertex.si.p), connection)

    def kept(self, kernel: Kernel, vertex, survived=1.0):
        d_vc = kernel.heuristic.scale(vertex.partial.d_vc, vertex.cos)  # before the edge to it
        return dr.minimum(_probability(d_vc, self.weighed(vertex.si.p)) / survived, 1)

    def is_merged(self, kernel, z, walk, stream):
        word = kernel.points.series(stream, Purpose.CONNECTION, z.event, mi.UInt32(_OF_QUERIES))
        asks = self.may_merge(kernel, z, newest_connection(kernel, kernel.kappa.splat, z))
        return self.photons.exist & asks & (sequential(word)[0] < self.kept(kernel, z))

    def merged(self, kernel: Kernel, z: Vertex, stream: Stream, wavelength_set=None) -> Contribution:
        drawn = sample(kernel, self, z, stream, wavelength_set)
        y, f = drawn.photon, drawn.f
        light = mis.Partial(0, y.older, y.d_vm, y.d_vm_newest), y.connection, f.pdf_fwd_w
        camera = z.partial, newest_connection(kernel, kernel.kappa.splat, z), f.pdf_rev_w
        h = kernel.heuristic
        weight = mis.weigh_merge(h, h.start(self.weighed(z.si.p)), light, camera)
        active = drawn.active & ~(weight == 0)
        value = drawn.value / self.kept(kernel, z)
        c = Contribution(value, weight, y.edges + 1, z.edges, active, None, "merge")
        return with_layers(kernel, c, z, drawn)


def _probability(d_vc: mis.PartialSum, merge: mi.Float) -> mi.Float:
    """Probability with which a ``merge`` of this partial sum is sampled beside older alternatives ``d_vc``.

    ``d_vc`` before the edge to it.
    """
    if mis.is_absent(d_vc):
        return mi.Float(1)
    return dr.minimum(SLACK * dr.pi * merge / (mis.HARD * d_vc), 1)
