"""Kernel time over that of its rays alone, see `instruments.floor`.

python scripts/floor.py cornell_box uplight_room veach_mis
python scripts/floor.py -o results/benchmark/floor.json    # of some scenes, for the goals
"""

from __future__ import annotations

import statistics
import sys
from pathlib import Path

import command_line
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.files.texts import write_json
from mitsuba_bdpt.measure.options import WHOLE
from mitsuba_bdpt.measure.preset import machine, software
from repository import PROJECT

import mitsuba as mi  # isort: skip

from instruments import floor

# Scenes by default. One or two camera subpaths per light subpath: with 16 the replay is cut into so many
# small kernels that it is no floor.
RECORDED = ("veach_mis", "many_lights", "glass_caustics")


def main(arguments=None) -> int:
    """Print the ratio per scene."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scene", nargs="*", default=RECORDED)
    parser.add_argument("--rounds", type=WHOLE, default=5)
    parser.add_argument("--path", action="store_true", help="of Mitsuba's path, over the same floor")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.json", help="write the ratios there")
    options = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    found = {}
    for name in options.scene:
        found[name] = floor.measure(PROJECT.scene(name), options.rounds, of_path=options.path)
        middle, low, high = (of(found[name]) for of in (statistics.median, min, max))
        print(f"{name}: {middle:.2f}x the floor ({low:.2f}-{high:.2f})", flush=True)
    if options.output:
        write_json(options.output, {"versions": software() | {"machine": machine()}, "values": found})
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
