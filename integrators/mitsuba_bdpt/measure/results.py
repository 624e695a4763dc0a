"""A sweep's files: cells, tables, spreads over seeds."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from ..errors import CommandError
from ..files.images import read_layers, write_layers
from ..files.texts import list_of, read_json, read_toml, write_json
from ..files.whole import replacing
from . import agreement, analysis, metrics
from .preset import FIRST_SEED, Cell, Cells, Preset
from .project import Project
from .record import Errors, Row
from .reference import Reference, load_reference, read_reference, reference_path
from .scenes import MeasuredScene, digest
from .tables import described


def cell_file(output: Path, cell: Cell) -> Path:
    return output / "cells" / f"{cell.key}.json"


def first_image_file(output: Path, cell: Cell) -> Path:
    """Return the file of the seconds of first images, by the cell of the smallest budget's first seed."""
    return output / "first" / f"{cell.key}.json"


def image_file(output: Path, cell: Cell) -> Path:
    return output / "images" / cell.scene / f"{cell.key}.exr"


def judge_of(project: Project, scene: MeasuredScene, resolution: int, depth: int):
    """Return a reference, and the SHA-256 of its file, computed before reading.

    If it is replaced meanwhile, the next run computes the errors again.
    """
    path = reference_path(project, scene.name, resolution, depth)
    sha256 = digest(path) if path.exists() else ""
    return load_reference(project, scene, resolution, depth), sha256


def store(output: Path, cell: Cell, row: dict, image: np.ndarray, judge) -> None:
    """Write image and row of a cell, with errors against ``judge`` (see `judge_of`)."""
    write_layers(image_file(output, cell), {"": image}, {"cell": json.dumps(asdict(cell))}, np.float32)
    found = row | errors(image, *judge, cell.seed == FIRST_SEED)
    write_json(cell_file(output, cell), found)


def errors(image, ref: Reference, ref_sha256: str, flip: bool) -> dict:
    """Return all error measures of an image.

    HDR-FLIP is slower than most renders: only with ``flip``, else None.
    """
    return relative_errors(image, ref) | {
        "reference_sha256": ref_sha256,
        "width": image.shape[1],
        "height": image.shape[0],
        "mean": float(image.mean()),
        "energy": float(image.mean() / ref.image.mean()),
        "tile_means": [float(f"{x:.7g}") for x in agreement.tile_columns(image)],
        "mse": metrics.mse(image, ref.image),
        "rel_mse_epsilon": metrics.rel_mse_epsilon(ref.image),
        "mape": metrics.mape(image, ref.image),
        "flip": metrics.hdr_flip(image, ref.image)[0] if flip else None,
        "delta_e_itp": metrics.delta_e_itp(image, ref.image),
    }


def relative_errors(image: np.ndarray, ref: Reference) -> Errors:
    """Return the relMSE of an image, raw and trimmed, and what the reference's own error adds to each."""
    return Errors(
        rel_mse=metrics.rel_mse(image, ref.image),
        rel_mse_trimmed=metrics.rel_mse(image, ref.image, metrics.TRIM),
        reference_rel_mse=ref.share_of(image, 0.0),
        reference_rel_mse_trimmed=ref.share_of(image, metrics.TRIM),
    )


def read_rows(output: Path, cells: Cells, wanted) -> list[Row]:
    """Return the rows of the finished cells among ``wanted``.

    Computes errors again if the reference has changed.
    """
    project, scene, resolution, depth = cells.where()
    path, found = reference_path(project, scene.name, resolution, depth), []
    for cell in wanted:
        file = cell_file(output, cell)
        if not file.exists():
            continue
        row = read_json(file, "delete it, to render it anew")
        if not path.exists() or row["reference_sha256"] != digest(path):
            image = _image(output, cell)
            row |= errors(image, *judge_of(*cells.where()), cell.seed == FIRST_SEED)
            write_json(file, row)
        found.append(_with_points(row))
    return found


def _with_points(row: Row) -> Row:
    """Set the ``sampler`` of a row to what made its random numbers, of `bdpt` its ``points``; return it.

    Files of cells and older tables have the sensor's, which `bdpt` does not use.
    """
    given = json.loads(row.get("parameters", "{}"))
    if given.get("type") == "bdpt":
        row["sampler"] = given.get("points", "sobol")
    return row


