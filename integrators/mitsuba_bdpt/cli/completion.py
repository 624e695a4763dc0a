"""``python -m mitsuba_bdpt completion``: a script with which a shell completes the command's words."""

from __future__ import annotations

import argparse
import sys


def run(shell: str, parser: argparse.ArgumentParser) -> int:
    """Print the script for this ``shell`` and return the exit status."""
    try:
        import shtab
    except ImportError:
        print("error: completion needs shtab; install it with: pip install shtab", file=sys.stderr)
        return 2
    parser.prog = "mitsuba-bdpt"
    print(shtab.complete(parser, shell))
    return 0
