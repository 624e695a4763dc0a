"""Cache of results of earlier renders of a scene."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

import mitsuba as mi

from ..host.notices import State, cached
from ..scene.prepared import PreparedScene

Found = TypeVar("Found")


class SceneCache:
    """Cached results for the scene of one render, by kind and key, valid until it is edited.

    Reads the parameters of scene and sensor once (up to 8 ms), and again after `expire`.
    """

    def __init__(self, prepared: PreparedScene, sensor: mi.Sensor):
        self._prepared, self._sensor = prepared, sensor
        self._state: tuple[State, int] | None = None

    def find(self, kind: str, key: Hashable, look: Callable[[], Found]) -> tuple[Found, bool]:
        """Return the result of ``look()``, and whether it was cached for ``key``."""
        if self._state is None:  # detects edits
            self._state = State.of([self._prepared.scene, self._sensor]), self._prepared.camera.region.border
        key = self._state, key
        return cached(self._prepared.scene, self._sensor, kind, key, look)

    def expire(self):
        """Read the parameters again before the next lookup: they may have been edited."""
        self._state = None
