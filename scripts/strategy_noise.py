"""Which strategies a scene's noise comes from.

    python scripts/strategy_noise.py ajar_door glass_caustics

From the technique images of renders with everything switched on (64^2): the relative variance of a sample,
raw and trimmed of its worst 0.1 % of values, of the image and of each strategy's weighted part of it. What
the strategies' variances lack to that of the image is the covariance of strategies that share a subpath.
"""

from __future__ import annotations

import argparse
import sys

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
import numpy as np
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.measure.metrics import TRIM
from mitsuba_bdpt.measure.tables import table
from repository import benchmark_depth

import mitsuba as mi  # isort: skip
import repository
from mitsuba_bdpt.measure.pyramid import technique_images

RESOLUTION, SPP, RENDERS, SHOWN = 64, 8, 24, 6


def noise(values, norm) -> tuple[float, float]:
    """Relative variance per sample of renders (first axis), raw and trimmed."""
    found = np.sort((values.var(axis=0, ddof=1) / norm).ravel()) * SPP
    return found.mean(), found[: int((1 - TRIM) * len(found))].mean()


def lines(name: str) -> list:
    """Rows of a scene: the image, all strategies together, and those with most noise."""
    scene = repository.load_scene(name, resolution=RESOLUTION)
    parameters = {"type": "bdpt", "max_depth": benchmark_depth(name), "skip": "none"}
    integrator = mi.load_dict(parameters | {"strategy_images": True})
    renders = np.array(
        [np.array(integrator.render(scene, seed=s, spp=SPP)) for s in range(RENDERS)], dtype=float
    )
    mean = renders[..., :3].mean(axis=0)
    norm = mean**2 + 0.01 * mean.mean() ** 2
    found = []
    for (_, s, t), part in technique_images(renders, integrator.aov_names(), "weighted").items():
        found.append((*noise(part, norm), part.mean() / mean.mean(), f"s{s}t{t}"))
    found.sort(reverse=True)
    total = noise(renders[..., :3], norm)
    rows = [[f"`{name}`", "image", f"{total[0]:.3g}", f"{total[1]:.3g}", "100 %"]]
    rows.append([f"`{name}`", "strategies, summed", *(f"{sum(f[i] for f in found):.3g}" for i in (0, 1)), ""])
    for raw, trimmed, energy, text in found[:SHOWN]:
        rows.append([f"`{name}`", text, f"{raw:.3g}", f"{trimmed:.3g}", f"{100 * energy:.1f} %"])
    return rows


def main(arguments=None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.split("\n\n")[0])
    parser.add_argument("scenes", nargs="+", help="names in scenes/")
    names = parser.parse_args(arguments).scenes
    mi.set_variant("llvm_ad_rgb")
    head = ["scene", "strategy", "variance of a sample", "trimmed", "energy"]
    print(table(head, [row for name in names for row in lines(name)]))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
