"""docs/user/tutorial.ipynb: the cells of docs/user/tutorial.py, run, with what they print and show.

python scripts/make_notebook.py             # some minutes
python scripts/make_notebook.py --check     # whether its cells are those of the script
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

SCRIPT = Path(__file__).resolve().parents[1] / "docs" / "user" / "tutorial.py"
NOTEBOOK = SCRIPT.with_suffix(".ipynb")


def cells(text: str) -> list[tuple[str, str]]:
    """Kind (``markdown`` or ``code``) and source of the cells of a script whose cells begin with ``# %%``."""
    found = []
    for cell in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            lines = [line.removeprefix("#").removeprefix(" ") for line in body.strip().splitlines()]
            found.append(("markdown", "\n".join(lines)))
        else:
            found.append(("code", body.strip()))
    return found


def notebook() -> nbformat.NotebookNode:
    """The script as a notebook that was not run."""
    new = {"markdown": nbformat.v4.new_markdown_cell, "code": nbformat.v4.new_code_cell}
    made = nbformat.v4.new_notebook()
    made.cells = [new[kind](source) for kind, source in cells(SCRIPT.read_text())]
    for number, cell in enumerate(made.cells):
        cell.id = f"cell-{number}"  # the same each time
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    made.metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return made


def run(made: nbformat.NotebookNode, timeout: float = 1800) -> nbformat.NotebookNode:
    """Run all cells in a kernel, which starts where the notebook lies; raises what a cell raises."""
    client = NotebookClient(made, timeout=timeout, resources={"metadata": {"path": str(NOTEBOOK.parent)}})
    client.execute()
    for cell in made.cells:
        cell.metadata.pop("execution", None)  # clock times
    return made


def main(arguments=None) -> int:
    """Write the notebook, or tell whether it is that of the script."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--check", action="store_true", help="compare the cells, run nothing")
    if parser.parse_args(arguments).check:
        there = [(cell.cell_type, cell.source) for cell in nbformat.read(NOTEBOOK, 4).cells]
        if there != cells(SCRIPT.read_text()):
            print(
                f"{NOTEBOOK.name} is not that of {SCRIPT.name}: python scripts/make_notebook.py",
                file=sys.stderr,
            )
            return 1
        return 0
    nbformat.write(run(notebook()), NOTEBOOK)
    return 0


if __name__ == "__main__":
    sys.exit(main())
