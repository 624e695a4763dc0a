"""Costs of a render besides its samples: first image without kernel cache, memory.

Each of `PROBES` takes the project and the number of repetitions, and returns plain numbers. Each repetition
is a process of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from typing import Any

from .options import VARIANT
from .project import Project

COLD = f"""
import time; start = time.perf_counter()
import mitsuba_bdpt, mitsuba as mi, drjit as dr
mi.set_variant({VARIANT!r})
scene = mi.load_dict(mi.cornell_box())
integrator = mi.load_dict({{'type': '%s', 'max_depth': 6}})
loaded = time.perf_counter()
image = mi.render(scene, integrator=integrator, spp=16); dr.eval(image); dr.sync_thread()
print(time.perf_counter() - loaded)
"""

FIRST = f"""
import json, sys, time
import mitsuba_bdpt, mitsuba as mi, drjit as dr
from pathlib import Path
from mitsuba_bdpt.measure.scenes import SceneFile, integrator_of
mi.set_variant({VARIANT!r})
wanted = json.loads(sys.argv[1])
scene = SceneFile("first", Path(wanted["file"])).load(wanted["resolution"], wanted["sampler"])
integrator = integrator_of(wanted["parameters"], wanted["max_depth"])
dr.sync_thread()
wall, processor = time.perf_counter(), time.process_time()
image = mi.render(scene, integrator=integrator, spp=wanted["spp"]); dr.eval(image); dr.sync_thread()
print(time.perf_counter() - wall, time.process_time() - processor)
"""

MEMORY = f"""
import mitsuba_bdpt, mitsuba as mi
from mitsuba_bdpt.host import memory
mi.set_variant({VARIANT!r})
d = mi.cornell_box()
d['sensor']['film']['width'], d['sensor']['film']['height'] = 1920, 1080
mi.render(mi.load_dict(d), integrator=mi.load_dict({{'type': 'bdpt', 'max_depth': 8}}), spp=%d)
print(memory.peak() / 2**30)
"""


def numbers(code: str, *arguments: str, environment: Mapping[str, str] | None = None) -> list[float]:
    """Return the numbers that a new process prints."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace")
    if done.returncode:
        raise RuntimeError(f"a probe ended with status {done.returncode}: {done.stderr[-500:]}")
    return [float(word) for word in done.stdout.split() if _is_number(word)]


def cold(code: str, *arguments: str) -> list[float]:
    """Like `numbers`, with an empty kernel cache."""
    with tempfile.TemporaryDirectory() as cache:
        empty = os.environ | {"DRJIT_CACHE_DIR": cache, "HOME": cache}
        return numbers(code, *arguments, environment=empty)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def coldstart(project: Project, rounds: int) -> dict[str, list[float]]:
    """Return seconds from an empty kernel cache to the first image, by integrator.

    Cornell box, 256x256, depth 6, 16 spp; without imports and loading. A value per round.
    """
    seconds: dict[str, list[float]] = {"path": [], "bdpt": []}
    for _ in range(rounds):
        for name, values in seconds.items():
            values.append(cold(COLD % name)[-1])
    return seconds


def first_image(wanted: Mapping[str, Any]) -> dict[str, float]:
    """Return ``seconds`` and ``cpu_seconds`` from an empty kernel cache to the image of a loaded scene.

    ``wanted``: the ``file``, ``resolution``, ``sampler``, ``max_depth``, ``parameters`` and ``spp``.
    """
    return dict(zip(("seconds", "cpu_seconds"), cold(FIRST, json.dumps(dict(wanted)))[-2:], strict=True))


def memory(project: Project, rounds: int) -> dict[str, list[float]]:
    """Return the peak resident GiB of a render, by samples per pixel.

    Cornell box, 1920x1080, depth 8. A value per round.
    """
    return {f"{spp} spp": [numbers(MEMORY % spp)[-1] for _ in range(rounds)] for spp in (2, 8)}


PROBES = {"coldstart": coldstart, "memory": memory}
