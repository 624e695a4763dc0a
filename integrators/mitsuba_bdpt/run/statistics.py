"""A render in numbers."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..transport.counters import MEDIA, MERGING

# Kinds of rays in the statistics, of what the kernel counts.
RAYS = ("camera", "light", "shadow_s1", "shadow_t1", "shadow_inner")


def rays(render) -> dict:
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


def statistics(render) -> dict:
    """A `Render` so far, as plain values."""
    work, planner, accumulator = render.meter.work, render.planner, render.accumulator
    decided, counts = planner.decided, work.counts
    connections = {name: counts[name] for name in ("evaluated", "zero", "rouletted")}
    connections["traced"] = counts["shadow_inner"]
    return {
        "seconds": {
            "compile": work.compile_seconds,
            "pilot": work.pilot_seconds,
            "render": work.seconds - work.idle_seconds,
            "total": work.seconds,
        },
        "rays": rays(render),
        "connections": connections,
        **({"media": {n: counts[n] for n in MEDIA}} if render.prepared.space is not None else {}),
        **({"merging": {n: counts[n] for n in MERGING}} if render.settings.merging else {}),
        "unbiased": not render.plan.merging,
        "skipped": [dict(left_out) for left_out in render.plan.skipped],
        "decisions": [decision.record() for decision in decided.decisions],
        "no_pilot": decided.no_pilot,
        "pilots": {"asked": decided.pilots.asked, "remembered": decided.pilots.remembered},
        "passes": list(accumulator.passes),
        "non_finite": counts["non_finite"],
        "non_finite_in_pilot": planner.lost_by_pilots(),
        "kernels": {"compiled": work.compiled, "cached": work.cached},
        **({"error": accumulator.error()} if render.settings.variance else {}),
        "peak_memory": int(dr.detail.malloc_watermark(dr.backend_v(mi.Float))),
    }
