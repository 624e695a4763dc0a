"""Sweeps of run time against error: scenes x integrators x samples x seeds.

For each scene, budget and seed the integrators of a preset run consecutively, so that noise of the machine
affects all. Each render is a file in OUTPUT/cells, named by a hash of all that determines it (parameters,
scene, versions, the plugin's source), and is not repeated; its image is in OUTPUT/images. Failed cells, and
scenes without reference, are reported and tried again by the next run. Errors are against the references of
`making`, made first if missing, and computed again when a reference changes. `results` describes the files.
"""

from __future__ import annotations

import datetime
import json
import math
import time
from argparse import Namespace
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pandas as pd

from ..errors import message
from ..files.images import check_output
from ..files.texts import read_json, write_json
from ..run.rendering import raise_interrupt
from .estimates import seed_errors
from .making import check, obtained
from .options import REFERENCE_SECONDS, VARIANT
from .options import Sweep as SweepOptions
from .preset import FIRST_SEED, Cell, Cells, Preset, machine, read_preset
from .project import Project
from .reference import make_command
from .results import beside, cell_file, decided, keep_missing, read_cell, rows, store, write_tables
from .scenes import check_plugins, integrator_of, samples_taken
from .showing import Renders
from .timing import Timed, alternating, timed

CALIBRATIONS = 3  # alternating renders that calibrate the samples for equal time
CALIBRATED = 0.25  # share of a limit of time for these renders, and for those that find how many samples fit
LEAST_SLOPE = 0.5  # of a larger budget's seconds over samples, in those of the budgets before
ROOM = 1.25  # times the predicted seconds of what was cut, in the advice of how many to allow


class Bench:
    """Loaded scenes and integrators of one scene's cells, with compiled kernels.

    ``seconds``: limit of the time for all its renders.
    """

    def __init__(self, cells: Cells, output: Path, seconds: float = math.inf):
        self.cells, self.output, self.seconds = cells, output, seconds
        self.scene = cache(lambda sampler: cells.scene.load(cells.resolution, sampler))
        self._loaded = cache(lambda parameters: integrator_of(dict(parameters), cells.max_depth))
        self._pilots: dict[tuple[str, int], float] = {}
        self._spp: dict[str, dict[str, float]] = {}

    def integrator(self, cell: Cell) -> mi.Integrator:
        return self._loaded(cell.parameters)

    def timed(self, cell: Cell, spp: int, seed: int) -> Timed:
        return timed(self.scene(cell.sampler), self.integrator(cell), spp, seed)

    def warm(self, cell: Cell, spp: int) -> float:
        """Render once, which compiles for ``spp``; returns the seconds of pilots."""
        key = cell.method, spp
        if key not in self._pilots:
            self.timed(cell, spp, 0)
            statistics = getattr(self.integrator(cell), "statistics", None)
            self._pilots[key] = statistics["seconds"]["pilot"] if statistics else 0.0
        return self._pilots[key]

    def spp_of(self, cell: Cell) -> int:
        """Return the samples of a cell: its budget, or those for equal time."""
        if cell.match == "spp":
            return self._taken(cell, cell.budget)
        wanted = cell.budget * self.equal(cell)["samples"]
        if cell.sampler == "independent":
            return max(round(wanted), 1)
        # Mitsuba's stratified samplers are a tenth slower per sample far from a power of two.
        return self._taken(cell, 2 ** max(round(math.log2(wanted)), 0))

    def equal(self, cell: Cell) -> dict[str, float]:
        """Return the ``samples`` of an integrator in the time of one of the first.

        Measured once, at ``spp``, and kept in a file.
        """
        if cell.method not in self._spp:
            one = next(c for c in self.cells.of(max(self.cells.spp), 0) if c.method == cell.method)
            kept = self.output / "ratios" / f"{one.key}.json"
            if not kept.exists():
                own = self.cells.methods[0].name
                first = next(c for c in self.cells.of(cell.budget, cell.seed) if c.method == own)
                budget = self._calibration_budget(first, cell)
                write_json(kept, {"samples": self._time_ratio(first, cell, budget), "spp": budget})
            self._spp[cell.method] = read_json(kept, "delete it, to measure it anew")
        return self._spp[cell.method]

    def _time_ratio(self, first: Cell, cell: Cell, budget: int) -> float:
        """Return the seconds of the ``first`` integrator's samples over those of a cell's."""
        sides = [(one, self._taken(one, budget)) for one in (first, cell)]
        for one, spp in sides:
            self.warm(one, spp)
        turns = alternating([partial(self.timed, *side) for side in sides], CALIBRATIONS, is_warm=True)
        seconds = [[decided(one._asdict() | {"clock": cell.clock}) for one in both] for both in turns]
        (_, ours), (_, theirs) = sides
        return float(np.median([a / ours / (b / theirs) for a, b in seconds]))

    def _calibration_budget(self, first: Cell, cell: Cell) -> int:
        if self.seconds == math.inf:
            return max(self.cells.spp)
        rivals = sum(m.match == "seconds" for m in self.cells.methods[1:])
        patience = CALIBRATED * self.seconds / rivals
        budget, *larger = sorted(self.cells.spp)
        while True:
            sides = [(one, self._taken(one, budget)) for one in (first, cell)]
            for side in sides:
                self.warm(*side)
            of_a_sample = sum(self.timed(one, spp, 0).seconds / spp for one, spp in sides)
            if not larger or (1 + CALIBRATIONS) * larger[0] * of_a_sample > patience:
                return budget
            budget = larger.pop(0)

    def _taken(self, cell: Cell, spp: int) -> int:
        return samples_taken(self.scene(cell.sampler), self.integrator(cell), spp)


