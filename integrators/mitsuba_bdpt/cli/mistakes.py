"""Exit statuses of a command: errors, in one line on standard error, and signals that end it.

Usage errors, `USAGE`, concern the user's input; the same command would fail again:

* `errors.UsageError` and `errors.UnsupportedError`: an invalid value, file or name, also if wrapped by
  Mitsuba or Dr.Jit.
* ``argparse.ArgumentTypeError``: words of the command line that are parsed later.
* ``OSError`` about a path that is missing or cannot be written (`PATHS`).
* ``RuntimeError`` of Mitsuba's (`_is_mitsubas`): about a scene file, an unknown plugin or its parameters, or
  of a plugin while rendering, such as a texture without spectra; not of `INNER` classes.

Failures, `FAILURE`, may be transient: `errors.FailureError`, other ``OSError``, ``MemoryError`` and Dr.Jit's
``RuntimeError`` about memory.

All else is a bug: its traceback is printed, with Python's exit status.
"""

from __future__ import annotations

import argparse
import errno
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from ..errors import FailureError, UnsupportedError, UsageError, behind, chain, message
from ..host import signals

FAILURE = 1  # the exit status after a failure
USAGE = 2  # the exit status after a usage error, as argparse's

INTERRUPTED = signals.STATUSES[signal.SIGINT]
TERMINATED = signals.STATUSES[signal.SIGTERM]

STATUSES = (
    f"Exit status: 0 done; {FAILURE} failed, which may not happen again (a full disk, a lost cluster, "
    f"memory that runs out during the render); {USAGE} usage error in the command line or the scene, a film "
    f"that needs more memory than there is among them, which would happen again; "
    f"{INTERRUPTED} ended by SIGINT (Ctrl-C), {TERMINATED} by SIGTERM."
)
"""What ``--help`` says of them."""

IN_WORDS = re.compile(r"[\w.]*(UsageError|UsageTypeError|UnsupportedError): bdpt: ")


def answered(main: Callable[[], int | None], interrupted: str = "interrupted") -> int | None:
    """Return the exit status of ``main``; prints its error, if any, or ``interrupted``."""
    try:
        return main()
    except (Exception, KeyboardInterrupt) as error:
        if behind(error, KeyboardInterrupt) is not None:
            print(interrupted, file=sys.stderr)
            return INTERRUPTED
        status = status_of(error)
        if status is None:
            raise
        print(f"error: {' '.join(in_words(error).split())}", file=sys.stderr)
        return status


PATHS = frozenset(
    (errno.ENOENT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EEXIST, errno.ENOTDIR, errno.EISDIR)
    + (errno.ENAMETOOLONG, errno.ELOOP)
)
"""Errors of the system about a path that the user gave."""

OUT_OF_MEMORY = re.compile(r"out[ _]of[ _]memory|failed to allocate", re.IGNORECASE)
"""What a ``RuntimeError`` of Dr.Jit says of memory that it cannot allocate."""

INNER = re.compile(r"\[\w*(Film|Block|Bitmap|Scene|Integrator|Sampler|Struct|Stream|Pool|Thread|Parser)\]")
"""What errors of classes that `bdpt` calls with data of its own begin with: they may be bugs."""


def in_words(error: BaseException) -> str:
    """Describe the error; for system errors, with the file."""
    if (lacking := _of_memory(error)) is not None:
        why = message(lacking) or "no more was given"
        return f"not enough memory ({why}); render a smaller --size, or parts of the image by --crop"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{str(error.filename)!r}: {error.strerror}"
    return message(next(filter(_is_mitsubas, chain(error)), error))


def _of_memory(error: BaseException) -> BaseException | None:
    of_drjit = (e for e in chain(error) if isinstance(e, RuntimeError) and OUT_OF_MEMORY.search(str(e)))
    return behind(error, MemoryError) or next(of_drjit, None)


def _is_mitsubas(error: BaseException) -> bool:
    """Return whether an error is one of Mitsuba's, ``[parser.cpp:9] …`` or ``[BitmapTexture] …``.

    Without `INNER` classes; with the traceback of a Python plugin, only if that ends in a usage error.
    """
    before, traceback, rest = str(error).partition("Traceback (most recent call last):")
    of_user = not traceback or IN_WORDS.match(rest.strip().splitlines()[-1])
    of_scene = before.startswith("[") and not INNER.match(before)
    return isinstance(error, RuntimeError) and of_scene and bool(of_user)


def status_of(error: BaseException) -> int | None:
    """Return the exit status after an ``error``, see above; None for a bug."""
    if isinstance(error, OSError):
        return USAGE if error.errno in PATHS else FAILURE
    if behind(error, UsageError, UnsupportedError, argparse.ArgumentTypeError):
        return USAGE
    if any(map(_is_mitsubas, chain(error))):
        return USAGE
    return FAILURE if isinstance(error, FailureError) or _of_memory(error) else None


@dataclass
class Ending:
    """State of a command that a signal ends.

    ``status``: its exit status; ``patient``: whether the next signal is only recorded, while results are
    written; ``signalled``: whether one has come.
    """

    status: int = INTERRUPTED
    patient: bool = False
    signalled: bool = False

    def __call__(self, number: int, frame: object) -> None:
        """Handle a signal: the first raises ``KeyboardInterrupt``; later ones are ignored."""
        if self.signalled:
            return
        self.signalled, self.status = True, signals.STATUSES[signal.Signals(number)]
        if not self.patient:
            raise KeyboardInterrupt


@contextmanager
def terminable() -> Iterator[Ending]:
    """Within, `Ending` handles SIGINT and SIGTERM.

    Leaves signals unchanged outside of the main thread.
    """
    ending = Ending()
    if threading.current_thread() is not threading.main_thread():
        yield ending
        return
    before = {number: signal.signal(number, ending) for number in signals.STATUSES}
    try:
        yield ending
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
