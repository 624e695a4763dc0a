"""The one stopwatch of the scripts for renders in this process: seconds of a whole one.

What a new process takes is measured in that process, see `probes`.
"""

from __future__ import annotations

import time

import drjit as dr
import mitsuba as mi
import numpy as np


def timed(scene, integrator, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """Image (height, width, 3) and wall seconds of a render, of nothing that was queued before it."""
    dr.sync_thread()
    started = time.perf_counter()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return np.array(image, dtype=np.float64)[..., :3], time.perf_counter() - started
