"""Tables and plots of a sweep.

Reads rows.parquet and probes.json in a folder; writes plots and README.md with all tables beside them. Goals
and explanations are read from goals.toml and notes.toml, if present. Parts of another Markdown file between
the lines `<!-- report: NAME -->` and `<!-- end -->` are filled too, NAME being ``goals``, ``efficiency`` or
``gallery`` (of images in ../images/gallery).
"""

from __future__ import annotations

import json
import re
from argparse import Namespace
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet

from ..errors import CommandError
from ..files.texts import list_of, read_json, read_toml, text_of, write_text
from ..files.whole import check_own
from . import figures
from .analysis import (
    ALONE,
    IMPOSSIBLE,
    INDEPENDENT,
    LIGHT_TRACER,
    MEDIA_RIVALS,
    NONE,
    RIVALS,
    UNAIMED,
    Biased,
    NotJudged,
    Refused,
    Results,
    Summary,
    convergence,
    cost,
    efficiency,
    geometric_mean,
    summary,
)
from .metrics import rel_mse_epsilon
from .project import Project
from .reference import make_command, read_reference, reference_path, too_few
from .scenes import digest
from .tables import ranged, ratio, said, table


def load(project: Project, folder: Path) -> tuple[Results, dict]:
    """Return the results in a folder, and the references of its scenes by name.

    Raises ``CommandError`` if there are none, or if errors are against other references than the
    ``project``'s.
    """
    try:
        rows = pyarrow.parquet.read_table(folder / "rows.parquet").to_pylist()
    except (FileNotFoundError, NotADirectoryError, pyarrow.ArrowInvalid) as error:
        raise CommandError(
            f"{folder}: rows.parquet is missing or not whole; run {project.sweep_command(folder)}"
        ) from error
    made, digests = {}, {}
    for row in rows:
        scene = row["scene"]
        if scene not in made:
            path = reference_path(project, scene, row["resolution"], row["max_depth"])
            if not path.is_file():
                raise CommandError(
                    f"{folder}: the reference of {scene} is not in {str(project.references)!r}; name the "
                    "folder of the sweep's project by --project, or run the sweep again, which makes it"
                )
            made[scene], digests[scene] = read_reference(path), digest(path)
        if row["reference_sha256"] != digests[scene]:
            raise CommandError(
                f"{folder}: the errors in {scene} were taken against another reference; run "
                f"{project.sweep_command(folder)}, which takes them anew"
            )
    means = {scene: kept.means for scene, kept in made.items() if not kept.given}
    if without := [scene for scene, kept in means.items() if kept is None]:
        raise CommandError(f"{folder}: {too_few(without[0], _reference_command(project, rows, without[0]))}")
    file = folder / "probes.json"
    measured = read_json(file, "delete it, and sweep again to measure it anew") if file.exists() else {}
    return Results(rows, means, measured), made


def _reference_command(project: Project, rows: list[dict], scene: str) -> str:
    """Return the command line that refines the reference of a scene."""
    row = next(row for row in rows if row["scene"] == scene)
    called = scene if scene in project.scene_names() else f"{scene}.xml"
    return make_command(project, called, row["resolution"], row["max_depth"])


def efficiency_table(results: Results) -> str:
    """Efficiency per scene and rival, trimmed and raw; missing energy where biased.

    A table per set of rivals: scenes with media have others.
    """
    groups = {}
    for scene in results.scenes:
        rivals = tuple(rival for rival in results.rivals if results.of(scene, rival))
        groups.setdefault(rivals, []).append(scene)
    return "\n".join(_efficiencies(results, rivals, scenes) for rivals, scenes in groups.items())


def _efficiencies(results: Results, rivals, scenes) -> str:
    head = ["scene", *(f"over {rival}, {kind}" for rival in rivals for kind in ("trimmed", "raw"))]
    with_all = NONE in results.methods[1:]
    head += [f"over {NONE}, trimmed"] * with_all
    lines = []
    for scene in scenes:
        line = [f"`{scene}`"]
        for rival in rivals:
            try:
                results.fair_efficiency(scene, rival)
            except Biased as why:
                line += [str(why), "–"]
                continue
            except Refused:
                pass
            line += [
                said(lambda s=scene, r=rival, e=error: results.fair_efficiency(s, r, e))
                for error in ("rel_mse_trimmed", "rel_mse")
            ]
        lines.append(line + [said(lambda s=scene: results.efficiency(s, NONE))] * with_all)
    return table(head, lines)


