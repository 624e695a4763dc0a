"""Images of integrators at equal time: images, magnified windows, error maps.

The last integrator has the given samples per pixel, the others as many as fit into its seconds. Errors are
against the project's reference, at its size and depth (made first if missing), or against a given image, at
the scene file's size and depth. Windows lie where the errors differ most.
"""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib
import mitsuba as mi
import numpy as np

from ..errors import CommandError
from ..files.images import read_layers
from ..files.loading import choose_sensor
from .figures import check_figure, save
from .making import Job, obtained
from .metrics import TRIM, rel_mse, rel_mse_epsilon, tone_map
from .options import RESOLUTION, VARIANT, EqualTime
from .project import Project
from .scenes import MeasuredScene, depth_of, integrator_of, path_tracers
from .showing import steps
from .timing import alternating, timed

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle

WINDOW = 6  # side of a window: this fraction of the image's
COLOURS = ("#E69F00", "#56B4E9")  # of the two windows
TIMED = 3  # renders for the median of times


@dataclass(frozen=True)
class Shot:
    """A render: integrator, samples per pixel, seconds, image, errors."""

    name: str
    spp: int
    seconds: float
    image: np.ndarray
    errors: np.ndarray
    rel_mse: float

    @property
    def caption(self) -> str:
        return f"{self.name}\n{self.spp} spp, {self.seconds:.2g} s\nrelMSE {self.rel_mse:.2g} (trimmed)"


def subject(project: Project, file: MeasuredScene, options: EqualTime | Namespace):
    """Return scene, reference image and ``max_depth`` of the ``options``."""
    if options.reference is None:
        seconds = options.reference_seconds
        job = Job(project, file, options.resolution or RESOLUTION, None, options.spp, seconds)
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
            count = spp if one is made[-1] else max(1, round(spp * limit / seconds(scene, one, spp)))
            seconds(scene, one, count)  # Mitsuba compiles for each number of samples
            image, taken, _ = timed(scene, one, count, seed=7)
            error = ((image - target) ** 2 / (target**2 + rel_mse_epsilon(target))).mean(axis=-1)
            found.append(Shot(name, count, taken, image, error, rel_mse(image, target, TRIM)))
    return found


def windows(found: list[Shot], shape) -> list[tuple[int, int, int]]:
    """Return two disjoint windows (left, top, side) of the largest differences.

    Compares logarithms of the first and the last image's errors, so that no single pixel decides.
    """
    height, width = shape
    side = max(4, min(height, width) // WINDOW)
    first, last = (np.log10(shot.errors + 1e-4) for shot in (found[0], found[-1]))
    sums = np.pad(np.abs(first - last).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    score = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    chosen = []
    for _ in COLOURS:
        top, left = np.unravel_index(np.argmax(score), score.shape)
        chosen.append((int(left), int(top), side))
        score[max(0, top - side) : top + side, max(0, left - side) : left + side] = -1
    return chosen


def draw(found: list[Shot], target: np.ndarray, title: str, file: Path) -> None:
    """Draw a column per image and one of the reference: image, windows, error map."""
    chosen = windows(found, target.shape[:2])
    exposure = math.log2(0.9 / max(float(np.quantile(target.max(axis=-1), 0.95)), 1e-9))
    images = [(shot.image, shot.caption, shot.errors) for shot in found] + [(target, "reference", None)]
    columns = len(images)
    figure, axes = plt.subplots(
        3, columns, figsize=(2.9 * columns, 7.3), height_ratios=(2, 1, 2), layout="constrained"
    )
    for (image, caption, errors), (top, middle, bottom) in zip(images, axes.T, strict=True):
        shown = tone_map(image, exposure)
        top.imshow(shown, interpolation="nearest")
        top.set_title(caption, fontsize=9)
        for (left, up, side), colour in zip(chosen, COLOURS, strict=True):
            top.add_patch(
                Rectangle((left, up), side, side, edgecolor=colour, facecolor="none", linewidth=1.5)
            )
        parts = [shown[up : up + side, left : left + side] for left, up, side in chosen]
        gap = np.ones((parts[0].shape[0], 1, 3))
        middle.imshow(np.concatenate([parts[0], gap, parts[1]], axis=1), interpolation="nearest")
        if errors is not None:
            drawn = bottom.imshow(np.maximum(errors, 1e-6), norm=LogNorm(1e-5, 10), cmap="viridis")
    bar = figure.colorbar(drawn, ax=axes[2, -1], location="left", fraction=0.3)
    bar.set_label("squared relative error", fontsize=8)
    for axis in axes.flat:
        axis.set_axis_off()
    figure.suptitle(title, fontsize=11)
    save(figure, file)


def pictured(
    project: Project, scene: str, integrators: Mapping[str, dict], options: EqualTime | Namespace
) -> tuple[Path, list[Shot]]:
    """Draw a scene rendered by these integrators; returns the file and the renders."""
    file = project.scene(scene)
    output = options.output or project.renders / f"equal_time_{file.name}.png"
    check_figure(output)
    loaded, target, depth = subject(project, file, options)
    ways = dict(integrators) or {kind: {"type": kind} for kind in (path_tracers(file.has_media)[0], "bdpt")}
    found = shots(loaded, target, ways, depth, options.spp)
    draw(found, target, f"{file.name}, equal time", output)
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
