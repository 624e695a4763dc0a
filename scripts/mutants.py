"""Plants bugs in a copy of the package, one at a time, and checks that the tests see them.

    python scripts/mutants.py                  # all, an hour
    python scripts/mutants.py hidden adjoint   # those with such a word in their name
    python scripts/mutants.py --list           # what is replaced by what
    python scripts/mutants.py --unchanged      # the same tests on a copy without bugs: they have to pass

Each test that is named beside a mutant runs against the copy, in a process of its own, and has to fail by an
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
class Mutant:
    """A planted bug.

    ``old`` stands exactly once in the module ``file``; with ``new`` in its place each of ``tests`` (names
    that pytest takes) must fail.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTANTS = tuple(
    Mutant(**bug | {"tests": tuple(bug["tests"])})
    for file in sorted((ROOT / "tests" / "planted_bugs").glob("*.toml"))
    for bug in tomllib.loads(file.read_text())["bug"]
)
"""Bugs of weights, densities, estimators and decisions."""


def planted(folder: Path, mutant: Mutant | None) -> Path:
    """Copy the package into ``folder``, with the bug if there is one; return what PYTHONPATH begins with.

    Raises ``CommandError`` if the text to replace is not there once.
    """
    package = folder / PACKAGE.name
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    if mutant is not None:
        file = package / mutant.file
        text = file.read_text()
        if (count := text.count(mutant.old)) != 1:
            raise CommandError(
                f"mutant {mutant.name}: {mutant.old!r} stands {count} times in {mutant.file}, not once; "
                "plant it anew"
            )
        file.write_text(text.replace(mutant.old, mutant.new))
    return folder


def outcome(folder: Path, test: str) -> tuple[int, str]:
    """Exit status and words of pytest on ``test`` with the package in ``folder``."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT / "scripts")])}
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-m", "", test]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def judged(status: int, output: str, bug: bool) -> str:
    """What is wrong with this outcome of a test, empty if nothing is; ``bug``: there is one to be seen."""
    if status not in (PASSED, FAILED):
        return "not run:\n" + output[-1500:]
    if not bug:
        return "" if status == PASSED else "fails without the bug:\n" + output[-1500:]
    if status == PASSED:
        return "does not see the bug"
    return "" if ASSERTION.search(output) else "fails by something else:\n" + output[-1500:]


def chosen(words: list[str]) -> list[Mutant]:
    """Mutants with one of these words in their name, all of them if there is no word."""
    for word in words:
        if not any(word in mutant.name for mutant in MUTANTS):
            raise CommandError(
                f"no mutant has {word!r} in its name; there are {'; '.join(m.name for m in MUTANTS)}"
            )
    return [mutant for mutant in MUTANTS if not words or any(word in mutant.name for word in words)]


def run(mutants: list[Mutant], bug: bool) -> int:
    """Print a line for each test; the number of those that did not do what they should."""
    wrong = 0
    for mutant in mutants:
        for test in mutant.tests:
            with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
                where = planted(Path(folder), mutant if bug else None)
                fault = judged(*outcome(where, test), bug)
            wrong += bool(fault)
            seen = "sees it" if bug else "passes without it"
            print(f"{mutant.name}: {test} {fault or seen}", flush=True)
    return wrong


def main(arguments=None) -> int:
    """Run the tests of the mutants, or print these."""
    parser = command_line.parser(__doc__)
    parser.add_argument("words", nargs="*", help="only mutants with one of these words in their name")
    parser.add_argument("--list", action="store_true", help="print names and what is replaced, run nothing")
    parser.add_argument("--unchanged", action="store_true", help="run the same tests without the bugs")
    options = parser.parse_args(arguments)
    mutants = chosen(options.words)
    if options.list:
        for mutant in mutants:
            print(f"{mutant.name}: {mutant.file}: {mutant.old!r} -> {mutant.new!r}")
        return 0
    wrong = run(mutants, not options.unchanged)
    tests = sum(len(mutant.tests) for mutant in mutants)
    print(f"{len(mutants)} mutants, {tests} tests: {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(answered(main))
