"""Sweeps of run time against error: scenes x integrators x samples x seeds.

For each scene, budget and seed the integrators of a preset run consecutively, so that noise of the machine
affects all. Each render is a file in OUTPUT/cells, named by a hash of all that determines it (parameters,
scene, versions, the plugin's source), and is not repeated; its image is in OUTPUT/images. Failed cells, and
scenes without reference, are reported and tried again by the next run. Errors are against the references of
`making`, made first if missing, and computed again when a reference changes. On a cluster, consecutive
renders go to one worker; workers need the project under the same path and the same software. `results`
describes the files.
"""

from __future__ import annotations

import datetime
import json
import math
import tempfile
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache, lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pandas as pd

from .. import workers
from ..errors import CommandError, message
from ..files.images import check_output
from ..files.texts import read_json, write_json
from ..run.rendering import raise_interrupt
from . import analysis, probes
from .estimates import FEWEST_WITH_INTERVAL, seed_errors
from .limited import Pending
from .making import Job, check, obtained
from .options import REFERENCE_SECONDS, VARIANT
from .options import Sweep as SweepOptions
from .preset import FIRST_SEED, Cell, Cells, Preset, machine, preset_of, read_preset, software
from .project import Project
from .reference import make_command
from .results import (
    beside,
    cell_file,
    decided,
    decisive,
    first_image_file,
    judge_of,
    keep_missing,
    lost,
    read_rows,
    rows,
    store,
    write_tables,
)
from .scenes import check_plugins, integrator_of, samples_taken
from .showing import Renders
from .timing import Timed, alternating, timed

CALIBRATIONS = 3  # alternating renders that calibrate the samples for equal time
CALIBRATED = 0.25  # share of a limit of time for these renders, and for those that find how many samples fit
ROOM = 1.25  # times the predicted seconds of what was cut, in the advice of how many to allow


class Bench:
    """Loaded scenes and integrators of one scene's cells, with compiled kernels.

    ``seconds``: limit of the time for all its renders.
    """

    def __init__(self, cells: Cells, output: Path, seconds: float | None = None):
        self.cells, self.output, self.seconds = cells, output, seconds
        _, file, resolution, depth = cells.where()
        self.scene = cache(lambda sampler: file.load(resolution, sampler))
        self._loaded = cache(lambda parameters: integrator_of(dict(parameters), depth))
        self._first: dict[tuple[str, int], tuple[float, float]] = {}
        self._spp: dict[str, dict[str, float]] = {}

    def integrator(self, cell: Cell) -> mi.Integrator:
        return self._loaded(cell.parameters)

    def timed(self, cell: Cell, spp: int, seed: int) -> Timed:
        return timed(self.scene(cell.sampler), self.integrator(cell), spp, seed)

    def first_seconds(self, cell: Cell, spp: int) -> tuple[float, float]:
        """Return the seconds of an integrator's first render for compiling and for pilots.

        Less with a cache on disk. Mitsuba's integrators compile for each number of samples; later renders use
        the pilots' cached results.
        """
        key = cell.method, spp
        if key not in self._first:
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
                dr.kernel_history_clear()
                self.timed(cell, spp, 0)
                kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
            compiled = sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1000
            statistics = getattr(self.integrator(cell), "statistics", None)
            own = statistics["seconds"] if statistics else {"compile": compiled, "pilot": 0.0}
            self._first[key] = own["compile"], own["pilot"]
        return self._first[key]

    def spp_of(self, cell: Cell) -> int:
        """Return the samples of a cell: its budget, or those for equal time."""
        if cell.match == "spp":
            return self._taken(cell, cell.budget)
        wanted = cell.budget * self._equal(cell)["samples"]
        if cell.sampler == "independent":
            return max(round(wanted), 1)
        # Mitsuba's stratified samplers are a tenth slower per sample far from a power of two.
        return self._taken(cell, 2 ** max(round(math.log2(wanted)), 0))

    def equal_time_spp(self, cell: Cell) -> int | None:
        """Return the budget at which the seconds of a cell's integrator equal the first one's, if they do."""
        return None if cell.match == "spp" else int(self._equal(cell)["spp"])

    def _equal(self, cell: Cell) -> dict[str, float]:
        """Return the ``samples`` of an integrator in the time of one of the first, and at which ``spp``.

        Measured once, and kept in a file.
        """
        if cell.method not in self._spp:
            one = next(c for c in self.cells.of(max(self.cells.subject.spp), 0) if c.method == cell.method)
            kept = self.output / "ratios" / f"{one.key}.json"
            if not kept.exists():
                first = self.cells.of(cell.budget, cell.seed)[0]
                budget = self._calibration_budget(first, cell)
                write_json(kept, {"samples": self._time_ratio(first, cell, budget), "spp": budget})
            self._spp[cell.method] = read_json(kept, "delete it, to measure it anew")
        return self._spp[cell.method]

    def _time_ratio(self, first: Cell, cell: Cell, budget: int) -> float:
        """Return the seconds of a sample by the ``first`` integrator over those by a cell's."""
        sides = [(one, self._taken(one, budget)) for one in (first, cell)]
        for one, spp in sides:
            self.first_seconds(one, spp)
        turns = alternating([partial(self.timed, *side) for side in sides], CALIBRATIONS, is_warm=True)
        seconds = [[decided(one._asdict() | {"clock": cell.clock}) for one in both] for both in turns]
        (_, ours), (_, theirs) = sides
        return float(np.median([a / ours / (b / theirs) for a, b in seconds]))

    def _calibration_budget(self, first: Cell, cell: Cell) -> int:
        budgets = sorted(self.cells.subject.spp)
        if self.seconds is None:
            return budgets[-1]
        rivals = sum(m.match == "seconds" for m in self.cells.methods[1:])
        patience, at, best = CALIBRATED * self.seconds / rivals, 0, budgets[0]
        # Small renders take longer per sample than large ones, so that more may fit than the first suggest.
        while best > at:
            at = best
            sides = [(one, self._taken(one, at)) for one in (first, cell)]
            for side in sides:
                self.first_seconds(*side)
            of_a_sample = sum(self.timed(one, spp, 0).seconds / spp for one, spp in sides)
            best = max((b for b in budgets if (1 + CALIBRATIONS) * b * of_a_sample <= patience), default=at)
        return at

    def _taken(self, cell: Cell, spp: int) -> int:
        return samples_taken(self.scene(cell.sampler), self.integrator(cell), spp)


