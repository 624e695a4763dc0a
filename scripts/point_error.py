"""What points are worth: the error with each kind, over that with independent numbers.

    python scripts/point_error.py cornell_box many_lights open_sky

At 128^2 and equal numbers of samples (16 and 64; products of both where the scene's sampler rounds): relMSE
trimmed of its worst 0.1 %, median of 5 seeds, over that of ``points=independent``. Path tracing alone
(light_paths=0), and with a light subpath for 4 camera subpaths.
"""

from __future__ import annotations

import argparse
import statistics
import sys

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip
import numpy as np
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure import metrics
from mitsuba_bdpt.measure.tables import table
from repository import RESOLUTION, benchmark_depth, load_reference, load_scene

BUDGETS, SEEDS = (16, 64), 5

METHODS = {"path tracing alone": {"light_paths": 0}, "light_paths=1/4": {"light_paths": 1 / 4}}
SAMPLERS = ("stratified", "multijitter", "orthogonal", "ldsampler")
KINDS = [("independent", "independent"), ("sobol", "independent"), *(("sampler", s) for s in SAMPLERS)]


def error(name: str, parameters: dict, points: str, sampler: str, spp: int) -> float:
    """Trimmed relMSE times samples per pixel."""
    scene = load_scene(name, resolution=RESOLUTION, sampler=sampler, spp=spp)
    depth = benchmark_depth(name)
    expected = load_reference(name, RESOLUTION, depth).image
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "points": points, **parameters})
    found = []
    for seed in range(SEEDS):
        image = np.array(integrator.render(scene, seed=seed, spp=spp))[..., :3]
        found.append(metrics.rel_mse(image, expected, metrics.TRIM) * sum(integrator.statistics["passes"]))
    return statistics.median(found)


def main(arguments=None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.split("\n\n")[0])
    parser.add_argument("scenes", nargs="+", help="names in scenes/")
    names = parser.parse_args(arguments).scenes
    mi.set_variant("llvm_ad_rgb")
    for method, parameters in METHODS.items():
        errors = {
            kind: [error(name, parameters, *kind, spp) for name in names for spp in BUDGETS] for kind in KINDS
        }
        base = errors.pop(KINDS[0])
        rows = []
        for (points, sampler), found in errors.items():
            text = f"`{points}`" + (f", `{sampler}`" if points == "sampler" else "")
            rows.append([text, *(f"{a / b:.2f}" for a, b in zip(found, base, strict=True))])
        heads = [f"`{name}`, {spp}" for name in names for spp in BUDGETS]
        print(f"{method}\n\n{table(['points', *heads], rows)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
