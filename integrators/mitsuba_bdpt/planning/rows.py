"""What a pilot keeps of each camera sample, and of splats: rows of numbers, in parts side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..transport import mis
from .configuration import WEIGHTINGS


@dataclass(frozen=True)
class Layout:
    """The parts of a row, by name: how many numbers each has, in their order."""

    parts: dict[str, int]

    @property
    def width(self) -> int:
        """Numbers of a row: an even one, so that Dr.Jit adds it as a packet."""
        used = sum(self.parts.values())
        return used + used % 2

    def place(self, name: str) -> slice:
        """Where the numbers of a part are."""
        names = list(self.parts)
        first = sum(self.parts[other] for other in names[: names.index(name)])
        return slice(first, first + self.parts[name])

    def of(self, rows: np.ndarray, name: str) -> np.ndarray:
        """A part of all rows; their numbers lie along the last axis."""
        return rows[..., self.place(name)]

    def row(self, values: Mapping[str, list[Any]]) -> list[Any]:
        """The numbers of one row, from lists by the names of its parts."""
        return [x for name in self.parts for x in values[name]]


# How many weightings use a class of strategies: the last ones.
_USERS = {kind: sum(w.of(kind) > 0 for w in WEIGHTINGS) for kind in mis.CLASSES}

# Of a camera sample, for each weighting: its estimate, and the second moments of its contributions without
# t <= 1, less their squares; for each weighting with t <= 1 their second moments by it; for each weighting
# with inner connections what drawing one adds. Then the number of its vertices that were joined; its tile; in
# scenes with media the number of pairs that were evaluated, else 0.
SAMPLE = Layout(
    {
        "estimate": len(WEIGHTINGS),
        "moment": len(WEIGHTINGS),
        "light": _USERS["light"],
        "draw": _USERS["inner"],
        "joined": 1,
        "tile": 1,
        "evaluated": 1,
    }
)

# Parts of `SAMPLE` that are sums over the contributions.
SUMS = ("estimate", "moment", "light", "draw")

# The size of splats, their second moments without t <= 1, those of them that are rare (see `pilot.SELDOM`),
# and their second moments by t <= 1.
SPLAT = Layout(
    {
        "size": 1,
        "moment": len(WEIGHTINGS),
        "rare": len(WEIGHTINGS),
        "light": _USERS["light"],
    }
)