def measure(bench: Bench, cell: Cell) -> tuple[dict, np.ndarray]:
    """Render a cell; returns its row, without errors, and its image."""
    spp = bench.spp_of(cell)
    compile_seconds, pilot_seconds = bench.first_seconds(cell, spp)
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
        "equal_time_spp": bench.equal_time_spp(cell),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "seconds_compile": compile_seconds,
        "seconds_pilot": pilot_seconds,
        "statistics": json.dumps(statistics),
        "decisions": json.dumps(statistics.get("decisions")),
    }
    return row | {f"rays_{kind}": n for kind, n in statistics.get("rays", {}).items()}, image


def measured(cells: Cells, group: Sequence[Cell]) -> list:
    """On a worker: return row and image of each cell of a ``group``, or the text of its error."""
    with workers.one_at_a_time:
        mi.set_variant(VARIANT)
        if group[0].versions != _loaded_software():
            raise CommandError(f"a worker has other software than the client: {dict(_loaded_software())}")
        scene = cells.subject.scene
        if scene.sha256 != cells.common["scene_sha256"]:
            raise CommandError(f"a worker has another {scene.name}.xml, mesh or texture than the client")
        bench, found = _bench(cells), []
        for cell in group:
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
def _bench(cells: Cells) -> Bench:
    return Bench(cells, Path(tempfile.mkdtemp(prefix="bdpt_sweep_")))


