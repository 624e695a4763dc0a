"""Sweeps of run time against error: scenes x integrators x samples x seeds, one row per render.

    python scripts/sweep.py presets/small.toml -o results/small
    python scripts/sweep.py presets/small.toml -o results/small     # again: goes on where it was stopped

A preset (TOML) names scenes, a resolution, the number of seeds, the samples per pixel of the first integrator
and the integrators with their parameters; ``match = "seconds"`` gives another one the samples that fit into
the first one's time, ``match = "spp"`` the same samples. For each scene, number of samples and seed all
integrators follow one another, so that a noisy machine is noisy for all. Every finished render is a file of
its own in OUTPUT/cells, named after a hash of all that determines it, and is not rendered again; a cell that
fails is reported and tried again the next time. OUTPUT/rows.csv and OUTPUT/rows.parquet hold all rows of the
preset. Errors are taken against the references of scripts/reference.py.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import platform
import time
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path

import metrics
import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np
import reference
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import mitsuba as mi  # isort: skip
import drjit as dr  # isort: skip
from mitsuba_bdpt import render  # isort: skip

TRIM = 0.001  # share of the worst values that the trimmed relMSE leaves out
CALIBRATIONS = 3  # alternating renders from which the samples for equal time follow
FIRST_SEED = 1  # seed 0 warms up


@dataclass(frozen=True)
class Method:
    """An integrator of a preset: ``parameters`` of the plugin, ``sampler`` of the sensor, ``match`` what it
    has in common with the first one, ``seconds`` or ``spp``."""

    name: str
    parameters: tuple
    sampler: str
    match: str


@dataclass(frozen=True)
class Preset:
    """A sweep; ``spp`` are those of the first method, ``max_depth`` None for each scene's own."""

    scenes: tuple
    methods: tuple
    spp: tuple
    seeds: int
    resolution: int
    max_depth: int | None


def read_preset(path: Path) -> Preset:
    """Read and check a TOML file; raises ``ValueError`` and ``TypeError`` naming the key."""
    data = tomllib.loads(path.read_text())
    needed = {"scenes", "spp", "seeds", "resolution", "integrator"}
    if unknown := sorted(set(data) - needed - {"max_depth"}):
        raise ValueError(
            f"{path}: {unknown[0]} is not a key of a preset; there are {sorted(needed | {'max_depth'})}"
        )
    if missing := sorted(needed - set(data)):
        raise ValueError(f"{path}: {missing[0]} is missing")
    for name in data["scenes"]:
        reference.scene_file(name)
    for key in {"seeds", "resolution", "max_depth"} & set(data):
        if type(data[key]) is not int or data[key] < 1:
            raise ValueError(f"{path}: {key}={data[key]!r} must be a whole number of at least 1")
    if not data["spp"] or not all(type(n) is int and n > 0 for n in data["spp"]):
        raise ValueError(f"{path}: spp={data['spp']!r} must be a list of whole numbers of at least 1")
    methods = tuple(_method(path, dict(entry)) for entry in data["integrator"])
    if len({m.name for m in methods}) < len(methods):
        raise ValueError(f"{path}: two integrators have the same name")
    return Preset(
        scenes=tuple(data["scenes"]),
        methods=methods,
        spp=tuple(data["spp"]),
        seeds=data["seeds"],
        resolution=data["resolution"],
        max_depth=data.get("max_depth"),
    )


def _method(path, entry) -> Method:
    if "type" not in entry:
        raise ValueError(f"{path}: an integrator without type: {entry!r}")
    name, sampler = entry.pop("name", entry["type"]), entry.pop("sampler", "independent")
    match = entry.pop("match", "spp")
    if "max_depth" in entry:
        raise ValueError(
            f"{path}: max_depth of integrator {name!r} would compare different images; set it for all"
        )
    if match not in ("spp", "seconds"):
        raise ValueError(f"{path}: match={match!r} of integrator {name!r} must be 'spp' or 'seconds'")
    return Method(name, tuple(sorted(entry.items())), sampler, match)


