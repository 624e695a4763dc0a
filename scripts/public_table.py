"""The tables and the summary of `public_scenes`: what is said of scenes that are rendered at equal time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.measure import analysis, report
from mitsuba_bdpt.measure.agreement import Apart, Means, apart, compare_means
from mitsuba_bdpt.measure.analysis import ALONE, NONE, OWN, NotJudged, Refused, Results, geometric_mean
from mitsuba_bdpt.measure.efficiency import refused_share
from mitsuba_bdpt.measure.tables import ratio, said, table

MARK = "Made by `scripts/public_scenes.py`"
"""What each of its texts has in it."""

DEFAULT = "bdpt"

OURS = {ALONE: "path tracing alone", NONE: "`skip=none`", DEFAULT: "default"}
"""What is compared with `path`, as the tables call it."""

LISTED = 4
"""Tiles that a text lists, at most."""

KINDS = {"rel_mse_trimmed": "trimmed", "rel_mse": "raw"}


@dataclass(frozen=True)
class Check:
    """What bias checks find in a scene, as texts.

    ``path``: what it lacks, empty if nothing; ``wrong``: what this package renders wrongly; ``lacks``: which
    of its integrators are darker than the reference, though not than `path`; ``unchecked``: why there was no
    check, if so.
    """

    path: str = ""
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


def check(results: Results, scene: str) -> Check:
    """Compare all integrators with `path` and with the reference, tile by tile.

    In place of a reference that is given, of unknown error, stands ``skip=none``. `path` is taken to miss
    what it is darker by than this; this package to be wrong where it is darker than `path`, where its path
    tracing alone differs from `path`, which has the same strategies, where it is brighter than the reference
    and where `path` is brighter than that.
    """
    path = results.standard_in(scene)[0]
    try:
        means = {
            method: Means.of([row["tile_means"] for row in results.of(scene, method)])
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
    text = ""
    if lost[0]:
        text = f"{analysis.missing(compare_means(means[path], judge))}: {_where(lost[0])}"
    return Check(text, tuple(wrong), tuple(lacks))


def _split(places: list[Apart]) -> tuple[list[Apart], list[Apart]]:
    """Where it is darker, and where brighter."""
    return [p for p in places if p.share < 0], [p for p in places if p.share > 0]


@dataclass(frozen=True)
class Findings:
    """The results of all scenes with their references, and by name why others are left out."""

    results: Results
    made: dict
    left_out: dict

    @cached_property
    def checks(self) -> dict[str, Check]:
        """Of each scene."""
        return {scene: check(self.results, scene) for scene in self.results.scenes}

    def wrong(self) -> list[str]:
        """Scenes that this package renders wrongly."""
        return [scene for scene, found in self.checks.items() if found.wrong]

    def _figure(self, scene: str, method: str, error: str) -> analysis.Summary:
        """The efficiency of one of `OURS` over `path`, whether or not that finds all light."""
        path = self.results.standard_in(scene)[0]
        return analysis.efficiency(self.results.of(scene, method), self.results.of(scene, path), error)

    @cached_property
    def _figures(self) -> dict[str, dict[tuple[str, str], float]]:
        """Medians by integrator and error of the scenes that have all of them: one set of scenes for each."""
        found = {}
        for scene in self.results.scenes:
            try:
                found[scene] = {
                    (way, error): self._figure(scene, way, error).median for way in OURS for error in KINDS
                }
            except Refused:
                continue
        return found

    def _efficiencies(self) -> str:
        """The table that all is about."""
        head = ["scene", *(f"{name}, {kind}" for name in OURS.values() for kind in KINDS.values())]
        lines = []
        for scene in self.results.scenes:
            mark = " †" if self.checks[scene].path else ""
            figures = [said(partial(self._figure, scene, way, error)) for way in OURS for error in KINDS]
            lines.append([f"`{scene}`{mark}", *figures])
        return table(head, lines)

    def _checks(self) -> str:
        """What was rendered, against what, and what the checks say."""
        head = ["scene", "size", "max_depth", "samples per pixel, seconds of a render", "reference"]
        head += ["its own relMSE over the default's", "`path` misses", "this package"]
        lines = []
        for scene in self.results.scenes:
            rows, found = self.results.of(scene, DEFAULT), self.checks[scene]
            path = self.results.standard_in(scene)[0]
            samples = ", ".join(
                f"{name} {self.results.of(scene, way)[0]['spp']}"
                for way, name in ({path: path} | OURS).items()
            )
            kept = self.made[scene]
            by = kept.provenance["integrator"] if kept.given else f"made, {kept.provenance['spp']} spp"
            shares = [f"{row[OWN['rel_mse']] / row['rel_mse']:.1%}" for row in rows[:1] if row["rel_mse"] > 0]
            lines.append(
                [
                    f"`{scene}`",
                    f"{rows[0]['width']} x {rows[0]['height']}",
                    str(rows[0]["max_depth"]),
                    f"{samples}; {np.median([row['seconds'] for row in rows]):.3g} s",
                    by,
                    *(shares or ["–"]),
                    found.unchecked or found.path or "nothing",
                    "not checked" if found.unchecked else _ours(found),
                ]
            )
        return table(head, lines)

    def tables(self) -> str:
        """Both tables, with what they mean."""
        results = self.results
        seeds = len(results.of(results.scenes[0], DEFAULT))
        return f"""# Public scenes at equal time

