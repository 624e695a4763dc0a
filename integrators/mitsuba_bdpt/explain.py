"""What a render does and does not do, and why, in words."""

from __future__ import annotations

from .plan import Plan, Settings, lost_paths


def explain(world, p: Plan, settings: Settings, decisions, table) -> str:
    """Text about the strategies in use and those that are skipped.

    ``decisions`` and ``table`` are a pilot's, see `choice.choose`; empty without one.
    """
    used = [
        name
        for name, on in (
            ("s=0 (camera subpath hits an emitter)", p.hit),
            ("s=1 (next-event estimation)", p.direct),
            ("t=1 (light vertex seen by the sensor)", p.splat),
            ("(1,1) (emitter point seen by the sensor)", p.endpoints),
            ("t=0 (light subpath hits the sensor)", p.arrival),
            (f"inner connections s,t>=2 ({p.connections})", p.connections != "none"),
        )
        if on
    ]
    lines = [
        f"heuristic {settings.heuristic}, one light subpath per {p.served} camera subpaths"
        if p.light
        else f"heuristic {settings.heuristic}, no light subpaths"
    ]
    lines += [f"used: {name}" for name in used]
    lines += [f"skipped ({s['level']}): {s['class']}: {s['why']}" for s in p.skipped]
    if (p.splat or p.arrival or p.connections != "none") and settings.stored_vertices < settings.max_depth:
        lines.append(f"limited: paths of more than {settings.stored_vertices} edges use s=0 and s=1 only")
    lines += [f"lost: {text}" for text in lost_paths(world, p, settings)]
    if world.emitters.evaluated:
        lines.append(
            "slow: a timed_sunsky lives, here or in another scene; calls that visit it cannot be recorded in "
            "one kernel"
        )
    return "\n".join(lines)
