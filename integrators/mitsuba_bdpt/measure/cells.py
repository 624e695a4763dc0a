"""What a sweep renders: its cells, each named after all that determines it."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ..host.versions import versions
from .preset import More, Preset, Subject
from .project import Project
from .reference import source_digest

FIRST_SEED = 1  # seed 0 warms up


@dataclass(frozen=True)
class Cell:
    """One render, and all that determines it.

    ``against``: for equal seconds, parameters and sampler of the first integrator and the samples at which
    the two were timed.
    """

    scene: str
    scene_sha256: str
    resolution: int
    max_depth: int
    method: str
    parameters: tuple
    sampler: str
    match: str
    against: tuple
    budget: int
    seed: int
    versions: tuple
    machine: str

    @property
    def key(self) -> str:
        """Name of the cell's files."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:24]


def software() -> dict:
    """Versions of what renders, the plugin's source among them."""
    return versions() | {"source": source_digest()}


def machine() -> str:
    """Processor and number of cores."""
    names = [line.split(":", 1)[1].strip() for line in _cpuinfo() if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


def _cpuinfo() -> list[str]:
    file = Path("/proc/cpuinfo")
    return file.read_text().splitlines() if file.exists() else []


class Cells:
    """The cells of a scene of a preset, integrators innermost."""

    def __init__(self, project: Project, preset: Preset, subject: Subject):
        self.project, self.subject = project, subject
        self.more: More | None = None  # of [more], if the scene is among its own
        if preset.more is not None and subject.name in preset.more.scenes:
            self.more = preset.more
        self.methods = [m for m in preset.methods if m.takes_part_in(subject.scene)]
        self.common = {
            "scene": subject.name,
            "scene_sha256": subject.scene.sha256,
            "resolution": preset.resolution,
            "max_depth": subject.max_depth,
            "versions": tuple(software().items()),
            "machine": machine(),
        }
        first = self.methods[0]
        self.against = first.parameters, first.sampler, max(subject.spp)

    def of(self, budget: int, seed: int, names=None) -> list[Cell]:
        """A cell per integrator, of those in ``names``."""
        return [
            Cell(
                **self.common,
                **{k: getattr(m, k) for k in ("parameters", "sampler", "match")},
                method=m.name,
                against=self.against if m.match == "seconds" else (),
                budget=budget,
                seed=seed,
            )
            for m in self.methods
            if (names is None or m.name in names) and seed < FIRST_SEED + (m.seeds or np.inf)
        ]

    def planned(self) -> list[Cell]:
        """Those that are rendered in any case."""
        found = [
            cell
            for spp, seeds in zip(self.subject.spp, self.subject.seeds, strict=True)
            for seed in range(FIRST_SEED, FIRST_SEED + seeds)
            for cell in self._turn(self.of(spp, seed))
        ]
        known = {cell.key for cell in found}
        first = [cell for seed in range(self.fewest()) for cell in self.further(seed)]
        return found + [cell for cell in first if cell.key not in known]

    def where(self) -> tuple:
        """What names the reference: project, scene, resolution, ``max_depth``."""
        return self.project, self.subject.scene, self.common["resolution"], self.subject.max_depth

    def fewest(self) -> int:
        """Seeds that [more] takes at least, 0 without it."""
        return 0 if self.more is None else self.more.at_least

    def further(self, index: int) -> list[Cell]:
        """The cells of [more] with its ``index``-th seed; none without it."""
        if self.more is None:
            return []
        return self._turn(self.of(self.more.spp, FIRST_SEED + index, self.more.methods))

    @staticmethod
    def _turn(found: list[Cell]) -> list[Cell]:
        """There for odd seeds and back for even ones: a drift of the machine's speed favours nobody."""
        return found[::-1] if found and found[0].seed % 2 == 0 else found
