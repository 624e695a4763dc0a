"""``python -m mitsuba_bdpt completion``: a script with which a shell completes the command's words."""

from __future__ import annotations

import argparse
import sys

from .mistakes import USAGE
from .render import say


def run(shell: str, parser: argparse.ArgumentParser) -> int:
    """Print the script for this ``shell`` and return the exit status."""
    try:
        import shtab
    except ImportError:
        print(
            "error: completion needs shtab; install it with: pip install 'mitsuba-bdpt[completion]'",
            file=sys.stderr,
        )
        return USAGE
    parser.prog = "mitsuba-bdpt"
    say(shtab.complete(parser, shell))
    return 0
