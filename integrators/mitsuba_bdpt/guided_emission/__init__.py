"""Guided emission: light subpaths start where they matter, as a pilot has learned. A component.

A pilot accumulates `EmissionStatistics` in the `Cells` of tables, `learn` fits `EmissionTables` to them, and
a render samples the directions (from infinity: the points) of emission by these tables.
"""

from .learning import EmissionStatistics, Learnt, learn, left_out
from .tables import Cells, EmissionTables, side_of, why_not

__all__ = [
    "Cells",
    "EmissionStatistics",
    "EmissionTables",
    "Learnt",
    "learn",
    "left_out",
    "side_of",
    "why_not",
]
