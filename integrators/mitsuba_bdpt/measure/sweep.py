"""Sweeps of run time against error: scenes x integrators x samples x seeds, one row per render.

    python scripts/sweep.py presets/small.toml -o results/small
    python scripts/sweep.py presets/small.toml -o results/small     # again: goes on where it was stopped
    python scripts/sweep.py presets/benchmark.toml --scenes pool    # one scene anew, other rows as they are
    python scripts/sweep.py presets/small.toml --scheduler HOST:8786    # on a dask.distributed cluster

Presets (see scripts/preset.py) say what is rendered. For each scene, budget and seed all integrators follow
one another, so that a noisy machine is noisy for all. Every finished render is a file of its own in
OUTPUT/cells, named after a hash of all that determines it (parameters, scene, versions, the plugin's
source), and is not rendered again; its image lies in OUTPUT/images. A cell that fails is reported and tried
again the next time. Errors are taken against the references of scripts/reference.py, and anew when a
reference has become better; HDR-FLIP for the first seed alone, since it takes longer than most renders.
On a cluster, renders that follow one another go to one worker together, which renders them one after the
other; workers see this folder under the same path, and have the same software. Probes are left out there.
OUTPUT/rows.csv and OUTPUT/rows.parquet hold all rows of the preset, OUTPUT/probes.json what
scripts/probes.py measures.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import hashlib
import json
import math
import os
import platform
import tempfile
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from itertools import groupby
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from .. import workers
from ..cli.mistakes import check_output
from ..errors import message
from ..files.whole import replacing
from ..host.versions import versions
from ..run.rendering import raise_interrupt
from . import analysis, metrics, probes, reference
from .preset import Preset, Subject, read_preset
from .timing import timed

CALIBRATIONS = 3  # alternating renders from which the samples for equal time follow
FIRST_SEED = 1  # seed 0 warms up


@dataclass(frozen=True)
class Cell:
    """One render, and all that determines it; ``against``: for equal seconds, parameters and sampler of the
    first integrator and the samples at which the two were timed."""

    scene: str
    scene_sha256: str
    resolution: int
    max_depth: int
    method: str
    parameters: tuple
    sampler: str
    match: str
    against: tuple
    budget: int
    seed: int
    versions: tuple
    machine: str

    @property
    def key(self) -> str:
        """Name of the cell's files."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:24]


def software() -> dict:
    """Versions of what renders, the plugin's source among them."""
    return versions() | {"source": reference.source_digest()}


