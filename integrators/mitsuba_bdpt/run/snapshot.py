"""The state of a render between passes, as plain numbers, to continue or to merge."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from .._version import __version__
from ..errors import CommandError, UsageError
from ..image.accumulator import Accumulator
from ..image.replicates import LAST, halves_of, stored
from ..planning.configuration import Decision
from ..planning.planner import PlannerState
from ..settings import Settings
from .statistics import Work


@dataclass(frozen=True)
class Progress:
    """Progress of a render after a pass.

    ``decided``: decisions so far; ``work``: counts; ``small_first``: whether the first pass has one sample
    per pixel, ``None`` if not yet known; ``why_merged``: see `Render`; ``whole``: whether a render can
    continue from it; ``scene``: optional digest of the scene's files.
    """

    decided: PlannerState = PlannerState()
    work: Work = Work()
    small_first: bool | None = None
    why_merged: str = ""
    whole: bool = True
    scene: str | None = None

    def stored(self) -> dict:
        """Return the fields of all parts as JSON values."""
        parts = (self, self.decided, self.work)
        values = {f.name: getattr(part, f.name) for part in parts for f in fields(part)}
        values["decisions"] = [decision.record() for decision in self.decided.decisions]
        return {name: value for name, value in values.items() if name not in ("decided", "work")}

    @classmethod
    def restored(cls, values: dict) -> Progress:
        """Inverse of `stored`."""
        decisions = tuple(map(Decision.read, values["decisions"]))
        values = values | {"decisions": decisions, "left_out": tuple(values["left_out"])}
        for name, part in (("decided", PlannerState), ("work", Work)):
            values[name] = part(**{f.name: values.pop(f.name) for f in fields(part)})
        return cls(**values)


FORMAT = 13  # version of the stored format; increase with every change


def identity(settings: Settings, accumulator: Accumulator, seed: int, spp: int, part: int) -> dict:
    """Return the values, as JSON, that a render and its continuation must share (not the scene)."""
    film, values = accumulator.film, asdict(settings)
    del values["timeout"]
    del values["internals"]["decisions"]
    values["target_error"] = bool(settings.target_error)  # the passes depend on whether it is set
    values |= {
        "version": __version__,
        "format": FORMAT,
        "variant": mi.variant(),
        "seed": seed,
        "spp": spp,
        "part": part,
        "film": [film.class_name(), *accumulator.size, *accumulator.offset],
        "filter": str(film.rfilter()),
        "colours": list(accumulator.colour.names),
    }
    return json.loads(json.dumps(values))


@dataclass(frozen=True)
class Snapshot:
    """Raw sums of the finished passes, and the state on which the next pass depends.

    The scene is not included.
    """

    identity: dict
    """What two renders must have in common for one to continue the other: parameters, variant, seed, film."""
    passes: tuple[int, ...]
    """Samples per pixel of each pass."""
    progress: Progress
    """State of the render beside its sums."""
    arrays: dict
    """Arrays in double precision: ``camera``, ``light`` and, with strategy images, ``strategies`` (raw sums,
    flat); ``inverse_threshold`` of roulette; with the variance ``replicates.*``, see `image.replicates`."""

    @property
    def spp(self) -> int:
        """Finished samples per pixel."""
        return sum(self.passes)

    def check(self, identity: dict, apart_from=()):
        """Raise ``UsageError`` naming the first entry in which ``identity`` differs."""
        # The version first: parameters may be renamed between versions.
        names = sorted(set(identity) | set(self.identity), key=lambda name: (name != "version", name))
        for name in names:
            mine, given = self.identity.get(name), identity.get(name)
            if name not in apart_from and mine != given:
                raise UsageError(
                    f"the snapshot is of another render: its {name} is {mine!r}, here it is {given!r}; "
                    "go on with what it was begun with, or begin anew (command line: --resume never)"
                )

    def joined(self, other: Snapshot) -> Snapshot:
        """Merge two renders: sums and counts are added; decisions are of the first.

        Raises `UsageError` if they differ in more than seed, samples per pixel and part, or share a seed.
        """
        self.check(other.identity, ("seed", "spp", "part"))
        seeds, others = _seeds(self), _seeds(other)
        if common := set(seeds) & set(others):
            raise UsageError(
                f"seed={min(common)} is in both snapshots; joined renders need seeds of their own"
            )
        spp = self.identity["spp"] + other.identity["spp"]
        work = self.progress.work.joined(other.progress.work)
        sums = [name for name in ("camera", "light", "strategies") if name in self.arrays]
        arrays = {name: self.arrays[name] + other.arrays[name] for name in sums}
        arrays["inverse_threshold"] = self.arrays["inverse_threshold"]
        pairs = zip(halves_of(self.arrays), halves_of(other.arrays), strict=True)
        arrays |= stored(tuple(mine.joined(others) for mine, others in pairs))
        return Snapshot(
            identity=self.identity | {"seed": seeds + others, "spp": spp},
            passes=self.passes + other.passes,
            progress=replace(self.progress, work=work, whole=False),
            arrays=arrays,
        )

    def image_only(self) -> Snapshot:
        """Return a smaller snapshot from which a render cannot continue."""
        kept = {n: a for n, a in self.arrays.items() if not n.startswith(LAST)}
        return replace(self, progress=replace(self.progress, whole=False), arrays=kept)

    def to_bytes(self) -> bytes:
        """Return the bytes of an ``npz`` file (NumPy), without pickled objects."""
        progress = self.progress.stored()
        text = json.dumps({"identity": self.identity, "passes": self.passes, "progress": progress})
        file = io.BytesIO()
        np.savez(file, snapshot=np.array(text), **self.arrays)
        return file.getvalue()

    @staticmethod
    def from_bytes(data: bytes) -> Snapshot:
        """Inverse of `to_bytes`; raises ``UsageError`` for other bytes."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            values = json.loads(str(arrays.pop("snapshot")))
            identity, passes = values["identity"], tuple(values["passes"])
            if identity["format"] == FORMAT:
                progress = Progress.restored(values["progress"])
                return Snapshot(identity, passes, progress, arrays)
        except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise CommandError(f"not a snapshot, or a damaged one ({error})") from error
        raise CommandError(
            f"a snapshot of another version of mitsuba-bdpt: its format is {identity['format']!r}, here it "
            f"is {FORMAT}; go on with the version that it was begun with, or begin anew"
        )


def read(path: Path) -> Snapshot:
    """Read a snapshot file; raises ``UsageError`` naming the file, or ``OSError``."""
    try:
        return Snapshot.from_bytes(path.read_bytes())
    except ValueError as error:
        raise CommandError(f"{str(path)!r} is {error}") from error


def _seeds(snapshot: Snapshot) -> list:
    seed = snapshot.identity["seed"]
    return list(seed) if isinstance(seed, list) else [seed]
