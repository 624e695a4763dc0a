"""Records whose fields are arrays of one entry for each of many things."""

from __future__ import annotations

from typing import Any, Self

import drjit as dr
import mitsuba as mi


class Columns:
    """A record of arrays, made and gathered by hand.

    Dr.Jit takes the types of a record's fields for those of the first variant that asked.
    """

    @staticmethod
    def types() -> tuple[Any, ...]:
        """The types of the fields in the present variant, in their order."""
        raise NotImplementedError

    @classmethod
    def zeros(cls, count: int) -> Self:
        """Room for so many."""
        return cls(*(dr.zeros(kind, count) for kind in cls.types()))

    def at(self, index: mi.UInt32, active: mi.Bool | bool = True) -> Self:
        """Those of these numbers."""
        columns = vars(self).values()
        return type(self)(*(dr.gather(type(column), column, index, active) for column in columns))
