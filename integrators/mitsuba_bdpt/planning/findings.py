"""What earlier renders of a scene have found, as long as nothing was edited."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

import mitsuba as mi

from ..host.edits import State
from ..host.notices import remembered
from ..scene.prepared import PreparedScene

Found = TypeVar("Found")


class Findings:
    """What is known of the scene that one render traces, by the kind of finding and a key.

    The parameters of scene and sensor are read once (up to 8 ms), and again after `expire`."""

    def __init__(self, prepared: PreparedScene, sensor: mi.Sensor):
        self._prepared, self._sensor = prepared, sensor
        self._state: tuple[State, int] | None = None

    def find(self, kind: str, key: Hashable, look: Callable[[], Found]) -> tuple[Found, bool]:
        """What ``look()`` finds, and whether an earlier render has found it for this ``key``."""
        return remembered(self._prepared.scene, self._sensor, kind, (self._scene_state(), key), look)

    def expire(self):
        """Look at the parameters again: somebody may have edited them."""
        self._state = None

    def _scene_state(self) -> tuple[State, int]:
        """What tells scene and sensor from themselves after an edit."""
        if self._state is None:
            state = State.of([self._prepared.scene, self._sensor])
            self._state = state, self._prepared.camera.region.border
        return self._state
