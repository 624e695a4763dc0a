"""A render in numbers."""

from __future__ import annotations

from typing import NotRequired, TypedDict

import drjit as dr
import mitsuba as mi

from ..transport.counters import MEDIA, MERGING

# Kinds of rays in the statistics, of what the kernel counts.
RAYS = ("camera", "light", "shadow_s1", "shadow_t1", "shadow_inner")


class Statistics(TypedDict):
    """A render in numbers, after it has ended or was interrupted: plain values, which JSON can hold."""

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
    merging: NotRequired[dict[str, int]]
    """With ``merging``: the ``photons`` kept, and ``merges``, camera vertices near at least one photon."""
    unbiased: bool
    """False with ``merging``, which is consistent."""
    skipped: list[dict]
    """The strategies that were skipped, and why."""
    decisions: list[dict]
    """The decisions of a pilot, of the scene alone or of the parameter ``decisions``, whose value is their
    JSON."""
    no_pilot: str
    """Why no pilot ran, or none decided. Empty where one did, and where ``decisions`` were given."""
    pilots: dict[str, int]
    """How many pilots were ``asked`` for, and how many results were ``remembered`` from earlier renders."""
    passes: list[int]
    """Samples per pixel of each pass."""
    non_finite: int
    """Contributions that were NaN or infinite and count as zero."""
    non_finite_in_pilot: int
    """The same in the pilots."""
    lost_light: NotRequired[dict[int, float]]
    """Estimated share of the image's light that no strategy samples, by index of the emitter."""
    error: NotRequired[float | None]
    """Estimated relMSE, with ``variance``."""
    kernels: dict[str, int]
    """Kernels ``compiled`` and ``cached``."""
    peak_memory: int
    """Bytes that Dr.Jit held at most."""


def rays(render) -> dict[str, int]:
    """Rays of a `Render` so far, by kind."""
    counts = render.meter.work.counts
    found = {name: counts[name] for name in RAYS}
    if render.settings.merging or render.plan.guided:
        found["photon"] = counts["photon"]
    if render.plan.guided:
        found["guided"] = counts["guided"]
    if render.accumulator.features is not None:  # one per camera sample
        pixels = int(render.prepared.camera.region.size.prod())
        found["features"] = sum(render.accumulator.passes) * pixels
    return found


def statistics(render) -> Statistics:
    """Return the statistics of a `Render` so far, without ``lost_light``."""
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
        "skipped": [dict(left_out) for left_out in render.plan.skipped],
        "decisions": [decision.record() for decision in decided.decisions],
        "no_pilot": decided.no_pilot,
        "pilots": {"asked": decided.pilots.asked, "remembered": decided.pilots.remembered},
        "passes": list(accumulator.passes),
        "non_finite": counts["non_finite"],
        "non_finite_in_pilot": planner.lost_by_pilots(),
        "kernels": {"compiled": work.compiled, "cached": work.cached},
        "peak_memory": int(dr.detail.malloc_watermark(dr.backend_v(mi.Float))),
    }
    if render.prepared.space is not None:
        found["media"] = {name: counts[name] for name in MEDIA}
    if render.settings.merging:
        found["merging"] = {name: counts[name] for name in MERGING}
    if render.settings.variance:
        found["error"] = accumulator.error()
    return found
