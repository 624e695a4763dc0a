"""Fingerprints of scene parameters, to detect edits."""

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

# Largest array (entries) that is kept alive: its index stays unique, without holding gigabytes.
KEPT = 64


@dataclass(frozen=True)
class State:
    """Fingerprint of the parameters of Mitsuba's objects; equal if nothing was edited.

    ``marks``: JIT indices of small arrays, checksums of larger arrays, text of all other values. ``kept``:
    the arrays known by index, kept alive so that Dr.Jit does not reuse the index.
    """

    marks: tuple[Any, ...]
    kept: tuple[Any, ...] = field(compare=False, repr=False)

    @classmethod
    def of(cls, owners: Iterable[mi.Object], deep: bool = True) -> State:
        """Return the present state of ``owners``, and of their children if ``deep``."""
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
    """Type, shape and CRC-32 of an array's contents (4 GB/s on one core)."""
    if dr.is_tensor_v(value):
        return (*value.shape, *_checksum(value.array))
    if dr.depth_v(value) > 1:
        return tuple(_checksum(part) for part in value)
    value = dr.detach(value)
    # Zero-copy in LLVM variants.
    data = np.from_dlpack(value) if dr.backend_v(value) == dr.JitBackend.LLVM else value.numpy()
    return type(value).__name__, len(data), zlib.crc32(data.view(np.uint8))
