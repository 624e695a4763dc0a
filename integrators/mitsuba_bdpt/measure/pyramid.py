"""The technique pyramid of a scene: the contribution of each strategy (s, t).

A row for each path length of k = 2, 3, ... edges with its k + 2 strategies (s, t), s light vertices and t
camera vertices, brightened by 2^(k-1). Strategies that are impossible or bring no light are empty frames.

``-o NAME.exr`` writes that file with the image and the layers ``weighted.s{S}t{T}.R`` ... and
``unweighted.s{S}t{T}.R`` ..., the image NAME.png, and the pyramids NAME_weighted.png, whose sum is the image,
and NAME_unweighted.png, in which each panel is an estimate by itself; ``-o NAME.pdf`` the same with the
pyramids as PDF.
"""

from __future__ import annotations

import re
from argparse import Namespace
from pathlib import Path

import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

from ..errors import CommandError, FailureError
from ..files.images import check_channels, check_output, write_images
from ..files.loading import choose_sensor
from .metrics import tone_map
from .options import FIGURE_FORMATS, VARIANT, Pyramid
from .paper import PAPER, WIDTHS, check_figure, save
from .project import Project
from .scenes import SceneFile, integrator_of
from .showing import amount

KINDS = ("weighted", "unweighted")

MARGIN = {1: 0.33, 2: 0.5}  # inches left of the panels, by columns of a page
TITLE, EDGE = 0.17, 0.04  # inches over a panel, and under the last
SHORT = 0.6  # inches of a panel below which its title has the numbers alone

SHORTEST = 2  # edges: single ones show the emitters only


def technique_images(image, names: list, kind: str) -> dict:
    """Return ``weighted`` or ``unweighted`` images of the strategies by ``(k, s, t)``.

    Of shape ``image`` (..., 3), from a render whose last channels have ``names``.
    """
    first = image.shape[-1] - len(names)
    found = {}
    for i, name in enumerate(names):
        if match := re.fullmatch(rf"{kind}\.s(\d+)t(\d+)\.R", name):
            s, t = int(match[1]), int(match[2])
            found[s + t - 1, s, t] = image[..., first + i : first + i + 3]
    return found


def render(file: SceneFile, options: Pyramid | Namespace):
    """Return the film after a render, and technique images, weighted and unweighted."""
    scene = file.load(options.resolution)
    parameters = {"type": "bdpt", "layers": "strategies", "heuristic": options.heuristic}
    integrator = integrator_of(parameters, options.max_depth)
    check_channels(choose_sensor(scene, 0).film(), integrator.aov_names())
    with amount(f"{file.name}: samples per pixel", options.spp) as show:
        integrator.on_pass = lambda report: show(report.spp_done)
        image = np.array(integrator.render(scene, spp=options.spp, seed=options.seed))
    names = integrator.aov_names()
    return scene.sensors()[0].film(), {kind: technique_images(image, names, kind) for kind in KINDS}


def panels(images: dict) -> dict:
    """Return the `technique_images` of two or more edges, None where they are black.

    Raises ``CommandError`` if all are.
    """
    found = {key: image if image.any() else None for key, image in images.items() if key[0] >= SHORTEST}
    if all(image is None for image in found.values()):
        raise CommandError(
            f"nothing to draw: no path of {SHORTEST} edges or more brings light; check the scene's lamps and "
            "sensor, or take more samples by --spp"
        )
    return found


def draw(found: dict, path: Path, exposure: float, columns: int = 2):
    """Draw the pyramid: a row per path length k, strategies s = 0 ... k + 1.

    Rows are centred. Strategies that are impossible or bring no light are empty frames. Rows below the last
    with light are left out; those without any are not labelled as brightened. ``columns``: width, in columns
    of a page.
    """
    shape = next(image.shape for image in found.values() if image is not None)
    longest = max(k for (k, _, _), image in found.items() if image is not None)
    lengths = range(SHORTEST, longest + 1)
    wide, margin = WIDTHS[columns], MARGIN[columns]  # inches
    panel = (wide - margin) / (longest + 2)
    high = panel * shape[0] / shape[1] + TITLE
    tall = high * len(lengths) + EDGE
    with plt.rc_context(PAPER):
        figure = plt.figure(figsize=(wide, tall))
        if panel < SHORT:
            figure.text(0.02 / wide, 1 - 0.02 / tall, "$s$, $t$:", va="top", fontsize=6)
        for row, k in enumerate(lengths):
            bottom = tall - (row + 1) * high
            for s in range(k + 2):
                left = margin + panel * (s + (longest - k) / 2)
                size = 0.97 * panel / wide, (high - TITLE) / tall
                axis = figure.add_axes((left / wide, bottom / tall, *size))
                named = f"{s}, {k + 1 - s}" if panel < SHORT else f"$s={s}$, $t={k + 1 - s}$"
                axis.set_title(named, fontsize=6 if panel < SHORT else 7, pad=2)
                axis.set(xticks=[], yticks=[])
                if (image := found.get((k, s, k + 1 - s))) is None:
                    for side in axis.spines.values():
                        side.set(color="#bbbbbb", linestyle=(0, (3, 3)))
                else:
                    axis.imshow(tone_map(image, exposure + k - 1), interpolation="nearest", aspect="auto")
                    axis.set_axis_off()
            has_image = any(found.get((k, s, k + 1 - s)) is not None for s in range(k + 2))
            text = f"$k={k}$\n{2 ** (k - 1)}x" if has_image else f"$k={k}$"
            figure.text(0.02 / wide, (bottom + (high - TITLE) / 2) / tall, text, va="center")
        save(figure, path)


def pictured(
    project: Project, scene: str, options: Pyramid | Namespace
) -> tuple[dict[str, Path], dict[str, dict]]:
    if options.max_depth < SHORTEST:
        raise CommandError(f"max_depth={options.max_depth} has no strategies to show; use {SHORTEST} or more")
    file = project.scene(scene)
    output = options.output or project.renders / f"pyramid_{file.name}.exr"
    is_figure = output.suffix.lower() in FIGURE_FORMATS
    image, ending = (output.with_suffix(".exr"), output.suffix) if is_figure else (output, ".png")
    pictures = {kind: image.with_name(f"{image.stem}_{kind}{ending}") for kind in KINDS}
    check_output(image, ".exr")
    for path in pictures.values():
        check_figure(path)
    film, images = render(file, options)
    shown = {kind: panels(images[kind]) for kind in KINDS}
    if why := write_images(film, image, {"heuristic": options.heuristic}, options.exposure):
        raise FailureError(why)
    for kind, path in pictures.items():
        draw(shown[kind], path, options.exposure, options.columns)
    return pictures, images


def run(options: Namespace) -> int:
    mi.set_variant(VARIANT)
    pictures, _ = pictured(Project(options.project), options.scene, options)
    print(*pictures.values(), sep="\n")
    return 0
