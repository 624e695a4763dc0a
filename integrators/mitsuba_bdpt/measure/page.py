"""Writes a sweep as one HTML file that needs neither network nor server.

For each scene: the first integrator's efficiency over `path` and its reasons, images of the first seed at the
deciding budget (half precision, divider, exposure control), and error maps. Then a table of all renders, and
plots. The template is page.html.
"""

from __future__ import annotations

import base64
import html
import json
import math
import tempfile
from argparse import Namespace
from pathlib import Path

import numpy as np

from ..files.images import check_output, read_layers
from ..files.texts import write_text
from ..files.whole import check_own
from ..planning.explain import subpaths
from . import figures, report
from .analysis import NOTHING, RIVALS, Biased, Refused, Results
from .project import Project
from .reference import HALF_MAX
from .tables import ratio

TITLE = "mitsuba-bdpt: sweep"
"""How the title of every page begins."""

FRAME = Path(__file__).with_suffix(".html")

COLUMNS = {
    "scene": "scene",
    "integrator": "method",
    "budget": "budget",
    "renders": None,
    "samples per pixel": "spp",
    "seconds": "seconds",
    "relMSE, trimmed": "rel_mse_trimmed",
    "relMSE": "rel_mse",
    "MAPE": "mape",
    "HDR-FLIP": "flip",
    "ΔE ITP": "delta_e_itp",
}

PLOTS = {
    "efficiency": "Ratio of efficiencies per scene, median and range over seeds",
    "seconds": "relMSE over seconds, a panel per scene",
    "samples": "relMSE over samples per pixel, a panel per scene",
    "rays": "Rays per camera subpath by kind, a bar per scene",
}


def answer(results: Results, scene: str) -> tuple[float, str]:
    """Return the ratio over a scene's strongest path tracer, and a sentence about it.

    The ratio is infinite where path tracers fail, NaN where it is unknown.
    """
    rival = (results.standard_in(scene) or RIVALS)[0].split()[0]
    try:
        found = results.against_path(scene)
    except Biased as why:
        lost = all(what == NOTHING for what in why.lacks.values())
        return (math.inf if lost else math.nan), f"{rival} fails the bias check here: {why}."
    except Refused as why:
        return math.nan, f"No figure: {str(why).rstrip('.')}."
    if found.median >= 1:
        span = f"({ratio(found.smallest)[:-1]} to {ratio(found.largest)})"
        return found.median, f"{rival} takes {ratio(found.median)} the time for the same error {span}."
    span = f"({ratio(1 / found.largest)[:-1]} to {ratio(1 / found.smallest)})"
    return found.median, f"{rival} is ahead: its efficiency is {ratio(1 / found.median)} ours {span}."


def why(results: Results, scene: str) -> str:
    """Describe what the first render at the deciding budget used and skipped."""
    rows = results.of(scene, results.methods[0], results.deciding)
    if not rows:
        return ""
    row = rows[0]
    statistics = json.loads(row["statistics"] or "{}")
    if not statistics:  # an integrator other than `bdpt`
        return ""
    decided = (statistics.get("decisions") or [None])[-1]
    if decided is None:
        said = "No pilot: the render was too short for one, or there was nothing to choose."
    elif not decided["light_paths"]:
        said = "Camera subpaths alone."
    else:
        joined = {
            "none": "light tracing, no inner connections",
            "one": "one inner connection drawn per camera vertex",
            "all": "all inner connections",
        }[decided["connections"]]
        served = round(1 / decided["light_paths"])
        said = f"A pilot chose one light subpath per {subpaths(served)}, {joined}."
    left_out = [
        f"Left out: {entry['class']} ({entry['why']})."
        for entry in statistics.get("skipped", [])
        if entry["level"] == "not worth its cost here"
    ]
    return " ".join([said, *left_out])


def answers(results: Results) -> str:
    """Return the list of all scenes, by decreasing gain."""
    found = {scene: answer(results, scene) for scene in results.scenes}
    order = sorted(found, key=lambda scene: -1 if math.isnan(found[scene][0]) else found[scene][0])[::-1]
    items = [
        f'<li><a href="#scene-{scene}"><b>{scene}</b></a>: {html.escape(found[scene][1])} '
        f"{html.escape(why(results, scene))}</li>"
        for scene in order
    ]
    return f"<ul>\n{chr(10).join(items)}\n</ul>"


