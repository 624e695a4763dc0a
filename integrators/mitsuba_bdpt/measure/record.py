"""The record of a render: what sweeps keep, and all figures are made of."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

Error = Literal["rel_mse", "rel_mse_trimmed"]
"""Columns of measured errors, of which `estimates` makes the errors of reports."""


class Errors(TypedDict):
    """The error of an image, raw and trimmed of the worst 0.1 % of values."""

    rel_mse: float
    rel_mse_trimmed: float
    reference_rel_mse: float  # what the reference's own error adds to them
    reference_rel_mse_trimmed: float
    variance: NotRequired[float | None]  # relMSE to the mean over seeds, without bias, `metrics.spread`


class Measured(Errors):
    """What a render took and how wrong it is, with one seed."""

    seed: int
    seconds: float
    cpu_seconds: NotRequired[float]  # missing in older sweeps


class Row(Measured):
    """A render of a sweep: a row of rows.parquet.

    Beside these columns ``rays_KIND``, the rays of `bdpt` by kind.
    """

    key: str  # names the cell's files
    scene: str
    method: str  # name of the integrator, with its parameters
    spp: int  # samples per pixel that it took
    scene_sha256: str
    resolution: int
    max_depth: int
    sampler: str  # of `bdpt` its points
    match: str  # "spp" or "seconds": what is equal to the first integrator's
    equal_time_spp: NotRequired[int | None]  # budget of equal seconds; missing in older sweeps
    clock: NotRequired[str]  # "wall" or "processor": the seconds that decide; missing in older sweeps
    budget: int  # samples per pixel of the first integrator
    first: str  # the integrator that the others are compared with
    parameters: str  # of the plugin, as JSON
    statistics: str  # of `bdpt`, as JSON
    decisions: str  # of `bdpt`, as JSON
    machine: str
    versions: str  # as JSON
    started: str
    seconds_compile: float
    seconds_pilot: float | None  # missing in older sweeps
    seconds_first_image: NotRequired[float | None]  # median, without kernel cache; if the preset asks for it
    reference_sha256: str
    width: int
    height: int
    mean: float
    energy: NotRequired[float]  # mean over that of the reference; missing in older sweeps
    tile_means: list[float]  # `agreement.tile_columns`
    mse: float
    rel_mse_epsilon: float
    mape: float
    flip: float | None  # of the first seed
    delta_e_itp: float
