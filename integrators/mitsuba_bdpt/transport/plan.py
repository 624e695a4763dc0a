"""The strategies of a render."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

JOINED = (1, 4)  # numbers of light subpaths with which a camera subpath can be connected
GUIDED_SAMPLES = 4  # guided samples per vertex where s = 0 is guided


@dataclass(frozen=True)
class Plan:
    """Strategy classes in use for one scene and sensor.

    * ``hit`` s=0, ``direct`` s=1 with t>=2, ``splat`` t=1 with s>=2, ``endpoints`` (1,1), ``arrival`` t=0;
      ``connections`` s,t>=2: ``all``, ``one`` or ``none``.
    * ``camera_paths_per_light_path``: camera subpaths per light subpath (S); ``joined``: light subpaths (M)
      with which each camera subpath is connected, shared by M S camera subpaths.
    * ``kappa_light``: kappa of t<=1 over its count; ``kappa_direct``: kappa of s=1.
    * ``roulette``: small contributions play roulette before their shadow ray.
    * ``merging``: vertex merging of SDS paths; ``guided``: guided samples per vertex; ``emission``: tables of
      guided emission; ``guidable``, ``teachable``: a pilot may choose guided samples, and tables.
    * ``skipped``: reasons for what is left out.
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
    emission: Any = None  # `guided_emission.EmissionTables`
    teachable: bool = False
    joined: int = 1

    @property
    def camera_paths(self) -> int:
        """Camera subpaths of a lane."""
        return self.camera_paths_per_light_path * self.joined

    @property
    def light(self) -> bool:
        """Whether light subpaths are traced."""
        return self.splat or self.arrival or self.connections != "none" or self.endpoints
