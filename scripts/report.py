"""Tables and plots of a sweep.

    python scripts/report.py docs/benchmark          # from rows.parquet and probes.json in that folder

writes the plots beside the data, docs/benchmark/README.md with all tables, and the parts of the project's
README.md between the lines `<!-- report: NAME -->` and `<!-- end -->`. Goals and explanations of what is not
as one expects are read from goals.toml and notes.toml in the folder.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import tomllib
from pathlib import Path

import figures
import numpy as np
import pyarrow.parquet
import reference
from analysis import (
    DECIDING,
    RIVALS,
    Refused,
    Results,
    Spread,
    convergence,
    cost,
    efficiency,
    geometric_mean,
    missing,
)
from metrics import rel_mse_epsilon

ROOT = Path(__file__).resolve().parents[1]
NONE = "bdpt skip=none"


def load(folder: Path) -> tuple[Results, dict]:
    """The data of a folder, and the references of its scenes by name."""
    rows = pyarrow.parquet.read_table(folder / "rows.parquet").to_pylist()
    wanted = {row["scene"]: (row["scene"], row["resolution"], row["max_depth"]) for row in rows}
    made = {scene: reference.load_reference(*key) for scene, key in wanted.items()}
    if without := [scene for scene, kept in made.items() if kept.means is None]:
        raise ValueError(f"{folder}: the reference of {without[0]} has too few renders for a bias check")
    file = folder / "probes.json"
    measured = json.loads(file.read_text()) if file.exists() else {}
    return Results(rows, {scene: kept.means for scene, kept in made.items()}, measured), made


def table(head, rows) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def ratio(x: float) -> str:
    """A ratio with three digits."""
    return f"{x:.3g}x" if x < 1000 else f"{round(x, -1):.0f}x"


def ranged(spread: Spread) -> str:
    """Median (smallest–largest)."""
    return f"{ratio(spread.median)} ({ratio(spread.smallest)[:-1]}–{ratio(spread.largest)[:-1]})"


def said(figure, form=ranged) -> str:
    """A figure in words, or why there is none."""
    try:
        return form(figure())
    except Refused as why:
        return str(why)


def efficiency_table(results: Results) -> str:
    """Per scene, against each rival: trimmed and raw; missing energy where the rival fails the bias check."""
    head = ["scene", *(f"over {rival}, {kind}" for rival in RIVALS for kind in ("trimmed", "raw"))]
    head += [f"over {NONE}, trimmed"]
    lines = []
    for scene in results.scenes:
        line = [f"`{scene}`"]
        for rival in RIVALS:
            check = results.bias(scene, rival)
            if check.passed:
                line += [
                    said(lambda s=scene, r=rival, e=error: results.efficiency(s, r, e))
                    for error in ("rel_mse_trimmed", "rel_mse")
                ]
            else:
                line += [missing(check), "–"]
        lines.append([*line, said(lambda s=scene: results.efficiency(s, NONE))])
    return table(head, lines)


def estimate(x) -> str:
    """Value (interval)."""
    return f"{x.value:.2f} ({x.low:.2f} to {x.high:.2f})"


def checks_table(results: Results) -> str:
    """Per scene: cost per sample, slopes, bias checks."""
    ours, other = results.methods[0], "bdpt points=independent"
    head = ["scene", "cost of a sample over path", f"{NONE} over path", "slope", "slope, independent points"]
    head += ["bias check", "ptracer"]
    lines = []
    for scene in results.scenes:
        check = results.bias(scene, ours)
        path = results.of(scene, "path", DECIDING)
        lines.append(
            [
                f"`{scene}`",
                *(
                    said(lambda p=path, s=scene, m=method: cost(results.of(s, m, DECIDING), p))
                    for method in (ours, NONE)
                ),
                *(
                    said(lambda s=scene, m=method: convergence(results.of(s, m)), estimate)
                    for method in (ours, other)
                ),
                ("passed" if check.passed else "**failed**")
                + f", p = {check.family_p:.2g}, energy {_signed(check.missing)}",
                _ptracer(results, scene),
            ]
        )
    return table(head, lines)


def _signed(share) -> str:
    """The surplus of energy with its interval, in percent."""
    half = 50 * (share.high - share.low)
    return f"{-100 * share.value:+.2g} % ± {half:.2g}"


def _ptracer(results: Results, scene: str) -> str:
    if not results.of(scene, "ptracer"):
        return "cannot render it"
    check = results.bias(scene, "ptracer")
    return said(lambda: results.efficiency(scene, "ptracer")) if check.passed else missing(check)


def budgets_table(results: Results) -> str:
    """How the efficiency over the stronger `path` depends on the budget."""
    budgets = sorted({row["budget"] for row in results.rows})
    head = ["scene", *(f"{b} spp, {kind}" for b in budgets for kind in ("trimmed", "raw"))]
    lines = []
    for scene in results.scenes:
        if all(results.bias(scene, rival).passed for rival in RIVALS):
            lines.append([f"`{scene}`"])
            for budget in budgets:
                for error in ("rel_mse_trimmed", "rel_mse"):
                    figure = said(lambda s=scene, e=error, b=budget: results.against_path(s, e, b))
                    lines[-1].append(figure if "x" in figure[:8] else "–")
    return table(head, lines)


def references_table(made: dict) -> str:
    """What each scene is compared with."""
    head = [
        "scene",
        "max_depth",
        "by",
        "samples per pixel",
        "own relMSE, raw",
        "trimmed",
        "epsilon of relMSE",
    ]
    lines = []
    for scene, kept in made.items():
        by = kept.provenance["integrator"]
        lines.append(
            [
                f"`{scene}`",
                str(kept.provenance["max_depth"]),
                by if isinstance(by, str) else f"`{by['type']}`",
                str(kept.provenance.get("spp", "–")),
                f"{kept.error:.1e}",
                f"{kept.error_trimmed:.1e}",
                f"{rel_mse_epsilon(kept.image):.3g}",
            ]
        )
    return table(head, lines)


# -- goals ------------------------------------------------------------------------------------


def _scene_goal(results: Results, scene: str, error="rel_mse_trimmed") -> str:
    """Over the stronger `path`, with a remark if that fails the bias check."""
    found = results.against_path(scene, error)
    failing = [rival for rival in RIVALS if not results.bias(scene, rival).passed]
    remark = f"; {' and '.join(failing)} fail the bias check" if failing else ""
    return ranged(found) + remark


def _near_one(results: Results, scene: str) -> str:
    found = results.against_path(scene)
    return f"{found.median:.3f}x, interval {found.low:.3f}–{found.high:.3f} ({found.count} pairs)"


def _worst(results: Results) -> str:
    """Of the scenes in which a `path` passes the bias check."""
    found = {}
    for scene in results.scenes:
        for rival in RIVALS:
            try:
                against = results.fair_efficiency(scene, rival)
            except Refused:
                continue
            found[scene] = min(found.get(scene, against), against, key=lambda ratio: ratio.median)
    worst = min(found, key=lambda scene: found[scene].median)
    return f"{ratio(found[worst].median)}, `{worst}`, of {len(found)} scenes that can be judged"


def _against_none(results: Results) -> str:
    medians = []
    for scene in results.scenes:
        try:
            medians.append(results.efficiency(scene, NONE).median)
        except Refused:
            continue
    return f"{ratio(geometric_mean(medians))}, {len(medians)} scenes"


def _alone(results: Results, scene: str) -> str:
    found = []
    for budget in (DECIDING, 4 * DECIDING):
        ours, theirs = (
            results.of(scene, method, budget) for method in ("bdpt light_paths=0", "path multijitter")
        )
        figure = said(lambda a=ours, b=theirs: efficiency(a, b))
        found.append(f"{figure} at {budget} spp")
    return ", ".join(found)


def _cost(results: Results, scene: str) -> str:
    path = results.of(scene, "path", DECIDING)
    sides = [cost(results.of(scene, method, DECIDING), path) for method in (NONE, results.methods[0])]
    return " / ".join(ranged(side) for side in sides)


def _check_probe(results, name):
    if name not in results.probes:
        raise Refused("not measured")


def _coldstart(results: Results) -> str:
    _check_probe(results, "coldstart")
    seconds = {name: float(np.median(v)) for name, v in results.probes["coldstart"]["values"].items()}
    return f"{seconds['bdpt']:.2f} s, {ratio(seconds['bdpt'] / seconds['path'])} `path`'s"


def _memory(results: Results) -> str:
    _check_probe(results, "memory")
    values = results.probes["memory"]["values"].items()
    return ", ".join(f"{np.median(v):.2f} GiB for {name}" for name, v in values)


GOALS = {
    "efficiency": _scene_goal,
    "efficiency raw": lambda results, scene: _scene_goal(results, scene, "rel_mse"),
    "near one": _near_one,
    "worst": _worst,
    "against none": _against_none,
    "alone": _alone,
    "cost": _cost,
    "coldstart": _coldstart,
    "memory": _memory,
}


def goals_table(results: Results, goals) -> str:
    """What is asked for beside what is measured."""
    lines = []
    for goal in goals:
        names = [goal["scene"]] if "scene" in goal else []
        measure = goal.get("measure")
        if measure is None:
            figure = "not measured yet"
        else:
            figure = said(lambda m=measure, n=names: GOALS[m](results, *n), str)
        lines.append([goal["what"], goal["at_least"], figure])
    return table(["what", "at least", "measured"], lines)


# -- files ------------------------------------------------------------------------------------


def notes_text(notes: dict) -> str:
    """Explanations by scene."""
    return "".join(f"* `{scene}`: {text}\n" for scene, text in notes.items())


def replace_part(text: str, name: str, part: str) -> str:
    """``text`` with what is between the markers of ``name`` replaced; ``ValueError`` without them."""
    pattern = re.compile(rf"(<!-- report: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise ValueError(f"there must be one `<!-- report: {name} -->` with an `<!-- end -->`")
    return pattern.sub(lambda m: m[1] + "\n" + part + "\n" + m[2], text)


def write_text(path: Path, text: str):
    """Written aside, then renamed."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def machine(results: Results) -> str:
    """Where and with what it was measured."""
    row = results.rows[0]
    versions = ", ".join(f"{name} {version}" for name, version in json.loads(row["versions"]).items())
    return f"{row['machine']}; {versions}"


