"""Tables and plots of a sweep.

Reads rows.parquet and probes.json in a folder; writes plots and README.md with all tables beside them.
Explanations are read from notes.toml, if present. Parts of another Markdown file between the lines
`<!-- report: NAME -->` and `<!-- end -->` are filled too, NAME being ``efficiency``, ``errors``, ``first
images`` or ``gallery`` (of images in ../images/gallery).
"""

from __future__ import annotations

import json
import re
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CommandError
from ..files.texts import read_toml, text_of, write_text
from ..files.whole import check_own, check_writable
from . import figures
from .agreement import BiasCheck
from .analysis import (
    INDEPENDENT,
    LIGHT_TRACER,
    MEDIA_RIVALS,
    NONE,
    RIVALS,
    Results,
    Summary,
    Unavailable,
    cost,
)
from .estimates import RelativeError
from .metrics import rel_mse_epsilon
from .project import Project
from .record import Error, Row
from .reference import Reference
from .results import load, missing_of
from .tables import (
    by_scene,
    positive,
    ranged,
    ratio,
    relative,
    replace_part,
    said,
    spanned,
    squared,
    table,
)

# -- tables -----------------------------------------------------------------------------------


def efficiency_table(results: Results) -> str:
    """Efficiency per scene and rival, trimmed and raw, and the energy that rivals lack.

    A table per set of rivals: scenes with media have others.
    """
    if not results.rivals:
        return f"There is no integrator to compare {results.methods[0]} with; add one to the preset.\n"
    groups: dict[tuple[str, ...], list[str]] = {}
    for scene in results.scenes:
        rivals = tuple(rival for rival in results.rivals if results.of(scene, rival))
        groups.setdefault(rivals, []).append(scene)
    return "\n".join(by_scene(scenes, _efficiencies(results, rivals)) for rivals, scenes in groups.items())


def _efficiencies(results: Results, rivals: Sequence[str]) -> dict[str, Callable[[str], object]]:
    """Return the columns of the first integrator's efficiencies over the ``rivals`` and everything."""
    columns: dict[str, Callable[[str], object]] = {}
    for rival in rivals:
        columns[f"over {rival}, trimmed"] = partial(results.efficiency, rival=rival)
        columns[f"over {rival}, raw"] = partial(results.efficiency, rival=rival, error="rel_mse")
    if NONE in results.aside and NONE in results.methods:
        columns[f"over {NONE}, trimmed"] = partial(results.efficiency, rival=NONE)
    if any(results.lacks(scene, rival) for scene in results.scenes for rival in rivals):
        columns["bias of rivals"] = partial(_lacking, results, rivals)
    return columns


def _lacking(results: Results, rivals: Sequence[str], scene: str) -> str:
    """Describe what each of the ``rivals`` lacks in a scene; once where they lack the same."""
    found = {rival: results.lacks(scene, rival) for rival in rivals}
    several = len(rivals) > 1 and len(set(found.values())) > 1
    said = [f"{rival}: {text}" if several else text for rival, text in found.items() if text]
    return "; ".join(dict.fromkeys(said)) or "none found"


def errors_table(results: Results) -> str:
    """Table of relMSE at the deciding budget: a row per scene and integrator, with its bias."""
    head = ["scene", "integrator", "samples per pixel", "seconds", "renders"]
    head += ["relMSE, trimmed", "relMSE, raw", "variance", "squared bias", "energy"]
    lines: list[list[str]] = []
    for scene in results.scenes:
        for method in results.methods:
            if rows := results.of(scene, method, results.deciding):
                trimmed, raw = (results.error(scene, method, error) for error in KINDS)
                lines.append(
                    [
                        *(f"`{scene}`", method, f"{np.median([row['spp'] for row in rows]):.0f}"),
                        *(spanned([row["seconds"] for row in rows]), str(len(rows))),
                        *(relative(trimmed), relative(raw), *_parts(raw)),
                        results.lacks(scene, method) or said(_energy, results, scene, method),
                    ]
                )
    return table(head, lines)


