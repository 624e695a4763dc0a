"""Order of a scene's emitters, in which all tables have them.

It decides which random numbers choose which emitter. Mitsuba puts the meshes of a file among its shapes in
the order of their addresses in memory, another one in each load, unless loaded with ``optimize=False``.
"""

from __future__ import annotations

from collections import Counter

import mitsuba as mi


def in_order(scene: mi.Scene) -> list[mi.Emitter]:
    """Return the emitters as the scene has them, but those on meshes by the ids, then places, of these."""
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
