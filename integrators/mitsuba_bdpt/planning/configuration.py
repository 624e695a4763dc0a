"""Configurations of a render, among which a pilot chooses, and decisions for one of them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from .. import components
from ..scene.prepared import PreparedScene
from ..settings import Settings
from ..transport.plan import JOINED, Plan
from . import budget
from .possible import unsampled_paths


@dataclass(frozen=True)
class Configuration:
    """Number of light subpaths, connections and coefficients of a render.

    ``light_paths`` and ``connections`` (``none``, ``one`` or ``all``) are the parameters; ``kappa_light`` is
    the coefficient of t <= 1 over its count, ``kappa_direct`` that of s = 1; ``guided``: guided samples per
    vertex (with `merging`: nonzero if vertices are merged although s = 0 samples that light); ``emission``:
    tables of guided emission; ``joined``: light subpaths with which each camera subpath is connected.
    """

    light_paths: float
    connections: str
    kappa_light: float
    kappa_direct: float
    guided: int = field(default=0, kw_only=True)
    emission: Any = field(default=None, kw_only=True)  # `guided_emission.EmissionTables`
    joined: int = field(default=1, kw_only=True)

    @property
    def weights(self) -> dict[str, float]:
        """Coefficient kappa times number of samples of each of `mis.CLASSES`; 0: not in use."""
        return {
            "hit": 1.0,
            "direct": self.kappa_direct,
            "light": self.kappa_light * self.light_paths,
            # As in `inputs._coefficients`.
            "inner": self.counts["inner"] if self.connections != "none" else 0.0,
        }

    @property
    def counts(self) -> dict[str, float]:
        """Number of independent samples per camera subpath, by class.

        A connection drawn by an approximation from M light subpaths is worth about sqrt(M) of them.
        """
        return {"hit": 1.0, "direct": 1.0, "light": self.light_paths, "inner": math.sqrt(self.joined)}

    def plan(self, full: Plan) -> Plan:
        """``full`` restricted to this configuration."""
        light = self.light_paths > 0
        adopted = replace(
            full,
            splat=full.splat and light,
            endpoints=full.endpoints and light,
            arrival=full.arrival and light,
            connections=self.connections if full.connections != "none" and light else "none",
            kappa_light=self.kappa_light,
            kappa_direct=self.kappa_direct,
            guided=max(self.guided, full.guided) if full.guidable and not full.merging else 0,
            merging=full.merging and (self.guided > 0 or not full.guidable),
        )
        joined = self.joined if adopted.connections == "one" else 1
        shared = round(1 / self.light_paths) if adopted.light else 1
        emission = self.emission if adopted.light else None
        return replace(adopted, camera_paths_per_light_path=shared, joined=joined, emission=emission)


PATH_TRACING = Configuration(0.0, "none", 1.0, 1.0)

# Configurations of which a pilot estimates variances. Each class of strategies, once in use, stays in use; in
# the last one strategies have the pilot's own weights. See experiments, "Choice of strategies".
CANDIDATES = (
    Configuration(0.0, "none", 1.0, 1 / 2),
    PATH_TRACING,
    Configuration(1 / 2, "none", 1 / 8, 1.0),
    Configuration(1 / 2, "none", 1 / 2, 1.0),
    Configuration(1.0, "none", 1 / 4, 1.0),
    Configuration(1 / 16, "one", 1 / 4, 1.0),
    Configuration(1 / 16, "one", 1 / 4, 1.0, joined=JOINED[-1]),
    Configuration(1 / 4, "one", 1 / 16, 1.0),
    Configuration(1 / 2, "one", 1 / 32, 1.0),
    Configuration(1.0, "one", 1 / 16, 1.0),
    Configuration(1 / 2, "one", 1 / 2, 1.0),
    Configuration(1.0, "one", 1.0, 1.0),
)


NOT_WORTH = "not worth its cost here"  # level of ``statistics["skipped"]`` of strategies that do not pay


def not_worth(name: str, why: str) -> dict[str, str]:
    """Entry of ``statistics["skipped"]``."""
    return {"class": name, "level": NOT_WORTH, "why": why}


# Contributions below a share of the image's mean play roulette before their shadow ray is traced: the smaller
# of this share and this multiple of a sample's relative variance. It bounds the variance that roulette adds.
MOST_ROULETTE, ROULETTE_PER_VARIANCE = 0.1, 0.2


@dataclass(frozen=True)
class Decision(Configuration):
    """The configuration of a render, with the `choice.Prediction` and the ``mean`` of the image."""

    cost: float
    variance: float
    mean: float

    @classmethod
    def of(cls, chosen: Configuration, **predictions: Any) -> Decision:
        """Round the predictions to six digits: others depend on the order of a pilot's atomic additions."""
        rounded: dict[str, Any] = {name: float(f"{x:.6g}") for name, x in predictions.items()}
        return cls(**vars(chosen), **rounded)

    @property
    def threshold(self) -> float:
        """Absolute size below which contributions play roulette."""
        return self.mean * min(MOST_ROULETTE, ROULETTE_PER_VARIANCE * self.variance)

    def record(self) -> dict[str, Any]:
        """Entry of ``statistics["decisions"]``."""
        values = asdict(self)
        values["coefficients"] = {"t<=1": values.pop("kappa_light"), "s=1": values.pop("kappa_direct")}
        return values

    @staticmethod
    def read(record: dict[str, Any]) -> Decision:
        """Inverse of `record`."""
        values = dict(record)
        coefficients = values.pop("coefficients")
        if emission := values.get("emission"):
            values["emission"] = components.guided_emission.EmissionTables(**emission)
        return Decision(kappa_light=coefficients["t<=1"], kappa_direct=coefficients["s=1"], **values)


