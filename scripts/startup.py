"""First and second render of scenes with many emitters or BSDFs, for `path` and `bdpt`.

    python scripts/startup.py

A process for each row, with an empty kernel cache: seconds to the first image of 128^2 pixels (compilation
included), then of a second render (seed and samples changed: nothing is compiled, kernels are only recorded).
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile

from mistakes import answered
from probes import numbers
from tables import table

COUNTS = ((1, 1), (30, 1), (300, 1), (1, 10), (1, 100))

CODE = """
import sys, time
import mitsuba_bdpt, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
T = mi.ScalarTransform4f
kind, lamps, bsdfs = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
film = {"type": "hdrfilm", "width": 128, "height": 128}
look = T().look_at([0, 3, 8], [0, 0, 0], [0, 1, 0])
scene = {"type": "scene", "sensor": {"type": "perspective", "to_world": look, "film": film}}
for i in range(lamps):
    x, z = i % 20 - 10, i // 20 - 7
    place = T().translate([x, 4, z]).rotate([1, 0, 0], 90).scale(0.1)
    emitter = {"type": "area", "radiance": 1.0 + i}
    scene[f"lamp{i}"] = {"type": "rectangle", "to_world": place, "emitter": emitter}
for i in range(bsdfs):
    x, z = i % 10 - 5, i // 10 - 5
    bsdf = [
        {"type": "diffuse", "reflectance": 0.2 + 0.005 * i},
        {"type": "roughconductor", "alpha": 0.1 + 0.002 * i},
        {"type": "plastic", "int_ior": 1.3 + 0.001 * i},
        {"type": "dielectric", "int_ior": 1.3 + 0.002 * i},
    ][i % 4]
    scene[f"ball{i}"] = {"type": "sphere", "center": [x, 0, z], "radius": 0.4, "bsdf": bsdf}
scene = mi.load_dict(scene)
integrator = mi.load_dict({"type": kind, "max_depth": 6})
for seed, spp in ((0, 8), (1, 16)):  # long enough for a pilot
    start = time.perf_counter()
    dr.eval(integrator.render(scene, seed=seed, spp=spp))
    dr.sync_thread()
    print(time.perf_counter() - start)
"""


def main(arguments=None) -> int:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__.split("\n\n")[0]).parse_args(arguments)
    rows = []
    for lamps, bsdfs in COUNTS:
        row = [str(lamps), str(bsdfs)]
        for kind in ("path", "bdpt"):
            with tempfile.TemporaryDirectory() as cache:
                empty = os.environ | {"DRJIT_CACHE_DIR": cache, "HOME": cache}
                first, second = numbers(CODE, kind, str(lamps), str(bsdfs), environment=empty)[-2:]
            row += [f"{first:.2f}", f"{second:.3f}"]
        rows.append(row)
    head = ["emitters", "BSDFs", "path: first", "second", "bdpt: first", "second"]
    print(table(head, rows))
    return 0


if __name__ == "__main__":
    sys.exit(answered(main))
