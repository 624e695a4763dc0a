"""Sweeps of run time against error: scenes x integrators x samples x seeds, one row per render.

Presets (see `preset`) say what is rendered. For each scene, budget and seed all integrators follow one
another, so that a noisy machine is noisy for all. Every finished render is a file of its own in OUTPUT/cells,
named after a hash of all that determines it (parameters, scene, versions, the plugin's source), and is not
rendered again; its image lies in OUTPUT/images. A cell that fails is reported and tried again the next time.
Errors are taken against the references of `making`, which are made first where there are none, and anew when
a reference has become better; HDR-FLIP for the first seed alone, since it takes longer than most renders. On
a cluster, renders that follow one another go to one worker together, which renders them one after the other;
workers see the project under the same path, and have the same software. Probes are left out there.
OUTPUT/rows.csv and OUTPUT/rows.parquet hold all rows of the preset, OUTPUT/probes.json what `probes` measure.
"""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import asdict, replace
from itertools import groupby
from pathlib import Path

import mitsuba as mi
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from .. import workers
from ..errors import CommandError, message
from ..files.images import check_output
from ..files.texts import write_json
from ..run.rendering import raise_interrupt
from . import analysis, probes
from .bench import Bench, measure, measured
from .cells import Cell, Cells, machine, software
from .making import Job, obtained
from .preset import Preset, read_preset
from .project import Project
from .rows import beside, cell_file, judge_of, read_rows, rows, store, write_tables
from .scenes import check_plugins


class Sweep:
    """A preset being rendered into a folder; ``failed``: what went wrong, a text each."""

    def __init__(self, project: Project, preset: Preset, output: Path):
        self.project, self.preset, self.output, self.failed = project, preset, output, []
        self.scenes = [Cells(project, preset, subject) for subject in preset.subjects]
        self._todo = [[c for c in cells.planned() if not self._is_there(c)] for cells in self.scenes]
        self._judges, self._tried = {}, set()
        self._progress, self._task = Progress(), TaskID(0)  # those of `run`, until then shown nowhere

    def prepare(self, seconds: float):
        """Complain of what cannot be rendered, and make references that are missing.

        Before hours of rendering, not after; each reference for at most about so many ``seconds``.
        """
        for cells, missing in zip(self.scenes, self._todo, strict=True):
            for method in {cell.method: cell for cell in missing}.values():
                check_plugins(method.method, dict(method.parameters), method.sampler, cells.subject.max_depth)
        for cells, missing in zip(self.scenes, self._todo, strict=True):
            if missing:
                obtained(Job(*cells.where(), spp=max(cells.subject.spp), seconds=seconds))

    def run(self, progress: Progress, elsewhere=None):
        """Render all that is not there yet, showing ``progress``.

        On a cluster if ``elsewhere``, a client and the preset's text, is given.
        """
        scenes, todo = self.scenes, self._todo
        probed = 0 if elsewhere else len(self.preset.probes)
        self._progress = progress
        self._task = progress.add_task("", total=sum(map(len, todo)) + probed)
        if elsewhere:
            self._remote(*elsewhere, scenes, todo)
            return
        self._probes()
        for cells, missing in zip(scenes, todo, strict=True):
            bench = Bench(cells, self.output)
            while missing := missing or self._more(cells):
                for cell in missing:
                    self._cell(bench, cell)
                missing = []

    def _probes(self):
        file = self.output / "probes.json"
        kept = json.loads(file.read_text()) if file.exists() else {}
        for name, rounds in self.preset.probes.items():
            self._progress.update(self._task, description=name)
            key = {"rounds": rounds, "versions": software() | {"machine": machine()}}
            try:
                if {k: kept.get(name, {}).get(k) for k in key} != key:
                    kept[name] = key | {"values": probes.PROBES[name](self.project, rounds)}
                    write_json(file, kept)
            except Exception as error:  # a probe must not cost the cells
                self.failed.append(f"{name}: {error}")
            self._progress.advance(self._task)

    def _cell(self, bench: Bench, cell: Cell):
        """Render a cell here."""
        self._progress.update(self._task, description=_description(cell))
        try:
            self._store(bench.cells, cell, measure(bench, cell))
        except Exception as error:  # one cell must not cost the others
            raise_interrupt(error)
            self.failed.append(f"{_description(cell)}: {message(error)}")
        self._progress.advance(self._task)

    def _store(self, cells: Cells, cell: Cell, result):
        if cells.where() not in self._judges:
            self._judges[cells.where()] = judge_of(*cells.where())
        store(self.output, cell, *result, self._judges[cells.where()])

    def _remote(self, client, preset: str, scenes: list[Cells], todo: list[list[Cell]]):
        """Render the cells of ``todo``, and those that follow from them, on a cluster."""
        root = str(self.project.root.resolve())
        while any(
            todo := [missing or self._more(cells) for cells, missing in zip(scenes, todo, strict=True)]
        ):
            groups = [
                (cells, list(group))
                for cells, missing in zip(scenes, todo, strict=True)
                for _, group in groupby(missing, key=lambda cell: (cell.budget, cell.seed))
            ]
            calls = [
                (root, preset, cells.subject.name, [asdict(cell) for cell in group])
                for cells, group in groups
            ]
            for index, results in workers.results(client, measured, calls):
                cells, group = groups[index]
                for cell, result in zip(group, results, strict=True):
                    if isinstance(result, str):
                        self.failed.append(f"{_description(cell)}: {result}")
                    else:
                        self._store(cells, cell, result)
                    self._progress.update(self._task, description=_description(cell), advance=1)
            todo = [[] for _ in scenes]

    def _more(self, cells: Cells) -> list[Cell]:
        """The cells of a further seed, none if the interval is narrow enough, or there are enough of them."""
        more, seeds = cells.more, cells.fewest()
        if more is None:
            return []
        while seeds < more.at_most and self._are_there(cells.further(seeds)):
            seeds += 1
        found = [c for seed in range(seeds) for c in cells.further(seed)]
        if not self._are_there(found):
            return []  # one of them failed
        try:
            widths = analysis.widths(read_rows(self.output, cells, found), more.methods)
        except ValueError as error:
            self.failed.append(f"further seeds in {cells.subject.name}: {error}")
            return []
        if max(widths.values()) < more.width or seeds == more.at_most:
            return []
        missing = [c for c in cells.further(seeds) if not self._is_there(c)]
        if not self._tried.isdisjoint(keys := {c.key for c in missing}):
            return []  # one of them failed
        self._tried |= keys
        total = self._progress.tasks[self._task].total or 0
        self._progress.update(self._task, total=total + len(missing))
        return missing

    def _is_there(self, cell: Cell) -> bool:
        return cell_file(self.output, cell).exists()

    def _are_there(self, cells: list[Cell]) -> bool:
        return all(map(self._is_there, cells))


