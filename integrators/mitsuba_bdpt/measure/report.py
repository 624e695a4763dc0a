"""Tables and plots of a sweep.

Reads rows.parquet in a folder; writes plots and README.md with all tables beside them, by the
template report.md.jinja. Explanations are read from notes.toml, if present.
"""

from __future__ import annotations

import json
from argparse import Namespace
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from jinja2 import Template

from ..errors import CommandError
from ..files.texts import write_text
from ..files.whole import check_own, check_writable
from . import figures
from .analysis import INDEPENDENT, LIGHT_TRACER, NONE, RIVALS, Results, Unavailable, cost
from .estimates import KINDS, Error
from .metrics import Estimate, rel_mse_epsilon
from .project import Project
from .reference import Reference
from .results import load, missing_of
from .tables import markdown, spanned, table

Figure = Callable[[str], object]  # a figure of a scene, see `formatted`

# -- tables -----------------------------------------------------------------------------------


def formatted(figure: Callable[..., object], *given: object) -> str:
    """Call ``figure`` and format what it returns, or the reason why there is none."""
    try:
        return str(figure(*given))
    except Unavailable as why:
        return str(why)


def by_scene(scenes: Sequence[str], columns: Mapping[str, Figure]) -> str:
    """Return a table of a row per scene; ``columns``: figures by head."""
    cells = {head: [formatted(figure, scene) for scene in scenes] for head, figure in columns.items()}
    return markdown(pd.DataFrame({"scene": [f"`{scene}`" for scene in scenes], **cells}))


def efficiency_table(results: Results) -> str:
    """Table of efficiencies per scene and rival, and the energy that rivals lack.

    A table per set of rivals: scenes with media have others.
    """
    if not results.rivals:
        return f"There is no integrator to compare {results.methods[0]} with; add one to the preset.\n"
    groups: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for scene in results.scenes:
        groups[tuple(results.present(scene, results.rivals))].append(scene)
    return "\n".join(by_scene(scenes, _efficiencies(results, rivals)) for rivals, scenes in groups.items())


def _efficiencies(results: Results, rivals: Sequence[str]) -> dict[str, Figure]:
    """Return the columns of efficiencies over the ``rivals`` and ``skip=none``."""
    columns: dict[str, Figure] = {
        f"over {rival}, {kind}": partial(results.efficiency, rival=rival, error=error)
        for rival in rivals
        for error, kind in KINDS.items()
    }
    if NONE in results.aside and NONE in results.methods:
        columns[f"over {NONE}, trimmed"] = partial(results.efficiency, rival=NONE)
    if any(results.lacks(scene, rival) for scene in results.scenes for rival in rivals):
        columns["bias of rivals"] = partial(_lacking, results, rivals)
    return columns


def _lacking(results: Results, rivals: Sequence[str], scene: str) -> str:
    """Describe what each of the ``rivals`` lacks in a scene, once if it is the same."""
    found = {rival: results.lacks(scene, rival) for rival in rivals}
    several = len(rivals) > 1 and len(set(found.values())) > 1
    texts = [f"{rival}: {text}" if several else text for rival, text in found.items() if text]
    return "; ".join(dict.fromkeys(texts)) or "none found"


def errors_table(results: Results) -> str:
    """Table of relMSE and energy at the deciding budget, by scene and integrator."""
    lines: list[dict[str, str]] = []
    for scene in results.scenes:
        for method in results.present(scene, results.methods, results.deciding):
            rows = results.of(scene, method, results.deciding)
            trimmed, raw = (results.error(scene, method, error) for error in KINDS)
            variance, squared_bias = raw.parts
            lines.append(
                {
                    "scene": f"`{scene}`",
                    "integrator": method,
                    "samples per pixel": f"{rows['spp'].median():.0f}",
                    "seconds": spanned(rows["seconds"]),
                    "renders": str(len(rows)),
                    "relMSE, trimmed": str(trimmed),
                    "relMSE, raw": str(raw),
                    "variance": variance,
                    "squared bias": squared_bias,
                    "energy": results.lacks(scene, method)
                    or formatted(lambda *one: _energy(results.missing(*one)), scene, method),
                }
            )
    return markdown(pd.DataFrame(lines))


def budgets_table(results: Results) -> str:
    """Table of efficiencies over the strongest of `Results.standard`, by budget."""

    def figure(error: Error, budget: int, scene: str) -> str:
        with suppress(Unavailable):
            return str(results.against_path(scene, error, budget))
        return "–"

    cells = product(sorted(results.rows["budget"].unique()), KINDS.items())
    columns = {f"{n} spp, {kind}": partial(figure, error, n) for n, (error, kind) in cells}
    return by_scene(results.scenes, columns)


def _first_rival(results: Results, scene: str) -> str:
    """Return the first of `Results.standard` in a scene."""
    return (results.present(scene, results.standard) or results.standard or RIVALS)[0]


