"""The most that each subpackage may weigh: a change that needs more takes it from another one.

The aims are 24,600 lines of package, 4,300 of scripts, 28,000 of tests and 32,000 words. The package has
1,330 more and scripts as many less: sweeps with a time limit, comparisons in a browser, conditions of
measurements, clusters and `doctor` stay, while tools of the repository alone went.
"""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "integrators" / "mitsuba_bdpt"

# Most lines of `*.py`, docstrings included, by folder.
MOST = {
    "measure": 5089,
    "transport merging guided_emission": 5877,
    "planning": 1730,
    "emitters": 2182,
    "cli": 1434,
    "media": 1346,
    "geometry": 1414,
    "image": 1297,
    "files": 845,
    "run": 1092,
    "scene sampling": 795,
    "host": 807,
    "sensors": 881,
    "": 1269,  # top files
}
OUTSIDE = {"scripts": 2839, "tests": 28606}
MOST_WORDS = 31198


def _lines(files):
    return sum(len(file.read_text().splitlines()) for file in files)


@pytest.mark.parametrize("folders", MOST)
def test_subpackages_keep_their_weight(folders):
    if folders:
        files = [file for folder in folders.split() for file in (PACKAGE / folder).rglob("*.py")]
    else:
        files = [*PACKAGE.glob("*.py"), *PACKAGE.parent.glob("*.py")]
    assert _lines(files) <= MOST[folders]


def test_every_subpackage_has_a_limit():
    limited = {folder for folders in MOST for folder in folders.split()}
    assert limited == {path.parent.name for path in PACKAGE.glob("*/__init__.py")}


@pytest.mark.parametrize("folder", OUTSIDE)
def test_scripts_and_tests_keep_their_weight(folder):
    assert _lines((ROOT / folder).rglob("*.py")) <= OUTSIDE[folder]


def test_documents_keep_their_weight():
    files = [file for file in ROOT.rglob("*.md") if file.relative_to(ROOT).parts[0] in ("docs", file.name)]
    assert sum(len(file.read_text().split()) for file in files) <= MOST_WORDS
