"""Describes which strategies a render uses and skips, and why."""

from __future__ import annotations

from fractions import Fraction

from ..scene.diagnostics import spoilt
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import Plan
from .choice import NEAR, Prediction, why_not
from .configuration import Configuration
from .possible import unsampled_paths


def explain(
    prepared: PreparedScene,
    p: Plan,
    settings: Settings,
    table: list[Prediction],
    confidence: float = 0.0,
    invalid: int = 0,
    not_sampled: str = "",
) -> str:
    """Describe the strategies in use and those skipped.

    ``table``: a pilot's predictions (`choice.choose`), with `choice.confidence`; empty without a pilot.
    ``invalid``: number of non-finite values of the pilot; ``not_sampled``: sentence about unsampled light.
    """
    light = "no light subpaths"
    if p.light:
        count = p.camera_paths_per_light_path
        light = f"one light subpath per {f'{count} camera subpaths' if count > 1 else 'camera subpath'}"
        light += f", each of which is connected with {p.joined} of them" * (p.joined > 1)
    merged = "SDS paths" + " and of paths that connections rarely sample" * bool(prepared.near_specular)
    used = {
        "s=0 (camera subpath hits an emitter)": p.hit,
        "s=1 (next-event estimation)": p.direct,
        "t=1 (light vertex seen by the sensor)": p.splat,
        "(1,1) (emitter point seen by the sensor)": p.endpoints,
        "t=0 (light subpath hits the sensor)": p.arrival,
        f"guided s=0 ({p.guided} per vertex of SDS paths)": p.guided,
        f"inner connections s,t>=2 ({p.connections})": p.connections != "none",
        _guided_emission(p): p.emission,
        f"vertex merging (photon mapping) of {merged} (the render is consistent, not unbiased)": p.merging,
    }
    lines = [
        f"heuristic {settings.heuristic}, {light}",
        *(f"used: {name}" for name, on in used.items() if on),
    ]
    lines += [f"skipped ({s['level']}): {s['class']}: {s['why']}" for s in p.skipped]
    longest = prepared.stored_vertices(settings)
    if (p.splat or p.arrival or p.connections != "none") and longest < settings.max_depth:
        lines.append(f"limited: paths of more than {longest} edges use s=0 and s=1 only")
    lines += [f"not sampled: {unsampled}" for unsampled in unsampled_paths(prepared, p, settings)]
    if not_sampled:
        lines.append(not_sampled)
    lines += [f"warning: {text}" for text in spoilt(prepared, settings)]
    if prepared.emitters.evaluated:
        lines.append(
            "slow: a timed_sunsky lives, here or in another scene; calls that visit it cannot be recorded in "
            "one kernel"
        )
    if invalid:
        lines.append(
            f"invalid samples (NaN or infinite): {invalid} of the pilot, which decided from the rest"
        )
    return "\n".join(lines + _pilot(settings, table, confidence))


def _guided_emission(p: Plan) -> str:
    if p.emission is None:
        return ""
    return (
        "guided emission (the pilot predicts that it lowers the squared error of strategies with light "
        f"subpaths to {p.emission.left:.0%})"
    )


def _named(candidate: Configuration) -> str:
    """Describe a candidate by parameters and coefficients."""
    if not candidate.light_paths:
        return f"light_paths=0, coefficient of s=1: {candidate.kappa_direct:g}"
    guided = f", guided={candidate.guided}" if candidate.guided else ""
    light = f"light_paths={Fraction(candidate.light_paths)}, connections={candidate.connections}"
    lane = f", {candidate.joined} light subpaths per lane" if candidate.joined > 1 else ""
    return f"{light}{guided}{lane}, coefficient of t<=1: {candidate.kappa_light:g}"


def _pilot(settings: Settings, table: list[Prediction], confidence: float) -> list[str]:
    """Describe the predictions; the last line is the choice and its confidence."""
    if not table:
        return []
    head = (
        "pilot: predictions, the chosen configuration first (time to the same error; cost and error relative "
    )
    lines = [
        head
        + "to path tracing alone; error: geometric mean of the relMSE of the mean render and a typical one)",
        "  relative time  cost per sample     error  configuration",
    ]
    for row in table:
        why = why_not(row, table[0])
        figures = f"{row.time / table[0].time:15.2f}  {row.cost:15.2f}  {row.error:8.3g}"
        lines.append(f"{figures}  {_named(row.candidate)}" + (f"; not chosen: {why}" if why else ""))
    if table[0].candidate.guided:
        lines.append(
            f"  guided s=0 gains {table[0].gain:.3g}x, by fewer outliers of SDS paths, which none of "
            "these figures has"
        )
    if settings.heuristic != "balance":
        lines.append(f"  the figures are those of the balance heuristic, not of {settings.heuristic}")
    lines.append(
        f"chosen: {_named(table[0].candidate)} (confidence: in {confidence:.0%} of bootstrap resamples of "
        f"the pilot it is within {NEAR:g}x of the best)"
    )
    return lines