def checks_table(results: Results, made: dict[str, Reference], notes: dict[str, str]) -> str:
    """Cost per sample, slopes and bias checks per scene; marks unexpected ones."""
    ours = results.methods[0]
    rival = " or ".join(dict.fromkeys(_first_rival(results, scene) for scene in results.scenes))

    def costs(method: str, scene: str) -> object:
        names = method, _first_rival(results, scene)
        return cost(*(results.of(scene, name, results.deciding) for name in names))

    def over_light_tracer(scene: str) -> str:
        lacks = results.lacks(scene, LIGHT_TRACER)
        return formatted(results.efficiency, scene, LIGHT_TRACER) + (f"; {lacks}" if lacks else "")

    columns: dict[str, tuple[str, Figure]] = {
        f"cost of a sample over {rival}": (ours, partial(costs, ours)),
        f"{NONE} over {rival}": (NONE, partial(costs, NONE)),
        "slope": (ours, partial(_slope, results, notes)),
        "slope, independent points": (INDEPENDENT, partial(results.convergence, method=INDEPENDENT)),
        "bias check": (ours, lambda scene: f"{_bias(results, made[scene], scene)}, by {_maker(made[scene])}"),
    }
    if LIGHT_TRACER in results.aside:  # else it is in the table of efficiencies
        columns[f"efficiency over {LIGHT_TRACER}"] = (LIGHT_TRACER, over_light_tracer)
    rendered = {head: figure for head, (name, figure) in columns.items() if name in results.methods}
    return by_scene(results.scenes, rendered)


def _slope(results: Results, notes: dict[str, str], scene: str) -> str:
    rows = results.of(scene, results.methods[0])
    found = results.convergence(scene, results.methods[0])
    if rows["decisions"].map(_chosen).nunique() > 1:
        return f"{found}, between decisions"
    expected = found.low <= -1 <= found.high or scene in notes or not notes
    return f"{found}" + ("" if expected else ", **unexplained**")


def _bias(results: Results, reference: Reference, scene: str) -> str:
    """Format the bias check of the first integrator, or why there is none."""
    ours = results.methods[0]
    try:
        check = results.bias(scene, ours)
    except Unavailable as why:
        reason = str(why)
        return formatted(lambda: f"energy {_energy(results.missing(scene, ours))} ({reason}: no verdict)")
    failed = "fails by what `merging` finds" if reference.merged and check.missing.low > 0 else "**failed**"
    verdict = "passed" if check.passed else failed
    return f"{verdict}, p = {check.family_p:.2g}, energy {_energy(check.missing)}"


def _energy(missing: Estimate) -> str:
    """Format the surplus of energy, in percent, with its interval."""
    return f"{-100 * missing.value:+.2g} % ± {50 * (missing.high - missing.low):.2g}"


def _chosen(decisions: str) -> str:
    """Return what the pilot chose last; empty without a pilot."""
    found = json.loads(decisions or "null")
    return f"{found[-1]['light_paths']}, {found[-1]['connections']}" if found else ""


DOUBTFUL = 0.3  # share of a reference's own error in an integrator's from which on it is marked


def references_table(results: Results, made: dict[str, Reference]) -> str:
    """Table of the references, with the largest share of their error in another's."""
    found = results.rows[results.rows["budget"] == results.deciding].groupby(["scene", "method"])
    sums = found[["reference_rel_mse_trimmed", "rel_mse_trimmed"]].sum()
    shares = (sums.iloc[:, 0] / sums.iloc[:, 1]).fillna(0).groupby("scene").max()
    columns: dict[str, Figure] = {
        "max_depth": lambda scene: made[scene].provenance["max_depth"],
        "by": lambda scene: _maker(made[scene]),
        "samples per pixel": lambda scene: made[scene].provenance.get("spp", "–"),
        "own relMSE": lambda scene: f"{made[scene].error:.1e}",
        "share in errors": lambda scene: (
            f"{100 * shares[scene]:.2g} %{' ⚠' if shares[scene] > DOUBTFUL else ''}"
        ),
        "epsilon of relMSE": lambda scene: f"{rel_mse_epsilon(made[scene].image):.3g}",
    }
    return by_scene(list(made), columns)


def _maker(kept: Reference) -> str:
    """Name the integrator that made a reference."""
    by = kept.provenance["integrator"]
    return by if isinstance(by, str) else f"`{by['type']}`" + (", `merging`" if kept.merged else "")


# -- the page ---------------------------------------------------------------------------------


def machine(rows: pd.DataFrame) -> str:
    """Describe the machine and software of most rows, then others with their scenes."""
    versions = {
        text: [f"{name} {one}" for name, one in json.loads(text).items()] for text in rows["versions"]
    }
    found = rows["machine"] + "; " + rows["versions"].map(versions).map(", ".join)
    main, *others = found.value_counts().index
    scenes = rows.groupby(found)["scene"].agg(lambda names: "`, `".join(sorted({*names})))
    return main + "".join(f"; for `{scenes[one]}` {one}" for one in others)


