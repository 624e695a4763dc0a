"""Equality of media by their properties, not by object identity.

Files loaded with ``optimize=False`` and scenes made in Python have a separate object for each shape that
declares a medium.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np

from ..host.introspection import children, own_parameters

# Relative difference due to rounding (sigma_t 0.4 with scale 2, and 0.8).
_ROUNDING = 1e-5


def representatives(media: list[mi.Medium], answers: Callable[[mi.Medium], np.ndarray]) -> list[int]:
    """Return for each of ``media`` the index of the first one that is equal to it.

    ``answers(medium)``: extinction, scattering and phase function at random points and directions.

    Equal media have the same structure (`_structure`), the same values, and the same answers up to rounding.
    Constants count by the answers alone, since only their product matters. Varying volumes equal only
    themselves: Mitsuba exposes neither a grid's filter nor its wrap mode.
    """
    structures = [_structure(medium) for medium in media]
    answered = cache(lambda index: answers(media[index]))
    found: list[int] = []
    for index, medium in enumerate(media):
        alike = (i for i in range(index) if found[i] == i and _same(structures[i], structures[index]))
        equal = (
            i
            for i in alike
            if _have_same_values(media[i], medium)
            and np.allclose(answered(i), answered(index), rtol=_ROUNDING, atol=0, equal_nan=True)
        )
        found.append(next(equal, index))
    return found


def _same(structure: tuple | None, other: tuple | None) -> bool:
    return structure is not None and structure == other


def _structure(medium: mi.Medium) -> tuple | None:
    """Classes and volumes of a medium and its descendants; None with Python plugins."""
    parts = list(_held(medium, "medium"))
    # Objects of Mitsuba's own plugins have exactly these types, Python plugins derived ones.
    if any(type(owner) not in (mi.Medium, mi.Volume, mi.PhaseFunction) for _, owner in parts):
        return None
    of_parts = (
        (path, owner.class_name(), owner if _varies(owner) else None, *_shapes(owner))
        for path, owner in parts
    )
    return (medium.use_emitter_sampling(), *of_parts)


def _held(owner: mi.Object, path: str) -> Iterator[tuple[str, mi.Object]]:
    """Yield ``owner`` and its descendants with paths; volumes are not descended into."""
    yield path, owner
    if isinstance(owner, mi.Volume):
        return
    for name, value in children(owner).items():
        if isinstance(value, mi.Object):
            yield from _held(value, f"{path}.{name}")


def _varies(owner: mi.Object) -> bool:
    return isinstance(owner, mi.Volume) and owner.class_name() != "ConstVolume"


def _values(owner: mi.Object) -> dict[str, Any]:
    """Parameters of ``owner`` in which it may differ from an equal structure."""
    if isinstance(owner, mi.Volume):
        return {}
    skipped = "scale" if isinstance(owner, mi.Medium) and owner.is_homogeneous() else ""
    return {name: value for name, value in own_parameters(owner).items() if name != skipped}


def _shapes(owner: mi.Object) -> list[tuple]:
    return [(name, np.shape(value)) for name, value in _values(owner).items()]


def _have_same_values(a: mi.Medium, b: mi.Medium) -> bool:
    """Whether two media of one structure have the same values, volumes aside."""
    return all(
        np.array_equal(np.array(ours), np.array(theirs), equal_nan=True)
        for (_, one), (_, other) in zip(_held(a, ""), _held(b, ""), strict=True)
        for ours, theirs in zip(_values(one).values(), _values(other).values(), strict=True)
    )
