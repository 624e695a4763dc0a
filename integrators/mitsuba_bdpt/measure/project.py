"""The folder of a project's measurements.

    PROJECT/scenes/NAME.xml             scenes with a NAME; others are given by their file
    PROJECT/dictionaries/NAME.xml       scenes that were given to a function as dictionaries
    PROJECT/references/                 reference images, made according to references/scenes.toml
    PROJECT/presets/NAME.toml           definitions of sweeps
    PROJECT/results/NAME/               results of sweeps
    PROJECT/renders/                    pictures

All folders are optional.
"""

from __future__ import annotations

import glob
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from ..errors import CommandError, did_you_mean, listed
from ..files.texts import read_toml
from .models import PresetFile, checked
from .scenes import SceneFile

PLAIN = re.compile(r"scene(_v[\d.]+)?", re.IGNORECASE)
"""Stems of scene files that are named by their folders: of exporters, one folder per scene."""


@dataclass(frozen=True)
class Project:
    root: Path

    @property
    def scenes(self) -> Path:
        return self.root / "scenes"

    @property
    def dictionaries(self) -> Path:
        return self.root / "dictionaries"

    @property
    def references(self) -> Path:
        return self.root / "references"

    @property
    def renders(self) -> Path:
        return self.root / "renders"

    def scene_names(self) -> list[str]:
        return sorted(path.stem for path in self.scenes.glob("*.xml"))

    def scene(self, name: str) -> SceneFile:
        """Return a scene by name, or by file relative to here or to the project.

        Raises ``CommandError`` that lists scenes if there is none.
        """
        named = (folder / f"{name}.xml" for folder in (self.scenes, self.dictionaries))
        for file in (Path(name), *named, self.root / name):
            if file.is_file():
                is_plain = PLAIN.fullmatch(file.stem) and file.parent != self.dictionaries
                return SceneFile(file.resolve().parent.name if is_plain else file.stem, file)
        known = self.scene_names()
        text = f"or put it into {str(self.scenes)!r} and give its name"
        if known:
            text = f"or a name; there are {listed(known, 30)}; {did_you_mean(name, known)}".rstrip("; ")
        raise CommandError(
            f"scene={name!r} is neither a scene file nor the name of one in {str(self.scenes)!r}; "
            f"give the path of an XML file, {text}"
        )

    def matching(self, name: str) -> list[SceneFile]:
        """Return the scenes of a pattern like ``rooms/*/scene.xml``, or of a name.

        Sorted. A ``~`` is the home folder. Raises ``CommandError`` if there are none.
        """
        name = str(Path(name).expanduser()) if name.startswith("~") else name
        if not glob.has_magic(name):
            return [self.scene(name)]
        for pattern in (name, str(self.root / name)):
            if found := sorted(glob.glob(pattern, recursive=True)):
                return [self.scene(file) for file in found]
        raise CommandError(
            f"scenes={name!r} matches no file; give the paths of XML files, e.g. 'rooms/*/scene.xml'"
        )

    def command(self, *words: str | Path) -> str:
        there = [] if self.root == Path() else ["--project", str(self.root)]
        return shlex.join(["mitsuba-bdpt", *map(str, words), *there])

    def sweep_command(self, folder: Path) -> str:
        """Return the command line of the sweep that fills a ``folder``."""
        known = (self.root / "presets" / f"{folder.name}.toml").is_file()
        return self.command("sweep", folder.name if known else "PRESET", "-o", folder)

    def depth(self, scene: SceneFile) -> int:
        """Return the ``max_depth`` of a scene by presets/benchmark.toml, else its file's."""
        file = self.root / "presets" / "benchmark.toml"
        data = read_toml(file) if file.is_file() else {}
        return checked(PresetFile, data, file).depth(scene.name, scene.max_depth)

    def preset(self, name: str) -> Path:
        """Return the path of a preset, by file or name; it may not exist."""
        return self._found(name, self.root / "presets" / f"{name}.toml")

    def results(self, name: str) -> Path:
        """Return the results of a sweep, by folder or name; they may not exist."""
        return self._found(name, self.root / "results" / name)

    @staticmethod
    def _found(given: str, named: Path) -> Path:
        return named if named.exists() and not Path(given).exists() else Path(given)
