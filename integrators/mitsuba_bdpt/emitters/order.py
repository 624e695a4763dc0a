"""Order of a scene's emitters, in which all tables have them.

It decides which random numbers choose which emitter. Mitsuba puts the meshes of a file among its shapes in
the order of their addresses in memory, another one in each load, unless loaded with ``optimize=False``.
"""

from __future__ import annotations

import mitsuba as mi


def in_order(scene: mi.Scene) -> list[mi.Emitter]:
    """Return the emitters as the scene has them, but those on meshes by the ids of these.

    Those of equal ids are in the order of their places.
    """
    emitters = scene.emitters()
    slots = [i for i, emitter in enumerate(emitters) if _is_on_mesh(emitter)]
    on_meshes = [emitters[i] for i in slots]
    ids = [emitter.get_shape().id() for emitter in on_meshes]
    key = _by_id if len(set(ids)) == len(ids) else _by_id_and_place
    for i, emitter in zip(slots, sorted(on_meshes, key=key), strict=True):
        emitters[i] = emitter
    return emitters


def _is_on_mesh(emitter: mi.Emitter) -> bool:
    shape = emitter.get_shape()
    return shape is not None and shape.is_mesh()


def _by_id(emitter: mi.Emitter) -> str:
    return emitter.get_shape().id()


def _by_id_and_place(emitter: mi.Emitter) -> tuple:
    box = emitter.get_shape().bbox()
    return _by_id(emitter), tuple(box.min), tuple(box.max), str(emitter)