@dataclass(frozen=True)
class Cell:
    """One render, and all that determines it."""

    scene: str
    scene_sha256: str
    resolution: int
    max_depth: int
    method: str
    parameters: tuple
    sampler: str
    match: str
    budget: int
    seed: int
    versions: tuple

    @property
    def key(self) -> str:
        """Name of the cell's file."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:24]


def cells(preset: Preset, scene: str) -> list[Cell]:
    """The cells of a scene, integrators innermost."""
    common = {
        "scene": scene,
        "scene_sha256": reference.digest(reference.scene_file(scene)),
        "resolution": preset.resolution,
        "max_depth": preset.max_depth or reference.default_depth(scene),
        "versions": tuple(render.versions().items()),
    }
    return [
        Cell(
            **common,
            **{k: getattr(m, k) for k in ("parameters", "sampler", "match")},
            method=m.name,
            budget=spp,
            seed=seed,
        )
        for spp in preset.spp
        for seed in range(FIRST_SEED, FIRST_SEED + preset.seeds)
        for m in preset.methods
    ]


class Bench:
    """The loaded scenes and integrators of one scene's cells, warm."""

    def __init__(self, preset: Preset, scene: str):
        self.preset, self.name = preset, scene
        self._scenes, self._integrators, self._spp = {}, {}, {}
        self.depth = preset.max_depth or reference.default_depth(scene)
        self.reference = reference.load_reference(scene, preset.resolution, self.depth)

    def scene(self, sampler: str):
        """The scene with that sampler."""
        if sampler not in self._scenes:
            self._scenes[sampler] = reference.load_scene(
                self.name, resolution=self.preset.resolution, sampler=sampler
            )
        return self._scenes[sampler]

    def integrator(self, method):
        """The plugin of a `Method` or `Cell`."""
        if method.parameters not in self._integrators:
            parameters = dict(method.parameters) | {"max_depth": self.depth}
            self._integrators[method.parameters] = mi.load_dict(parameters)
        return self._integrators[method.parameters]

    def timed(self, method, spp: int, seed: int):
        """Image and wall seconds of a render."""
        scene, integrator = self.scene(method.sampler), self.integrator(method)
        start = time.perf_counter()
        image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
        dr.eval(image)
        dr.sync_thread()
        return np.array(image, dtype=np.float64)[..., :3], time.perf_counter() - start

    def spp_of(self, cell: Cell) -> int:
        """Samples of a cell: its budget, or what fits into the first method's seconds for it."""
        first = self.preset.methods[0]
        if cell.match == "spp" or cell.method == first.name:
            return cell.budget
        key = (cell.method, cell.budget)
        if key not in self._spp:
            ratios = []
            for seed in range(CALIBRATIONS + 1):
                ours, theirs = (self.timed(m, cell.budget, seed)[1] for m in (first, cell))
                if seed:  # seed 0 compiles
                    ratios.append(ours / theirs)
            self._spp[key] = max(round(cell.budget * float(np.median(ratios))), 1)
        return self._spp[key]

    def warm(self, cell: Cell):
        """Compile what the cell needs."""
        key = ("warm", cell.method)
        if key not in self._spp:
            self.timed(cell, 2, 0)
            self._spp[key] = 0


def measure(bench: Bench, cell: Cell) -> dict:
    """Render a cell; its row."""
    spp = bench.spp_of(cell)
    bench.warm(cell)
    image, seconds = bench.timed(cell, spp, cell.seed)
    statistics = getattr(bench.integrator(cell), "statistics", {})
    row = {
        "key": cell.key,
        **{k: v for k, v in asdict(cell).items() if k not in ("parameters", "versions")},
        "parameters": json.dumps(dict(cell.parameters)),
        "versions": json.dumps(dict(cell.versions)),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "spp": spp,
        "seconds": seconds,
        "seconds_compile": statistics.get("seconds", {}).get("compile"),
        "mean": float(image.mean()),
        "statistics": json.dumps(statistics),
    }
    row |= {f"rays_{kind}": n for kind, n in statistics.get("rays", {}).items()}
    return row | errors(image, bench.reference)


