"""What contributors and reporters are asked to run exists."""

import contextlib
import re
import shlex
from pathlib import Path

import pytest
import yaml
from mitsuba_bdpt.cli.arguments import build_parser

ROOT = Path(__file__).resolve().parents[2]
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")), *FORMS]


def test_each_commit_is_checked_as_by_make_lint():
    """Rationale: hooks with versions of their own judge otherwise than the check of each change. Expected:
    the hooks are the commands of `make lint`, in the environment that it makes."""
    recipe = re.search(r"^lint: .*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)[1]
    commands = [line.strip().replace("$(VENV)", ".venv") for line in recipe.splitlines()]
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert [hook["entry"] for hook in hooks] == commands


COMMAND = r"(?:python -m mitsuba_bdpt|mitsuba-bdpt) "


def commands(text):
    """The command lines of a page: lines of their own, and in backquotes with an option or a scene."""
    text = re.sub(r" *\\\n *", " ", text)
    lines = re.findall(rf"^ +(?:\$ )?{COMMAND}([^#\n]*)", text, re.MULTILINE)
    quoted = re.findall(rf"`{COMMAND}([^`\n]* [^`\n]*)`", text)
    return [line.strip() for line in [*lines, *quoted] if not re.search(r"\.\.\.|…|[A-Z]{3}|\$", line)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_in_documents_are_understood(page):
    """Rationale: options are renamed, and pages keep the old names. Expected: the parser accepts every
    command of a page; those with placeholders (`SCENE`, `...`) are left out."""
    parser = build_parser()
    for line in commands(page.read_text()):
        with contextlib.suppress(SystemExit) if line.endswith("--help") else contextlib.nullcontext():
            parser.parse_args(shlex.split(line))
