"""How good renders are that stop at an estimated error.

    python scripts/stopping.py cornell_box uplight_room glass_caustics --target-error 0.01 --renders 32

Renders of different seeds stop at the first estimate (``statistics["error"]``) that is small enough. Shown
are, as means over renders, the samples per pixel, that estimate, the relMSE against the scene's reference,
and the mean of the image over that of the reference, less 1, with its standard error: the bias of stopping.
"""

from __future__ import annotations

import argparse

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
import numpy as np
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import number
from mitsuba_bdpt.measure.metrics import rel_mse
from repository import RESOLUTION, benchmark_depth

import mitsuba as mi  # isort: skip

MOST_SPP = 1 << 12


def line(name: str, error: float, renders: int) -> str:
    """The line of a scene, as Markdown."""
    depth = benchmark_depth(name)
    target = repository.load_reference(name, RESOLUTION, depth).image
    scene = repository.load_scene(name, resolution=RESOLUTION)
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": depth, "variance": True, "target_error": error})
    spp, estimates, found, means = [], [], [], []
    for seed in range(renders):
        image = np.array(bdpt.render(scene, seed=seed, spp=MOST_SPP), dtype=np.float64)[..., :3]
        spp.append(sum(bdpt.statistics["passes"]))
        estimates.append(bdpt.statistics["error"])
        found.append(rel_mse(image, target))
        means.append(image.mean() / target.mean())
    bias, spread = np.mean(means) - 1, np.std(means, ddof=1) / np.sqrt(renders)
    return (
        f"| `{name}` | {error:g} | {np.mean(spp):.0f} | {np.mean(estimates):.2g} | {np.mean(found):.2g} "
        f"({min(found):.2g}–{max(found):.2g}) | {100 * bias:+.2f} ± {100 * spread:.2f} % |"
    )


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--target-error", type=number(float, 1e-9), default=0.01)
    parser.add_argument("--renders", type=number(int, 2), default=32)
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print("| scene | asked | spp | estimate | relMSE (smallest–largest) | mean of the image |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in args.scenes:
        print(line(name, args.target_error, args.renders), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(answered(main))
