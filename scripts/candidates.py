"""What the pilot predicts of each way to render, beside what renders show.

    python scripts/candidates.py cornell_box uplight_room glass_caustics

For each scene (128^2, as in the benchmark) and a selection of candidates: the predicted variance of a sample
with what points leave of it, split into that of camera samples and that of splats, and cost; the relMSE of
renders of 64 samples per pixel times 64, trimmed of its worst 0.1 %, with the default points, and their time
over that of path tracing alone. Renders of a given candidate come from the parameter ``decisions``. (What
pilots choose, and what that is worth: scripts/choices.py.)
"""

from __future__ import annotations

import json
import statistics
import sys

import command_line
import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
from mitsuba_bdpt.measure.tables import table

import mitsuba as mi  # isort: skip
import drjit as dr
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure import metrics
from mitsuba_bdpt.measure.timing import timed
from mitsuba_bdpt.planning import moments, pilot
from mitsuba_bdpt.planning.choice import cost
from mitsuba_bdpt.planning.configuration import WEIGHTINGS, Configuration, Decision, Weighting
from mitsuba_bdpt.run import rendering
from repository import RESOLUTION, benchmark_depth, load_reference, load_scene

SPP, LANES, ROUNDS = 64, 1 << 15, 4

# (share of a light subpath, connections, kappa of t = 1 over its count)
SELECTION = (
    (0, "none", 1),
    (1, "none", 1 / 4),
    (1 / 4, "none", 1 / 4),
    (1, "one", 1),
    (1, "one", 1 / 4),
    (1 / 4, "one", 1),
    (1 / 4, "one", 1 / 4),
    (1 / 16, "one", 1 / 4),
    (1 / 4, "all", 1 / 4),
)


def candidate(share: float, connections: str, splat: float) -> Configuration:
    """An entry of `SELECTION` as one of the pilot's."""
    inner = float(connections != "none")
    weighting = Weighting(1, 1, splat * share, inner)
    return Configuration.weighted(weighting, round(1 / share) if share else 1, connections)


def predicted(scene, settings) -> moments.Moments:
    """What several pilots of the scene find."""
    render = rendering.Render(scene, scene.sensors()[0], settings, 1, SPP)
    found = None
    for i in range(ROUNDS):
        seed = dr.opaque(mi.UInt32, i)
        new = pilot.measure(render.prepared, render.plan, settings, seed, LANES)
        found = new if found is None else found.joined(new)
    return found


def rendered(scene, depth: int, made: Decision, expected) -> tuple[float, float]:
    """Median of relMSE times samples, and of seconds per render, over `ROUNDS` renders after a first one."""
    decisions = json.dumps([made.record()])
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth, "decisions": decisions})
    errors, seconds = [], []
    for seed in range(ROUNDS + 1):
        image, taken = timed(scene, integrator, SPP, seed)
        seconds.append(taken)
        errors.append(metrics.rel_mse(image, expected, metrics.TRIM) * SPP)
    return statistics.median(errors[1:]), statistics.median(seconds[1:])


def lines(name: str, depth: int) -> list:
    """Rows of a scene's table."""
    scene = load_scene(name, resolution=RESOLUTION)
    expected = load_reference(name, RESOLUTION, depth).image
    settings = mi.load_dict({"type": "bdpt", "max_depth": depth}).settings
    moments = predicted(scene, settings)
    rows, alone = [], None
    for entry in SELECTION:
        share, connections, splat = entry
        way = candidate(*entry)
        draw = moments.draw if connections == "one" else 0
        base, light = moments.variance(draw, stratified=True)[:, :, WEIGHTINGS.index(way.weighting)].mean(
            axis=0
        )
        light *= way.camera_paths_per_light_path
        each = cost(way, moments.rays)
        made = Decision.of(way, first_pass=0, cost=each, variance=base + light, mean=moments.mean)
        error, seconds = rendered(scene, depth, made, expected)
        alone = alone or seconds
        name_of_share = f"1/{way.camera_paths_per_light_path}" if share else "0"
        rows.append(
            [
                f"`{name}`",
                f"{name_of_share}, {connections}, {splat if share else '–'}",
                f"{base:.3g} + {light:.3g}",
                f"{error:.3g}",
                f"{(base + light) / error:.2f}",
                f"{each:.2f}",
                f"{seconds / alone:.2f}",
            ]
        )
    return rows


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scene", nargs="+")
    options = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    depths = {name: benchmark_depth(name) for name in options.scene}
    head = ["scene", "light_paths, connections, kappa of t=1 over its count", "predicted: camera + splats"]
    head += ["relMSE · spp", "ratio", "predicted cost", "time"]
    rows = []
    for name, depth in depths.items():
        rows += lines(name, depth)
    print(table(head, rows))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
