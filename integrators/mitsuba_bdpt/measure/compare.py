"""Compares two integrators in alternating renders: seconds, errors, efficiency.

Medians over pairs of renders with different seeds, after a warm-up that compiles. Errors are relMSE, less the
reference's own (`estimates.seed_errors`); ≥, ≤ and ~ mark bounds, where the reference is too noisy. The last
column is the share of the reference's own error in the trimmed measured one (the larger of both sides).
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import mitsuba as mi
import pandas as pd

from ..errors import CommandError
from .estimates import KINDS, bound_of_ratio, seed_errors
from .making import Job, fitted, obtained
from .options import VARIANT, Compare
from .project import Project
from .reference import Reference
from .results import rel_mse_columns
from .scenes import check_plugins, integrator_of, samples_taken
from .showing import steps
from .tables import described, markdown
from .timing import Render, alternating, timed


def measured(
    sides: Sequence[Render],
    target: Reference,
    rounds: int,
    on_render: Callable[[int], object] = lambda seed: None,
) -> list[pd.DataFrame]:
    """Render as `timing.alternating`; returns the rows of each side, one per round."""
    found: list[list[dict[str, float]]] = [[] for _ in sides]
    for turn in alternating(sides, rounds, on_render):
        for rows, one in zip(found, turn, strict=True):
            times = {"seconds": one.seconds, "cpu_seconds": one.cpu_seconds}
            rows.append(times | rel_mse_columns(one.image, target))
    return [pd.DataFrame(rows) for rows in found]


def line(first: pd.DataFrame, second: pd.DataFrame) -> dict[str, str]:
    """Return the ratios of a scene, or that all errors are 0."""
    if not (first["rel_mse_trimmed"].all() and second["rel_mse_trimmed"].all()):
        return {"time": "every value (trimmed) is exactly that of the reference"}
    time = first["seconds"] / second["seconds"]
    cells = {"time": f"{time.median():.3g}"}
    for kind, name in KINDS.items():
        (ours, over), (theirs, under) = (seed_errors(rows, kind, differs=False) for rows in (first, second))
        error = ours / theirs
        low, middle, high = (1 / (time * error)).quantile([0.25, 0.5, 0.75])
        cells[f"{name} error"] = f"{bound_of_ratio(over, under)} {error.median():.3g}".lstrip()
        figure = f"{middle:.3g} ({low:.3g}–{high:.3g})"
        cells[f"{name} efficiency (quartiles)"] = f"{bound_of_ratio(under, over)} {figure}".lstrip()
    own = [(rows["reference_rel_mse_trimmed"] / rows["rel_mse_trimmed"]).median() for rows in (first, second)]
    return cells | {"reference": f"{100 * max(own):.1f} %"}


def lines(
    project: Project, names: Sequence[str], ways: Sequence[Mapping[str, Any]], options: Compare | Namespace
) -> pd.DataFrame:
    """Return the table of two integrators and the scenes ``names``."""
    scenes = [project.scene(name) for name in names]
    for way in ways:
        if "max_depth" in way:
            raise CommandError(
                f"max_depth={way['max_depth']} of {way.get('type')!r} would compare different images; "
                "leave it out: both sides have the depth of the reference"
            )
    rows: list[dict[str, str]] = []
    for scene in scenes:
        width = fitted(scene, options.resolution)
        job = Job(project, scene, width, None, max(options.spp), options.reference_seconds)
        plugins = [dict(way) for way in ways]
        samplers = [plugin.pop("sampler", None) for plugin in plugins]
        for plugin, sampler in zip(plugins, samplers, strict=True):
            check_plugins(str(plugin.get("type")), plugin, sampler, job.depth)
        target = obtained(job)
        sides = [
            (scene.load(job.resolution, sampler or "independent"), integrator_of(plugin, job.depth))
            for plugin, sampler in zip(plugins, samplers, strict=True)
        ]
        for spp in options.spp:
            taken = [samples_taken(*side, spp) for side in sides]
            renders = [partial(timed, *side, count) for side, count in zip(sides, taken, strict=True)]
            with steps(2 * (options.pairs + 1)) as step:
                shown = f"{scene.name}, {spp} spp, seed {{}}"
                found = measured(
                    renders, target, options.pairs, lambda seed, shown=shown: step(shown.format(seed))
                )
            counts = " / ".join(dict.fromkeys(map(str, taken)))
            rows.append({"scene": f"`{scene.name}`", "spp": counts, **line(*found)})
    return pd.DataFrame(rows).fillna("–")


def text(names: Sequence[str], table: pd.DataFrame) -> str:
    """Format the ``table`` as Markdown, with what its ratios are of both ``names``."""
    first, second = names
    return (
        f"Time and errors of {first} divided by those of {second}; "
        f"efficiency, 1 / (time · error), of {first} over {second}.\n\n{markdown(table)}"
    )


def run(options: Namespace) -> int:
    """Print the table that the command-line ``options`` request."""
    mi.set_variant(VARIANT)
    rows = lines(Project(options.project), options.scenes, options.sides, options)
    print(text([described(way) for way in options.sides], rows))
    return 0