def measure(bench: Bench, cell: Cell) -> tuple[dict, np.ndarray]:
    """Render a cell; returns its row, without errors, and its image."""
    spp = bench.spp_of(cell)
    pilot_seconds = bench.warm(cell, spp)
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    image, seconds, cpu_seconds = bench.timed(cell, spp, cell.seed)
    statistics = getattr(bench.integrator(cell), "statistics", {})
    parameters = dict(cell.parameters)
    is_bdpt = parameters["type"] == "bdpt"  # which does not use the sensor's sampler
    row = {
        "key": cell.key,
        **{k: v for k, v in asdict(cell).items() if k not in ("parameters", "versions", "against")},
        "sampler": parameters.get("points", "sobol") if is_bdpt else cell.sampler,
        "machine": machine(),
        "parameters": json.dumps(parameters),
        "versions": json.dumps(dict(cell.versions)),
        "started": started,
        # A target error or timeout may end a render early.
        "spp": sum(statistics.get("passes", ())) or spp,
        # Budget at which the seconds equal the first integrator's, if they do.
        "equal_time_spp": None if cell.match == "spp" else int(bench.equal(cell)["spp"]),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "seconds_pilot": pilot_seconds,
        "statistics": json.dumps(statistics),
        "decisions": json.dumps(statistics.get("decisions")),
    }
    return row | {f"rays_{kind}": n for kind, n in statistics.get("rays", {}).items()}, image


class Pending:
    """The renders of a scene that are not in ``output``, by seeds, then budgets.

    Integrators of one budget and seed are rendered together or not at all.
    """

    def __init__(self, cells: Cells, output: Path):
        self.cells, self._output = cells, output
        missing = [[c for c in group if not cell_file(output, c).exists()] for group in cells.groups]
        self._groups = [group for group in missing if group]
        self._seconds: dict[str, dict[int, float]] = defaultdict(dict)
        self._compiled = set[tuple[str, int]]()

    @property
    def late(self) -> list[Cell]:
        return [cell for group in self._groups for cell in group]

    @property
    def needed(self) -> float:
        return sum(map(self._predicted, self._groups))

    @property
    def text(self) -> str:
        """How many renders are missing, and at which budgets."""
        counts = Counter(cell.budget for cell in self.late)
        at = ", ".join(f"{count} at {budget} spp" for budget, count in sorted(counts.items()))
        return f"{counts.total()} of {len(self.cells.planned)} renders: {at}"

    def render(self, rendered: Callable[[Cell], float | None], seconds: float) -> int:
        """Render what fits into the ``seconds``; returns the number of renders.

        ``rendered`` renders a cell and returns its seconds, None if it failed. Two seeds of the smallest
        budget are rendered in any case: with fewer there is no figure.
        """
        end = time.monotonic() + seconds
        if seconds < math.inf and not self._seconds:
            finished = {cell: cell_file(self._output, cell) for cell in self.cells.planned}
            for cell, file in finished.items():
                if file.exists():
                    self._seconds[cell.method][cell.budget] = read_cell(file)["seconds"]

        def fits(group: list[Cell]) -> bool:
            is_least = group[0].budget == min(self.cells.spp) and group[0].seed < FIRST_SEED + 2
            left = end - time.monotonic()
            return is_least or (left > 0 and self._predicted(group) <= left)

        done = 0
        while group := next(filter(fits, self._groups), None):
            for cell in [*group]:  # after an interruption the rest is still missing
                taken = rendered(cell)
                if taken is not None:
                    self._seconds[cell.method][cell.budget] = taken
                self._compiled.add((cell.method, cell.budget))
                group.remove(cell)
                done += 1
            self._groups.remove(group)
        return done

    def _predicted(self, group: list[Cell]) -> float:
        """Return the predicted seconds of the renders of a ``group``."""
        # The first render of a budget compiles, in a render that is not measured.
        renders = [(c.method, c.budget, 1 + ((c.method, c.budget) not in self._compiled)) for c in group]
        return sum(count * self._seconds_of(method, budget) for method, budget, count in renders)

    def _seconds_of(self, method: str, budget: int) -> float:
        """Return the seconds of a render: the last of its budget, else extrapolated."""
        known = self._seconds[method]
        if not known or budget in known:
            return known.get(budget, 0.0)
        *_, before, last = [0, *sorted(known)]
        proportional = known[last] / last
        if budget < last:
            return proportional * budget
        slope = (known[last] - known.get(before, 0.0)) / (last - before)
        return known[last] + max(slope, LEAST_SLOPE * proportional) * (budget - last)


