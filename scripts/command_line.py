"""What the command lines of scripts share."""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable
from pathlib import Path


def parser(description: str | None) -> ArgumentParser:
    """A parser whose help begins with a script's docstring. Options are taken as whole words only."""
    return ArgumentParser(
        allow_abbrev=False, description=description, formatter_class=RawDescriptionHelpFormatter
    )


def make(description: str | None, name: str, make_all: Callable[[Path], None]) -> None:
    """Call ``make_all`` with the folder that the command line names, by default ``name`` of scenes/."""
    taking = parser(description)
    folder = Path(__file__).resolve().parents[1] / "scenes" / name
    taking.add_argument("folder", type=Path, nargs="?", default=folder, help="default: %(default)s")
    folder = taking.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    make_all(folder)
