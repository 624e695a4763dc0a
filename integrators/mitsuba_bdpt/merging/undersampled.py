"""Which light a render of few samples hardly ever finds, in scenes with near-specular lobes.

Connections sample paths through such lobes, but rarely. Photons and camera subpaths follow delta and
near-specular events, and are merged at a path's only other vertex; the partial sums of the weights then tell
how many samples of the path a render expects.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi

from ..transport import mis
from ..transport.alternatives import has_lobe, is_sds_vertex, newest_connection
from ..transport.inputs import Kernel
from ..transport.near_specular import NARROW, is_narrow
from ..transport.photons.guided_hits import Unguided
from ..transport.walk import Vertex
from .merging import Merging, Sample
from .unsampled import Unsampled

# Expected samples per pixel below which light is undersampled: nine of ten pixels have none of it, the others
# at least ten times too much.
FEWEST = 0.1

# Bounds of kinds of light by expected samples per pixel: none, undersampled, few (which a pilot takes for
# outliers).
KINDS = (0.0, FEWEST, 1.0)

# What photons can guide s = 0 to find: SDS light, second and fourth moments of its samples without guiding
# (mean over the colours), and vertices at which s = 0 is guided. Dr.Jit adds four numbers as a packet.
GUIDABLE = ("light", "second", "fourth", "vertices")


@dataclass
class Undersampled(Unsampled):
    """Which merges count as missing in a render of ``samples`` per pixel.

    ``kinds``: sums of sizes by kind, see `KINDS`.
    """

    samples: mi.Float
    kinds: mi.Float64 = field()

    only_specular = NARROW

    @staticmethod
    def of(samples: float) -> Undersampled:
        """Empty sums for a render of ``samples`` per pixel."""
        return Undersampled(dr.opaque(mi.Float, samples), dr.zeros(mi.Float64, len(KINDS)))

    def emission(self, e, aim):
        return super().emission(replace(e, pdf_second=e.pdf_second * aim), aim)  # the render has no aim

    def begin(self, kernel, e, walk):
        return super().begin(kernel, e, walk) if kernel.plan.guided else walk

    def stored(self, kernel, y, walk, stream):
        return has_lobe(kernel, y), 1.0

    def is_merged(self, kernel, z, walk):
        return has_lobe(kernel, z)

    def missing(self, kernel, merging, z, found, position):
        """Adds the merge to the sums.

        Only where the vertex is not near-specular itself: the path is merged there alone.
        """
        expected = self.expected(kernel, merging, z, found)
        active = found.active & ~is_narrow(found.f)
        kind = mi.UInt32(0)
        for bound in KINDS[:-1]:
            kind += dr.select(expected > 0 if bound == 0 else expected >= bound, mi.UInt32(1), 0)
        size = mi.Float64(dr.sum(mi.unpolarized_spectrum(found.value)))
        dr.scatter_add(self.kinds, size, kind, active & dr.isfinite(size) & ~(expected >= KINDS[-1]))
        return active & ~(expected >= FEWEST)  # NaN counts

    def expected(self, kernel: Kernel, merging: Merging, z: Vertex, found: Sample) -> mi.Float:
        """Expected number of samples per pixel of the merged path and its neighbours.

        A connection of an edge at ``z`` succeeds if the other subpath arrives in the footprint at ``z`` of
        the lobe at the edge's other end. Footprints of all strategies, times their samples per camera sample,
        add up in the recursion of the weights (`mis`); times the density of photons at ``z`` (one over area)
        they are the expected number per camera sample.
        """
        h, photon, f = kernel.heuristic, found.photon, found.f
        newest = newest_connection(kernel, z, adjoint=False)
        camera = h.combine(newest, h.scale(z.partial.d_vc, f.pdf_rev_w))
        area = photon.connection + photon.older * f.pdf_fwd_w + camera
        # The render's light subpaths are not aimed.
        return self.samples * area * (found.number * photon.aim / merging.eta(z.si.p))


@dataclass
class Guidable(Undersampled):
    """Which merges are on paths that photons can guide.

    Camera subpaths pass diffuse vertices too, as long as no edge is connectible (see `sds`), and merge where
    s = 0 can be guided. ``guidable``: by tile of the film, ``tiles`` per direction, sums of `GUIDABLE` over
    camera samples; where fewer than ``rarest`` samples are expected in a pixel, s = 0 counts as not finding
    the light.
    """

    rarest: mi.Float
    tiles: int
    guidable: mi.Float64

    @staticmethod
    def of(samples: float, rarest: float = 0.0, tiles: int = 1) -> Guidable:
        """Empty sums for a render of ``samples`` per pixel."""
        sums = dr.zeros(mi.Float64, tiles**2 * len(GUIDABLE))
        return Guidable(*vars(Undersampled.of(samples)).values(), dr.opaque(mi.Float, rarest), tiles, sums)

    def begin(self, kernel, e, walk):
        return replace(walk, active=walk.active & ~e.delta)  # s = 0 samples no others

    def begin_camera(self, kernel, walk, side):
        walk = Unguided(kernel.near_specular).begin_camera(kernel, walk)
        return walk, replace(side, connect=None, isolated=True)

    def is_merged(self, kernel, z, walk):
        return is_sds_vertex(kernel, z, adjoint=False)

    def missing(self, kernel, merging, z, found, position):
        """Adds the merge to the sums where it is on a path that photons guide."""
        photon, expected = found.photon, self.expected(kernel, merging, z, found)
        active = (expected > 0) & found.active & ~is_narrow(found.f)
        active &= (photon.edges > 1) | ~mis.is_used(kernel.kappa.direct)
        colours = mi.unpolarized_spectrum(found.value)
        light = mi.Float64(dr.sum(colours) / len(colours))
        size = dr.select(expected >= self.rarest, light * self.samples / expected, 0)  # of a sample of s = 0
        powers = [light, light * size, light * size * dr.square(size)]
        active &= dr.isfinite(powers[-1])
        sums = [dr.select(active, x, 0) for x in powers] + [mi.Float64(1)]
        tile = kernel.camera.region.tile(position, self.tiles)
        dr.scatter_reduce(dr.ReduceOp.Add, self.guidable, mi.ArrayXd(sums), tile)
        return active
