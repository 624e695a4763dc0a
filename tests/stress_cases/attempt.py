"""Load scene files and render each, saying what happened: one line of JSON per file.

A process for what may crash or hang.

    python -m stress_cases.attempt INTEGRATOR FILE ...
"""

from __future__ import annotations

import json
import resource
import sys

import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np

import mitsuba as mi  # isort: skip

SEEDS, SIZE, SPP = range(1, 5), 16, 32

# A film of a mutated size must not take the whole machine.
MEMORY = 16 << 30


def attempt(path: str, integrator: str) -> dict:
    """What became of a scene file: the ``stage`` that was reached, and an error or figures of the images.

    ``stage``: ``load``, ``render`` or ``image``. Of an exception its ``kind`` and ``text``; of the images of
    all seeds their ``means``, how many values of them are ``bad``, not finite, how many were ``counted`` and
    left out, and whether the scene is ``bounded``: else Mitsuba's environments are in front of all shapes.
    """
    stage = "load"
    try:
        scene = mi.load_file(path, parallel=False, resolution=SIZE, integrator=integrator)
        used = scene.integrator()
        if not scene.sensors():
            raise ValueError("no sensor")
        stage = "render"
        images, counted = [], 0
        for seed in SEEDS:
            images.append(np.array(used.render(scene, 0, seed=seed, spp=SPP), dtype=np.float64))
            counted += getattr(used, "statistics", {}).get("non_finite", 0)
    except Exception as error:
        text = " ".join(str(error).split())
        return {"stage": stage, "kind": type(error).__name__, "text": text}
    bad = sum(int((~np.isfinite(image)).sum()) for image in images)
    return {
        "stage": "image",
        "means": [float(image.mean()) for image in images],
        "bad": bad,
        "counted": counted,
        "bounded": bool(np.isfinite(np.array(scene.bbox().bounding_sphere().radius)).all()),
    }


def main():
    """Run the command line."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    for path in sys.argv[2:]:
        print(json.dumps(attempt(path, sys.argv[1])), flush=True)


if __name__ == "__main__":
    main()
