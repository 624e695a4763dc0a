"""What tells a scene from itself after an edit of its parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr

from .objects import all_parameters

# Arrays of up to so many entries are kept, so that no other gets their number.
KEPT = 64

# So many entries of larger ones stand for them: kept, these would outlive a scene that takes gigabytes. (Each
# takes 3 us; of 300 meshes all together 10 ms.)
LOOKED_AT = 2


@dataclass(frozen=True)
class State:
    """The parameters of Mitsuba's objects at one time; equal to a later one, also as a key, if nothing was
    edited in between. (A large array that was edited in place, or twice, may have the number of the old one
    again, and is taken for it if it has the same entries where two are looked at.)

    ``marks``: arrays of Dr.Jit by their number, all else by its text. ``kept``: the small arrays.
    """

    marks: tuple
    kept: tuple = field(compare=False, repr=False)

    @classmethod
    def of(cls, owners) -> State:
        """The present state of ``owners`` and of all that they hold."""
        marks, kept = [], []
        for value in all_parameters(owners):
            indices = dr.detail.collect_indices(value)
            if not indices:
                marks.append(repr(value))
                continue
            marks += indices
            if (width := dr.width(value)) <= KEPT:
                kept.append(dr.copy(value))
            else:
                entries = value.array if dr.is_tensor_v(value) else value
                places = ((i + 1) * (width - 1) // LOOKED_AT for i in range(LOOKED_AT))
                marks += [width, *(repr(dr.slice(entries, i)) for i in places)]
        return cls(tuple(marks), tuple(kept))
