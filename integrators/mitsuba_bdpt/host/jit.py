"""Guards of Dr.Jit while kernels are recorded."""

from __future__ import annotations

import contextlib
import gc

import drjit as dr
import mitsuba as mi
import numpy as np

from .introspection import own_parameters

# Numbers in a row without an emitter after which no more are expected; those of freed ones are used again.
_GAP = 64


def float64(x) -> np.ndarray:
    """The numbers of an array of Dr.Jit in double precision, those of lanes that are masked out included.

    These hold whatever lay in memory: where it is a signalling NaN, NumPy's cast reports an invalid value.
    """
    with np.errstate(invalid="ignore"):
        return np.array(x, dtype=np.float64)


def registered_emitters() -> list[str]:
    """Class names of all emitters in the process: a virtual call visits those of other scenes too."""
    found, index, missing = [], 0, 0
    while missing < _GAP:
        index += 1
        emitter = _emitter(index)
        missing = missing + 1 if emitter is None else 0
        found += [emitter.class_name()] if emitter is not None else []
    return found


def _emitter(index: int):
    """The emitter that Dr.Jit gave this number to, or None."""
    try:
        return dr.reinterpret_array(mi.EmitterPtr, mi.UInt32(index))[0]
    except RuntimeError:  # never given, or freed
        return None


@contextlib.contextmanager
def evaluated_mode(on=True):
    """Run loops, calls and branches of kernels one after the other, without recording them as a whole.

    Calls of `timed_sunsky` need this.
    """
    flags = (dr.JitFlag.SymbolicCalls, dr.JitFlag.SymbolicLoops, dr.JitFlag.SymbolicConditionals)
    with contextlib.ExitStack() as stack:
        for flag in flags if on else ():
            stack.enter_context(dr.scoped_set_flag(flag, False))
        yield


@contextlib.contextmanager
def gc_paused():
    """Pause Python's cycle collector.

    A scene that only the collector would free, and that is freed while a kernel is being recorded, leaves
    calls of its objects in the kernel beside those of the others, and Dr.Jit aborts the process ("invalid
    redefinition of function").
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def make_parameters_opaque(owners):
    """Move the numbers of ``owners`` that a kernel would hold as constants into memory.

    Calls of objects of one class then differ in data alone and are compiled once, not once per object. What
    is differentiated stays.
    """
    values = (value for owner in owners for value in own_parameters(owner).values())
    dr.make_opaque([value for value in values if not dr.grad_enabled(value)])
