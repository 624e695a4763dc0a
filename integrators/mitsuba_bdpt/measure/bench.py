"""Renders the cells of a sweep, locally or on a cluster's worker."""

from __future__ import annotations

import datetime
import json
import math
import tempfile
from dataclasses import asdict
from functools import cache, lru_cache
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import workers
from ..errors import CommandError, message
from ..files.texts import read_json, write_json
from .options import VARIANT
from .preset import Cell, Cells, machine, read_preset, software
from .project import Project
from .scenes import integrator_of
from .timing import timed

CALIBRATIONS = 3  # alternating renders that calibrate the samples for equal time


class Bench:
    """Loaded scenes and integrators of one scene's cells, with compiled kernels."""

    def __init__(self, cells: Cells, output: Path):
        self.cells, self.output = cells, output
        _, self._file, self._resolution, self._depth = cells.where()
        self._scenes, self._integrators, self._compile, self._pilot, self._spp = {}, {}, {}, {}, {}

    def scene(self, sampler: str):
        if sampler not in self._scenes:
            self._scenes[sampler] = self._file.load(self._resolution, sampler)
        return self._scenes[sampler]

    def integrator(self, cell: Cell):
        if cell.parameters not in self._integrators:
            self._integrators[cell.parameters] = integrator_of(dict(cell.parameters), self._depth)
        return self._integrators[cell.parameters]

    def timed(self, cell: Cell, spp: int, seed: int):
        """Return image and wall seconds of a render."""
        return timed(self.scene(cell.sampler), self.integrator(cell), spp, seed)

    def compile_seconds(self, cell: Cell, spp: int) -> float:
        """Return the seconds of compiling an integrator's kernels.

        Less with a cache on disk. Mitsuba's integrators compile for each number of samples.
        """
        key = cell.method, spp
        if key not in self._compile:
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
                dr.kernel_history_clear()
                self.timed(cell, spp, 0)
                kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
            statistics = getattr(self.integrator(cell), "statistics", None)
            self._pilot[key] = statistics["seconds"]["pilot"] if statistics else 0.0
            self._compile[key] = (
                statistics["seconds"]["compile"]
                if statistics
                else sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1000
            )
        return self._compile[key]

    def pilot_seconds(self, cell: Cell, spp: int) -> float:
        """Return the seconds of the first render's pilots, whose results are then cached."""
        self.compile_seconds(cell, spp)
        return self._pilot[cell.method, spp]

    def spp_of(self, cell: Cell) -> int:
        """Return the samples of a cell: its budget, or those for equal time.

        The ratio of seconds is measured once, at the largest budget.
        """
        first, largest = self.cells.of(cell.budget, cell.seed)[0], max(self.cells.subject.spp)
        if cell.match == "spp" or cell.method == first.method:
            return self._possible(cell.sampler, cell.budget)
        if cell.method not in self._spp:
            one = next(c for c in self.cells.of(largest, 0) if c.method == cell.method)
            kept = self.output / "ratios" / f"{one.key}.json"
            if not kept.exists():
                for one_of_both in (first, cell):
                    self.compile_seconds(one_of_both, largest)
                pairs = [
                    [self.timed(c, largest, seed)[1] for c in (first, cell)] for seed in range(CALIBRATIONS)
                ]
                write_json(kept, float(np.median([ours / theirs for ours, theirs in pairs])))
            self._spp[cell.method] = read_json(kept, "delete it, to measure it anew")
        wanted = cell.budget * self._spp[cell.method]
        if cell.sampler == "independent":
            return max(round(wanted), 1)
        # Mitsuba's stratified samplers are a tenth slower per sample far from a power of two.
        return self._possible(cell.sampler, 2 ** max(round(math.log2(wanted)), 0))

    def _possible(self, sampler: str, spp: int) -> int:
        """Return the samples that a sampler takes: stratified ones may round up."""
        fork = self.scene(sampler).sensors()[0].sampler().fork()
        fork.set_sample_count(spp)
        return int(fork.sample_count())


def measure(bench: Bench, cell: Cell) -> tuple[dict, np.ndarray]:
    """Render a cell; returns its row, without errors, and its image."""
    spp = bench.spp_of(cell)
    compile_seconds = bench.compile_seconds(cell, spp)
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    image, seconds = bench.timed(cell, spp, cell.seed)
    statistics = getattr(bench.integrator(cell), "statistics", {})
    row = {
        "key": cell.key,
        **{k: v for k, v in asdict(cell).items() if k not in ("parameters", "versions", "against")},
        "machine": machine(),
        "parameters": json.dumps(dict(cell.parameters)),
        "versions": json.dumps(dict(cell.versions)),
        "started": started,
        # A target error or timeout may end a render early.
        "spp": sum(statistics.get("passes", ())) or spp,
        "seconds": seconds,
        "seconds_compile": compile_seconds,
        "seconds_pilot": bench.pilot_seconds(cell, spp),
        "statistics": json.dumps(statistics),
        "decisions": json.dumps(statistics.get("decisions")),
    }
    return row | {f"rays_{kind}": n for kind, n in statistics.get("rays", {}).items()}, image


def measured(root: str, preset: str, scene: str, cells: list[dict]) -> list:
    """On a worker: return row and image of each cell, or the text of its error.

    ``root``: of the project; ``preset``: its text; ``scene``: its name.
    """
    with workers.one_at_a_time:
        mi.set_variant(VARIANT)
        bench, found = _bench(root, preset, scene, cells[0]["scene_sha256"]), []
        for entry in cells:
            cell = Cell(**entry)
            if cell.versions != _loaded_software():
                raise CommandError(f"a worker has other software than the client: {dict(_loaded_software())}")
            if cell.scene_sha256 != bench.cells.common["scene_sha256"]:
                raise CommandError(f"a worker has another {scene}.xml, mesh or texture than the client")
            try:
                found.append(measure(bench, cell))
            except Exception as error:  # one cell must not end the others
                found.append(message(error))
        return found


@cache
def _loaded_software() -> tuple:
    """Return `software` at the first call: files may change later, imports do not."""
    return tuple(software().items())


@lru_cache(maxsize=2)
def _bench(root: str, preset: str, scene: str, scene_sha256: str) -> Bench:
    """Return the cached bench of a scene of a preset.

    Identified by the scene's content and the preset's text.
    """
    folder = tempfile.TemporaryDirectory(prefix="bdpt_sweep_")
    file = Path(folder.name) / "preset.toml"
    file.write_text(preset)
    project = Project(Path(root))
    whole = read_preset(file, project)
    subject = next(subject for subject in whole.subjects if subject.name == scene)
    bench = Bench(Cells(project, whole, subject), file.parent)
    bench.folder = folder  # lives as long as the bench
    return bench
