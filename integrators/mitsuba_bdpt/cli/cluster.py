"""One render on many machines: parts with different seeds on ``dask.distributed``.

The client runs the pilot once and sends its decisions to all workers. Each part is an independent render,
returned as a `Snapshot`. Sums are added in the order of the parts, so the image does not depend on the
workers.
"""

from __future__ import annotations

import json
import time
import uuid
from argparse import Namespace
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import mitsuba as mi

from ..errors import CommandError, behind
from ..files.loading import load
from ..planning.budget import fixed_by
from ..planning.configuration import Decision
from ..run.rendering import PassReport
from ..run.snapshot import Snapshot
from ..run.statistics import RAYS
from ..workers import connected, one_at_a_time, results, worker_count

PARTS_PER_WORKER = 4  # bounds the wait for the last part to a quarter of a worker's work

# Minimum samples per pixel of a part: short point sequences converge slower, and `variance` needs 8.
LEAST_SPP = 16

STRIDE = 0x9E3779B9  # stride of the parts' seeds, 2^32 / golden ratio: renders with adjacent seeds share none


def check_settings(settings) -> None:
    """Raise ``CommandError`` for parameters whose meaning differs in a part."""
    for name in ("timeout", "target_error"):
        value = getattr(settings, name)
        if value > 0 or (name == "timeout" and value == 0):
            raise CommandError(
                f"scheduler with {name}={value} is not possible: each part would end by itself."
            )
    if found := [name for name in ("duv_dx", "duv_dy") if name in settings.aovs]:
        raise CommandError(
            f"scheduler with aovs={settings.aovs!r} is not possible: {found[0]} depends on the samples per "
            "pixel of a part; render it apart."
        )


def parts_of(spp: int, count: int, seed: int) -> list[tuple[int, int]]:
    """Return seed and samples per pixel of at most ``count`` parts, see `LEAST_SPP`."""
    count = max(1, min(count, spp // LEAST_SPP))
    return [((seed + i * STRIDE) % 2**32, spp // count + (i < spp % count)) for i in range(count)]


def render(scene, integrator, options: Namespace, spp: int, on_part: Callable[[PassReport], None]):
    """Render on the cluster ``options.scheduler``, into the sensor's film.

    ``on_part`` is called after each part. Returns the statistics (seconds: sum of the pilot and all parts),
    and what ended the render early, else None: Ctrl-C, a lost scheduler, a failed part. The statistics then
    cover the parts that arrived. Raises errors of `connected`, and those before the first part.
    """
    started, arrived, ended = time.perf_counter(), {}, None
    merged, following = None, 0
    integrator.statistics = {}  # not those of the previous render
    with connected(options.scheduler) as workers:
        job = _job(scene, integrator, options, spp)
        of_pilot = integrator.statistics  # before the parts replace them
        count = options.parts or PARTS_PER_WORKER * worker_count(workers)
        parts = [(job, i, *part) for i, part in enumerate(parts_of(spp, count, options.seed))]
        try:
            for index, data in results(workers, render_part, parts):
                arrived[index] = Snapshot.from_bytes(data)
                while following in arrived:
                    merged = joined(merged, arrived.pop(following))
                    following += 1
                if merged is not None:
                    rays = sum(merged.progress.work.counts[name] for name in RAYS)
                    seconds = time.perf_counter() - started
                    image = partial(integrator.assemble, merged, scene, options.sensor)
                    on_part(PassReport(merged.spp, spp, seconds, rays, None, lambda s=merged: s, image))
        except (KeyboardInterrupt, Exception) as error:
            ended = behind(error, KeyboardInterrupt) or error
    for index in sorted(arrived):  # after a missing one
        merged = joined(merged, arrived[index])
    if merged is None:
        if isinstance(ended, Exception):
            raise ended
        return {"passes": []}, ended
    integrator.assemble(merged, scene, options.sensor, develop=False)
    return _with_pilot(integrator.statistics, of_pilot), ended


def joined(merged: Snapshot | None, part: Snapshot) -> Snapshot:
    return part if merged is None else merged.joined(part)


def _with_pilot(parts: dict, of_pilot: dict) -> dict:
    """Add the statistics ``of_pilot`` to those of the ``parts``.

    The parts contain the decisions only. Nothing is added to decisions that were given.
    """
    if not of_pilot:
        return parts
    sums = {
        name: {key: number + of_pilot[name][key] for key, number in parts[name].items()}
        for name in ("seconds", "kernels")
    }
    names = ("no_pilot", "non_finite_in_pilot", "skipped")
    if "merging" in parts:
        sums["merging"] = parts["merging"] | {"why": of_pilot["merging"]["why"]}
    return parts | {name: of_pilot[name] for name in names} | sums


def _job(scene, integrator, options: Namespace, spp: int) -> str:
    """Return what a worker needs for each part, as JSON.

    The absolute path of the scene file, the options of `loading.load`, and the pilot's decisions.
    """
    properties, settings = dict(options.properties), integrator.settings
    fixed = fixed_by(settings)
    if not fixed or settings.merging == "auto":
        decided = integrator.decide(scene, options.sensor, options.seed, spp)
    if settings.merging == "auto":
        properties["merging"] = not integrator.statistics["unbiased"]
    names = ("variant", "defines", "integrator", "sensor", "time", "target_error", "denoise", "size", "crop")
    kept = {name: getattr(options, name) for name in names}
    kept["append"] = [str(folder.resolve()) for folder in options.append]
    # An empty list if no pilot runs: parts, which are shorter, run none either.
    kept["decisions"] = None if fixed else decided
    kept["render"] = uuid.uuid4().hex  # the scene may have been edited since the last render
    return json.dumps(kept | {"scene": str(options.scene.resolve()), "properties": list(properties.items())})


def render_part(job: str, part: int, seed: int, spp: int) -> bytes:
    """Render the ``part`` of this index of a `_job` on a worker; returns `Snapshot.to_bytes`.

    A process renders one part at a time, on all cores.
    """
    with one_at_a_time:
        options, scene, integrator = _loaded(job)
        mi.set_variant(options.variant)  # per thread
        reports = []
        integrator.on_pass, integrator.part = reports.append, part
        integrator.render(scene, options.sensor, seed, spp, develop=False)
        integrator.on_pass = None
        return reports[-1].snapshot().image_only().to_bytes()


@lru_cache(maxsize=1)
def _loaded(job: str):
    """Return options, scene and integrator of a `_job`, loaded once per worker."""
    options = Namespace(**json.loads(job))
    options.scene, options.append = Path(options.scene), [Path(folder) for folder in options.append]
    scene, integrator, _ = load(options)
    if options.decisions is not None:
        decisions = tuple(map(Decision.read, options.decisions))
        integrator.settings = integrator.settings.varied(decisions=decisions)
    return options, scene, integrator
