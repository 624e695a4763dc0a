"""What is published says the same everywhere."""

import re
import tomllib
from pathlib import Path

import mitsuba_bdpt
import yaml
from mitsuba_bdpt.cli import measuring

ROOT = Path(__file__).parents[2]


def test_version_has_one_home():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    changes = (ROOT / "CHANGELOG.md").read_text()
    newest = re.search(r"^## (\S+) \((\d{4}-\d\d-\d\d)\)$", changes, re.MULTILINE)
    assert citation["version"] == newest[1] == mitsuba_bdpt.__version__
    assert str(citation["date-released"]) == newest[2]


def test_the_repository_has_one_address():
    """As in pyproject.toml, on GitHub and in Colab; and a file that it names on the branch main exists."""
    home = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]["Homepage"]
    files = [*ROOT.glob("*.*"), *ROOT.glob("docs/user/*"), *ROOT.glob(".github/*/*")]
    text = "\n".join(
        path.read_text() for path in files if path.suffix in (".md", ".py", ".cff", ".yml", ".toml")
    )
    github = re.findall(
        r"https://(?:github\.com|colab\.research\.google\.com/github)/([\w./-]*mitsuba-bdpt[\w./-]*)", text
    )
    assert len(github) >= 5
    for address in github:
        owner, name, *rest = address.rstrip(".").split("/")
        assert home.endswith(f"/{owner}/{name}"), address
        assert rest[:2] not in (["blob", "main"], ["tree", "main"]) or (ROOT / "/".join(rest[2:])).exists(), (
            address
        )


def test_links_of_the_description_lead_somewhere_from_any_page():
    """An index shows README.md, whose relative links the build replaces."""
    hooks = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]["hooks"]
    text = (ROOT / "README.md").read_text()
    for change in hooks["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(change["pattern"], change["replacement"], text)
    links = re.findall(r"\]\(([^)\s]+)", text)
    assert len(links) > 5 and all(re.match("https?://|#", link) for link in links)


def test_the_extra_of_measuring_is_what_is_looked_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    packages = [re.match(r"[\w-]+", text)[0] for text in project["optional-dependencies"]["measure"]]
    modules = {re.sub("_(science|py)$", "", name.replace("-", "_")) for name in packages}
    assert modules == set(measuring.NEEDED)