class Sweep:
    """A preset being rendered into a folder.

    ``scenes``: those that have references; ``failed``: messages of failures; ``cut``: what was left out for
    lack of time, by scene; ``wanted``: the seconds that it needs.
    """

    def __init__(self, preset: Preset, output: Path):
        self.scenes, self.output = list(preset.cells), output
        self.failed, self.cut, self.wanted = list(preset.left_out), dict[str, str](), 0

    def check(self) -> None:
        """Raise ``CommandError`` for plugins and references that cannot be made."""
        for cells in self.scenes:
            for method in cells.methods:
                check_plugins(method.name, dict(method.parameters), method.sampler, cells.max_depth)
            check(cells.job)

    def prepare(self, seconds: float | None = None, limit: float = math.inf) -> None:
        """Make the references that are missing, or of another version of their scene.

        Each takes at most about ``seconds``, by default `REFERENCE_SECONDS`, or equal shares of half the
        ``limit``. A scene without one is skipped, and recorded in ``failed``.
        """
        if seconds is None:
            lacking = sum(bool(cells.job.lack) for cells in self.scenes)
            seconds = REFERENCE_SECONDS if limit == math.inf else limit / 2 / max(lacking, 1)
        for cells in [*self.scenes]:
            try:
                obtained(replace(cells.job, seconds=seconds))
            except Exception as error:
                self._note(f"{cells.scene.name}: left out", error)
                self.scenes.remove(cells)

    def _note(self, what: object, error: Exception) -> None:
        """Record a failure; re-raises ``KeyboardInterrupt``."""
        raise_interrupt(error)
        self.failed.append(f"{what}: {' '.join(message(error).split())}")

    def rows(self) -> pd.DataFrame:
        """Return the rows of finished cells; unreadable scenes are recorded in ``failed``."""
        found = [pd.DataFrame()]
        for cells in self.scenes:
            try:
                found.append(rows(cells, self.output))
            except Exception as error:
                self._note(f"{cells.scene.name}: no rows", error)
        return pd.concat(found, ignore_index=True)

    def run(self, seconds: float = math.inf) -> None:
        """Render the missing cells.

        ``seconds``: limit, shared equally by the scenes, see `Pending`; what does not fit is recorded in
        ``cut``.
        """
        end = time.monotonic() + seconds
        pending = [one for one in (Pending(cells, self.output) for cells in self.scenes) if one.late]
        works = [_work(cell) for one in pending for cell in one.late]
        benches: dict[int, Bench] = {}

        def rendered(progress: Renders, i: int) -> int:
            """Render what fits of a scene into its share of the time left."""
            if i not in benches:
                benches[i] = Bench(pending[i].cells, self.output, seconds / len(pending))
            sharing = sum(bool(other.late) for other in pending[i:])
            share = (end - time.monotonic()) / max(sharing, 1)
            done = pending[i].render(partial(self._cell, progress, benches[i]), max(share, 0.0))
            if not pending[i].late:
                del benches[i]
            return done

        # What a scene leaves goes to the others, until nothing more fits.
        try:
            with Renders(works, seconds) as progress:
                while sum([rendered(progress, i) for i, one in enumerate(pending) if one.late]):
                    pass
        finally:
            late = [one for one in pending if one.late]
            self.cut = {one.cells.scene.name: one.text for one in late}
            self.wanted = math.ceil(ROOM * sum(one.needed for one in late))

    def _cell(self, progress: Renders, bench: Bench, cell: Cell) -> float | None:
        """Render a cell; returns its wall seconds, None if it failed."""
        progress.begin(str(cell))
        seconds = None
        try:
            row, image = measure(bench, cell)
            store(self.output, bench.cells, cell, row, image)
            seconds = row["seconds"]
        except Exception as error:  # one cell must not end the others
            self._note(cell, error)
        progress.end(str(cell), _work(cell))
        return seconds


