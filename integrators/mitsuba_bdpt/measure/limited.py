"""Renders of a sweep under a limit of time: which of them fit, predicted from those that were rendered."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby

from .preset import FIRST_SEED, Cell, Cells

LEAST_SLOPE = 0.5  # of a larger budget's seconds over samples, in those of the budgets before


class Pending:
    """The ``missing`` renders of a scene, in the order of seeds, all budgets of each.

    Integrators of one budget and seed are rendered together or not at all. ``known``: seconds of earlier
    renders by integrator and budget.
    """

    def __init__(self, cells: Cells, missing: Sequence[Cell], known: Mapping[str, Mapping[int, float]]):
        self.cells = cells
        ordered = sorted(missing, key=lambda cell: (cell.seed, cell.budget))
        self._groups = [
            list(group) for _, group in groupby(ordered, key=lambda cell: (cell.seed, cell.budget))
        ]
        self._seconds = {method: dict(seconds) for method, seconds in known.items()}
        self._compiled = set[tuple[str, int]]()

    @property
    def late(self) -> list[Cell]:
        return [cell for group in self._groups for cell in group]

    @property
    def needed(self) -> float:
        return sum(map(self._predicted, self._groups))

    @property
    def text(self) -> str:
        """How many renders are missing, and at which budgets."""
        late = self.late
        counts = Counter(cell.budget for cell in late)
        at = ", ".join(f"{count} at {budget} spp" for budget, count in sorted(counts.items()))
        return f"{len(late)} of {len(self.cells.planned())} renders: {at}"

    def render(self, rendered: Callable[[Cell], float | None], seconds: float) -> int:
        """Render what fits into the ``seconds``; returns the number of renders.

        ``rendered`` renders a cell and returns its seconds, None if it failed. Two seeds of the smallest
        budget are rendered in any case: with fewer there is no figure.
        """
        end = time.monotonic() + seconds

        def fits(group: list[Cell]) -> bool:
            is_least = group[0].budget == min(self.cells.subject.spp) and group[0].seed < FIRST_SEED + 2
            left = end - time.monotonic()
            return is_least or (left > 0 and self._predicted(group) <= left)

        done = 0
        while group := next(filter(fits, self._groups), None):
            self._groups.remove(group)
            for cell in group:
                taken = rendered(cell)
                if taken is not None:
                    self._seconds.setdefault(cell.method, {})[cell.budget] = taken
                self._compiled.add((cell.method, cell.budget))
                done += 1
        return done

    def _predicted(self, group: list[Cell]) -> float:
        """Return the predicted seconds of the renders of a ``group``."""
        # The first render of a budget compiles, in a render that is not measured.
        renders = [(c.method, c.budget, 1 + ((c.method, c.budget) not in self._compiled)) for c in group]
        return sum(count * self._seconds_of(method, budget) for method, budget, count in renders)

    def _seconds_of(self, method: str, budget: int) -> float:
        """Return the seconds of a render: the last of its budget, else extrapolated; 0 before the first."""
        known = self._seconds.get(method, {})
        if not known or budget in known:
            return known.get(budget, 0.0)
        *_, before, last = [0, *sorted(known)]
        proportional = known[last] / last
        slope = (known[last] - known.get(before, 0.0)) / (last - before)
        if budget < last:
            return proportional * budget
        return known[last] + max(slope, LEAST_SLOPE * proportional) * (budget - last)