def _image(output: Path, cell: Cell) -> np.ndarray:
    """Read the image of a finished cell; raises ``CommandError`` if it is missing."""
    try:
        (image,), _ = read_layers(image_file(output, cell), "")
    except (OSError, CommandError) as error:
        file = str(cell_file(output, cell))
        raise CommandError(f"{error}: delete {file!r} too, to render the image anew") from error
    return image


def rows(preset: Preset, cells: Cells, output: Path) -> list[Row]:
    """Return the rows of all finished cells of a scene, in order.

    Cells are those that were rendered: a source edited meanwhile changes their names.
    """
    wanted = cells.possible()
    found = read_rows(output, cells, wanted)
    spreads = _spreads(output, cells, wanted, found) if found else {}
    first = {c.method: _first_image(output, c) for c in cells.of(min(cells.subject.spp), FIRST_SEED)}
    for row in found:
        row |= {"variance": spreads[row["key"]], "first": preset.methods[0].name}
        row["seconds_first_image"] = first[row["method"]]
    return found


def _first_image(output: Path, cell: Cell) -> float | None:
    """Return the median seconds of an integrator's first images; None without."""
    file = first_image_file(output, cell)
    return float(np.median(read_json(file, "delete it, to render it anew"))) if file.exists() else None


def _spreads(output: Path, cells: Cells, wanted: list[Cell], table: list[Row]) -> dict[str, float | None]:
    """Return `metrics.spread` by the rows' keys, for each integrator and budget.

    None for fewer than two renders, differing numbers of samples, or missing images. Cached in
    OUTPUT/variances, since reading the images is slow.
    """
    there = {row["key"]: row for row in table}
    groups: dict[tuple[str, int], list[Cell]] = {}
    for cell in wanted:
        if cell.key in there:
            groups.setdefault((cell.method, cell.budget), []).append(cell)
    file = output / "variances" / f"{cells.subject.name}.json"
    kept = read_json(file, "delete it, to take the variance anew") if file.exists() else {}
    now: dict[str, list[float] | None] = {}
    found: dict[str, float | None] = dict.fromkeys(there)
    for group in groups.values():
        mark = " ".join([there[group[0].key]["reference_sha256"], *(cell.key for cell in group)])
        now[mark] = kept[mark] if mark in kept else _spread(output, cells, group, there)
        values = now[mark] or [None] * len(group)
        found |= {cell.key: value for cell, value in zip(group, values, strict=True)}
    if now != kept:
        write_json(file, now)
    return found


def _spread(output: Path, cells: Cells, group: list[Cell], there: dict[str, Row]) -> list[float] | None:
    """Like `_spreads`, of the compared cells ``group``, whose rows are ``there``."""
    files = [image_file(output, cell) for cell in group]
    if (
        len(group) < 2
        or len({there[cell.key]["spp"] for cell in group}) > 1
        or not all(file.exists() for file in files)
    ):
        return None
    return metrics.spread([_image(output, cell) for cell in group], load_reference(*cells.where()).image)


def _stored(file: Path) -> list[Row]:
    """Return the rows of a file; older sweeps have the variance as ``spread``."""
    table = pyarrow.parquet.read_table(pa.BufferReader(file.read_bytes()))
    names = ["variance" if name == "spread" else name for name in table.column_names]
    return [_with_points(row) for row in table.rename_columns(names).to_pylist()]


def beside(table: list[Row], order: Sequence[str] | None, output: Path) -> list[Row]:
    """Return ``table`` and stored rows of other scenes, in ``order``; None: as stored, new ones last."""
    file, done = output / "rows.parquet", {row["scene"] for row in table}
    try:
        others = _stored(file) if file.exists() else []
    except pyarrow.ArrowInvalid as error:
        raise CommandError(
            f"{str(file)!r} is damaged ({error}); run the sweep without --scenes, which writes it anew"
        ) from error
    order = order or list(dict.fromkeys(row["scene"] for row in [*others, *table]))
    found = table + [row for row in others if row["scene"] in order and row["scene"] not in done]
    return sorted(found, key=lambda row: order.index(row["scene"]))


