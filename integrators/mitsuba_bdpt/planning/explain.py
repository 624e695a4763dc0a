"""Describes which strategies a render uses and skips, and why."""

from __future__ import annotations

from fractions import Fraction

from ..scene.diagnostics import spoilt
from .choice import NEAR, confidence, why_not
from .configuration import Configuration
from .planner import Planner
from .possible import unsampled_paths


def explain(planner: Planner, not_sampled: str = "") -> str:
    """Describe the strategies in use and those skipped; ``not_sampled``: about unsampled light."""
    p, decided, prepared, settings = planner.plan, planner.decided, planner.prepared, planner.settings
    light = "no light subpaths"
    if p.light:
        light = f"camera subpaths per light subpath: {p.camera_paths_per_light_path}, "
        light += f"light subpaths per lane: {p.joined}"
    merged = "SDS paths" + " and of paths that connections rarely sample" * bool(prepared.near_specular)
    left = f"{p.emission.left:.0%}" if p.emission else ""
    used = {
        "s=0 (camera subpath hits an emitter)": p.hit,
        "s=1 (next-event estimation)": p.direct,
        "t=1 (light vertex seen by the sensor)": p.splat,
        "(1,1) (emitter point seen by the sensor)": p.endpoints,
        "t=0 (light subpath hits the sensor)": p.arrival,
        f"guided s=0 ({p.guided} per vertex of SDS paths)": p.guided,
        f"inner connections s,t>=2 ({p.connections})": p.connections != "none",
        f"guided emission (predicted to lower squared errors of light subpaths to {left})": p.emission,
        f"vertex merging (photon mapping) of {merged} (the render is consistent, not unbiased)": p.merging,
    }
    lines = [f"heuristic {settings.heuristic}, {light}"]
    lines += [f"used: {name}" for name, on in used.items() if on]
    skipped = (*planner.full.skipped, *decided.left_out)
    lines += [f"skipped ({s['level']}): {s['class']}: {s['why']}" for s in skipped]
    longest = prepared.stored_vertices(settings)
    if (p.splat or p.arrival or p.connections != "none") and longest < settings.max_depth:
        lines.append(f"limited: paths of more than {longest} edges use s=0 and s=1 only")
    lines += [f"not sampled: {unsampled}" for unsampled in unsampled_paths(prepared, p, settings)]
    if not_sampled:
        lines.append(not_sampled)
    lines += [f"warning: {text}" for text in spoilt(prepared, settings)]
    if prepared.emitters.evaluated:
        lines.append("slow: a timed_sunsky lives, here or in another scene: no kernel records its calls")
    if decided.non_finite:
        lines.append(f"invalid samples (NaN or infinite): {decided.non_finite} of the pilot")
    return "\n".join(lines + (_pilot(planner) if planner.table else []))


def _named(candidate: Configuration) -> str:
    """Describe a candidate by parameters and coefficients."""
    if not candidate.light_paths:
        return f"light_paths=0, coefficient of s=1: {candidate.kappa_direct:g}"
    guided = f", guided={candidate.guided}" if candidate.guided else ""
    light = f"light_paths={Fraction(candidate.light_paths)}, connections={candidate.connections}"
    lane = f", {candidate.joined} light subpaths per lane" if candidate.joined > 1 else ""
    return f"{light}{guided}{lane}, coefficient of t<=1: {candidate.kappa_light:g}"


def _pilot(planner: Planner) -> list[str]:
    """Describe the predictions; the last line is the choice and its confidence."""
    table, heuristic = planner.table, planner.settings.heuristic
    lines = [
        "pilot: the chosen configuration first; cost and relMSE relative to path tracing alone",
        "  relative time  cost per sample     error  configuration",
    ]
    for row in table:
        why = why_not(row, table[0])
        figures = f"{row.time / table[0].time:15.2f}  {row.cost:15.2f}  {row.error:8.3g}"
        lines.append(f"{figures}  {_named(row.candidate)}" + (f"; not chosen: {why}" if why else ""))
    if heuristic != "balance":
        lines.append(f"  the figures are those of the balance heuristic, not of {heuristic}")
    sure = f"{confidence(*planner.measured):.0%} of bootstrap resamples of the pilot"
    return [
        *lines,
        f"chosen: {_named(table[0].candidate)} (confidence: in {sure} it is within {NEAR:g}x of the best)",
    ]
