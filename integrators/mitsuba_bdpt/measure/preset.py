"""Presets: what a sweep renders, as TOML or as a dictionary of the same keys.

docs/user/measuring_scenes.md describes the keys, `models.PresetFile` checks them. `Cells` are the renders of
a scene, each named after all that determines it.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import CommandError, message
from ..files.texts import read_toml
from ..host.introspection import versions
from ..run.rendering import raise_interrupt
from .making import SHARE_ON_THE_WAY, Job, fitted
from .models import PresetFile, checked
from .project import Project
from .reference import Reference, load_reference, source_digest
from .scenes import SceneFile, digest

FIRST_SEED = 1  # seed 0 warms up


@dataclass(frozen=True)
class Cell:
    """One render, and all that determines it."""

    scene: str
    scene_sha256: str
    resolution: int
    max_depth: int
    clock: str
    method: str
    parameters: tuple
    sampler: str
    match: str
    against: tuple  # for equal time: of the first integrator, and the samples at which both were timed
    budget: int
    seed: int
    versions: tuple
    machine: str

    @property
    def key(self) -> str:
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:24]

    def __str__(self) -> str:
        return f"{self.scene}, {self.budget} spp, seed {self.seed}, {self.method}"


def software() -> dict:
    """Return the versions that determine a render, with the plugin's source."""
    return versions() | {"source": source_digest()}


def machine() -> str:
    file = Path("/proc/cpuinfo")
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    names = re.findall(r"^model name\s*: (.*)", text, re.MULTILINE)
    return f"{names[0].strip() if names else platform.machine()}, {os.cpu_count()} cores"


class Cells:
    """The renders of a scene of a preset.

    ``resolution``: width in pixels; ``spp``, ``seeds``: budgets in samples per pixel, and seeds of each;
    ``methods``: integrators; ``groups``: the renders, in lists of a seed and budget, all budgets of a seed
    before the next.
    """

    def __init__(self, project: Project, file: PresetFile, scene: SceneFile):
        self.project, self.scene = project, scene
        self.resolution = fitted(scene, file.resolution)
        self.max_depth = file.depth(scene.name, scene.max_depth)
        self.spp, self.seeds = file.budgets(scene.name)
        self.methods = [
            method
            for method in file.methods
            if (method.scenes is None or scene.name in method.scenes)
            and method.media in (None, scene.has_media)
        ]
        self._common = {
            "scene": scene.name,
            "scene_sha256": scene.sha256,
            "resolution": self.resolution,
            "max_depth": self.max_depth,
            "clock": file.clock,
            "versions": tuple(software().items()),
            "machine": machine(),
        }
        seeds = range(FIRST_SEED, FIRST_SEED + max(self.seeds))
        pairs = [(seed, spp, n) for seed in seeds for spp, n in zip(self.spp, self.seeds, strict=True)]
        self.groups = [self.of(spp, seed) for seed, spp, n in pairs if seed < FIRST_SEED + n]

    def of(self, budget: int, seed: int) -> list[Cell]:
        """Return a cell per integrator, reversed for even seeds.

        That cancels drifts of the machine's speed.
        """
        first = self.methods[0]
        found = [
            Cell(
                **self._common,
                **{k: getattr(m, k) for k in ("parameters", "sampler", "match")},
                method=m.name,
                against=(first.parameters, first.sampler, max(self.spp)) if m.match == "seconds" else (),
                budget=budget,
                seed=seed,
            )
            for m in self.methods
            if seed < FIRST_SEED + (m.seeds or np.inf)
        ]
        return found if seed % 2 else found[::-1]

    @property
    def planned(self) -> list[Cell]:
        return [cell for group in self.groups for cell in group]

    @property
    def where(self) -> tuple[Project, SceneFile, int, int]:
        """Key of the reference: project, scene, resolution, ``max_depth``."""
        return self.project, self.scene, self.resolution, self.max_depth

    @property
    def job(self) -> Job:
        """The reference that judges the renders."""
        return Job(*self.where, spp=max(self.spp), share=SHARE_ON_THE_WAY)

    @cached_property
    def reference(self) -> tuple[Reference, str]:
        """The stored reference, and the SHA-256 of its file, computed before reading."""
        path = self.job.path
        sha256 = digest(path) if path.exists() else ""
        return load_reference(*self.where), sha256


class Preset(NamedTuple):
    """What is rendered.

    ``cells``: by scene. ``scenes``: names of all scenes of the preset, also of those that are not rendered
    now; None where the command names them. ``left_out``: scenes that cannot be measured, with the reason.
    """

    cells: list[Cells]
    scenes: tuple[str, ...] | None
    left_out: list[str]


def read_preset(
    given: Path | Mapping[str, Any],
    project: Project,
    only: Sequence[str] | None = None,
    scenes: Sequence[str] = (),
) -> Preset:
    """Read a TOML file, or take a dictionary of its keys; loads the scenes.

    ``only``: of the preset's scenes these, or the scenes of a preset that names none. ``scenes``: those of a
    preset without. Raises ``CommandError`` naming file and key.
    """
    path = Path("preset") if isinstance(given, Mapping) else given
    content = given if isinstance(given, Mapping) else read_toml(given)
    file = checked(PresetFile, ({"scenes": scenes} if scenes else {}) | dict(content), path)
    patterns = file.scenes or only
    if not patterns:
        raise CommandError(f"{path}: scenes is missing; list them, or name scene files by --scenes")
    found = [scene for pattern in patterns for scene in project.matching(pattern)]
    names = [scene.name for scene in found]
    if twice := [name for name in names if names.count(name) > 1]:
        raise CommandError(f"{path}: scenes={list(patterns)} names one twice: {twice[0]}")
    tables: dict[str, Sequence[str]] = {f"[scene.{name}]": [name] for name in file.scene}
    tables |= {f"scenes of integrator {one.name!r}": one.scenes for one in file.integrator if one.scenes}
    for where, named in tables.items():
        if unknown := [name for name in named if name not in names]:
            raise CommandError(f"{path}: {where}: {unknown[0]!r} is not among the preset's scenes {names}")
    if only and file.scenes:
        if unknown := [name for name in only if name not in names]:
            raise CommandError(f"--scenes {unknown[0]}: not in the preset, which has {', '.join(names)}")
        found = [scene for scene in found if scene.name in only]
    cells, left_out = [], []
    for scene in found:
        try:
            cells.append(Cells(project, file, scene))
        except Exception as error:  # one scene must not cost the others
            raise_interrupt(error)
            left_out.append(f"{scene.name}: left out: {' '.join(message(error).split())}")
    if not cells:
        raise CommandError(f"{path}: no scene can be measured: {'; '.join(left_out)}")
    return Preset(cells, tuple(names) if file.scenes else None, left_out)