def encoded(image: np.ndarray) -> str:
    """Encode an image as base64 of half precision, as the page decodes it."""
    half = np.minimum(image, HALF_MAX).astype("<f2")
    return base64.b64encode(half.tobytes()).decode()


def scene_data(folder: Path, results: Results, made: dict, scene: str) -> dict:
    """Return a scene's images by name, captions and size."""
    target = made[scene].image
    images, captions = {}, {}
    for method in results.methods:
        rows = results.of(scene, method, results.deciding)
        file = folder / "images" / scene / f"{rows[0]['key']}.exr" if rows else None
        if file is None or not file.exists():
            continue
        (image,), _ = read_layers(file, "")
        images[method] = encoded(image)
        row = rows[0]
        captions[method] = (
            f"{method}: {row['spp']} samples per pixel, {row['seconds']:.3g} s, relMSE {row['rel_mse']:.2g}"
        )
    bright = float(np.quantile(target.max(axis=-1), 0.95))
    return {
        "name": scene,
        "width": target.shape[1],
        "height": target.shape[0],
        "mean": float(target.mean()),
        "exposure": round(4 * math.log2(0.9 / max(bright, 1e-6))) / 4,
        "images": images | {"reference": encoded(target)},
        "figures": captions,
        "words": f"{answer(results, scene)[1]} {why(results, scene)}",
    }


def lines(results: Results) -> list[list]:
    """Return the table's lines: medians over seeds."""
    found = []
    for scene in results.scenes:
        for method in results.methods:
            for budget in sorted({row["budget"] for row in results.of(scene, method)}):
                rows = results.of(scene, method, budget)
                line = [scene, method, budget, len(rows)]
                for column in list(COLUMNS.values())[len(line) :]:
                    values = [row[column] for row in rows if row[column] is not None]
                    middle = float(np.median(values)) if values else math.nan
                    line.append(middle if math.isfinite(middle) else None)
                line[4] = int(line[4])
                found.append(line)
    return found


def plots(results: Results) -> str:
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / f"{name}.png" for name in PLOTS}
        if results.rivals:
            figures.efficiencies(results, results.rivals, files["efficiency"])
        figures.convergence(results, "seconds", files["seconds"])
        figures.convergence(results, "spp", files["samples"])
        figures.rays(results, files["rays"])
        made = {name: file for name, file in files.items() if file.exists()}
        shown = {name: base64.b64encode(file.read_bytes()).decode() for name, file in made.items()}
    return "\n".join(
        f'<p><img class="plot" alt="{PLOTS[name]}" src="data:image/png;base64,{data}"></p>'
        for name, data in shown.items()
    )


def page(folder: Path, results: Results, made: dict) -> str:
    data = {
        "columns": list(COLUMNS),
        "rows": lines(results),
        "scenes": [scene_data(folder, results, made, scene) for scene in results.scenes],
    }
    first, *others = (html.escape(name) for name in results.methods)
    stronger = report.stronger(results).replace("`", "")
    introduction = (
        f"<p>{first} beside {', '.join(others)} in {len(results.scenes)} scenes, "
        f"{len(results.rows)} renders. Efficiency is 1 / (seconds · relMSE); ratios are medians "
        f"(smallest to largest) over renders with the same seed at {results.deciding} samples per pixel of "
        f"{first}, trimmed of the worst 0.1 % of values, over {stronger}.</p>"
    )
    parts = {
        "TITLE": f"{TITLE} {html.escape(folder.resolve().name)}",
        "INTRODUCTION": introduction,
        "ANSWERS": answers(results),
        "PLOTS": plots(results),
        "MACHINE": html.escape(report.machine(results)),
        # Only "</" could end a script element.
        "DATA": json.dumps(data, allow_nan=False).replace("</", "<\\/"),
    }
    text = FRAME.read_text()
    for name, part in parts.items():
        text = text.replace(f"@{name}@", part)
    return text


def run(options: Namespace) -> int:
    """Write the page that the command-line ``options`` request."""
    project = Project(options.project)
    folder = project.results(options.folder)
    output = options.output or folder / "page.html"
    check_output(output, ".html")
    check_own(output, f"<title>{TITLE}", "move it away, or name another output by -o")
    text = page(folder, *report.load(project, folder))
    write_text(output, text)
    print(f"{output}: {len(text) / 2**20:.1f} MiB")
    return 0
