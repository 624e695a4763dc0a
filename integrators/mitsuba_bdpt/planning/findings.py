"""What earlier renders of a scene have found, as long as nothing was edited."""

from __future__ import annotations

from ..host.edits import State
from ..host.notices import remembered


class Findings:
    """What is known of the scene that one render traces, by the kind of finding and a key.

    The parameters of scene and sensor are read once (up to 8 ms), and again after `expire`."""

    def __init__(self, prepared, sensor):
        self._prepared, self._sensor, self._state = prepared, sensor, None

    def find(self, kind: str, key, look):
        """What ``look()`` finds, and whether an earlier render has found it for this ``key``."""
        key = self._scene_state(), key
        return remembered(self._prepared.scene, self._sensor, kind, key, look)

    def expire(self):
        """Look at the parameters again: somebody may have edited them."""
        self._state = None

    def _scene_state(self) -> tuple:
        """What tells scene and sensor from themselves after an edit."""
        if self._state is None:
            state = State.of([self._prepared.scene, self._sensor])
            self._state = state, self._prepared.camera.region.border
        return self._state
