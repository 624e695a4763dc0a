"""Tests do not see the scenes of those before them."""

import gc

import leftovers
import mitsuba as mi
import pytest
from mitsuba_bdpt.host.jit import registered_emitters

KIND = "TimedSunskyEmitter"


def keep_a_scene():
    """Leave a scene in a cycle: the exception holds this frame, and the frame the exception."""
    scene = mi.load_dict({"type": "scene", "sky": {"type": "timed_sunsky"}})
    with pytest.raises(ValueError, match="x") as kept:
        int("x")
    assert kept.value and len(scene.emitters()) == 1


def test_a_scene_that_an_exception_keeps_is_freed():
    """Rationale: kernels of later tests visited it, and failed when the cycle collector had not run."""
    before = registered_emitters()
    enabled = gc.isenabled()
    gc.disable()
    try:
        keep_a_scene()
        assert registered_emitters().count(KIND) == before.count(KIND) + 1
        leftovers.collect(before)
        assert registered_emitters().count(KIND) == before.count(KIND)
    finally:
        if enabled:
            gc.enable()
