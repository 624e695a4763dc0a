"""The technique pyramid of a scene: the contribution of each strategy (s, t).

A row for each path length of k = 2, 3, ... edges with its k + 2 strategies (s, t), s light vertices and t
camera vertices, brightened by 2^(k-1); strategies without contribution are left out.

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
from ..files.whole import replacing
from .metrics import tone_map
from .options import VARIANT, Pyramid
from .project import Project
from .scenes import MeasuredScene, integrator_of
from .showing import amount

matplotlib.use("Agg")
import matplotlib.pyplot as plt

KINDS = ("weighted", "unweighted")

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
    """Return the nonzero `technique_images` of two or more edges.

    Raises ``CommandError`` if there are none.
    """
    found = {key: image for key, image in images.items() if key[0] >= SHORTEST and image.any()}
    if not found:
        raise CommandError(
            f"nothing to draw: no path of {SHORTEST} edges or more brings light; check the scene's lamps and "
            "sensor, or take more samples by --spp"
        )
    return found


def draw(found: dict, path: Path, exposure: float):
    """Draw the pyramid: rows of path lengths, s increasing to the right."""
    lengths = sorted({k for k, _, _ in found})
    rows = [[key for key in found if key[0] == k] for k in lengths]
    columns = max(len(row) for row in rows)
    height, width = next(iter(found.values())).shape[:2]
    panel, margin, title = 1.9, 0.5, 0.3  # inches
    high = panel * height / width + title
    wide = margin + panel * columns
    figure = plt.figure(figsize=(wide, high * len(rows)))
    for i, row in enumerate(rows):
        bottom = 1 - (i + 1) / len(rows)
        for j, (k, s, t) in enumerate(row):
            # Centred rows form the pyramid.
            left = margin + panel * (j + (columns - len(row)) / 2)
            box = (left / wide, bottom, 0.97 * panel / wide, (1 - title / high) / len(rows))
            axis = figure.add_axes(box)
            axis.imshow(tone_map(found[k, s, t], exposure + k - 1), interpolation="nearest")
            axis.set_title(f"s = {s}, t = {t}", fontsize=8, pad=2)
            axis.set_axis_off()
        text = f"k = {lengths[i]}\n{2 ** (lengths[i] - 1)}x"
        figure.text(0.05 / wide, bottom + 0.5 / len(rows), text, fontsize=8)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    plt.close(figure)


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
