"""The paths behind the worst values of renders, see `instruments.fireflies`.

python scripts/fireflies.py glass_caustics thin_lens --seeds 5
"""

from __future__ import annotations

import sys
from pathlib import Path

import command_line
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure.options import REFERENCE_SECONDS, RESOLUTION, SECONDS, VARIANT, WHOLE, WIDTH, Number
from mitsuba_bdpt.measure.project import Project

import mitsuba as mi  # isort: skip

from instruments import fireflies


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    add, one = parser.add_argument, WHOLE
    add("scenes", nargs="+", help="scene files, or names in PROJECT/scenes")
    add("--project", type=Path, default=repository.ROOT, metavar="DIR", help="default: this repository")
    add("--seeds", type=one, default=5, help="renders of each scene (default: %(default)s)")
    add("--spp", type=one, default=64, help="samples per pixel (default: %(default)s)")
    add("--resolution", type=WIDTH, default=RESOLUTION, help="width (default: %(default)s)")
    add("--max-depth", type=one, help="longest path in edges; default: as in presets/benchmark.toml")
    text = "values of its pixel by which a sample is off (default: %(default)s)"
    add("--level", type=Number(float, 1e-9), default=0.5, help=text)
    add("--top", type=one, default=12, help="samples examined of each render (default: %(default)s)")
    add("--lines", type=one, default=6, help="kinds of paths of each scene (default: %(default)s)")
    text = "seconds that making a missing reference may take (default: %(default)g)"
    add("--reference-seconds", type=SECONDS, default=REFERENCE_SECONDS, help=text)
    options = parser.parse_args(arguments)
    mi.set_variant(VARIANT)
    print(fireflies.text(Project(options.project), options.scenes, options))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