{MARK}. {report.machine(results)}.

Efficiency, 1 / (seconds · relMSE), over Mitsuba's `path` (`volpath` in scenes with media) with the sampler
`independent`, in the same seconds: median (smallest–largest) over {seeds} seeds. *Trimmed*: without the worst
0.1 % of values. Above 1x `path` takes longer for the same error. †: `path` misses light here, so that its
error does not fall to 0, and more time is worth less to it than the figure says.

{self._efficiencies()}
Bias: Welch's test of 4 x 4 tiles (row,column from 0 at the top left) and the whole image at a significance of
0.1 %, each integrator against `path` and against the reference (against `skip=none` where the reference is a
given image). The own error of a given image, which includes what else it shows, is taken from our renders.

{self._checks()}{self._left_out()}"""

    def _left_out(self) -> str:
        if not self.left_out:
            return ""
        lines = "".join(f"* `{name}`: {why}\n" for name, why in self.left_out.items())
        return f"\nLeft out:\n\n{lines}"

    def summary(self) -> str:
        """The words as a text of its own."""
        return f"# Summary\n\n{MARK}, see table.md beside it.\n\n{self.words()}"

    def words(self) -> str:
        """The summary: a sentence for each thing that one wants to know."""
        count = len(self.results.scenes)
        lines = [f"{count} of {count + len(self.left_out)} scenes were rendered."]
        lines += [f"Left out: {name}: {why}" for name, why in self.left_out.items()]
        lines += [self._means(complete=True)]
        if any(found.path or found.unchecked for found in self.checks.values()):
            lines += [self._means(complete=False)]
        return "".join(f"* {line}\n" for line in [*lines, *self._worst(), *self._bias(), *self._unjudged()])

    def _means(self, complete: bool) -> str:
        """Geometric means over `path`, of scenes in which a check finds that it has all light, or of all."""
        scenes = [
            scene
            for scene in self._figures
            if not complete or not (self.checks[scene].path or self.checks[scene].unchecked)
        ]
        where = "where `path` finds all light" if complete else "also where `path` may miss light"
        head = f"Geometric means over `path` at equal time, of {len(scenes)} scenes with all figures, {where}"
        if not scenes:
            return f"{head}."
        parts = []
        for way, name in OURS.items():
            means = [
                f"{ratio(geometric_mean([self._figures[scene][way, error] for scene in scenes]))} {kind}"
                for error, kind in KINDS.items()
            ]
            parts.append(f"{name} {', '.join(means)}")
        return f"{head}: {'; '.join(parts)}."

    def _worst(self) -> list[str]:
        """The scenes in which the default does worst."""
        if not self._figures:
            return []
        parts = []
        for error, kind in KINDS.items():
            found = {scene: figures[DEFAULT, error] for scene, figures in self._figures.items()}
            name = min(found, key=lambda scene: found[scene])
            parts.append(f"`{name}`, {ratio(found[name])} {kind}")
        return [f"The default's worst scene: {'; '.join(parts)}."]

    def _bias(self) -> list[str]:
        """What the checks say of `path` and of this package."""
        checked = {scene: found for scene, found in self.checks.items() if not found.unchecked}
        lost = {scene: found.path for scene, found in checked.items() if found.path}
        lines = [f"`path` misses energy in {len(lost)} of {len(checked)} scenes{':' if lost else '.'}"]
        lines[0] += "".join(f" `{scene}`, {text}." for scene, text in lost.items())
        wrong = {scene: found.wrong for scene, found in checked.items() if found.wrong}
        lines.append(f"Biased by us: {len(wrong)} of {len(checked)} scenes{':' if wrong else '.'}")
        lines[1] += "".join(f" `{scene}`: {'; '.join(texts)}." for scene, texts in wrong.items())
        lines += [
            f"`{scene}`: {', '.join(found.lacks)}: darker than the reference, no more than `path`."
            for scene, found in checked.items()
            if found.lacks
        ]
        unchecked = [scene for scene, found in self.checks.items() if found.unchecked]
        if unchecked:
            why = self.checks[unchecked[0]].unchecked
            lines.append(f"Bias was not checked in {', '.join(f'`{scene}`' for scene in unchecked)}: {why}")
        return lines

    def _unjudged(self) -> list[str]:
        """Scenes whose figures the reference is too noisy for, with what to do."""
        lines = []
        for scene in self.results.scenes:
            try:
                for way in OURS:
                    for error in KINDS:
                        self._figure(scene, way, error)
            except NotJudged as why:
                remedy = (
                    "the image that is given is noisy, or shows something else (filter, max_depth, other "
                    "light): try --own-references"
                    if self.made[scene].given
                    else "run again, which goes on with it, with a larger --reference-seconds"
                )
                share = refused_share(why.share, 3)
                lines.append(
                    f"`{scene}`: the reference carries {share} of an error, 1 % is allowed; {remedy}."
                )
            except Refused:
                continue
        return lines


def _ours(found: Check) -> str:
    """What is said of this package in a scene."""
    if found.wrong:
        return f"**wrong**: {'; '.join(found.wrong)}"
    return f"passed; {', '.join(found.lacks)} darker than the reference" if found.lacks else "passed"
