"""Which strategies a render uses."""

from __future__ import annotations

from dataclasses import dataclass

from ..emitters.emission_tables import EmissionTables

# Numbers of light subpaths with which each camera subpath can be joined.
JOINED = (1, 4)

# Numbers of guided samples at a vertex among which a pilot chooses.
GUIDED = (1, 4, 8)


@dataclass(frozen=True)
class Plan:
    """Strategy classes in use for one scene and sensor.

    Classes: ``hit`` s=0, ``direct`` s=1 with t>=2, ``splat`` t=1 with s>=2, ``endpoints`` (1,1),
    ``arrival`` t=0, ``inner`` s,t>=2. ``camera_paths_per_light_path``: camera subpaths per light subpath (S).
    ``connections``: ``all``, ``one`` or ``none``. ``kappa_light``: kappa of t<=1 over its count;
    ``kappa_direct``: kappa of s=1.
    ``roulette``: whether small contributions may be dropped before their ray. ``skipped`` explains what is
    left out. ``merging``: whether vertices of isolated paths are merged; ``guided``: by how many samples
    s = 0 is guided at a vertex; ``guidable``: whether a pilot may say that it pays; ``emission``: what guides
    that of light subpaths, ``teachable``: whether a pilot may say that it pays. ``joined``: number of light
    subpaths (M) with whose vertices each camera subpath is joined; they serve M S camera subpaths.
    """

    hit: bool
    direct: bool
    splat: bool
    endpoints: bool
    arrival: bool
    connections: str
    camera_paths_per_light_path: int
    kappa_light: float
    kappa_direct: float
    roulette: bool
    hide_emitters: bool
    skipped: tuple[dict[str, str], ...] = ()
    merging: bool = False
    guided: int = 0
    guidable: bool = False
    emission: EmissionTables | None = None
    teachable: bool = False
    joined: int = 1

    @property
    def served(self) -> int:
        """Camera subpaths that a lane serves."""
        return self.camera_paths_per_light_path * self.joined

    @property
    def light(self) -> bool:
        """Whether light subpaths are traced at all."""
        return self.splat or self.arrival or self.connections != "none" or self.endpoints