def page(results: Results, made: dict, goals, notes) -> str:
    """The page of all tables, as Markdown."""
    return f"""# Benchmark

Made by `python scripts/report.py docs/benchmark` from the data beside it; `make benchmark` measures them:
{machine(results)}.

Efficiency is 1 / (seconds · relMSE), a ratio of the renders of one seed, which followed one another;
median (smallest–largest) over seeds. relMSE is the mean of (x − r)² / (r² + 0.01 mean(r)²), *trimmed* without
the worst 0.1 % of values, {DECIDING} samples per pixel unless said. An integrator that fails the bias
check has its missing energy reported instead. A figure is refused where the reference's own error is above
1 % of the error measured.

## Goals

{goals_table(results, goals)}
## Efficiency

{efficiency_table(results)}
![Efficiency per scene](efficiency.png)

By budget, over the stronger of the two `path`:

{budgets_table(results)}
## Cost, convergence, bias

Slope: exponent of raw relMSE over samples, −1 for independent samples, with its 95 % interval. Bias check:
Welch's test of 4 x 4 tiles and the whole image at a significance of 0.1 %, and the surplus of energy.

{checks_table(results)}
{notes_text(notes)}
![relMSE over samples](samples.png)

![relMSE over seconds](seconds.png)

![Rays by kind](rays.png)

## References

{references_table(made)}"""


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--readme", type=Path, default=ROOT / "README.md")
    args = parser.parse_args()
    results, made = load(args.folder)
    goals = tomllib.loads((args.folder / "goals.toml").read_text())["goal"]
    notes = tomllib.loads((args.folder / "notes.toml").read_text())
    figures.efficiencies(results, RIVALS, args.folder / "efficiency.png")
    figures.convergence(results, "seconds", args.folder / "seconds.png")
    figures.convergence(results, "spp", args.folder / "samples.png")
    figures.rays(results, args.folder / "rays.png")
    write_text(args.folder / "README.md", page(results, made, goals, notes))
    readme = replace_part(args.readme.read_text(), "goals", goals_table(results, goals))
    write_text(args.readme, replace_part(readme, "efficiency", efficiency_table(results)))


if __name__ == "__main__":
    main()
