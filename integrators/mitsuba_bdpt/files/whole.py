"""Atomic writes of files, and checks before them."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from ..errors import CommandError

MAGIC = {".exr": b"\x76\x2f\x31\x01", ".png": b"\x89PNG"}
"""The first four bytes of an image's file, by suffix."""


def utf8(path: Path) -> str:
    """Return a path in UTF-8, as Mitsuba and OpenEXR take it; ``CommandError`` for other encodings."""
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise CommandError(
            f"{str(path)!r} is not in UTF-8, the encoding of Mitsuba's paths; rename the file or folder"
        ) from error


def from_utf8(name: str) -> Path:
    """Return the path of a ``name`` that Mitsuba gives, see `utf8`."""
    return Path(os.fsdecode(name.encode("utf-8")))


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def check_format(path: Path, output: Path) -> None:
    """Raise ``CommandError``, naming ``output``, if ``path`` has another format than its suffix."""
    kind = path.suffix.lower()
    if kind not in MAGIC or not path.is_file():  # a pipe must not be read
        return
    with path.open("rb") as file:
        start = file.read(4)
    if start and start != MAGIC[kind]:
        raise CommandError(
            f"output={str(output)!r} would overwrite {str(path)!r}, which exists and is not "
            f"{kind[1:].upper()}. Move it away, or name another output."
        )


def check_own(path: Path, mark: str, remedy: str) -> None:
    """Raise ``CommandError`` with the ``remedy`` if a text file lacks ``mark``."""
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    if text.strip() and mark not in text:
        raise CommandError(f"{str(path)!r} exists and was made by something else; {remedy}")


def check_writable(path: Path) -> None:
    """Raise ``OSError`` if `replacing` could not write a file, ``CommandError`` if it is none."""
    if path.exists() and not path.is_file():
        raise CommandError(f"{str(path)!r} is no file; name another output.")
    try:
        _temporary(path).touch()
    finally:
        with contextlib.suppress(OSError):
            _temporary(path).unlink()


@contextlib.contextmanager
def replacing(path: Path):
    """Yield a temporary path that replaces ``path`` at the end; an exception leaves the old file."""
    temporary = _temporary(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
