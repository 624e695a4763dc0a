"""Counts and times of a render, and the statistics computed from them."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from typing import NotRequired, TypedDict

import drjit as dr
import mitsuba as mi

from ..transport.contribution import COUNTERS, MEDIA, MERGING


@dataclass(frozen=True)
class Work:
    """Counted work of a render, part of its progress.

    ``counts``: sums of `COUNTERS` by name; ``compiled`` and ``cached`` kernels; ``seconds`` in total, of
    which ``compile_seconds`` compile kernels and ``pilot_seconds`` run pilots (without compilation).
    """

    counts: dict = field(default_factory=lambda: dict.fromkeys(COUNTERS, 0))
    compiled: int = 0
    cached: int = 0
    seconds: float = 0.0
    compile_seconds: float = 0.0
    pilot_seconds: float = 0.0

    @property
    def idle_seconds(self) -> float:
        """Seconds without samples of the image."""
        return self.compile_seconds + self.pilot_seconds

    def joined(self, other: Work) -> Work:
        """Return the work of two merged renders."""
        names = [f.name for f in fields(self) if f.name != "counts"]
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return Work({name: n + other.counts[name] for name, n in self.counts.items()}, **sums)


class Meter:
    """Waits for the launches of one render, and measures them."""

    def __init__(self):
        self._started, self._running = time.perf_counter(), []
        self._noted = self._earlier = Work()
        self._earlier_spp = 0

    def resume(self, work: Work, spp: int):
        """Continue from the ``work`` of an earlier part with ``spp`` samples per pixel."""
        self._noted, self._earlier, self._earlier_spp = work, work, spp

    @property
    def work(self) -> Work:
        """All work so far, including earlier parts of the render."""
        return replace(self._noted, seconds=self._earlier.seconds + self.elapsed())

    def elapsed(self) -> float:
        """Return the seconds since this part of the render began."""
        return time.perf_counter() - self._started

    def rate(self, spp: int) -> float:
        """Samples per pixel and second of this part, at ``spp`` in total, without compilation and pilots."""
        busy = self.elapsed() - (self._noted.idle_seconds - self._earlier.idle_seconds)
        return (spp - self._earlier_spp) / max(busy, 1e-3)

    def launched(self, counts):
        """Add a launched batch; ``counts`` are those of `kernel.trace`."""
        self._running.append(counts)

    def wait(self):
        """Wait for what was launched, and add its counts and compile times."""
        dr.sync_thread()
        while self._running:
            batch = self._running.pop().numpy().tolist()
            counts = self._noted.counts
            counts = {name: counts[name] + n for name, n in zip(counts, batch, strict=True)}
            self._noted = replace(self._noted, counts=counts)
        for entry in dr.kernel_history():
            work = self._noted
            if entry["type"] != dr.KernelType.JIT:
                continue
            if entry["cache_hit"]:  # it is still assembled, which is not counted as compilation
                self._noted = replace(work, cached=work.cached + 1)
            else:
                seconds = work.compile_seconds + (entry["codegen_time"] + entry["backend_time"]) / 1000
                self._noted = replace(work, compiled=work.compiled + 1, compile_seconds=seconds)

    @contextmanager
    def pilot(self):
        """Measures the body as a pilot, after waiting for earlier passes."""
        self.wait()
        started, compiled = time.perf_counter(), self._noted.compile_seconds
        yield
        self.wait()
        spent = time.perf_counter() - started - (self._noted.compile_seconds - compiled)
        self._noted = replace(self._noted, pilot_seconds=self._noted.pilot_seconds + spent)


# Kinds of rays in the statistics that the kernel counts.
RAYS = ("camera", "light", "shadow_s1", "shadow_t1", "shadow_inner")


class Statistics(TypedDict):
    """Statistics of a finished or interrupted render: plain values, JSON-serialisable."""

    seconds: dict[str, float]
    """``compile``, ``pilot``, ``render`` and ``total``."""
    rays: dict[str, int]
    """By kind: ``camera`` and ``light`` subpaths; shadow rays ``shadow_s1``, ``shadow_t1``, ``shadow_inner``;
    ``photon`` subpaths; ``guided`` subpaths; ``features``."""
    connections: dict[str, int]
    """Inner connections: ``evaluated``, ``zero``, ``rouletted``, ``traced``."""
    media: NotRequired[dict[str, int]]
    """In scenes with media: ``segments`` of edges and connections, each with a ray of its own (``rays``
    counts a shadow ray through null surfaces once), and tentative ``collisions`` in grids."""
    merging: NotRequired[dict[str, int | str]]
    """Where vertices are merged: ``why``, the ``photons`` kept, and ``merges``, camera vertices near at least
    one photon."""
    unbiased: bool
    """False where vertices are merged, which is consistent."""
    skipped: list[dict]
    """The strategies that were skipped, and why."""
    decisions: list[dict]
    """The decision of a pilot or of the scene alone, or none."""
    no_pilot: str
    """Why no pilot ran, or none decided."""
    pilots: dict[str, int]
    """Whether a pilot was ``rendered``, or its results were ``cached`` by an earlier render: 0 or 1."""
    passes: list[int]
    """Samples per pixel of each pass."""
    non_finite: int
    """Contributions that were NaN or infinite and count as zero."""
    non_finite_in_pilot: int
    """The same in the pilot."""
    unsampled_light: NotRequired[dict[int, float]]
    """Estimated share of the image's light that no strategy samples, by index in ``scene.emitters()``."""
    light_groups: NotRequired[dict[str, list[list[str]]]]
    """Of each light group the ids of each emitter: of its shape, its own; with ``light_groups``."""
    error: NotRequired[float | None]
    """Estimated relMSE, with ``variance``."""
    kernels: dict[str, int]
    """Kernels ``compiled`` and ``cached``."""
    peak_memory: int
    """Bytes that Dr.Jit held at most."""


