"""The configurations among which a pilot chooses."""

from __future__ import annotations

from dataclasses import replace

from ..scene.prepared import PreparedScene
from ..settings import LIGHT_PATHS, Settings
from ..transport.plan import Plan
from .configuration import WEIGHTINGS, Configuration
from .possible import UnreachablePaths, unreachable_paths

SERVED = tuple(round(1 / n) for n in LIGHT_PATHS if n)


def candidates(prepared: PreparedScene, full: Plan, settings: Settings) -> list[Configuration]:
    """All configurations that lose no light which ``full`` finds, with one inner connection or none.

    (All of them gain 1.02 at most in the scenes of docs/reports/choices.json, 1.13 in one of a small caustic,
    and one pilot of 32 chose them where they take 2.1 times as long.)
    """

    def lost_without_arrival(plan: Plan) -> tuple[UnreachablePaths, ...]:
        """A small lens is a poor finder of what t = 0 alone finds: it does not stand for connections.

        Nor does merging, which is not unbiased.
        """
        return unreachable_paths(prepared, replace(plan, arrival=False, merging=False), settings)

    found: list[Configuration] = []
    lost = lost_without_arrival(full)
    # A sensor with area sees delta emitters by light subpaths alone.
    tied = prepared.emitters.unhittable and not prepared.camera.delta and (full.endpoints or full.arrival)
    for weighting in WEIGHTINGS:
        if (weighting.inner and full.connections == "none") or (tied and not weighting.light):
            continue
        connections = "one" if weighting.inner else "none"
        if lost_without_arrival(Configuration.weighted(weighting, 1, connections).plan(full)) != lost:
            continue
        most = 1 / weighting.light if weighting.light else 1  # a coefficient beyond the count is of no use
        found += [Configuration.weighted(weighting, n, connections) for n in SERVED if n <= most]
    return found
