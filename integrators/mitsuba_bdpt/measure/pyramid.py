"""The technique pyramid of a scene: what each strategy (s, t) makes of it.

    python scripts/strategies.py veach_bidir -o renders/pyramid
    python scripts/strategies.py scenes/pool.xml --max-depth 4 --spp 256 -o renders/pool

A row for each path length of k = 2, 3, ... edges with the k + 2 ways (s, t) to make such paths, s light
vertices and t camera vertices, brightened by 2^(k-1); strategies that contribute nothing are left out.

Written are OUTPUT.exr, with the image and the layers ``weighted.s{S}t{T}.R`` ... and
``unweighted.s{S}t{T}.R`` ..., OUTPUT.png, the image, and the pyramids OUTPUT_weighted.png, which adds up to
the image, and OUTPUT_unweighted.png, in which each panel is an estimate by itself.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import mitsuba as mi  # noqa: E402

from mitsuba_bdpt.cli.arguments import number  # noqa: E402
from mitsuba_bdpt.files.images import write_images  # noqa: E402

from ..cli.mistakes import check_output  # noqa: E402
from . import reference
from .metrics import tone_map  # noqa: E402

KINDS = ("weighted", "unweighted")

SHORTEST = 2  # edges: of single ones the emitters themselves are seen


def technique_images(image, names: list, kind: str) -> dict:
    """``weighted`` or ``unweighted`` images of the strategies by ``(k, s, t)``, shape of ``image`` (..., 3),
    out of a render whose last channels have these ``names``."""
    first = image.shape[-1] - len(names)
    found = {}
    for i, name in enumerate(names):
        if match := re.fullmatch(rf"{kind}\.s(\d+)t(\d+)\.R", name):
            s, t = int(match[1]), int(match[2])
            found[s + t - 1, s, t] = image[..., first + i : first + i + 3]
    return found


def render(path: Path, options):
    """The film after a render with technique images, and these, weighted and unweighted."""
    values = {"resolution": options.resolution} if options.resolution else {}
    scene = reference.load_file(path, **values)
    integrator = mi.load_dict(
        {
            "type": "bdpt",
            "max_depth": options.max_depth,
            "strategy_images": True,
            "heuristic": options.heuristic,
        }
    )
    image = np.array(integrator.render(scene, spp=options.spp, seed=options.seed))
    names = integrator.aov_names()
    return scene.sensors()[0].film(), {kind: technique_images(image, names, kind) for kind in KINDS}


def panels(images: dict) -> dict:
    """Those `technique_images` to which anything contributes, but for single edges."""
    return {key: image for key, image in images.items() if key[0] >= SHORTEST and image.any()}


def draw(found: dict, path: Path, exposure: float):
    """The pyramid as a picture: rows of path lengths, s rising to the right; raises ``ValueError`` if no
    strategy contributes."""
    if not found:
        raise ValueError(f"nothing to draw in {path.name}: no path of {SHORTEST} edges or more brings light")
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


def main(arguments=None) -> int:
    """Render, write, say what was written."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("scene", help="a scene file, or a name in scenes/")
    parser.add_argument("-o", "--output", type=Path, help="default: renders/pyramid_SCENE")
    whole = number(int, 1)
    parser.add_argument("--max-depth", type=whole, default=5, help="longest path in edges; default 5")
    parser.add_argument("--spp", type=whole, default=64)
    parser.add_argument("--seed", type=number(int, 0, 2**32 - 1), default=0)
    parser.add_argument("--resolution", type=whole, help="value of $resolution in the scene file")
    parser.add_argument("--heuristic", default="balance")
    stops = number(float, -100, 100)
    parser.add_argument("--exposure", type=stops, default=0.0, help="stops, of the pictures")
    options = parser.parse_args(arguments)
    if options.max_depth < SHORTEST:
        raise ValueError(f"max_depth={options.max_depth} has no strategies to show; use {SHORTEST} or more")
    mi.set_variant("llvm_ad_rgb")
    path = reference.find_scene(options.scene)
    default = reference.ROOT / "renders" / f"pyramid_{path.stem}"
    output = options.output.with_suffix("") if options.output else default
    image = output.with_name(f"{output.name}.exr")
    pictures = {kind: output.with_name(f"{output.name}_{kind}.png") for kind in KINDS}
    for file in (image, *pictures.values()):
        check_output(file, file.suffix)
    film, images = render(path, options)
    write_images(film, image, {"heuristic": options.heuristic}, options.exposure)
    for kind, file in pictures.items():
        draw(panels(images[kind]), file, options.exposure)
        print(file)
    return 0