class Sweep:
    """A preset being rendered into a folder.

    ``failed``: messages of failures; ``cut``: what was left out for lack of time, by scene; ``wanted``: the
    seconds that it needs.
    """

    def __init__(self, project: Project, preset: Preset, output: Path):
        self.project, self.preset, self.output = project, preset, output
        self.cut, self.wanted = dict[str, str](), 0
        self.failed = list(preset.left_out)
        scenes = [Cells(project, preset, subject) for subject in preset.subjects]
        self._todo = {cells: [c for c in cells.planned() if not self._is_there(c)] for cells in scenes}
        self._judges, self._tried = {}, set()
        self._progress = Renders()  # placeholder until `run`

    @property
    def scenes(self) -> list[Cells]:
        """The scenes that have references."""
        return list(self._todo)

    def check(self):
        """Raise ``CommandError`` for plugins and references that cannot be made."""
        for cells, job in self._jobs():
            found = {cell.method: cell for cell in cells.planned()}
            for name, cell in found.items():
                check_plugins(name, dict(cell.parameters), cell.sampler, cells.subject.max_depth)
            check(job)

    def _jobs(self) -> list[tuple[Cells, Job]]:
        """Return the scenes that lack renders or their reference, with these."""
        jobs = {cells: Job(*cells.where(), spp=max(cells.subject.spp)) for cells in self.scenes}
        return [(cells, job) for cells, job in jobs.items() if self._todo[cells] or job.is_missing]

    def prepare(self, seconds: float | None = None, limit: float | None = None):
        """Make the references that are missing, or of another version of their scene, before rendering.

        Each reference takes at most about ``seconds``, by default `REFERENCE_SECONDS`, or equal shares of
        half the ``limit``. A scene without one is skipped, and recorded in ``failed``.
        """
        wanted = self._jobs()
        if seconds is None:
            lacking = sum(job.is_missing for _, job in wanted)
            seconds = REFERENCE_SECONDS if limit is None else limit / 2 / max(lacking, 1)
        for cells, job in wanted:
            try:
                obtained(replace(job, seconds=seconds))
            except Exception as error:
                self._note(f"{job.scene.name}: left out", error)
                del self._todo[cells]

    def _note(self, what: str, error: Exception):
        """Record a failure; re-raises ``KeyboardInterrupt``."""
        raise_interrupt(error)
        self.failed.append(f"{what}: {' '.join(message(error).split())}")

    def rows(self) -> pd.DataFrame:
        """Return the rows of finished cells; unreadable scenes are recorded in ``failed``."""
        found = [pd.DataFrame()]
        for cells in self.scenes:
            try:
                found.append(rows(self.preset, cells, self.output))
            except Exception as error:
                self._note(f"{cells.subject.name}: no rows", error)
        return pd.concat(found, ignore_index=True)

    def run(self, progress: Renders, client=None, seconds: float | None = None):
        """Render the missing cells, showing ``progress``.

        ``client``: of a cluster, to render there. ``seconds``: limit, shared equally by the scenes; what does
        not fit is recorded in ``cut``.
        """
        self._progress = progress
        progress.plan(_work(cell) for missing in self._todo.values() for cell in missing)
        if client is not None:
            self._remote(client)
            return
        if seconds is not None:
            self._limited(seconds)
            return
        for cells, missing in self._todo.items():
            bench = Bench(cells, self.output)
            self._first_images(cells)
            while missing := missing or self._more(cells):
                for cell in missing:
                    self._cell(bench, cell)
                missing = []

    def _limited(self, seconds: float):
        """Render what fits into the ``seconds``, see `Pending`, of which the scenes have equal shares."""
        end = time.monotonic() + seconds
        todo = self._todo.items()
        pending = [Pending(cells, missing, self._known_seconds(cells)) for cells, missing in todo if missing]
        benches: dict[int, Bench] = {}
        for cells in self.scenes:
            self._first_images(cells)

        def rendered(i: int) -> int:
            """Render what fits of a scene into its share of the time left."""
            if i not in benches:
                benches[i] = Bench(pending[i].cells, self.output, seconds / len(pending))
            sharing = sum(bool(other.late) for other in pending[i:])
            share = (end - time.monotonic()) / max(sharing, 1)
            done = pending[i].render(partial(self._cell, benches[i]), max(share, 0.0))
            if not pending[i].late:
                del benches[i]
            return done

        # What a scene leaves goes to the others, until nothing more fits.
        while sum([rendered(i) for i, one in enumerate(pending) if one.late]):
            pass
        late = [one for one in pending if one.late]
        self.cut = {one.cells.subject.name: one.text for one in late}
        self.wanted = math.ceil(ROOM * sum(one.needed for one in late))

    def _known_seconds(self, cells: Cells) -> dict[str, dict[int, float]]:
        """Return the seconds of finished renders of a scene, by integrator and budget."""
        found: dict[str, dict[int, float]] = {}
        for cell in cells.planned():
            file = cell_file(self.output, cell)
            if file.exists():
                row = read_json(file, "delete it, to render it anew")
                found.setdefault(cell.method, {})[cell.budget] = row["seconds"]
        return found

    def _first_images(self, cells: Cells):
        """Render the missing first images of a scene, at its smallest budget."""
        for cell in cells.of(min(cells.subject.spp), FIRST_SEED):
            file = first_image_file(self.output, cell)
            if not self.preset.file.first_image or file.exists():
                continue
            self._progress.begin(f"{cell.scene}, first image, {cell.method}")
            wanted = {
                "file": str(cells.subject.scene.file.resolve()),
                "parameters": dict(cell.parameters),
                "spp": cell.budget,
                **{key: getattr(cell, key) for key in ("resolution", "sampler", "max_depth")},
            }
            try:
                taken = [probes.first_image(wanted) for _ in range(self.preset.file.first_image)]
                write_json(file, [decided(one | {"clock": cell.clock}) for one in taken])
            except Exception as error:  # one render must not end the others
                self._note(f"{cell.scene}, first image, {cell.method}", error)

    def _cell(self, bench: Bench, cell: Cell) -> float | None:
        """Render a cell in this process; returns its wall seconds, None if it failed."""
        self._progress.begin(_description(cell))
        seconds = None
        try:
            row, image = measure(bench, cell)
            self._store(bench.cells, cell, (row, image))
            seconds = row["seconds"]
        except Exception as error:  # one cell must not end the others
            self._note(_description(cell), error)
        self._progress.end(_description(cell), _work(cell))
        return seconds

    def _store(self, cells: Cells, cell: Cell, result):
        if cells.where() not in self._judges:
            self._judges[cells.where()] = judge_of(*cells.where())
        store(self.output, cell, *result, self._judges[cells.where()])

    def _remote(self, client):
        todo = self._todo
        while any((todo := {cells: todo[cells] or self._more(cells) for cells in todo}).values()):
            groups = [
                (cells, list(group))
                for cells, missing in todo.items()
                for _, group in groupby(missing, key=lambda cell: (cell.budget, cell.seed))
            ]
            for index, results in workers.results(client, measured, groups):
                cells, group = groups[index]
                for cell, result in zip(group, results, strict=True):
                    if isinstance(result, str):
                        self.failed.append(f"{_description(cell)}: {result}")
                    else:
                        self._store(cells, cell, result)
                    self._progress.end(_description(cell), _work(cell))
            todo = {cells: [] for cells in todo}

    def _more(self, cells: Cells) -> list[Cell]:
        """Return the cells of a further seed; none if narrow enough or at the limit."""
        more, seeds = cells.more, cells.fewest()
        if more is None:
            return []
        while seeds < more.seeds[1] and self._are_there(cells.further(seeds)):
            seeds += 1
        found = [c for seed in range(seeds) for c in cells.further(seed)]
        if not self._are_there(found):
            return []  # a failed cell
        try:
            ours, *others = (cell.method for cell in cells.of(more.spp, FIRST_SEED, more.integrators))
            rows = decisive(read_rows(self.output, cells, found)).assign(first=ours)
            results = analysis.Results(rows, {})
            ratios = [results.efficiency(cells.subject.name, name) for name in others]
        except ValueError as error:
            self.failed.append(f"further seeds in {cells.subject.name}: {error}")
            return []
        is_narrow = seeds >= FEWEST_WITH_INTERVAL and max(one.high - one.low for one in ratios) < more.width
        if is_narrow or seeds == more.seeds[1]:
            return []
        missing = [c for c in cells.further(seeds) if not self._is_there(c)]
        if not self._tried.isdisjoint(keys := {c.key for c in missing}):
            return []  # a failed cell
        self._tried |= keys
        self._progress.plan(map(_work, missing))
        return missing

    def _is_there(self, cell: Cell) -> bool:
        return cell_file(self.output, cell).exists()

    def _are_there(self, cells: list[Cell]) -> bool:
        return all(map(self._is_there, cells))


