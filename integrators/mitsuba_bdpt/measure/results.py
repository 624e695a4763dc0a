"""A sweep's files: cells, tables, variances over seeds."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from ..errors import CommandError
from ..files.images import read_layers, write_layers
from ..files.texts import list_of, read_json, read_toml, text_of, write_json
from ..files.whole import replacing
from . import agreement, analysis, metrics
from .preset import FIRST_SEED, Cell, Cells, Preset
from .project import Project
from .reference import Reference, load_reference, read_reference, reference_path
from .scenes import MeasuredScene, digest
from .tables import described


def cell_file(output: Path, cell: Cell) -> Path:
    return output / "cells" / f"{cell.key}.json"


def first_image_file(output: Path, cell: Cell) -> Path:
    """Return the file of the seconds of first images, by the cell of the smallest budget's first seed."""
    return output / "first" / f"{cell.key}.json"


def image_file(output: Path, render: Any) -> Path:
    """Return the file of the image of a render: a `Cell` or a row."""
    return output / "images" / render.scene / f"{render.key}.exr"


def judge_of(project: Project, scene: MeasuredScene, resolution: int, depth: int):
    """Return a reference, and the SHA-256 of its file, computed before reading."""
    path = reference_path(project, scene.name, resolution, depth)
    sha256 = digest(path) if path.exists() else ""
    return load_reference(project, scene, resolution, depth), sha256


def store(output: Path, cell: Cell, row: dict, image: np.ndarray, judge) -> None:
    """Write image and row of a cell, with errors against ``judge`` (see `judge_of`)."""
    write_layers(image_file(output, cell), {"": image}, {"cell": json.dumps(asdict(cell))}, np.float32)
    found = row | errors(image, *judge, cell.seed == FIRST_SEED)
    write_json(cell_file(output, cell), found)


def errors(image, ref: Reference, ref_sha256: str, flip: bool) -> dict:
    """Return all error measures of an image; of HDR-FLIP, slower than most renders, only with ``flip``."""
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


def relative_errors(image: np.ndarray, ref: Reference) -> dict[str, float]:
    """Return the relMSE of an image, raw and trimmed, and what the reference's own error adds to each."""
    found: dict[str, float] = {}
    for name, trim in (("rel_mse", 0.0), ("rel_mse_trimmed", metrics.TRIM)):
        found[name] = metrics.rel_mse(image, ref.image, trim)
        found[f"reference_{name}"] = ref.share_of(image, trim)
    return found


def read_rows(output: Path, cells: Cells, wanted: Sequence[Cell]) -> pd.DataFrame:
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
            row |= errors(_image(output, cell), *judge_of(*cells.where()), cell.seed == FIRST_SEED)
            write_json(file, row)
        found.append(row)
    return pd.DataFrame(found)


def _image(output: Path, render: Any) -> np.ndarray:
    """Read the image of a finished cell, see `image_file`; raises ``CommandError`` if it is missing."""
    try:
        (image,), _ = read_layers(image_file(output, render), "")
    except (OSError, CommandError) as error:
        file = str(cell_file(output, render))
        raise CommandError(f"{error}: delete {file!r} too, to render the image anew") from error
    return image


def rows(preset: Preset, cells: Cells, output: Path) -> pd.DataFrame:
    """Return the rows of all finished cells of a scene, in order.

    Cells are those that were rendered: a source edited meanwhile changes their names.
    """
    found = read_rows(output, cells, cells.possible())
    if found.empty:
        return found
    first = {c.method: _first_image(output, c) for c in cells.of(min(cells.subject.spp), FIRST_SEED)}
    return found.assign(
        variance=_variances(output, cells, found),
        first=preset.methods[0].name,
        seconds_first_image=found["method"].map(first).astype(float),
    )


def _first_image(output: Path, cell: Cell) -> float | None:
    """Return the median seconds of an integrator's first images; None without."""
    file = first_image_file(output, cell)
    return float(np.median(read_json(file, "delete it, to render it anew"))) if file.exists() else None


