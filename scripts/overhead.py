"""What a render takes besides its samples, and what a sample takes.

    python scripts/overhead.py cornell_box veach_mis open_sky
    python scripts/overhead.py --short cornell_box veach_mis thin_lens

Medians over rounds in which all of them alternate, at 128^2. The cost of a sample, over that of `path`:
seconds of a whole render of 64 samples per pixel less those of 4, so that what is fixed cancels. Path
tracing alone (light_paths=0) with its points and with independent numbers; a light subpath for 16 camera
subpaths without inner connections, with one per vertex, with all; everything switched on. A whole render of
one sample, with path tracing alone. The pilot: its seconds, of the statistics, in first renders of 64 and 256
samples per pixel of a scene, and its share of these; later renders remember what it found.

With --short: whole renders of 4 and 16 samples per pixel by `path` with multijitter, by path tracing alone,
by the default, and by the default where the scene was just loaded and a pilot is asked.

With --small: renders of 64^2 at 8 samples per pixel by `path`, path tracing alone and the default, warm:
the best of five means over twenty, and where the time of the two goes, in means over twenty: what is asked of
scene and pilot before anything is traced, the recording of the kernel in Python, what Dr.Jit does with the
record (`dr.eval` of a kernel that it knows), and waiting for the kernel.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections import defaultdict
from contextlib import contextmanager

import command_line
import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.image.accumulator import Accumulator
from mitsuba_bdpt.measure.tables import table
from mitsuba_bdpt.measure.timing import timed
from mitsuba_bdpt.run import rendering
from mitsuba_bdpt.run.statistics import Meter
from repository import benchmark_depth

ROUNDS, SHORT, LONG = 7, 4, 64

# Samples per pixel of short renders.
BUDGETS, SHORT_ROUNDS = (4, 16), 15

# A small render, and how many of them are taken together.
SMALL_SIZE, SMALL_SPP, SMALL_RENDERS, SMALL_ROUNDS = 64, 8, 20, 5

STAGES = {
    "scene": (rendering.Render, "__init__"),
    "pilot": (rendering.Render, "decide"),
    "recording": (rendering, "trace"),
    "`dr.eval`": (Accumulator, "evaluate"),
    "waiting": (Meter, "wait"),
}
"""Where the time of a small render goes: what to call it, and the function."""

ALONE = {"type": "bdpt", "light_paths": 0}
SHARED = {"type": "bdpt", "light_paths": 1 / 16}
METHODS = {
    "path": ({"type": "path"}, "independent"),
    "path multijitter": ({"type": "path"}, "multijitter"),
    "path tracing alone": (ALONE, "independent"),
    "independent numbers": (ALONE | {"points": "independent"}, "independent"),
    "1/16, none": (SHARED | {"connections": "none"}, "independent"),
    "1/16, one": (SHARED | {"connections": "one"}, "independent"),
    "1/16, all": (SHARED | {"connections": "all"}, "independent"),
    "skip=none": ({"type": "bdpt", "skip": "none"}, "independent"),
}


def measure(name: str) -> list[str]:
    """A row of the table."""
    depth = benchmark_depth(name)
    scenes = {
        s: repository.load_scene(name, resolution=repository.RESOLUTION, sampler=s)
        for s in ("independent", "multijitter")
    }
    made = {k: (mi.load_dict(d | {"max_depth": depth}), scenes[s]) for k, (d, s) in METHODS.items()}
    chosen = mi.load_dict({"type": "bdpt", "max_depth": depth})
    cost = {k: [] for k in made}
    first = []
    pilot = {LONG: [], 4 * LONG: []}
    for seed in range(ROUNDS + 1):
        for k, (integrator, scene) in made.items():
            short, long = (timed(scene, integrator, spp, seed)[1] for spp in (SHORT, LONG))
            cost[k].append((long - short) / (LONG - SHORT))
        first.append(timed(scenes["independent"], made["path tracing alone"][0], 1, seed)[1])
        for spp, found in pilot.items():
            anew = repository.load_scene(name, resolution=repository.RESOLUTION)  # forgotten
            chosen.render(anew, seed=seed, spp=spp)
            spent = chosen.statistics["seconds"]
            found.append((1e3 * spent["pilot"], 100 * spent["pilot"] / spent["total"]))
    # The first round compiles.
    base = statistics.median(cost["path"][1:])
    row = [f"`{name}`", f"{1e3 * base:.2f} ms"]
    row += [f"{statistics.median(v[1:]) / base:.2f}" for k, v in cost.items() if k != "path"]
    row.append(f"{1e3 * statistics.median(first[1:]):.0f} ms")
    for found in pilot.values():
        spent, share = (statistics.median(column) for column in zip(*found[1:], strict=True))
        row.append(f"{spent:.0f} ms, {share:.1f} %")
    return row


def measure_short(name: str) -> list[list[str]]:
    """The rows of the table of short renders."""
    depth = benchmark_depth(name)
    scene = repository.load_scene(name, resolution=repository.RESOLUTION, sampler="independent")
    stronger = repository.load_scene(name, resolution=repository.RESOLUTION, sampler="multijitter")
    made = [
        (mi.load_dict({"type": "path", "max_depth": depth}), stronger),
        (mi.load_dict(ALONE | {"max_depth": depth}), scene),
        (mi.load_dict({"type": "bdpt", "max_depth": depth}), scene),
    ]
    rows = []
    for spp in BUDGETS:
        spent = []
        for seed in range(SHORT_ROUNDS + 1):
            anew = repository.load_scene(name, resolution=repository.RESOLUTION)
            turn = [*made, (made[-1][0], anew)]
            spent.append([1e3 * timed(s, integrator, spp, seed)[1] for integrator, s in turn])
        cells = [f"{statistics.median(column):.0f} ms" for column in zip(*spent[1:], strict=True)]
        rows.append([f"`{name}`", str(spp), *cells])
    return rows


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


def measure_small(name: str) -> list[list[str]]:
    """The rows of the table of small renders."""
    depth = benchmark_depth(name)
    scene = repository.load_scene(name, resolution=SMALL_SIZE, sampler="independent")
    ways = {"`path`": {"type": "path"}, "path tracing alone": ALONE, "default": {"type": "bdpt"}}
    made = {way: mi.load_dict(parameters | {"max_depth": depth}) for way, parameters in ways.items()}

    def several(integrator) -> float:
        return statistics.mean(timed(scene, integrator, SMALL_SPP, seed)[1] for seed in range(SMALL_RENDERS))

    best = {
        way: [several(integrator) for _ in range(SMALL_ROUNDS + 1)][1:] for way, integrator in made.items()
    }
    base, rows = min(best["`path`"]), []
    for way, found in best.items():
        with stages() as spent:
            several(made[way])
        each = [f"{1e3 * spent[stage] / SMALL_RENDERS:.1f}" if spent else "–" for stage in STAGES]
        rows.append([f"`{name}`", way, f"{1e3 * min(found):.1f} ms", f"{min(found) / base:.2f}", *each])
    return rows


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scenes", nargs="+", help="names in scenes/")
    parser.add_argument("--short", action="store_true", help="renders of 4 and 16 samples per pixel")
    parser.add_argument("--small", action="store_true", help="renders of 64^2 at 8 samples per pixel")
    options = parser.parse_args(arguments)
    names = options.scenes
    mi.set_variant("llvm_ad_rgb")
    if options.short:
        head = ["scene", "spp", "`path` multijitter", "path tracing alone", "default", "the same, first"]
        print(table(head, [row for name in names for row in measure_short(name)]))
        return 0
    if options.small:
        head = ["scene", "by", "a render", "over `path`", *(f"{stage}, ms" for stage in STAGES)]
        print(table(head, [row for name in names for row in measure_small(name)]))
        return 0
    head = ["scene", "`path`, per sample and pixel", *list(METHODS)[1:], "a render of 1 sample"]
    head += [f"pilot at {spp}" for spp in (LONG, 4 * LONG)]
    print(table(head, [measure(name) for name in names]))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
