"""Writes a sweep as one HTML file that needs neither network nor server.

For each scene: the first integrator's efficiency over `path`, images of the seeds with the median trimmed
error (half precision, divider, exposure control), and error maps. Then a table of all renders, and the report
with its plots. The template is page.html.
"""

from __future__ import annotations

import base64
import re
import tempfile
from argparse import Namespace
from pathlib import Path

import numpy as np
import pandas as pd
from jinja2 import Template
from markdown_it import MarkdownIt
from markupsafe import Markup

from ..files.images import check_output
from ..files.texts import write_text
from ..files.whole import check_own
from . import figures
from .analysis import Results, Unavailable
from .estimates import KINDS
from .metrics import exposure_of
from .project import Project
from .reference import HALF_MAX
from .report import Report

TITLE = "mitsuba-bdpt: sweep"  # begins the title of every page

FRAME = Path(__file__).with_suffix(".html")

COLUMNS = {
    "scene": "scene",
    "integrator": "method",
    "budget": "budget",
    "renders": "renders",
    "samples per pixel": "spp",
    "seconds": "seconds",
    "relMSE, trimmed": "rel_mse_trimmed",
    "relMSE, raw": "rel_mse",
    "HDR-FLIP": "flip",
    "ΔE ITP": "delta_e_itp",
}


def answers(results: Results) -> dict[str, str]:
    """Return efficiencies over the strongest path tracers as texts, best first."""
    found: dict[str, tuple[float, str]] = {}
    for scene in results.scenes:
        lacks = results.path_lacks(scene)
        added = f"; the bias check fails, {lacks}" if lacks else ""
        try:
            ratio, over = results.against_path(scene), " and ".join(results.present(scene, results.standard))
        except Unavailable as why:
            found[scene] = -1.0, f"{why}{added}"
        else:
            found[scene] = ratio.median, f"efficiency over {over}: {ratio}{added}"
    return {scene: found[scene][1] for scene in sorted(found, key=found.__getitem__, reverse=True)}


def encoded(image: np.ndarray) -> str:
    """Encode an image as base64 of half precision, as the page decodes it."""
    half = np.minimum(image, HALF_MAX).astype("<f2")
    return base64.b64encode(half.tobytes()).decode()


def scene_data(folder: Path, results: Results, made: dict, scene: str, words: str) -> dict:
    """Return a scene's images by name, captions and size."""
    target = made[scene].image
    found = figures.shots(folder, results, scene, results.methods)
    return {
        "name": scene,
        "width": target.shape[1],
        "height": target.shape[0],
        "mean": float(target.mean()),
        "exposure": round(4 * exposure_of(target)) / 4,
        "images": {shot.name: encoded(shot.image) for shot in found} | {"reference": encoded(target)},
        "figures": {shot.name: shot.caption.replace("\n", ", ") for shot in found},
        "words": words,
    }


def lines(results: Results) -> list[list]:
    """Return the table's lines: relMSE as in reports, [number, bound] where it is one.

    Over seeds the mean of errors, and the median of samples and seconds.
    """
    averages = dict.fromkeys(["spp", "seconds"], "median")
    averages |= dict.fromkeys(["flip", "delta_e_itp"], "mean")
    groups = results.rows.groupby(["scene", "method", "budget"])
    found = groups.agg(averages).assign(renders=groups.size()).astype({"spp": int})
    for kind in KINDS:
        errors = [results.error(scene, method, kind, budget) for scene, method, budget in found.index]
        cells = [[one.total.value, one.bound] if one.bound else one.total.value for one in errors]
        found[kind] = pd.Series(cells, found.index, object)
    order = {name: i for i, name in enumerate([*results.scenes, *results.methods])}
    found = found.sort_index(key=lambda level: level.map(lambda name: order.get(name, name))).reset_index()
    return found[list(COLUMNS.values())].astype(object).where(found.notna(), None).to_numpy().tolist()


def reported(report: Report) -> str:
    """Return the report as HTML, without its title, with its plots."""
    text = report.text().partition("\n")[2]
    with tempfile.TemporaryDirectory() as folder:
        report.draw(Path(folder))

        def embedded(found: re.Match) -> str:
            data = base64.b64encode((Path(folder) / found[1]).read_bytes()).decode()
            return f'class="plot" src="data:image/png;base64,{data}"'

        return re.sub(r'src="(\w+\.png)"', embedded, MarkdownIt().enable("table").render(text))


def filled(**parts: object) -> str:
    """Return the template filled with ``title``, ``answers``, ``report`` and ``data``."""
    template = Template(FRAME.read_text(encoding="utf-8"), autoescape=True, trim_blocks=True)
    return template.render(parts)


def page(folder: Path, report: Report) -> str:
    results, words = report.results, answers(report.results)
    scenes = [scene_data(folder, results, report.made, scene, words[scene]) for scene in results.scenes]
    return filled(
        title=f"{TITLE} {folder.resolve().name}",
        answers=words,
        report=Markup(reported(report)),
        data={"columns": list(COLUMNS), "rows": lines(results), "scenes": scenes},
    )


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
