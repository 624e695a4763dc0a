"""Stored reference images, with an estimate of their own error.

Files lie in the project's references/: EXR in half precision with the image (R, G, B), half the difference of
two halves of its samples (difference.R ...), a sample of its own error, and the provenance as JSON in the
header, with the data of bias checks. `making` makes them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CommandError
from ..files.images import attribute, read_layers, write_layers
from .agreement import Means, Sample
from .metrics import rel_mse
from .options import REFERENCE_SECONDS
from .project import Project
from .scenes import SceneFile, digest

HALF_MAX = 65504.0  # the largest number in half precision
PACKAGE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Reference:
    """A reference image, its error, and its provenance.

    ``image`` and ``difference`` (height, width, 3), half the difference of the halves; ``means`` for bias
    checks, None if too few renders made it.
    """

    image: np.ndarray
    difference: np.ndarray
    means: Means | None
    provenance: dict[str, Any]

    @property
    def error(self) -> float:
        """The reference's own relMSE."""
        return rel_mse(self.image + self.difference, self.image)

    @property
    def merged(self) -> bool:
        """Whether it contains light that only `merging` samples, slightly blurred."""
        made_by = self.provenance["integrator"]
        return not isinstance(made_by, str) and bool(made_by.get("merging"))


def reference_path(project: Project, name: str, resolution: int, max_depth: int) -> Path:
    return project.references / f"{name}_{resolution}_{max_depth}.exr"


def make_command(project: Project, scene: SceneFile, resolution: int, max_depth: int, *more: str) -> str:
    """Return the command that makes or refines a reference; ``more``: options."""
    known = project.scenes / f"{scene.name}.xml"
    words = scene.name if scene.file == known else scene.file, "--resolution", str(resolution)
    words = *words, "--max-depth", str(max_depth), *more, "--seconds", f"{REFERENCE_SECONDS:g}"
    return project.command("reference", *words)


def load_reference(project: Project, scene: SceneFile, resolution: int, max_depth: int) -> Reference:
    """Return the stored reference.

    Raises ``CommandError``, with the command that makes it, if it is missing or of another scene file.
    """
    path = reference_path(project, scene.name, resolution, max_depth)
    make = make_command(project, scene, resolution, max_depth)
    if not path.is_file():
        raise CommandError(
            f"no reference for scene={scene.name!r} at {resolution} and depth {max_depth}; {make}"
        )
    try:
        found = read_reference(path)
    except CommandError as error:
        raise CommandError(f"{error}, by {make}") from error
    if found.provenance["scene_sha256"] != scene.sha256:
        raise CommandError(
            f"the reference {path.name} was made of another {scene.name}, mesh or texture; {make}"
        )
    return found


def header_of(path: Path) -> dict[str, Any]:
    """Return the provenance of a reference; empty if the file is missing or none."""
    try:
        return json.loads(attribute(path, "provenance") or "{}")
    except ValueError:
        return {}


def read_reference(path: Path) -> Reference:
    """Read a reference from a file; raises ``CommandError`` if it is none."""
    (image, difference), header = read_layers(path, "", "difference.")
    try:
        provenance = json.loads(header["provenance"])
        means = means_of(provenance["means"])
    except (KeyError, TypeError, ValueError) as error:
        raise CommandError(
            f"{str(path)!r} is no reference: it does not say what made it; delete it, to make it anew"
        ) from error
    return Reference(image, difference, means, provenance)


def write(path: Path, reference: Reference):
    brightest = float(reference.image.max())
    if brightest > HALF_MAX:
        raise CommandError(
            f"{path.name}: radiance {brightest:g} does not fit into half precision; scale the lamps"
        )
    layers = {"": reference.image, "difference.": reference.difference}
    header = reference.provenance | {"rel_mse": reference.error, "means": kept_of(reference.means)}
    write_layers(path, layers, {"provenance": json.dumps(header)}, np.float16)


def means_of(kept: Any) -> Means | None:
    """Return the `Means` in a provenance; freedom is infinite for exact images."""
    if kept is None:
        return None

    def sample(of: dict[str, Any]) -> Sample:
        mean, error, nonzero = (np.array(of[key]) for key in ("mean", "error", "nonzero"))
        return Sample(mean, error, np.inf if of["freedom"] is None else of["freedom"], nonzero)

    return Means(**{name: sample(of) for name, of in kept.items()})


def kept_of(means: Means | None) -> dict[str, Any] | None:
    """Inverse of `means_of`, for JSON."""

    def plain(of: Sample) -> dict[str, Any]:
        values = {"mean": of.mean, "error": of.error, "nonzero": of.nonzero}
        rounded = {key: [float(f"{x:.9g}") for x in found] for key, found in values.items()}
        return rounded | {"freedom": None if np.isinf(of.freedom) else of.freedom}

    return means and {"columns": plain(means.columns), "whole": plain(means.whole)}


def source_digest() -> str:
    """Return a shortened SHA-256 of the package's source files."""
    others = (PACKAGE / "cli", PACKAGE / "measure")
    files = sorted(PACKAGE.rglob("*.py"))
    return digest(*(file for file in files if not any(map(file.is_relative_to, others))))[:12]
