"""A render between two passes, as plain numbers: to go on later, or to be joined with others elsewhere."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from .._version import __version__
from ..errors import CommandError, UsageError
from ..image.accumulator import Accumulator
from ..settings import Settings
from .progress import Progress

# Of what a snapshot holds; another number with every change of that.
FORMAT = 6


def identity(settings: Settings, accumulator: Accumulator, seed: int, spp: int) -> dict:
    """What two renders have to have in common for one to go on from the other, as JSON holds it.

    The scene is not in it.
    """
    film, values = accumulator.film, asdict(settings)
    del values["timeout"]
    values["target_error"] = bool(settings.target_error)  # the passes depend on whether there is one
    values |= {
        "version": __version__,
        "format": FORMAT,
        "variant": mi.variant(),
        "seed": seed,
        "spp": spp,
        "film": [film.class_name(), *accumulator.size, *accumulator.offset],
        "filter": str(film.rfilter()),
        "colours": list(accumulator.colour.names),
    }
    return json.loads(json.dumps(values))


@dataclass(frozen=True)
class Snapshot:
    """The raw sums of the passes that are done, and all that the next pass depends on.

    ``identity`` says of which render, see `identity`; ``passes``: samples per pixel of each. ``arrays``, all
    in double precision: ``camera``, ``light`` and, with strategy images, ``strategies`` (raw sums, see
    `accumulator.Accumulator`; flat), ``inverse_threshold`` of roulette, ``replicates.last.*``, the sums after
    the last replicate of the variance. The scene is not part of it: whoever goes on has to bring the same
    one.
    """

    identity: dict
    passes: tuple[int, ...]
    progress: Progress
    arrays: dict

    @property
    def spp(self) -> int:
        """Samples per pixel that are done."""
        return sum(self.passes)

    def check(self, identity: dict, apart_from=()):
        """Raise ``UsageError`` naming the first entry in which this is another render than ``identity``."""
        # The version first: parameters of another one may differ in name only.
        names = sorted(set(identity) | set(self.identity), key=lambda name: (name != "version", name))
        for name in names:
            mine, given = self.identity.get(name), identity.get(name)
            if name not in apart_from and mine != given:
                raise UsageError(
                    f"the snapshot is of another render: its {name} is {mine!r}, here it is {given!r}; "
                    "go on with what it was begun with, or begin anew"
                )

    def joined(self, other: Snapshot) -> Snapshot:
        """Both as one render: sums and counts are added.

        Raises `UsageError` if they differ in more than seed and samples per pixel, or have a seed in common.
        """
        self.check(other.identity, ("seed", "spp"))
        seeds, others = _seeds(self), _seeds(other)
        if common := set(seeds) & set(others):
            raise UsageError(
                f"seed={min(common)} is in both snapshots; joined renders need seeds of their own"
            )
        spp = self.identity["spp"] + other.identity["spp"]
        arrays = {
            name: self.arrays[name] + other.arrays[name]
            for name in ("camera", "light", "strategies")
            if name in self.arrays
        } | {"inverse_threshold": self.arrays["inverse_threshold"]}
        return Snapshot(
            identity=self.identity | {"seed": seeds + others, "spp": spp},
            passes=self.passes + other.passes,
            progress=self.progress.joined(other.progress),
            arrays=arrays,
        )

    def image_only(self) -> Snapshot:
        """What an image is made of, to be sent elsewhere and joined; a render cannot go on from it."""
        kept = {n: a for n, a in self.arrays.items() if not n.startswith("replicates.last.")}
        return replace(self, progress=self.progress.image_only(), arrays=kept)

    def to_bytes(self) -> bytes:
        """As a file of NumPy's ``npz`` format, without pickled objects."""
        progress, arrays = self.progress.stored()
        text = json.dumps({"identity": self.identity, "passes": self.passes, "progress": progress})
        file = io.BytesIO()
        np.savez(file, snapshot=np.array(text), **self.arrays, **arrays)
        return file.getvalue()

    @staticmethod
    def from_bytes(data: bytes) -> Snapshot:
        """The snapshot of `to_bytes`; raises ``UsageError`` if it is none."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            values = json.loads(str(arrays.pop("snapshot")))
            identity, passes = values["identity"], tuple(values["passes"])
            if identity["format"] == FORMAT:
                progress = Progress.restored(values["progress"], arrays)
                return Snapshot(identity, passes, progress, arrays)
        except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise CommandError(f"not a snapshot, or a damaged one ({error})") from error
        raise CommandError(
            f"a snapshot of another version of mitsuba-bdpt: its format is {identity['format']!r}, here it "
            f"is {FORMAT}; go on with the version that it was begun with, or begin anew"
        )


def read(path: Path) -> Snapshot:
    """The snapshot in a file; raises ``UsageError`` naming it if it holds none, ``OSError``."""
    try:
        return Snapshot.from_bytes(path.read_bytes())
    except ValueError as error:
        raise CommandError(f"{str(path)!r} is {error}") from error


def _seeds(snapshot: Snapshot) -> list:
    seed = snapshot.identity["seed"]
    return list(seed) if isinstance(seed, list) else [seed]
