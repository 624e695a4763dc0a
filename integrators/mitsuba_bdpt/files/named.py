"""Files that a scene file names: meshes, textures, spectra, other scene files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from .loading import elements


def named_files(
    scene: Path, definitions: Iterable[tuple[str, str]] = (), folders: Iterable[Path] = ()
) -> list[Path]:
    """Return existing files that a scene file, or an included one, names.

    Each once. ``definitions``: parameters within names; ``folders``: additional search folders. Raises
    ``CommandError`` if a scene file is not XML.
    """
    found = {}
    _note_files(scene, dict(definitions), [Path(), *folders], found)
    return list(found)


def _note_files(scene: Path, values: dict, folders: list[Path], found: dict[Path, None]) -> None:
    """Add to ``found``, an ordered set, the files that a scene file names.

    Searches like Mitsuba: beside the scene file, then in ``folders``. The file's defaults are added to
    ``values``.
    """
    folders = [scene.parent, *folders]

    def resolved(name, exists):
        return next((folder / name for folder in folders if exists(folder / name)), None)

    for element in elements(scene):
        own = {key: _substituted(text, values) for key, text in element.attrib.items()}
        if element.tag == "default":
            values.setdefault(own.get("name", ""), own.get("value", ""))
        elif element.tag == "path" and (folder := resolved(own.get("value", ""), Path.is_dir)):
            folders.insert(0, folder)
        name = own.get("value" if own.get("name") == "filename" else "filename")
        path = resolved(name, Path.is_file) if name else None
        if path is None:
            continue
        is_new = path not in found
        found[path] = None
        if element.tag == "include" and is_new:
            _note_files(path, values, folders, found)


def _substituted(text: str, values: dict) -> str:
    """Substitute parameters in ``text``, longest names first (one may be a prefix)."""
    for key in sorted(values, key=len, reverse=True):
        text = text.replace(f"${key}", values[key])
    return text
