"""BSDFs that differ in the numbers of their textures alone: one is called for all, with numbers from tables.

Virtual calls record a function for each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .introspection import LEAVES, number, own_parameters, parts

# Plugins whose functions depend on their parameters alone, and on which textures are 0: those lobes of
# ``principled`` are left out at loading.
_PLAIN = LEAVES | {"SmoothDiffuse", "Principled", "TwoSidedBRDF"}


class Mold:
    """The ``bsdfs`` of one kind: the first is called for all. ``values`` of each one's ``textures``."""

    def __init__(self, bsdfs: list[mi.BSDF], textures: list[list[mi.Texture]], values: list[list]):
        self.bsdfs, self._held = bsdfs, []
        for texture, *column in zip(textures[0], *values, strict=True):
            if (np.array(column) != column[0]).any():
                parameters = mi.traverse(texture)
                # Lists, as in `emitters.tables.table`.
                table = type(parameters["value"])(*map(mi.Float, np.array(column).T.tolist()))
                dr.make_opaque(table)
                self._held.append((parameters, table))

    def __call__(self, question: Callable[..., Any], row: mi.UInt32, *args):
        """Return ``question(bsdf, *args)`` of the BSDF ``row``; the last of ``args`` is the call's mask."""
        own = [dr.copy(parameters["value"]) for parameters, _ in self._held]
        try:
            for parameters, table in self._held:
                parameters["value"] = dr.gather(type(table), table, row, args[-1])
            return question(self.bsdfs[0], *args)
        finally:
            for (parameters, _), value in zip(self._held, own, strict=True):
                parameters["value"] = value


def molds(bsdfs: Iterable[mi.BSDF]) -> tuple[list[Mold], int]:
    """Group ``bsdfs`` by all that their functions depend on but numbers of textures; count structures."""
    kinds, structures = dict[Any, list[tuple]](), set()
    for bsdf in bsdfs:
        kind, textures, values, found = [bsdf.flags()], [], [], parts(bsdf)
        structures.add(tuple((name, part.class_name()) for name, part in found))  # names and classes of parts
        for name, part in found:
            own, of_class = own_parameters(part), part.class_name()
            if of_class not in _PLAIN or any(dr.width(x) != 1 or dr.grad_enabled(x) for x in own.values()):
                kind.append(id(bsdf))
            elif of_class in LEAVES:
                values.append(np.array(own["value"]).ravel())
                kind.append((name, of_class, *(part is t for t in textures), bool(values[-1].any())))
                textures.append(part)
            else:
                kind.append((name, of_class, *((key, number(x)) for key, x in own.items())))
        kinds.setdefault(tuple(kind), []).append((bsdf, textures, values))
    return [Mold(*map(list, zip(*members, strict=True))) for members in kinds.values()], len(structures)
