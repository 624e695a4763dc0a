"""Files that are whole or not there."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def check_writable(path: Path) -> None:
    """Raise ``OSError`` now if `replacing` could not write `path` later, ``ValueError`` if it is something
    else than a file."""
    if path.exists() and not path.is_file():
        raise ValueError(f"{str(path)!r} is no file; name another output.")
    try:
        _temporary(path).touch()
    finally:
        with contextlib.suppress(OSError):
            _temporary(path).unlink()


@contextlib.contextmanager
def replacing(path: Path):
    """Name of a file beside `path` that takes its place at the end: whoever looks at `path` never sees half a
    file, and an error leaves what was there."""
    temporary = _temporary(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
