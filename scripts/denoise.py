"""What denoising does to the error: a table of scenes, for bdpt and `path`.

python scripts/denoise.py cornell_box glass_caustics veach_bidir ajar_door veach_mis open_sky

relMSE of images of 128² with 16 samples per pixel (means over seeds), raw and denoised, and the seconds that
denoising takes. `path` is denoised with the same albedo and normals, of 64 samples per pixel.
"""

from __future__ import annotations

import argparse
import sys
import time

import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
import numpy as np
import repository
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import number
from mitsuba_bdpt.image import denoising
from mitsuba_bdpt.measure.metrics import rel_mse
from mitsuba_bdpt.measure.tables import table

import mitsuba as mi  # isort: skip

RESOLUTION = 128


def guides(scene, spp: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Albedo and normals of a scene, by Mitsuba's own plugin, which has no normals of maps in the world."""
    guides = denoising.GUIDES.replace(denoising.WORLD_NORMAL, "sh_normal")
    made = mi.load_dict({"type": "aov", "aovs": guides})
    image = np.array(mi.render(scene, integrator=made, spp=spp, seed=7))
    return image[..., -6:-3], image[..., -3:]


def errors(name: str, spp: int, seeds: int) -> list[str]:
    """A row of the table."""
    scene, depth = repository.load_scene(name, resolution=RESOLUTION), repository.benchmark_depth(name)
    expected = repository.load_reference(name, RESOLUTION, depth).image
    albedo, normal = guides(scene)
    cells, seconds = [f"`{name}`"], []
    for kind in ("bdpt", "path"):
        integrator, found = mi.load_dict({"type": kind, "max_depth": depth}), []
        for seed in range(seeds):
            raw = np.array(integrator.render(scene, seed=seed, spp=spp))[..., :3]
            started = time.perf_counter()
            clean = denoising.denoised(raw, albedo, normal)
            seconds.append(time.perf_counter() - started)
            found.append([rel_mse(raw, expected), rel_mse(clean, expected)])
        before, after = np.mean(found, axis=0)
        cells += [f"{before:.3g}, {after:.3g}", f"{before / after:.3g}x"]
    return [*cells, f"{np.median(seconds):.2f}"]


def main(arguments=None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.split("\n\n")[0])
    parser.add_argument("scene", nargs="+")
    parser.add_argument("--spp", type=number(int, 1), default=16)
    parser.add_argument("--seeds", type=number(int, 1), default=3)
    options = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    head = ["scene", "bdpt: raw, denoised", "less", "`path`: raw, denoised", "less", "seconds"]
    rows = [errors(name, options.spp, options.seeds) for name in options.scene]
    print(table(head, rows))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