def _parts(raw: RelativeError) -> tuple[str, str]:
    """Format variance and squared bias, or why there are none."""
    if raw.variance is None or raw.squared_bias is None:
        why = "one render" if raw.count == 1 else "images are missing, or samples differ"
        return why, why
    return positive(raw.variance, raw.count), squared(raw.squared_bias, raw.count)


def _energy(results: Results, scene: str, method: str) -> str:
    found = results.surplus(scene, method)
    return f"{100 * found.value:+.2g} % ± {50 * (found.high - found.low):.2g}"


KINDS: dict[Error, str] = {"rel_mse_trimmed": "trimmed", "rel_mse": "raw"}


def budgets_table(results: Results) -> str:
    """Efficiency over the strongest of `Results.standard`, by budget: a table per set of budgets."""

    def figure(error: Error, budget: int, scene: str) -> Summary:
        return results.against_path(scene, error, budget)

    groups: dict[tuple[int, ...], list[str]] = {}
    for scene in results.scenes:
        found: list[int] = []
        for budget in sorted({row["budget"] for row in results.of(scene, results.methods[0])}):
            try:
                figure("rel_mse", budget, scene)
            except Unavailable:  # a single render, or none, or an exact one
                continue
            found.append(budget)
        if found:
            groups.setdefault(tuple(found), []).append(scene)
    tables: list[str] = []
    for budgets, scenes in groups.items():
        columns: dict[str, Callable[[str], object]] = {
            f"{budget} spp, {kind}": partial(figure, error, budget)
            for budget in budgets
            for error, kind in KINDS.items()
        }
        tables.append(by_scene(scenes, columns))
    return "\n".join(tables)


def first_images_table(results: Results) -> str:
    """Table of seconds from an empty kernel cache to the first image, introduced; empty if not measured."""
    found: dict[tuple[str, str], float] = {}
    for row in results.rows:
        if (seconds := row.get("seconds_first_image")) is not None:
            found[row["scene"], row["method"]] = seconds

    def over(rival: str, scene: str) -> str:
        ours, theirs = found.get((scene, results.methods[0])), found.get((scene, rival))
        return "–" if ours is None or theirs is None else f"{theirs:.3g} s, {ratio(ours / theirs)}"

    columns: dict[str, Callable[[str], object]] = {
        results.methods[0]: lambda scene: f"{found[scene, results.methods[0]]:.3g} s",
        **{f"{rival}, ratio to it": partial(over, rival) for rival in results.standard},
    }
    scenes = [scene for scene in results.scenes if (scene, results.methods[0]) in found]
    if not scenes:
        return ""
    text = "Seconds from an empty kernel cache to the first image, at the fewest samples of the sweep:"
    return f"{text}\n\n{by_scene(scenes, columns)}\n"


def gaps_table(results: Results) -> str:
    """Table of raw over trimmed relMSE: how much of the error few values carry.

    For the first integrator and the first of `Results.standard`, by decreasing ratio.
    """
    ours, rivals = results.methods[0], _first_rivals(results)
    columns: dict[str, Callable[[str], object]] = {ours: partial(results.gap, method=ours)}
    if rivals:
        columns[" or ".join(rivals)] = lambda scene: results.gap(
            scene, (results.standard_in(scene) or rivals)[0]
        )
    return by_scene(results.by_gap(ours), columns)


def _first_rivals(results: Results) -> list[str]:
    """Return the first of `Results.standard` in any scene, without repetitions."""
    firsts = [name for scene in results.scenes for name in results.standard_in(scene)[:1]]
    return list(dict.fromkeys(firsts)) or results.standard[:1]


