"""Light of which a render expects few samples, in scenes with near-specular lobes.

See docs/method/near_specular.md, "Undersampled light".
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi

from ..transport import mis
from ..transport.alternatives import has_lobe, is_sds_vertex, newest_connection
from ..transport.inputs import TraceContext
from ..transport.near_specular import NARROW, is_narrow
from ..transport.photons.guided_hits import Unguided
from ..transport.walk import Vertex
from .merging import Merging, Sample
from .unsampled import Unsampled

FEWEST = 0.1  # expected samples per pixel below which light is undersampled

# Bounds of kinds of light by expected samples per pixel: none, undersampled, few (which a pilot takes for
# outliers).
KINDS = (0.0, FEWEST, 1.0)

_SUMS = 5  # of `Guidable` per tile of the film


@dataclass
class Undersampled(Unsampled):
    """Which merges count as missing in a render of ``samples`` per pixel; ``sums`` of sizes by `KINDS`."""

    samples: mi.Float
    sums: mi.Float64 = field()

    only_specular = NARROW

    @staticmethod
    def of(samples: float) -> Undersampled:
        """Empty sums for a render of ``samples`` per pixel."""
        return Undersampled(dr.opaque(mi.Float, samples), dr.zeros(mi.Float64, len(KINDS)))

    def begin(self, kernel, e, walk):
        return super().begin(kernel, e, walk) if kernel.plan.guided else walk

    def stored(self, kernel, y, stream):
        return has_lobe(kernel, y), 1.0

    def is_merged(self, kernel, z):
        return has_lobe(kernel, z)

    def missing(self, kernel, merging, z, found, position):
        """Adds the merge to the sums, at the path's only vertex that is not near-specular."""
        expected = self.expected(kernel, merging, z, found)
        active = found.active & ~is_narrow(found.f)
        kind = dr.select(expected > 0, mi.UInt32(1), 0) + dr.select(expected >= FEWEST, mi.UInt32(1), 0)
        size = mi.Float64(dr.sum(mi.unpolarized_spectrum(found.value)))
        dr.scatter_add(self.sums, size, kind, active & dr.isfinite(size) & ~(expected >= KINDS[-1]))
        return active & ~(expected >= FEWEST)  # NaN counts

    def expected(self, kernel: TraceContext, merging: Merging, z: Vertex, found: Sample) -> mi.Float:
        """Expected number of samples per pixel of the merged path and its neighbours.

        Area A of the footprints of all strategies at ``z``, from the partial sums of both subpaths, times the
        density of light subpaths there (1 / area).
        """
        h, photon, f = kernel.heuristic, found.photon, found.f
        newest = newest_connection(kernel, z, adjoint=False)
        camera = h.combine(newest, h.scale(z.partial.d_vc, f.pdf_rev_w))
        area = photon.connection + photon.d_vc * f.pdf_fwd_w + camera
        # The render's light subpaths are not aimed.
        return self.samples * area * (found.number * photon.aim / merging.eta(z))


@dataclass
class Guidable(Undersampled):
    """Which merges are on paths that photons can guide.

    Camera subpaths go on as long as no edge is connectible, and merge where s = 0 can be guided. ``sums``
    over camera samples by tile of the film, ``tiles`` per direction: fields of `moments.GuidableLight`. Light
    is ``rare`` with fewer than ``rarest`` expected samples in a pixel.
    """

    rarest: mi.Float
    tiles: int

    @staticmethod
    def of(samples: float, rarest: float = 0.0, tiles: int = 1) -> Guidable:
        """Empty sums for a render of ``samples`` per pixel."""
        given, rare = (dr.opaque(mi.Float, x) for x in (samples, rarest))
        return Guidable(given, dr.zeros(mi.Float64, tiles**2 * _SUMS), rare, tiles)

    def begin(self, kernel, e, walk):
        return replace(walk, active=walk.active & ~e.delta)  # s = 0 samples no others

    def begin_camera(self, kernel, walk, side):
        walk = Unguided(kernel.near_specular).begin_camera(kernel, walk)
        return walk, replace(side, connect=None, isolated=True)

    def is_merged(self, kernel, z):
        return is_sds_vertex(kernel, z, adjoint=False)

    def missing(self, kernel, merging, z, found, position):
        """Adds the merge to the sums where it is on a path that photons guide."""
        photon, expected = found.photon, self.expected(kernel, merging, z, found)
        active = (expected > 0) & found.active & ~is_narrow(found.f)
        active &= (photon.edges > 1) | ~mis.is_used(kernel.kappa.direct)
        colours = mi.unpolarized_spectrum(found.value)
        light = mi.Float64(dr.sum(colours) / len(colours))
        found_by_hits = expected >= self.rarest
        size = dr.select(found_by_hits, light * self.samples / expected, 0)  # of a sample of s = 0
        powers = [light, light * size, light * size * dr.square(size)]
        active &= dr.isfinite(powers[-1])
        sums = [dr.select(active, x, 0) for x in powers] + [mi.Float64(1)]
        sums.append(dr.select(active & ~found_by_hits, light, 0))
        tile = kernel.camera.region.tile(position, self.tiles)
        dr.scatter_reduce(dr.ReduceOp.Add, self.sums, mi.ArrayXd(sums), tile)
        return active