def _variances(output: Path, cells: Cells, table: pd.DataFrame) -> pd.Series:
    """Return `metrics.spread` of each row, over the seeds of its integrator and budget.

    NaN for fewer than two renders, differing numbers of samples, or missing images.
    """
    found, ref = pd.Series(np.nan, table.index), None
    for _, group in table.groupby(["method", "budget"]):
        renders = list(group.itertuples())
        are_there = all(image_file(output, render).exists() for render in renders)
        if len(group) > 1 and group["spp"].nunique() == 1 and are_there:
            ref = ref or load_reference(*cells.where())
            found[group.index] = metrics.spread([_image(output, render) for render in renders], ref.image)
    return found


def _stored(file: Path) -> pd.DataFrame:
    """Return the rows of a file; older sweeps have the variance as ``spread``."""
    return pd.read_parquet(file).rename(columns={"spread": "variance"})


def beside(table: pd.DataFrame, order: Sequence[str] | None, output: Path) -> pd.DataFrame:
    """Return ``table`` and stored rows of other scenes, in ``order``; None: as stored, new ones last."""
    file = output / "rows.parquet"
    try:
        others = _stored(file) if file.exists() else table[:0]
    except pa.ArrowInvalid as error:
        raise CommandError(
            f"{str(file)!r} is damaged ({error}); run the sweep without --scenes, which writes it anew"
        ) from error
    if others.empty:
        return table
    done = set(table.get("scene", ()))
    every = pd.concat([others, table])
    order = list(order or every["scene"].unique())
    kept = pd.concat([table, others[~others["scene"].isin(done)]])
    kept = kept[kept["scene"].isin(order)]
    return kept.sort_values("scene", key=lambda names: names.map(order.index), kind="stable")


def lost(table: pd.DataFrame, output: Path) -> list[str]:
    """Return messages about stored rows whose render is not among those of the ``table``.

    An edited scene has its own message.
    """
    before = _before(output)
    if table.empty or before.empty:
        return []
    now = before["scene"].map(table.groupby("scene")["scene_sha256"].first())
    is_edited = now.notna() & (now != before["scene_sha256"])
    told = [
        f"{name}: the scene has changed: {count} renders of it before are no longer in the tables, and used "
        "again if it is reverted"
        for name, count in before["scene"][is_edited].value_counts(sort=False).items()
    ]
    keys = ["scene", "method", "budget", "seed", "resolution", "max_depth", "parameters"]
    is_kept = pd.MultiIndex.from_frame(before[keys]).isin(pd.MultiIndex.from_frame(table[keys]))
    gone = before[~is_edited & ~is_kept]
    if gone.empty:
        return told
    names = ", ".join((gone["scene"] + " by " + gone["method"]).unique())
    text = (
        f"{output}: {len(gone)} rows are not of this preset, and no longer in the tables: {names}. Their "
        "renders are kept: sweep the earlier preset again to have its rows, and name another folder by -o"
    )
    return [*told, text]


def _before(output: Path) -> pd.DataFrame:
    """Return the stored rows; none if they are missing or damaged, and so written anew."""
    try:
        return _stored(output / "rows.parquet")
    except (FileNotFoundError, pa.ArrowInvalid):
        return pd.DataFrame()


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


COLUMNS = (
    *("scene", "integrator", "parameters", "sampler", "spp", "seed", "clock", "budget", "equal_time_spp"),
    *("seconds", "cpu_seconds", "seconds_compile", "seconds_pilot", "seconds_first_image"),
    *("rel_mse", "rel_mse_trimmed", "reference_rel_mse", "reference_rel_mse_trimmed", "variance"),
    *("mse", "mape", "flip", "delta_e_itp", "mean", "energy", "width", "height", "max_depth"),
)
"""Columns of rows.csv, before those of the rays and the image."""


def named_image(row: Any) -> str:
    """Return the name of a render's image, scene_integrator_spp_seed.exr."""
    method = re.sub(r"[^\w.=+-]+", "-", row.method)
    return f"{row.scene}_{method}_{row.spp}_{row.seed}.exr"


def _name_images(table: pd.DataFrame, output: Path) -> list[str]:
    """Link the images of the rows under their names; returns these, empty where there is no image.

    Names of the rows before are removed.
    """
    names: list[str] = []
    for row in table.itertuples():
        stored, name = image_file(output, row), named_image(row)
        names.append(name if stored.exists() else "")
        if stored.exists():
            with replacing(output / "images" / name) as temporary:
                try:
                    os.link(stored, temporary)
                except OSError:  # no links on this file system
                    shutil.copyfile(stored, temporary)
    for name in {named_image(row) for row in _before(output).itertuples()}.difference(names):
        (output / "images" / name).unlink(missing_ok=True)
    return names


