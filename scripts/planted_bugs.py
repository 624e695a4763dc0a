"""Plants bugs in a copy of the package, one at a time, and checks that the tests see them.

    python scripts/planted_bugs.py                  # all, half an hour on two cores
    python scripts/planted_bugs.py hidden adjoint   # those with such a word in their name

Each test that is named beside a bug runs against the copy, in a process of its own, and has to fail by an
assertion: one that fails by anything else shows that the bug is not the one that was meant. The exit status
is 1 if a test did not do what it should, and 2 if the text to replace is not in the module once (the code has
changed: plant the bug anew).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import command_line
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.errors import CommandError

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "integrators" / "mitsuba_bdpt"
ASSERTION = re.compile(r"^E +(assert |AssertionError|Failed: DID NOT)", re.MULTILINE)
PASSED, FAILED = 0, 1  # exit statuses of pytest


@dataclass(frozen=True)
class PlantedBug:
    """A planted bug.

    ``old`` stands exactly once in the module ``file``; with ``new`` in its place each of ``tests`` (names
    that pytest takes) must fail.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


BUGS = tuple(
    PlantedBug(**entry | {"tests": tuple(entry["tests"])})
    for file in sorted((ROOT / "tests" / "planted_bugs").glob("*.toml"))
    for entry in tomllib.loads(file.read_text())["bug"]
)
"""Bugs of weights, densities, estimators and decisions."""


def planted(folder: Path, bug: PlantedBug) -> Path:
    """Copy the package into ``folder``, with the bug; return what PYTHONPATH begins with.

    Raises ``CommandError`` if the text to replace is not there once.
    """
    package = folder / PACKAGE.name
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    file = package / bug.file
    text = file.read_text()
    if (count := text.count(bug.old)) != 1:
        raise CommandError(
            f"planted bug {bug.name}: {bug.old!r} stands {count} times in {bug.file}, not once; plant it anew"
        )
    file.write_text(text.replace(bug.old, bug.new))
    return folder


def outcome(folder: Path, test: str) -> tuple[int, str]:
    """Exit status and words of pytest on ``test`` with the package in ``folder``."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT / "scripts")])}
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-m", "", test]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def judged(status: int, output: str) -> str:
    """What is wrong with this outcome of a test, empty if nothing is."""
    if status not in (PASSED, FAILED):
        return "not run:\n" + output[-1500:]
    if status == PASSED:
        return "does not see the bug"
    return "" if ASSERTION.search(output) else "fails by something else:\n" + output[-1500:]


def chosen(words: list[str]) -> list[PlantedBug]:
    """Bugs with one of these words in their name, all of them if there is no word."""
    for word in words:
        if not any(word in bug.name for bug in BUGS):
            raise CommandError(f"no planted bug has {word!r} in its name; see tests/planted_bugs")
    return [bug for bug in BUGS if not words or any(word in bug.name for word in words)]


def run(bugs: list[PlantedBug]) -> int:
    """Print a line for each test, on all cores; return the number of those that did not do as they should."""

    def fault(pair: tuple[PlantedBug, str]) -> str:
        bug, test = pair
        with tempfile.TemporaryDirectory(prefix="planted-bug-") as folder:
            return judged(*outcome(planted(Path(folder), bug), test))

    pairs = [(bug, test) for bug in bugs for test in bug.tests]
    wrong = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for (bug, test), found in zip(pairs, pool.map(fault, pairs), strict=True):
            wrong += bool(found)
            print(f"{bug.name}: {test} {found or 'sees it'}", flush=True)
    return wrong


def main(arguments=None) -> int:
    """Run the tests of the bugs, or print these."""
    parser = command_line.parser(__doc__)
    parser.add_argument("words", nargs="*", help="only bugs with one of these words in their name")
    bugs = chosen(parser.parse_args(arguments).words)
    wrong = run(bugs)
    tests = sum(len(bug.tests) for bug in bugs)
    print(f"{len(bugs)} bugs, {tests} tests: {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(answered(main))
