"""The benchmark's scenes on a GPU: errors and times of `bdpt` and `path` in a variant of CUDA.

    python scripts/gpu.py --device "NVIDIA H200"    # all of them; writes docs/reports/cuda.json

Every scene first renders once by each method in a process of its own, twelve at a time, which compiles its
kernels (thirty run out of memory: each keeps stacks for all threads of the GPU), then, alone, in another one
that is timed. 128^2 pixels, as many samples per pixel for every method; `path` (`volpath` in media) with the
sampler `multijitter`. An error is the median relMSE over seeds against the reference that is committed, raw
and without the worst pixels. Bias: `compare_means` of the renders against the reference.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path

import command_line
import numpy as np
import pandas as pd
import repository
from mitsuba_bdpt.host.introspection import versions
from mitsuba_bdpt.measure.agreement import Means, compare_means, tile_columns
from mitsuba_bdpt.measure.results import rel_mse_columns
from mitsuba_bdpt.measure.scenes import integrator_of, path_tracers
from mitsuba_bdpt.measure.tables import markdown, ratio
from mitsuba_bdpt.measure.timing import Timed, alternating, timed

import mitsuba as mi  # isort: skip

RECORD = repository.ROOT / "docs" / "reports" / "cuda.json"
SPP, SEEDS = 256, 8
METHODS = {
    "bdpt": ({"type": "bdpt"}, "independent"),
    "bdpt skip=none": ({"type": "bdpt", "skip": "none"}, "independent"),
    "path": ({"type": "path"}, "multijitter"),
}
BESIDE = 12  # processes at a time


def row(name: str, reference, method: str, found: list[Timed]) -> dict:
    """What the renders of one method do in a scene."""
    errors = [rel_mse_columns(one.image, reference) for one in found]
    judged = None
    if reference.means is not None:
        means = Means.of([tile_columns(one.image) for one in found])
        check = compare_means(means, reference.means)
        judged = {"passed": bool(check.passed), "p": float(check.p)}
    return {
        "scene": name,
        "method": method,
        "seconds": float(np.median([one.seconds for one in found])),
        "rel_mse": float(np.median([error["rel_mse"] for error in errors])),
        "trimmed": float(np.median([error["rel_mse_trimmed"] for error in errors])),
        "mean": float(np.mean([one.image for one in found])),
        "bias": judged,
    }


def here(name: str, seeds: int) -> list:
    """The rows of a scene; without ``seeds`` the seconds of the first renders."""
    file, depth = repository.PROJECT.scene(name), repository.benchmark_depth(name)
    renders, load = [], cache(partial(file.load, repository.RESOLUTION))
    for method, (parameters, sampler) in METHODS.items():
        if method == "path":
            parameters = parameters | {"type": path_tracers(file.has_media)[0]}
        renders.append(partial(timed, load(sampler), integrator_of(parameters, depth), SPP))
    first = [render(0).seconds for render in renders]
    if not seeds:
        return first
    reference = repository.load_reference(name, repository.RESOLUTION, depth)
    turns = zip(*alternating(renders, seeds, is_warm=True), strict=True)
    return [row(name, reference, *found) for found in zip(METHODS, turns, strict=True)]


def apart(variant: str, seeds: int, name: str) -> list | str:
    """What `here` returns in a new process, or the last line of its error."""
    command = [sys.executable, __file__, "--here", name, str(seeds), "--variant", variant]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]
    return json.loads(done.stdout.splitlines()[-1])


def speedup(ours: dict, theirs: dict, error: str) -> float:
    """Ratio of efficiencies 1 / (seconds * error) of two methods, ours over theirs."""
    return theirs["seconds"] * theirs[error] / (ours["seconds"] * ours[error])


def page(found: dict) -> str:
    """The table of a record, as Markdown."""
    by_scene: dict[str, dict] = {}
    for one in found["rows"]:
        by_scene.setdefault(one["scene"], {})[one["method"]] = one
    lines = []
    for name, methods in sorted(by_scene.items()):
        ours, path, none = methods["bdpt"], methods["path"], methods["bdpt skip=none"]
        judged = {None: "too few renders", True: "none found", False: "found"}
        lines.append(
            {
                "scene": name,
                "ms": f"{1e3 * ours['seconds']:.0f}",
                "`path` ms": f"{1e3 * path['seconds']:.0f}",
                "relMSE, trimmed": f"{ours['trimmed']:.3g}",
                "over `path`, trimmed": ratio(speedup(ours, path, "trimmed")),
                "raw": ratio(speedup(ours, path, "rel_mse")),
                "over `skip=none`": ratio(speedup(ours, none, "trimmed")),
                "first render, s": f"{ours['first_seconds']:.0f}",
                "bias": judged[ours["bias"] and ours["bias"]["passed"]],
            }
        )
    return markdown(pd.DataFrame(lines))


def main(arguments=None) -> None:
    """Measure."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scenes", nargs="*", help="names; by default those of the benchmark")
    parser.add_argument("--variant", default="cuda_ad_rgb")
    parser.add_argument("--device", default="", help="name of the GPU, for the file")
    parser.add_argument("--output", type=Path, default=RECORD, metavar="FILE.json")
    parser.add_argument("--here", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    mi.set_variant(options.variant)
    if options.here:
        print(json.dumps(here(options.here[0], int(options.here[1]))))
        return
    names = options.scenes or repository.benchmark_scenes()
    found = {"variant": options.variant, "device": options.device, "spp": SPP, "rows": [], "failed": {}}
    found["software"] = versions()
    with ThreadPoolExecutor(BESIDE) as pool:
        first = list(pool.map(partial(apart, options.variant, 0), names))
    for name, compiled in zip(names, first, strict=True):
        rows = compiled if isinstance(compiled, str) else apart(options.variant, SEEDS, name)
        if isinstance(rows, str):
            found["failed"][name] = rows
        else:
            found["rows"] += [one | {"first_seconds": s} for one, s in zip(rows, compiled, strict=True)]
        print(name, found["failed"].get(name, "done"), flush=True)
        options.output.write_text(json.dumps(found, indent=1) + "\n")
    print(page(found))


if __name__ == "__main__":
    main()