def gaps_table(results: Results) -> str:
    """Table of raw over trimmed relMSE: how much of the error few values carry.

    For the first integrator and the first of `Results.standard`, by decreasing ratio.
    """
    ours, rivals = results.methods[0], _first_rivals(results)
    rows = []
    for scene in results.by_gap(ours):
        methods = [ours, *(results.standard_in(scene) or rivals)[:1]]
        rows.append(
            [f"`{scene}`", *(said(lambda s=scene, m=method: results.gap(s, m)) for method in methods)]
        )
    return table(["scene", ours, *([" or ".join(rivals)] if rivals else [])], rows)


def _first_rivals(results: Results) -> list[str]:
    """Return the first of `Results.standard` in any scene, without repetitions."""
    firsts = [name for scene in results.scenes for name in results.standard_in(scene)[:1]]
    return list(dict.fromkeys(firsts)) or results.standard[:1]


GALLERY = "../images/gallery"  # relative to docs/reports/figures.md
GALLERY_COLUMNS = 3


def gallery(results: Results) -> str:
    """Images of all scenes, with the efficiency over the stronger `path`."""
    cells = []
    for scene in results.scenes:
        try:
            figure = ranged(results.against_path(scene))
        except Biased as why:
            rival, lacks = list(why.lacks.items())[-1]
            figure = f"`{rival.split()[0]}`: {lacks}"
        except NotJudged:
            figure = "not judged"
        except Refused as why:
            figure = str(why)
        cells.append(f"![{scene}]({GALLERY}/{scene}.png)<br>`{scene}`<br>{figure}")
    cells += [""] * (-len(cells) % GALLERY_COLUMNS)
    rows = [cells[i : i + GALLERY_COLUMNS] for i in range(0, len(cells), GALLERY_COLUMNS)]
    return table(rows[0], rows[1:])


def estimate(x) -> str:
    return f"{x.value:.2f} ({x.low:.2f} to {x.high:.2f})"


def checks_table(results: Results, made: dict, notes: dict) -> str:
    """Cost per sample, slopes and bias checks per scene; marks unexpected ones."""
    ours = results.methods[0]
    rival = " or ".join(_first_rivals(results) or RIVALS[:1])
    head = ["scene", f"cost of a sample over {rival}", f"{NONE} over {rival}", "slope"]
    head += ["slope, independent points"]
    head += ["bias check", LIGHT_TRACER]
    lines = []
    for scene in results.scenes:
        path = [
            row
            for method in results.standard_in(scene)[:1]
            for row in results.of(scene, method, results.deciding)
        ]
        lines.append(
            [
                f"`{scene}`",
                *(
                    said(lambda p=path, s=scene, m=method: cost(results.of(s, m, results.deciding), p))
                    for method in (ours, NONE)
                ),
                _slope(results, scene, notes),
                said(lambda s=scene: convergence(results.of(s, INDEPENDENT)), estimate),
                said(lambda s=scene: results.bias(s, ours), partial(_verdict, merged=made[scene].merged))
                + f", by {_maker(made[scene])}",
                said(lambda s=scene: results.fair_efficiency(s, LIGHT_TRACER)),
            ]
        )
    return table(head, lines)


def _slope(results, scene, notes) -> str:
    try:
        found = convergence(results.of(scene, results.methods[0]))
    except Refused as why:
        return str(why)
    if len({_chosen(row) for row in results.of(scene, results.methods[0])}) > 1:
        return estimate(found) + ", between decisions"
    expected = found.low <= -1 <= found.high or scene in notes
    return estimate(found) + ("" if expected else ", **unexplained**")


def _chosen(row) -> str:
    """Return the pilot's last choice as parameters; empty without a pilot."""
    decisions = json.loads(row["decisions"] or "null")
    last = decisions[-1] if decisions else None
    if last is None:
        return ""
    share = last["light_paths"]
    light_paths = f"1/{round(1 / share)}" if share else "0"
    return f"light_paths={light_paths}, connections={last['connections']}"


def _pilot_share(row) -> float:
    """Return the pilots' share of a scene's first render; later ones reuse them."""
    first = row.get("seconds_pilot")
    if first is None:
        raise Refused("rows of a version that remembered no pilots")
    return first / (first + row["seconds"])


