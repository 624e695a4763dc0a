"""What the default's choice of strategies is worth: its time to an error over that of the best fixed choice.

    python scripts/choices.py small_casters/point_cube cornell_box --seeds 8
    python scripts/choices.py --all -o docs/choices.json    # every scene; can be interrupted

For each scene the candidates of a pilot with 1, 4 and 16 camera subpaths per light subpath are rendered by
hand (parameter ``decisions``), and the default with ``--seeds`` seeds, 64 samples per pixel. A time is that
of the processor, pilot included, which neighbours on the machine disturb less than seconds; errors are
relMSE, raw and trimmed of the worst 0.1 %. The table shows, raw and trimmed: the default's time times error
(means over the seeds) over the least of the fixed choices, that of the worst seed, and what was chosen. The
least of some thirty noisy products is below the true one: figures are on the safe side. The scenes of
small_casters get a reference of 8,192 samples per pixel with a light subpath each.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
import numpy as np
import reference
from metrics import TRIM, rel_mse
from mistakes import answered
from mitsuba_bdpt import choice, pilot, rendering
from mitsuba_bdpt.__main__ import number
from tables import table

import mitsuba as mi  # isort: skip
import drjit as dr  # isort: skip

SPP, FIXED_SEEDS, SERVED = 64, 3, (1, 4, 16)
REFERENCE_SPP, REFERENCE_SEED, FIXED_SEED = 4096, 1_000_000, 1000
SMALL = "small_casters"


def loaded(name: str):
    """A scene, its ``max_depth`` and its reference."""
    if not name.startswith(SMALL):
        depth = reference.benchmark_depth(name)
        stored = reference.load_reference(name, reference.RESOLUTION, depth)
        return reference.load_scene(name, resolution=reference.RESOLUTION), depth, stored.image
    scene = mi.load_file(str(reference.SCENES / f"{name}.xml"))
    depth = scene.integrator().max_depth
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


def products(rows) -> np.ndarray:
    """Time times error, raw and trimmed, of the means over several renders; of times the least, which
    neighbours disturbed least."""
    rows = np.array(rows)
    return rows[:, 0].min() * rows[:, 1:].mean(axis=0)


def fixed(scene, depth: int, expected) -> dict:
    """`products` of the candidates, by weighting, number of camera subpaths and kind of connections."""
    settings = mi.load_dict({"type": "bdpt", "max_depth": depth}).settings
    render = rendering.Render(scene, scene.sensors()[0], settings, 1, SPP)
    mean = pilot.measure(render.world, render.plan, settings, dr.opaque(mi.UInt32, 1), 1 << 14).mean
    found = {}
    for way in choice.candidates(render.world, render.plan, settings):
        if way.connections == "all" or way.served not in SERVED:
            continue
        made = json.dumps([way.decided(0, 1.0, 1.0, mean).record()])
        integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "decisions": made})
        integrator.render(scene, spp=1)
        rows = [measured(scene, integrator, FIXED_SEED + i, expected) for i in range(FIXED_SEEDS)]
        found[way.weighting, way.served, way.connections] = products(rows)
    return found


def measure(name: str, seeds: int) -> dict:
    """A row: the default's time times error over the best fixed choice's, raw and trimmed, of the mean over
    the seeds and of the worst seed; how often what was chosen."""
    scene, depth, expected = loaded(name)
    best = np.min(list(fixed(scene, depth, expected).values()), axis=0)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth})
    integrator.render(scene, seed=FIXED_SEED, spp=SPP)  # compiles
    rows, chosen = [], Counter()
    for seed in range(seeds):
        rows.append(measured(scene, integrator, seed, expected))
        made = integrator.statistics["decisions"]
        share = made[-1]["light_paths"] if made else None
        chosen[f"1/{round(1 / share)} {made[-1]['connections']}" if share else "no light subpaths"] += 1
    rows = np.array(rows)
    worst = rows[:, 0].min() * rows[:, 1:].max(axis=0)
    return {
        "scene": name,
        "mean": (products(rows) / best).tolist(),
        "worst": (worst / best).tolist(),
        "chosen": dict(chosen.most_common()),
    }


def shown(row: dict) -> list[str]:
    """A row as the cells of the table."""
    cells = [f"{mean:.2f} ({worst:.2f})" for mean, worst in zip(row["mean"], row["worst"], strict=True)]
    return [f"`{row['scene']}`", *cells, ", ".join(f"{text} ({n})" for text, n in row["chosen"].items())]


def main(arguments=None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", help="names in scenes/, also small_casters/NAME")
    parser.add_argument("--all", action="store_true", help="the benchmark's scenes and all of small_casters")
    parser.add_argument("--seeds", type=number(int, 1), default=8)
    parser.add_argument("-o", "--output", type=Path, help="JSON of the rows; scenes that are in it are kept")
    options = parser.parse_args(arguments)
    names = list(options.scenes)
    if options.all:
        small = sorted(path.stem for path in (reference.SCENES / SMALL).glob("*.xml"))
        names += reference.read_toml(reference.BENCHMARK)["scenes"]
        names += [f"{SMALL}/{name}" for name in small if name != "common"]
    if not names:
        parser.error("name scenes, or --all")
    mi.set_variant("llvm_ad_rgb")
    kept = options.output and options.output.exists() and json.loads(options.output.read_text())
    rows = {row["scene"]: row for row in kept or []}
    for name in names:
        if name not in rows:
            rows[name] = measure(name, options.seeds)
            print("  ".join(shown(rows[name])), file=sys.stderr, flush=True)
        if options.output:
            reference.write_json(options.output, list(rows.values()))
    head = ["scene", "raw: mean (worst seed)", "trimmed: mean (worst seed)", "chosen (seeds)"]
    print(table(head, [shown(rows[name]) for name in names]))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