def machine() -> str:
    """Processor and number of cores."""
    names = [line.split(":", 1)[1].strip() for line in _cpuinfo() if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


def _cpuinfo() -> list[str]:
    file = Path("/proc/cpuinfo")
    return file.read_text().splitlines() if file.exists() else []


class Cells:
    """The cells of a scene of a preset, integrators innermost."""

    def __init__(self, preset: Preset, subject: Subject):
        self.subject, self.more = subject, preset.more
        self.methods = [m for m in preset.methods if m.scenes is None or subject.name in m.scenes]
        self.common = {
            "scene": subject.name,
            "scene_sha256": reference.scene_digest(subject.name),
            "resolution": preset.resolution,
            "max_depth": subject.max_depth,
            "versions": tuple(software().items()),
            "machine": machine(),
        }
        first = self.methods[0]
        self.against = first.parameters, first.sampler, max(subject.spp)

    def of(self, budget: int, seed: int, names=None) -> list[Cell]:
        """A cell per integrator, of those in ``names``."""
        return [
            Cell(
                **self.common,
                **{k: getattr(m, k) for k in ("parameters", "sampler", "match")},
                method=m.name,
                against=self.against if m.match == "seconds" else (),
                budget=budget,
                seed=seed,
            )
            for m in self.methods
            if (names is None or m.name in names) and seed < FIRST_SEED + (m.seeds or np.inf)
        ]

    def planned(self) -> list[Cell]:
        """Those that are rendered in any case."""
        found = [
            cell
            for spp, seeds in zip(self.subject.spp, self.subject.seeds, strict=True)
            for seed in range(FIRST_SEED, FIRST_SEED + seeds)
            for cell in self._turn(self.of(spp, seed))
        ]
        known = {cell.key for cell in found}
        first = [cell for seed in range(self.fewest()) for cell in self.further(seed)]
        return found + [cell for cell in first if cell.key not in known]

    def where(self) -> tuple:
        """What names the reference."""
        return self.subject.name, self.common["resolution"], self.subject.max_depth

    def fewest(self) -> int:
        """Seeds that [more] takes at least, 0 if the scene is not among its own."""
        return self.more.at_least if self.more and self.subject.name in self.more.scenes else 0

    def further(self, index: int) -> list[Cell]:
        """The cells of [more] with its ``index``-th seed."""
        return self._turn(self.of(self.more.spp, FIRST_SEED + index, self.more.methods))

    @staticmethod
    def _turn(found: list[Cell]) -> list[Cell]:
        """There for odd seeds and back for even ones: a drift of the machine's speed favours nobody."""
        return found[::-1] if found and found[0].seed % 2 == 0 else found


class Bench:
    """The loaded scenes and integrators of one scene's cells, warm."""

    def __init__(self, cells: Cells, output: Path):
        self.cells, self.output, self.name = cells, output, cells.subject.name
        self.resolution, self.depth = cells.where()[1:]
        self._scenes, self._integrators, self._compile, self._pilot, self._spp = {}, {}, {}, {}, {}

    def scene(self, sampler: str):
        """The scene with that sampler."""
        if sampler not in self._scenes:
            self._scenes[sampler] = reference.load_scene(
                self.name, resolution=self.resolution, sampler=sampler
            )
        return self._scenes[sampler]

    def integrator(self, cell: Cell):
        """The plugin of a cell."""
        if cell.parameters not in self._integrators:
            parameters = dict(cell.parameters) | {"max_depth": self.depth}
            self._integrators[cell.parameters] = mi.load_dict(parameters)
        return self._integrators[cell.parameters]

    def timed(self, cell: Cell, spp: int, seed: int):
        """Image and wall seconds of a render."""
        return timed(self.scene(cell.sampler), self.integrator(cell), spp, seed)

    def compile_seconds(self, cell: Cell, spp: int) -> float:
        """Seconds for the kernels of an integrator (less where they come from the cache on disk); afterwards
        it is warm. Mitsuba's integrators have kernels of their own for each number of samples."""
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
        """Seconds of the pilots of the first render of so many samples, which later ones remember."""
        self.compile_seconds(cell, spp)
        return self._pilot[cell.method, spp]

    def spp_of(self, cell: Cell) -> int:
        """Samples of a cell: its budget, or what fits into the first method's seconds for it.

        The ratio of seconds is measured once, at the largest budget, and kept.
        """
        first, largest = self.cells.of(cell.budget, cell.seed)[0], max(self.cells.subject.spp)
        if cell.match == "spp" or cell.method == first.method:
            return self._possible(cell.sampler, cell.budget)
        if cell.method not in self._spp:
            one = [c for c in self.cells.of(largest, 0) if c.method == cell.method][0]
            kept = self.output / "ratios" / f"{one.key}.json"
            if not kept.exists():
                for one_of_both in (first, cell):
                    self.compile_seconds(one_of_both, largest)
                pairs = [
                    [self.timed(c, largest, seed)[1] for c in (first, cell)] for seed in range(CALIBRATIONS)
                ]
                reference.write_json(kept, float(np.median([ours / theirs for ours, theirs in pairs])))
            self._spp[cell.method] = json.loads(kept.read_text())
        wanted = cell.budget * self._spp[cell.method]
        if cell.sampler == "independent":
            return max(round(wanted), 1)
        # Mitsuba's stratified samplers take a tenth longer per sample for numbers far from a power of two.
        return self._possible(cell.sampler, 2 ** max(round(math.log2(wanted)), 0))

    def _possible(self, sampler: str, spp: int) -> int:
        """The samples that a sampler makes of so many: stratified ones may round up."""
        fork = self.scene(sampler).sensors()[0].sampler().fork()
        fork.set_sample_count(spp)
        return int(fork.sample_count())


def judge_of(scene: str, resolution: int, depth: int):
    """A reference, and the SHA-256 of its file, taken before: should another one replace it meanwhile, the
    next run takes the errors anew."""
    path = reference.reference_path(scene, resolution, depth)
    sha256 = reference.digest(path) if path.exists() else ""
    return reference.load_reference(scene, resolution, depth), sha256


def measure(bench: Bench, cell: Cell) -> tuple[dict, np.ndarray]:
    """Render a cell; its row, but for the errors, and its image."""
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
        "spp": spp,
        "seconds": seconds,
        "seconds_compile": compile_seconds,
        "seconds_pilot": bench.pilot_seconds(cell, spp),
        "statistics": json.dumps(statistics),
        "decisions": json.dumps(statistics.get("decisions")),
    }
    return row | {f"rays_{kind}": n for kind, n in statistics.get("rays", {}).items()}, image


