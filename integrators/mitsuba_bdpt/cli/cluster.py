"""One render on many machines: parts with seeds of their own on the workers of ``dask.distributed``.

The client asks the pilot once; its decisions go to all. Each part is an independent render whose raw sums
come back as a `Snapshot`; they are added in the order of the parts, so the image does not depend on which
worker made which, nor on whether one of them was lost.
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
from ..run.rendering import PassReport
from ..run.snapshot import Snapshot
from ..run.statistics import RAYS
from ..workers import connected, one_at_a_time, results, worker_count

# Parts for each worker: the last one that is waited for then takes a quarter of what a worker does in all.
PARTS_PER_WORKER = 4

# Samples per pixel of a part at least: shorter point sequences are worse, and `variance` needs 8.
LEAST_SPP = 16

# Between seeds of the parts, 2^32 / golden ratio: renders whose own seeds are neighbours share none.
STRIDE = 0x9E3779B9


def check_settings(settings) -> None:
    """Raise ``CommandError`` for parameters that would mean something else in each part."""
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
    """Seed and samples per pixel of ``count`` parts, fewer if they would be shorter than `LEAST_SPP`."""
    count = max(1, min(count, spp // LEAST_SPP))
    return [((seed + i * STRIDE) % 2**32, spp // count + (i < spp % count)) for i in range(count)]


class Merged:
    """Snapshots of parts added up in the order of the parts, whatever the order in which they come."""

    def __init__(self):
        self.snapshot, self._next, self._waiting = None, 0, {}

    def add(self, index: int, snapshot: Snapshot) -> None:
        """Add the part number ``index``; a part that came before is ignored."""
        if index >= self._next:
            self._waiting[index] = snapshot
        while self._next in self._waiting:
            self._join(self._next)
            self._next += 1

    def close(self) -> None:
        """Add the parts behind one that will not come, in their order."""
        for index in sorted(self._waiting):
            self._join(index)

    def _join(self, index: int) -> None:
        part = self._waiting.pop(index)
        self.snapshot = part if self.snapshot is None else self.snapshot.joined(part)

    @property
    def count(self) -> int:
        """Parts that have come."""
        return self._next + len(self._waiting)


def render(scene, integrator, options: Namespace, spp: int, on_part: Callable[[PassReport], None]):
    """Render as the command line ``options`` say on a cluster, into the sensor's film.

    The cluster is that of ``options.scheduler``; ``on_part`` is called after each part. Returns the
    statistics, whose seconds are those of the pilot and all parts together, and what ended the render early,
    None if nothing did: Ctrl-C, a scheduler that is gone, a part that failed. Then they are of the parts
    that had come. Raises what `connected` does, and what ends the render before the first part.
    """
    started, merged = time.perf_counter(), Merged()
    ended: BaseException | None = None
    with connected(options.scheduler) as workers:
        job = _job(scene, integrator, options, spp)
        of_pilot = integrator.statistics  # before the parts, whose own take their place
        count = options.parts or PARTS_PER_WORKER * worker_count(workers.client)
        parts = [(job, *part) for part in parts_of(spp, count, options.seed)]
        try:
            for index, data in results(workers, render_part, parts):
                merged.add(index, Snapshot.from_bytes(data))
                done = merged.snapshot
                if done is not None:
                    rays = sum(done.progress.work.counts[name] for name in RAYS)
                    seconds = time.perf_counter() - started
                    image = partial(integrator.assemble, done, scene, options.sensor)
                    on_part(PassReport(done.spp, spp, seconds, rays, None, lambda s=done: s, image))
        except (KeyboardInterrupt, Exception) as error:
            ended = behind(error, KeyboardInterrupt) or error
    merged.close()
    if merged.snapshot is None:
        if isinstance(ended, Exception):
            raise ended
        return {"passes": []}, ended
    integrator.assemble(merged.snapshot, scene, options.sensor, develop=False)
    return _with_pilot(integrator.statistics, of_pilot), ended


def _with_pilot(parts: dict, of_pilot: dict) -> dict:
    """Statistics of the ``parts`` together with those ``of_pilot``.

    The parts know the pilot's decisions alone. Nothing is added where decisions were given by hand.
    """
    if not of_pilot:
        return parts
    sums = {
        name: {key: number + of_pilot[name][key] for key, number in parts[name].items()}
        for name in ("seconds", "kernels")
    }
    return parts | {name: of_pilot[name] for name in ("no_pilot", "non_finite_in_pilot", "skipped")} | sums


def _job(scene, integrator, options: Namespace, spp: int) -> str:
    """What a worker needs to know of each part, as JSON.

    The scene file by its absolute path, the options that `loading.load` reads, the pilot's decisions.
    """
    properties, settings = dict(options.properties), integrator.settings
    if settings.decisions is None:  # an empty list where there is nothing to choose
        decided = integrator.decide(scene, options.sensor, options.seed, spp)
        properties["decisions"] = json.dumps(decided)
    names = ("variant", "defines", "integrator", "sensor", "time", "target_error", "denoise", "size", "crop")
    kept = {name: getattr(options, name) for name in names}
    kept["append"] = [str(folder.resolve()) for folder in options.append]
    kept["render"] = uuid.uuid4().hex  # the scene may have been edited since the last one
    return json.dumps(kept | {"scene": str(options.scene.resolve()), "properties": list(properties.items())})


def render_part(job: str, seed: int, spp: int) -> bytes:
    """Render one part of a `_job` on a worker; returns it as `Snapshot.to_bytes`.

    A process renders one part at a time, for each takes all cores.
    """
    with one_at_a_time:
        options, scene, integrator = _loaded(job)
        mi.set_variant(options.variant)  # of this thread
        reports = []
        integrator.on_pass = reports.append
        integrator.render(scene, options.sensor, seed, spp, develop=False)
        integrator.on_pass = None
        return reports[-1].snapshot().image_only().to_bytes()


@lru_cache(maxsize=1)
def _loaded(job: str):
    """Options, scene and integrator of a `_job`; a worker loads them once."""
    options = Namespace(**json.loads(job))
    options.scene, options.append = Path(options.scene), [Path(folder) for folder in options.append]
    scene, integrator, _ = load(options)
    return options, scene, integrator
