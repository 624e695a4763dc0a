"""The README and the pages of docs/ agree with the repository."""

import re
from pathlib import Path

import pytest
from mitsuba_bdpt import settings

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    """Rationale: the site checks links between its pages, but not those to source, tests and scenes, which it
    does not have. Expected: every relative link of a page leads to a file or a folder of the repository."""
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_the_page_of_the_parameters_is_made_from_them():
    """Expected: docs/user/parameters.md has the table of `settings` between its markers."""
    page = (ROOT / "docs" / "user" / "parameters.md").read_text()
    found = re.search(r"<!-- report: parameters -->\n(.*)<!-- end -->", page, re.DOTALL)[1]
    assert found.strip() == settings.table().strip()


def test_the_readme_is_short():
    """Expected: 120 lines at most; the rest is in docs/."""
    assert (ROOT / "README.md").read_text().count("\n") <= 120
