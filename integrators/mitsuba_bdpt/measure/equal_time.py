"""Images of integrators at equal time: images, magnified windows, error maps.

The last integrator has the given samples per pixel, the others as many as fit into its seconds. Errors are
against the project's reference, at its size and depth (made first if missing), or against a given image, at
the scene file's size and depth. Windows lie where the errors differ most.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pandas as pd

from ..errors import CommandError
from ..files.images import read_layers
from ..files.loading import choose_sensor
from . import crops
from .crops import Shot
from .estimates import RelativeError, mean_of, relative_error
from .making import Job, fitted, obtained
from .metrics import TRIM, rel_mse
from .options import RESOLUTION, VARIANT, EqualTime
from .paper import check_figure
from .project import Project
from .results import rel_mse_columns
from .scenes import SceneFile, depth_of, integrator_of, path_tracers, samples_taken
from .showing import steps
from .timing import alternating, timed

TIMED = 3  # renders for the median of times
MATCHED, CLOSE = 3, 0.05  # times that samples are matched at most, and difference of times that is left


@dataclass(frozen=True)
class Subject:
    """Scene, reference image, ``max_depth``, and error against the reference."""

    scene: Any
    target: np.ndarray
    depth: int
    error: Callable[[np.ndarray], RelativeError]


def subject(project: Project, file: SceneFile, options: EqualTime | Namespace) -> Subject:
    if options.reference is None:
        seconds = options.reference_seconds
        width = fitted(file, options.resolution or RESOLUTION)
        job = Job(project, file, width, None, options.spp, seconds)
        kept = obtained(job)
        scene = file.load(job.resolution, options.sampler)

        def error(image: np.ndarray) -> RelativeError:
            row = pd.DataFrame([rel_mse_columns(image, kept)])
            return relative_error(row, "rel_mse_trimmed", differs=False)

        return Subject(scene, kept.image, job.depth, error)
    (target,), _ = read_layers(options.reference, "")
    scene = file.load(options.resolution, options.sampler)
    width, height = (int(n) for n in choose_sensor(scene, 0).film().crop_size())
    if target.shape[:2] != (height, width):
        raise CommandError(
            f"reference={str(options.reference)!r} has {target.shape[1]} x {target.shape[0]} pixels, the "
            f"film of {str(file.file)!r} {width} x {height}; render it from this scene"
        )

    def bound(image: np.ndarray) -> RelativeError:  # of an image, whose own error is unknown
        return RelativeError(mean_of([rel_mse(image, target, TRIM)]), "≤", 1)

    return Subject(scene, target, depth_of(scene.integrator()), bound)


def seconds(scene, made, spp: int) -> float:
    """Return the median seconds of renders after a warm-up, which compiles."""
    turns = alternating([partial(timed, scene, made, spp)], TIMED)
    return float(np.median([found.seconds for (found,) in turns]))


def _samples_within(limit: float, scene, made, spp: int) -> int:
    """Return the samples per pixel that an integrator renders in ``limit`` seconds.

    In proportion to those of ``spp``, then anew from what these took, since a part of the time is fixed. The
    last render is of these samples, for which Mitsuba compiles.
    """
    count = samples_taken(scene, made, spp)
    taken = seconds(scene, made, count)
    for _ in range(MATCHED):
        if abs(taken / limit - 1) <= CLOSE:
            break
        count = samples_taken(scene, made, max(1, round(count * limit / taken)))
        taken = seconds(scene, made, count)
    return count


def shots(given: Subject, ways: dict[str, dict], spp: int) -> list[Shot]:
    """Render with each integrator in the time of the last one.

    ``ways``: parameters of plugins by caption. The last has ``spp`` samples per pixel, others as many as fit.
    """
    scene, made = given.scene, [integrator_of(parameters, given.depth) for parameters in ways.values()]
    with steps(1 + len(made)) as step:
        step(list(ways)[-1])
        spp = samples_taken(scene, made[-1], spp)
        limit, found = seconds(scene, made[-1], spp), []
        for name, one in zip(ways, made, strict=True):
            step(name)
            count = spp if one is made[-1] else _samples_within(limit, scene, one, spp)
            image, taken, _ = timed(scene, one, count, seed=7)
            found.append(Shot(name, count, taken, image, given.error(image)))
    return found


def pictured(
    project: Project, scene: str, integrators: Mapping[str, dict], options: EqualTime | Namespace
) -> tuple[Path, list[Shot]]:
    file = project.scene(scene)
    output = options.output or project.renders / f"equal_time_{file.name}.png"
    check_figure(output)
    places = crops.centres(options.windows)
    given = subject(project, file, options)
    ways = dict(integrators) or {kind: {"type": kind} for kind in (path_tracers(file.has_media)[0], "bdpt")}
    found = shots(given, ways, options.spp)
    crops.draw([crops.Block(file.name, found, given.target)], output, options.columns, places)
    return output, found


def run(options: Namespace) -> int:
    mi.set_variant(VARIANT)
    integrators = dict(options.integrators)
    output, found = pictured(Project(options.project), options.scene, integrators, options)
    print(output)
    for shot in found:
        print(shot.caption.replace("\n", ", "))
    return 0