def _rays_per_sample(rows) -> str:
    """Rays per sample: camera, light; shadow rays of s = 1, t = 1, inner."""
    if not rows or rows[0].get("rays_camera") is None:
        return "–"
    samples = rows[0]["spp"] * rows[0]["width"] * rows[0]["height"]
    kinds = (("camera", "light"), ("shadow_s1", "shadow_t1", "shadow_inner"))
    return "; ".join(
        " + ".join(f"{rows[0][f'rays_{kind}'] / samples:.2f}" for kind in group) for group in kinds
    )


def choices_table(results: Results) -> str:
    """Table of the pilots' choices and costs, skipped strategies, and rays per sample."""
    head = ["scene", "chosen (number of renders)", "left out in the first render"]
    head += ["share of the pilot in the first render"]
    head += ["closest hits and shadow rays per sample", f"the same, {NONE}"]
    lines = []
    for scene in results.scenes:
        rows = results.of(scene, results.methods[0], results.deciding)
        chosen = Counter(_chosen(row) for row in rows).most_common()
        if not rows:
            lines.append([f"`{scene}`", "not rendered", *["–"] * (len(head) - 2)])
            continue
        skipped = json.loads(rows[0]["statistics"]).get("skipped", [])
        left_out = [s for s in skipped if s["level"] == "not worth its cost here"]
        lines.append(
            [
                f"`{scene}`",
                "; ".join(f"{text or 'no pilot'} ({count})" for text, count in chosen),
                ", ".join(s["class"] for s in left_out) or "–",
                said(lambda rows=rows: f"{100 * np.median([_pilot_share(row) for row in rows]):.1f} %", str),
                _rays_per_sample(rows),
                _rays_per_sample(results.of(scene, NONE, results.deciding)),
            ]
        )
    return table(head, lines)


def _verdict(check, merged: bool) -> str:
    """Format a bias check, with the surplus of energy and its interval in percent.

    ``merged``: the reference contains light that only `merging` samples.
    """
    half = 50 * (check.missing.high - check.missing.low)
    failed = "fails by what `merging` finds" if merged and check.missing.low > 0 else "**failed**"
    verdict = "passed" if check.passed else failed
    return f"{verdict}, p = {check.family_p:.2g}, energy {-100 * check.missing.value:+.2g} % ± {half:.2g}"


def stronger(results: Results) -> str:
    """Name the baselines of efficiencies by budget."""
    names = results.standard or [RIVALS[0]]
    if set(names) <= {*RIVALS, *MEDIA_RIVALS}:
        media = (
            ", with media the stronger of `volpath` and `volpathmis`," if set(names) & {*MEDIA_RIVALS} else ""
        )
        return f"the stronger `path`{media}"
    return f"the strongest of {', '.join(names)}" if len(names) > 1 else names[0]


def budgets_table(results: Results) -> str:
    """Table of the efficiency over the strongest of `Results.standard`, by budget."""
    budgets = sorted({row["budget"] for row in results.rows})
    head = ["scene", *(f"{b} spp, {kind}" for b in budgets for kind in ("trimmed", "raw"))]
    lines = []
    for scene in results.scenes:
        line = [f"`{scene}`"]
        for budget in budgets:
            for error in ("rel_mse_trimmed", "rel_mse"):
                try:
                    line.append(ranged(results.against_path(scene, error, budget)))
                except Refused:
                    line.append("–")
        if set(line[1:]) != {"–"}:
            lines.append(line)
    return table(head, lines)


def _maker(kept) -> str:
    """Name the integrator that made a reference."""
    by = kept.provenance["integrator"]
    return by if isinstance(by, str) else f"`{by['type']}`" + (", `merging`" if kept.merged else "")


def references_table(made: dict) -> str:
    head = ["scene", "max_depth", "by", "samples per pixel", "own relMSE", "epsilon of relMSE"]
    lines = []
    for scene, kept in made.items():
        lines.append(
            [
                f"`{scene}`",
                str(kept.provenance["max_depth"]),
                _maker(kept),
                str(kept.provenance.get("spp", "–")),
                f"{kept.error:.1e}",
                f"{rel_mse_epsilon(kept.image):.3g}",
            ]
        )
    return table(head, lines)


# -- goals ------------------------------------------------------------------------------------


