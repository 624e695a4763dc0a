"""The technique pyramid of a scene: what each strategy (s, t) makes of it.

A row for each path length of k = 2, 3, ... edges with the k + 2 ways (s, t) to make such paths, s light
vertices and t camera vertices, brightened by 2^(k-1); strategies that contribute nothing are left out.

Written are OUTPUT.exr, with the image and the layers ``weighted.s{S}t{T}.R`` ... and
``unweighted.s{S}t{T}.R`` ..., OUTPUT.png, the image, and the pyramids OUTPUT_weighted.png, which adds up to
the image, and OUTPUT_unweighted.png, in which each panel is an estimate by itself.
"""

from __future__ import annotations

import re
from argparse import Namespace
from pathlib import Path

import matplotlib
import mitsuba as mi
import numpy as np

from ..errors import CommandError
from ..files.images import check_output, write_images
from .metrics import tone_map
from .project import Project
from .scenes import SceneFile, integrator_of

matplotlib.use("Agg")
import matplotlib.pyplot as plt

KINDS = ("weighted", "unweighted")

SHORTEST = 2  # edges: of single ones the emitters themselves are seen


def technique_images(image, names: list, kind: str) -> dict:
    """``weighted`` or ``unweighted`` images of the strategies by ``(k, s, t)``.

    They have the shape of ``image`` (..., 3), and come out of a render whose last channels have these
    ``names``.
    """
    first = image.shape[-1] - len(names)
    found = {}
    for i, name in enumerate(names):
        if match := re.fullmatch(rf"{kind}\.s(\d+)t(\d+)\.R", name):
            s, t = int(match[1]), int(match[2])
            found[s + t - 1, s, t] = image[..., first + i : first + i + 3]
    return found


def render(file: SceneFile, options: Namespace):
    """The film after a render with technique images, and these, weighted and unweighted."""
    scene = file.load(options.resolution)
    parameters = {"type": "bdpt", "strategy_images": True, "heuristic": options.heuristic}
    integrator = integrator_of(parameters, options.max_depth)
    image = np.array(integrator.render(scene, spp=options.spp, seed=options.seed))
    names = integrator.aov_names()
    return scene.sensors()[0].film(), {kind: technique_images(image, names, kind) for kind in KINDS}


def panels(images: dict) -> dict:
    """Those `technique_images` to which anything contributes, but for single edges."""
    return {key: image for key, image in images.items() if key[0] >= SHORTEST and image.any()}


def draw(found: dict, path: Path, exposure: float):
    """Draw the pyramid as a picture: rows of path lengths, s rising to the right.

    Raises ``CommandError`` if no strategy contributes.
    """
    if not found:
        raise CommandError(
            f"nothing to draw in {path.name}: no path of {SHORTEST} edges or more brings light"
        )
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
            # Rows are centred, which makes the pyramid.
            left = margin + panel * (j + (columns - len(row)) / 2)
            box = (left / wide, bottom, 0.97 * panel / wide, (1 - title / high) / len(rows))
            axis = figure.add_axes(box)
            axis.imshow(tone_map(found[k, s, t], exposure + k - 1), interpolation="nearest")
            axis.set_title(f"s = {s}, t = {t}", fontsize=8, pad=2)
            axis.set_axis_off()
        text = f"k = {lengths[i]}\n{2 ** (lengths[i] - 1)}x"
        figure.text(0.05 / wide, bottom + 0.5 / len(rows), text, fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def run(options: Namespace) -> int:
    """Render, write, say what was written, as the command line ``options`` say."""
    if options.max_depth < SHORTEST:
        raise CommandError(f"max_depth={options.max_depth} has no strategies to show; use {SHORTEST} or more")
    mi.set_variant("llvm_ad_rgb")
    project = Project(options.project)
    file = project.scene(options.scene)
    output = options.output.with_suffix("") if options.output else project.renders / f"pyramid_{file.name}"
    image = output.with_name(f"{output.name}.exr")
    pictures = {kind: output.with_name(f"{output.name}_{kind}.png") for kind in KINDS}
    for path in (image, *pictures.values()):
        check_output(path, path.suffix)
    film, images = render(file, options)
    write_images(film, image, {"heuristic": options.heuristic}, options.exposure)
    for kind, path in pictures.items():
        draw(panels(images[kind]), path, options.exposure)
        print(path)
    return 0
