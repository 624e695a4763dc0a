"""What is published says the same everywhere."""

import re
import tomllib
from pathlib import Path

import mitsuba_bdpt
from mitsuba_bdpt.cli import measuring

ROOT = Path(__file__).parents[2]


def test_version_has_one_home():
    """Expected: CITATION.cff and the newest release in CHANGELOG.md name the package's version. What
    is to come, under "Unreleased", has none."""
    citation = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    newest = re.search(r"^## (?!Unreleased$)(\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert citation[1] == newest[1] == mitsuba_bdpt.__version__


def test_each_package_is_required_once():
    """Rationale: a package that two extras name with different bounds was tested with neither. Expected:
    every package has one home among the dependencies, the extras and the dependency groups."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"] | project["dependency-groups"]
    lists = [project["project"]["dependencies"], *extras.values()]
    names = [re.match(r"[\w-]+", requirement)[0] for texts in lists for requirement in texts]
    assert len(names) == len(set(names)), sorted(names)


def test_the_extra_of_measuring_is_what_is_looked_for():
    """Expected: the modules that the commands look for are those of the packages of the extra `[measure]`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    packages = [re.match(r"[\w-]+", text)[0] for text in project["optional-dependencies"]["measure"]]
    modules = {re.sub("_(science|py)$", "", name.replace("-", "_")) for name in packages}
    assert modules == set(measuring.NEEDED)
