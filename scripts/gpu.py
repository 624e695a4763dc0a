"""The benchmark's scenes on a GPU: errors and times of `bdpt` and `path` in a variant of CUDA.

    python scripts/gpu.py --output docs/reports/cuda.json            # all scenes of the benchmark
    python scripts/gpu.py --output docs/reports/cuda.json --report   # the page of the file that is there

Every scene has a process of its own, twelve at a time. First they render all methods once, side by side,
which compiles their kernels; then they take turns, so that nothing else runs on the GPU while one is timed.
(Thirty side by side run out of memory: each keeps stacks for all threads of the GPU.) 128^2 pixels, as many
samples per pixel for every method; `path` (`volpath` in media) with the sampler `multijitter`. An error is
the median relMSE over seeds against the reference that is committed, raw and without the worst pixels; the
ratio over `path` that of errors times seconds. Bias: `compare_means` of the renders against the reference.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from functools import partial
from pathlib import Path

import command_line
import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip
import numpy as np
import repository
from mitsuba_bdpt.host.introspection import versions
from mitsuba_bdpt.measure.agreement import Means, compare_means, tile_columns
from mitsuba_bdpt.measure.results import rel_mse_columns
from mitsuba_bdpt.measure.scenes import integrator_of, path_tracers
from mitsuba_bdpt.measure.tables import ratio, table
from mitsuba_bdpt.measure.timing import Timed, alternating, timed

SPP, SEEDS = 256, 8
METHODS = {
    "bdpt": ({"type": "bdpt"}, "independent"),
    "bdpt skip=none": ({"type": "bdpt", "skip": "none"}, "independent"),
    "path": ({"type": "path"}, "multijitter"),
}
BESIDE = 12
"""Processes at a time."""
PATIENCE = 130
"""Seconds after which a scene no longer waits until all others have compiled."""


def subject(name: str) -> tuple[dict, int]:
    """What renders a scene, {method: (scene, integrator)}, and its ``max_depth``."""
    file, depth = repository.PROJECT.scene(name), repository.benchmark_depth(name)
    loaded = {sampler: file.load(repository.RESOLUTION, sampler) for _, sampler in METHODS.values()}
    made = {}
    for method, (parameters, sampler) in METHODS.items():
        if method == "path":
            parameters = parameters | {"type": path_tracers(file.has_media)[0]}
        made[method] = loaded[sampler], integrator_of(parameters, depth)
    return made, depth


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


def measure(name: str, variant: str, compiled, turn, results) -> None:
    """Put the rows of a scene, or the error that it ended with, into the queue ``results``."""
    mi.set_variant(variant)
    try:
        methods, depth = subject(name)
        renders = [partial(timed, *made, SPP) for made in methods.values()]
        first = [render(0).seconds for render in renders]
        wait(compiled)
        reference = repository.load_reference(name, repository.RESOLUTION, depth)
        with turn:
            turns = list(alternating(renders, SEEDS, is_warm=True))
        rows = [
            row(name, reference, method, list(found)) | {"first_seconds": seconds}
            for method, found, seconds in zip(methods, zip(*turns, strict=True), first, strict=True)
        ]
        results.put((name, rows, versions()))
    except Exception as error:  # the others go on; it is in the file
        results.put((name, f"{type(error).__name__}: {error}", versions()))
        wait(compiled)


def wait(compiled) -> None:
    """Until all processes have come so far, or `PATIENCE` is at an end for one of them."""
    if not compiled.broken:
        try:
            compiled.wait(PATIENCE)
        except Exception:  # threading.BrokenBarrierError, of a class that depends on the platform
            return


def collect(names: list[str], variant: str) -> tuple[list[dict], dict, dict]:
    """Rows of scenes that are rendered side by side, errors of those that failed, and versions."""
    context = multiprocessing.get_context("spawn")
    compiled, turn, results = context.Barrier(len(names)), context.Lock(), context.Queue()
    processes = [
        context.Process(target=measure, args=(name, variant, compiled, turn, results), daemon=True)
        for name in names
    ]
    for process in processes:
        process.start()
    rows, failed, software, waiting = [], {}, {}, set(names)
    while waiting and any(process.is_alive() for process in processes):
        if results.empty():
            time.sleep(0.05)
            continue
        name, found, software = results.get()
        waiting.discard(name)
        if isinstance(found, str):
            failed[name] = found
        else:
            rows += found
        print(name, found if isinstance(found, str) else "done", flush=True)
    failed |= dict.fromkeys(waiting, "its process ended without a word")
    return rows, failed, software


def batched(names: list[str], size: int) -> list[list[str]]:
    """``names`` in lists of ``size`` (`itertools.batched` is not in Python 3.11)."""
    return [names[i : i + size] for i in range(0, len(names), size)]


def speedup(ours: dict, theirs: dict, error: str) -> float:
    """Ratio of efficiencies 1 / (seconds * error) of two methods, ours over theirs."""
    return theirs["seconds"] * theirs[error] / (ours["seconds"] * ours[error])


def page(found: dict) -> str:
    """The table of a file's figures, as Markdown."""
    by_scene: dict[str, dict] = {}
    for one in found["rows"]:
        by_scene.setdefault(one["scene"], {})[one["method"]] = one
    lines = []
    for name, methods in sorted(by_scene.items()):
        ours, path, none = methods["bdpt"], methods["path"], methods["bdpt skip=none"]
        bias = (
            "too few renders" if ours["bias"] is None else "none found" if ours["bias"]["passed"] else "found"
        )
        lines.append(
            [
                name,
                f"{1e3 * ours['seconds']:.0f}",
                f"{1e3 * path['seconds']:.0f}",
                f"{ours['trimmed']:.3g}",
                *(ratio(speedup(ours, path, which)) for which in ("trimmed", "rel_mse")),
                ratio(speedup(ours, none, "trimmed")),
                f"{ours['first_seconds']:.0f}",
                bias,
            ]
        )
    head = [
        "scene", "ms", "`path` ms", "relMSE, trimmed", "over `path`, trimmed", "raw", "over `skip=none`",
        "first render, s", "bias",
    ]  # fmt: skip
    return table(head, lines)


def main(arguments=None) -> None:
    """Measure, or print the table of an earlier measurement."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scenes", nargs="*", help="names; by default those of the benchmark")
    parser.add_argument("--variant", default="cuda_ad_rgb")
    parser.add_argument("--device", default="", help="name of the GPU, for the file")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.json")
    parser.add_argument("--report", action="store_true", help="print the table of the file")
    options = parser.parse_args(arguments)
    if not options.report:
        found = {"variant": options.variant, "device": options.device, "spp": SPP, "rows": [], "failed": {}}
        for names in batched(options.scenes or repository.benchmark_scenes(), BESIDE):
            rows, failed, found["software"] = collect(names, options.variant)
            found["rows"] += rows
            found["failed"] |= failed
            options.output.write_text(json.dumps(found, indent=1) + "\n")
    print(page(json.loads(options.output.read_text())))


if __name__ == "__main__":
    main()
