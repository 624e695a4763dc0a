"""What contributors and reporters are asked to run exists."""

import contextlib
import re
import shlex
from pathlib import Path

import pytest
from mitsuba_bdpt.cli.arguments import build_parser

ROOT = Path(__file__).resolve().parents[2]
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")), *FORMS]


COMMAND = r"(?:python -m mitsuba_bdpt|mitsuba-bdpt) "


def commands(text):
    """The command lines of a page: lines of their own, and in backquotes with an option or a scene."""
    text = re.sub(r" *\\\n *", " ", text)
    lines = re.findall(rf"^ +(?:\$ )?{COMMAND}([^#\n]*)", text, re.MULTILINE)
    quoted = re.findall(rf"`{COMMAND}([^`\n]* [^`\n]*)`", text)
    return [line.strip() for line in [*lines, *quoted] if not re.search(r"\.\.\.|…|[A-Z]{3}|\$", line)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_in_documents_are_understood(page):
    """Commands with placeholders (`SCENE`, `...`) are left out."""
    parser = build_parser()
    for line in commands(page.read_text()):
        with contextlib.suppress(SystemExit) if line.endswith("--help") else contextlib.nullcontext():
            parser.parse_args(shlex.split(line))
