"""What tells a scene from itself after an edit of its parameters."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .introspection import all_parameters, own_parameters

# Arrays of up to so many entries are kept, so that no other gets their number. Larger ones would outlive a
# scene that takes gigabytes.
KEPT = 64


@dataclass(frozen=True)
class State:
    """A record of the parameters of Mitsuba's objects, to find edits by.

    Equal to a later one, also as a key, if nothing was edited in between. ``marks``: small arrays of Dr.Jit
    by their number, transformations too, larger ones by a checksum of their contents, all else by its text.
    ``kept``: what is known by its number.
    """

    marks: tuple[Any, ...]
    kept: tuple[Any, ...] = field(compare=False, repr=False)

    @classmethod
    def of(cls, owners: Iterable[mi.Object], deep: bool = True) -> State:
        """The present state of ``owners``, and of all that they hold if ``deep``."""
        marks, kept = [], []
        own = (own_parameters(owner).values() for owner in owners)
        for value in all_parameters(owners) if deep else chain.from_iterable(own):
            indices = dr.detail.collect_indices(value)
            if not indices:
                marks.append(repr(value))
            elif dr.width(value) <= KEPT or not dr.is_array_v(value):
                marks += indices
                kept.append(dr.copy(value))
            else:
                marks.append(_checksum(value))
        return cls(tuple(marks), tuple(kept))


def _checksum(value) -> tuple:
    """Type, shape and CRC-32 of the contents of an array (4 GB/s on one core)."""
    if dr.is_tensor_v(value):
        return (*value.shape, *_checksum(value.array))
    if dr.depth_v(value) > 1:
        return tuple(_checksum(part) for part in value)
    value = dr.detach(value)
    # Without a copy where the memory is the processor's.
    data = np.from_dlpack(value) if dr.backend_v(value) == dr.JitBackend.LLVM else value.numpy()
    return type(value).__name__, len(data), zlib.crc32(data.view(np.uint8))
