"""The technique pyramid of a scene: the contribution of each strategy (s, t).

A row for each path length of k = 2, 3, ... edges with its k + 2 strategies (s, t), s light vertices and t
camera vertices, brightened by 2^(k-1). Strategies that are impossible or bring no light are empty frames.

``-o NAME.exr`` writes that file with the image and the layers ``weighted.s{S}t{T}.R`` ... and
``unweighted.s{S}t{T}.R`` ..., the image NAME.png, and the pyramids NAME_weighted.png, whose sum is the image,
and NAME_unweighted.png, in which each panel is an estimate by itself.
"""

from __future__ import annotations

import re
from argparse import Namespace
from pathlib import Path

import matplotlib
import mitsuba as mi
import numpy as np

from ..errors import CommandError
from ..files.images import check_channels, check_output, write_images
from ..files.loading import choose_sensor
from .figures import PAPER, WIDTHS, save
from .metrics import tone_map
from .options import VARIANT, Pyramid
from .project import Project
from .scenes import MeasuredScene, integrator_of
from .showing import amount

matplotlib.use("Agg")
import matplotlib.pyplot as plt

KINDS = ("weighted", "unweighted")

WIDTH = WIDTHS[2]
TITLE, EDGE = 0.2, 0.04  # inches over a panel, and under the last

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


def render(file: MeasuredScene, options: Pyramid | Namespace):
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
    """Return the `technique_images` of two or more edges, None for strategies without contribution.

    Raises ``CommandError`` if none contributes.
    """
    found = {key: image if image.any() else None for key, image in images.items() if key[0] >= SHORTEST}
    if all(image is None for image in found.values()):
        raise CommandError(
            f"nothing to draw: no path of {SHORTEST} edges or more brings light; check the scene's lamps and "
            "sensor, or take more samples by --spp"
        )
    return found


def draw(found: dict, path: Path, exposure: float):
    """Draw the pyramid: a row per path length k, the strategies s = 0 ... k + 1 from left to right.

    Rows are centred. Strategies that are impossible or bring no light are empty frames. Rows below the last
    with light are left out.
    """
    shape = next(image.shape for image in found.values() if image is not None)
    longest = max(k for (k, _, _), image in found.items() if image is not None)
    lengths = range(SHORTEST, longest + 1)
    margin, panel = 0.5, (WIDTH - 0.5) / (longest + 2)  # inches
    high = panel * shape[0] / shape[1] + TITLE
    wide, tall = WIDTH, high * len(lengths) + EDGE
    with plt.rc_context(PAPER):
        figure = plt.figure(figsize=(wide, tall))
        for row, k in enumerate(lengths):
            bottom = tall - (row + 1) * high
            for s in range(k + 2):
                left = margin + panel * (s + (longest - k) / 2)
                size = 0.97 * panel / wide, (high - TITLE) / tall
                axis = figure.add_axes((left / wide, bottom / tall, *size))
                axis.set_title(f"$s={s}$, $t={k + 1 - s}$", fontsize=min(7, 9 * panel), pad=2)
                axis.set(xticks=[], yticks=[])
                if (image := found.get((k, s, k + 1 - s))) is None:
                    for side in axis.spines.values():
                        side.set(color="#bbbbbb", linestyle=(0, (3, 3)))
                else:
                    axis.imshow(tone_map(image, exposure + k - 1), interpolation="nearest", aspect="auto")
                    axis.set_axis_off()
            text = f"$k={k}$\n{2 ** (k - 1)}x"
            figure.text(0.02 / wide, (bottom + (high - TITLE) / 2) / tall, text, va="center")
        save(figure, path)


def pictured(
    project: Project, scene: str, options: Pyramid | Namespace
) -> tuple[dict[str, Path], dict[str, dict]]:
    """Render and write a scene's pyramids; returns files, and images by kind."""
    if options.max_depth < SHORTEST:
        raise CommandError(f"max_depth={options.max_depth} has no strategies to show; use {SHORTEST} or more")
    file = project.scene(scene)
    image = options.output or project.renders / f"pyramid_{file.name}.exr"
    pictures = {kind: image.with_name(f"{image.stem}_{kind}.png") for kind in KINDS}
    check_output(image, ".exr")
    for path in pictures.values():
        check_output(path, ".png")
    film, images = render(file, options)
    shown = {kind: panels(images[kind]) for kind in KINDS}
    write_images(film, image, {"heuristic": options.heuristic}, options.exposure)
    for kind, path in pictures.items():
        draw(shown[kind], path, options.exposure)
    return pictures, images


def run(options: Namespace) -> int:
    """Render and write the pyramids that the command-line ``options`` request."""
    mi.set_variant(VARIANT)
    pictures, _ = pictured(Project(options.project), options.scene, options)
    print(*pictures.values(), sep="\n")
    return 0
