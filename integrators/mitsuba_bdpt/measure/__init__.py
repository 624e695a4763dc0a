"""Measuring: errors, bias and speed of renders, references, sweeps and what they show.

Each command that measures is a function here, of the same options under the same names, which takes a scene
as a dictionary (that of ``mi.load_dict``) where the command takes a file::

    from mitsuba_bdpt import measure

    scene = mi.cornell_box()
    print(measure.compare_integrators(scene, "bdpt", "path", spp=16, resolution=64))
    reference = measure.make_reference(scene, resolution=64, seconds=60)  # .image, .error
    ways = ["path", {"type": "bdpt", "skip": "none"}]
    for shot in measure.compare_at_equal_time(scene, ways, resolution=64):
        print(shot.caption)

References, pictures and rows lie in the folder ``project``, by the scene's name. A dictionary is written into
a scene file there, named by its content unless it is given as ``measure.SceneDict(name, dictionary)``.

Needs the extra ``[measure]``. Within the package nothing but the commands import it (see `cli.measuring`).

* For Python: `api`; options, their defaults and bounds: `options`.
* Scenes: `project` (the user's folder), `scenes` (any scene file, at any size).
* Renders: `timing` (a render, and several sides in turns).
* Errors: `metrics` (of an image), `agreement` (bias), `reference` (stored references), `making` (how they are
  made).
* Sweeps: `models` (contents of TOML files), `preset` (which renders), `limited` (which fit into a time),
  `sweep`, `results` (their files and tables).
* Reports: `analysis` (figures, or why there are none), `tables`, `figures` (plots), `crops` (images side by
  side), `paper` (widths and formats for print), `report` (Markdown), `page` (HTML).
* A few integrators in one scene: `compare`, `equal_time`; the strategies of one: `pyramid`.
* Progress and time left: `showing`.
"""

from .api import (
    SceneDict,
    compare_at_equal_time,
    compare_integrators,
    make_reference,
    render_pyramid,
    run_sweep,
)

__all__ = [
    "SceneDict",
    "compare_at_equal_time",
    "compare_integrators",
    "make_reference",
    "render_pyramid",
    "run_sweep",
]
