"""The configurations among which a pilot chooses, and the one under a uniform environment without a pilot."""

from __future__ import annotations

from dataclasses import replace

from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import Plan
from .budget import CHEAP_SAMPLES, EVEN
from .configuration import CANDIDATES, Configuration, Decision, not_worth
from .possible import UnsampledPaths, unsampled_paths

# kappa of s = 1 under an environment whose largest radiance is at most `UNIFORM` times the mean, where s = 0
# has little noise. From `UNIFORM_SAMPLES` on a pilot chooses. See experiments, "Choice of strategies".
UNIFORM_DIRECT, UNIFORM, UNIFORM_SAMPLES = 0.7, 2, 1 << 20

# Multiple of the samples that a pilot's kernel takes (`budget.samples_of_kernel`) from which on the pilot's
# gain there pays for it.
UNIFORM_TIMES = 10

LEFT_OUT = [
    not_worth(name, "all light comes from a uniform environment, and the render is too short for a pilot")
    for name in ("t<=1", "inner")
]


def candidates(prepared: PreparedScene, full: Plan, settings: Settings) -> list[Configuration]:
    """Those of `CANDIDATES` that sample the light that ``full`` samples."""

    def without_arrival(plan: Plan) -> tuple[UnsampledPaths, ...]:
        """Paths that are not sampled, when neither t = 0 nor merging counts.

        A small lens rarely samples such paths, and merging is not unbiased: neither replaces connections.
        """
        return unsampled_paths(prepared, replace(plan, arrival=False, merging=False), settings)

    def is_possible(candidate: Configuration) -> bool:
        if candidate.connections != "none" and full.connections == "none":
            return False
        return (candidate.light_paths > 0 or not tied) and without_arrival(candidate.plan(full)) == unsampled

    unsampled = without_arrival(full)
    # A sensor with area sees delta emitters only by light subpaths.
    tied = prepared.emitters.unhittable and not prepared.camera.delta and (full.endpoints or full.arrival)
    return [candidate for candidate in CANDIDATES if is_possible(candidate)]


def without_pilot(
    prepared: PreparedScene, full: Plan, settings: Settings, samples: int, of_kernel: int
) -> Decision | None:
    """Decision for a render of ``samples`` samples that needs no pilot, or None.

    Path tracing alone under a uniform environment in a render too short for a pilot, whose kernel takes as
    long as ``of_kernel`` samples: camera subpaths hit the environment wherever its light enters, caustics
    included, and light subpaths rarely find the way in.
    """
    contrast = prepared.emitters.contrast
    most = max(UNIFORM_TIMES * of_kernel, UNIFORM_SAMPLES if contrast <= UNIFORM else CHEAP_SAMPLES)
    if samples >= most or not contrast <= EVEN:  # also if it is NaN
        return None
    if all(candidate.light_paths for candidate in candidates(prepared, full, settings)):
        return None
    alone = Configuration(0.0, "none", 1.0, UNIFORM_DIRECT if contrast <= UNIFORM else 1.0)
    return Decision.of(alone, cost=1.0, variance=0.0, mean=0.0)
