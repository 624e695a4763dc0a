"""Two checkouts of the plugin on the same scenes: are images the same, and which takes longer?

    git worktree add ../before v0.1.0
    python scripts/versus.py ../before                                 # all scenes of the benchmark
    python scripts/versus.py ../before --scenes pool veach_mis --spp 16 --pairs 12
    python scripts/versus.py ../before --parameters skip=none          # instead of the default

Each checkout renders in a process of its own, in turns, the scenes of this one at 128^2, warm. For each
scene: the largest difference of two values of the same seed, over the image's mean (sums of floats in another
order: below 1e-4); time, errors and efficiency of this checkout over the other's, as `mitsuba-bdpt compare`
shows them; what the other one decided, and this one. The exit status is 1 with ``--same`` if an image differs
by more than 1e-4 of its mean or a decision does.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

import command_line
import numpy as np
import pandas as pd
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import property_
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.files.loading import in_proportion
from mitsuba_bdpt.measure import compare
from mitsuba_bdpt.measure.options import WHOLE
from mitsuba_bdpt.measure.results import rel_mse_columns
from mitsuba_bdpt.measure.tables import markdown
from mitsuba_bdpt.measure.timing import Timed, alternating

import mitsuba as mi  # isort: skip

HERE = Path(__file__).resolve().parents[1]

ROUNDING = 1e-4  # of an image's mean: what sums of floats differ by in another order

# What each process runs: it answers each line of its input with one.
CHILD = """
import json, sys, time
import mitsuba_bdpt, mitsuba as mi, drjit as dr, numpy as np
mi.set_variant('llvm_ad_rgb')
for line in sys.stdin:
    asked = json.loads(line)
    if 'scene' in asked:
        # With optimize Mitsuba puts objects without id in another order in each process.
        scene = mi.load_file(asked['scene'], parallel=False, optimize=False, **asked['definitions'])
        bdpt = mi.load_dict(asked['integrator'])
        answer = mitsuba_bdpt.__file__
    else:
        dr.sync_thread(); started, cpu_started = time.perf_counter(), time.process_time()
        image = np.array(bdpt.render(scene, seed=asked['seed'], spp=asked['spp']))[..., :3]
        taken = time.perf_counter() - started, time.process_time() - cpu_started
        np.save(asked['image'], image)
        made = [[d['light_paths'], d['connections'], d['coefficients']] for d in bdpt.statistics['decisions']]
        answer = [*taken, made]
    print('ANSWER', json.dumps(answer), flush=True)
"""


class Checkout:
    """A process that renders with the plugin of the checkout in a folder.

    ``decisions``: those of the last render. Raises ``CommandError`` if there is no plugin.
    """

    def __init__(self, folder: Path, images: Path):
        sources = folder / "integrators"
        if not (sources / "mitsuba_bdpt" / "__init__.py").exists():
            raise CommandError(
                f"checkout={folder} has no integrators/mitsuba_bdpt; give a clone or a worktree"
            )
        self._image, self._sources = images / f"{len(list(images.iterdir()))}.npy", sources.resolve()
        self._image.touch()
        self.decisions: list = []
        environment = os.environ | {"PYTHONPATH": str(self._sources)}
        command = [sys.executable, "-c", CHILD]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, env=environment, text=True, stdin=pipe, stdout=pipe)

    def _ask(self, **what):
        self._process.stdin.write(json.dumps(what) + "\n")
        self._process.stdin.flush()
        for text in self._process.stdout:
            _, found, answer = text.partition("ANSWER ")  # the rest is what Mitsuba logs
            if found:
                return json.loads(answer)
        raise RuntimeError(f"the process of {self._sources} has ended; its error stands above")

    def load(self, name: str, integrator: dict):
        """Load a scene."""
        scene = repository.scene_file(name)
        definitions = in_proportion(scene, {"resolution": repository.RESOLUTION})
        found = self._ask(scene=str(scene), definitions=definitions, integrator=integrator)
        if not Path(found).is_relative_to(self._sources):
            raise RuntimeError(f"{found} was imported in place of {self._sources}")

    def render(self, spp: int, seed: int) -> Timed:
        """A render of the scene."""
        *taken, self.decisions = self._ask(seed=seed, spp=spp, image=str(self._image))
        return Timed(np.load(self._image).astype(np.float64), *taken)

    def close(self):
        """End the process."""
        self._process.communicate()


def line(name: str, sides: list[Checkout], parameters: dict, spp: int, pairs: int) -> tuple[dict, bool]:
    """A scene's line of the table, and whether both checkouts made the same."""
    depth = repository.benchmark_depth(name)
    expected = repository.load_reference(name, repository.RESOLUTION, depth)
    for side in sides:
        side.load(name, {"type": "bdpt", "max_depth": depth} | parameters)
    apart, same, rows = 0.0, True, ([], [])
    for turn in alternating([partial(side.render, spp) for side in sides], pairs):
        old, new = (one.image for one in turn)
        apart = max(apart, np.abs(new - old).max() / old.mean())
        same &= sides[0].decisions == sides[1].decisions
        for own, one in zip(rows, turn, strict=True):
            own.append({"seconds": one.seconds} | rel_mse_columns(one.image, expected))
    old, new = map(pd.DataFrame, rows)
    cells = {"scene": f"`{name}`", "apart": f"{apart:.1g}"} | compare.line(new, old)
    cells["decided"] = " → ".join(_named(side.decisions) for side in sides)
    return cells, bool(same and apart < ROUNDING)


def _named(decisions: list) -> str:
    if not decisions:
        return "–"
    share, connections, _ = decisions[-1]
    return f"1/{round(1 / share)} {connections}" if share else "0"


def main(arguments=None) -> int:
    """Print the table."""
    parser = command_line.parser(__doc__)
    parser.add_argument("checkout", type=Path, help="the folder of the other one")
    parser.add_argument("--scenes", nargs="+", help="names in scenes/ that have references")
    parser.add_argument("--parameters", nargs="+", default=[], metavar="KEY=VALUE")
    parser.add_argument("--spp", type=WHOLE, default=64)
    parser.add_argument("--pairs", type=WHOLE, default=8)
    parser.add_argument("--same", action="store_true", help="fail unless images and decisions are the same")
    options = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    parameters = dict(map(property_, options.parameters))
    mi.load_dict({"type": "bdpt"} | parameters)  # checks them
    names = options.scenes or repository.benchmark_scenes()
    for name in names:
        repository.benchmark_depth(name)  # known before anything is rendered
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        sides = [
            stack.enter_context(closing(Checkout(checkout, Path(folder))))
            for checkout in (options.checkout, HERE)
        ]
        lines = []
        for name in names:
            lines.append(line(name, sides, parameters, options.spp, options.pairs))
            print("  ".join(lines[-1][0].values()), file=sys.stderr, flush=True)
    print(markdown(pd.DataFrame([cells for cells, _ in lines])))
    return int(options.same and not all(same for _, same in lines))


if __name__ == "__main__":
    sys.exit(answered(main))
