"""Tables that a kernel can index, with one row per emitter of the scene."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import accumulate
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

Record = TypeVar("Record")

BELOW_ONE = 1 - 2**-24  # largest float below 1


def in_order(scene: mi.Scene) -> list[mi.Emitter]:
    """Return the emitters as the scene has them, but those on meshes by the ids, then places, of these.

    The order decides which random numbers choose which emitter. Mitsuba puts the meshes of a file in the
    order of their addresses in memory, another one in each load, unless loaded with ``optimize=False``.
    """
    emitters = scene.emitters()
    shapes = [emitter.get_shape() for emitter in emitters]
    slots = [i for i, shape in enumerate(shapes) if shape is not None and shape.is_mesh()]
    ids = Counter(shapes[i].id() for i in slots)

    def key(i: int) -> tuple:
        box, name = shapes[i].bbox(), shapes[i].id()
        return name, *((tuple(box.min), tuple(box.max), str(emitters[i])) if ids[name] > 1 else ())

    for slot, emitter in zip(slots, [emitters[i] for i in sorted(slots, key=key)], strict=True):
        emitters[slot] = emitter
    return emitters


def rows(emitters, default, row) -> list:
    """``row(emitter)`` of each of ``emitters``, ``default`` where one is None."""
    return [default if emitter is None else row(emitter) for emitter in emitters]


def table(records: list[Record]) -> Record:
    """Opaque columns (``mi.Float``, ``mi.Vector3f``) of records of numbers and tuples, for `look_up`."""

    def column(name):
        # Lists, not NumPy: Dr.Jit borrows an array's memory, and its alignment is part of the kernel.
        values = np.array([getattr(record, name) for record in records], dtype=np.float64).T.tolist()
        if not isinstance(values[0], list):
            return mi.Float(values)
        return mi.Vector3f(*(mi.Float(v) for v in values))

    made = replace(records[0], **{name: column(name) for name in vars(records[0])})
    dr.make_opaque(made)
    return made


def cell_at(u: mi.Point2f, side: int) -> mi.UInt32:
    """Index of the cell at ``u`` in a square of ``side`` x ``side`` cells."""
    at = mi.Point2u(dr.clip(u, 0, BELOW_ONE) * side)
    return mi.UInt32(dr.minimum(at.y, side - 1) * side + dr.minimum(at.x, side - 1))


def look_up(columns: Record, index: mi.UInt32, active: mi.Bool) -> Record:
    return replace(columns, **{k: dr.gather(type(v), v, index, active) for k, v in vars(columns).items()})


def switch(owners, method: str, index: mi.UInt32, *arguments):
    """Call ``method`` of the owner at ``index``; the last argument is the mask.

    ``owners``: one per emitter of the scene, or None. Calls these alone: Mitsuba's virtual calls visit all
    objects in the process, some of which may lack the method.
    """
    methods = [getattr(owner, method) for owner in owners if owner is not None]
    if len(methods) == 1:
        return methods[0](*arguments)
    # Number of owners before each emitter; the last sum belongs to no emitter.
    numbers = accumulate((owner is not None for owner in owners), initial=0)
    number = dr.gather(mi.UInt32, mi.UInt32(list(numbers)), index, arguments[-1])
    return dr.switch(number, methods, *arguments)


class Mask:
    """Property of a group's emitters; ``values``: one per emitter of the scene, None of other groups."""

    def __init__(self, values):
        known = [value for value in values if value is not None]
        self.any, self.all = any(known), all(known)
        self._table = mi.Bool([bool(value) for value in values])
        dr.make_opaque(self._table)

    def at(self, index, active):
        """Mask: the emitter has the property (``active`` lanes: those of this group)."""
        if not self.any:
            return mi.Bool(False)
        if self.all:
            return mi.Bool(active)
        return active & dr.gather(mi.Bool, self._table, index, active)


def inverse_table(pointers):
    """Emitter index by the index of its pointer in Dr.Jit's registry."""
    ids = dr.reinterpret_array(mi.UInt32, pointers).numpy()
    found = np.zeros(int(ids.max()) + 1, int)
    found[ids] = range(len(ids))
    return mi.UInt32(found.tolist())
