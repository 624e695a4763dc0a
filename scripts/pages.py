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

import repository
from goals import goals_table
from mitsuba_bdpt.measure.report import PARTS, Report
from mitsuba_bdpt.measure.tables import replace_part

REPORTS = repository.ROOT / "docs" / "reports"


@cache
def benchmark() -> Report:
    """The report of docs/reports/benchmark."""
    return Report.of(repository.PROJECT, REPORTS / "benchmark")


def _recorded(name: str, table: str) -> str:
    """The ``table`` of a script, of its record in docs/reports."""
    record = json.loads((REPORTS / f"{name}.json").read_text())
    return getattr(__import__(name), table)(record)


def _whole() -> str:
    _, _, text = benchmark().text().partition("\n")  # without its title, which the page has
    return text


TABLES: dict[str, Callable[[], str]] = {
    **{name: lambda part=part: part(benchmark()) for name, part in PARTS.items()},
    "goals": lambda: goals_table(benchmark().results),
    "benchmark": _whole,
    "scale": partial(_recorded, "scale", "tables"),
    "scale goals": partial(_recorded, "scale", "goals"),
    "stress": partial(_recorded, "stress", "summary"),
    "cases": partial(_recorded, "stress", "tables"),
    "choices": partial(_recorded, "choices", "choices_table"),
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
