"""Compares two integrators in alternating renders: seconds, errors, efficiency.

Medians over pairs of renders with different seeds, after a warm-up that compiles; for efficiency also
quartiles. Errors are relMSE, trimmed of the worst 0.1 % and raw, less the reference's own
(`estimates.seed_errors`); ≥, ≤ and ~ mark ratios that are bounds, where the reference is too noisy. The last
column is the share of the reference's own error in the trimmed measured one (the larger of both sides).
Without any error there are no ratios. Equality of means is not tested here: see `agreement`.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import CommandError
from .estimates import Bound, bound_of_ratio, seed_errors
from .making import Job, fitted, obtained
from .options import VARIANT, Compare
from .project import Project
from .record import Error, Measured
from .reference import Reference
from .results import relative_errors
from .scenes import check_plugins, integrator_of, samples_taken
from .showing import steps
from .tables import described, table
from .timing import Render, Timed, alternating, timed

HEADS = (
    "scene",
    "spp",
    "time",
    "error",
    "raw error",
    "efficiency (quartiles)",
    "raw efficiency",
    "reference",
)


def measured(
    sides: Sequence[Render],
    target: Reference,
    rounds: int,
    on_render: Callable[[int], object] = lambda seed: None,
) -> Iterator[list[Measured]]:
    """Render as `timing.alternating`; yields the records of each round."""
    for seed, turn in enumerate(alternating(sides, rounds, on_render), 1):
        yield [
            Measured(
                seed=seed,
                seconds=found.seconds,
                cpu_seconds=found.cpu_seconds,
                **relative_errors(found.image, target),
            )
            for found in turn
        ]


@dataclass(frozen=True)
class Side:
    """Renders a scene by an integrator with samples per pixel and a seed."""

    scene: mi.Scene
    integrator: mi.Integrator

    @staticmethod
    def of(parameters: Mapping[str, Any], job: Job) -> Side:
        """Return the side of a plugin with ``parameters``, of which ``sampler`` is the sensor's.

        Size and depth are those of the reference's ``job``.
        """
        own = dict(parameters)
        sampler = own.pop("sampler", "independent")
        return Side(job.scene.load(job.resolution, sampler), integrator_of(own, job.depth))

    def taken(self, spp: int) -> int:
        """Return the samples that a render takes for ``spp``."""
        return samples_taken(self.scene, self.integrator, spp)

    def __call__(self, spp: int, seed: int) -> Timed:
        return timed(self.scene, self.integrator, self.taken(spp), seed)


def line(
    name: str, sides: Sequence[Callable[[int, int], Timed]], target: Reference, spp: int, pairs: int
) -> list[str]:
    """Return a scene's line of the table; for an image without an error, the reason."""
    made = [partial(render, spp) for render in sides]
    found: list[list[Measured]] = []
    with steps(2 * (pairs + 1)) as step:
        for pair in measured(made, target, pairs, lambda seed: step(f"{name}, {spp} spp, seed {seed}")):
            if not all(row["rel_mse_trimmed"] for row in pair):
                why = "every value (trimmed) is exactly that of the reference"
                return [f"`{name}`", str(spp), why, *["–"] * (len(HEADS) - 3)]
            found.append(pair)
    return [f"`{name}`", str(spp), *_figures(found)]


def _figures(pairs: Sequence[Sequence[Measured]]) -> list[str]:
    """Return the cells of `HEADS` after the samples."""
    time = np.array([first["seconds"] / second["seconds"] for first, second in pairs])
    (error, *bounds), (raw, *raw_bounds) = (_ratio(pairs, name) for name in ("rel_mse_trimmed", "rel_mse"))
    low, middle, high = np.quantile(1 / (time * error), (0.25, 0.5, 0.75))
    own = [[row["reference_rel_mse_trimmed"] / row["rel_mse_trimmed"] for row in pair] for pair in pairs]
    return [
        f"{np.median(time):.3g}",
        f"{bounds[0]} {np.median(error):.3g}".lstrip(),
        f"{raw_bounds[0]} {np.median(raw):.3g}".lstrip(),
        f"{bounds[1]} {middle:.3g} ({low:.3g}–{high:.3g})".lstrip(),
        f"{raw_bounds[1]} {np.median(1 / (time * raw)):.3g}".lstrip(),
        f"{100 * np.median(own, axis=0).max():.1f} %",
    ]


def _ratio(pairs: Sequence[Sequence[Measured]], error: Error) -> tuple[np.ndarray, Bound, Bound]:
    """Return ratios of errors of each pair, first over second; their bound, and their reciprocals'."""
    sides = [[pair[side] for pair in pairs] for side in (0, 1)]
    (first, over), (second, under) = (seed_errors(rows, error, differs=False) for rows in sides)
    return np.divide(first, second), bound_of_ratio(over, under), bound_of_ratio(under, over)


def lines(
    project: Project, names: Sequence[str], ways: Sequence[Mapping[str, Any]], options: Compare | Namespace
) -> list[list[str]]:
    """Return the rows of the table, for two integrators and the scenes ``names``."""
    scenes = [project.scene(name) for name in names]
    for way in ways:
        if "max_depth" in way:
            raise CommandError(
                f"max_depth={way['max_depth']} of {way.get('type')!r} would compare different images; "
                "leave it out: both sides have the depth of the reference"
            )
    rows: list[list[str]] = []
    for scene in scenes:
        width = fitted(scene, options.resolution)
        job = Job(project, scene, width, None, max(options.spp), options.reference_seconds)
        for way in ways:
            own = dict(way)
            sampler = own.pop("sampler", None)
            check_plugins(str(own.get("type")), own, sampler, job.depth)
        target, sides = obtained(job), [Side.of(way, job) for way in ways]
        for spp in options.spp:
            taken = dict.fromkeys(str(one.taken(spp)) for one in sides)
            name, _, *figures = line(scene.name, sides, target, spp, options.pairs)
            rows.append([name, " / ".join(taken), *figures])
    return rows


def text(names: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return the table of the ``rows``, after what its ratios are; ``names``: of both integrators."""
    first, second = names
    return (
        f"Time and errors of {first} divided by those of {second}; "
        f"efficiency, 1 / (time · error), of {first} over {second}.\n\n{table(HEADS, rows)}"
    )


def run(options: Namespace) -> int:
    """Print the table that the command-line ``options`` request."""
    mi.set_variant(VARIANT)
    rows = lines(Project(options.project), options.scenes, options.sides, options)
    print(text([described(way) for way in options.sides], rows))
    return 0
