"""What the benchmark has to reach, and whether it does: a table of docs/reports/figures.md."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np
import repository
import scale
from mitsuba_bdpt.files.texts import read_toml
from mitsuba_bdpt.measure.analysis import (
    MEDIA_RIVALS,
    NONE,
    RIVALS,
    Results,
    Summary,
    Unavailable,
    cost,
    summary,
)
from mitsuba_bdpt.measure.estimates import FEWEST_WITH_INTERVAL, KINDS, Error
from mitsuba_bdpt.measure.tables import ratio, table
from scipy import stats

# Names in presets/benchmark.toml, like those of `analysis`.
IMPOSSIBLE = "bdpt skip=impossible"
ALONE = "bdpt light_paths=0"
UNAIMED = "bdpt guiding=photons"
MERGING = "bdpt merging"

FLOOR = repository.ROOT / "docs" / "reports" / "benchmark" / "floor.json"


@dataclass(frozen=True)
class Measured:
    """What a goal measures: a text, and the numbers that must reach its bound; NaN where one is missing."""

    text: str
    values: Sequence[float]


def _measured(
    figures: Mapping[str, Callable[[], Summary]],
    show: Callable[[Summary], str] = str,
    value: Callable[[Summary], float] = attrgetter("median"),
    join: str = ", ",
) -> Measured:
    """Named ``figures``, or why there is none; judged by ``value``."""
    texts, values = list[str](), list[float]()
    for name, figure in figures.items():
        try:
            found = figure()
            text, number = show(found), value(found)
        except Unavailable as why:
            text, number = str(why), np.nan
        texts.append(f"{text} {name}")
        values.append(number)
    return Measured(join.join(texts), values)


def over_path(results: Results, scene: str, error: Error = "rel_mse_trimmed") -> Measured:
    """Efficiency over the strongest path tracer without bias; else over the strongest, and what it lacks."""
    lacks, found = results.path_lacks(scene), results.against_path(scene, error)
    return Measured(f"{found}" + f"; {lacks}" * bool(lacks), [found.median])


def _near(found: Summary) -> str:
    middle = f"{found.bound} {found.median:.3f}x".lstrip()
    what = "interval" if found.count >= FEWEST_WITH_INTERVAL else "range"
    return f"{middle}, {what} {found.low:.3f}–{found.high:.3f}, {found.count} pairs"


def _over_rivals(results: Results, scene: str, **more: str) -> dict[str, Callable[[], Summary]]:
    """Efficiency over each of `Results.standard`."""
    over, rivals = partial(results.efficiency, scene, **more), results.present(scene, results.standard)
    return {f"over {rival}": partial(over, rival) for rival in rivals or RIVALS}


def near_one(results: Results, scene: str) -> Measured:
    """Efficiency over each of `Results.standard`, judged by the lower end of its interval."""
    return _measured(_over_rivals(results, scene), _near, attrgetter("low"), "; ")


def worst(results: Results) -> Measured:
    """Smallest efficiency over all scenes."""
    found: dict[str, Summary] = {}
    for scene in results.scenes:
        with suppress(Unavailable):  # not rendered, or exact
            found[scene] = results.against_path(scene)
    if not found:
        raise Unavailable("not rendered")
    name = min(found, key=lambda scene: found[scene].median)
    return Measured(f"`{name}` of {len(found)} scenes: {_near(found[name])}", [found[name].median])


def against_none(results: Results) -> Measured:
    """Geometric means over all scenes, by which it is judged, and over those without media."""
    plain = [scene for scene in results.scenes if not results.present(scene, MEDIA_RIVALS)]
    every = _mean_over_none(results, results.scenes)
    if not 0 < len(plain) < len(results.scenes):
        return every
    return Measured(f"{every.text}; without media: {_mean_over_none(results, plain).text}", every.values)


def _mean_over_none(results: Results, scenes: list[str]) -> Measured:
    """Geometric means over the scenes, trimmed and raw."""
    found, medians = dict[str, float](), list[float]()
    for error, kind in KINDS.items():
        medians = []
        for scene in scenes:
            with suppress(Unavailable):  # not rendered, or exact
                medians.append(results.efficiency(scene, NONE, error).median)
        if not medians:
            raise Unavailable("not rendered")
        found[kind] = float(stats.gmean(medians))
    text = ", ".join(f"{ratio(mean)} {kind}" for kind, mean in found.items())
    return Measured(f"{text}, {len(medians)} of {len(scenes)} scenes", [*found.values()])


def unaimed(results: Results, scene: str) -> Measured:
    """Efficiency of guided emission, trimmed, by which it is judged, and raw."""
    found = _measured({kind: partial(results.efficiency, scene, UNAIMED, e) for e, kind in KINDS.items()})
    return Measured(found.text, found.values[:1])


def merged(results: Results, scene: str) -> Measured:
    """Raw efficiency of `merging` over each of `Results.standard`, biased or not."""
    return _measured(_over_rivals(results, scene, error="rel_mse", first=MERGING))


def alone(results: Results, scene: str) -> Measured:
    """Efficiency of path tracing alone over `path` with its best sampler."""
    budgets = (results.deciding, 4 * results.deciding)
    over = partial(results.efficiency, scene, RIVALS[1], first=ALONE)
    return _measured({f"at {n} spp": partial(over, budget=n) for n in budgets})


def costs(results: Results, scene: str) -> Measured:
    """Times of a sample over `path`'s."""
    path, *sides = (results.of(scene, way, results.deciding) for way in (RIVALS[0], NONE, IMPOSSIBLE))
    found = [cost(side, path) for side in sides]
    return Measured(" / ".join(map(str, found)), [one.median for one in found])


