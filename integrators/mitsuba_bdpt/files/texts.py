"""Reads and checks TOML; writes JSON and text atomically."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from ..errors import CommandError
from .whole import replacing


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raises ``CommandError`` naming it if invalid, or ``OSError``."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # invalid TOML, or not UTF-8
        raise CommandError(f"{path} is not TOML: {error}") from error


def read_json(path: Path, remedy: str) -> Any:
    """Read a JSON file; raises ``CommandError`` with the ``remedy`` if it is damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise CommandError(f"{str(path)!r} is damaged ({error}); {remedy}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text by `replacing`; creates the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: Path, value: Any) -> None:
    """Write JSON by `replacing`, lists of numbers on one line; creates the folder."""
    text = json.dumps(value, indent=1)
    text = re.sub(r'\[\n[^][{}"]*\]', lambda found: re.sub(r"\n\s*", " ", found[0]), text)
    write_text(path, text + "\n")
