"""Launches as Dr.Jit has recorded them (``dr.freeze``), which later renders of an unchanged scene replay.

A replay repeats the recorded kernels with the data that its arrays have now; its key is all else that
recording reads. Dr.Jit raises an error for arrays that it does not reach from the arguments (phase functions
``hg`` have one): such launches are recorded anew by each render.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import behind

# Has the ``launch`` to record. No PyTree: Dr.Jit compares it by its identity.
_current = threading.local()


def _launch(scene, sensor, arrays):
    return _current.launch()


class Kept:
    """A launch, recorded by its first `run`."""

    def __init__(self):
        self._frozen, self._refused = dr.freeze(_launch, limit=1), False

    def run(self, launch: Callable[[], Any], film, scene: mi.Scene, sensor: mi.Sensor, held) -> Any:
        """Return ``launch()``, the first to add to ``film``; ``held``: objects with the arrays it uses."""
        if not self._refused:
            arrays: list = []
            _collect((film, held), arrays, {})
            _current.launch = launch
            try:
                return self._frozen(scene, sensor, arrays)
            except RuntimeError as error:
                if behind(error, KeyboardInterrupt):
                    raise
                self._refused = True
                film.clear()
            finally:
                del _current.launch
        return launch()


def _collect(x: Any, arrays: list, seen: dict):
    """Append the Dr.Jit arrays that ``x`` holds to ``arrays``, without empty ones, which end the process."""
    if dr.is_array_v(x):
        indices = dr.detail.collect_indices(x)
        arrays += [x] if indices and all(indices) else []
    elif id(x) not in seen and not isinstance(x, mi.Object):
        seen[id(x)] = x
        values = x.values() if isinstance(x, dict) else x if isinstance(x, (list, tuple)) else ()
        for value in (*values, *getattr(x, "__dict__", {}).values()):
            _collect(value, arrays, seen)