def store(output: Path, cell: Cell, row: dict, image: np.ndarray, judge) -> None:
    """Write the image and the row of a cell, the errors against ``judge`` (see `judge_of`) added."""
    reference.write_exr(image_file(output, cell), {"": image}, {"cell": json.dumps(asdict(cell))}, np.float32)
    found = row | errors(image, *judge, cell.seed == FIRST_SEED)
    reference.write_json(cell_file(output, cell), found)


# -- on a worker of a cluster ------------------------------------------------------------------


def measured(preset: str, scene: str, cells: list[dict]) -> list:
    """Row and image of each cell, or why it failed, as text; one after the other."""
    with workers.one_at_a_time:
        mi.set_variant("llvm_ad_rgb")
        bench, found = _bench(preset, scene, cells[0]["scene_sha256"]), []
        for entry in cells:
            cell = Cell(**entry)
            if cell.versions != _loaded_software():
                raise ValueError(f"a worker has other software than the client: {dict(_loaded_software())}")
            if cell.scene_sha256 != bench.cells.common["scene_sha256"]:
                raise ValueError(f"a worker has another {scene}.xml, mesh or texture than the client")
            try:
                found.append(measure(bench, cell))
            except Exception as error:  # one cell must not cost the others
                found.append(message(error))
        return found


@cache
def _loaded_software() -> tuple:
    """`software` when this process first asked: files may change under a worker, not what it imported."""
    return tuple(software().items())


@lru_cache(maxsize=2)
def _bench(preset: str, scene: str, scene_sha256: str) -> Bench:
    """The bench of a scene, of these contents, of the preset in a file of this text; kept, so that it stays
    warm."""
    folder = tempfile.TemporaryDirectory(prefix="bdpt_sweep_")
    file = Path(folder.name) / "preset.toml"
    file.write_text(preset)
    whole = read_preset(file)
    subject = next(subject for subject in whole.subjects if subject.name == scene)
    bench = Bench(Cells(whole, subject), file.parent)
    bench.folder = folder  # goes with the bench
    return bench


def errors(image, ref: reference.Reference, ref_sha256: str, flip: bool) -> dict:
    """All measures of an image; ``judged`` (raw) and ``judged_trimmed`` are false where the reference is not
    good enough for them. HDR-FLIP takes longer than most renders: only where ``flip``, else None."""
    raw, trimmed = (metrics.rel_mse(image, ref.image, trim) for trim in (0.0, metrics.TRIM))
    own = [ref.share_of(image, trim) for trim in (0.0, metrics.TRIM)]
    return {
        "reference_sha256": ref_sha256,
        "width": image.shape[1],
        "height": image.shape[0],
        "mean": float(image.mean()),
        "tile_means": [float(f"{x:.7g}") for x in metrics.tile_columns(image)],
        "mse": metrics.mse(image, ref.image),
        "rel_mse": raw,
        "rel_mse_trimmed": trimmed,
        "rel_mse_epsilon": metrics.rel_mse_epsilon(ref.image),
        "mape": metrics.mape(image, ref.image),
        "flip": metrics.hdr_flip(image, ref.image)[0] if flip else None,
        "delta_e_2000": metrics.delta_e_2000(image, ref.image),
        "delta_e_itp": metrics.delta_e_itp(image, ref.image),
        "energy_in_black": metrics.energy_in_black(image, ref.image),
        "reference_rel_mse": own[0],
        "reference_rel_mse_trimmed": own[1],
        "judged": analysis.judged(own[0], raw),
        "judged_trimmed": analysis.judged(own[1], trimmed),
    }