# kappa of s = 1 under an environment whose largest radiance is at most `UNIFORM` times the mean, where s = 0
# has little noise. From `UNIFORM_SAMPLES`, and from `UNIFORM_TIMES` the samples that a pilot's kernel takes
# (`budget.samples_of_kernel`) on a pilot chooses. See experiments, "Choice of strategies".
UNIFORM_DIRECT, UNIFORM, UNIFORM_SAMPLES, UNIFORM_TIMES = 0.7, 2, 1 << 20, 10

_SHORT = "all light comes from a uniform environment, and the render is too short for a pilot"
LEFT_OUT = [not_worth(name, _SHORT) for name in ("t<=1", "inner")]


def candidates(prepared: PreparedScene, full: Plan, settings: Settings) -> list[Configuration]:
    """Those of `CANDIDATES` that sample the light that ``full`` samples without t = 0 and merging.

    A small lens rarely samples light by t = 0, and merging is not unbiased: neither replaces connections.
    """
    # A sensor with area sees delta emitters only by light subpaths.
    tied = prepared.emitters.unhittable and not prepared.camera.delta and (full.endpoints or full.arrival)
    plan = replace(full, arrival=False, merging=False)
    unsampled = unsampled_paths(prepared, plan, settings)
    return [
        candidate
        for candidate in CANDIDATES
        if (candidate.connections == "none" or full.connections != "none")
        and (candidate.light_paths or not tied)
        and unsampled_paths(prepared, candidate.plan(plan), settings) == unsampled
    ]


def without_pilot(prepared: PreparedScene, full: Plan, settings: Settings, samples: int) -> Decision | None:
    """Path tracing alone under a uniform environment, if ``samples`` are too few for a pilot; else None.

    Camera subpaths hit the environment wherever its light enters, caustics included, and light subpaths
    rarely find the way in.
    """
    contrast, of_kernel = prepared.emitters.contrast, budget.samples_of_kernel(prepared)
    most = max(UNIFORM_TIMES * of_kernel, UNIFORM_SAMPLES if contrast <= UNIFORM else budget.CHEAP_SAMPLES)
    if samples >= most or not contrast <= budget.EVEN:  # also if it is NaN
        return None
    if all(candidate.light_paths for candidate in candidates(prepared, full, settings)):
        return None
    alone = Configuration(0.0, "none", 1.0, UNIFORM_DIRECT if contrast <= UNIFORM else 1.0)
    return Decision.of(alone, cost=1.0, variance=0.0, mean=0.0)
