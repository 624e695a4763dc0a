"""Equality of media by their properties, not by object identity.

Files loaded with ``optimize=False`` and scenes made in Python have a separate object for each shape that
declares a medium.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from ..host.introspection import children, own_parameters

if TYPE_CHECKING:
    from .media import MediumProperties

_ROUNDING = 1e-5  # relative difference due to rounding (sigma_t 0.4 with scale 2, and 0.8)


def representatives(media: list[MediumProperties]) -> list[int]:
    """Return for each of ``media`` the index of the first one that is equal to it.

    Equal media have the same classes and parameters, and the same values up to rounding. Constants count by
    the values alone, since only their product matters. Varying volumes and plugins in Python equal only
    themselves: Mitsuba exposes neither a grid's filter nor its wrap mode.
    """
    keys = [(m.medium.use_emitter_sampling(), *_key(m.medium)) for m in media]

    def are_equal(i: int, j: int) -> bool:
        return keys[i] == keys[j] and np.allclose(
            media[i].values, media[j].values, rtol=_ROUNDING, atol=0, equal_nan=True
        )

    return [next((j for j in range(i) if are_equal(j, i)), i) for i in range(len(media))]


def _key(owner: mi.Object) -> Iterator[Hashable]:
    """Yield what an equal object has in common with ``owner``, its descendants included."""
    varies = isinstance(owner, mi.Volume) and owner.class_name() != "ConstVolume"
    # Objects of Mitsuba's own plugins have exactly these types, Python plugins derived ones.
    of_python = type(owner) not in (mi.Medium, mi.Volume, mi.PhaseFunction)
    yield owner if varies or of_python else owner.class_name()
    if isinstance(owner, mi.Volume):
        return
    product = isinstance(owner, mi.Medium) and owner.is_homogeneous()
    for name, value in own_parameters(owner).items():
        if not (product and name == "scale"):
            yield name, np.array(value).tobytes()
    for value in children(owner).values():
        if isinstance(value, mi.Object):
            yield from _key(value)
