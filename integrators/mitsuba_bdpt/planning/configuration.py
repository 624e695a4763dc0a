"""The configurations of a render: how many light subpaths, which connections, with which coefficients.

A pilot tells the variance of each of `WEIGHTINGS`; a `Configuration` adds the numbers of subpaths and
connections, and is what the kernel is told.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ..emitters.emission_tables import EmissionTables
from ..transport.plan import Plan


@dataclass(frozen=True)
class Weighting:
    """Coefficients kappa of the classes `mis.CLASSES`, relative to the densities of one sample each."""

    hit: float
    direct: float
    light: float
    inner: float

    def of(self, kind: str) -> float:
        """kappa of a class."""
        return getattr(self, kind)

    @property
    def combination(self) -> str:
        """``n0c0`` path tracing alone, ``n1c0`` with light tracing, ``n1c1`` with inner connections."""
        return f"n{int(self.light > 0)}c{int(self.inner > 0)}"


# In this order: each class is in use from some weighting on.
WEIGHTINGS = (
    *(Weighting(1, direct, 0, 0) for direct in (1 / 16, 1 / 2, 1)),
    *(Weighting(1, 1, light, 0) for light in (1 / 64, 1 / 16, 1 / 4)),
    *(Weighting(1, 1, light, 1) for light in (1 / 64, 1 / 16, 1 / 4, 1)),
)


@dataclass(frozen=True)
class Configuration:
    """A way to render.

    The parameters ``light_paths`` and ``connections`` (``none``, ``one`` or ``all``), the coefficients kappa
    of t <= 1, over its count (``kappa_light``), and of s = 1 (``kappa_direct``). ``guided``: samples
    by which s = 0 is at a vertex; with `merging`, not 0 if vertices are merged though s = 0 finds that light.
    ``emission``: what guides that of light subpaths; ``joined``: with so many of them each camera subpath is.
    """

    light_paths: float
    connections: str
    kappa_light: float
    kappa_direct: float
    guided: int = field(default=0, kw_only=True)
    emission: EmissionTables | None = field(default=None, kw_only=True)
    joined: int = field(default=1, kw_only=True)

    @classmethod
    def weighted(cls, weighting: Weighting, served: int, connections: str) -> Configuration:
        """That of a pilot's ``weighting``, with a light subpath for so many camera subpaths."""
        return cls(
            light_paths=1 / served if weighting.light else 0.0,
            connections=connections,
            kappa_light=weighting.light * served if weighting.light else 1.0,
            kappa_direct=float(weighting.direct),
        )

    @property
    def weighting(self) -> Weighting:
        """The weighting whose variance is that of this configuration, up to the numbers of subpaths."""
        inner = float(self.connections != "none")
        return Weighting(1, self.kappa_direct, self.kappa_light * self.light_paths, inner)

    @property
    def camera_paths_per_light_path(self) -> int:
        """Camera subpaths that a light subpath serves (S), 1 without light subpaths."""
        return round(1 / self.light_paths) if self.light_paths else 1

    def plan(self, full: Plan) -> Plan:
        """``full`` with what is not done left out."""
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