def lost(table: list[Row], output: Path) -> list[str]:
    """Return messages about stored rows whose render is not among those of the ``table``.

    An edited scene has its own message.
    """
    before = _before(output) if table else []
    keys = ["scene", "method", "budget", "seed", "resolution", "max_depth", "parameters", "sampler"]
    kept = {tuple(row[key] for key in keys) for row in table}
    versions = {row["scene"]: row["scene_sha256"] for row in table}

    def is_edited(row: Row) -> bool:
        return versions.get(row["scene"], row["scene_sha256"]) != row["scene_sha256"]

    edited = Counter(row["scene"] for row in before if is_edited(row))
    told = [
        f"{name}: the scene has changed: {count} renders of it before are no longer in the tables, and used "
        "again if it is reverted"
        for name, count in edited.items()
    ]
    gone = [row for row in before if not is_edited(row) and tuple(row[key] for key in keys) not in kept]
    if not gone:
        return told
    names = ", ".join(dict.fromkeys(f"{row['scene']} by {row['method']}" for row in gone))
    text = (
        f"{output}: {len(gone)} rows are not of this preset, and no longer in the tables: {names}. Their "
        "renders are kept: sweep the earlier preset again to have its rows, and name another folder by -o"
    )
    return [*told, text]


def _before(output: Path) -> list[Row]:
    """Return the stored rows; none if they are missing or damaged, and so written anew."""
    try:
        return _stored(output / "rows.parquet")
    except (FileNotFoundError, pyarrow.ArrowInvalid):
        return []


def keep_missing(output: Path, scenes: Sequence[str], cut: Mapping[str, str], command: str) -> None:
    """Write what was cut of the ``scenes``, with the ``command`` that renders it, for the report.

    Entries of other scenes stay.
    """
    file = output / "missing.json"
    kept = {name: one for name, one in missing_of(output).items() if name not in scenes}
    kept |= {name: {"text": text, "command": command} for name, text in cut.items()}
    if kept:
        write_json(file, kept)
    else:
        file.unlink(missing_ok=True)


def missing_of(output: Path) -> dict[str, dict[str, str]]:
    """Return what `keep_missing` wrote, by scene."""
    file = output / "missing.json"
    return read_json(file, "delete it, and sweep again") if file.exists() else {}


COLUMNS: dict[str, Callable[[Row], object]] = {
    "scene": lambda row: row["scene"],
    "integrator": lambda row: row["method"],
    "parameters": lambda row: described(dict(sorted(json.loads(row["parameters"]).items()))),
    "sampler": lambda row: row["sampler"],
    "spp": lambda row: row["spp"],
    "seed": lambda row: row["seed"],
    "clock": lambda row: row.get("clock", "wall"),
}
"""First columns of rows.csv."""

NUMBERS = (
    "budget",
    "equal_time_spp",
    "seconds",
    "cpu_seconds",
    "seconds_compile",
    "seconds_pilot",
    "seconds_first_image",
    "rel_mse",
    "rel_mse_trimmed",
    "reference_rel_mse",
    "reference_rel_mse_trimmed",
    "variance",
    "mse",
    "mape",
    "flip",
    "delta_e_itp",
    "mean",
    "energy",
    "width",
    "height",
    "max_depth",
)
"""Further columns of rows.csv, named as in rows."""


def named_image(row: Row) -> str:
    """Return the name of a render's image, scene_integrator_spp_seed.exr."""
    method = re.sub(r"[^\w.=+-]+", "-", row["method"])
    return f"{row['scene']}_{method}_{row['spp']}_{row['seed']}.exr"


def _name_images(table: list[Row], output: Path) -> list[str]:
    """Link the images of the rows under their names; returns these, empty where there is no image.

    Names of the rows before are removed.
    """
    names: list[str] = []
    for row in table:
        stored, name = output / "images" / row["scene"] / f"{row['key']}.exr", named_image(row)
        names.append(name if stored.exists() else "")
        if stored.exists():
            with replacing(output / "images" / name) as temporary:
                try:
                    os.link(stored, temporary)
                except OSError:  # no links on this file system
                    shutil.copyfile(stored, temporary)
    for name in {named_image(row) for row in _before(output)}.difference(names):
        (output / "images" / name).unlink(missing_ok=True)
    return names