def _description(cell: Cell) -> str:
    return f"{cell.scene}, {cell.budget} spp, seed {cell.seed}, {cell.method}"


def chosen(preset: Preset, names) -> Preset:
    """The part of a preset about the scenes ``names``, without probes; raises ``CommandError`` for others."""
    known = [subject.name for subject in preset.subjects]
    for name in names:
        if name not in known:
            raise CommandError(f"--scenes {name}: not in the preset, which has {', '.join(known)}")
    subjects = tuple(subject for subject in preset.subjects if subject.name in names)
    return replace(preset, subjects=subjects, probes={})


def run(options: Namespace) -> int:
    """Sweep as the command line ``options`` say; the exit status is 1 if a cell failed."""
    mi.set_variant("llvm_ad_rgb")
    project = Project(options.project)
    file = project.preset(options.preset)
    output = options.output or project.root / "results" / file.stem
    whole = read_preset(file, project)
    preset = chosen(whole, options.scenes) if options.scenes else whole
    check_output(output / "rows.csv", ".csv")  # complain before hours of rendering, not after
    sweep = Sweep(project, preset, output)
    sweep.prepare(options.reference_seconds)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress:
        if options.scheduler:
            with workers.connected(options.scheduler) as client:
                sweep.run(progress, (client, file.read_text()))
        else:
            sweep.run(progress)
    table = rows(preset, sweep.scenes, output)
    if options.scenes:
        table = beside(table, whole, output)
    if table:
        write_tables(table, output)
    print(f"{output}: {len(table)} rows" + "".join(f"\nfailed: {text}" for text in sweep.failed))
    return 1 if sweep.failed else 0
