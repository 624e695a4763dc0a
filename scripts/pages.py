"""Tables of the documentation's pages, made of the data of the repository.

    python scripts/pages.py docs/reports/stress.md    # prints the page with its tables
    python scripts/pages.py docs/reports/public.md --results results/public

The site of `make docs` has them. In the repository there is nothing between the lines `<!-- report: NAME -->`
and `<!-- end -->`, but where the results of a page are not committed.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import choices
import goals
import gpu
import numpy as np
import pandas as pd
import peers
import repository
import scale
import stress
from mitsuba_bdpt.measure.analysis import Results
from mitsuba_bdpt.measure.report import Report, efficiency_table, formatted
from mitsuba_bdpt.measure.tables import markdown

REPORTS = repository.ROOT / "docs" / "reports"


@cache
def benchmark() -> Report:
    """The report of docs/reports/benchmark."""
    return Report.of(repository.PROJECT, REPORTS / "benchmark")


def _recorded(name: str, table: Callable[..., str]) -> str:
    """The ``table`` of the record of a script in docs/reports."""
    return table(json.loads((REPORTS / f"{name}.json").read_text()))


GALLERY, GALLERY_COLUMNS = "../images/gallery", 3  # relative to docs/reports/figures.md


def gallery(results: Results) -> str:
    """Images of all scenes, with the efficiency over the stronger `path`."""

    def figure(scene: str) -> str:
        lacks = results.path_lacks(scene)
        return f"{results.against_path(scene)}" + f"<br>{lacks}" * bool(lacks)

    cells = [
        f"![{scene}]({GALLERY}/{scene}.png)<br>`{scene}`<br>{formatted(figure, scene)}"
        for scene in results.scenes
    ]
    cells += [""] * (-len(cells) % GALLERY_COLUMNS)
    first, *rows = np.reshape(cells, (-1, GALLERY_COLUMNS)).tolist()
    return markdown(pd.DataFrame(rows, columns=first))


def replace_part(text: str, name: str, part: str) -> str:
    """Replace the text between the markers of ``name``; ``ValueError`` without them."""
    pattern = re.compile(rf"(<!-- report: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise ValueError(f"there must be one `<!-- report: {name} -->` with an `<!-- end -->`")
    return pattern.sub(lambda m: m[1] + "\n" + part + "\n" + m[2], text)


TABLES: dict[str, Callable[[], str]] = {
    "efficiency": lambda: efficiency_table(benchmark().results),
    "gallery": lambda: gallery(benchmark().results),
    "goals": lambda: goals.goals_table(benchmark().results),
    "benchmark": lambda: benchmark().text().partition("\n")[2],  # the page has the title
    "scale": partial(_recorded, "scale", scale.tables),
    "scale goals": partial(_recorded, "scale", goals.scale_table),
    "stress": partial(_recorded, "stress", stress.summary),
    "cases": partial(_recorded, "stress", stress.tables),
    "peers": partial(_recorded, "peers", peers.tables),
    "cuda": partial(_recorded, "cuda", gpu.page),
    "choices": partial(_recorded, "choices", choices.choices_table),
}


def filled(text: str) -> str:
    """Return the ``text`` of a page with its tables; ``KeyError`` for one that is not known."""
    for name in re.findall(r"^<!-- report: (.*?) -->\n<!-- end -->", text, re.MULTILINE):
        text = replace_part(text, name, TABLES[name]())
    return text


def main(arguments=None) -> int:
    """Print a page."""
    parser = argparse.ArgumentParser(description="Print a page with its tables.")
    parser.add_argument("page", type=Path)
    parser.add_argument("--results", type=Path, help="folder of a sweep of which its efficiencies are")
    options = parser.parse_args(arguments)
    text = options.page.read_text()
    if options.results:
        found = Report.of(repository.PROJECT, options.results).results
        text = replace_part(text, "efficiency", efficiency_table(found))
    print(filled(text), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
