"""The folder in which one measures.

    PROJECT/scenes/NAME.xml             scenes that have a NAME; others are called by their file
    PROJECT/references/                 reference images; references/scenes.toml says how they are made
    PROJECT/presets/NAME.toml           what sweeps render
    PROJECT/results/NAME/               what they leave
    PROJECT/renders/                    pictures, and sums from which a reference can be improved

None of these folders has to be there.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import CommandError, did_you_mean
from ..files.texts import read_toml, table_of, whole_of
from .scenes import DictionaryScene, MeasuredScene, SceneFile

LISTED = 30
"""Names of scenes that a message lists, at most."""


@dataclass(frozen=True)
class Project:
    """The folder ``root``, see above."""

    root: Path
    given: Mapping[str, DictionaryScene] = field(default_factory=dict, compare=False)
    """Scenes that are given as dictionaries, by their names."""

    @property
    def scenes(self) -> Path:
        """The folder of scenes that have names."""
        return self.root / "scenes"

    @property
    def references(self) -> Path:
        """The folder of reference images."""
        return self.root / "references"

    @property
    def renders(self) -> Path:
        """The folder of pictures and of what is only kept to go on with."""
        return self.root / "renders"

    def scene_names(self) -> list[str]:
        """The scenes that can be called by name."""
        return sorted(path.stem for path in self.scenes.glob("*.xml"))

    def scene(self, name: str) -> MeasuredScene:
        """A scene by its name, or by its file, seen from here or from the project's folder.

        Raises ``CommandError`` that says what there is if there is none.
        """
        if name in self.given:
            return self.given[name]
        for file in (Path(name), self.scenes / f"{name}.xml", self.root / name):
            if file.is_file():
                return SceneFile(file.stem, file)
        raise CommandError(
            f"scene={name!r} is neither a scene file nor the name of one in {str(self.scenes)!r}; "
            f"give the path of an XML file{self._names_for(name)}"
        )

    def called(self, scene: MeasuredScene) -> str:
        """What `scene` finds a scene by."""
        named = self.scenes / f"{scene.name}.xml"
        return str(scene.file) if isinstance(scene, SceneFile) and scene.file != named else scene.name

    def command(self, *words: str | Path) -> str:
        """A command line of this project, as a message quotes it for a shell."""
        there = [] if self.root == Path() else ["--project", str(self.root)]
        return shlex.join(["mitsuba-bdpt", *map(str, words), *there])

    def sweep_command(self, folder: Path) -> str:
        """That of the sweep that fills a ``folder``: of the preset of its name, if there is one."""
        known = (self.root / "presets" / f"{folder.name}.toml").is_file()
        return self.command("sweep", folder.name if known else "PRESET", "-o", folder)

    def _names_for(self, name: str) -> str:
        """The end of a message about a ``name`` that is unknown."""
        known = self.scene_names()
        if not known:
            return f", or put it into {str(self.scenes)!r} and give its name"
        more = f" and {len(known) - LISTED} more" if len(known) > LISTED else ""
        text = f", or a name; there are {', '.join(known[:LISTED])}{more}; {did_you_mean(name, known)}"
        return text.rstrip("; ")

    def depth(self, scene: MeasuredScene) -> int:
        """The ``max_depth`` at which a scene is rendered unless said.

        That of presets/benchmark.toml if there is one, else that of the scene's file.
        """
        benchmark = self.root / "presets" / "benchmark.toml"
        return depth_in(benchmark, read_toml(benchmark) if benchmark.is_file() else {}, scene)

    def preset(self, name: str) -> Path:
        """A preset by its file or by its name in presets/; the file may not be there."""
        return self._found(Path(name), self.root / "presets" / f"{name}.toml")

    def results(self, name: str) -> Path:
        """What a sweep has left, by its folder or by its name in results/; it may not be there."""
        return self._found(Path(name), self.root / "results" / name)

    @staticmethod
    def _found(given: Path, named: Path) -> Path:
        return named if named.exists() and not given.exists() else given


def depth_in(file: Path, preset: dict, scene: MeasuredScene) -> int:
    """The ``max_depth`` at which a preset, as read from a TOML ``file``, renders a scene.

    Its own, else that of all scenes, else that of the scene's file. Raises ``CommandError`` for what is no
    such number.
    """
    own = table_of(file, "scene", preset.get("scene", {})).get(scene.name, {})
    merged = preset | table_of(file, f"scene.{scene.name}", own)
    return whole_of(file, "max_depth", merged["max_depth"]) if "max_depth" in merged else scene.max_depth