def _scene_goal(results: Results, scene: str, error="rel_mse_trimmed") -> str:
    """Efficiency over the strongest unbiased path tracer; else their missing energy."""
    try:
        return ranged(results.against_path(scene, error))
    except Biased as why:
        rivals = results.standard_in(scene)
        found = [said(lambda r=rival: results.efficiency(scene, r, error)) for rival in rivals]
        return f"{why} (against their error all the same: {', '.join(found)})"


# Pairs required near 1, until the interval of their median is this narrow.
MANY, NARROW = 20, 0.04


def _near(found: Summary) -> str:
    wide = found.count >= MANY and found.high - found.low > NARROW
    text = f"{found.median:.3f}x, interval {found.low:.3f}–{found.high:.3f}, {found.count} pairs"
    return text + (f" (not narrower than {NARROW})" if wide else "")


def _near_one(results: Results, scene: str) -> str:
    """Efficiency over each of `Results.standard`."""
    return "; ".join(
        f"{said(lambda r=rival: results.fair_efficiency(scene, r), _near)} over {rival}"
        for rival in results.standard_in(scene) or RIVALS
    )


def _worst(results: Results) -> str:
    """Smallest efficiency over scenes with an unbiased path tracer.

    Names the scenes that cannot be judged.
    """
    found, others = {}, []
    for scene in results.scenes:
        try:
            found[scene] = results.against_path(scene)
        except Biased:
            continue
        except Refused:
            others.append(f"`{scene}`")
    if not found:
        raise Refused("no scene can be judged")
    worst = min(found, key=lambda scene: found[scene].median)
    text = f"`{worst}` of {len(found)} scenes: {_near(found[worst])}"
    return text + (f"; not judged: {', '.join(others)}" if others else "")


def _against_none(results: Results) -> str:
    plain = [scene for scene in results.scenes if not any(results.of(scene, name) for name in MEDIA_RIVALS)]
    sets = {"": results.scenes} | ({"without media: ": plain} if 0 < len(plain) < len(results.scenes) else {})
    return "; ".join(f"{name}{_mean_over_none(results, scenes)}" for name, scenes in sets.items())


def _mean_over_none(results: Results, scenes: list[str]) -> str:
    """Mean over the judged scenes, by the errors and by the spread over seeds."""
    found = []
    for error in ("rel_mse_trimmed", "spread_trimmed"):
        medians = []
        for scene in scenes:
            try:
                medians.append(results.efficiency(scene, NONE, error).median)
            except Refused:
                continue
        if medians:
            found.append(f"{ratio(geometric_mean(medians))}, {len(medians)} of {len(scenes)} scenes")
        elif not found:
            raise Refused("no scene can be judged")
    return ", by the spread over seeds ".join(found)


def _unaimed(results: Results, scene: str) -> str:
    error, noise = (
        said(partial(results.efficiency, scene, UNAIMED, error))
        for error in ("rel_mse_trimmed", "spread_trimmed")
    )
    return f"{error}; by the spread over seeds {noise}"


def _alone(results: Results, scene: str) -> str:
    found = []
    for budget in (results.deciding, 4 * results.deciding):
        ours, theirs = (results.of(scene, method, budget) for method in (ALONE, RIVALS[1]))
        figure = said(lambda a=ours, b=theirs: efficiency(a, b))
        found.append(f"{figure} at {budget} spp")
    return ", ".join(found)


def _cost(results: Results, scene: str) -> str:
    path = results.of(scene, RIVALS[0], results.deciding)
    sides = [cost(results.of(scene, method, results.deciding), path) for method in (NONE, IMPOSSIBLE)]
    return " / ".join(ranged(side) for side in sides)


def _pilot(results: Results, scene: str) -> str:
    found = []
    for budget in (results.deciding, 4 * results.deciding):
        rows = results.of(scene, results.methods[0], budget)
        if rows:
            found.append(f"{100 * np.median([_pilot_share(row) for row in rows]):.1f} % at {budget} spp")
    if not found:
        raise Refused(f"no render of {scene}")
    return ", ".join(found)


def _floor(results: Results) -> str:
    return ", ".join(f"{ranged(summary(v))} `{name}`" for name, v in _values(results, "floor").items())


