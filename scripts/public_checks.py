"""Whether renders at equal time agree: what `path` misses in a scene, what this package renders wrongly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.measure import analysis
from mitsuba_bdpt.measure.agreement import Apart, Means, apart, compare_means, tile_columns
from mitsuba_bdpt.measure.analysis import ALONE, NONE, Results

DEFAULT = "bdpt"

OURS = {ALONE: "path tracing alone", NONE: "`skip=none`", DEFAULT: "default"}
"""What is compared with `path`, as the tables call it."""

LISTED = 4
"""Tiles that a text lists, at most."""


@dataclass(frozen=True)
class Check:
    """What bias checks find in a scene, as texts.

    ``path``: what it lacks, empty if nothing; ``disputed``: a reference that the user gave has no more light
    there than `path`, which may be wrong with it, or right; ``wrong``: what this package renders wrongly;
    ``lacks``: which of its integrators are darker than the reference, though not than `path`; ``unchecked``:
    why there was no check, if so.
    """

    path: str = ""
    disputed: bool = False
    wrong: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    unchecked: str = ""


def _where(places: list[Apart]) -> str:
    """Tiles, and by how much each is brighter or darker, the worst first."""
    tiles = sorted((place for place in places if place.tile), key=lambda place: -abs(place.share))
    if not tiles:
        return "the whole image alone"
    listed = ", ".join(f"{p.tile[0]},{p.tile[1]} ({_percent(p.share)})" for p in tiles[:LISTED])
    more = f" and {len(tiles) - LISTED} more" if len(tiles) > LISTED else ""
    return f"tile{'s' if len(tiles) > 1 else ''} {listed}{more}"


def _percent(share: float) -> str:
    """A difference in percent, with two digits or more."""
    value = 100 * share
    return f"{value:+.2g} %" if abs(value) < 99.5 else f"{value:+.0f} %"


def check(results: Results, scene: str, given: np.ndarray | None = None) -> Check:
    """Compare all integrators with `path` and with the reference, tile by tile.

    In place of a reference that is ``given``, an image of unknown error, stands ``skip=none``. `path` is
    taken to miss what it is darker by than this; this package to be wrong where it is darker than `path`,
    where its path tracing alone differs from `path`, which has the same strategies, where it is brighter than
    the reference and where `path` is brighter than that. That `path` misses light is this package's own word
    alone, but for what a given image has to say of it.
    """
    path = results.standard_in(scene)[0]
    try:
        means = {
            method: Means.of([row["tile_means"] for row in results.of(scene, method)], f"`{method}`")
            for method in (path, *OURS)
        }
    except CommandError as why:
        return Check(unchecked=str(why))
    judge = results.references.get(scene) or means[NONE]
    lost, wrong, lacks = _split(apart(means[path], judge)), [], []
    for method, name in OURS.items():
        below, brighter = _split(apart(means[method], means[path]))
        if below:
            wrong.append(f"{name} is darker than `{path}` in {_where(below)}")
        if brighter and method == ALONE:
            wrong.append(f"{name} is brighter than `{path}` in {_where(brighter)}")
        darker, brighter = _split(apart(means[method], judge))
        if brighter:
            wrong.append(f"{name} is brighter than the reference in {_where(brighter)}")
        if darker and not below:
            lacks.append(name)
    if lost[1]:
        wrong.append(f"`{path}` is brighter than the reference in {_where(lost[1])}")
    if not lost[0]:
        return Check("", False, tuple(wrong), tuple(lacks))
    text = f"{analysis.missing(compare_means(means[path], judge))}: {_where(lost[0])}"
    disputed = given is not None and _nearer(given, means[path], judge, lost[0])
    if disputed:
        text += f"; the given image has no more light there than `{path}`"
    return Check(text, disputed, tuple(wrong), tuple(lacks))


def _nearer(given: np.ndarray, one: Means, other: Means, places: list[Apart]) -> bool:
    """Whether an image is nearer to the means of one than to those of the other in these places."""
    tiles = one.tiles
    rows = [tiles**2 if place.tile is None else place.tile[0] * tiles + place.tile[1] for place in places]
    image, *means = (
        np.reshape(columns, (-1, 3))[rows]
        for columns in (tile_columns(given, tiles), one.columns.mean, other.columns.mean)
    )
    near, far = (np.abs(image - mean).sum() for mean in means)
    return bool(near < far)


def _split(places: list[Apart]) -> tuple[list[Apart], list[Apart]]:
    """Where it is darker, and where brighter."""
    return [p for p in places if p.share < 0], [p for p in places if p.share > 0]
