"""The record of stress cases: of the cases that there are, and its tables."""

import json
import subprocess
import sys
from pathlib import Path

import stress

ROW = {"name": "a[1]", "section": "S", "happened": "done", "source": "s1"}


def test_the_record_is_of_these_cases():
    root = Path(__file__).parents[2]
    options = ["-q", "--collect-only", "-p", "no:cacheprovider", "-m", "stress", "tests/stress_cases"]
    command = [sys.executable, "-m", "pytest", *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, check=True)
    names = [line.split("::test_", 1)[1] for line in done.stdout.splitlines() if "::" in line]
    assert sorted(row["name"] for row in json.loads(stress.RECORD.read_text())) == sorted(names)


def test_rows_of_some_cases_are_written(monkeypatch, tmp_path):
    monkeypatch.setattr(stress, "RECORD", tmp_path / "stress.json")
    stress.RECORD.write_text(json.dumps([ROW, ROW | {"name": "b"}]))
    stress.write({"b": ROW | {"name": "b", "happened": "anew"}})
    first, second = json.loads(stress.RECORD.read_text())
    assert first == ROW
    assert second == ROW | {"name": "b", "happened": "anew", "source": stress.reference.source_digest()}
