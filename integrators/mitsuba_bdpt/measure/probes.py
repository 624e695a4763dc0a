"""Renders in new processes: seconds of a first image without kernel cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from typing import Any

from .options import VARIANT

RENDER = f"""
import json, sys, time
import mitsuba_bdpt, mitsuba as mi, drjit as dr
from pathlib import Path
from mitsuba_bdpt.measure.scenes import SceneFile, integrator_of
mi.set_variant({VARIANT!r})
wanted = json.loads(sys.argv[1])
scene = SceneFile("scene", Path(wanted["file"])).load(wanted["resolution"], wanted["sampler"])
integrator = integrator_of(wanted["parameters"], wanted["max_depth"])
dr.sync_thread()
wall, processor = time.perf_counter(), time.process_time()
image = mi.render(scene, integrator=integrator, spp=wanted["spp"]); dr.eval(image); dr.sync_thread()
print(time.perf_counter() - wall, time.process_time() - processor)
"""


def numbers(code: str, *arguments: str, **environment: str) -> list[float]:
    """Return the numbers that ``code`` prints last in a new process; ``environment``: added to this one's."""
    command, variables = [sys.executable, "-c", code, *arguments], os.environ | environment
    done = subprocess.run(command, env=variables, capture_output=True, text=True, errors="replace")
    if done.returncode:
        raise RuntimeError(f"a probe ended with status {done.returncode}: {done.stderr[-500:]}")
    return [float(word) for word in done.stdout.splitlines()[-1].split()]


def first_image(wanted: Mapping[str, Any]) -> dict[str, float]:
    """Return ``seconds`` and ``cpu_seconds`` of a render with an empty kernel cache, without loading.

    ``wanted``: ``file``, ``resolution`` and ``sampler`` of the scene, ``parameters`` of the integrator,
    ``max_depth`` and ``spp``.
    """
    with tempfile.TemporaryDirectory() as cache:
        wall, processor = numbers(RENDER, json.dumps(dict(wanted)), DRJIT_CACHE_DIR=cache, HOME=cache)
    return {"seconds": wall, "cpu_seconds": processor}