class Sweep:
    """A preset being rendered into a folder; ``failed``: what went wrong, a text each."""

    def __init__(self, preset: Preset, output: Path, progress: Progress):
        self.preset, self.output, self.progress, self.failed = preset, output, progress, []
        self._judges, self._task, self._tried = {}, None, set()

    def run(self, elsewhere=None):
        """Render all that is not there yet; on a cluster if ``elsewhere``, a client and the preset's text, is
        given."""
        scenes = [Cells(self.preset, subject) for subject in self.preset.subjects]
        todo = [[c for c in cells.planned() if not cell_file(self.output, c).exists()] for cells in scenes]
        probed = 0 if elsewhere else len(self.preset.probes)
        self._task = self.progress.add_task("", total=sum(map(len, todo)) + probed)
        for cells, missing in zip(scenes, todo, strict=True):
            if missing:  # complain before hours of rendering, not after
                reference.load_reference(*cells.where())
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
            self.progress.update(self._task, description=name)
            key = {"rounds": rounds, "versions": software() | {"machine": machine()}}
            try:
                if {k: kept.get(name, {}).get(k) for k in key} != key:
                    kept[name] = key | {"values": probes.PROBES[name](rounds)}
                    reference.write_json(file, kept)
            except Exception as error:  # a probe must not cost the cells
                self.failed.append(f"{name}: {error}")
            self.progress.advance(self._task)

    def _cell(self, bench: Bench, cell: Cell):
        """Render a cell here."""
        self.progress.update(self._task, description=_description(cell))
        try:
            self._store(bench.cells, cell, measure(bench, cell))
        except Exception as error:  # one cell must not cost the others
            raise_interrupt(error)
            self.failed.append(f"{_description(cell)}: {message(error)}")
        self.progress.advance(self._task)

    def _store(self, cells: Cells, cell: Cell, result):
        if cells.where() not in self._judges:
            self._judges[cells.where()] = judge_of(*cells.where())
        store(self.output, cell, *result, self._judges[cells.where()])

    def _remote(self, client, preset: str, scenes: list[Cells], todo: list[list[Cell]]):
        """Render the cells of ``todo``, and those that follow from them, on a cluster."""
        while any(
            todo := [missing or self._more(cells) for cells, missing in zip(scenes, todo, strict=True)]
        ):
            groups = [
                (cells, list(group))
                for cells, missing in zip(scenes, todo, strict=True)
                for _, group in groupby(missing, key=lambda cell: (cell.budget, cell.seed))
            ]
            calls = [
                (preset, cells.subject.name, [asdict(cell) for cell in group]) for cells, group in groups
            ]
            for index, results in workers.results(client, measured, calls):
                cells, group = groups[index]
                for cell, result in zip(group, results, strict=True):
                    if isinstance(result, str):
                        self.failed.append(f"{_description(cell)}: {result}")
                    else:
                        self._store(cells, cell, result)
                    self.progress.update(self._task, description=_description(cell), advance=1)
            todo = [[] for _ in scenes]

    def _more(self, cells: Cells) -> list[Cell]:
        """The cells of a further seed, none if the interval is narrow enough, or there are enough of them."""
        if not cells.fewest():
            return []
        seeds = cells.fewest()
        while seeds < cells.more.at_most and self._are_there(cells.further(seeds)):
            seeds += 1
        found = [c for seed in range(seeds) for c in cells.further(seed)]
        if not self._are_there(found):
            return []  # one of them failed
        try:
            widths = analysis.widths(read_rows(self.output, found), cells.more.methods)
        except ValueError as error:
            self.failed.append(f"further seeds in {cells.subject.name}: {error}")
            return []
        if max(widths.values()) < cells.more.width or seeds == cells.more.at_most:
            return []
        missing = [c for c in cells.further(seeds) if not cell_file(self.output, c).exists()]
        if not self._tried.isdisjoint(keys := {c.key for c in missing}):
            return []  # one of them failed
        self._tried |= keys
        total = self.progress.tasks[self._task].total
        self.progress.update(self._task, total=total + len(missing))
        return missing

    def _are_there(self, cells: list[Cell]) -> bool:
        return all(cell_file(self.output, cell).exists() for cell in cells)


def _description(cell: Cell) -> str:
    return f"{cell.scene}, {cell.budget} spp, seed {cell.seed}, {cell.method}"


