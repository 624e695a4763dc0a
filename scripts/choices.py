"""What the default's choice of strategies is worth: its time to an error over that of the best fixed choice.

    python scripts/choices.py small_casters/point_cube cornell_box
    python scripts/choices.py --all -o results/choices.json    # every scene; goes on after an interruption

For each scene the pilot's candidates are rendered by hand (internal ``decisions``, with the tables of
emission and the guided samples of the default): first once; those which are then among the best, or which
pilots of `PILOT_SEEDS` seeds choose, with `SEEDS` seeds, in turns with the default, 128^2 (small_casters:
their own film), 64 samples per pixel, in processor time without the pilot. Errors are relMSE, raw and trimmed
of the worst 0.1 %.

The table shows the default's time times error (means over the seeds) over the least of the fixed choices,
with the interval of nine in ten resamplings of the seeds, and the same of what the worst of the pilots chose;
the least, over the fixed choices, of the larger of both ratios; the pilot's predicted time to an error over
the measured one (trimmed), the largest ratio of two candidates; and what was chosen. The least of several
noisy products is below the true one: figures are on the safe side. Scenes of small_casters get references of
8,192 samples per pixel; those of others may have light that the default merges and no fixed choice samples.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import command_line
import numpy as np
import pandas as pd
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.files.texts import write_json
from mitsuba_bdpt.measure.metrics import TRIM, rel_mse
from mitsuba_bdpt.measure.tables import markdown
from mitsuba_bdpt.measure.timing import timed
from mitsuba_bdpt.planning.choice import Prediction
from mitsuba_bdpt.planning.configuration import CANDIDATES, Configuration, Decision
from mitsuba_bdpt.run import rendering

import mitsuba as mi  # isort: skip

SPP, SEEDS, PILOT_SEEDS = 64, 8, 16
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
        return scene, depth, repository.load_reference(name, repository.RESOLUTION, depth).image
    made = mi.load_dict({"type": "bdpt", "max_depth": depth, "light_paths": 1, "connections": "one"})
    halves = [np.array(made.render(scene, seed=REFERENCE_SEED + i, spp=REFERENCE_SPP)) for i in (0, 1)]
    return scene, depth, np.mean(halves, axis=0, dtype=np.float64)[..., :3]


def measured(scene, integrator, seed: int, expected) -> np.ndarray:
    """Processor seconds of a render, and its raw and trimmed error."""
    found = timed(scene, integrator, SPP, seed)
    return np.array([found.cpu_seconds, *(rel_mse(found.image, expected, trim) for trim in (0.0, TRIM))])


def product(rows, seeds=slice(None)) -> np.ndarray:
    """Time times error, raw and trimmed, from `measured` of several seeds.

    Errors are means over ``seeds``; the time is the least, which neighbours disturbed least.
    """
    rows = np.array(rows)
    return rows[:, 0].min() * rows[seeds, 1:].mean(axis=0)


def named(way: Configuration) -> str:
    """Light subpaths per camera subpath, connections, kappa of t <= 1 (without light subpaths of s = 1)."""
    if not way.light_paths:
        return f"0, {way.kappa_direct:g}"
    lane = f", {way.joined} per lane" if way.joined > 1 else ""
    return f"1/{round(1 / way.light_paths)} {way.connections} {way.kappa_light:g}{lane}"


def piloted(scene, settings, seed: int | None = None) -> list[Prediction]:
    """The predictions of a pilot of this seed, the best first."""
    render = rendering.Render(scene, scene.sensors()[0], settings, 0, SPP)
    if seed is not None:
        render.planner.pilot_seed = seed
    return render.decide()


def by_hand(scene, depth: int, row: Prediction, best: Configuration, mean: float):
    """An integrator that does what ``row`` predicts, with what the ``best`` has beside its candidate."""
    way = replace(
        row.candidate,
        emission=best.emission if row.candidate.light_paths else None,
        guided=best.guided,
    )
    made = Decision.of(way, cost=row.cost, variance=row.variance, mean=mean)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "merging": False})
    integrator.settings = integrator.settings.varied(decisions=(made,))
    integrator.render(scene, spp=1)  # compiles
    return integrator


def fixed(scene, depth: int, expected, chosen: set[str], predicted: list[Prediction], mean: float) -> dict:
    """Integrators, by their names, of the candidates that are among the best or ``chosen``."""
    rows = {named(row.candidate): row for row in predicted}
    made = {name: by_hand(scene, depth, row, predicted[0].candidate, mean) for name, row in rows.items()}
    first = {n: product([measured(scene, w, FIRST_SEED, expected)]) for n, w in made.items()}
    best = np.min(list(first.values()), axis=0)
    return {n: w for n, w in made.items() if n in chosen or (first[n] <= AMONG_BEST * best).any()}


def measure(name: str) -> dict:
    """A row: `measured` with each seed, of the default and of fixed choices; the pilots' results."""
    scene, depth, expected = loaded(name)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth})
    integrator.render(scene, seed=FIRST_SEED, spp=SPP)  # compiles
    predicted = piloted(scene, integrator.settings)
    tables = [piloted(scene, integrator.settings, seed) for seed in range(PILOT_SEEDS)]
    chosen = Counter(named(found[0].candidate) for found in tables if found)
    mean = integrator.statistics["decisions"][0]["mean"]
    ways = fixed(scene, depth, expected, set(chosen), predicted, mean)
    rows, found = [], {way: [] for way in ways}
    for seed in range(SEEDS):
        # In turns, since the machine's speed changes.
        for way, by in ways.items():
            found[way].append(measured(scene, by, seed, expected).tolist())
        rows.append(measured(scene, integrator, seed, expected).tolist())
    return {
        "scene": name,
        "candidates": CANDIDATE_NAMES,
        "fixed": found,
        "default": rows,
        "chosen": dict(chosen.most_common()),
        "predicted": {named(row.candidate): row.time for row in predicted if named(row.candidate) in found},
    }


