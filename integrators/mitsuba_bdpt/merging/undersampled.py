"""Which light a render of few samples hardly ever finds, in scenes with near-specular lobes.

Connections sample paths through such lobes, but rarely. Photons and camera subpaths follow delta and
near-specular events, and are merged at a path's only other vertex; the partial sums of the weights then tell
how many samples of the path a render expects.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..transport.alternatives import newest_connection
from ..transport.inputs import Kernel
from ..transport.near_specular import is_narrow
from ..transport.walk import Vertex
from .merging import Merging, Sample

# Expected samples per pixel below which light is undersampled: nine of ten pixels have none of it, the others
# at least ten times too much.
FEWEST = 0.1

# Bounds of kinds of light by expected samples per pixel: none, undersampled, few (which a pilot takes for
# outliers).
KINDS = (0.0, FEWEST, 1.0)


@dataclass
class Undersampled:
    """Which merges count as missing in a render of ``samples`` per pixel.

    ``kinds``: sums of sizes by kind, see `KINDS`.
    """

    samples: mi.Float
    kinds: mi.Float64

    @staticmethod
    def of(samples: float) -> Undersampled:
        """Empty sums for a render of ``samples`` per pixel."""
        return Undersampled(dr.opaque(mi.Float, samples), dr.zeros(mi.Float64, len(KINDS)))

    def missing(
        self, kernel: Kernel, merging: Merging, z: Vertex, found: Sample, only_delta: mi.Bool
    ) -> mi.Bool:
        """Mask: the merge ``found`` at ``z`` counts; adds it to the sums.

        Only where the vertex is not near-specular itself: the path is merged there alone. Light of emitters
        that rays can hit counts only behind a near-specular event; ``only_delta``: none came before ``z``. It
        does not count where photons guide s = 0.
        """
        expected = self.expected(kernel, merging, z, found)
        active = found.active & ~is_narrow(found.f)
        active &= ~(found.photon.delta if kernel.plan.guided else only_delta & found.photon.delta)
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
        newest = newest_connection(kernel, kernel.kappa.splat, z)
        camera = h.combine(newest, h.scale(z.partial.d_vc, f.pdf_rev_w))
        area = photon.connection + photon.older * f.pdf_fwd_w + camera
        # The render's light subpaths are not aimed.
        return self.samples * area * (found.number * photon.aim / merging.eta(z.si.p))
