"""What the benchmark has to reach, and whether it does: a table of docs/reports/figures.md."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter

import numpy as np
import repository
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


PROBES = repository.ROOT / "docs" / "reports" / "benchmark" / "probes.json"


def probed(results: Results, name: str) -> dict[str, list[float]]:
    """Return the results of a probe for the software of the rows."""
    probe, row = json.loads(PROBES.read_text()).get(name, {}), results.rows.iloc[0]
    if probe.get("versions") != json.loads(row["versions"]) | {"machine": row["machine"]}:
        raise Unavailable("not measured of this version on this machine")
    return probe["values"]


def floor(results: Results) -> Measured:
    """Kernel time over that of its rays alone."""
    found = {name: summary(v) for name, v in probed(results, "floor").items()}
    text = ", ".join(f"{one} `{name}`" for name, one in found.items())
    return Measured(text, [one.median for one in found.values()])


def coldstart(results: Results) -> Measured:
    """Seconds of a process to the first image, also over `path`'s."""
    values = probed(results, "coldstart")
    ratios = summary(np.divide(values["bdpt"], values["path"]))
    seconds = float(np.median(values["bdpt"]))
    return Measured(f"{seconds:.2f} s, {ratios} `path`'s", [seconds, ratios.median])


def memory(results: Results) -> Measured:
    """Peak memory of a process in GiB."""
    found = {name: float(np.median(v)) for name, v in probed(results, "memory").items()}
    return Measured(", ".join(f"{v:.2f} GiB for {name}" for name, v in found.items()), [*found.values()])


@dataclass(frozen=True)
class Goal:
    """``what`` must reach ``bounds``: one for all numbers of ``measure``, or one for each.

    ``text``: how the table writes the bounds; ``aim``: what more is worth; ``scenes``: given to ``measure``.
    """

    what: str
    bounds: tuple[float, ...]
    measure: Callable[..., Measured]
    scenes: tuple[str, ...] = ()
    aim: str = "–"
    text: str = "{:g}x"
    at_most: bool = False

    def row(self, results: Results) -> list[str]:
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


def _over_path(least: float, scene: str, what: str | None = None, aim: str = "–", raw: bool = False) -> Goal:
    measure = partial(over_path, error="rel_mse") if raw else over_path
    return Goal(what or f"… `{scene}`", (least,), measure, (scene,), aim)


_NOTHING = ", nothing to gain"
_END = "{:g}x, lower end of the interval"
GOALS = (
    _over_path(
        2,
        "cornell_box",
        "efficiency over the stronger `path`, `cornell_box`, depth 6, 64 spp, trimmed",
        "2.2x",
    ),
    _over_path(30, "uplight_room", aim="40x"),
    _over_path(50, "veach_bidir", "… `veach_bidir`, depth 7", "100x"),
    _over_path(200, "glass_caustics", aim="300x"),
    _over_path(30, "glass_caustics", "… `glass_caustics`, raw", raw=True),
    _over_path(100, "rough_glass_caustics", "… `rough_glass_caustics` (alpha 0.005), raw", raw=True),
    Goal("… the same with `merging`", (200,), merged, ("rough_glass_caustics",)),
    _over_path(60, "frosted_glass_caustics", "… `frosted_glass_caustics` (alpha 0.02), raw", raw=True),
    Goal("… the same with `merging`", (80,), merged, ("frosted_glass_caustics",)),
    _over_path(2.3, "ajar_door", aim="4x"),
    _over_path(2, "many_lights", aim="4x"),
    _over_path(2.2, "window_room", aim="3x"),
    Goal(f"… `open_sky`{_NOTHING}", (0.96,), near_one, ("open_sky",), "1.0x", _END),
    Goal(f"… `veach_mis`{_NOTHING}", (0.96,), near_one, ("veach_mis",), "1.0x", _END),
    Goal("guided emission over `guiding=photons`, `pool`, 64 spp, trimmed", (2.3,), unaimed, ("pool",), "3x"),
    Goal("… `ring_caustic`", (2.3,), unaimed, ("ring_caustic",), "3x"),
    Goal("… `smallvcm_cornell_sun`", (1.7,), unaimed, ("smallvcm_cornell_sun",), "2.2x"),
    _over_path(
        100,
        "fog_beam",
        "efficiency over the stronger of `volpath` and `volpathmis`, `fog_beam`, 64 spp, trimmed",
        "300x",
    ),
    _over_path(80, "fog_beam_thick", aim="250x"),
    _over_path(120, "fog_caustic", aim="350x"),
    _over_path(80, "fog_lamp_in_glass", aim="250x"),
    _over_path(6, "fog_lamp", aim="15x"),
    _over_path(2, "cloudy_ball", aim="3x"),
    _over_path(2, "glass_slab", aim="5x"),
    _over_path(0.97, "skin_ball", f"… `skin_ball`{_NOTHING} by light subpaths", "1.3x"),
    _over_path(0.97, "cloud_sky", f"… `cloud_sky`{_NOTHING} by light subpaths", "1.1x"),
    Goal("worst scene of all", (0.98,), worst, aim="1.0x"),
    Goal(
        "path tracing alone (`light_paths=0`) over `path` with multijitter, `cornell_box`",
        (1.0,),
        alone,
        ("cornell_box",),
        "1.2x",
        "{:.1f}x",
    ),
    Goal("default over `skip=none`, geometric mean over all scenes", (3,), against_none, aim="4x"),
    Goal(
        "cost of a sample over `path`'s, `cornell_box`, depth 6: `skip=none` / `skip=impossible`",
        (3.0, 1.8),
        costs,
        ("cornell_box",),
        "2.5x / 1.3x",
        "{}x / {}x",
        at_most=True,
    ),
    Goal("kernel time over the floor (the rays alone, replayed)", (1.35,), floor, aim="1.2x", at_most=True),
    Goal(
        "pilot and decisions, share of a render at 256 spp, `cornell_box`",
        (2,),
        pilot,
        ("cornell_box",),
        "1 %",
        "{} %",
        at_most=True,
    ),
    Goal(
        "peak memory of a process, 1920x1080, depth 8",
        (1.5,),
        memory,
        aim="0.8 GiB",
        text="{} GiB",
        at_most=True,
    ),
    Goal(
        "cold start to the first image, `cornell_box`",
        (2.5, 4),
        coldstart,
        aim="2x `path`'s",
        text="{} s and {}x `path`'s",
        at_most=True,
    ),
)


def goals_table(results: Results) -> str:
    """Goals and measurements, and whether they are met, at the default budget of comparisons."""
    results = replace(results, compared=None)
    return table(["what", "bound", "aim", "measured", "met"], [goal.row(results) for goal in GOALS])
