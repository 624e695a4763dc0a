"""Helpers for recording Dr.Jit kernels."""

from __future__ import annotations

import contextlib
import gc
import threading

import drjit as dr
import mitsuba as mi

from .introspection import own_parameters

_GAP = 64  # consecutive unused registry indices that end the search; indices of freed emitters are reused

# Numbers of threads before each of the calls that are within `two_threads`.
_before, _lock = [], threading.Lock()


def registered_emitters() -> list[str]:
    """Class names of all emitters in the process; virtual calls visit all of them."""
    found, index, missing = [], 0, 0
    while missing < _GAP:
        index, missing = index + 1, missing + 1
        with contextlib.suppress(RuntimeError, AttributeError):  # never given, or freed
            found.append(dr.reinterpret_array(mi.EmitterPtr, mi.UInt32(index))[0].class_name())
            missing = 0
    return found


def ensure_two_threads() -> int:
    """Give Dr.Jit two threads at least, else Mitsuba's EXR files hang; returns the number before."""
    before = dr.thread_count()
    if before < 2:
        dr.set_thread_count(2)
    return before


@contextlib.contextmanager
def two_threads():
    """Within, Dr.Jit has at least two threads, until the last caller leaves."""
    with _lock:
        _before.append(ensure_two_threads())
    try:
        yield
    finally:
        with _lock:
            before = _before.pop()
            if before < 2 and not _before:
                dr.set_thread_count(before)


@contextlib.contextmanager
def evaluated_mode(on=True):
    """Evaluate loops, calls and branches instead of recording (for `timed_sunsky`)."""
    flags = (dr.JitFlag.SymbolicCalls, dr.JitFlag.SymbolicLoops, dr.JitFlag.SymbolicConditionals)
    with contextlib.ExitStack() as stack:
        for flag in flags if on else ():
            stack.enter_context(dr.scoped_set_flag(flag, False))
        yield


@contextlib.contextmanager
def gc_paused():
    """Pause Python's cycle collector: if it frees a scene while a kernel is recorded, Dr.Jit aborts."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def make_parameters_opaque(owners):
    """Make parameters opaque, but differentiated ones: calls then differ in data, and compile once."""
    values = (value for owner in owners for value in own_parameters(owner).values())
    dr.make_opaque([value for value in values if not dr.grad_enabled(value)])
