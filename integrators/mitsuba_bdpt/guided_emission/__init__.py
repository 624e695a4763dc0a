"""Guided emission: light subpaths start where they matter, as a pilot has learned. A component.

A pilot accumulates emission statistics in the `Cells` of tables (`Listener`), `learn` fits `EmissionTables`
to them, and a render samples the directions (from infinity: the points) of emission by these tables.
"""

from .learning import Learnt, Listener, learn, left_by, left_out
from .tables import Cells, EmissionTables, side_of, why_not

__all__ = [
    "Cells",
    "EmissionTables",
    "Learnt",
    "Listener",
    "learn",
    "left_by",
    "left_out",
    "side_of",
    "why_not",
]
