"""A render between two passes, as plain numbers: to go on later, or to be joined with others elsewhere."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import CommandError, UsageError
from ..image.spread import restored, stored

# Of what a snapshot holds; another number with every change of that.
FORMAT = 4

# What is added up where snapshots are joined, and what is kept as the first one has it.
_SUMMED = ("counts", "compiled", "cached", "seconds", "compile_seconds", "pilot_seconds")


@dataclass(frozen=True)
class Snapshot:
    """The raw sums of the passes that are done, and all that the next pass depends on.

    ``identity`` says of which render: variant, parameters, seed, samples per pixel, film; plain values, as
    ``progress`` (decisions, counts, seconds, …). ``passes``: samples per pixel of each. ``arrays``, all in
    double precision: ``camera``, ``light`` and, with strategy images, ``strategies`` (raw sums, see
    `accumulator.Accumulator`; flat), ``inverse_threshold`` of roulette, ``moments.*`` of the pilots,
    ``replicates.*`` of the variance. The scene is not part of it: whoever goes on has to bring the same one.
    """

    identity: dict
    passes: tuple[int, ...]
    progress: dict
    arrays: dict

    @property
    def spp(self) -> int:
        """Samples per pixel that are done."""
        return sum(self.passes)

    def check(self, identity: dict, apart_from=()):
        """Raise ``ValueError`` naming the first entry in which this is another render than ``identity``."""
        for name in sorted(set(identity) | set(self.identity)):
            mine, given = self.identity.get(name), identity.get(name)
            if name not in apart_from and mine != given:
                raise UsageError(
                    f"the snapshot is of another render: its {name} is {mine!r}, here it is {given!r}; "
                    "go on with what it was begun with, or begin anew"
                )

    def joined(self, other: Snapshot) -> Snapshot:
        """Both as one render: sums and counts are added. Raises ``ValueError`` if they differ in more than
        seed and samples per pixel, or have a seed in common."""
        self.check(other.identity, ("seed", "spp"))
        seeds, others = _seeds(self), _seeds(other)
        if common := set(seeds) & set(others):
            raise UsageError(
                f"seed={min(common)} is in both snapshots; joined renders need seeds of their own"
            )
        spp = self.identity["spp"] + other.identity["spp"]
        progress = self.progress | {
            name: _added(self.progress[name], other.progress[name]) for name in _SUMMED
        }
        arrays = {
            name: self.arrays[name] + other.arrays[name]
            for name in ("camera", "light", "strategies")
            if name in self.arrays
        } | {"inverse_threshold": self.arrays["inverse_threshold"]}
        return Snapshot(
            identity=self.identity | {"seed": seeds + others, "spp": spp},
            passes=self.passes + other.passes,
            progress=progress | {"whole": False, "replicates": _joined_replicates(self, other, arrays)},
            arrays=arrays,
        )

    def image_only(self) -> Snapshot:
        """What an image is made of, to be sent elsewhere and joined; a render cannot go on from it."""
        kept = {n: a for n, a in self.arrays.items() if not n.startswith(("moments.", "replicates.last"))}
        return replace(self, progress=self.progress | {"whole": False}, arrays=kept)

    def to_bytes(self) -> bytes:
        """As a file of NumPy's ``npz`` format, without pickled objects."""
        text = json.dumps({"identity": self.identity, "passes": self.passes, "progress": self.progress})
        file = io.BytesIO()
        np.savez(file, snapshot=np.array(text), **self.arrays)
        return file.getvalue()

    @staticmethod
    def from_bytes(data: bytes) -> Snapshot:
        """The snapshot of `to_bytes`; raises ``ValueError`` if it is none."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            values = json.loads(str(arrays.pop("snapshot")))
            return Snapshot(values["identity"], tuple(values["passes"]), values["progress"], arrays)
        except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise CommandError(f"not a snapshot: {type(error).__name__} {error}") from error


def read(path: Path) -> Snapshot:
    """The snapshot in a file; raises ``ValueError`` naming it if it holds none, ``OSError``."""
    try:
        return Snapshot.from_bytes(path.read_bytes())
    except ValueError as error:
        raise CommandError(f"{str(path)!r} is {error}") from error


def _seeds(snapshot: Snapshot) -> list:
    seed = snapshot.identity["seed"]
    return list(seed) if isinstance(seed, list) else [seed]


def _added(a, b):
    return {name: a[name] + b[name] for name in a} if isinstance(a, dict) else a + b


def _joined_replicates(a: Snapshot, b: Snapshot, arrays: dict):
    """Replicates of both, whose means and squares go to ``arrays``."""
    first, second = a.progress["replicates"], b.progress["replicates"]
    if first is None:
        return None
    halves = zip(restored(first, a.arrays), restored(second, b.arrays), strict=True)
    found, progress = stored([mine.joined(other) for mine, other in halves])
    arrays |= found
    return progress
