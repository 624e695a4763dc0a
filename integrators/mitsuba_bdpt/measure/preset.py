"""Presets: what a sweep renders, as TOML, or in Python as a dictionary of the same keys.

docs/user/measuring_scenes.md describes the keys; `DEFAULTS` has what a preset need not say. `Cells` are the
renders of a scene, each named after all that determines it.
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

from ..errors import CommandError, did_you_mean, message
from ..files.texts import list_of, read_toml, table_of, text_of, whole_of
from ..host.introspection import versions
from ..run.rendering import raise_interrupt
from . import probes
from .agreement import FEWEST_RUNS, TILES
from .making import fitting_width, resized
from .options import RESOLUTION
from .project import Project, depth_in
from .reference import source_digest
from .scenes import MeasuredScene

MATCHES = ("seconds", "spp")
CLOCKS = ("wall", "processor")


@dataclass(frozen=True)
class Method:
    """An integrator of a preset.

    ``parameters``: of the plugin; ``sampler``: of the sensor; ``match``: equal "spp" or "seconds" with the
    first; ``scenes``: where it is rendered (None: everywhere); ``media``: whether these have participating
    media (None: either); ``seeds``: at most so many per budget (None: all).
    """

    name: str
    parameters: tuple
    sampler: str
    match: str
    scenes: tuple | None
    media: bool | None
    seeds: int | None

    def takes_part_in(self, scene: MeasuredScene) -> bool:
        if self.scenes is not None and scene.name not in self.scenes:
            return False
        return self.media is None or self.media == scene.has_media


@dataclass(frozen=True)
class Subject:
    """A scene of a preset: width, ``max_depth``, samples per pixel and seeds of each budget."""

    scene: MeasuredScene
    resolution: int
    max_depth: int
    spp: tuple
    seeds: tuple

    @property
    def name(self) -> str:
        return self.scene.name


@dataclass(frozen=True)
class More:
    """Further seeds of some ``methods`` in some scenes at one budget.

    From ``at_least`` to ``at_most``, until the interval of the median ratio of efficiencies is narrower than
    ``width``.
    """

    scenes: tuple
    methods: tuple
    spp: int
    at_least: int
    at_most: int
    width: float


@dataclass(frozen=True)
class Preset:
    """What is rendered.

    ``clock``: one of `CLOCKS`, whose seconds decide. ``first_images``: processes that render the first image
    of each scene and integrator. ``scenes``: names of all scenes of the preset, also of those that are not
    rendered now; None where the command names them. ``left_out``: scenes that cannot be measured, with the
    reason. ``resolution``: the width that is asked for.
    """

    subjects: tuple
    methods: tuple
    more: More | None
    probes: dict
    clock: str
    first_images: int
    scenes: tuple[str, ...] | None
    left_out: tuple[str, ...]
    resolution: int

    def resized(self) -> list[str]:
        """Return a message about each scene that is not rendered at the width that is asked for."""
        return [told for one in self.subjects for told in resized(one.scene, self.resolution, one.resolution)]


DEFAULTS: dict[str, Any] = {
    "resolution": RESOLUTION,
    "clock": CLOCKS[0],
    "first_image": 0,
    "spp": [4, 16, 64],
    "seeds": FEWEST_RUNS,
    "integrator": [
        {"type": "bdpt"},
        {"type": "path", "media": False},
        {"type": "volpath", "media": True},
    ],
}
"""What a preset need not say: the package's integrator and Mitsuba's path tracer in equal time."""


def read_preset(path: Path, project: Project, only: Sequence[str] | None = None) -> Preset:
    """Read a TOML file of a ``project``; raises ``CommandError`` naming file and key."""
    return preset_of(path, read_toml(path), project, only)


def preset_of(
    path: Path, given: Mapping[str, Any], project: Project, only: Sequence[str] | None = None
) -> Preset:
    """Return the preset of a dictionary; ``path`` names it in errors.

    By default all scenes that the ``project`` has as dictionaries. ``only``: of the preset's scenes these,
    without probes; or the scenes of a preset that names none. Loads these scenes.
    """
    data = DEFAULTS | ({"scenes": list(project.given)} if project.given else {}) | dict(given)
    is_open = "scenes" not in data
    if is_open and only:
        data["scenes"] = list(only)
    keys = {"scenes", "spp", "seeds", "resolution", "integrator"}
    others = {"max_depth", "clock", "first_image", "scene", "more", "probes"}
    _check_keys(path, data, keys, keys | others, "a preset")
    for key in {"resolution", "max_depth", *({"first_image"} if data["first_image"] else ())} & set(data):
        whole_of(path, key, data[key])
    if data["resolution"] % TILES:
        raise CommandError(f"{path}: resolution={data['resolution']} must be divisible by {TILES}")
    scenes = [scene for name in _names(path, "scenes", data["scenes"]) for scene in project.matching(name)]
    names = [scene.name for scene in scenes]
    if twice := [name for name in names if names.count(name) > 1]:
        raise CommandError(f"{path}: scenes={data['scenes']!r} names one twice: {twice[0]}")
    for name in table_of(path, "scene", data.get("scene", {})):
        if name not in names:
            raise CommandError(f"{path}: [scene.{name}] is not among the scenes {names}")
    methods = _methods(path, data["integrator"], names)
    more = _more(path, data["more"], names, methods) if "more" in data else None
    measured = _probes(path, data.get("probes", {}))
    if only and not is_open:
        scenes, measured = _chosen(scenes, only), {}
    subjects, left_out = _subjects(path, data, scenes)
    clock, first = _timing(path, data, project)
    order = None if is_open else tuple(names)
    return Preset(subjects, methods, more, measured, clock, first, order, left_out, data["resolution"])


def _timing(path, data, project) -> tuple[str, int]:
    """Return the clock, and the number of processes for first images."""
    clock, first = data["clock"], data["first_image"]
    if clock not in CLOCKS:
        raise CommandError(f"{path}: clock={clock!r} must be one of {CLOCKS}")
    if first and project.given:
        raise CommandError(f"{path}: first_image={first} needs scene files: other processes render them")
    return clock, first


def _chosen(scenes: list[MeasuredScene], names: Sequence[str]) -> list[MeasuredScene]:
    """Return the scenes of these names; raises ``CommandError`` for others."""
    known = [scene.name for scene in scenes]
    for name in names:
        if name not in known:
            raise CommandError(f"--scenes {name}: not in the preset, which has {', '.join(known)}")
    return [scene for scene in scenes if scene.name in names]


def _subjects(path, data, scenes) -> tuple[tuple, tuple]:
    """Return subjects of the scenes that can be measured, and messages about the others."""
    found, left_out = [], []
    for scene in scenes:
        try:
            width = fitting_width(scene, data["resolution"])
        except Exception as error:  # one scene must not cost the others
            raise_interrupt(error)
            left_out.append(f"{scene.name}: left out: {' '.join(message(error).split())}")
        else:
            found.append(_subject(path, data, scene, width))
    if not found:
        raise CommandError(f"{path}: no scene can be measured: {'; '.join(left_out)}")
    return tuple(found), tuple(left_out)


def _names(path, key, value) -> list[str]:
    return list_of(path, key, value, str, "texts in quotes")


def _methods(path, entries, scenes) -> tuple:
    list_of(path, "integrator", entries, dict, "tables: write [[integrator]] and the keys of each below")
    # The first sets the time, so that it alone has its samples by default.
    defaults = ("spp", *("seconds",) * (len(entries) - 1))
    methods = tuple(
        _method(path, {"match": match} | entry, scenes)
        for match, entry in zip(defaults, entries, strict=True)
    )
    if len({m.name for m in methods}) < len(methods):
        raise CommandError(f"{path}: two integrators have the same name")
    first = methods[0]
    if (first.scenes, first.media, first.seeds) != (None, None, None) or first.match == "seconds":
        raise CommandError(
            f"{path}: the first integrator, {first.name!r}, sets the time of the others; it takes "
            "neither scenes nor media nor seeds nor match = 'seconds'"
        )
    return methods


def _probes(path, counts) -> dict:
    """Return the number of repetitions of each probe."""
    for name, count in table_of(path, "probes", counts).items():
        if name not in probes.PROBES:
            raise CommandError(f"{path}: probe {name!r} is unknown; there are {sorted(probes.PROBES)}")
        whole_of(path, name, count)
    return counts


def _check_keys(path, entry, needed, allowed, what):
    if unknown := sorted(set(entry) - allowed):
        there, near = f"there are {sorted(allowed)}", did_you_mean(unknown[0], sorted(allowed))
        raise CommandError(f"{path}: {unknown[0]} is not a key of {what}; {there}; {near}".rstrip("; "))
    if missing := sorted(needed - set(entry)):
        more = "; list them, or name scene files by --scenes" if missing[0] == "scenes" else ""
        raise CommandError(f"{path}: {missing[0]} is missing{more}")


def _row(path, key, value) -> tuple:
    if not isinstance(value, list) or not value or not all(type(n) is int and n > 0 for n in value):
        raise CommandError(f"{path}: {key}={value!r} must be a list of whole numbers of at least 1")
    return tuple(value)


def _subject(path, data, scene, width: int) -> Subject:
    name = scene.name
    own = table_of(path, f"scene.{name}", data.get("scene", {}).get(name, {}))
    _check_keys(path, own, set(), {"max_depth", "spp", "seeds"}, f"[scene.{name}]")
    merged = data | own
    spp, seeds = _row(path, "spp", merged["spp"]), merged["seeds"]
    if len(set(spp)) < len(spp):
        raise CommandError(f"{path}: spp={list(spp)} of {name} names a budget twice")
    if isinstance(seeds, list):
        seeds = _row(path, "seeds", seeds)
        if len(seeds) != len(spp):
            raise CommandError(f"{path}: seeds={list(seeds)} of {name} must be as many as spp={list(spp)}")
    else:
        seeds = (whole_of(path, "seeds", seeds),) * len(spp)
    return Subject(scene, width, depth_in(path, data, scene), spp, seeds)


def _method(path, entry, scenes) -> Method:
    if "type" not in entry:
        raise CommandError(f"{path}: an integrator without type: {entry!r}")
    kind = text_of(path, "type of an integrator", entry["type"])
    name = text_of(path, "name of an integrator", entry.pop("name", kind))
    sampler = text_of(path, f"sampler of integrator {name!r}", entry.pop("sampler", "independent"))
    match, only, seeds = entry.pop("match"), entry.pop("scenes", None), entry.pop("seeds", None)
    media = entry.pop("media", None)
    if "max_depth" in entry:
        raise CommandError(
            f"{path}: max_depth of integrator {name!r} would compare different images; set it for all"
        )
    if match not in MATCHES:
        raise CommandError(f"{path}: match={match!r} of integrator {name!r} must be one of {MATCHES}")
    if media is not None and not isinstance(media, bool):
        raise CommandError(f"{path}: media={media!r} of integrator {name!r} must be true or false")
    if only is not None:
        _names(path, f"scenes of integrator {name!r}", only)
    if unknown := [scene for scene in only or () if scene not in scenes]:
        raise CommandError(f"{path}: scene {unknown[0]!r} of integrator {name!r} is not in the preset")
    for key, value in entry.items():
        if not isinstance(value, bool | int | float | str):
            raise CommandError(
                f"{path}: {key}={value!r} of integrator {name!r} must be a number, a text, true or false"
            )
    if seeds is not None:
        whole_of(path, f"seeds of integrator {name!r}", seeds)
    parameters = tuple(sorted(entry.items()))
    return Method(name, parameters, sampler, match, tuple(only) if only else None, media, seeds)


def _more(path, entry, scenes, methods) -> More:
    keys = {"scenes", "integrators", "spp", "seeds", "width"}
    table_of(path, "more", entry)
    _check_keys(path, entry, keys, keys, "[more]")
    for key, known in (("scenes", scenes), ("integrators", [m.name for m in methods])):
        if unknown := [n for n in _names(path, f"{key} of [more]", entry[key]) if n not in known]:
            raise CommandError(f"{path}: {unknown[0]!r} of [more] {key} is not in the preset")
    if entry["integrators"][:1] != [methods[0].name] or len(entry["integrators"]) < 2:
        raise CommandError(
            f"{path}: integrators of [more] must be the first one, {methods[0].name!r}, and its rivals"
        )
    seeds = _row(path, "seeds of [more]", entry["seeds"])
    if len(seeds) != 2 or not 2 <= seeds[0] <= seeds[1]:
        raise CommandError(f"{path}: seeds={entry['seeds']!r} of [more] must be [at least, at most]")
    limited = [m.name for m in methods if m.name in entry["integrators"] and (m.scenes or m.seeds)]
    if limited:
        raise CommandError(f"{path}: {limited[0]!r} of [more] is limited by scenes or seeds of its own")
    width = entry["width"]
    if isinstance(width, bool) or not isinstance(width, int | float) or not 0 < width < 1:
        raise CommandError(f"{path}: width={width!r} of [more] must be a number between 0 and 1")
    spp = whole_of(path, "spp of [more]", entry["spp"])
    return More(tuple(entry["scenes"]), tuple(entry["integrators"]), spp, seeds[0], seeds[1], float(width))


FIRST_SEED = 1  # seed 0 warms up


@dataclass(frozen=True)
class Cell:
    """One render, and all that determines it.

    ``against``: for equal time, parameters and sampler of the first integrator, and the samples at which both
    were timed.
    """

    scene: str
    scene_sha256: str
    resolution: int
    max_depth: int
    clock: str
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
    """Return the versions that determine a render, with the plugin's source."""
    return versions() | {"source": source_digest()}