def _values(results, name) -> dict:
    """Return a probe's results for the software of the rows."""
    probe = results.probes.get(name)
    if probe is None:
        raise Refused("not measured")
    if probe["versions"] != json.loads(results.rows[0]["versions"]) | {"machine": results.rows[0]["machine"]}:
        raise Refused("measured of another version or on another machine")
    return probe["values"]


def _coldstart(results: Results) -> str:
    values = _values(results, "coldstart")
    ratios = summary([a / b for a, b in zip(values["bdpt"], values["path"], strict=True)])
    return f"{np.median(values['bdpt']):.2f} s, {ranged(ratios)} `path`'s"


def _memory(results: Results) -> str:
    values = _values(results, "memory")
    return ", ".join(f"{np.median(v):.2f} GiB for {name}" for name, v in values.items())


GOALS = {
    "efficiency": _scene_goal,
    "efficiency raw": lambda results, scene: _scene_goal(results, scene, "rel_mse"),
    "near one": _near_one,
    "worst": _worst,
    "against none": _against_none,
    "alone": _alone,
    "not aimed": _unaimed,
    "cost": _cost,
    "pilot": _pilot,
    "floor": _floor,
    "coldstart": _coldstart,
    "memory": _memory,
}

OF_A_SCENE = ("efficiency", "efficiency raw", "near one", "alone", "not aimed", "cost", "pilot")
"""Those that take a scene."""


def checked_goals(file: Path, data: dict) -> list[dict]:
    """Return the entries [[goal]] of goals.toml; raises ``CommandError`` if invalid."""
    if not data:
        return []
    goals = list_of(file, "goal", data.get("goal"), dict, "tables: write [[goal]] and the keys of each below")
    for goal in goals:
        for key in ("what", "at_least"):
            text_of(file, f"{key} of a [[goal]]", goal.get(key))
        if "aim" in goal:
            text_of(file, f"aim of {goal['what']!r}", goal["aim"])
        measure, scene = goal.get("measure"), goal.get("scene")
        if measure is not None and measure not in tuple(GOALS):
            raise CommandError(
                f"{file}: measure={measure!r} of {goal['what']!r} must be one of {sorted(GOALS)}"
            )
        if measure is not None and (scene is not None) != (measure in OF_A_SCENE):
            needs = "needs a scene" if scene is None else "is no figure of one scene: leave out scene"
            raise CommandError(f"{file}: measure={measure!r} of {goal['what']!r} {needs}")
    return goals


def goals_table(results: Results, goals) -> str:
    """Table of goals and measurements."""
    lines = []
    for goal in goals:
        names = [goal["scene"]] if "scene" in goal else []
        measure = goal.get("measure")
        if measure is None:
            figure = "not measured yet"
        else:
            figure = said(lambda m=measure, n=names: GOALS[m](results, *n), str)
        lines.append([goal["what"], goal["at_least"], goal.get("aim", "–"), figure])
    return table(["what", "at least", "aim", "measured"], lines)


# -- files ------------------------------------------------------------------------------------


def notes_text(notes: dict) -> str:
    """Format the explanations, each with its scenes."""
    lines = []
    for text in dict.fromkeys(notes.values()):
        scenes = ", ".join(f"`{scene}`" for scene in notes if notes[scene] == text)
        lines.append(f"* {scenes}: {text}\n")
    return "".join(lines)


