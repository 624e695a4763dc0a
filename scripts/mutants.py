"""Plants bugs in a copy of the package, one at a time, and checks that the tests see them.

    python scripts/mutants.py                  # all, some minutes
    python scripts/mutants.py hidden adjoint   # those with such a word in their name

For each mutant the tests that are named beside it run against the copy; one at least has to fail. A suite
that has become blind to one of them is seen here. Exit status 1 if a bug is not seen.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "integrators" / "mitsuba_bdpt"


@dataclass(frozen=True)
class Mutant:
    """``old`` text of a module, which occurs once, its replacement, and the tests that see it."""

    name: str
    module: str
    old: str
    new: str
    tests: str


MUTANTS = (
    Mutant(
        "splats on hidden emitters",
        "connect",
        "        active &= y.si.shape.emitter() == dr.zeros(mi.EmitterPtr)\n",
        "        pass\n",
        "tests/test_plausible_bugs.py::test_light_on_a_hidden_lamp_is_not_splatted",
    ),
    Mutant(
        "what is in front of a lens",
        "cameras",
        "active=towards & on_lens & unhidden & within & inside",
        "active=towards & on_lens & within & inside",
        "tests/test_plausible_bugs.py::test_what_is_in_front_of_a_lens_hides_the_light_from_it",
    ),
    Mutant(
        "count of light subpaths",
        "kernel",
        "1.0 if batch.spread else sharing.lanes / batch.size",
        "1.0 if batch.spread else 1 / kernel.plan.served",
        "tests/test_plausible_bugs.py::test_splats_of_few_pixels_count_once",
    ),
    Mutant(
        "one seed for both subpaths",
        "points",
        'mi.UInt32(1 if side == "light" else 2)',
        "mi.UInt32(1)",
        "tests/test_plausible_bugs.py::test_no_number_decides_two_things",
    ),
    Mutant(
        "two purposes of one dimension",
        "points",
        "    ROULETTE = 9\n",
        "    ROULETTE = 6\n",
        "tests/test_plausible_bugs.py",
    ),
    Mutant(
        "roulette by the number of the lobe",
        "subpath",
        "Purpose.ROULETTE",
        "Purpose.LOBE",
        "tests/test_plausible_bugs.py::test_each_purpose_is_drawn_for_at_one_place",
    ),
)


def seen(mutant: Mutant, folder: Path) -> bool:
    """Whether a test fails on a copy of the package in ``folder`` that has this bug; raises ``ValueError`` if
    its text is not there once."""
    copy = folder / "mitsuba_bdpt"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    file = copy / f"{mutant.module}.py"
    text = file.read_text()
    if text.count(mutant.old) != 1:
        raise ValueError(f"{mutant.name}: {mutant.module}.py has its text {text.count(mutant.old)} times")
    file.write_text(text.replace(mutant.old, mutant.new))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", mutant.tests]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT / "scripts")])}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    if done.returncode not in (0, 1):  # no test ran, or pytest itself failed
        raise ValueError(f"{mutant.name}: pytest ended with {done.returncode}\n{done.stdout[-2000:]}")
    return done.returncode == 1


def main(arguments=None) -> int:
    """Print what became of each; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", help="only mutants with one of these words in their name")
    words = parser.parse_args(arguments).words
    blind = 0
    with tempfile.TemporaryDirectory() as folder:
        for mutant in MUTANTS:
            if words and not any(word in mutant.name for word in words):
                continue
            found = seen(mutant, Path(folder))
            blind += not found
            print(f"{'seen' if found else 'NOT SEEN'}: {mutant.name}", flush=True)
    return 1 if blind else 0


if __name__ == "__main__":
    sys.exit(main())
