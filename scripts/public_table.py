"""The tables and the summary of `public_scenes`: what is said of scenes that are rendered at equal time."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from mitsuba_bdpt.measure import analysis, report
from mitsuba_bdpt.measure.analysis import Refused, Results, geometric_mean
from mitsuba_bdpt.measure.estimates import OWN
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.tables import ratio, said, table
from public_checks import DEFAULT, OURS, Check, check

MARK = "Made by `scripts/public_scenes.py`"
"""What each of its texts has in it."""

KINDS = {"rel_mse_trimmed": "trimmed", "rel_mse": "raw"}


@dataclass(frozen=True)
class Findings:
    """The results of all scenes with their references; by name why others are left out, and notes."""

    results: Results
    made: dict[str, Reference]
    left_out: dict[str, str]
    notes: dict[str, list[str]]

    @cached_property
    def checks(self) -> dict[str, Check]:
        """Of each scene."""
        given = {scene: kept.image for scene, kept in self.made.items() if kept.given}
        return {scene: check(self.results, scene, given.get(scene)) for scene in self.results.scenes}

    def wrong(self) -> list[str]:
        """Scenes that this package renders wrongly, or may: those of which the checks do not agree."""
        return [scene for scene, found in self.checks.items() if found.wrong or found.disputed]

    def _figure(self, scene: str, method: str, error: str) -> analysis.Summary:
        """The efficiency of one of `OURS` over `path`, whether or not that finds all light."""
        path = self.results.standard_in(scene)[0]
        differ = self.results.differs(scene, method), self.results.differs(scene, path)
        ours, theirs = self.results.of(scene, method), self.results.of(scene, path)
        return analysis.efficiency(ours, theirs, error, differ)

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
        head += ["its own relMSE over the default's, raw", "`path` misses", "this package"]
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
        if not results.scenes:
            return f"# Public scenes at equal time\n\n{MARK}. No scene was rendered.\n{self._left_out()}"
        counts = sorted({len(results.of(scene, DEFAULT)) for scene in results.scenes})
        seeds = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
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
References that are made are this package's own: that `path` misses light by them is its word alone.

{self._checks()}{self._noted()}{self._left_out()}"""

    def _noted(self) -> str:
        lines = "".join(
            f"* `{scene}`: {text}.\n" for scene in self.results.scenes for text in self._notes(scene)
        )
        return f"\nNotes:\n\n{lines}" if lines else ""

    def _notes(self, scene: str) -> list[str]:
        """What else there is to say of a scene: light that no render has, and notes on its reference."""
        lost = [
            sum(json.loads(row["statistics"]).get("lost_light", {}).values())
            for row in self.results.of(scene, DEFAULT)
        ]
        found = []
        if any(lost):
            found.append(
                f"about {max(lost):.1%} of its light, of delta lamps through glass on what is seen through "
                "glass, is found by no strategy: it is in no render and no reference that is made; "
                "`merging` finds it"
            )
        return found + self.notes.get(scene, [])

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
        lines = [f"{count} of {len({*self.results.scenes, *self.left_out})} scenes were rendered."]
        lines += [f"Left out: {name}: {why}" for name, why in self.left_out.items()]
        if not count:
            return "".join(f"* {line}\n" for line in lines)
        lines += [self._means(complete=True)]
        if any(found.path or found.unchecked for found in self.checks.values()):
            lines += [self._means(complete=False)]
        return "".join(f"* {line}\n" for line in [*lines, *self._worst(), *self._bias(), *self._unmeasured()])

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
        lost = {scene: found.path for scene, found in checked.items() if found.path and not found.disputed}
        lines = [f"`path` misses energy in {len(lost)} of {len(checked)} scenes{':' if lost else '.'}"]
        lines[0] += "".join(f" `{scene}`, {text}." for scene, text in lost.items())
        lines += [
            f"Either `path` and what made the given image miss energy in `{scene}`, or this package is too "
            f"bright there: {found.path}."
            for scene, found in checked.items()
            if found.disputed
        ]
        wrong = {scene: found.wrong for scene, found in checked.items() if found.wrong}
        text = f"Biased by us: {len(wrong)} of {len(checked)} scenes{':' if wrong else '.'}"
        lines.append(text + "".join(f" `{scene}`: {'; '.join(texts)}." for scene, texts in wrong.items()))
        lines += [f"`{scene}`: {text}." for scene in self.results.scenes for text in self._notes(scene)]
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

    def _unmeasured(self) -> list[str]:
        """Scenes without some figures: why."""
        return [
            f"`{scene}`: no figure: {text}."
            for scene in self.results.scenes
            for text in dict.fromkeys(map(str, self._refused(scene)))
        ]

    def _refused(self, scene: str) -> list[Refused]:
        """Why figures of a scene are refused."""
        found = []
        for way in OURS:
            for error in KINDS:
                try:
                    self._figure(scene, way, error)
                except Refused as why:
                    found.append(why)
        return found


def _ours(found: Check) -> str:
    """What is said of this package in a scene."""
    if found.wrong:
        return f"**wrong**: {'; '.join(found.wrong)}"
    return f"passed; {', '.join(found.lacks)} darker than the reference" if found.lacks else "passed"