def errors(image, ref: reference.Reference) -> dict:
    """All metrics of an image; ``judged`` is false where the reference is not good enough for them."""
    trimmed = metrics.rel_mse(image, ref.image, trim=TRIM)
    flip, _ = metrics.hdr_flip(image, ref.image)
    return {
        "mse": metrics.mse(image, ref.image),
        "rel_mse": metrics.rel_mse(image, ref.image),
        "rel_mse_trimmed": trimmed,
        "rel_mse_epsilon": metrics.rel_mse_epsilon(ref.image),
        "mape": metrics.mape(image, ref.image),
        "flip": flip,
        "delta_e_2000": metrics.delta_e_2000(image, ref.image),
        "delta_e_itp": metrics.delta_e_itp(image, ref.image),
        "energy_in_black": metrics.energy_in_black(image, ref.image),
        "reference_rel_mse": ref.error,
        "judged": metrics.reference_good_enough(ref.error, trimmed),
    }


def write_json(path: Path, value) -> None:
    """Write at once: a process that is killed leaves the whole file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(json.dumps(value, indent=1) + "\n")
    os.replace(temporary, path)


def run(preset: Preset, output: Path, progress: Progress) -> list[str]:
    """Render all cells that are not there yet; returns what failed, a text each."""
    todo = {s: [c for c in cells(preset, s) if not cell_file(output, c).exists()] for s in preset.scenes}
    task = progress.add_task("", total=sum(len(c) for c in todo.values()))
    failed = []
    for scene, missing in todo.items():
        bench = None
        for cell in missing:
            progress.update(task, description=f"{scene}, {cell.budget} spp, seed {cell.seed}, {cell.method}")
            try:
                bench = bench or Bench(preset, scene)
                write_json(cell_file(output, cell), measure(bench, cell))
            except Exception as error:  # one cell must not cost the others
                failed.append(f"{scene}, {cell.method}, {cell.budget} spp, seed {cell.seed}: {error}")
            progress.advance(task)
    return failed


def cell_file(output: Path, cell: Cell) -> Path:
    """Where a finished cell lies."""
    return output / "cells" / f"{cell.key}.json"


def rows(preset: Preset, output: Path) -> list[dict]:
    """The rows of all finished cells of the preset, in its order."""
    files = [cell_file(output, c) for scene in preset.scenes for c in cells(preset, scene)]
    return [json.loads(f.read_text()) for f in files if f.exists()]


def write_tables(table: list[dict], output: Path) -> None:
    """rows.csv and rows.parquet, the same columns in both."""
    import pyarrow as pa
    import pyarrow.parquet

    columns = list(dict.fromkeys(key for row in table for key in row))
    table = [{key: row.get(key) for key in columns} for row in table]
    temporary = output / f".rows.{os.getpid()}.tmp"
    with temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)
    os.replace(temporary, output / "rows.csv")
    pyarrow.parquet.write_table(pa.Table.from_pylist(table), temporary)
    os.replace(temporary, output / "rows.parquet")


def main() -> int:
    """Run the command line; the exit status is 1 if a cell failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("preset", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="default: results/NAME_OF_PRESET")
    args = parser.parse_args()
    output = args.output or Path("results") / args.preset.stem
    preset = read_preset(args.preset)
    mi.set_variant("llvm_ad_rgb")
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress:
        failed = run(preset, output, progress)
    table = rows(preset, output)
    if table:
        write_tables(table, output)
    print(f"{output}: {len(table)} rows" + "".join(f"\nfailed: {text}" for text in failed))
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
