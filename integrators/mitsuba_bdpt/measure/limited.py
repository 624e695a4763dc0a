"""The missing renders of a scene, in an order in which those that fit into a time are rendered first."""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path

from .preset import FIRST_SEED, Cell, Cells
from .results import cell_file, read_cell

LEAST_SLOPE = 0.5  # of a larger budget's seconds over samples, in those of the budgets before


class Pending:
    """The renders of a scene that are not in ``output``, in the order of seeds, all budgets of each.

    Integrators of one budget and seed are rendered together or not at all.
    """

    def __init__(self, cells: Cells, output: Path):
        self.cells, self._output = cells, output
        missing = [[c for c in group if not cell_file(output, c).exists()] for group in cells.groups]
        self._groups = [group for group in missing if group]
        self._seconds: dict[str, dict[int, float]] = defaultdict(dict)
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
        counts = Counter(cell.budget for cell in self.late)
        at = ", ".join(f"{count} at {budget} spp" for budget, count in sorted(counts.items()))
        return f"{counts.total()} of {len(self.cells.planned)} renders: {at}"

    def render(self, rendered: Callable[[Cell], float | None], seconds: float) -> int:
        """Render what fits into the ``seconds``; returns the number of renders.

        ``rendered`` renders a cell and returns its seconds, None if it failed. Two seeds of the smallest
        budget are rendered in any case: with fewer there is no figure.
        """
        end = time.monotonic() + seconds
        if seconds < math.inf and not self._seconds:
            finished = {cell: cell_file(self._output, cell) for cell in self.cells.planned}
            for cell, file in finished.items():
                if file.exists():
                    self._seconds[cell.method][cell.budget] = read_cell(file)["seconds"]

        def fits(group: list[Cell]) -> bool:
            is_least = group[0].budget == min(self.cells.spp) and group[0].seed < FIRST_SEED + 2
            left = end - time.monotonic()
            return is_least or (left > 0 and self._predicted(group) <= left)

        done = 0
        while group := next(filter(fits, self._groups), None):
            self._groups.remove(group)
            for cell in group:
                taken = rendered(cell)
                if taken is not None:
                    self._seconds[cell.method][cell.budget] = taken
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
        known = self._seconds[method]
        if not known or budget in known:
            return known.get(budget, 0.0)
        *_, before, last = [0, *sorted(known)]
        proportional = known[last] / last
        if budget < last:
            return proportional * budget
        slope = (known[last] - known.get(before, 0.0)) / (last - before)
        return known[last] + max(slope, LEAST_SLOPE * proportional) * (budget - last)