def replace_part(text: str, name: str, part: str) -> str:
    """Replace the text between the markers of ``name``; ``ValueError`` without them."""
    pattern = re.compile(rf"(<!-- report: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise CommandError(f"there must be one `<!-- report: {name} -->` with an `<!-- end -->`")
    return pattern.sub(lambda m: m[1] + "\n" + part + "\n" + m[2], text)


def machine(results: Results) -> str:
    """Describe machine and software of the measurements.

    Raises ``CommandError`` for rows of several machines or versions, or of one scene by several sources of
    the plugin.
    """
    found, source_of, scenes = set(), {}, {}
    for row in results.rows:
        versions, scene = json.loads(row["versions"]), row["scene"]
        source = versions.pop("source")
        if source_of.setdefault(scene, source) != source:
            raise CommandError(f"the rows of {scene} are by several sources of the plugin; render them anew")
        scenes.setdefault(source, set()).add(scene)
        found.add((row["machine"], json.dumps(versions)))
    if len(found) > 1:
        raise CommandError(f"the rows are from several machines or versions: {sorted(found)}")
    ((where, versions),) = found
    text = where + "; " + ", ".join(f"{name} {version}" for name, version in json.loads(versions).items())
    main, *others = sorted(scenes, key=lambda source: -len(scenes[source]))
    named = "".join(f", {source} for `{'`, `'.join(sorted(scenes[source]))}`" for source in others)
    return f"{text}, source {main}{named}"


MARK = "Made by `mitsuba-bdpt report`"
"""What every report has in it."""


def _introduction(results: Results) -> str:
    """Introduce the figures, with machine and software."""
    return f"""# Benchmark

{MARK} from the data beside it. Machine and versions: {machine(results)}.

Efficiency is 1 / (seconds · relMSE), a ratio of the renders of one seed, which followed one another;
median (smallest–largest) over seeds. relMSE is the mean of (x − r)² / (r² + 0.01 mean(r)²), *trimmed*
without the worst 0.1 % of values, {results.deciding} samples per pixel unless said. An integrator that
fails the bias check has its missing energy reported instead. A figure is refused where the reference's
own error is above 1 % of the error measured (its share is said). Samples for equal time follow from the
seconds at the largest budget; seconds are those measured, so other budgets are compared as if errors fell
with 1 / time. Where seeds were added until an interval was narrow enough, it is slightly too narrow (it
holds the median in 90 % of cases, not 95 %).
"""


def page(results: Results, made: dict, goals: list, notes: dict) -> str:
    """Return the page of all tables, as Markdown."""
    if unknown := sorted(set(notes) - set(results.scenes)):
        raise CommandError(f"notes.toml: {unknown[0]!r} is not among the scenes")
    parts = [_introduction(results)]
    if goals:
        parts.append(f"## Goals\n\n{goals_table(results, goals)}")
    parts.append(
        f"""## Efficiency

{efficiency_table(results)}
{"![Efficiency per scene](efficiency.png)" if results.rivals else ""}

By budget, over {stronger(results)} that passes the bias check:

{budgets_table(results)}
How much of the error single values carry: raw over trimmed relMSE at {results.deciding} samples per pixel:

{gaps_table(results)}"""
    )
    parts.append(
        f"""## What was skipped

Decided by a pilot in the first render of each scene, at {results.deciding} samples per pixel:

{choices_table(results)}"""
    )
    parts.append(
        f"""## Cost, convergence, bias

Slope: exponent of raw relMSE over samples, −1 for independent samples, with its 95 % interval ("between
decisions": budgets differ in what is skipped, since a short render has no pilot). Bias
check: Welch's test of 4 x 4 tiles and the whole image at a significance of 0.1 %, the surplus of energy,
and what the reference was made by: where that is `bdpt`, with nothing skipped and other counts, what both
have in common is left to the package's own tests.

{checks_table(results, made, notes)}
{notes_text(notes)}
![relMSE over samples](samples.png)

![relMSE over seconds](seconds.png)

![Rays by kind](rays.png)
"""
    )
    parts.append(f"## References\n\n{references_table(made)}")
    return "\n".join(parts)


def run(options: Namespace) -> int:
    """Write the report that the command-line ``options`` request."""
    project = Project(options.project)
    folder = project.results(options.folder)
    check_own(folder / "README.md", MARK, "move it away, or sweep into another folder")
    results, made = load(project, folder)
    files = {name: folder / f"{name}.toml" for name in ("goals", "notes")}
    kept = {name: read_toml(file) if file.exists() else {} for name, file in files.items()}
    goals, notes = checked_goals(files["goals"], kept["goals"]), kept["notes"]
    for scene, text in notes.items():
        text_of(files["notes"], scene, text)
    write_text(folder / "README.md", page(results, made, goals, notes))
    if results.rivals:
        figures.efficiencies(results, results.rivals, folder / "efficiency.png")
    figures.convergence(results, "seconds", folder / "seconds.png")
    figures.convergence(results, "spp", folder / "samples.png")
    figures.rays(results, folder / "rays.png")
    if options.readme:
        readme = options.readme.read_text()
        for name, part in (
            ("goals", goals_table(results, goals)),
            ("efficiency", efficiency_table(results)),
            ("gallery", gallery(results)),
        ):
            readme = replace_part(readme, name, part)
        write_text(options.readme, readme)
    print(folder / "README.md")
    return 0