def _description(cell: Cell) -> str:
    return f"{cell.scene}, {cell.budget} spp, seed {cell.seed}, {cell.method}"


def _work(cell: Cell) -> float:
    """Return what a render takes, in proportion: equal for all integrators at equal time."""
    return float(cell.budget) * cell.resolution**2


def poor_reference(cells: Cells, table: pd.DataFrame) -> list[str]:
    """Return messages about rows that the reference is too noisy for.

    Each with the command that refines the reference.
    """
    rows = table[table["scene"] == cells.subject.name] if len(table) else table
    if rows.empty:
        return []
    project, scene, resolution, depth = cells.where()
    words = "--spp", str(max(cells.subject.spp))
    make = make_command(project, project.called(scene), resolution, depth, *words)
    groups = rows.groupby(["method", "budget"], sort=False)
    poor = [key for key, at in groups if seed_errors(at, "rel_mse_trimmed", False)[1]]
    if not poor:
        return []
    others = f" and {len(poor) - 1} more" if len(poor) > 1 else ""
    method, budget = poor[-1]
    text = f"{scene.name}: the reference is noisier than the renders of {method} at {budget} spp{others}, "
    return [f"{text}whose trimmed errors are upper bounds. To go on: {make}"]


def short_of_target(table: pd.DataFrame) -> list[str]:
    """Return messages about integrators that ended before the preset's target error."""
    renders = {}
    for row in table.itertuples():
        target = json.loads(row.parameters).get("target_error", 0)
        if target > 0:
            key = row.scene, row.budget, row.method, target
            error = json.loads(row.statistics)["error"]
            renders.setdefault(key, []).append(error is None or not error <= target)
    return [
        f"{scene}, {budget} spp, {method}: {sum(short)} of {len(short)} renders did not reach "
        f"target_error={target:g}"
        for (scene, budget, method, target), short in renders.items()
        if any(short)
    ]


