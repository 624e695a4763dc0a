"""Load scene files and render each, in a process for what may crash or hang: one line of JSON per file.

python -m stress_cases.attempt INTEGRATOR FILE ...
"""

import json
import resource
import signal
import sys

import mitsuba_bdpt  # noqa: F401  (chooses LLVM before Dr.Jit is imported)
import numpy as np

import mitsuba as mi  # isort: skip

# Seconds after which a file's process ends, and its memory: a film of a mutated size must not take the
# machine.
LIMIT, MEMORY = 600, 16 << 30


def attempt(path: str, integrator: str) -> dict:
    """What became of a scene file: the ``stage`` that was reached (load, render, image), and an error's
    ``text``.

    Of the images of four seeds their ``means``, how many values are ``bad``, not finite, and whether the
    scene is ``bounded``: else Mitsuba's environments are in front of all shapes.
    """
    stage = "load"
    try:
        # Mitsuba's merged rectangles have no box, and `path` is too bright beside them.
        scene = mi.load_file(path, parallel=False, optimize=False, resolution=16, integrator=integrator)
        used = scene.integrator()
        if not scene.sensors():
            raise ValueError("no sensor")
        stage = "render"
        images = [
            np.array(used.render(scene, 0, seed=seed, spp=32), dtype=np.float64) for seed in range(1, 5)
        ]
    except Exception as error:
        return {"stage": stage, "text": " ".join(str(error).split())}
    return {
        "stage": "image",
        "means": [float(image.mean()) for image in images],
        "bad": int((~np.isfinite(images)).sum()),
        "bounded": bool(np.isfinite(np.array(scene.bbox().bounding_sphere().radius)).all()),
    }


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    for name in sys.argv[2:]:
        signal.alarm(LIMIT)
        print(json.dumps(attempt(name, sys.argv[1])), flush=True)