def write_tables(table: list[Row], output: Path) -> None:
    """Write rows.parquet with all columns, rows.csv with a number or a text in each cell, and rows.json.

    rows.json has the parameters, decisions, statistics and versions of each render, in the order of the rows.
    """
    columns = list(dict.fromkeys(key for row in table for key in row))
    whole = [{key: row.get(key) for key in columns} for row in table]
    rays = [key for key in columns if key.startswith("rays_")]
    tidy = [
        {name: made(row) for name, made in COLUMNS.items()}
        | {name: row.get(name) for name in (*NUMBERS, *rays)}
        | {"image": image}
        for row, image in zip(table, _name_images(table, output), strict=True)
    ]
    encoded = {"encoding": "utf-8", "errors": "backslashreplace", "newline": ""}
    with replacing(output / "rows.csv") as temporary, temporary.open("w", **encoded) as file:
        writer = csv.DictWriter(file, tidy[0])
        writer.writeheader()
        writer.writerows(tidy)
    parts = "parameters", "decisions", "statistics", "versions"
    found = [
        {key: row[key] for key in ("scene", "method", "spp", "seed", "key", "machine", "started")}
        | {key: json.loads(row[key] or "null") for key in parts}
        for row in table
    ]
    write_json(output / "rows.json", found)
    arrays = pa.Table.from_pylist(whole)
    place, written = columns.index("tile_means"), pa.BufferOutputStream()
    means = arrays["tile_means"].cast(pa.list_(pa.float32()))  # seven digits, as written
    pyarrow.parquet.write_table(arrays.set_column(place, "tile_means", means), written, compression="zstd")
    with replacing(output / "rows.parquet") as temporary:
        temporary.write_bytes(written.getvalue())


def decided(row: Mapping[str, Any]) -> float:
    """Return the seconds of a record by its clock: wall or processor seconds."""
    return row["cpu_seconds"] if row.get("clock") == "processor" else row["seconds"]


def decisive(rows: list[Row]) -> list[Row]:
    """Return the ``rows`` with the seconds by which they are compared."""
    return [{**row, "seconds": decided(row)} for row in rows]


def load(project: Project, folder: Path) -> tuple[analysis.Results, dict[str, Reference]]:
    """Return the results in a folder, and the references of its scenes by name.

    The integrators that notes.toml lists as ``aside`` are not compared. Raises ``CommandError`` if there are
    no results, or if errors are against other references than the ``project``'s.
    """
    try:
        rows = decisive(_stored(folder / "rows.parquet"))
    except (FileNotFoundError, NotADirectoryError, pyarrow.ArrowInvalid) as error:
        raise CommandError(
            f"{folder}: rows.parquet is missing or not whole; run {project.sweep_command(folder)}"
        ) from error
    made, digests = {}, {}
    for row in rows:
        scene = row["scene"]
        if scene not in made:
            path = reference_path(project, scene, row["resolution"], row["max_depth"])
            if not path.is_file():
                raise CommandError(
                    f"{folder}: the reference of {scene} is not in {str(project.references)!r}; name the "
                    "folder of the sweep's project by --project, or run the sweep again, which makes it"
                )
            made[scene], digests[scene] = read_reference(path), digest(path)
        if row["reference_sha256"] != digests[scene]:
            raise CommandError(
                f"{folder}: the errors in {scene} were taken against another reference; run "
                f"{project.sweep_command(folder)}, which takes them anew"
            )
    means = {scene: kept.means for scene, kept in made.items() if kept.means is not None}
    file = folder / "probes.json"
    measured = read_json(file, "delete it, and sweep again to measure it anew") if file.exists() else {}
    notes = folder / "notes.toml"
    given = read_toml(notes) if notes.exists() else {}
    aside = list_of(notes, "aside", given["aside"], str, "texts in quotes") if "aside" in given else []
    found = analysis.Results(rows, means, measured, tuple(aside))
    if unknown := [name for name in aside if name not in found.methods]:
        raise CommandError(
            f"{notes}: {unknown[0]!r} of aside is not in the sweep: {', '.join(found.methods)}"
        )
    return found, made
