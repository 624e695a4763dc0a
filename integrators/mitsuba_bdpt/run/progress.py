"""All that the next pass of a render and its statistics depend on, besides the film's sums."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace

import numpy as np

from ..image.replicates import Spread
from ..planning.decision import read_decisions
from ..planning.moments import Moments
from ..planning.planner import Decided, Pilots
from .work import Work


@dataclass(frozen=True)
class Progress:
    """Progress of a render after a pass.

    What was ``decided``, the ``work`` that was done, the two ``halves`` of the replicates, ``None`` without
    `variance` (see `image.replicates`); ``small_first``: whether the first pass is one of a single sample,
    ``None`` before it is known; ``whole``: whether a render can go on from it, and not only be joined;
    ``scene``: a digest of the scene's files, if whoever keeps it has made one."""

    decided: Decided = Decided()
    work: Work = Work()
    halves: tuple[Spread, ...] | None = None
    small_first: bool | None = None
    whole: bool = True
    scene: str | None = None

    def joined(self, other: Progress) -> Progress:
        """Of two renders that are joined; what was decided is that of the first."""
        halves = None
        if self.halves is not None:
            pairs = zip(self.halves, other.halves, strict=True)
            halves = tuple(mine.joined(others) for mine, others in pairs)
        joined = replace(self, work=self.work.joined(other.work), halves=halves)
        return joined.image_only()

    def image_only(self) -> Progress:
        """Without what only a render that goes on needs."""
        return replace(self, whole=False, decided=replace(self.decided, moments=None))

    def stored(self) -> tuple[dict, dict]:
        """Plain values, as JSON holds them, and arrays by name: the fields of all parts side by side."""
        values, arrays = {}, {}
        for part in (self, self.decided, self.work):
            values |= {f.name: getattr(part, f.name) for f in fields(part)}
        del values["decided"], values["work"]
        values["decisions"] = [decision.record() for decision in self.decided.decisions]
        if self.decided.moments is not None:
            values["moments"], arrays = _split(self.decided.moments, "moments")
        values["replicates"] = halves = values.pop("halves")
        if halves is not None:
            values["replicates"] = {"halves": [[half.count, half.spp] for half in halves]}
            for i, half in enumerate(halves):
                arrays |= _split(half, f"replicates.{i}")[1]
        return values, arrays

    @classmethod
    def restored(cls, values: dict, arrays: dict) -> Progress:
        """What was `stored`; takes its arrays out of ``arrays``."""
        values = dict(values)
        decisions = read_decisions(json.dumps(values["decisions"]))
        moments = _arrays(arrays, "moments")
        if moments:
            moments = Moments(**values["moments"], **moments)
        values |= {"decisions": decisions, "moments": moments or None, "pilots": Pilots(*values["pilots"])}
        values["left_out"] = tuple(values["left_out"])
        replicates, values["halves"] = values.pop("replicates"), None
        if replicates is not None:
            values["halves"] = tuple(
                Spread(count, spp, **_arrays(arrays, f"replicates.{i}"))
                for i, (count, spp) in enumerate(replicates["halves"])
            )
        for name, part in (("decided", Decided), ("work", Work)):
            values[name] = part(**{f.name: values.pop(f.name) for f in fields(part)})
        return cls(**values)


def _split(record, name: str) -> tuple[dict, dict]:
    """The plain values of a dataclass, and its arrays by name after that of the record."""
    values, arrays = {}, {}
    for f in fields(record):
        value = getattr(record, f.name)
        if isinstance(value, np.ndarray):
            arrays[f"{name}.{f.name}"] = value
        else:
            values[f.name] = value
    return values, arrays


def _arrays(arrays: dict, name: str) -> dict:
    """The arrays of the record of that name, taken out of ``arrays``."""
    names = [other for other in arrays if other.startswith(f"{name}.")]
    return {other.removeprefix(f"{name}."): arrays.pop(other) for other in names}
