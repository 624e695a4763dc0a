"""Hooks of mkdocs.yml: the pages that are not Markdown files of docs/.

The README is the first page, CONTRIBUTING.md and CHANGELOG.md are pages too, and so are the tutorial's cells.
A comment `<!-- api: CLASS MEMBER ... -->` is replaced by the docstrings of that class of the package, read
without importing it. Links to files that the site does not have (source, tests, scenes) become plain text.
Equations become MathML, so that pages need no script and no other site.
"""

from __future__ import annotations

import ast
import html
import json
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "integrators" / "mitsuba_bdpt"

# Files at the top of the repository that are pages of the site.
TOP = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}

# A link to what the site does not have, up from docs/ or at the top of the repository.
ELSEWHERE = r"(?:(?:\.\./)+|(?=LICENSE|CITATION))"
FOLDERS = r"(?:integrators|tests|scripts|scenes|references|presets|LICENSE|CITATION|Makefile|pyproject)"
OUTSIDE = re.compile(rf"(?<!!)\[([^\]]*)\]\({ELSEWHERE}{FOLDERS}\b[^)]*\)")

# What pymdownx.arithmatex makes of equations in the text and of those on lines of their own.
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)

# Characters in a line of code; longer calls have a line for each argument.
CODE_WIDTH = 80

API = re.compile(r"<!-- api: (\w+)((?: \w+)*) -->")


def top(name: str) -> str:
    """Return a file of the top of the repository as a page: its links lead from docs/."""
    text = re.sub(r"\]\(docs/", "](", (ROOT / name).read_text())
    for file, page in TOP.items():
        text = text.replace(f"]({file})", f"]({page})")
    return re.sub(rf"\]\((?={FOLDERS}\b)", "](../", text)


def tutorial() -> str:
    """Return the cells of docs/user/tutorial.ipynb: prose, code, and what it prints and shows."""
    parts = []
    for cell in json.loads((ROOT / "docs/user/tutorial.ipynb").read_text())["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            if text := "".join(output.get("text", ())).rstrip():
                parts.append(f"```text\n{text}\n```")
            if image := output.get("data", {}).get("image/png"):
                parts.append(f"![what the cell shows](data:image/png;base64,{image.strip()})")
    return "\n\n".join(parts) + "\n"


def found_class(name: str) -> ast.ClassDef:
    """Return the class of that name, wherever the package defines it; ``ValueError`` if it does not."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and node.name == name:
                return node
    raise ValueError(f"the package has no class {name}, of which a page of docs/ shows the docstrings")


def signature(method: ast.FunctionDef) -> str:
    """Return the call of a method as code, or the name of a property, with the type of the result."""
    result = f" -> {ast.unparse(method.returns)}" if method.returns else ""
    if any(isinstance(d, ast.Name) and d.id == "property" for d in method.decorator_list):
        return method.name + result
    arguments = re.sub(r"^(self|cls)(, )?", "", ast.unparse(method.args))
    call = f"{method.name}({arguments}){result}"
    if len(call) > CODE_WIDTH:
        arguments = re.sub(r", (?=\*?\w+(?::|=|$))", ",\n    ", arguments)
        call = f"{method.name}(\n    {arguments},\n){result}"
    return call


def documented(node: ast.ClassDef) -> str:
    """Return the docstring of a class, with its attributes as a list that has their types."""
    types = {
        ast.unparse(n.target): ast.unparse(n.annotation) for n in node.body if isinstance(n, ast.AnnAssign)
    }
    text, _, attributes = ast.get_docstring(node).partition("\n\nAttributes:\n")
    told = dict(re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", attributes, re.MULTILINE))
    lines = [
        f"* `{name}: {kind}`" + (f": {' '.join(told[name].split())}" if name in told else "")
        for name, kind in types.items()
    ]
    return "\n\n".join([text, "\n".join(lines)])


def described(match: re.Match) -> str:
    """Return the docstrings of a class, or of those of its members that an `API` comment names."""
    node, members = found_class(match[1]), match[2].split()
    methods = {n.name: n for n in node.body if isinstance(n, ast.FunctionDef)}
    if missing := [name for name in members if name not in methods]:
        raise ValueError(f"{node.name} has no method {missing[0]}, whose docstring a page of docs/ shows")
    if not members:
        members = [name for name in methods if not name.startswith("_")]
    has_fields = any(isinstance(n, ast.AnnAssign) for n in node.body)
    parts = [documented(node)] if has_fields and ast.get_docstring(node) else []
    for name in members:
        text = ast.get_docstring(methods[name])
        if text is None:
            raise ValueError(f"{node.name}.{name} has no docstring, which a page of docs/ shows")
        parts.append(f"### {name}\n\n```python\n{signature(methods[name])}\n```\n\n{text}")
    return "\n\n".join(parts)


def on_files(files, config):
    """Add the pages."""
    pages = {page: top(name) for name, page in TOP.items()} | {"user/tutorial.md": tutorial()}
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Insert docstrings, lead links to the tutorial to its page, and take off those that lead nowhere."""
    markdown = API.sub(described, markdown)
    markdown = re.sub(r"\]\(((?:[\w./]*/)?)tutorial\.(?:ipynb|py)\)", r"](\1tutorial.md)", markdown)
    markdown = re.sub(r"\]\((?:\.\./)+(CONTRIBUTING|CHANGELOG)\.md\)", _top_page(page), markdown)
    return OUTSIDE.sub(r"\1", markdown)


def on_page_content(content, page, config, files):
    """Set the equations."""
    return EQUATION.sub(_set, content)


def _set(match: re.Match) -> str:
    """Return an equation in TeX as MathML; one on a line of its own in a frame that may be scrolled."""
    display = "block" if match[1] == "div" else "inline"
    set_ = convert(html.unescape(match[2]).strip(), display=display)
    return f'<div class="equation">{set_}</div>' if display == "block" else set_


def _top_page(page):
    """Return the replacement of a link to a file at the top of the repository, as seen from a ``page``."""
    up = "../" * page.file.src_uri.count("/")
    return lambda match: f"]({up}{TOP[match[1] + '.md']})"
