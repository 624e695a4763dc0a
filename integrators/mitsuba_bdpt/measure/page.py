"""Writes a sweep as one HTML file that needs neither network nor server.

For each scene: the first integrator's efficiency over `path`, images of the first seed at the deciding budget
(half precision, divider, exposure control), and error maps. Then a table of all renders, and the report with
its plots. The template is page.html.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
import tempfile
from argparse import Namespace
from pathlib import Path

import numpy as np
from markdown_it import MarkdownIt

from ..files.images import check_output, read_layers
from ..files.texts import write_text
from ..files.whole import check_own
from .analysis import NOTHING, Results, Unavailable
from .project import Project
from .reference import HALF_MAX
from .report import KINDS, Report
from .tables import brief, ratio

TITLE = "mitsuba-bdpt: sweep"
"""How the title of every page begins."""

FRAME = Path(__file__).with_suffix(".html")

BOUNDS = {
    "": ("", ""),
    "≥": ("at least ", "at most "),
    "≤": ("at most ", "at least "),
    "~": ("about ", "about "),
}
"""How an efficiency and its reciprocal are bounded, in words."""

COLUMNS = {
    "scene": "scene",
    "integrator": "method",
    "budget": "budget",
    "renders": None,
    "samples per pixel": "spp",
    "seconds": "seconds",
    "relMSE, trimmed": "rel_mse_trimmed",
    "relMSE, raw": "rel_mse",
    "MAPE": "mape",
    "HDR-FLIP": "flip",
    "ΔE ITP": "delta_e_itp",
}


def answer(results: Results, scene: str) -> tuple[float, str]:
    """Return the ratio over a scene's strongest path tracer, and a sentence about it.

    The ratio is infinite where path tracers find nothing, NaN where there is none.
    """
    rival = results.tracer(scene)
    lacks = results.path_lacks(scene)
    try:
        found = results.against_path(scene)
    except Unavailable as why:
        return math.nan, f"No figure: {str(why).rstrip('.')}."
    added = f" {rival} fails the bias check here: {lacks}." if lacks else ""
    least, most = BOUNDS[found.bound]
    if found.median >= 1:
        span = f"({ratio(found.smallest)[:-1]} to {ratio(found.largest)})"
        words = f"{rival} takes {least}{ratio(found.median)} the time for the same error {span}.{added}"
        return (math.inf if lacks == NOTHING else found.median), words
    span = f"({ratio(1 / found.largest)[:-1]} to {ratio(1 / found.smallest)})"
    words = f"{rival} is ahead: its efficiency is {most}{ratio(1 / found.median)} ours {span}.{added}"
    return found.median, words


def answers(results: Results) -> str:
    """Return the list of all scenes, by decreasing gain."""
    found = {scene: answer(results, scene) for scene in results.scenes}
    order = sorted(found, key=lambda scene: -1 if math.isnan(found[scene][0]) else found[scene][0])[::-1]
    items = [
        f'<li><a href="#scene-{scene}"><b>{scene}</b></a>: {html.escape(found[scene][1])}</li>'
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
        seconds = float(np.median([row["seconds"] for row in rows]))
        captions[method] = (
            f"{method}: {rows[0]['spp']} samples per pixel, {seconds:.3g} s, "
            f"relMSE {brief(results.error(scene, method))} (trimmed)"
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
        "words": answer(results, scene)[1],
    }


def lines(results: Results) -> list[list]:
    """Return the table's lines: relMSE as in reports, [number, bound] where it is one.

    Over seeds the mean of errors, and the median of samples and seconds.
    """
    found = []
    for scene in results.scenes:
        for method in results.methods:
            for budget in sorted({row["budget"] for row in results.of(scene, method)}):
                rows = results.of(scene, method, budget)
                line = [scene, method, budget, len(rows)]
                for column in list(COLUMNS.values())[len(line) :]:
                    if column in KINDS:
                        error = results.error(scene, method, column, budget)
                        line.append([error.total.value, error.bound] if error.bound else error.total.value)
                        continue
                    values = [row[column] for row in rows if row[column] is not None]
                    average = np.median if column in ("spp", "seconds") else np.mean
                    middle = float(average(values)) if values else math.nan
                    line.append(middle if math.isfinite(middle) else None)
                line[4] = int(line[4])
                found.append(line)
    return found


def reported(report: Report) -> str:
    """Return the report as HTML, without its title, with its plots."""
    text = report.text().partition("\n")[2]
    with tempfile.TemporaryDirectory() as folder:
        report.draw(Path(folder))

        def embedded(found: re.Match) -> str:
            data = base64.b64encode((Path(folder) / found[1]).read_bytes()).decode()
            return f'class="plot" src="data:image/png;base64,{data}"'

        return re.sub(r'src="(\w+\.png)"', embedded, MarkdownIt().enable("table").render(text))


def page(folder: Path, report: Report) -> str:
    results = report.results
    data = {
        "columns": list(COLUMNS),
        "rows": lines(results),
        "scenes": [scene_data(folder, results, report.made, scene) for scene in results.scenes],
    }
    parts = {
        "TITLE": f"{TITLE} {html.escape(folder.resolve().name)}",
        "ANSWERS": answers(results),
        "REPORT": reported(report),
        # Only "</" could end a script element.
        "DATA": json.dumps(data, allow_nan=False).replace("</", "<\\/"),
    }
    text = FRAME.read_text(encoding="utf-8")
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
    text = page(folder, Report.of(project, folder, options.spp))
    write_text(output, text)
    print(f"{output}: {len(text) / 2**20:.1f} MiB")
    return 0
