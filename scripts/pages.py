"""Tables of the documentation's pages, made of the data of the repository.

    python scripts/pages.py docs/reports/stress.md    # prints the page with its tables

The site of `make docs` has them. In the repository there is nothing between the lines `<!-- report: NAME -->`
and `<!-- end -->`.
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
import repository
import scale
import stress
from mitsuba_bdpt.measure.report import PARTS, Report
from mitsuba_bdpt.measure.tables import replace_part

REPORTS = repository.ROOT / "docs" / "reports"


@cache
def benchmark() -> Report:
    """The report of docs/reports/benchmark."""
    return Report.of(repository.PROJECT, REPORTS / "benchmark")


def _recorded(name: str, table: Callable[..., str]) -> str:
    """The ``table`` of the record of a script in docs/reports."""
    return table(json.loads((REPORTS / f"{name}.json").read_text()))


TABLES: dict[str, Callable[[], str]] = {
    **{name: lambda part=part: part(benchmark()) for name, part in PARTS.items()},
    "goals": lambda: goals.goals_table(benchmark().results),
    "benchmark": lambda: benchmark().text().partition("\n")[2],  # the page has the title
    "scale": partial(_recorded, "scale", scale.tables),
    "scale goals": partial(_recorded, "scale", scale.goals),
    "stress": partial(_recorded, "stress", stress.summary),
    "cases": partial(_recorded, "stress", stress.tables),
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
    print(filled(parser.parse_args(arguments).page.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
