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
    """All configurations that sample the light that ``full`` samples.

    With one inner connection or none: all connections hardly gain (experiments, "Choice of strategies").
    """

    def lost_without_arrival(plan: Plan) -> tuple[UnreachablePaths, ...]:
        """Paths that are not sampled, when neither t = 0 nor merging counts.

        A small lens rarely samples such paths, and merging is not unbiased: neither replaces connections.
        """
        return unreachable_paths(prepared, replace(plan, arrival=False, merging=False), settings)

    found: list[Configuration] = []
    lost = lost_without_arrival(full)
    # A sensor with area sees delta emitters only by light subpaths.
    tied = prepared.emitters.unhittable and not prepared.camera.delta and (full.endpoints or full.arrival)
    for weighting in WEIGHTINGS:
        if (weighting.inner and full.connections == "none") or (tied and not weighting.light):
            continue
        connections = "one" if weighting.inner else "none"
        if lost_without_arrival(Configuration.weighted(weighting, 1, connections).plan(full)) != lost:
            continue
        most = 1 / weighting.light if weighting.light else 1  # a larger coefficient is of no use
        found += [Configuration.weighted(weighting, n, connections) for n in SERVED if n <= most]
    return found
