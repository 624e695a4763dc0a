"""Costs of a render besides its samples: first image without kernel cache, memory.

Each of `PROBES` takes the number of repetitions, and returns plain numbers. Each repetition
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

RENDER = f"""
import json, sys, time
import mitsuba_bdpt, mitsuba as mi, drjit as dr
from pathlib import Path
from mitsuba_bdpt.host import memory
from mitsuba_bdpt.measure.scenes import DictionaryScene, SceneFile, integrator_of
mi.set_variant({VARIANT!r})
wanted = json.loads(sys.argv[1])
if "file" in wanted:
    scene = SceneFile("scene", Path(wanted["file"]))
else:
    box = mi.cornell_box()
    box["sensor"]["film"] |= wanted["film"]
    scene = DictionaryScene("box", box)
scene = scene.load(wanted.get("resolution"), wanted.get("sampler"))
integrator = integrator_of(wanted["parameters"], wanted["max_depth"])
dr.sync_thread()
wall, processor = time.perf_counter(), time.process_time()
image = mi.render(scene, integrator=integrator, spp=wanted["spp"]); dr.eval(image); dr.sync_thread()
print(time.perf_counter() - wall, time.process_time() - processor, memory.peak() / 2**30)
"""


def numbers(code: str, *arguments: str, environment: Mapping[str, str] | None = None) -> list[float]:
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace")
    if done.returncode:
        raise RuntimeError(f"a probe ended with status {done.returncode}: {done.stderr[-500:]}")
    return [float(word) for word in done.stdout.splitlines()[-1].split()]


def rendered(wanted: Mapping[str, Any], **environment: str) -> list[float]:
    """Return wall seconds, processor seconds and peak resident GiB of a render in a new process.

    ``wanted``: ``parameters`` of the integrator, ``max_depth`` and ``spp``; ``file``, ``resolution`` and
    ``sampler`` of a scene, else ``film`` of the Cornell box. ``environment``: added to that of the process.
    """
    return numbers(RENDER, json.dumps(dict(wanted)), environment=os.environ | environment)


def first_image(wanted: Mapping[str, Any]) -> dict[str, float]:
    """Return ``seconds`` and ``cpu_seconds`` of `rendered` with an empty kernel cache, without loading."""
    with tempfile.TemporaryDirectory() as cache:
        wall, processor, _ = rendered(wanted, DRJIT_CACHE_DIR=cache, HOME=cache)
    return {"seconds": wall, "cpu_seconds": processor}


def coldstart(rounds: int) -> dict[str, list[float]]:
    """Return seconds from an empty kernel cache to the first image, by integrator.

    Cornell box, 256x256, depth 6, 16 spp; without imports and loading. A value per round.
    """
    wanted: dict[str, Any] = {"film": {}, "max_depth": 6, "spp": 16}
    turns = [
        {name: first_image(wanted | {"parameters": {"type": name}})["seconds"] for name in ("path", "bdpt")}
        for _ in range(rounds)
    ]
    return {name: [turn[name] for turn in turns] for name in ("path", "bdpt")}


def memory(rounds: int) -> dict[str, list[float]]:
    """Return the peak resident GiB of a render, by samples per pixel.

    Cornell box, 1920x1080, depth 8. A value per round.
    """
    wanted = {"film": {"width": 1920, "height": 1080}, "parameters": {"type": "bdpt"}, "max_depth": 8}
    return {f"{spp} spp": [rendered(wanted | {"spp": spp})[-1] for _ in range(rounds)] for spp in (2, 8)}


PROBES = {"coldstart": coldstart, "memory": memory}