def checks_table(results: Results, made: dict[str, Reference], notes: dict[str, str]) -> str:
    """Cost per sample, slopes and bias checks per scene; marks unexpected ones."""
    ours = results.methods[0]
    rival = " or ".join(_first_rivals(results) or RIVALS[:1])

    def costs(method: str, scene: str) -> Summary:
        first = results.standard_in(scene)[:1]
        theirs = results.of(scene, first[0], results.deciding) if first else []
        return cost(results.of(scene, method, results.deciding), theirs)

    def bias(scene: str) -> str:
        try:
            verdict = _verdict(results.bias(scene, ours), made[scene].merged)
        except Unavailable as few:
            why = str(few)
            verdict = said(lambda: f"energy {_energy(results, scene, ours)} ({why}: no verdict)")
        return f"{verdict}, by {_maker(made[scene])}"

    columns: dict[str, Callable[[str], object]] = {
        f"cost of a sample over {rival}": partial(costs, ours),
        f"{NONE} over {rival}": partial(costs, NONE),
        "slope": partial(_slope, results, notes),
        "slope, independent points": partial(results.convergence, method=INDEPENDENT),
        "bias check": bias,
    }
    if LIGHT_TRACER in results.aside:  # else it is in the table of efficiencies
        columns[f"efficiency over {LIGHT_TRACER}"] = lambda scene: _with_bias(results, scene, LIGHT_TRACER)
    of = {f"{NONE} over {rival}": NONE, "slope, independent points": INDEPENDENT}
    of[f"efficiency over {LIGHT_TRACER}"] = LIGHT_TRACER
    return by_scene(results.scenes, _rendered(results, columns, of))


def _rendered(
    results: Results, columns: dict[str, Callable[[str], object]], of: Mapping[str, str]
) -> dict[str, Callable[[str], object]]:
    """Return the ``columns`` without those ``of`` integrators that were not rendered."""
    return {name: made for name, made in columns.items() if of.get(name) in (None, *results.methods)}


def _with_bias(results: Results, scene: str, rival: str) -> str:
    """Return the efficiency over ``rival``, and the energy that it lacks."""
    lacks = results.lacks(scene, rival)
    return said(results.efficiency, scene, rival) + (f"; {lacks}" if lacks else "")


def _slope(results: Results, notes: dict[str, str], scene: str) -> str:
    rows = results.of(scene, results.methods[0])
    found = results.convergence(scene, results.methods[0])
    if len(set(map(_chosen, rows))) > 1:
        return said(lambda: found) + ", between decisions"
    expected = found.low <= -1 <= found.high or scene in notes or not notes
    return said(lambda: found) + ("" if expected else ", **unexplained**")


def _verdict(check: BiasCheck, merged: bool) -> str:
    """Format a bias check, with the surplus of energy and its interval in percent.

    ``merged``: the reference contains light that only `merging` samples.
    """
    half = 50 * (check.missing.high - check.missing.low)
    failed = "fails by what `merging` finds" if merged and check.missing.low > 0 else "**failed**"
    verdict = "passed" if check.passed else failed
    return f"{verdict}, p = {check.family_p:.2g}, energy {-100 * check.missing.value:+.2g} % ± {half:.2g}"


def choices_table(results: Results) -> str:
    """Table of the pilots' choices and costs, skipped strategies, and rays per sample."""

    def rows(scene: str) -> list[Row]:
        return results.of(scene, results.methods[0], results.deciding)

    def chosen(scene: str) -> str:
        counts = Counter(map(_chosen, rows(scene))).most_common()
        return "; ".join(f"{text or 'no pilot'} ({n})" for text, n in counts) or "not rendered"

    def left_out(scene: str) -> str:
        skipped = [s for row in rows(scene)[:1] for s in json.loads(row["statistics"]).get("skipped", [])]
        return ", ".join(s["class"] for s in skipped if s["level"] == "not worth its cost here") or "nothing"

    columns: dict[str, Callable[[str], object]] = {
        "chosen (number of renders)": chosen,
        "left out in the first render": left_out,
        "share of the pilot in the first render": lambda scene: f"{pilot_percent(rows(scene)):.1f} %",
        "closest hits and shadow rays per sample": lambda scene: _rays_per_sample(rows(scene)),
        f"the same, {NONE}": lambda scene: _rays_per_sample(results.of(scene, NONE, results.deciding)),
    }
    return by_scene(results.scenes, _rendered(results, columns, {f"the same, {NONE}": NONE}))


def _chosen(row: Row) -> str:
    """Return the pilot's last choice as parameters; empty without a pilot."""
    decisions = json.loads(row["decisions"] or "null")
    last = decisions[-1] if decisions else None
    if last is None:
        return ""
    share = last["light_paths"]
    light_paths = f"1/{round(1 / share)}" if share else "0"
    return f"light_paths={light_paths}, connections={last['connections']}"


