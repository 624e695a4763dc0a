"""Kernel time over that of its rays alone, see `instruments.floor`.

python scripts/floor.py cornell_box uplight_room veach_mis
python scripts/floor.py --record results/benchmark/probes.json    # of some scenes, cold start and memory
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import command_line
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.files.texts import read_json, write_json
from mitsuba_bdpt.measure.options import WHOLE
from mitsuba_bdpt.measure.preset import machine, software
from repository import PROJECT, ROOT

import mitsuba as mi  # isort: skip

from instruments import floor

# Scenes of the record. One or two camera subpaths per light subpath: with 16 the replay is cut into so many
# small kernels that it is no floor.
RECORDED = ("veach_mis", "many_lights", "glass_caustics")

CODE = """
import sys, mitsuba_bdpt, mitsuba as mi
sys.path.append(sys.argv[1])
from repository import PROJECT
from instruments import floor
mi.set_variant("llvm_ad_rgb")
print(*floor.measure(PROJECT.scene(sys.argv[2]), int(sys.argv[3])))
"""


BOX = """
import json, sys, time, mitsuba_bdpt, mitsuba as mi, drjit as dr
from mitsuba_bdpt.host import memory
mi.set_variant("llvm_ad_rgb")
film, parameters, spp = json.loads(sys.argv[1])
box = mi.cornell_box()
box["sensor"]["film"] |= film
scene, integrator = mi.load_dict(box), mi.load_dict(parameters)
dr.sync_thread()
began = time.perf_counter()
image = mi.render(scene, integrator=integrator, spp=spp); dr.eval(image); dr.sync_thread()
print(time.perf_counter() - began, memory.peak() / 2**30)
"""


def numbers(code: str, *arguments: str, **environment: str) -> list[float]:
    """Return the numbers that ``code`` prints last in a new process; ``environment``: added to this one's."""
    command, variables = [sys.executable, "-c", code, *arguments], os.environ | environment
    done = subprocess.run(command, env=variables, stdout=subprocess.PIPE, text=True, check=True)
    return [float(word) for word in done.stdout.splitlines()[-1].split()]


def of_kernels(rounds: int) -> dict[str, list[float]]:
    """Return the ratios of `floor`, by scene."""
    return {name: numbers(CODE, str(ROOT / "scripts"), name, str(rounds)) for name in RECORDED}


def coldstart(rounds: int) -> dict[str, list[float]]:
    """Return seconds from an empty kernel cache to the first image, without loading, by integrator.

    Cornell box, 256x256, depth 6, 16 spp.
    """
    found: dict[str, list[float]] = {"path": [], "bdpt": []}
    for _ in range(rounds):
        for name, seconds in found.items():
            wanted = json.dumps([{}, {"type": name, "max_depth": 6}, 16])
            with tempfile.TemporaryDirectory() as cache:
                seconds.append(numbers(BOX, wanted, DRJIT_CACHE_DIR=cache, HOME=cache)[0])
    return found


def memory(rounds: int) -> dict[str, list[float]]:
    """Return the peak resident GiB of a render, by samples per pixel: Cornell box, 1920x1080, depth 8."""
    film, way = {"width": 1920, "height": 1080}, {"type": "bdpt", "max_depth": 8}
    wanted = {f"{spp} spp": json.dumps([film, way, spp]) for spp in (2, 8)}
    return {name: [numbers(BOX, one)[1] for _ in range(rounds)] for name, one in wanted.items()}


def record(file: Path, rounds: int) -> None:
    """Add floor, cold start and memory, unless the same software was measured before."""
    kept = read_json(file, "delete it, to measure it anew") if file.exists() else {}
    measures = {"floor": (of_kernels, rounds), "coldstart": (coldstart, rounds), "memory": (memory, 1)}
    for name, (measure, n) in measures.items():
        key = {"rounds": n, "versions": software() | {"machine": machine()}}
        if {k: kept.get(name, {}).get(k) for k in key} != key:
            kept[name] = key | {"values": measure(n)}
            write_json(file, kept)


def main(arguments=None) -> int:
    """Print the ratio per scene."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scene", nargs="*")
    parser.add_argument("--rounds", type=WHOLE, default=5)
    parser.add_argument("--path", action="store_true", help="of Mitsuba's path, over the same floor")
    parser.add_argument("--record", type=Path, metavar="FILE", help="write the floor of some scenes there")
    options = parser.parse_args(arguments)
    if bool(options.scene) == bool(options.record):
        parser.error("give scenes, or --record FILE")
    mi.set_variant("llvm_ad_rgb")
    if options.record:
        record(options.record, options.rounds)
        return 0
    for name in options.scene:
        ratios = floor.measure(PROJECT.scene(name), options.rounds, of_path=options.path)
        middle = statistics.median(ratios)
        print(f"{name}: {middle:.2f}x the floor ({min(ratios):.2f}-{max(ratios):.2f})", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