def cell_file(output: Path, cell: Cell) -> Path:
    """Where a finished cell lies."""
    return output / "cells" / f"{cell.key}.json"


def image_file(output: Path, cell: Cell) -> Path:
    """Where its image lies."""
    return output / "images" / cell.scene / f"{cell.key}.exr"


def read_rows(output: Path, cells) -> list[dict]:
    """The rows of those cells that are finished; their errors anew where the reference is another now."""
    found = []
    for cell in cells:
        file = cell_file(output, cell)
        if not file.exists():
            continue
        row = json.loads(file.read_text())
        where = cell.scene, cell.resolution, cell.max_depth
        path = reference.reference_path(*where)
        if not path.exists() or row["reference_sha256"] != reference.digest(path):
            (image,), _ = reference.read_exr(image_file(output, cell), "")
            row |= errors(image, *judge_of(*where), cell.seed == FIRST_SEED)
            reference.write_json(file, row)
        found.append(row)
    return found


def rows(preset: Preset, output: Path) -> list[dict]:
    """The rows of all finished cells of the preset, in its order."""
    found = []
    for subject in preset.subjects:
        cells = Cells(preset, subject)
        wanted = {c.key: c for c in cells.planned()}
        if cells.fewest():
            wanted |= {c.key: c for s in range(cells.more.at_most) for c in cells.further(s)}
        found += read_rows(output, wanted.values())
    return [row | {"first": preset.methods[0].name} for row in found]


def chosen(preset: Preset, names) -> Preset:
    """The part of a preset about the scenes ``names``, without probes; raises ``ValueError`` for others."""
    known = [subject.name for subject in preset.subjects]
    for name in names:
        if name not in known:
            raise ValueError(f"--scenes {name}: not in the preset, which has {', '.join(known)}")
    subjects = tuple(subject for subject in preset.subjects if subject.name in names)
    return replace(preset, subjects=subjects, probes={})


def beside(table: list[dict], preset: Preset, output: Path) -> list[dict]:
    """``table`` and the rows of other scenes of the ``preset`` that OUTPUT/rows.parquet has, as they are."""
    import pyarrow.parquet

    file, done = output / "rows.parquet", {row["scene"] for row in table}
    others = pyarrow.parquet.read_table(file).to_pylist() if file.exists() else []
    order = [subject.name for subject in preset.subjects]
    found = table + [row for row in others if row["scene"] in order and row["scene"] not in done]
    return sorted(found, key=lambda row: order.index(row["scene"]))


def write_tables(table: list[dict], output: Path) -> None:
    """rows.csv and rows.parquet, the same columns in both."""
    import pyarrow as pa
    import pyarrow.parquet

    columns = list(dict.fromkeys(key for row in table for key in row))
    table = [{key: row.get(key) for key in columns} for row in table]
    with replacing(output / "rows.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)
    arrays = pa.Table.from_pylist(table)
    place = columns.index("tile_means")
    means = arrays["tile_means"].cast(pa.list_(pa.float32()))  # seven digits were written
    with replacing(output / "rows.parquet") as temporary:
        pyarrow.parquet.write_table(
            arrays.set_column(place, "tile_means", means), temporary, compression="zstd"
        )


def main() -> int:
    """Run the command line; the exit status is 1 if a cell failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("preset", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="default: results/NAME_OF_PRESET")
    parser.add_argument("--scenes", nargs="+", help="these of the preset alone; other rows stay as they are")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of a dask.distributed cluster to render on")
    args = parser.parse_args()
    output = args.output or Path("results") / args.preset.stem
    mi.set_variant("llvm_ad_rgb")
    whole = read_preset(args.preset)
    preset = chosen(whole, args.scenes) if args.scenes else whole
    check_output(output / "rows.csv", ".csv")  # complain before hours of rendering, not after
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress:
        sweep = Sweep(preset, output, progress)
        if args.scheduler:
            with workers.connected(args.scheduler) as client:
                sweep.run((client, args.preset.read_text()))
        else:
            sweep.run()
    table = rows(preset, output)
    if args.scenes:
        table = beside(table, whole, output)
    if table:
        write_tables(table, output)
    print(f"{output}: {len(table)} rows" + "".join(f"\nfailed: {text}" for text in sweep.failed))
    return 1 if sweep.failed else 0