def swept(
    project: Project, preset: str | Mapping[str, Any], options: SweepOptions | Namespace
) -> tuple[pd.DataFrame, list[str]]:
    """Render the missing cells of a ``preset``; returns all rows, and failures.

    ``preset``: a TOML file, its name, or its content as a dictionary. With ``seconds``, missing references
    take half of these at most, unless ``reference_seconds`` says so, and the renders what is left.
    """
    began = time.monotonic()
    if isinstance(preset, Mapping):
        whole, name = preset_of(Path("preset"), preset, project, options.scenes), "sweep"
    else:
        file = project.preset(preset)
        whole, name = read_preset(file, project, options.scenes), file.stem
    output = options.output or project.root / "results" / name
    if options.scheduler and project.given:
        raise CommandError(
            f"scheduler={options.scheduler} with scene={next(iter(project.given))!r}, a dictionary, is not "
            "possible: workers load files; write it into one"
        )
    if options.scheduler and options.seconds is not None:
        raise CommandError(f"seconds={options.seconds:g} with scheduler={options.scheduler} is not possible")
    for told in whole.left_out:
        print(told, flush=True)
    sweep = Sweep(project, whole, output)
    sweep.check()
    check_output(output / "rows.csv", ".csv")  # fail before rendering
    if options.output is None:
        print(f"rows and images go to {output}", flush=True)
    sweep.prepare(options.reference_seconds, options.seconds)
    left = None
    if options.seconds is not None:
        left = max(options.seconds - (time.monotonic() - began), 0.0)
    with Renders(left) as progress:
        if options.scheduler:
            with workers.connected(options.scheduler) as client:
                sweep.run(progress, client)
        else:
            sweep.run(progress, seconds=left)
    table = sweep.rows()
    if options.scenes or whole.scenes is None:
        table = beside(table, whole.scenes, output)
    for told in lost(table, output):
        print(f"warning: {told}")
    if len(table):
        write_tables(table, output)
    command = "" if isinstance(preset, Mapping) else project.command("sweep", preset, "-o", output)
    scenes = [subject.name for subject in whole.subjects]
    keep_missing(output, scenes, sweep.cut, f"{command} --seconds {sweep.wanted}" if command else "")
    with suppress(OSError):  # not empty
        output.rmdir()
    _tell(sweep, table)
    late = time.monotonic() - began - (options.seconds or math.inf)
    if late > 1:
        print(
            f"took {late:.0f} s more than --seconds {options.seconds:g}: kernels are compiled, equal time is "
            "measured and two seeds of the smallest budget are rendered in any case"
        )
    return table, sweep.failed


def _tell(sweep: Sweep, table: pd.DataFrame) -> None:
    """Print what time did not allow, warnings, and the number of rows."""
    # What was cut comes first: the figures depend on it.
    if sweep.cut:
        cut = "; ".join(f"{scene}, {text}" for scene, text in sweep.cut.items())
        print(f"cut for lack of time: {cut}; run it again with --seconds {sweep.wanted}, about")
    if len(methods := set(table.get("method", ()))) == 1:
        print(
            f"{methods.pop()} is the only integrator, and compared with none; tables [[integrator]] of "
            "the preset replace the default ones: list these too"
        )
    poor = [text for cells in sweep.scenes for text in poor_reference(cells, table)]
    for text in [*short_of_target(table), *poor]:
        print(f"warning: {text}")
    print(f"{sweep.output}: {len(table)} rows" + "".join(f"\nfailed: {text}" for text in sweep.failed))


def run(options: Namespace) -> int:
    mi.set_variant(VARIANT)
    _, failed = swept(Project(options.project), options.preset, options)
    return 1 if failed else 0
