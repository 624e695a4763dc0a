"""Kernel time over that of its rays alone, see `mitsuba_bdpt.measure.floor`.

python scripts/floor.py cornell_box uplight_room veach_mis
"""

from __future__ import annotations

import argparse
import statistics
import sys

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import number
from mitsuba_bdpt.measure import floor
from repository import PROJECT

import mitsuba as mi  # isort: skip


def main(arguments=None) -> int:
    """Print the ratio per scene."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.split("\n\n")[0])
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
