"""What a script answers to a user's mistake: one line, and the exit status 2 (as argparse's), no traceback.

Taken for mistakes is what names something that the user gave:

* ``argparse.ArgumentTypeError``: words of the command line that are read after the rest of it.
* ``OSError``: a file or a folder that is missing, or cannot be written.
* ``ValueError``, ``TypeError`` and ``NotImplementedError``, but only if a ``raise`` of this project raised
  them: its checks say in words what is wrong with which name, path or parameter. The same types out of NumPy,
  or out of an expression of a script, are bugs.
* ``RuntimeError`` of Mitsuba's parser: about a scene's file, an unknown plugin, or its parameters; where it
  holds the traceback of a plugin in Python, only if ``bdpt`` refused a parameter in words.

All else is a bug, whose traceback must be seen.
"""

from __future__ import annotations

import argparse
import re
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import mitsuba_bdpt
from mitsuba_bdpt.errors import message
from mitsuba_bdpt.files.images import prepare_output
from mitsuba_bdpt.files.whole import check_format, check_writable

STATUS = 2
SOURCES = Path(mitsuba_bdpt.__file__).resolve().parent, Path.cwd() / "scripts"

IN_WORDS = re.compile(r"[\w.]*(UsageError|UsageTypeError|UnsupportedError): bdpt: ")


def answered(main: Callable[[], int | None]) -> int | None:
    """The exit status of ``main``; that of a mistake if there was one, which is printed."""
    try:
        return main()
    except Exception as error:
        if not is_mistake(error):
            raise
        print(f"error: {' '.join(message(error).split())}", file=sys.stderr)
        return STATUS


def is_mistake(error: Exception) -> bool:
    """Whether the user is to mend it, see above."""
    if isinstance(error, OSError | argparse.ArgumentTypeError):
        return True
    if isinstance(error, NotImplementedError | ValueError | TypeError):  # the first is a RuntimeError too
        return _is_raised_here(error)
    if not isinstance(error, RuntimeError) or not str(error).startswith("[parser.cpp"):
        return False
    _, traceback_, rest = str(error).partition("Traceback (most recent call last):")
    return not traceback_ or bool(IN_WORDS.match(rest.strip().splitlines()[-1]))


def _is_raised_here(error: Exception) -> bool:
    last = traceback.extract_tb(error.__traceback__)[-1]
    source = Path(last.filename).resolve()
    return any(source.is_relative_to(folder) for folder in SOURCES) and last.line.startswith("raise")


def check_output(path: Path, suffix: str) -> None:
    """Refuse, before anything is rendered, an output of another ``suffix``, one that cannot be written, and
    one that would overwrite an image of another format; its folder is made. With an EXR goes a PNG of its
    name, as from the command ``render``."""
    if suffix == ".exr":
        prepare_output(path)
        return
    if path.suffix.lower() != suffix:
        raise ValueError(f"output={str(path)!r} must end in {suffix}")
    check_format(path, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    check_writable(path)
