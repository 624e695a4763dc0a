"""What a small render takes besides its samples, and where that goes.

    python scripts/overhead.py cornell_box veach_mis

Renders of 64^2 at 8 samples per pixel by `path`, path tracing alone and the default, in turns, warm: the
median of a hundred, and where the time of the latter two goes, in means over twenty: what is asked of scene
and pilot before anything is traced, the recording of the kernel in Python, what Dr.Jit does with the record
(`dr.eval` of a kernel that it knows), and waiting for the kernel. (The cost of a sample, or a short render:
``mitsuba-bdpt compare`` with that many samples.)
"""

from __future__ import annotations

import statistics
import sys
import time
from collections import defaultdict
from contextlib import contextmanager
from functools import partial

import command_line
import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.image.accumulator import Accumulator
from mitsuba_bdpt.measure.scenes import integrator_of
from mitsuba_bdpt.measure.tables import table
from mitsuba_bdpt.measure.timing import alternating, timed
from mitsuba_bdpt.run import rendering
from mitsuba_bdpt.run.statistics import Meter

SIZE, SPP, RENDERS, ROUNDS = 64, 8, 20, 100

STAGES = {
    "scene": (rendering.Render, "__init__"),
    "pilot": (rendering.Render, "decide"),
    "recording": (rendering, "trace"),
    "`dr.eval`": (Accumulator, "evaluate"),
    "waiting": (Meter, "wait"),
}
"""Where the time of a render goes: what to call it, and the function."""

WAYS = {
    "`path`": {"type": "path"},
    "path tracing alone": {"type": "bdpt", "light_paths": 0},
    "default": {"type": "bdpt"},
}


@contextmanager
def stages():
    """Seconds by stage, see `STAGES`, of the renders within."""
    spent, former = defaultdict(float), {}

    def watched(stage, function):
        def call(*given, **named):
            started = time.perf_counter()
            try:
                return function(*given, **named)
            finally:
                spent[stage] += time.perf_counter() - started

        return call

    for stage, (owner, name) in STAGES.items():
        former[stage] = getattr(owner, name)
        setattr(owner, name, watched(stage, former[stage]))
    try:
        yield spent
    finally:
        for stage, (owner, name) in STAGES.items():
            setattr(owner, name, former[stage])


def rows(name: str) -> list[list[str]]:
    """The rows of a scene."""
    scene = repository.load_scene(name, resolution=SIZE, sampler="independent")
    depth = repository.benchmark_depth(name)
    sides = [partial(timed, scene, integrator_of(way, depth), SPP) for way in WAYS.values()]
    turns = [[found.seconds for found in turn] for turn in alternating(sides, ROUNDS)]
    medians = [statistics.median(column) for column in zip(*turns, strict=True)]
    found = []
    for way, render, seconds in zip(WAYS, sides, medians, strict=True):
        with stages() as spent:
            for seed in range(RENDERS):
                render(seed)
        each = [f"{1e3 * spent[stage] / RENDERS:.1f}" if spent else "–" for stage in STAGES]
        found.append([f"`{name}`", way, f"{1e3 * seconds:.1f} ms", f"{seconds / medians[0]:.2f}", *each])
    return found


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scenes", nargs="+", help="names in scenes/")
    names = parser.parse_args(arguments).scenes
    mi.set_variant("llvm_ad_rgb")
    head = ["scene", "by", "a render", "over `path`", *(f"{stage}, ms" for stage in STAGES)]
    print(table(head, [row for name in names for row in rows(name)]))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
