"""The README and the pages of docs/ agree with the repository."""

import re
from pathlib import Path

import pytest
from mitsuba_bdpt import settings

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]


def anchors(page):
    """The anchors that GitHub gives to the headings of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    """Rationale: `make docs` checks the links of the site; GitHub forms anchors in another way, and shows
    pages that the site does not have. Expected: every relative link of a page leads to a file of the
    repository, and its anchor to a heading as GitHub names it."""
    missing = []
    for link in re.findall(r"\]\(([^)\s]+)[^)]*\)", page.read_text()):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if "://" not in link and not (target.is_file() and (not anchor or anchor in anchors(target))):
            missing.append(link)
    assert not missing


def test_the_page_of_the_parameters_is_made_from_them():
    """Expected: docs/user/parameters.md has the table of `settings` between its markers."""
    page = (ROOT / "docs" / "user" / "parameters.md").read_text()
    found = re.search(r"<!-- report: parameters -->\n(.*)<!-- end -->", page, re.DOTALL)[1]
    assert found.strip() == settings.table().strip()


MADE = ("docs/reports/", "CHANGELOG.md")
"""Pages made by scripts, and the one that grows by version."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_are_short(page):
    """Expected: fewer than 2,500 words, so that a page is read in a quarter of an hour; not of `MADE`."""
    words = re.findall(r"[A-Za-z0-9][^\s|]*", page.read_text())
    assert str(page.relative_to(ROOT)).startswith(MADE) or len(words) < 2500


def test_the_readme_is_short():
    """Expected: below 100 lines, and six parameters in its table; the rest is in docs/."""
    text = (ROOT / "README.md").read_text()
    assert text.count("\n") < 100
    assert len(set(re.findall(r"^\| `(\w+)` \| ", text, re.MULTILINE)) & settings.PARAMETERS.keys()) == 6


def test_the_readme_names_what_is_searched_for():
    """Expected: the field's words for what the package does, before the first command; beside every render
    that it shows the time and the memory that it takes."""
    text = (ROOT / "README.md").read_text()
    for words in ("Bidirectional path tracing", "SDS", "vertex merging", "photon mapping"):
        assert words in text[: text.index("## Install")]
    commands = re.findall(r"^    (?:make render|python -m mitsuba_bdpt) .*", text, re.MULTILINE)
    commands += re.findall(r"^print\(integrator.statistics\).*", text, re.MULTILINE)
    assert len(commands) >= 8
    assert not [line for line in commands if not re.search(r"\b\d+ (?:s|min|h), [\d.]+ GB", line)]