def machine() -> str:
    """Return processor and number of cores."""
    file = Path("/proc/cpuinfo")
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    names = re.findall(r"^model name\s*: (.*)", text, re.MULTILINE)
    return f"{names[0].strip() if names else platform.machine()}, {os.cpu_count()} cores"


class Cells:
    """The cells of a scene of a preset, integrators innermost."""

    def __init__(self, project: Project, preset: Preset, subject: Subject):
        self.project, self.subject = project, subject
        self.more: More | None = None  # of [more], if it contains the scene
        if preset.more is not None and subject.name in preset.more.scenes:
            self.more = preset.more
        self.methods = [m for m in preset.methods if m.takes_part_in(subject.scene)]
        self.common = {
            "scene": subject.name,
            "scene_sha256": subject.scene.sha256,
            "resolution": subject.resolution,
            "max_depth": subject.max_depth,
            "clock": preset.clock,
            "versions": tuple(software().items()),
            "machine": machine(),
        }
        first = self.methods[0]
        self.against = first.parameters, first.sampler, max(subject.spp)

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
        more = range(0 if self.more is None else self.more.at_most)
        found = {c.key: c for c in (*self.planned(), *(c for seed in more for c in self.further(seed)))}
        return list(found.values())

    def where(self) -> tuple:
        """Key of the reference: project, scene, resolution, ``max_depth``."""
        return self.project, self.subject.scene, self.common["resolution"], self.subject.max_depth

    def fewest(self) -> int:
        """Minimum number of seeds of [more], 0 without it."""
        return 0 if self.more is None else self.more.at_least

    def further(self, index: int) -> list[Cell]:
        """Return the cells of [more] with its ``index``-th seed; none without it."""
        if self.more is None:
            return []
        return self._turn(self.of(self.more.spp, FIRST_SEED + index, self.more.methods))

    @staticmethod
    def _turn(found: list[Cell]) -> list[Cell]:
        """Reverse the order for even seeds: cancels drifts of the machine's speed."""
        return found[::-1] if found and found[0].seed % 2 == 0 else found
