"""Images of integrators at equal time: images, magnified windows, error maps.

The last integrator has the given samples per pixel, the others as many as fit into its seconds. Errors are
against the project's reference, at its size and depth (made first if missing), or against a given image, at
the scene file's size and depth. Windows lie where the errors differ most.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import CommandError
from ..files.images import read_layers
from ..files.loading import choose_sensor
from . import crops
from .making import Job, fitted, obtained
from .metrics import TRIM, rel_mse
from .options import RESOLUTION, VARIANT, EqualTime
from .paper import check_figure
from .project import Project
from .scenes import MeasuredScene, depth_of, integrator_of, path_tracers
from .showing import steps
from .timing import alternating, timed

TIMED = 3  # renders for the median of times
MATCHED, CLOSE = 3, 0.05  # times that samples are matched at most, and difference of times that is left


@dataclass(frozen=True)
class Shot:
    """A render: integrator, samples per pixel, seconds, image, trimmed relMSE."""

    name: str
    spp: int
    seconds: float
    image: np.ndarray
    rel_mse: float

    @property
    def caption(self) -> str:
        return f"{self.name}\n{self.spp} spp, {self.seconds:.2g} s\nrelMSE {self.rel_mse:.2g} (trimmed)"


def subject(project: Project, file: MeasuredScene, options: EqualTime | Namespace):
    """Return scene, reference image and ``max_depth`` of the ``options``."""
    if options.reference is None:
        seconds = options.reference_seconds
        width = fitted(file, options.resolution or RESOLUTION)
        job = Job(project, file, width, None, options.spp, seconds)
        target = obtained(job).image
        return file.load(job.resolution, options.sampler), target, job.depth
    (target,), _ = read_layers(options.reference, "")
    scene = file.load(options.resolution, options.sampler)
    width, height = (int(n) for n in choose_sensor(scene, 0).film().crop_size())
    if target.shape[:2] != (height, width):
        raise CommandError(
            f"reference={str(options.reference)!r} has {target.shape[1]} x {target.shape[0]} pixels, the "
            f"film of {file.called} {width} x {height}; render it from this scene"
        )
    return scene, target, depth_of(scene.integrator())


def seconds(scene, made, spp: int) -> float:
    """Return the median seconds of renders after a warm-up, which compiles."""
    turns = alternating([partial(timed, scene, made, spp)], TIMED)
    return float(np.median([found.seconds for (found,) in turns]))


def _samples_within(limit: float, scene, made, spp: int) -> int:
    """Return the samples per pixel that an integrator renders in ``limit`` seconds.

    In proportion to those of ``spp``, then anew from what these took, since a part of the time is fixed. The
    last render is of these samples, for which Mitsuba compiles.
    """
    count, taken = spp, seconds(scene, made, spp)
    for _ in range(MATCHED):
        if abs(taken / limit - 1) <= CLOSE:
            break
        count = max(1, round(count * limit / taken))
        taken = seconds(scene, made, count)
    return count


def shots(scene, target: np.ndarray, ways: dict[str, dict], depth: int, spp: int) -> list[Shot]:
    """Render with each integrator in the time of the last one.

    ``ways``: parameters of plugins by caption. The last has ``spp`` samples per pixel, others as many as fit.
    """
    made = [integrator_of(parameters, depth) for parameters in ways.values()]
    with steps(1 + len(made)) as step:
        step(list(ways)[-1])
        limit, found = seconds(scene, made[-1], spp), []
        for name, one in zip(ways, made, strict=True):
            step(name)
            count = spp if one is made[-1] else _samples_within(limit, scene, one, spp)
            image, taken, _ = timed(scene, one, count, seed=7)
            found.append(Shot(name, count, taken, image, rel_mse(image, target, TRIM)))
    return found


def pictured(
    project: Project, scene: str, integrators: Mapping[str, dict], options: EqualTime | Namespace
) -> tuple[Path, list[Shot]]:
    """Draw a scene rendered by these integrators; returns the file and the renders."""
    file = project.scene(scene)
    output = options.output or project.renders / f"equal_time_{file.name}.png"
    check_figure(output)
    places = crops.centres(options.windows)
    loaded, target, depth = subject(project, file, options)
    ways = dict(integrators) or {kind: {"type": kind} for kind in (path_tracers(file.has_media)[0], "bdpt")}
    found = shots(loaded, target, ways, depth, options.spp)
    columns = [crops.judged(shot.name, shot.spp, shot.seconds, shot.image, target) for shot in found]
    crops.draw([crops.Block(file.name, tuple(columns), target)], output, options.columns, places)
    return output, found


def run(options: Namespace) -> int:
    """Draw the images that the command-line ``options`` request."""
    mi.set_variant(VARIANT)
    integrators = dict(options.integrators)
    output, found = pictured(Project(options.project), options.scene, integrators, options)
    print(output)
    for shot in found:
        print(shot.caption.replace("\n", ", "))
    return 0
