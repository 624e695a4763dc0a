"""Measurements as functions, of scenes as dictionaries or files.

Heavy imports are deferred: the command declares its options where the extra ``[measure]`` or Mitsuba is
missing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import CommandError, FailureError
from . import options as available
from .options import VARIANT

if TYPE_CHECKING:
    import pandas as pd

    from .crops import Shot
    from .project import Project
    from .reference import Reference


class SceneDict:
    """A scene ``dictionary`` for ``mi.load_dict``, and the ``name`` of its references."""

    def __init__(self, name: str, dictionary: Mapping[str, Any]):
        self.name, self.dictionary = name, dictionary


Scene = str | Path | Mapping[str, Any] | SceneDict
"""A scene's file, its name in PROJECT/scenes, or a dictionary."""

Plugin = str | Mapping[str, Any]
"""An integrator's type, or its parameters as a dictionary; ``sampler`` among them is the sensor's."""


def make_reference(scene: Scene, *, project: str | Path = ".", **options) -> Reference:
    """Make the reference of a scene, or refine the stored one.

    ``options``: those of `options.MakeReference`. Returns the reference with its ``image`` and own ``error``.
    """
    from .making import make, requested

    asked = available.MakeReference(**options)
    with _measured([scene], project) as (found, (name,)):
        return make(requested(found, name, asked))[0]


def compare_integrators(
    scenes: Scene | Sequence[Scene], first: Plugin, second: Plugin, *, project: str | Path = ".", **options
) -> str:
    """Compare two integrators: time, error, efficiency of the first over the second.

    ``options``: those of `options.Compare`. Returns a table in Markdown, after a sentence on its ratios.
    """
    from . import compare as module
    from .tables import described

    asked, ways = available.Compare(**options), [_parameters(first), _parameters(second)]
    with _measured(scenes, project) as (found, names):
        return module.text([described(way) for way in ways], module.lines(found, names, ways, asked))


def compare_at_equal_time(
    scene: Scene, integrators: Sequence[Plugin] = (), *, project: str | Path = ".", **options
) -> list[Shot]:
    """Render a scene with several integrators in equal time, and draw the images.

    ``options``: those of `options.EqualTime`; by default `path` (with media `volpath`) and `bdpt`. Returns
    the renders, with their ``image``, ``seconds`` and ``rel_mse``.
    """
    from . import equal_time as module
    from .tables import described

    asked = available.EqualTime(**options)
    ways = {described(way): way for way in map(_parameters, integrators)}
    with _measured([scene], project) as (found, (name,)):
        return module.pictured(found, name, ways, asked)[1]


def render_pyramid(scene: Scene, *, project: str | Path = ".", **options) -> dict[str, dict]:
    """Render and draw an image of each strategy (s, t).

    ``options``: those of `options.Pyramid`. Returns the images by kind, ``weighted`` or ``unweighted``, and
    by (k, s, t).
    """
    from . import pyramid as module

    asked = available.Pyramid(**options)
    with _measured([scene], project) as (found, (name,)):
        return module.pictured(found, name, asked)[1]


def run_sweep(
    preset: str | Path | Mapping[str, Any],
    dictionaries: Sequence[SceneDict] = (),
    *,
    project: str | Path = ".",
    **options,
) -> pd.DataFrame:
    """Render the missing cells of a preset, a TOML file or a dictionary of its keys.

    ``dictionaries``: scenes by name; a preset without ``scenes`` renders all of them. ``options``: those of
    `options.Sweep`. Returns the rows as a pandas frame. Raises ``FailureError`` if a render failed; the
    other rows are kept.
    """
    from . import sweep as module

    asked = available.Sweep(**options)
    with _measured(dictionaries, project) as (found, names):
        named = preset if isinstance(preset, Mapping) else available.text_of_path("preset", preset)
        rows, failed = module.swept(found, named, asked, names)
    if failed:
        raise FailureError(f"preset={str(preset)!r}: {len(failed)} failed: {'; '.join(failed)}")
    return rows


@contextmanager
def _measured(scenes: Scene | Sequence[Scene], root: str | Path) -> Iterator[tuple[Project, list[str]]]:
    """Yield the project, and the names or files of these scenes; sets `VARIANT`."""
    import mitsuba as mi

    from .project import Project

    project, before = Project(Path(available.text_of_path("project", root))), mi.variant()
    mi.set_variant(VARIANT)
    try:
        is_one = isinstance(scenes, str | Path | Mapping | SceneDict)
        yield project, [_file(project, one) for one in ([scenes] if is_one else scenes)]
    finally:
        if before is not None:
            mi.set_variant(before)


def _file(project: Project, scene: Scene) -> str:
    """Return the file or name of a scene; dictionaries are written into files."""
    import mitsuba as mi

    from .scenes import digest

    if isinstance(scene, str | Path):
        return str(scene)
    name, content = (scene.name, scene.dictionary) if isinstance(scene, SceneDict) else ("", scene)
    if not isinstance(content, Mapping) or content.get("type") != "scene":
        raise CommandError(f"scene={scene!r} must be a file, a name or a dictionary of type 'scene'")
    if (project.scenes / f"{name}.xml").exists():
        raise CommandError(f"scene={name!r} is the name of a file in {str(project.scenes)!r}; take another")
    project.dictionaries.mkdir(parents=True, exist_ok=True)
    file = project.dictionaries / f"{name or 'unnamed'}.xml"
    mi.parser.write_file(mi.parser.parse_dict(mi.parser.ParserConfig(VARIANT), dict(content)), str(file))
    return str(file if name else file.replace(file.with_name(f"scene_{digest(file)[:8]}.xml")))


def _parameters(plugin: Plugin) -> dict[str, Any]:
    found = {"type": plugin} if isinstance(plugin, str) else dict(plugin)
    if not isinstance(found.get("type"), str):
        raise CommandError(f"integrator={plugin!r} must be a type or a dictionary with one")
    return found
