"""The README and the pages of docs/ agree with the repository."""

import json
import re
from pathlib import Path

import pytest
from mitsuba_bdpt import settings
from mitsuba_bdpt.cli.arguments import build_parser
from mitsuba_bdpt.cli.values import property_

import mitsuba as mi  # isort: skip (after mitsuba_bdpt, which chooses the LLVM library)

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]


def anchors(page):
    """The anchors that GitHub gives to the headings of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    """As GitHub names anchors, and tests by their names; `make docs` checks the links of the site."""
    missing = []
    for link, title in re.findall(r'\]\(([^)\s]+)(?: "([^"]*)")?\)', page.read_text()):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if "://" not in link and not (target.is_file() and (not anchor or anchor in anchors(target))):
            missing.append(link)
        elif path.endswith(".py") and title not in target.read_text():
            missing.append(f"{link} {title}")
    assert not missing


def test_the_page_of_the_parameters_is_made_from_them():
    page = (ROOT / "docs" / "user" / "parameters.md").read_text()
    found = re.search(r"<!-- report: parameters -->\n(.*)<!-- end -->", page, re.DOTALL)[1]
    assert found.strip() == settings.table().strip()


TABLES = ROOT / "docs" / "user" / "coming_from.md"
NAMES = {"path", "bdpt"}  # integrators, beside parameters


def test_parameters_named_for_newcomers_exist():
    """In the last column every name is a parameter, every `name=value` loads, every option is `render`'s."""
    mi.set_variant("llvm_ad_rgb")
    cells = re.findall(r"^\|.*\| (.*) \|$", TABLES.read_text(), re.MULTILINE)
    spans = [span for cell in cells for span in re.findall(r"`([^`]+)`", cell)]
    named = set()
    for span in spans:
        if span.startswith("-"):
            build_parser().parse_args(["render", "scene.xml", *span.split()])
        elif "=" in span:
            name, value = property_(span)
            mi.load_dict({"type": "bdpt", "max_depth": 6, name: value})
            named.add(name)
        elif re.fullmatch(r"\w+", span):
            assert span in settings.PARAMETERS or span in NAMES, span
            named.add(span)
    assert len(named & settings.PARAMETERS.keys()) >= 10


def test_the_menu_for_blender_has_our_parameters():
    page = (ROOT / "docs" / "user" / "blender.md").read_text()
    text = re.search(r"```json\n(.*?)```", page, re.DOTALL)[1]
    kinds = {int: "integer", float: "float", bool: "boolean"}
    for name, entry in json.loads(f"{{{text}}}")["bdpt"]["parameters"].items():
        parameter = settings.PARAMETERS[name]
        assert (entry["type"], entry["default"]) == (kinds[parameter.kind], parameter.default)
        assert entry.get("min", parameter.low) == parameter.low or parameter.kind is not int
