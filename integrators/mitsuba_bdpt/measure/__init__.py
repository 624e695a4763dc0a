"""Measuring: errors, bias and speed of renders, references, and sweeps.

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

Needs the extra ``[measure]``. Within the package only the commands import it (see `cli.measuring`).

* A user's folder is a `project`, its files `scenes`; `api` and `options` are for Python and the command.
* Renders are timed by `timing`; `metrics` are errors of an image, `agreement` is bias, `making` makes each
  `reference`.
* A sweep's TOML file is checked by `models`, `preset` lists its renders, `sweep` orders and renders them,
  `results` are its files.
* `analysis` of the rows is shown by `report`, `figures`, `crops` and `page`, with `tables` and `paper`.
* A few integrators in one scene: `compare`, `equal_time`; the strategies of one: `pyramid`.
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
