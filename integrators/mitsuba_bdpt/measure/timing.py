"""Times whole renders in this process.

For times of a new process see `probes`.
"""

from __future__ import annotations

import time

import drjit as dr
import mitsuba as mi
import numpy as np


def timed(scene, integrator, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """Return image (height, width, 3) and wall seconds of a render."""
    dr.sync_thread()
    started = time.perf_counter()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return np.array(image, dtype=np.float64)[..., :3], time.perf_counter() - started
