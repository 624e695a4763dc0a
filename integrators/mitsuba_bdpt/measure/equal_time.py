"""Pictures of integrators side by side at equal time: images, magnified windows, error maps.

    python scripts/equal_time.py veach_bidir --spp 25    # renders/equal_time_veach_bidir.png: path, bdpt
    python scripts/equal_time.py veach_mis --spp 16 -i "bdpt heuristic=power" "bdpt heuristic=balance"
    python scripts/equal_time.py my_room.xml --reference my_room_4096spp.exr

The last integrator has ``--spp`` samples per pixel, the others as many as fit into its seconds. Errors are
against the scene's reference in references/, at its size and the depth of the benchmark; for a file that is
not in scenes/ against ``--reference``, at the file's own size and depth. Windows are where the errors differ
most.
"""

from __future__ import annotations

import argparse
import math
import re
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import mitsuba as mi
import numpy as np

from ..cli.arguments import number
from ..cli.mistakes import check_output
from ..files.loading import choose_sensor
from ..files.whole import replacing
from . import reference
from .metrics import TRIM, rel_mse, rel_mse_epsilon, tone_map
from .reference import RESOLUTION, benchmark_depth
from .timing import timed

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.colors import LogNorm  # noqa: E402
from matplotlib.patches import Rectangle  # noqa: E402

WINDOW = 6  # a window's side is this part of the image's
COLOURS = ("#E69F00", "#56B4E9")  # of the two windows
TIMED = 3  # renders of which the median is the time


@dataclass(frozen=True)
class Shot:
    """A render: what made it, samples per pixel, seconds, the image (height, width, 3), its errors."""

    name: str
    spp: int
    seconds: float
    image: np.ndarray
    errors: np.ndarray
    rel_mse: float

    @property
    def caption(self) -> str:
        """Beneath the image."""
        return f"{self.name}\n{self.spp} spp, {self.seconds:.2g} s\nrelMSE {self.rel_mse:.2g} (trimmed)"


def subject(path: Path, sampler: str | None, exr: Path | None):
    """Scene, reference and ``max_depth`` of a scene's file, whose reference is in ``exr`` if given."""
    own = {"sampler": sampler} if sampler else {}
    if path.resolve().parent == reference.SCENES and exr is None:
        depth = benchmark_depth(path.stem)
        target = reference.load_reference(path.stem, RESOLUTION, depth).image
        return reference.load_file(path, resolution=RESOLUTION, **own), target, depth
    if exr is None:
        raise ValueError(
            f"scene={str(path)!r} is not in scenes/ and has no reference; give one with --reference "
            f"FILE.exr, which python -m mitsuba_bdpt render {path} --spp 4096 -o FILE.exr makes"
        )
    (target,), _ = reference.read_exr(exr, "")
    scene = reference.load_file(path, **own)
    width, height = (int(n) for n in choose_sensor(scene, 0).film().crop_size())
    if target.shape[:2] != (height, width):
        raise ValueError(
            f"reference={str(exr)!r} has {target.shape[1]} x {target.shape[0]} pixels, the film of "
            f"{str(path)!r} {width} x {height}; render it from this file"
        )
    return scene, target, depth_of(scene.integrator())


def depth_of(made) -> int:
    """The ``max_depth`` of an integrator, which Mitsuba's own tell in their text alone; -1 without one."""
    found = re.search(r"\bmax_depth = (\d+)", str(made))
    return int(found[1]) if found and int(found[1]) < 2**31 else -1


def seconds(scene, made, spp: int) -> float:
    """Median over renders that follow a first one, which compiles."""
    return float(np.median([timed(scene, made, spp, seed)[1] for seed in range(TIMED + 1)][1:]))


def shots(scene, target: np.ndarray, names: list[str], depth: int, spp: int) -> list[Shot]:
    """All integrators; the last has ``spp`` samples per pixel, others as many as its seconds allow."""
    made = [reference.integrator_of(name, depth) for name in names]
    limit, found = seconds(scene, made[-1], spp), []
    for name, one in zip(names, made, strict=True):
        count = spp if one is made[-1] else max(1, round(spp * limit / seconds(scene, one, spp)))
        seconds(scene, one, count)  # Mitsuba compiles anew for each number of samples
        image, taken = timed(scene, one, count, seed=7)
        error = ((image - target) ** 2 / (target**2 + rel_mse_epsilon(target))).mean(axis=-1)
        found.append(Shot(name, count, taken, image, error, rel_mse(image, target, TRIM)))
    return found


def windows(found: list[Shot], shape) -> list[tuple[int, int, int]]:
    """Two windows (left, top, side) that do not overlap, where the errors of the first and the last image
    differ most (on a logarithmic scale, so that no single pixel decides)."""
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
    """A column per image and one of the reference: image, windows, error map."""
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
    with replacing(file) as temporary:
        figure.savefig(temporary, dpi=100, format="png", metadata={"Software": None})
    plt.close(figure)


def main(arguments=None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", help="a scene file, or a name in scenes/ that has a reference")
    parser.add_argument("--spp", type=number(int, 1), default=64, help="of the last integrator")
    text = "TYPE KEY=VALUE …, each in quotes; default: path bdpt"
    parser.add_argument("-i", "--integrators", nargs="+", default=["path", "bdpt"], help=text)
    text = "value of $sampler in the scene file, of the sensor; default: the file's"
    parser.add_argument("--sampler", help=text)
    text = "image to take errors against; default: the one in references/"
    parser.add_argument("--reference", type=Path, metavar="EXR", help=text)
    parser.add_argument("-o", "--output", type=Path, help="default: renders/equal_time_SCENE.png")
    args = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    path = reference.find_scene(args.scene)
    file = args.output or reference.ROOT / "renders" / f"equal_time_{path.stem}.png"
    check_output(file, ".png")
    scene, target, depth = subject(path, args.sampler, args.reference)
    found = shots(scene, target, args.integrators, depth, args.spp)
    draw(found, target, f"{path.stem}, equal time", file)
    print(file)
    for shot in found:
        print(shot.caption.replace("\n", ", "))
    return 0
