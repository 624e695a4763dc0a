"""References given as images: of other programs, any size, unknown error.

An image is averaged down to the size of the measurement, and stored as the project's reference. It may differ
from the scene by noise, filter, depth or lighting; the renders that it judges estimate its error:
`own_error`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CommandError
from ..files.images import read_layers
from .estimates import OWN
from .making import Job, check_size, provenance_of
from .metrics import TRIM, rel_mse_epsilon
from .reference import Reference, load_reference, reference_path, write
from .scenes import digest

TRIMS = {"rel_mse": 0.0, "rel_mse_trimmed": TRIM}
"""Errors of a row, and the share of the largest values that each leaves out."""


def adopt(job: Job, file: Path) -> Reference:
    """Store the image of an EXR ``file`` as the reference of a job's scene.

    Raises ``CommandError`` if it is smaller than the measurement, of another shape, or not finite.
    """
    check_size(job)
    sha256, stored = digest(file), job.stored
    if stored is not None and stored.provenance.get("given_sha256") == sha256:
        return stored
    (image,), _ = read_layers(file, "")
    width, height = job.scene.size(job.resolution)
    own_height, own_width = image.shape[:2]
    if own_width < width or own_height < height:
        raise CommandError(
            f"reference={str(file)!r} has {own_width} x {own_height} pixels, less than the {width} x "
            f"{height} that are measured; take a smaller resolution, or leave it out"
        )
    if abs(own_height * width / own_width - height) > 1:
        raise CommandError(
            f"reference={str(file)!r} has {own_width} x {own_height} pixels, the film of the scene another "
            "shape; give an image of the whole film, or leave it out"
        )
    if not np.isfinite(image).all():
        raise CommandError(f"reference={str(file)!r} has values that are not finite; leave it out")
    image = reduced(image, width, height)
    words = {"integrator": f"given: {file.name}", "given": str(file), "given_sha256": sha256}
    path = reference_path(job.project, job.scene.name, job.resolution, job.depth)
    write(path, Reference(image, np.zeros_like(image), None, provenance_of(job, **words)))
    return load_reference(job.project, job.scene, job.resolution, job.depth)


def forget(job: Job) -> None:
    """Remove a given image from the project's references, so that one can be rendered."""
    stored = job.stored
    if stored is not None and stored.given:
        reference_path(job.project, job.scene.name, job.resolution, job.depth).unlink()


def reduced(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Reduce an image by area averages; old pixels count by their covered part."""
    rows, columns = _coverage(image.shape[0], height), _coverage(image.shape[1], width)
    return np.einsum("yv,vuc,xu->yxc", rows, image, columns, optimize=True)


def _coverage(old: int, new: int) -> np.ndarray:
    """Weights (new, old) of averages along one side."""
    edges = np.arange(new + 1) * old / new
    low, high = (np.clip(edges[part, None] - np.arange(old), 0, 1) for part in (slice(-1), slice(1, None)))
    return (high - low) * new / old


def own_errors(image: np.ndarray, renders: Sequence[np.ndarray]) -> dict[str, float]:
    """Return `own_error` for each error of a row, by the names in `estimates.OWN`."""
    return {error: own_error(image, renders, trim) for error, trim in TRIMS.items()}


def own_error(image: np.ndarray, renders: Sequence[np.ndarray], trim: float) -> float:
    """Estimate the relMSE of ``image`` from independent unbiased ``renders``.

    The mean of (r - a)(r - b) / (r^2 + eps), a and b the means of every other render: their noise is
    independent, so only the error of r remains. Excludes the share ``trim`` of the largest products; not
    negative.
    """
    a, b = (np.mean(renders[start::2], axis=0) for start in (0, 1))
    products = ((image - a) * (image - b) / (image**2 + rel_mse_epsilon(image))).ravel()
    kept = np.argsort(np.abs(products))[: len(products) - round(trim * len(products))]
    return max(float(products[kept].mean()), 0.0)


def with_own_errors(rows: list[dict[str, Any]], own: dict[str, float]) -> list[dict[str, Any]]:
    """Return the ``rows`` of a scene with its reference's `own_errors` filled in."""
    known = {name: own[error] for error, name in OWN.items()}
    return [row | known for row in rows]