def pilot(results: Results, scene: str) -> Measured:
    """The pilot's share of renders, judged by the longest."""
    shares: dict[int, float] = {}
    for budget in (results.deciding, 4 * results.deciding):
        if len(rows := results.of(scene, results.methods[0], budget)):
            seconds = rows["seconds_pilot"]
            shares[budget] = 100 * float((seconds / (seconds + rows["seconds"])).median())
    if not shares:
        raise Unavailable(f"no render of {scene}")
    text = ", ".join(f"{share:.1f} % at {budget} spp" for budget, share in shares.items())
    return Measured(text, [shares[max(shares)]])


def floor(results: Results) -> Measured:
    """Kernel time over that of its rays alone, of the software of the rows."""
    record, row = json.loads(FLOOR.read_text()), results.rows.iloc[0]
    if record["versions"] != json.loads(row["versions"]) | {"machine": row["machine"]}:
        raise Unavailable("not measured of this version on this machine")
    found = {name: summary(values) for name, values in record["values"].items()}
    text = ", ".join(f"{one} `{name}`" for name, one in found.items())
    return Measured(text, [one.median for one in found.values()])


def scaled(rows: list[dict], kind: str, size: int | str, figure: str, method: str) -> Measured:
    """A figure of scale.py."""
    own = [row for row in rows if row["kind"] == kind]
    for row in own:
        if row["size"] == size:
            value = scale.FIGURES[figure](own, row, method)
            return Measured(f"{value:.3g}", [value])
    raise Unavailable("not measured")


@dataclass(frozen=True)
class Goal:
    """``what`` must reach ``bounds``; fields as in goals.toml."""

    what: str
    bounds: Sequence[float]
    measure: Callable[..., Measured]
    scenes: Sequence[str] = ()
    aim: str = "–"
    text: str = "{:g}x"
    at_most: bool = False

    def row(self, results: Results | list[dict]) -> list[str]:
        """The goal, what was measured, and whether all numbers meet the bound; intervals do not matter."""
        try:
            found = self.measure(results, *self.scenes)
        except Unavailable as why:
            found = Measured(str(why), [])
        bound = self.text.format(*self.bounds) + " at most" * self.at_most
        met = "–"
        if len(found.values) and not np.isnan(found.values).any():
            bounds = np.broadcast_to(self.bounds, len(found.values))
            is_met = np.all(found.values <= bounds if self.at_most else found.values >= bounds)
            met = "yes" if is_met else "**no**"
        return [self.what, bound, self.aim, found.text, met]


def _read(measure: str, what: str | None = None, **row) -> Goal:
    """A goal of goals.toml."""
    return Goal(what or f"… `{row['scenes'][0]}`", measure=globals()[measure], **row)


_TABLES = read_toml(Path(__file__).with_suffix(".toml"))
GOALS, OF_SCALE = ([_read(**row) for row in _TABLES[name]] for name in ("goals", "scale"))


def _table(goals: list[Goal], results: Results | list[dict]) -> str:
    return table(["what", "bound", "aim", "measured", "met"], [goal.row(results) for goal in goals])


def goals_table(results: Results) -> str:
    """Goals and measurements, and whether they are met, at the default budget of comparisons."""
    return _table(GOALS, replace(results, compared=None))


def scale_table(record: dict) -> str:
    """The same for a record of scale.py."""
    return _table(OF_SCALE, record["rows"])
