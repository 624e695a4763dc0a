"""Hooks of mkdocs.yml: the pages that are not files of docs/.

The README is the first page, the tutorial's cells become a page, and each module of the package has a page of
its docstrings. Links to the source of a module lead to that page, and those to tests, which the site does not
have, become plain text.
"""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "integrators" / "mitsuba_bdpt"


def readme() -> str:
    """The first page: links from the top of the repository become links from docs/."""
    text = (ROOT / "README.md").read_text()
    text = re.sub(r"\]\(docs/", "](", text)
    return re.sub(r"\]\((?=(integrators|scripts|scenes|references|tests)\b)", "](../", text)


def tutorial() -> str:
    """The cells of docs/user/tutorial.py: prose and code in turn."""
    cells = re.split(r"^# %%", (ROOT / "docs" / "user" / "tutorial.py").read_text(), flags=re.MULTILINE)[1:]
    parts = []
    for cell in cells:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            parts.append("\n".join(line.removeprefix("#").removeprefix(" ") for line in body.splitlines()))
        else:
            parts.append(f"```python\n{body.strip()}\n```")
    return "\n\n".join(parts) + "\n"


def module(path: Path) -> str:
    """The page of a module."""
    name = ".".join(["mitsuba_bdpt", *path.relative_to(PACKAGE).with_suffix("").parts])
    return f"# {path.stem}\n\n::: {name.removesuffix('.__init__')}\n"


def on_files(files, config):
    """Add the pages."""
    pages = {"index.md": readme(), "tutorial.md": tutorial()}
    paths = [
        path
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.stem == "__init__" or not path.stem.startswith("_")
    ]
    paths = [path for path in paths if path.stem != "__init__" or path.parent == PACKAGE]
    pages |= {
        f"api/{path.relative_to(PACKAGE).with_suffix('')}.md".replace("__init__", "init"): module(path)
        for path in paths
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Lead links to source files to the pages of their docstrings, and those to the tutorial to its page."""
    markdown = markdown.replace("](tutorial.py)", "](tutorial.md)")
    up = "../" * page.file.src_uri.count("/")

    def replaced(match):
        text, target = match[1], match[2]
        if found := re.fullmatch(r"(?:\.\./)+integrators/mitsuba_bdpt/([\w/]+)\.py", target):
            return f"[{text}]({up}api/{found[1]}.md)"
        return text

    return re.sub(
        r"(?<!!)\[([^\]]*)\]\(((?:\.\./)+(?:integrators|tests|scripts|scenes|references)[^)]*)\)",
        replaced,
        markdown,
    )
