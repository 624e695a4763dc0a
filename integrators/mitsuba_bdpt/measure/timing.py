"""Times whole renders in this process, also of several sides in turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np


class Timed(NamedTuple):
    """A render: image (height, width, 3), wall seconds, processor seconds."""

    image: np.ndarray
    seconds: float
    cpu_seconds: float


Render = Callable[[int], Timed]  # renders with a seed


def timed(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> Timed:
    dr.sync_thread()
    started, cpu_started = time.perf_counter(), time.process_time()
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    taken = time.perf_counter() - started, time.process_time() - cpu_started
    return Timed(np.array(image, dtype=np.float64)[..., :3], *taken)


def alternating(
    sides: Sequence[Render],
    rounds: int,
    on_render: Callable[[int], object] = lambda seed: None,
    *,
    is_warm: bool = False,
) -> Iterator[list[Timed]]:
    """Render with all sides in turn; yields the renders of each round.

    In the order of the sides. Seeds are 1 to ``rounds``, after a round of seed 0 that compiles and is not
    returned, unless everything ``is_warm``. Every other round is in reversed order, which cancels drifts of
    the machine's speed. Calls ``on_render`` before each render.
    """
    for seed in range(int(is_warm), rounds + 1):
        found: dict[int, Timed] = {}
        for i in range(len(sides))[:: 1 if seed % 2 else -1]:
            on_render(seed)
            found[i] = sides[i](seed)
        if seed:
            yield [found[i] for i in range(len(sides))]