def _work(cell: Cell) -> float:
    """Return the relative duration of a render, equal for all integrators."""
    return float(cell.budget) * cell.resolution**2


def poor_reference(cells: Cells, table: pd.DataFrame) -> str:
    """Return a message with the command that refines a reference that is too noisy."""
    here = table[table["scene"] == cells.scene.name]
    groups = here.groupby(["method", "budget"], sort=False)
    poor = [key for key, at in groups if seed_errors(at, "rel_mse_trimmed", False)[1]]
    if not poor:
        return ""
    make = make_command(*cells.where, "--spp", str(max(cells.spp)))
    others = f" and {len(poor) - 1} more" if len(poor) > 1 else ""
    method, budget = poor[-1]
    return (
        f"{cells.scene.name}: the reference is too noisy for the renders of {method} at {budget} spp"
        f"{others}, whose trimmed errors are upper bounds. To go on: {make}"
    )


def swept(
    project: Project,
    preset: str | Mapping[str, Any],
    options: SweepOptions | Namespace,
    scenes: Sequence[str] = (),
) -> tuple[pd.DataFrame, list[str]]:
    """Render the missing cells of a ``preset``; returns all rows, and failures.

    ``preset``: a TOML file, its name, or its content as a dictionary; ``scenes``: those of a preset without.
    With ``seconds``, missing references take half of these at most, unless ``reference_seconds`` says so, and
    the renders what is left.
    """
    began = time.monotonic()
    given = preset if isinstance(preset, Mapping) else project.preset(preset)
    whole = read_preset(given, project, options.scenes, scenes)
    output = options.output or project.root / "results" / (given.stem if isinstance(given, Path) else "sweep")
    for told in whole.left_out:
        print(told, flush=True)
    sweep = Sweep(whole, output)
    sweep.check()
    check_output(output / "rows.csv", ".csv")  # fail before rendering
    limit = math.inf if options.seconds is None else options.seconds
    sweep.prepare(options.reference_seconds, limit)
    try:
        sweep.run(max(limit - (time.monotonic() - began), 0.0))
    finally:  # after an interruption there are tables too
        table = sweep.rows()
        if options.scenes or whole.scenes is None:
            table = beside(table, whole.scenes, output)
        if len(table):
            others = len([*(output / "cells").glob("*.json")]) - len(table)
            if others > 0:
                print(f"{others} stored renders of other presets, or before an edit, stay without rows")
            write_tables(table, output)
        again = "" if isinstance(preset, Mapping) else project.command("sweep", preset, "-o", output)
        if again and limit < math.inf:
            again += f" --seconds {sweep.wanted}"
        keep_missing(output, [cells.scene.name for cells in whole.cells], sweep.cut, again)
    _print_summary(sweep, table)
    return table, sweep.failed


def _print_summary(sweep: Sweep, table: pd.DataFrame) -> None:
    """Print what time did not allow, warnings, and the number of rows."""
    # What was cut comes first: the figures depend on it.
    if sweep.cut:
        cut = "; ".join(f"{scene}, {text}" for scene, text in sweep.cut.items())
        print(f"cut for lack of time: {cut}; run it again with --seconds {sweep.wanted}, about")
    for row in table.to_dict("records"):
        target = json.loads(row["parameters"]).get("target_error")
        error = json.loads(row["statistics"]).get("error")
        if target and (error is None or error > target):
            text = f"{row['scene']}, {row['budget']} spp, seed {row['seed']}, {row['method']}"
            print(f"warning: {text}: ended before target_error={target:g}; give it more spp")
    for cells in sweep.scenes if len(table) else ():
        if text := poor_reference(cells, table):
            print(f"warning: {text}")
    print(f"{sweep.output}: {len(table)} rows" + "".join(f"\nfailed: {text}" for text in sweep.failed))


def run(options: Namespace) -> int:
    mi.set_variant(VARIANT)
    _, failed = swept(Project(options.project), options.preset, options)
    return 1 if failed else 0
