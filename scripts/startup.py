"""First and second render of scenes with many emitters or BSDFs, and of rooms, for `path` and `bdpt`.

    python scripts/startup.py
    python scripts/startup.py --rooms 10 27 --spp 8 64 --rounds 5

A process for each row and round, with an empty kernel cache: seconds to the first image of 128^2 pixels
(compilation included), then of a second render (seed and samples changed: nothing is compiled, kernels are
only recorded, unless the pilot decides otherwise). With ``--rooms`` the materials of `room` instead, both
integrators by turns: medians over the rounds of seconds, of the CPU seconds of the thread that compiles
beyond those of the same render again, which other processes disturb less, and of the ratio of these.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
from pathlib import Path

import command_line
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import number
from mitsuba_bdpt.measure.probes import numbers
from mitsuba_bdpt.measure.tables import table
from room import MOST

COUNTS = ((1, 1), (30, 1), (300, 1), (1, 10), (1, 100))

CODE = """
import sys, time
import mitsuba_bdpt, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
T = mi.ScalarTransform4f
kind, lamps, bsdfs = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
film = {"type": "hdrfilm", "width": 128, "height": 128}
look = T().look_at([0, 3, 8], [0, 0, 0], [0, 1, 0])
scene = {"type": "scene", "sensor": {"type": "perspective", "to_world": look, "film": film}}
for i in range(lamps):
    x, z = i % 20 - 10, i // 20 - 7
    place = T().translate([x, 4, z]).rotate([1, 0, 0], 90).scale(0.1)
    emitter = {"type": "area", "radiance": 1.0 + i}
    scene[f"lamp{i}"] = {"type": "rectangle", "to_world": place, "emitter": emitter}
for i in range(bsdfs):
    x, z = i % 10 - 5, i // 10 - 5
    bsdf = [
        {"type": "diffuse", "reflectance": 0.2 + 0.005 * i},
        {"type": "roughconductor", "alpha": 0.1 + 0.002 * i},
        {"type": "plastic", "int_ior": 1.3 + 0.001 * i},
        {"type": "dielectric", "int_ior": 1.3 + 0.002 * i},
    ][i % 4]
    scene[f"ball{i}"] = {"type": "sphere", "center": [x, 0, z], "radius": 0.4, "bsdf": bsdf}
scene = mi.load_dict(scene)
integrator = mi.load_dict({"type": kind, "max_depth": 6})
for seed, spp in ((0, 8), (1, 16)):  # long enough for a pilot
    start = time.perf_counter()
    dr.eval(integrator.render(scene, seed=seed, spp=spp))
    dr.sync_thread()
    print(time.perf_counter() - start)
"""

# Of materials 0 the Cornell box.
ROOM = """
import sys, time
import mitsuba_bdpt, room, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
kind, materials, spp = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
box = mi.cornell_box()
box["sensor"]["film"].update(width=128, height=128)
scene = mi.load_dict(room.room(materials) if materials else box)
integrator = mi.load_dict({"type": kind, "max_depth": 8})
clocks = time.perf_counter, time.thread_time
taken = []
for _ in range(2):
    start = [clock() for clock in clocks]
    dr.eval(integrator.render(scene, spp=spp))
    dr.sync_thread()
    taken.append([clock() - begun for clock, begun in zip(clocks, start)])
print(taken[0][0], taken[0][1] - taken[1][1])
"""


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    materials = number(int, 0, MOST)
    parser.add_argument("--rooms", type=materials, nargs="+", help="numbers of materials; 0: the Cornell box")
    count = number(int, 1)
    parser.add_argument("--spp", type=count, nargs="+", help="samples per pixel, of rooms; default: 8")
    parser.add_argument("--rounds", type=count, help="renders of each room; default: 3")
    asked = parser.parse_args(arguments)
    if asked.rooms is None and (asked.spp or asked.rounds):
        parser.error("--spp and --rounds are of rooms: add --rooms")
    spp, rounds = asked.spp or [8], asked.rounds or 3
    if asked.rooms is not None:
        print(table(*_rooms(asked.rooms, spp, rounds)))
        return 0
    rows = []
    for lamps, bsdfs in COUNTS:
        row = [str(lamps), str(bsdfs)]
        for kind in ("path", "bdpt"):
            first, second = _cold(CODE, kind, str(lamps), str(bsdfs))
            row += [f"{first:.2f}", f"{second:.3f}"]
        rows.append(row)
    head = ["emitters", "BSDFs", "path: first", "second", "bdpt: first", "second"]
    print(table(head, rows))
    return 0


def _rooms(rooms, counts, rounds: int) -> tuple[list, list]:
    """Head and rows of the table of first images of rooms."""
    rows = []
    for materials in rooms:
        for spp in counts:
            times = [
                [_cold(ROOM, kind, str(materials), str(spp)) for kind in ("path", "bdpt")]
                for _ in range(rounds)
            ]
            (path, path_cpu), (bdpt, bdpt_cpu) = (
                [statistics.median(time) for time in zip(*of_kind, strict=True)]
                for of_kind in zip(*times, strict=True)
            )
            ratio = statistics.median(ours[1] / theirs[1] for theirs, ours in times)
            row = [f"{x:.2f}" for x in (path, bdpt, path_cpu, bdpt_cpu, ratio)]
            rows.append([str(materials), str(spp), *row])
    return ["materials", "spp", "path", "bdpt", "path: compiling", "bdpt: compiling", "ratio"], rows


def _cold(code, *arguments) -> list[float]:
    """The last two numbers that a process with an empty kernel cache prints."""
    with tempfile.TemporaryDirectory() as cache:
        empty = os.environ | {"DRJIT_CACHE_DIR": cache, "HOME": cache}
        return numbers(code, *arguments, environment=empty, folder=Path(__file__).parent)[-2:]


if __name__ == "__main__":
    sys.exit(answered(main))
