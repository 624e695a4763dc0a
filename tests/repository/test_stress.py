"""The record of stress cases: of the cases that there are, and its tables."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import stress

ROW = {
    "name": "a[1]",
    "section": "S",
    "tried": "this",
    "expected": "that",
    "happened": "done",
    "source": "s1",
}


def test_the_record_is_of_these_cases():
    """Expected: the names are those of the tests in tests/stress_cases, each once."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "--collect-only",
        "-p",
        "no:cacheprovider",
        "-m",
        "stress",
    ]
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [*command, "tests/stress_cases"], capture_output=True, text=True, cwd=root, check=True
    )
    names = [line.split("::test_", 1)[1] for line in done.stdout.splitlines() if "::" in line]
    assert sorted(row["name"] for row in json.loads(stress.RECORD.read_text())) == sorted(names)


@pytest.mark.parametrize("ok", stress.RESULTS)
def test_what_was_not_tried_is_not_called_well(ok):
    """Expected: the tables mark what went wrong and what could not be tried, and the summary names both."""
    row = ROW | {"ok": ok, "seconds": 60.0}
    table = re.sub(" +", " ", stress.tables([row]))
    assert f"| `a` | this | that | {stress.RESULTS[ok]} |" in table
    text = stress.summary([row])
    assert (f"* `a[1]`: {stress.RESULTS[ok]}: done" in text) == (ok is not True)
    assert "1 cases, 1 minutes; digests of the plugin's source (cases): `s1` (1)." in text
    assert f"{stress.RESULTS[ok]} (2 of 2)" in stress.tables([row, row | {"name": "a[2]"}])


def test_rows_of_some_cases_are_written(monkeypatch, tmp_path):
    """Expected: their rows take the place of earlier ones, and all others stay."""
    monkeypatch.setattr(stress, "RECORD", tmp_path / "stress.json")
    stress.RECORD.write_text(json.dumps([ROW, ROW | {"name": "b"}]))
    stress.write({"b": ROW | {"name": "b", "happened": "anew"}})
    first, second = json.loads(stress.RECORD.read_text())
    assert first == ROW
    assert second == ROW | {"name": "b", "happened": "anew", "source": stress.reference.source_digest()}