def pilot_percent(rows: Sequence[Row]) -> float:
    """Return the pilots' share of a scene's first render in percent; later ones reuse them."""
    shares: list[float] = []
    for row in rows:
        if (first := row.get("seconds_pilot")) is None:
            raise Unavailable("rows of a version that cached no pilots")
        shares.append(first / (first + row["seconds"]))
    if not shares:
        raise Unavailable("not rendered")
    return 100 * float(np.median(shares))


def _rays_per_sample(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rays per sample: camera, light; shadow rays of s = 1, t = 1, inner."""
    if not rows or rows[0].get("rays_camera") is None:
        return "–"
    samples = rows[0]["spp"] * rows[0]["width"] * rows[0]["height"]
    kinds = (("camera", "light"), ("shadow_s1", "shadow_t1", "shadow_inner"))
    return "; ".join(
        " + ".join(f"{rows[0][f'rays_{kind}'] / samples:.2f}" for kind in group) for group in kinds
    )


def references_table(made: dict[str, Reference]) -> str:
    return by_scene(
        made,
        {
            "max_depth": lambda scene: made[scene].provenance["max_depth"],
            "by": lambda scene: _maker(made[scene]),
            "samples per pixel": lambda scene: made[scene].provenance.get("spp", "–"),
            "own relMSE": lambda scene: f"{made[scene].error:.1e}",
            "epsilon of relMSE": lambda scene: f"{rel_mse_epsilon(made[scene].image):.3g}",
        },
    )


def _maker(kept: Reference) -> str:
    """Name the integrator that made a reference."""
    by = kept.provenance["integrator"]
    return by if isinstance(by, str) else f"`{by['type']}`" + (", `merging`" if kept.merged else "")


GALLERY = "../images/gallery"  # relative to docs/reports/figures.md
GALLERY_COLUMNS = 3


def gallery(results: Results) -> str:
    """Images of all scenes, with the efficiency over the stronger `path`."""

    def figure(scene: str) -> str:
        lacks = results.path_lacks(scene)
        rival = results.tracer(scene)
        return ranged(results.against_path(scene)) + (f"<br>`{rival}`: {lacks}" if lacks else "")

    cells = [
        f"![{scene}]({GALLERY}/{scene}.png)<br>`{scene}`<br>{said(figure, scene)}" for scene in results.scenes
    ]
    cells += [""] * (-len(cells) % GALLERY_COLUMNS)
    rows = [cells[i : i + GALLERY_COLUMNS] for i in range(0, len(cells), GALLERY_COLUMNS)]
    return table(rows[0], rows[1:])


def stronger(results: Results) -> str:
    """Name the baselines of efficiencies by budget."""
    names = results.standard or [RIVALS[0]]
    if set(names) <= {*RIVALS, *MEDIA_RIVALS}:
        media = (
            ", with media the stronger of `volpath` and `volpathmis`," if set(names) & {*MEDIA_RIVALS} else ""
        )
        return f"the stronger `path`{media}"
    return f"the strongest of {', '.join(names)}" if len(names) > 1 else names[0]


# -- files ------------------------------------------------------------------------------------


def notes_text(notes: dict[str, str]) -> str:
    """Format the explanations, each with its scenes."""
    lines: list[str] = []
    for text in dict.fromkeys(notes.values()):
        scenes = ", ".join(f"`{scene}`" for scene in notes if notes[scene] == text)
        lines.append(f"* {scenes}: {text}\n")
    return "".join(lines)


def machine(results: Results) -> str:
    """Describe machine and software of the measurements.

    Raises ``CommandError`` for rows of several machines or versions, or of one scene by several sources of
    the plugin.
    """
    found: set[tuple[str, str]] = set()
    source_of: dict[str, str] = {}
    scenes: dict[str, set[str]] = {}
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


def title(results: Results, folder: Path) -> str:
    """Return the title: the folder, which has the preset's name, and the scene if there is one only."""
    name = folder.resolve().name
    return ": ".join([name[:1].upper() + name[1:], *(results.scenes if len(results.scenes) == 1 else ())])


def _clock(results: Results) -> str:
    """Describe the seconds, where they are not those of the clock on the wall."""
    processor = any(row.get("clock") == "processor" for row in results.rows)
    return "Seconds are processor seconds, of all threads together.\n" if processor else ""


def _equal_times(results: Results) -> str:
    """Describe the budgets at which times are equal."""
    if all(name in results.at_equal_samples for name in results.methods[1:]):
        return ""
    found: dict[int, list[str]] = {}
    for scene in results.scenes:
        rows = [row for row in results.rows if row["scene"] == scene]
        largest, at = max(row["budget"] for row in rows), [row.get("equal_time_spp") for row in rows]
        for spp in {n for n in at if n is not None and n != largest}:
            found.setdefault(spp, []).append(f"`{scene}`")
    few = "; ".join(f"at {spp} spp: {', '.join(scenes)}" for spp, scenes in sorted(found.items()))
    few = f" (for lack of time {few})" if few else ""
    return (
        f"Samples are matched for equal time at the largest budget{few}, so that times\nat others are nearly "
        "equal; what is left is in the efficiency, as if errors fell with 1 / time."
    )


def _equal_samples(results: Results) -> str:
    """Name the integrators that are not at equal time."""
    names = ", ".join(f"`{name}`" for name in results.at_equal_samples)
    return f"Not at equal time, but with the samples of the first integrator: {names}. " if names else ""


def missing_text(folder: Path) -> str:
    """Return the paragraph about renders that were cut, with the command that renders them; or nothing."""
    found = missing_of(folder)
    if not found:
        return ""
    cut = "; ".join(f"`{scene}`, {one['text']}" for scene, one in found.items())
    commands = dict.fromkeys(one["command"] for one in found.values() if one["command"])
    how = f" Render them by {', '.join(f'`{command}`' for command in commands)}." if commands else ""
    return f"**Renders are missing**, cut for lack of time: {cut}.{how}\n\n"


# Standard deviations of the logarithm of seconds over seeds. Other programs ran where that of wall seconds is
# `DISTURBED`, a fifth of the seconds, and `BUSY` times that of processor seconds, which the work alone sets.
DISTURBED = 0.2
BUSY = 3.0
FEWEST_TIMED = 3


def _is_disturbed(rows: Sequence[Row]) -> bool:
    """Return whether wall seconds of equal work differ much more than its processor seconds."""
    if len(rows) < FEWEST_TIMED or any(not row.get("cpu_seconds") for row in rows):
        return False
    wall, processor = (
        float(np.std(np.log([row.get(name, 0.0) for row in rows]), ddof=1))
        for name in ("seconds", "cpu_seconds")
    )
    return wall > max(DISTURBED, BUSY * processor)


def busy_text(results: Results) -> str:
    """Return the paragraph about scenes whose wall seconds other programs disturbed; or nothing."""
    found: list[str] = []
    for scene in results.scenes:
        sides = {
            name: results.of(scene, name, results.deciding) for name in (results.methods[0], *results.rivals)
        }
        disturbed = [f"{name} {_ranges(rows)}" for name, rows in sides.items() if _is_disturbed(rows)]
        if disturbed:
            found.append(f"`{scene}`: {', '.join(disturbed)}")
    if not found:
        return ""
    why = "wall seconds differ over seeds where processor seconds do not, and so may efficiencies"
    how = '`clock = "processor"` in the preset compares processor seconds; the sweep then renders anew'
    return f"**Other programs ran meanwhile**: {why}. {'; '.join(found)}. {how}.\n\n"


# Seconds, and multiples of those of both renders, within which the renders of one seed follow one another.
APART, APART_TIMES = 60.0, 10.0


def _is_apart(first: Row, second: Row) -> bool:
    """Return whether two renders that are compared are of different runs of a sweep."""
    began, other = (datetime.fromisoformat(row["started"]) for row in (first, second))
    between = abs((began - other).total_seconds())
    return between > APART + APART_TIMES * (first["seconds"] + second["seconds"])


def apart_text(results: Results) -> str:
    """Return the paragraph about integrators whose renders did not follow those of the first; or nothing."""
    found: dict[str, list[str]] = {}
    for scene in results.scenes:
        firsts = {row["seed"]: row for row in results.of(scene, results.methods[0], results.deciding)}
        for name in results.rivals:
            rows = results.of(scene, name, results.deciding)
            if any(_is_apart(firsts[row["seed"]], row) for row in rows if row["seed"] in firsts):
                found.setdefault(name, []).append(f"`{scene}`")
    if not found:
        return ""
    what = "; ".join(f"{name} in {', '.join(scenes)}" for name, scenes in found.items())
    why = "and efficiencies have what changed on the machine between them"
    how = "A sweep into another folder (`-o`) renders all anew"
    first = results.methods[0]
    return f"**Seconds of different runs** are compared with those of {first}, {why}: {what}. {how}.\n\n"


def _ranges(rows: Sequence[Row]) -> str:
    wall, processor = (
        "–".join(f"{end(row.get(name, 0.0) for row in rows):.3g}" for end in (min, max))
        for name in ("seconds", "cpu_seconds")
    )
    return f"{wall} s (processor {processor} s)"


def _introduction(results: Results) -> str:
    """Introduce the figures, with machine and software."""
    return f"""{MARK} from the data beside it. Machine and versions: {machine(results)}.

Efficiency is 1 / (seconds · relMSE), a ratio of the renders of one seed, which followed one another;
median (smallest–largest) over seeds; the figure has the 95 % interval of the median, for up to five seeds
the same range. The range of five seeds holds the median in 94 % of cases, of four, three and two in 87, 75
and 50 %. relMSE is the mean of (x − r)² / (r² + 0.01 mean(r)²), *trimmed*
without the worst 0.1 % of values, {results.deciding} samples per pixel unless said. Its expectation is free
of the reference's noise: raw, it is the variance over seeds; trimmed, and raw of one or two seeds, the
error against the reference less its own. Where the mean of the renders differs from the reference, the
squared bias is added, and the figure is a bound, since rare light that was not met is in no variance: ≥ where
the other integrator's error is at least the one measured, ≤ where the first integrator's is, ~ where both
are.
{_equal_times(results)}
{_equal_samples(results)}Where seeds were added until an interval was narrow enough, it is slightly too
narrow (it holds the median in 90 % of cases, not 95 %).
{_clock(results)}"""


def _differences(results: Results) -> str:
    """Return the sentence on energy that integrators lack or have in excess; nothing where none does."""
    others = [name for name in results.methods if results.kind(name) != "bdpt"]
    if not any(results.lacks(scene, name) for scene in results.scenes for name in others):
        return ""
    return (
        "Energy that an integrator of Mitsuba's lacks or has in excess may be light that it does not find,\n"
        "or a known difference: see *Differences from path and volpath* (docs/user/differences.md).\n\n"
    )


def _by_budget(results: Results) -> str:
    """Return the table of efficiencies by budget with its sentence; nothing where there are none."""
    found = budgets_table(results)
    which = f"over {stronger(results)} of those that pass the bias check, or of all where none does"
    return f"By budget, {which}:\n\n{found}\n" if found else ""


def page(
    results: Results,
    made: dict[str, Reference],
    notes: dict[str, str],
    name: str,
    missing: str = "",
) -> str:
    """Return the page of all tables, as Markdown, under a title; ``missing``: see `missing_text`."""
    if unknown := sorted(set(notes) - set(results.scenes)):
        raise CommandError(f"notes.toml: {unknown[0]!r} is not among the scenes")
    picture = "![Efficiency per scene](efficiency.png)"
    return f"""# {name}

{missing}{busy_text(results)}{apart_text(results)}{_introduction(results)}
## Efficiency

{efficiency_table(results)}
{_differences(results)}{picture if results.has_efficiency(results.scenes) else ""}

{_by_budget(results)}{first_images_table(results)}How much of the error single values carry:
raw over trimmed relMSE at {results.deciding} samples per pixel:

{gaps_table(results)}
## Errors

At {results.deciding} samples per pixel of the first integrator: mean (95 % interval over the seeds, from five
renders on; of few seeds with rare bright values it is too narrow); of seconds the median (smallest–largest).
Variance and squared bias add up to the raw error where the mean of the renders differs from the reference,
and of two renders; elsewhere the squared bias is 0 within its noise, and may be
negative. Energy: that of the image over the reference's, as a difference with its 95 % interval, or what is
missing by the bias check.

{errors_table(results)}
## What was skipped

By `{results.methods[0]}`, decided by a pilot in the first render of each scene, at {results.deciding} samples
per pixel.
Rays: closest hits of camera + light subpaths; shadow rays for s = 1 + t = 1 + other connections.

{choices_table(results)}
## Cost, convergence, bias

Of `{results.methods[0]}`. Slope: exponent of raw relMSE over samples, −1 for independent samples, with its
95 % interval ("between decisions": budgets differ in what is skipped, since a short render has no pilot).
Bias check: Welch's test of 4 x 4 tiles and the whole image at a significance of 0.1 %, the surplus of energy,
and what the reference was made by: where that is `bdpt`, with nothing skipped and other counts, what both
have in common is left to the package's own tests.

{checks_table(results, made, notes)}
{notes_text(notes)}
![relMSE over samples](samples.png)

![relMSE over seconds](seconds.png)

![Rays by kind](rays.png)

## References

{references_table(made)}"""


@dataclass(frozen=True)
class Report:
    """The results in a folder, with notes."""

    results: Results
    made: dict[str, Reference]
    notes: dict[str, str]
    title: str
    missing: str = ""

    @staticmethod
    def of(project: Project, folder: Path, spp: int | None = None) -> Report:
        """Read a folder; raises ``CommandError`` like `results.load`, or for invalid notes."""
        results, made = load(project, folder)
        results = replace(results, compared=spp)
        file = folder / "notes.toml"
        notes = read_toml(file) if file.exists() else {}
        notes.pop("aside", None)  # read by `results.load`
        for scene, text in notes.items():
            text_of(file, scene, text)
        return Report(results, made, notes, title(results, folder), missing_text(folder))

    def text(self) -> str:
        """Return the page of all tables, as Markdown."""
        return page(self.results, self.made, self.notes, self.title, self.missing)

    def draw(self, folder: Path) -> None:
        """Write the plots that the page shows."""
        if self.results.has_efficiency(self.results.scenes):
            figures.efficiencies(self.results, self.results.rivals, folder / "efficiency.png")
        figures.convergence(self.results, "seconds", folder / "seconds.png")
        figures.convergence(self.results, "spp", folder / "samples.png")
        figures.rays(self.results, folder / "rays.png")


def run(options: Namespace) -> int:
    """Write the report that the command-line ``options`` request."""
    project = Project(options.project)
    folder = project.results(options.folder)
    check_own(folder / "README.md", MARK, "move it away, or sweep into another folder")
    found = Report.of(project, folder, options.spp)
    try:
        check_writable(folder / "README.md")
    except OSError as error:
        raise CommandError(
            f"folder={str(folder)!r} cannot be written ({error.strerror}), which has the report; copy it to "
            "where it can, or change its rights"
        ) from error
    write_text(folder / "README.md", found.text())
    found.draw(folder)
    if options.readme:
        write_text(options.readme, _filled(options.readme, found))
    print(folder / "README.md")
    return 0


PARTS: dict[str, Callable[[Report], str]] = {
    "efficiency": lambda found: efficiency_table(found.results),
    "errors": lambda found: errors_table(found.results),
    "first images": lambda found: first_images_table(found.results),
    "gallery": lambda found: gallery(found.results),
}
"""Parts of Markdown files that a report fills, by their names in `<!-- report: NAME -->`."""


def _filled(file: Path, found: Report) -> str:
    """Return the text of a Markdown file with its parts filled; ``CommandError`` if it has none."""
    text = file.read_text(encoding="utf-8")
    names = re.findall(r"<!-- report: (.*?) -->", text)
    for name in names:
        if name not in PARTS:
            raise CommandError(f"{file}: there is no part {name!r}; there are {', '.join(PARTS)}")
        text = replace_part(text, name, PARTS[name](found))
    if not names:
        raise CommandError(f"{file} has no `<!-- report: NAME -->` with an `<!-- end -->`; add one")
    return text
