"""Kernel time over that of its rays alone, see `instruments.floor`.

python scripts/floor.py cornell_box uplight_room veach_mis
python scripts/floor.py --record results/benchmark/probes.json    # beside the probes of a sweep
"""

from __future__ import annotations

import statistics
import sys
from pathlib import Path

import command_line
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.files.texts import read_json, write_json
from mitsuba_bdpt.measure import probes
from mitsuba_bdpt.measure.options import Number
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


def record(file: Path, rounds: int) -> None:
    """Add the floor to the probes of a sweep, unless the same software was measured before.

    A process for each scene.
    """
    kept = read_json(file, "delete it, to measure it anew") if file.exists() else {}
    key = {"rounds": rounds, "versions": software() | {"machine": machine()}}
    if {name: kept.get("floor", {}).get(name) for name in key} == key:
        return
    scripts = str(ROOT / "scripts")
    values = {name: probes.numbers(CODE, scripts, name, str(rounds)) for name in RECORDED}
    write_json(file, kept | {"floor": key | {"values": values}})


def main(arguments=None) -> int:
    """Print the ratio per scene."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scene", nargs="*")
    parser.add_argument("--rounds", type=Number(int, 1), default=5)
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
