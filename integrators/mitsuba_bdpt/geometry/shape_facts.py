"""Facts that follow from the parameters of a scene's shapes, cached until an edit."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import partial
from typing import Any, TypeVar

import mitsuba as mi

from ..host.introspection import all_shapes, named, registry_id
from ..host.notices import State, cached, notes
from .flaws import Flaw
from .hits import HitTables
from .rounding import ShapeErrors
from .to_world import check_inverse

Found = TypeVar("Found")


class ShapeFacts:
    """The `ShapeErrors` (``errors``) and `HitTables` of a scene, and facts about single shapes.

    ``flaws``: names of shapes by their flaw; ``marks``: fingerprints of the shapes by registry index;
    ``before``: facts of an earlier state of the scene, of which those about shapes with equal marks are kept.
    Holds no object of the scene: it may outlive it. Raises ``UsageError`` for shapes for which Mitsuba's own
    calls disagree (`check_inverse`).
    """

    def __init__(
        self, scene: mi.Scene, marks: dict[int, Hashable] | None = None, before: ShapeFacts | None = None
    ):
        self._marks = marks or {}
        self._found: dict[tuple, Any] = {}
        if before is not None:
            same = {None, *(index for index, mark in self._marks.items() if before._marks.get(index) == mark)}
            self._found = {key: found for key, found in before._found.items() if same.issuperset(key[1:])}
        self.flaws: dict[Flaw, list[str]] = {}
        for shape in all_shapes(scene):
            self.about("inverse", partial(check_inverse, shape), shape)
            if flaw := self.about("flaw", partial(Flaw.of, shape), shape):
                self.flaws.setdefault(flaw, []).append(f"shape {named(shape)}")
        self.errors, self.hits = ShapeErrors(scene, self.about), HitTables.of(scene, self.about)

    @classmethod
    def of(cls, scene: mi.Scene, sensor: mi.Sensor) -> ShapeFacts:
        """Cached facts, new after edits; keyed by registry indices: the cache may be another scene's."""
        marks = {registry_id(shape): _mark(shape) for shape in all_shapes(scene)}
        before = next(iter(notes(scene, sensor).get("shapes", {}).values()), None)
        return cached(
            scene, sensor, "shapes", tuple(marks.items()), lambda: cls(scene, marks, before), most=1
        )[0]

    def about(self, kind: str, find: Callable[[], Found], *shapes: mi.Shape | None) -> Found:
        """Cached result of ``find()``, which depends on the own parameters of these ``shapes`` alone."""
        key = kind, *(None if shape is None else registry_id(shape) for shape in shapes)
        if key not in self._found:
            self._found[key] = find()
        return self._found[key]


def _mark(shape: mi.Shape) -> Hashable:
    """Fingerprint of all that facts about a shape depend on."""
    state = State.of([shape], deep=False)
    return state, shape.class_name(), shape.has_flipped_normals(), repr(shape.bbox())
