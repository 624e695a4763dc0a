"""TOML that is read and checked, JSON and text that are written whole."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from ..errors import CommandError
from .whole import replacing


def read_toml(path: Path) -> dict:
    """A TOML file; raises ``CommandError`` naming it if it is none, ``OSError`` if it is not there."""
    try:
        return tomllib.loads(path.read_text())
    except ValueError as error:  # of TOML, or of text that is not UTF-8
        raise CommandError(f"{path} is not TOML: {error}") from error


def read_json(path: Path, remedy: str):
    """What a JSON file holds; raises ``CommandError`` with the ``remedy`` if it is damaged."""
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise CommandError(f"{str(path)!r} is damaged ({error}); {remedy}") from error


def table_of(path: Path, key: str, value) -> dict:
    """The ``value`` of a ``key`` in a TOML file, which has to be a table; raises ``CommandError``."""
    if not isinstance(value, dict):
        raise CommandError(f"{path}: {key}={value!r} must be a table: write [{key}] and its keys below")
    return value


def list_of(path: Path, key: str, value, kind: type, what: str) -> list:
    """As `table_of`: a list of values of a ``kind``, called ``what``, at least one."""
    if not isinstance(value, list) or not value or not all(isinstance(entry, kind) for entry in value):
        raise CommandError(f"{path}: {key}={value!r} must be a list with at least one entry, all {what}")
    return value


def text_of(path: Path, key: str, value) -> str:
    """As `table_of`: a text that is not empty."""
    if not isinstance(value, str) or not value:
        raise CommandError(f"{path}: {key}={value!r} must be a text in quotes that is not empty")
    return value


def whole_of(path: Path, key: str, value) -> int:
    """As `table_of`: a whole number of at least 1."""
    if type(value) is not int or value < 1:
        raise CommandError(f"{path}: {key}={value!r} must be a whole number of at least 1")
    return value


def write_text(path: Path, text: str) -> None:
    """Write by `replacing`; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(text)


def write_json(path: Path, value) -> None:
    """Write by `replacing`; the folder is made. Lists of numbers take a line."""
    text = json.dumps(value, indent=1)
    text = re.sub(r'\[\n[^][{}"]*\]', lambda found: re.sub(r"\n\s*", " ", found[0]), text)
    write_text(path, text + "\n")
