"""This repository as a project to measure in, and its scenes as the benchmark renders them.

Puts the folders tests and tests/support on the path, for `stress_cases`, `instruments` and `scenes`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mitsuba_bdpt.files.texts import read_toml
from mitsuba_bdpt.measure import reference
from mitsuba_bdpt.measure.options import RESOLUTION  # noqa: F401 (for the scripts)
from mitsuba_bdpt.measure.project import Project

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "support")]

PROJECT = Project(ROOT)
SCENES = PROJECT.scenes


def scene_file(name: str) -> Path:
    """The XML file of a scene; raises ``ValueError`` if there is none."""
    return PROJECT.scene(name).file


def load_scene(name: str, **size):
    """A scene, see `SceneFile.load`."""
    return PROJECT.scene(name).load(**size)


def benchmark_depth(name: str) -> int:
    """The ``max_depth`` at which the benchmark renders a scene."""
    return PROJECT.depth(PROJECT.scene(name))


def load_reference(name: str, resolution: int, max_depth: int) -> reference.Reference:
    """The stored reference of a scene."""
    return reference.load_reference(PROJECT, PROJECT.scene(name), resolution, max_depth)


def benchmark_scenes() -> list[str]:
    """The scenes of the benchmark, by name."""
    return read_toml(PROJECT.preset("benchmark"))["scenes"]