# Standard deviations of the logarithm of seconds over seeds. Other programs ran where that of wall seconds is
# `DISTURBED`, a fifth of the seconds, and `BUSY` times that of processor seconds, which the work alone sets.
DISTURBED = 0.2
BUSY = 3.0
FEWEST_TIMED = 3

# Seconds, and multiples of those of both renders, within which the renders of one seed follow one another.
APART, APART_TIMES = 60.0, 10.0


def conditions_table(results: Results) -> str:
    """Table of unusual conditions of the times, with scenes; empty without any."""
    found: dict[str, list[str]] = defaultdict(list)
    for scene in results.scenes:
        for condition in _conditions(results, scene):
            found[condition].append(f"`{scene}`")
    rows = [[text, ", ".join(names)] for text, names in found.items()]
    return table(["condition", "scenes"], rows) if rows else ""


def _conditions(results: Results, scene: str) -> Iterator[str]:
    """Yield what makes the times of a scene differ from those of a quiet sweep."""
    everything = results.rows[results.rows["scene"] == scene]
    matched = everything.get("equal_time_spp", pd.Series(dtype=float)).dropna().unique()
    for spp in sorted({*matched} - {everything["budget"].max()}):
        yield f"for lack of time, samples are matched for equal time at {spp:.0f} spp"
    ours = results.methods[0]
    first = results.of(scene, ours, results.deciding)
    for name in (ours, *results.rivals):
        rows = results.of(scene, name, results.deciding)
        if _is_disturbed(rows):
            yield f"{name}: other programs ran meanwhile (wall seconds differ, processor seconds do not)"
        pairs = first.merge(rows, on="seed")
        began, other = (pd.to_datetime(pairs[f"started_{side}"]) for side in "xy")
        allowed = APART + APART_TIMES * (pairs["seconds_x"] + pairs["seconds_y"])
        if ((began - other).abs().dt.total_seconds() > allowed).any():
            yield f"{name}: its renders did not follow those of {ours}"


def _is_disturbed(rows: pd.DataFrame) -> bool:
    """Return whether wall seconds differ over seeds where processor seconds do not."""
    if len(rows) < FEWEST_TIMED or "cpu_seconds" not in rows or not (rows["cpu_seconds"] > 0).all():
        return False
    wall, processor = np.log(rows[["seconds", "cpu_seconds"]]).std()
    return wall > max(DISTURBED, BUSY * processor)


MARK = "Made by `mitsuba-bdpt report`"  # in every report

TEMPLATE = Path(__file__).with_suffix(".md.jinja")
TABLES = (
    *(machine, conditions_table, efficiency_table, budgets_table),
    *(errors_table, checks_table, references_table),
)
"""What the template calls."""


@dataclass(frozen=True)
class Report:
    """The results in a folder, with notes by scene, and what was cut of scenes."""

    results: Results
    made: dict[str, Reference]
    notes: dict[str, str]
    title: str
    missing: Mapping[str, Mapping[str, str]]

    @staticmethod
    def of(project: Project, folder: Path, spp: int | None = None) -> Report:
        """Read a folder; raises ``CommandError`` if its files do not fit together."""
        results, made, notes = load(project, folder)
        results = replace(results, compared=spp)
        if unknown := sorted(set(notes) - set(results.scenes)):
            raise CommandError(f"notes.toml: {unknown[0]!r} is not among the scenes")
        name = folder.resolve().name  # the preset's
        scene = f": {results.scenes[0]}" if len(results.scenes) == 1 else ""
        title = name[:1].upper() + name[1:] + scene
        return Report(results, made, notes, title, missing_of(folder))

    def text(self) -> str:
        """Return the page of all tables, as Markdown."""
        results = self.results
        notes: dict[str, list[str]] = defaultdict(list)
        for scene, text in self.notes.items():
            notes[text].append(f"`{scene}`")
        others = [name for name in results.methods if results.kind(name) != "bdpt"]
        template = Template(TEMPLATE.read_text(encoding="utf-8"), trim_blocks=True)
        return template.render(
            {one.__name__: one for one in TABLES},
            mark=MARK,
            report=self,
            results=results,
            notes=notes,
            has_known_differences=any(results.lacks(s, name) for s in results.scenes for name in others),
        )

    def draw(self, folder: Path) -> None:
        """Write the plots that the page shows."""
        if self.results.has_efficiency(self.results.scenes):
            figures.efficiencies(self.results, folder / "efficiency.png")
        figures.convergence(self.results, folder / "seconds.png", against="seconds")
        figures.convergence(self.results, folder / "samples.png", against="spp")
        figures.rays(self.results, folder / "rays.png")


def run(options: Namespace) -> int:
    """Write the report that the command-line ``options`` request."""
    project = Project(options.project)
    folder = project.results(options.folder)
    check_own(folder / "README.md", MARK, "move it away, or sweep into another folder")
    found = Report.of(project, folder, options.spp)
    check_writable(folder / "README.md")
    write_text(folder / "README.md", found.text())
    found.draw(folder)
    print(folder / "README.md")
    return 0