def write_tables(table: pd.DataFrame, output: Path) -> None:
    """Write rows.parquet with all columns, rows.csv with a number or a text in each cell, and rows.json.

    rows.json has the parameters, decisions, statistics and versions of each render, in the order of the rows.
    """
    rays = [name for name in table if name.startswith("rays_")]
    counts = table.columns.intersection([*rays, "equal_time_spp"])
    table = table.astype(dict.fromkeys(counts, "Int64"))
    parts = {
        name: [json.loads(text or "null") for text in table[name]]
        for name in ("parameters", "decisions", "statistics", "versions")
    }
    plain = ["scene", "method", "spp", "seed", "key", "machine", "started"]
    write_json(output / "rows.json", table[plain].assign(**parts).to_dict("records"))
    tidy = table.rename(columns={"method": "integrator"}).assign(
        parameters=[described(dict(sorted(found.items()))) for found in parts["parameters"]],
        clock=table.get("clock", pd.Series("wall", table.index)).fillna("wall"),
        image=_name_images(table, output),
    )
    encoded = {"encoding": "utf-8", "errors": "backslashreplace"}
    with replacing(output / "rows.csv") as temporary:
        tidy.reindex(columns=[*COLUMNS, *rays, "image"]).to_csv(temporary, index=False, **encoded)
    means = [np.array(found, np.float32) for found in table["tile_means"]]  # seven digits, as written
    written = io.BytesIO()
    table.assign(tile_means=means).to_parquet(written, compression="zstd", index=False)
    with replacing(output / "rows.parquet") as temporary:
        temporary.write_bytes(written.getvalue())


def decided(row: Mapping[str, Any]) -> float:
    """Return the seconds of a record by its clock: wall or processor seconds."""
    return row["cpu_seconds"] if row.get("clock") == "processor" else row["seconds"]


def decisive(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with the seconds by which they are compared."""
    return table.assign(seconds=table.apply(decided, axis=1))


def load(project: Project, folder: Path) -> tuple[analysis.Results, dict[str, Reference], dict[str, str]]:
    """Return the results in a folder, and the references of its scenes and the notes by scene.

    The integrators that notes.toml lists as ``aside`` are not compared. Raises ``CommandError`` if there are
    no results, or if errors are against other references than the ``project``'s.
    """
    try:
        table = decisive(_stored(folder / "rows.parquet"))
    except (FileNotFoundError, NotADirectoryError, pa.ArrowInvalid) as error:
        raise CommandError(
            f"{folder}: rows.parquet is missing or not whole; run {project.sweep_command(folder)}"
        ) from error
    made: dict[str, Reference] = {}
    for scene, rows in table.groupby("scene", sort=False):
        path = reference_path(project, scene, rows["resolution"].iloc[0], rows["max_depth"].iloc[0])
        if not path.is_file():
            raise CommandError(
                f"{folder}: the reference of {scene} is not in {str(project.references)!r}; name the "
                "folder of the sweep's project by --project, or run the sweep again, which makes it"
            )
        made[scene] = read_reference(path)
        if (rows["reference_sha256"] != digest(path)).any():
            raise CommandError(
                f"{folder}: the errors in {scene} were taken against another reference; run "
                f"{project.sweep_command(folder)}, which takes them anew"
            )
    means = {scene: kept.means for scene, kept in made.items() if kept.means is not None}
    notes = folder / "notes.toml"
    given = read_toml(notes) if notes.exists() else {}
    aside = list_of(notes, "aside", given.pop("aside"), str, "texts in quotes") if "aside" in given else []
    found = analysis.Results(table, means, aside)
    if unknown := [name for name in aside if name not in found.methods]:
        raise CommandError(
            f"{notes}: {unknown[0]!r} of aside is not in the sweep: {', '.join(found.methods)}"
        )
    return found, made, {scene: text_of(notes, scene, text) for scene, text in given.items()}