def rays(render) -> dict[str, int]:
    """Return the rays of a `Render` so far, by kind."""
    counts = render.meter.work.counts
    found = {name: counts[name] for name in RAYS}
    if render.settings.merging or render.plan.guided:
        found["photon"] = counts["photon"]
    if render.plan.guided:
        found["guided"] = counts["guided"]
    if render.accumulator.features is not None:  # one per camera sample
        found["features"] = sum(render.accumulator.passes) * int(render.prepared.camera.region.size.prod())
    return found


def statistics(render) -> Statistics:
    """Return the statistics of a `Render` so far, without ``unsampled_light``."""
    work, planner, accumulator = render.meter.work, render.planner, render.accumulator
    decided, counts = planner.decided, work.counts
    connections = {name: counts[name] for name in ("evaluated", "zero", "rouletted")}
    connections["traced"] = counts["shadow_inner"]
    found: Statistics = {
        "seconds": {
            "compile": work.compile_seconds,
            "pilot": work.pilot_seconds,
            "render": work.seconds - work.idle_seconds,
            "total": work.seconds,
        },
        "rays": rays(render),
        "connections": connections,
        "unbiased": not render.plan.merging,
        "skipped": [dict(left_out) for left_out in (*planner.full.skipped, *decided.left_out)],
        "decisions": [decision.record() for decision in decided.decisions],
        "no_pilot": decided.no_pilot,
        "pilots": {name: int(decided.pilot == name) for name in ("rendered", "cached")},
        "passes": list(accumulator.passes),
        "non_finite": counts["non_finite"],
        "non_finite_in_pilot": decided.non_finite,
        "kernels": {"compiled": work.compiled, "cached": work.cached},
        "peak_memory": int(dr.detail.malloc_watermark(dr.backend_v(mi.Float))),
    }
    if render.prepared.space is not None:
        found["media"] = {name: counts[name] for name in MEDIA}
    if render.settings.merging:
        found["merging"] = {"why": render.why_merged} | {name: counts[name] for name in MERGING}
    if render.light_groups is not None:
        found["light_groups"] = {name: list(lamps) for name, lamps in render.light_groups.lamps.items()}
    if render.settings.variance:
        found["error"] = accumulator.error()
    return found
