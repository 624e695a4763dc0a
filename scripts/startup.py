"""First and second render of scenes with many emitters or BSDFs, and of rooms, for `path` and `bdpt`.

    python scripts/startup.py
    python scripts/startup.py --rooms 10 27 --spp 8 64 --rounds 5

By turns, each in a process of its own with an empty kernel cache: seconds to the first image of 128^2 pixels
(compilation included); of the same render again (nothing is compiled, kernels are only recorded); and the CPU
seconds of the thread that compiles beyond those of the second render, which other processes disturb less,
with their ratio. Medians over the rounds. With ``--rooms`` the materials of `room` in place of many emitters
or BSDFs.
"""

from __future__ import annotations

import statistics
import sys
from pathlib import Path

import command_line
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import number
from mitsuba_bdpt.measure import probes
from mitsuba_bdpt.measure.tables import table
from room import MOST

COUNTS = ((1, 1), (30, 1), (300, 1), (1, 10), (1, 100))

CODE = """
import sys, time
import mitsuba_bdpt, room, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
kind, spp, scene = sys.argv[1], int(sys.argv[2]), eval(sys.argv[3])
scene["sensor"]["film"].update(width=128, height=128)
scene, integrator = mi.load_dict(scene), mi.load_dict({"type": kind, "max_depth": 8})
clocks = time.perf_counter, time.thread_time
for _ in range(2):
    start = [clock() for clock in clocks]
    dr.eval(integrator.render(scene, spp=spp))
    dr.sync_thread()
    print(*(clock() - begun for clock, begun in zip(clocks, start)))
"""


def row(name: str, scene: str, spp: int, rounds: int) -> list[str]:
    """A row of the table; ``scene``: an expression of its dictionary."""
    medians, compiling = [], []
    turns = [
        [
            probes.cold(CODE, kind, str(spp), scene, folder=Path(__file__).parent)[-4:]
            for kind in ("path", "bdpt")
        ]
        for _ in range(rounds)
    ]
    for of_kind in zip(*turns, strict=True):
        compiling.append([cpu - again for _, cpu, _, again in of_kind])
        first, _, second, _ = (statistics.median(column) for column in zip(*of_kind, strict=True))
        medians += [f"{first:.2f}", f"{second:.3f}", f"{statistics.median(compiling[-1]):.2f}"]
    ratio = statistics.median(ours / theirs for theirs, ours in zip(*compiling, strict=True))
    return [name, str(spp), *medians, f"{ratio:.2f}"]


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    materials, count = number(int, 0, MOST), number(int, 1)
    parser.add_argument("--rooms", type=materials, nargs="+", help="numbers of materials; 0: the Cornell box")
    parser.add_argument("--spp", type=count, nargs="+", default=[8], help="samples per pixel; default: 8")
    parser.add_argument("--rounds", type=count, default=3, help="renders of each; default: 3")
    asked = parser.parse_args(arguments)
    scenes = {f"{lamps} emitters, {bsdfs} BSDFs": f"room.crowd({lamps}, {bsdfs})" for lamps, bsdfs in COUNTS}
    if asked.rooms:
        scenes = {f"{n} materials": f"room.room({n})" if n else "mi.cornell_box()" for n in asked.rooms}
    head = [
        "scene",
        "spp",
        *(f"{kind}: {what}" for kind in ("path", "bdpt") for what in ("first", "second", "compiling")),
    ]
    rows = [row(name, scene, spp, asked.rounds) for name, scene in scenes.items() for spp in asked.spp]
    print(table([*head, "ratio"], rows))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
