"""Configurations of a render: light subpaths, connections, coefficients.

A pilot estimates the variance of each of `CANDIDATES`. A `Decision` is a configuration in use with its
predictions; it has a JSON form.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeGuard

from .. import components
from ..errors import UsageError
from ..settings import CONNECTIONS, LIGHT_PATHS
from ..transport.plan import JOINED, MOST_GUIDED, EmissionTables, Plan


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
    emission: EmissionTables | None = field(default=None, kw_only=True)
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

    @property
    def number(self) -> int:
        """Index of the candidate that this is, whatever was decided beside it."""
        return CANDIDATES.index(replace(self, guided=0, emission=None))

    @property
    def camera_paths_per_light_path(self) -> int:
        """Camera subpaths per light subpath (S); 1 without light subpaths."""
        return round(1 / self.light_paths) if self.light_paths else 1

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
        served = self.camera_paths_per_light_path if adopted.light else 1
        joined = self.joined if adopted.connections == "one" else 1
        emission = self.emission if adopted.light else None
        return replace(adopted, camera_paths_per_light_path=served, joined=joined, emission=emission)


# Configurations of which a pilot estimates variances. Each class of strategies, once in use, stays in use; in
# the last one strategies have the pilot's own weights. See experiments, "Choice of strategies".
CANDIDATES = (
    Configuration(0.0, "none", 1.0, 1 / 2),
    Configuration(0.0, "none", 1.0, 1.0),
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


# Level of ``statistics["skipped"]`` of strategies that do not pay.
NOT_WORTH = "not worth its cost here"


def not_worth(name: str, why: str) -> dict[str, str]:
    """Entry of ``statistics["skipped"]`` of a class of strategies that does not pay."""
    return {"class": name, "level": NOT_WORTH, "why": why}


# Contributions below a share of the image's mean play roulette before their shadow ray is traced: the smaller
# of this share and this multiple of a sample's relative variance. It bounds the variance that roulette adds.
MOST_ROULETTE, ROULETTE_PER_VARIANCE = 0.1, 0.2

# Bound of recorded numbers, so that products fit into single precision.
LARGEST = 1e30

# Entries of a record, see `Decision.record`.
ENTRIES = (
    *("pass", "light_paths", "connections", "guided", "emission", "joined", "coefficients"),
    *("cost", "variance", "mean"),
)


@dataclass(frozen=True)
class Decision(Configuration):
    """The configuration from pass ``first_pass`` on, with its predictions.

    ``cost`` of a sample (path tracing alone: 1); ``variance`` as in `choice.Prediction`; ``mean`` of the
    image, the scale of roulette.
    """

    first_pass: int
    cost: float
    variance: float
    mean: float

    @classmethod
    def of(
        cls, chosen: Configuration, first_pass: int, *, cost: float, variance: float, mean: float
    ) -> Decision:
        """Return the decision for a configuration with these predictions.

        Rounds them to six digits: further digits depend on the order of a pilot's atomic additions.
        """
        cost, variance, mean = (float(f"{number:.6g}") for number in (cost, variance, mean))
        what = {f.name: getattr(chosen, f.name) for f in fields(Configuration)}
        return cls(**what, first_pass=first_pass, cost=cost, variance=variance, mean=mean)

    @property
    def threshold(self) -> float:
        """Absolute size below which contributions play roulette."""
        return self.mean * min(MOST_ROULETTE, ROULETTE_PER_VARIANCE * self.variance)

    def record(self) -> dict[str, Any]:
        """Entry of ``statistics["decisions"]``."""
        return {
            "pass": self.first_pass,
            "light_paths": self.light_paths,
            "connections": self.connections,
            "guided": self.guided,
            "emission": None if self.emission is None else self.emission.record(),
            "joined": self.joined,
            "coefficients": {"t<=1": self.kappa_light, "s=1": self.kappa_direct},
            "cost": self.cost,
            "variance": self.variance,
            "mean": self.mean,
        }


def read_decisions(text: str) -> tuple[Decision, ...]:
    """Parse the parameter ``decisions``: JSON as in ``statistics``.

    An empty list means a render without a pilot. Raises `UsageError` naming the entry and the mistake.
    """
    where = ""
    made: list[Decision] = []
    try:
        entries = json.loads(text)
        if not _is_list(entries):
            raise TypeError("a list of decisions is needed")
        for number, entry in enumerate(entries):
            where = f"entry {number}"
            made.append(_read_decision(entry))
        where = ""
        passes = [decision.first_pass for decision in made]
        if passes != sorted(set(passes)):
            raise ValueError(f"passes {passes} must rise")
        return tuple(made)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        says = f"{where}: {error}" if where else error
        what = f"{where} lacks {error}" if isinstance(error, KeyError) else says
        raise UsageError(
            f"decisions={text!r} is not what json.dumps(integrator.statistics['decisions']) writes: {what}"
        ) from error


def _is_list(value: Any) -> TypeGuard[list[Any]]:
    return isinstance(value, list)


def _is_object(value: Any) -> TypeGuard[dict[str, Any]]:
    """Whether a JSON value is an object."""
    return isinstance(value, dict)


def _read_decision(entry: Any) -> Decision:
    if not _is_object(entry) or not _is_object(entry.get("coefficients", {})):
        raise TypeError(f"{entry!r} is no decision")
    light_paths, connections = _number(entry, "light_paths"), entry["connections"]
    if light_paths not in LIGHT_PATHS or connections not in CONNECTIONS[1:]:
        raise ValueError(f"light_paths={light_paths!r}, connections={connections!r}")
    if not light_paths and connections != "none":
        raise ValueError(f"connections={connections!r} without light paths")
    if unknown := set(entry) - set(ENTRIES):
        raise ValueError(f"{min(unknown)} is no part of a decision")
    first_pass = entry["pass"]
    if isinstance(first_pass, bool) or not isinstance(first_pass, int):
        raise TypeError(f"pass={first_pass!r}")
    numbers = {
        "kappa_light": _number(entry["coefficients"], "t<=1"),
        "kappa_direct": _number(entry["coefficients"], "s=1"),
        **{name: _number(entry, name) for name in ("cost", "variance", "mean")},
    }
    for name, value in {"first_pass": first_pass, **numbers}.items():
        least = 0 if name in ("first_pass", "variance", "mean") else 2.0**-20
        if not least <= value <= LARGEST:
            raise ValueError(f"{name}={value!r}")
    guided = entry.get("guided", 0)  # missing in records of older versions
    if isinstance(guided, bool) or not isinstance(guided, int) or not 0 <= guided <= MOST_GUIDED:
        raise ValueError(f"guided={guided!r}")
    joined = entry.get("joined", 1)
    if isinstance(joined, bool) or joined not in JOINED or (joined > 1 and connections != "one"):
        raise ValueError(f"joined={joined!r}, connections={connections!r}")
    emission = entry.get("emission")
    return Decision(
        light_paths=light_paths,
        connections=connections,
        first_pass=first_pass,
        guided=guided,
        joined=joined,
        emission=None if emission is None else components.guided_emission.EmissionTables.read(emission),
        **numbers,
    )


def _number(entry: dict[str, Any], name: str) -> float:
    """Return a JSON number; booleans and numeric strings raise `TypeError`."""
    value = entry[name]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name}={value!r} must be a number")
    return float(value)


def replayed(decision: Decision) -> list[dict[str, str]]:
    """What a replayed decision leaves out, as in ``statistics["skipped"]``."""
    names = ["t<=1"] * (not decision.light_paths) + ["inner"] * (decision.connections == "none")
    return [{"class": name, "level": "by hand", "why": "decisions"} for name in names]
