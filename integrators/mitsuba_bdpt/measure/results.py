"""A sweep's files: cells, images, tables, variances over seeds."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from ..errors import CommandError
from ..files.images import read_layers, write_layers
from ..files.texts import read_json, read_toml, write_json
from ..files.whole import replacing
from . import agreement, analysis, metrics
from .models import Notes, checked
from .preset import FIRST_SEED, Cell, Cells
from .project import Project
from .reference import Reference, read_reference, reference_path
from .scenes import digest
from .tables import described


def cell_file(output: Path, cell: Cell) -> Path:
    return output / "cells" / f"{cell.key}.json"


def read_cell(file: Path) -> dict[str, Any]:
    return read_json(file, "delete it, to render it anew")


def image_file(output: Path, render: Any) -> Path:
    """Return the file of the image of a render: a `Cell` or a row."""
    method = re.sub(r"[^\w.=+-]+", "-", render.method)
    names = render.scene, method, render.budget, render.seed, render.key[:8]
    return output / "images" / f"{'_'.join(map(str, names))}.exr"


def store(output: Path, cells: Cells, cell: Cell, row: dict, image: np.ndarray) -> None:
    """Write image and row of a cell, with errors against the stored reference."""
    write_layers(image_file(output, cell), {"": image}, {"cell": json.dumps(asdict(cell))}, np.float32)
    write_json(cell_file(output, cell), row | errors(image, *cells.reference, cell.seed == FIRST_SEED))


def errors(image, ref: Reference, ref_sha256: str, flip: bool) -> dict:
    """Return all error measures of an image; HDR-FLIP, which is slow, with ``flip``."""
    return rel_mse_columns(image, ref) | {
        "reference_sha256": ref_sha256,
        "width": image.shape[1],
        "height": image.shape[0],
        "mean": float(image.mean()),
        "energy": float(image.mean() / ref.image.mean()),
        "tile_means": [float(f"{x:.7g}") for x in agreement.tile_columns(image)],
        "flip": metrics.hdr_flip(image, ref.image) if flip else None,
        "delta_e_itp": metrics.delta_e_itp(image, ref.image),
    }


def rel_mse_columns(image: np.ndarray, ref: Reference) -> dict[str, float]:
    """Return a row's relMSE, raw and trimmed, and the reference's shares of both."""
    found: dict[str, float] = {}
    for name, trim in (("rel_mse", 0.0), ("rel_mse_trimmed", metrics.TRIM)):
        found[name] = metrics.rel_mse(image, ref.image, trim)
        found[f"reference_{name}"] = metrics.reference_rel_mse(ref.difference, image, ref.image, trim)
    return found


def rows(cells: Cells, output: Path) -> pd.DataFrame:
    """Return the rows of all finished cells of a scene, by budgets.

    Computes errors again if the reference has changed.
    """
    found = []
    for cell in sorted(cells.planned, key=lambda cell: cell.budget):
        file = cell_file(output, cell)
        if file.exists():
            row = read_cell(file)
            if row["reference_sha256"] != cells.reference[1]:
                row |= errors(_image(output, cell), *cells.reference, cell.seed == FIRST_SEED)
                write_json(file, row)
            found.append(row)
    table = pd.DataFrame(found)
    if not found:
        return table
    return table.assign(variance=_variances(output, cells, table), first=cells.methods[0].name)


def _image(output: Path, render: Any) -> np.ndarray:
    """Read the image of a finished cell; raises ``CommandError`` if it is missing."""
    try:
        (image,), _ = read_layers(image_file(output, render), "")
    except (OSError, CommandError) as error:
        file = str(cell_file(output, render))
        raise CommandError(f"{error}: delete {file!r} too, to render the image anew") from error
    return image


def _variances(output: Path, cells: Cells, table: pd.DataFrame) -> pd.Series:
    """Return `metrics.spread` of each row, over seeds.

    NaN for fewer than two renders, differing numbers of samples, or missing images.
    """
    found = pd.Series(np.nan, table.index)
    for _, group in table.groupby(["method", "budget"]):
        renders = list(group.itertuples())
        are_there = all(image_file(output, render).exists() for render in renders)
        if len(group) > 1 and group["spp"].nunique() == 1 and are_there:
            images = [_image(output, render) for render in renders]
            found[group.index] = metrics.spread(images, cells.reference[0].image)
    return found


def _stored(folder: Path, remedy: str) -> pd.DataFrame:
    """Return the rows of a folder; older sweeps have the variance as ``spread``."""
    try:
        return pd.read_parquet(folder / "rows.parquet").rename(columns={"spread": "variance"})
    except (FileNotFoundError, NotADirectoryError, pa.ArrowInvalid) as error:
        raise CommandError(f"{folder}: rows.parquet is missing or not whole; {remedy}") from error


def beside(table: pd.DataFrame, order: Sequence[str] | None, output: Path) -> pd.DataFrame:
    """Return ``table`` and stored rows of other scenes, in ``order``.

    None: as stored, new ones last.
    """
    if not (output / "rows.parquet").exists():
        return table
    others = _stored(output, "run the sweep without --scenes, which writes it anew")
    order = list(order or pd.concat([others, table])["scene"].unique())
    kept = others["scene"].isin(order) & ~others["scene"].isin(table.get("scene", ()))
    found = pd.concat([table, others[kept]])
    return found.sort_values("scene", key=lambda names: names.map(order.index), kind="stable")


def keep_missing(output: Path, scenes: Sequence[str], cut: Mapping[str, str], command: str) -> None:
    """Write what was cut of the ``scenes``, with the ``command`` that renders it.

    Entries of other scenes stay.
    """
    kept = {name: one for name, one in missing_of(output).items() if name not in scenes}
    kept |= {name: {"text": text, "command": command} for name, text in cut.items()}
    if kept:
        write_json(output / "missing.json", kept)
    else:
        (output / "missing.json").unlink(missing_ok=True)


def missing_of(output: Path) -> dict[str, dict[str, str]]:
    """Return what `keep_missing` wrote, by scene."""
    file = output / "missing.json"
    return read_json(file, "delete it, and sweep again") if file.exists() else {}


COLUMNS = (
    *("scene", "integrator", "parameters", "sampler", "spp", "seed", "clock", "budget", "equal_time_spp"),
    *("seconds", "cpu_seconds", "seconds_pilot"),
    *("rel_mse", "rel_mse_trimmed", "reference_rel_mse", "reference_rel_mse_trimmed", "variance"),
    *("flip", "delta_e_itp", "mean", "energy", "width", "height", "max_depth"),
)
"""Columns of rows.csv, before those of the rays and the image."""


def write_tables(table: pd.DataFrame, output: Path) -> None:
    """Write rows.parquet with all columns, rows.csv with plain cells, and rows.json.

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
    images = [image_file(output, row) for row in table.itertuples()]
    tidy = table.rename(columns={"method": "integrator"}).assign(
        parameters=[described(dict(sorted(found.items()))) for found in parts["parameters"]],
        image=[file.name if file.exists() else "" for file in images],
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


def load(project: Project, folder: Path) -> tuple[analysis.Results, dict[str, Reference], dict[str, str]]:
    """Return the results in a folder, its references and its notes by scene.

    Rows have the seconds by which they are compared. The integrators that notes.toml lists as ``aside`` are
    not compared. Raises ``CommandError`` if there are no results, or if errors are against other references
    than the ``project``'s.
    """
    again = f"run {project.sweep_command(folder)}"
    table = _stored(folder, again)
    table = table.assign(seconds=table.apply(decided, axis=1))
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
                f"{folder}: the errors in {scene} were taken against another reference; {again}, which takes "
                "them anew"
            )
    means = {scene: kept.means for scene, kept in made.items() if kept.means is not None}
    notes = folder / "notes.toml"
    given = checked(Notes, read_toml(notes) if notes.exists() else {}, notes)
    found = analysis.Results(table, means, given.aside)
    if unknown := [name for name in given.aside if name not in found.methods]:
        raise CommandError(
            f"{notes}: {unknown[0]!r} of aside is not in the sweep: {', '.join(found.methods)}"
        )
    return found, made, given.model_extra or {}
