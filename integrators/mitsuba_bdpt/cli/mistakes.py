"""What a command answers to a user's mistake: one line, and the exit status 2 (as argparse's), no traceback.

Taken for mistakes is what names something that the user gave:

* `errors.UsageError` and `errors.UnsupportedError`: a value, a file or a name that cannot be used; also
  where Mitsuba or Dr.Jit have wrapped them.
* ``argparse.ArgumentTypeError``: words of the command line that are read after the rest of it.
* ``OSError``: a file or a folder that is missing, or cannot be written.
* ``RuntimeError`` of Mitsuba's parser: about a scene's file, an unknown plugin, or its parameters; where it
  holds the traceback of a plugin in Python, only if that ends in one of the first.

All else is a bug, whose traceback must be seen.
"""

from __future__ import annotations

import argparse
import errno
import re
import sys
from collections.abc import Callable
from typing import TypeVar

from ..errors import UnsupportedError, UsageError, behind, message

STATUS = 2
"""The exit status after a mistake."""

INTERRUPTED = 130
"""The exit status of a process that SIGINT has ended."""

Status = TypeVar("Status", int, int | None)

IN_WORDS = re.compile(r"[\w.]*(UsageError|UsageTypeError|UnsupportedError): bdpt: ")


def answered(main: Callable[[], Status]) -> Status | int:
    """The exit status of ``main``; that of a mistake if there was one, which is printed."""
    try:
        return main()
    except Exception as error:
        if behind(error, KeyboardInterrupt) is not None:
            raise KeyboardInterrupt from error
        if not is_mistake(error):
            raise
        print(f"error: {' '.join(in_words(error).split())}", file=sys.stderr)
        return STATUS


REMEDIES = {
    errno.ENOENT: "give the path of one that is there",
    errno.EACCES: "give a path that may be read and written, or change its rights",
    errno.EPERM: "give a path that may be read and written, or change its rights",
    errno.EROFS: "give a path on a disk that can be written",
    errno.EEXIST: "a file stands where a folder is needed: move it away, or give another path",
    errno.ENOTDIR: "a file stands where a folder is needed: move it away, or give another path",
    errno.EISDIR: "a folder stands where a file is needed: give another path",
    errno.ENOSPC: "free some space and run the command again",
    errno.EDQUOT: "free some space and run the command again",
}
"""What to do about errors of the system."""


def in_words(error: Exception) -> str:
    """What went wrong; of what the system could not do, with which file, and what to do about it."""
    if not isinstance(error, OSError) or error.strerror is None or error.filename is None:
        return message(error)
    remedy = REMEDIES.get(error.errno or 0)
    return f"{str(error.filename)!r}: {error.strerror}" + (f"; {remedy}" if remedy else "")


def is_mistake(error: Exception) -> bool:
    """Whether the user is to mend it, see above."""
    if isinstance(error, OSError | argparse.ArgumentTypeError):
        return True
    if behind(error, UsageError, UnsupportedError) is not None:
        return True
    if not isinstance(error, RuntimeError) or not str(error).startswith("[parser.cpp"):
        return False
    _, traceback, rest = str(error).partition("Traceback (most recent call last):")
    return not traceback or bool(IN_WORDS.match(rest.strip().splitlines()[-1]))