CANDIDATE_NAMES = [named(way) for way in CANDIDATES]


def ratios(row: dict, seeds=slice(None)) -> dict:
    """Time times error, raw and trimmed, over the least of the fixed choices, by name of the choice."""
    found = {name: product(rows, seeds) for name, rows in row["fixed"].items()}
    best = np.min(list(found.values()), axis=0)
    return {
        name: value / best for name, value in (found | {"default": product(row["default"], seeds)}).items()
    }


def shown(row: dict) -> dict[str, str]:
    """A row as a line of the table, by columns."""
    found = ratios(row)
    default = found.pop("default")
    worst = np.max([found[name] for name in row["chosen"]] or [default], axis=0)
    random = np.random.default_rng(SEEDS)
    drawn = (ratios(row, random.integers(0, SEEDS, SEEDS))["default"] for _ in range(RESAMPLINGS))
    low, high = np.quantile(list(drawn), INTERVAL, axis=0)
    cells = {"scene": f"`{row['scene']}`"}
    for kind, m, a, b, w in zip(("raw", "trimmed"), default, low, high, worst, strict=True):
        cells[f"{kind}: default, worst pilot"] = f"{m:.2f} ({a:.2f}–{b:.2f}), {w:.2f}"
    wrong = [time / found[name][1] for name, time in row["predicted"].items()]
    return cells | {
        "best by both": f"{min(map(max, found.values())):.2f}",
        "predicted / measured": f"{max(wrong) / min(wrong):.2g}",
        "chosen (pilots)": ", ".join(f"{name} ({n})" for name, n in row["chosen"].items()),
    }


def choices_table(record: list[dict]) -> str:
    """The table of a record, as Markdown."""
    return markdown(pd.DataFrame(map(shown, record)))


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scenes", nargs="*", help="names in scenes/, also small_casters/NAME")
    parser.add_argument("--all", action="store_true", help="the benchmark's scenes and all of small_casters")
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
        if name not in rows or rows[name].get("candidates") != CANDIDATE_NAMES:
            rows[name] = measure(name)
            print("  ".join(shown(rows[name]).values()), file=sys.stderr, flush=True)
        if options.output:
            write_json(options.output, list(rows.values()))
    print(choices_table([rows[name] for name in names]))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
