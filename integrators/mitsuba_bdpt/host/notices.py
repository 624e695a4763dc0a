"""State cached with a scene between renders, and fingerprints of parameters that detect edits."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from .introspection import all_parameters, own_parameters

FINDINGS = 16  # maximum number of cached results of one kind per scene; the oldest are dropped

_scenes: dict[int, tuple] = {}

Found = TypeVar("Found")


def notes(scene: mi.Scene, sensor: mi.Sensor) -> dict[str, Any]:
    """Return the cache of ``scene``, a dictionary that lives as long as the scene.

    ``sensor`` is a sensor that it is rendered with. Scenes have no weak references, and a scene kept alive
    would take part in other scenes' virtual calls. A new scene may have the same address: the reconstruction
    filter of the sensor's film, small enough to be kept alive, identifies the scene.
    """
    for number in [n for n, held in _scenes.items() if _references(held) <= _alone()]:
        del _scenes[number]  # its scene is gone
    mark = next(iter(scene.sensors()), sensor).film().rfilter()
    known, found = _scenes.get(id(scene), (None, {}))
    if known is not mark:
        found = {}
        _scenes[id(scene)] = mark, found
    return found


def _references(held: tuple) -> int:
    """Reference count of the filter in an entry of `_scenes`; a film adds one."""
    return sys.getrefcount(held[0])


@cache
def _alone() -> int:
    """`_references` of a filter without a film."""
    return _references((mi.load_dict({"type": "box"}), {}))


def cached(
    scene: mi.Scene,
    sensor: mi.Sensor,
    kind: str,
    key: Hashable,
    find: Callable[[], Found],
    most: int = FINDINGS,
) -> tuple[Found, bool]:
    """Return the result of ``find()``, and whether it was among the latest ``most`` cached of a ``kind``."""
    known = notes(scene, sensor).setdefault(kind, {})
    is_known, found = key in known, known.pop(key, None)
    known[key] = found = found if is_known else find()
    while len(known) > most:
        del known[next(iter(known))]
    return found, is_known


def warn_once(scene: mi.Scene, sensor: mi.Sensor, text: str, about: Hashable = None):
    """Log a warning unless one with the same ``about`` (default: ``text``) was logged for ``scene``."""
    logged = notes(scene, sensor).setdefault("warnings", set())
    about = about or text
    if about not in logged:
        logged.add(about)
        mi.Log(mi.LogLevel.Warn, text)


KEPT = 64  # largest array (entries) that is kept alive: its index stays unique, without holding gigabytes


@dataclass(frozen=True)
class State:
    """Fingerprint of the parameters of Mitsuba's objects; equal if nothing was edited.

    ``marks``: JIT indices of small arrays, checksums of larger arrays, text of all other values. ``kept``:
    the small arrays, so that Dr.Jit does not reuse their indices.
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
