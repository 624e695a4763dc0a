"""What the default's choice of strategies is worth: its time to an error over that of the best fixed choice.

    python scripts/choices.py small_casters/point_cube cornell_box
    python scripts/choices.py --all -o docs/reports/choices.json            # every scene; can be interrupted
    python scripts/choices.py --all -o docs/reports/choices.json --again    # after a change of the choice

For each scene the candidates of a pilot with 1, 4 and 16 camera subpaths per light subpath, those with all
inner connections in place of one drawn, and what pilots of 32 seeds choose, are rendered by hand (parameter
``decisions``, with the tables of emission and the guided samples of s = 0 that the default has); those which
one render of a seed of its own shows to be among the best, or which are chosen, with 8 seeds, as the default
is, 64 samples per pixel. A time is that of the processor, which neighbours on the machine disturb less than
seconds; the default's without the pilot, which later renders of a scene remember (docs/method/skipping.md has
what it takes). Errors are relMSE, raw and trimmed of the worst 0.1 %.
The table shows, raw and trimmed: the default's time times error (means over the seeds) over the least of the
fixed choices, with the interval that nine in ten resamplings of the seeds (the same for both sides) lie in,
and the same of what the worst of the pilots chose; the least, over the fixed choices, of the larger of its
two ratios, which is 1 where one choice is best by both errors; and what was chosen. The least of several
noisy products is below the true one: figures are on the safe side. The scenes of small_casters get a
reference of 8,192 samples per pixel with a light subpath each, and so do those whose stored reference has
light that only `merging` finds, which no choice has.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import command_line
import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
import numpy as np
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.files.texts import write_json
from mitsuba_bdpt.measure.metrics import TRIM, rel_mse
from mitsuba_bdpt.measure.tables import table
from mitsuba_bdpt.planning import pilot
from mitsuba_bdpt.planning.candidates import candidates
from mitsuba_bdpt.planning.configuration import Configuration, Decision
from mitsuba_bdpt.run import rendering

import mitsuba as mi  # isort: skip
import drjit as dr  # isort: skip

SPP, SEEDS, PILOT_SEEDS, SERVED = 64, 8, 32, (1, 4, 16)
REFERENCE_SPP, REFERENCE_SEED, FIRST_SEED = 4096, 1_000_000, 1000

# A fixed choice is among the best if one render's time times error, raw or trimmed, is within this factor.
AMONG_BEST = 1.4

# Resamplings of the seeds, and the quantiles between which nine in ten of them lie.
RESAMPLINGS, INTERVAL = 1000, (0.05, 0.95)
SMALL = "small_casters"


def loaded(name: str):
    """A scene, its ``max_depth`` and its reference."""
    if name.startswith(SMALL):
        scene = mi.load_file(str(repository.SCENES / f"{name}.xml"))
        depth = scene.integrator().max_depth
    else:
        scene = repository.load_scene(name, resolution=repository.RESOLUTION)
        depth = repository.benchmark_depth(name)
        stored = repository.load_reference(name, repository.RESOLUTION, depth)
        if not stored.merged:
            return scene, depth, stored.image
    made = mi.load_dict({"type": "bdpt", "max_depth": depth, "light_paths": 1, "connections": "one"})
    halves = [np.array(made.render(scene, seed=REFERENCE_SEED + i, spp=REFERENCE_SPP)) for i in (0, 1)]
    return scene, depth, np.mean(halves, axis=0, dtype=np.float64)[..., :3]


def measured(scene, integrator, seed: int, expected) -> np.ndarray:
    """Processor seconds of a render, and its raw and trimmed error."""
    dr.sync_thread()
    started = time.process_time()
    image = np.array(integrator.render(scene, seed=seed, spp=SPP))[..., :3]
    seconds = time.process_time() - started
    return np.array([seconds, rel_mse(image, expected), rel_mse(image, expected, TRIM)])


def product(rows, seeds=slice(None)) -> np.ndarray:
    """Time times error, raw and trimmed, from `measured` of several seeds.

    Errors are means over ``seeds``; the time is the least, which neighbours disturbed least.
    """
    rows = np.array(rows)
    return rows[:, 0].min() * rows[seeds, 1:].mean(axis=0)


def by_hand(scene, depth: int, way: Configuration, mean: float):
    """An integrator that does what the candidate ``way`` says; ``mean`` of the image."""
    made = json.dumps([Decision.of(way, first_pass=0, cost=1.0, variance=1.0, mean=mean).record()])
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "decisions": made})
    integrator.render(scene, spp=1)  # compiles
    return integrator


def piloted(scene, settings) -> Counter:
    """How often pilots of `PILOT_SEEDS` seeds choose which candidate; nothing where none is asked."""
    tables = []
    for seed in range(PILOT_SEEDS):
        render = rendering.Render(scene, scene.sensors()[0], settings, 0, SPP)
        render.planner.pilot_seed = seed
        tables.append(render.decide())
    return Counter(named(table[0].candidate) for table in tables if table)


def fixed(scene, depth: int, expected, chosen: set, known: dict) -> dict:
    """Integrators, by their names, of the candidates that are among the best or ``chosen``.

    Where those among the best are ``known``, only of the best, by which the machine's speed is told, and the
    chosen.
    """
    settings = mi.load_dict({"type": "bdpt", "max_depth": depth}).settings
    render = rendering.Render(scene, scene.sensors()[0], settings, 1, SPP)
    mean = pilot.measure(render.prepared, render.plan, settings, dr.opaque(mi.UInt32, 1), 1 << 14).mean
    ways = candidates(render.prepared, render.plan, settings)
    ways += [replace(way, connections="all") for way in ways if way.connections == "one"]
    ways = {named(way): way for way in map(as_taught(settings, scene), ways)}
    if known:
        old = {name: product(rows) for name, rows in known.items()}
        names = chosen | {min(old, key=lambda name: old[name][i]) for i in (0, 1)}
    else:
        names = chosen | {name for name, way in ways.items() if way.camera_paths_per_light_path in SERVED}
    made = {name: by_hand(scene, depth, ways[name], mean) for name in sorted(names)}
    if not known:
        first = {n: product([measured(scene, w, FIRST_SEED, expected)]) for n, w in made.items()}
        best = np.min(list(first.values()), axis=0)
        made = {n: w for n, w in made.items() if n in chosen or (first[n] <= AMONG_BEST * best).any()}
    return made


def as_taught(settings, scene):
    """A function that gives a candidate what the default has learnt beside the choice among candidates."""
    render = rendering.Render(scene, scene.sensors()[0], settings, 1, SPP)
    table = render.decide()
    if not table:
        return lambda way: way
    best = table[0].candidate

    def taught(way: Configuration) -> Configuration:
        alike = way.light_paths and (way.light_paths, way.connections) == (best.light_paths, best.connections)
        return replace(
            way,
            emission=best.emission if way.light_paths else None,
            guided=best.guided,
            joined=best.joined if alike else 1,
        )

    return taught


def as_fast(known: dict, found: dict) -> dict:
    """``known`` rows with the times that they would have at the machine's present speed.

    That is told by ``found``, rows of some of the same choices.
    """
    both = known.keys() & found.keys()
    speeds = [np.array(found[name])[:, 0].min() / np.array(known[name])[:, 0].min() for name in both]
    return {name: np.array(rows) * [np.median(speeds), 1, 1] for name, rows in known.items()}


def named(way: Configuration) -> str:
    """In words: light subpaths per camera subpath, connections (with how many), kappa of t <= 1 or s = 1."""
    if not way.light_paths:
        return f"0, {way.kappa_direct:g}"
    joined = f" of {way.joined}" if way.joined > 1 else ""
    return f"1/{way.camera_paths_per_light_path} {way.connections}{joined} {way.kappa_light:g}"


def measure(name: str, known: dict) -> dict:
    """A row: `measured` with each seed, of the default and of fixed choices, and what pilots have chosen.

    Choices that are ``known`` are kept, their times scaled to the machine's present speed.
    """
    scene, depth, expected = loaded(name)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth})
    integrator.render(scene, seed=FIRST_SEED, spp=SPP)  # compiles
    chosen = dict(piloted(scene, integrator.settings).most_common())
    ways = fixed(scene, depth, expected, set(chosen), known)
    rows, kinds, found = [], [], {way: [] for way in ways}
    for seed in range(SEEDS):
        # In turns, since the machine's speed changes.
        for way, by in ways.items():
            found[way].append(measured(scene, by, seed, expected))
        rows.append(measured(scene, integrator, seed, expected))
        (made,) = integrator.statistics["decisions"] or [None]
        kinds.append(made and (made["light_paths"], made["connections"]))
    if known:
        found = as_fast(known, found) | found
    # One kind of decision takes other times than another: the least of each, as often as it is made.
    least = {kind: min(row[0] for row, of in zip(rows, kinds, strict=True) if of == kind) for kind in kinds}
    rows = np.array(rows)
    rows[:, 0] = np.mean([least[kind] for kind in kinds])
    return {"scene": name, "fixed": rounded(found), "default": rounded({"": rows})[""], "chosen": chosen}


def rounded(found: dict) -> dict:
    """``found`` with five digits of each number."""
    return {name: [[float(f"{x:.5g}") for x in row] for row in rows] for name, rows in found.items()}


def ratios(row: dict, seeds=slice(None)) -> dict:
    """Time times error, raw and trimmed, over the least of the fixed choices, by name of the choice."""
    found = {name: product(rows, seeds) for name, rows in row["fixed"].items()}
    best = np.min(list(found.values()), axis=0)
    return {
        name: value / best for name, value in (found | {"default": product(row["default"], seeds)}).items()
    }


def shown(row: dict) -> list[str]:
    """A row as the cells of the table."""
    found = ratios(row)
    default = found.pop("default")
    worst = np.max([found[name] for name in row["chosen"]] or [default], axis=0)
    random = np.random.default_rng(SEEDS)
    drawn = (ratios(row, random.integers(0, SEEDS, SEEDS))["default"] for _ in range(RESAMPLINGS))
    low, high = np.quantile(list(drawn), INTERVAL, axis=0)
    cells = [
        f"{m:.2f} ({a:.2f}–{b:.2f}), {w:.2f}" for m, a, b, w in zip(default, low, high, worst, strict=True)
    ]
    counts = ", ".join(f"{name} ({n})" for name, n in row["chosen"].items())
    return [f"`{row['scene']}`", *cells, f"{min(map(max, found.values())):.2f}", counts or "–"]


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scenes", nargs="*", help="names in scenes/, also small_casters/NAME")
    parser.add_argument("--all", action="store_true", help="the benchmark's scenes and all of small_casters")
    parser.add_argument("--again", action="store_true", help="render the default of scenes in OUTPUT anew")
    parser.add_argument("-o", "--output", type=Path, help="JSON of the rows; scenes that are in it are kept")
    options = parser.parse_args(arguments)
    names = list(options.scenes)
    if options.all:
        small = sorted(path.stem for path in (repository.SCENES / SMALL).glob("*.xml"))
        names += repository.benchmark_scenes()
        names += [f"{SMALL}/{name}" for name in small if name != "common"]
    if not names:
        parser.error("name scenes, or --all")
    mi.set_variant("llvm_ad_rgb")
    stored = options.output and options.output.exists() and json.loads(options.output.read_text())
    rows = {row["scene"]: row for row in stored or []}
    for name in names:
        if name not in rows or options.again:
            # Errors against a reference that is made anew are others.
            kept = name in rows and not name.startswith(SMALL)
            rows[name] = measure(name, rows[name]["fixed"] if kept else {})
            print("  ".join(shown(rows[name])), file=sys.stderr, flush=True)
        if options.output:
            write_json(options.output, list(rows.values()))
    head = [
        "scene",
        "raw: default, worst pilot",
        "trimmed: default, worst pilot",
        "best by both",
        "chosen (pilots)",
    ]
    print(table(head, [shown(rows[name]) for name in names]))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
