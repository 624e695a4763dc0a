"""Presets: what a sweep renders, as TOML, or in Python as a dictionary of the same keys.

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
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CommandError, message
from ..files.texts import read_toml
from ..host.introspection import versions
from ..run.rendering import raise_interrupt
from .making import fitted
from .models import Method, More, PresetFile, checked
from .project import Project
from .reference import source_digest
from .scenes import MeasuredScene


@dataclass(frozen=True)
class Subject:
    """A scene of a preset: width, ``max_depth``, samples per pixel and seeds of each budget."""

    scene: MeasuredScene
    resolution: int
    max_depth: int
    spp: tuple[int, ...]
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        return self.scene.name


@dataclass(frozen=True)
class Preset:
    """What is rendered.

    ``file``: its keys. ``scenes``: names of all scenes of the preset, also of those that are not rendered
    now; None where the command names them. ``left_out``: scenes that cannot be measured, with the reason.
    """

    file: PresetFile
    subjects: tuple[Subject, ...]
    scenes: tuple[str, ...] | None
    left_out: tuple[str, ...]

    @property
    def methods(self) -> tuple[Method, ...]:
        """The integrators; the first one has its samples, whose time the others match."""
        first, *others = self.file.integrator
        return first.model_copy(update={"match": "spp"}), *others


def read_preset(path: Path, project: Project, only: Sequence[str] | None = None) -> Preset:
    """Read a TOML file of a ``project``; raises ``CommandError`` naming file and key."""
    return preset_of(path, read_toml(path), project, only)


def preset_of(
    path: Path, given: Mapping[str, Any], project: Project, only: Sequence[str] | None = None
) -> Preset:
    """Return the preset of a dictionary; ``path`` names it in errors.

    By default all scenes that the ``project`` has as dictionaries. ``only``: of the preset's scenes these;
    or the scenes of a preset that names none. Loads these scenes.
    """
    file = checked(PresetFile, ({"scenes": list(project.given)} if project.given else {}) | dict(given), path)
    if file.first_image and project.given:
        raise CommandError(
            f"{path}: first_image={file.first_image} needs scene files: other processes render them"
        )
    patterns = file.scenes or only
    if not patterns:
        raise CommandError(f"{path}: scenes is missing; list them, or name scene files by --scenes")
    scenes = [scene for pattern in patterns for scene in project.matching(pattern)]
    names = [scene.name for scene in scenes]
    if twice := [name for name in names if names.count(name) > 1]:
        raise CommandError(f"{path}: scenes={list(patterns)} names one twice: {twice[0]}")
    _check_names(path, file, names)
    if only and file.scenes:
        if unknown := [name for name in only if name not in names]:
            raise CommandError(f"--scenes {unknown[0]}: not in the preset, which has {', '.join(names)}")
        scenes = [scene for scene in scenes if scene.name in only]
    subjects, left_out = _subjects(path, file, scenes)
    return Preset(file, subjects, tuple(names) if file.scenes else None, left_out)


def _check_names(path: Path, file: PresetFile, names: list[str]) -> None:
    tables: dict[str, Sequence[str]] = {f"[scene.{name}]": [name] for name in file.scene}
    tables |= {f"scenes of integrator {one.name!r}": one.scenes for one in file.integrator if one.scenes}
    tables |= {"scenes of [more]": file.more.scenes} if file.more else {}
    for where, named in tables.items():
        if unknown := [name for name in named if name not in names]:
            raise CommandError(f"{path}: {where}: {unknown[0]!r} is not among the preset's scenes {names}")


def _subjects(
    path: Path, file: PresetFile, scenes: Sequence[MeasuredScene]
) -> tuple[tuple[Subject, ...], tuple[str, ...]]:
    """Return subjects of the scenes that can be measured, and messages about the others."""
    found, left_out = [], []
    for scene in scenes:
        try:
            width, depth = fitted(scene, file.resolution), file.depth(scene.name, scene.max_depth)
        except Exception as error:  # one scene must not cost the others
            raise_interrupt(error)
            left_out.append(f"{scene.name}: left out: {' '.join(message(error).split())}")
        else:
            found.append(Subject(scene, width, depth, *file.budgets(scene.name)))
    if not found:
        raise CommandError(f"{path}: no scene can be measured: {'; '.join(left_out)}")
    return tuple(found), tuple(left_out)


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


def software() -> dict:
    """Return the versions that determine a render, with the plugin's source."""
    return versions() | {"source": source_digest()}


def machine() -> str:
    file = Path("/proc/cpuinfo")
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    names = re.findall(r"^model name\s*: (.*)", text, re.MULTILINE)
    return f"{names[0].strip() if names else platform.machine()}, {os.cpu_count()} cores"


class Cells:
    """The cells of a scene of a preset, integrators innermost."""

    def __init__(self, project: Project, preset: Preset, subject: Subject):
        self.project, self.subject = project, subject
        more, scene = preset.file.more, subject.scene
        self.more: More | None = more if more is not None and scene.name in more.scenes else None
        self.methods = [
            method
            for method in preset.methods
            if (method.scenes is None or scene.name in method.scenes)
            and method.media in (None, scene.has_media)
        ]
        self.common = {
            "scene": subject.name,
            "scene_sha256": subject.scene.sha256,
            "resolution": subject.resolution,
            "max_depth": subject.max_depth,
            "clock": preset.file.clock,
            "versions": tuple(software().items()),
            "machine": machine(),
        }
        first = self.methods[0]
        self.against = first.parameters, first.sampler, max(subject.spp)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Cells) and self.possible() == other.possible()

    def __hash__(self) -> int:
        return hash(self.common["scene_sha256"])

    def of(self, budget: int, seed: int, names=None) -> list[Cell]:
        """Return a cell per integrator, of those in ``names``."""
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
        """Return the cells that are always rendered."""
        found = [
            cell
            for spp, seeds in zip(self.subject.spp, self.subject.seeds, strict=True)
            for seed in range(FIRST_SEED, FIRST_SEED + seeds)
            for cell in self._turn(self.of(spp, seed))
        ]
        known = {cell.key for cell in found}
        first = [cell for seed in range(self.fewest()) for cell in self.further(seed)]
        return found + [cell for cell in first if cell.key not in known]

    def possible(self) -> list[Cell]:
        """Return these and all that [more] may add."""
        more = range(0 if self.more is None else self.more.seeds[1])
        found = {c.key: c for c in (*self.planned(), *(c for seed in more for c in self.further(seed)))}
        return list(found.values())

    def where(self) -> tuple:
        """Key of the reference: project, scene, resolution, ``max_depth``."""
        return self.project, self.subject.scene, self.common["resolution"], self.subject.max_depth

    def fewest(self) -> int:
        """Minimum number of seeds of [more], 0 without it."""
        return 0 if self.more is None else self.more.seeds[0]

    def further(self, index: int) -> list[Cell]:
        """Return the cells of [more] with its ``index``-th seed; none without it."""
        if self.more is None:
            return []
        return self._turn(self.of(self.more.spp, FIRST_SEED + index, self.more.integrators))

    @staticmethod
    def _turn(found: list[Cell]) -> list[Cell]:
        """Reverse the order for even seeds: cancels drifts of the machine's speed."""
        return found[::-1] if found and found[0].seed % 2 == 0 else found
