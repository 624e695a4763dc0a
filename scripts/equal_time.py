"""Pictures of integrators side by side at equal time: images, magnified windows, error maps.

    python scripts/equal_time.py veach_bidir --spp 25    # renders/equal_time_veach_bidir.png: path, bdpt
    python scripts/equal_time.py veach_mis --spp 16 -i "bdpt heuristic=power" "bdpt heuristic=balance"

The last integrator has ``--spp`` samples per pixel, the others as many as fit into its seconds. Errors are
against the scene's reference in references/; windows are where they differ most.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import reference
from metrics import TRIM, rel_mse, rel_mse_epsilon, tone_map
from mitsuba_bdpt.__main__ import number, property_
from mitsuba_bdpt.files import replacing
from reference import benchmark_depth

import mitsuba as mi  # isort: skip
import drjit as dr  # isort: skip

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.colors import LogNorm  # noqa: E402
from matplotlib.patches import Rectangle  # noqa: E402

RESOLUTION = 128  # as the references
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


def integrator(words: str, depth: int):
    """The plugin ``TYPE KEY=VALUE …``."""
    kind, *properties = words.split()
    return mi.load_dict({"type": kind, "max_depth": depth} | dict(property_(text) for text in properties))


def timed(scene, made, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """Image and seconds of a render."""
    started = time.perf_counter()
    image = mi.render(scene, integrator=made, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return np.array(image, dtype=np.float64)[..., :3], time.perf_counter() - started


def seconds(scene, made, spp: int) -> float:
    """Median over renders that follow a first one, which compiles."""
    return float(np.median([timed(scene, made, spp, seed)[1] for seed in range(TIMED + 1)][1:]))


def shots(scene, target: np.ndarray, names: list[str], depth: int, spp: int) -> list[Shot]:
    """All integrators; the last has ``spp`` samples per pixel, others as many as its seconds allow."""
    made = [integrator(name, depth) for name in names]
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
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as temporary:
        figure.savefig(temporary, dpi=100, format="png", metadata={"Software": None})
    plt.close(figure)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", help="name of a scene of scenes/ that has a reference")
    parser.add_argument("--spp", type=number(int, 1), default=64, help="of the last integrator")
    text = "TYPE KEY=VALUE …, each in quotes; default: path bdpt"
    parser.add_argument("-i", "--integrators", nargs="+", default=["path", "bdpt"], help=text)
    text = "of the sensor; default: %(default)s, Mitsuba's own default"
    parser.add_argument("--sampler", default="independent", help=text)
    parser.add_argument("-o", "--output", type=Path, help="default: renders/equal_time_SCENE.png")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    depth = benchmark_depth(args.scene)
    target = reference.load_reference(args.scene, RESOLUTION, depth).image
    scene = reference.load_scene(args.scene, resolution=RESOLUTION, sampler=args.sampler)
    found = shots(scene, target, args.integrators, depth, args.spp)
    file = args.output or reference.ROOT / "renders" / f"equal_time_{args.scene}.png"
    draw(found, target, f"{args.scene}, equal time", file)
    print(file)
    for shot in found:
        print(shot.caption.replace("\n", ", "))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
