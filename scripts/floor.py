"""Kernel time over that of its rays alone, see `instruments.floor`.

python scripts/floor.py cornell_box uplight_room veach_mis
"""

from __future__ import annotations

import statistics
import sys

import command_line
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import number
from mitsuba_bdpt.measure import probes
from mitsuba_bdpt.measure.project import Project
from repository import PROJECT, ROOT

import mitsuba as mi  # isort: skip

from instruments import floor

# One or two camera subpaths per light subpath: with 16 the replay is cut into so many small kernels that it
# is no floor.
PROBED = ("veach_mis", "many_lights", "glass_caustics")

CODE = """
import sys, mitsuba_bdpt, mitsuba as mi
sys.path.append(sys.argv[1])
from repository import PROJECT
from instruments import floor
mi.set_variant("llvm_ad_rgb")
print(*floor.measure(PROJECT.scene(sys.argv[2]), int(sys.argv[3])))
"""


def probe(project: Project, rounds: int) -> dict:
    """Kernel time over that of its rays alone, by scene, a value per round: a probe of sweeps."""
    scripts = str(ROOT / "scripts")
    return {name: probes.numbers(CODE, scripts, name, str(rounds)) for name in PROBED}


def main(arguments=None) -> int:
    """Print the ratio per scene."""
    parser = command_line.parser(__doc__)
    parser.add_argument("scene", nargs="+")
    parser.add_argument("--rounds", type=number(int, 1), default=5)
    parser.add_argument("--path", action="store_true", help="of Mitsuba's path, over the same floor")
    options = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    for name in options.scene:
        ratios = floor.measure(PROJECT.scene(name), options.rounds, of_path=options.path)
        middle = statistics.median(ratios)
        print(f"{name}: {middle:.2f}x the floor ({min(ratios):.2f}-{max(ratios):.2f})", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
