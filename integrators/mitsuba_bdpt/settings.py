"""The integrator's parameters as one record."""

from __future__ import annotations

from dataclasses import dataclass

UNLIMITED = 2**32 - 1


# Most light vertices per lane (a lane's local memory lies on a thread's stack).
MAX_STORED = 1024


DEFAULT_STORED = 64


LIGHT_PATHS = (0, 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)


CONNECTIONS = ("auto", "all", "one", "none")


SKIP = ("auto", "impossible", "none")


@dataclass(frozen=True)
class Settings:
    """The integrator's parameters, checked. See `integrator` for their meaning."""

    max_depth: int
    rr_depth: int
    hide_emitters: bool
    heuristic: str
    skip: str
    light_paths: float | str
    connections: str
    points: str
    decisions: tuple | None
    stored_vertices: int
    strategy_images: bool
    variance: bool
    until_error: float
    aovs: str
    spp_per_pass: int
    timeout: float

    @property
    def strategy_depth(self) -> int:
        """The largest path length of the strategy images, 0 for none."""
        return self.max_depth if self.strategy_images else 0


HEURISTICS = ("balance", "power", "maximum", "uniform")


POINTS = ("sobol", "sampler", "independent")
