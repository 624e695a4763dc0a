"""TOML that is read, JSON and text that are written whole."""

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
