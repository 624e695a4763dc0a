"""Facts that follow from the parameters of a scene's shapes, cached until an edit."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

import mitsuba as mi

from ..host.introspection import all_shapes, registry_index
from ..host.notices import State, cached
from .hits import HitTables
from .rounding import ShapeErrors
from .to_world import check_inverse

Found = TypeVar("Found")


class ShapeFacts:
    """The `ShapeErrors` (``errors``) and `HitTables` of a scene, and facts about single shapes.

    Holds no object of Mitsuba: it may outlive the scene. Raises ``UsageError`` for shapes for which Mitsuba's
    own calls disagree (`check_inverse`).
    """

    def __init__(self, scene: mi.Scene):
        for shape in all_shapes(scene):
            check_inverse(shape)
        self.errors, self.hits = ShapeErrors(scene), HitTables.of(scene)
        self._found: dict[tuple, tuple[Hashable, object]] = {}

    @classmethod
    def of(cls, scene: mi.Scene, sensor: mi.Sensor) -> ShapeFacts:
        """Return the cached facts, or new ones if a parameter of a shape was edited.

        The key has everything that facts depend on, including the shapes' registry indices by which they are
        looked up: the cache may belong to another scene, see `notices.notes`.
        """
        shapes = all_shapes(scene)
        own = [(registry_index(s), s.class_name(), s.has_flipped_normals(), repr(s.bbox())) for s in shapes]
        key = State.of(shapes, deep=False), tuple(own)
        return cached(scene, sensor, "shapes", key, lambda: cls(scene), most=1)[0]

    def about(
        self, kind: str, find: Callable[[], Found], *shapes: mi.Shape | None, state: Hashable = None
    ) -> Found:
        """Return the cached result of ``find()`` for a ``kind`` of fact and its ``shapes``.

        It must depend on the own parameters of these and on ``state`` alone, of which the latest is cached;
        errors are not.
        """
        key = kind, *(None if shape is None else registry_index(shape) for shape in shapes)
        known = self._found.get(key)
        if known is None or known[0] != state:
            known = self._found[key] = state, find()
        return known[1]  # type: ignore[return-value]
