"""The pilot's statistics of light on SDS paths, see `transport.photons.guiding_benefit`."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..sampling import sobol
from ..sampling.points import Points
from ..sampling.sequences import GUIDE, sequence_seed
from ..scene.prepared import PreparedScene
from ..sensors.records import Region
from ..settings import Settings
from ..transport import mis
from ..transport.batch import Batch
from ..transport.inputs import Kernel
from ..transport.photons.aim import Aim
from ..transport.photons.guided_hits import Unguided
from ..transport.photons.guiding_benefit import Estimator, Found, trace
from ..transport.photons.photon_pass import photons_of, trace_guide
from ..transport.plan import Plan
from .moments import FINE, GROUPS, SDSLight, tile_of

# Camera samples (most subpaths end at once); photon subpaths of the estimate, and the most of the guide.
LANES, PHOTONS = 1 << 14, 1 << 16

# Camera subpaths per light subpath of the estimate's weights.
CAMERA_PATHS = 4

# Estimates of s = 0 above the arriving light times ``samples`` / SHARE are dropped: a render rarely samples
# such light, so that it adds no noise to the image. Not where merging would sample it.
SHARE = 16


def measure(
    prepared: PreparedScene, plan: Plan, settings: Settings, seed: mi.UInt32, samples: float
) -> SDSLight | None:
    """Light on SDS paths where ``plan`` can guide s = 0, and its second moments.

    ``samples``: camera samples of the render. None without photons.
    """
    plan = replace(plan, camera_paths_per_light_path=CAMERA_PATHS)
    kernel = Kernel(prepared, plan, settings, mis.Heuristic("balance"))
    aim = Aim.of(prepared.scene, prepared.emitters, prepared.near_specular)
    made = [
        trace_guide(kernel, aim, Points("sobol", sequence_seed(seed, GUIDE + number)), count)[0]
        for number, count in enumerate((PHOTONS, min(photons_of(int(samples)), PHOTONS)))
    ]
    if made[0] is None or made[1] is None:
        return None
    kernel.sds = Unguided(kernel.near_specular)
    most = math.inf if settings.merging is True else samples / SHARE
    estimator = Estimator(*made, dr.opaque(mi.Float, PHOTONS), dr.opaque(mi.Float, most))
    region = prepared.camera.region
    pixels = int(region.size.prod())
    chosen = min(LANES, pixels)
    batch = Batch(0, chosen, 0, LANES // chosen, spread=pixels)
    sums = Sums(region)
    trace(kernel, estimator, batch, Points("sobol", seed), sums.add)
    found, vertices = sums.evaluated()
    return SDSLight(found, vertices / batch.size, batch.size)


def group(lane: mi.UInt32) -> mi.UInt32:
    """Index of the independent part of the pilot to which a ``lane`` belongs.

    Neighbouring lanes belong to different parts, in random order: else parts could be columns of the film.
    """
    return (lane + sobol.mix(lane // GROUPS)) % GROUPS


# Numbers of a row, the last one 0: Dr.Jit adds an even number as a packet.
_WIDTH = 4


class Sums:
    """Sums of the lanes' `Found` by group and fine tile."""

    def __init__(self, region: Region):
        self._region = region
        self._sums = dr.zeros(mi.Float64, GROUPS * FINE**2 * _WIDTH)
        self._vertices = dr.zeros(mi.UInt32, 1)
        dr.make_opaque(self._sums, self._vertices)

    def add(self, lane: mi.UInt32, position: mi.Point2f, found: Found):
        """Accumulate the `Found` of a ``lane`` at a film ``position``."""
        row = group(lane) * FINE**2 + tile_of(self._region, position)
        values = mi.ArrayXd([found.arriving, found.unguided, found.guided, mi.Float64(0)])
        dr.scatter_reduce(dr.ReduceOp.Add, self._sums, values, row)
        dr.scatter_reduce(dr.ReduceOp.Add, self._vertices, found.vertices, mi.UInt32(0))

    def evaluated(self) -> tuple[np.ndarray, int]:
        """Sums, shape (`GROUPS`, fine tiles, 3), and number of guidable vertices."""
        dr.eval(self._sums, self._vertices)
        return np.array(self._sums).reshape(GROUPS, FINE**2, _WIDTH)[:, :, :3], int(self._vertices[0])
