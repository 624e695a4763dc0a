"""Compares two integrators in alternating renders: seconds, errors, efficiency.

Medians over pairs of renders with different seeds, after a warm-up that compiles; for efficiency also
quartiles. Errors are relMSE, trimmed of the worst 0.1 % and raw. The last column is the share of the
reference's own error in the trimmed one (the larger of both sides), which bounds the bias of the ratios.
Without any error there are no ratios. Equality of means is not tested here: see `agreement`.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..errors import CommandError
from .analysis import Refused
from .making import Job, obtained
from .metrics import TRIM, rel_mse
from .options import VARIANT, Compare
from .project import Project
from .reference import Reference
from .scenes import check_plugins, integrator_of
from .showing import steps
from .tables import table
from .timing import timed

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


@dataclass(frozen=True)
class Side:
    """A plugin with parameters, and the scene with its sampler."""

    made: mi.Integrator
    scene: mi.Scene

    @staticmethod
    def of(parameters: dict, job: Job) -> Side:
        """Create from the plugin's ``parameters``, of which ``sampler`` is the sensor's.

        Size and depth are those of the reference's ``job``.
        """
        own = dict(parameters)
        sampler = own.pop("sampler", "independent")
        return Side(integrator_of(own, job.depth), job.scene.load(job.resolution, sampler))

    def measured(self, target: Reference, spp: int, seed: int) -> tuple[float, ...]:
        """Return seconds, trimmed and raw error, and the reference's share of the former.

        Raises `Refused` if the error is 0.
        """
        image, seconds = timed(self.scene, self.made, spp, seed)
        trimmed = rel_mse(image, target.image, TRIM)
        if trimmed == 0:
            raise Refused("every value (trimmed) is exactly that of the reference")
        return seconds, trimmed, rel_mse(image, target.image), target.share_of(image, TRIM) / trimmed


def line(name: str, sides: list[Side], target: Reference, spp: int, pairs: int) -> list[str]:
    """Return a scene's line of the table."""
    try:
        with steps(2 * (pairs + 1)) as step:
            found = ratios(sides, target, spp, pairs, lambda seed: step(f"{name}, {spp} spp, seed {seed}"))
        return [f"`{name}`", str(spp), *found]
    except Refused as why:
        return [f"`{name}`", str(spp), str(why), *["–"] * (len(HEADS) - 3)]


def ratios(sides: list[Side], target: Reference, spp: int, pairs: int, on_render) -> list[str]:
    """Return the figures of a scene's line; calls ``on_render`` before each render.

    Raises `Refused` for an image without an error.
    """
    found = []
    for seed in range(pairs + 1):
        pair = [None, None]
        for i in (0, 1) if seed % 2 else (1, 0):
            on_render(seed)
            pair[i] = sides[i].measured(target, spp, seed)
        found.append(pair)
    first, second = np.array(found[1:]).transpose(1, 2, 0)
    time, error, raw, _ = first / second
    share = max(np.median(first[3]), np.median(second[3]))
    low, middle, high = np.quantile(1 / (time * error), (0.25, 0.5, 0.75))
    cells = [*np.median([time, error, raw], axis=1), np.median(1 / (time * raw))]
    text = [f"{x:.3g}" for x in cells]
    return [
        *text[:3],
        f"{middle:.3g} ({low:.3g}–{high:.3g})",
        text[3],
        f"{100 * share:.1f} %",
    ]


def lines(
    project: Project, names: Sequence[str], ways: Sequence[dict], options: Compare | Namespace
) -> list[list[str]]:
    """Return the rows of the table, for two integrators and the scenes ``names``."""
    scenes = [project.scene(name) for name in names]
    for side in map(dict, ways):
        if "max_depth" in side:
            raise CommandError(
                f"max_depth={side['max_depth']} of {side.get('type')!r} would compare different images; "
                "leave it out: both sides have the depth of the reference"
            )
    rows = []
    for scene in scenes:
        job = Job(project, scene, options.resolution, None, max(options.spp), options.reference_seconds)
        for side in ways:
            own = dict(side)
            sampler = own.pop("sampler", None)
            check_plugins(str(own.get("type")), own, sampler, job.depth)
        target = obtained(job)
        made = [Side.of(side, job) for side in ways]
        rows += [line(scene.name, made, target, spp, options.pairs) for spp in options.spp]
    return rows


def run(options: Namespace) -> int:
    """Print the table that the command-line ``options`` request."""
    mi.set_variant(VARIANT)
    print(table(HEADS, lines(Project(options.project), options.scenes, options.sides, options)))
    return 0
