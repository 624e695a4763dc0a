"""Describes which strategies a render uses and skips, and why."""

from __future__ import annotations

from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import Plan
from .choice import NEAR, Prediction, why_not
from .configuration import Configuration
from .possible import Rest, Start, UnreachablePaths, unreachable_paths

_STARTS = {
    Start.DELTA_EMITTER: "delta emitter, delta surfaces",
    Start.BEAM: "directionalarea",
    Start.DIRECT_DELTA_EMITTER: "delta emitter",
}
_RESTS = {
    Rest.SEEN_VERTEX: ", a {vertex} that the sensor sees",
    Rest.VERTICES: ", two other {vertices} or more, delta surfaces or none, sensor",
    Rest.VERTEX_BETWEEN_DELTA: ", a single other {vertex}, delta surfaces, sensor (no two neighbours can be "
    "connected)",
    Rest.SENSOR: ", sensor",
    Rest.LONG: ", ... on paths longer than {longest} edges",
}


def words(lost: UnreachablePaths) -> str:
    """Describe paths that no strategy in use can sample."""
    starts = " or ".join(_STARTS[start] for start in lost.starts)
    vertex, vertices = "surface", "surfaces"
    if lost.volumes:
        vertex, vertices = "surface or scattering in a medium", "surfaces or scatterings in media"
    rest = _RESTS[lost.rest].format(longest=lost.longest, vertex=vertex, vertices=vertices)
    return f"{starts}{rest} (needs {lost.needs})" if lost.needs else f"{starts}{rest}"


def subpaths(count: int) -> str:
    """Number of camera subpaths as text."""
    return f"{count} camera subpaths" if count > 1 else "camera subpath"


def explain(
    prepared: PreparedScene,
    p: Plan,
    settings: Settings,
    table: list[Prediction],
    confidence: float = 0.0,
    lost_by_pilot: int = 0,
) -> str:
    """Describe the strategies in use and those skipped.

    ``table``: a pilot's predictions (`choice.choose`), with `choice.confidence`; empty without a pilot.
    ``lost_by_pilot``: number of non-finite values of the pilot.
    """
    used = [
        name
        for name, on in (
            ("s=0 (camera subpath hits an emitter)", p.hit),
            ("s=1 (next-event estimation)", p.direct),
            ("t=1 (light vertex seen by the sensor)", p.splat),
            ("(1,1) (emitter point seen by the sensor)", p.endpoints),
            ("t=0 (light subpath hits the sensor)", p.arrival),
            (
                f"guided s=0 ({p.guided} per vertex of SDS paths)",
                p.guided,
            ),
            (f"inner connections s,t>=2 ({p.connections})", p.connections != "none"),
            (_guided_emission(p), p.emission is not None),
        )
        if on
    ]
    lines = [
        f"heuristic {settings.heuristic}, one light subpath per {subpaths(p.camera_paths_per_light_path)}"
        + (f", each of which is connected with {p.joined} of them" if p.joined > 1 else "")
        if p.light
        else f"heuristic {settings.heuristic}, no light subpaths"
    ]
    lines += [f"used: {name}" for name in used]
    if p.merging:
        lines.append(
            "used: vertex merging (photon mapping) of SDS paths (the render is consistent, not unbiased)"
        )
    lines += [f"skipped ({s['level']}): {s['class']}: {s['why']}" for s in p.skipped]
    longest = prepared.stored_vertices(settings)
    if (p.splat or p.arrival or p.connections != "none") and longest < settings.max_depth:
        lines.append(f"limited: paths of more than {longest} edges use s=0 and s=1 only")
    missing = unreachable_paths(prepared, p, settings)
    lines += [f"lost: {words(lost)}" for lost in missing]
    if any(lost.volumes for lost in missing):
        lines.append("lost light: the estimate of its share leaves out vertices in media")
    if prepared.emitters.evaluated:
        lines.append(
            "slow: a timed_sunsky lives, here or in another scene; calls that visit it cannot be recorded in "
            "one kernel"
        )
    if lost_by_pilot:
        lines.append(f"not finite: {lost_by_pilot} values of the pilot, which decided from the rest")
    return "\n".join(lines + _pilot(settings, table, confidence))


def _guided_emission(p: Plan) -> str:
    if p.emission is None:
        return ""
    return (
        f"guided emission (light subpaths are aimed; the pilot predicts that {p.emission.left:.0%} of their "
        "part of the squared error is left)"
    )


def _named(candidate: Configuration) -> str:
    """Describe a candidate by parameters and coefficients."""
    if not candidate.light_paths:
        return f"light_paths=0, coefficient of s=1 {candidate.kappa_direct:g}"
    guided = f", guided={candidate.guided}" if candidate.guided else ""
    light = f"light_paths=1/{candidate.camera_paths_per_light_path}, connections={candidate.connections}"
    return f"{light}{guided}, coefficient of t<=1 {candidate.kappa_light:g}"


def _pilot(settings: Settings, table: list[Prediction], confidence: float) -> list[str]:
    """Describe the predictions, and the confidence in the first."""
    if not table:
        return []
    head = (
        "pilot: time to the same error, over that of the chosen (cost of a sample; its relMSE, including the "
    )
    lines = [head + "stratification gain):"]
    for row in table:
        why = why_not(row, table[0])
        lines.append(
            f"  {row.time / table[0].time:8.2f}  {_named(row.candidate)} ({row.cost:.2f}, {row.variance:.3g})"
            + (f"; not chosen: {why}" if why else "")
        )
    if table[0].candidate.guided:
        lines.append(
            f"  guided s=0 gains {table[0].gain:.3g}x, by fewer outliers of SDS paths, which none of "
            "these figures has"
        )
    if table[0].without_tables:
        lines.append("  guided emission is in none of these figures")
    if (joined := table[0].candidate.joined) > 1:
        lines.append(f"  they are of one light subpath at a time, not of {joined}")
    lines.append(
        f"  confidence: in {confidence:.0%} of bootstrap resamples of the pilot the chosen configuration is "
        f"within {NEAR:g}x of the best"
    )
    if settings.heuristic != "balance":
        lines.append(f"  the figures are those of the balance heuristic, not of {settings.heuristic}")
    return lines
