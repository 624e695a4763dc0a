"""What is published says the same everywhere."""

import re
import tomllib
from pathlib import Path

import mitsuba_bdpt

ROOT = Path(__file__).parents[2]


def test_version_has_one_home():
    """Expected: CITATION.cff and the newest release in CHANGELOG.md name the package's version. What
    is to come, under "Unreleased", has none."""
    citation = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    newest = re.search(r"^## (?!Unreleased$)(\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert citation[1] == newest[1] == mitsuba_bdpt.__version__


def test_extras_have_the_same_bounds():
    """Rationale: a package that two extras name with different bounds was tested with neither. Expected: one
    requirement per name."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    found = {}
    for requirement in {text for texts in extras.values() for text in texts}:
        found.setdefault(re.match(r"[\w-]+", requirement)[0], []).append(requirement)
    assert all(len(texts) == 1 for texts in found.values()), found
