"""The stress table: its quick cases (`make stress` runs all of them), and whether it is of these cases."""

import json

import pytest
import stress

from stress_cases import cases
from stress_cases.agreement import Judged, worst


@pytest.mark.parametrize("name", [case.name for case in cases() if case.quick])
def test_what_is_expected_happens(name):
    """Rationale, expectation and the reason of each tolerance: see the case of that name in
    tests/stress_cases. (In a process of its own: a crash is an outcome, too.)"""
    outcome = stress.apart(name)
    if outcome.ok is None:
        pytest.skip(outcome.happened)
    assert outcome.ok, outcome.happened


def test_the_record_is_of_these_cases():
    """Rationale: a case that was changed after the last whole run would stand in the table with words that
    nothing has checked. Expected: the record's names, what was tried and what is expected are those of the
    cases, in their order."""
    record = json.loads(stress.RECORD.read_text())
    recorded = [tuple(row[key] for key in ("name", "section", "tried", "expected")) for row in record]
    assert recorded == [(case.name, case.section, case.tried, case.expected) for case in cases()]


@pytest.mark.parametrize(
    "ok, mark", [(True, "as expected"), (False, "**no**: done"), (None, "**not tried**: done")]
)
def test_what_was_not_tried_is_not_called_well(ok, mark, monkeypatch, capsys):
    """Expected: the table marks what went wrong and what could not be tried, and the summary names both;
    only the former is an exit status of 1."""
    outcome = stress.Outcome(ok, "done")
    monkeypatch.setattr(stress, "apart", lambda name: outcome)
    assert stress.main(["black"]) == (ok is False)
    (case,) = [case for case in cases() if case.name == "black"]
    row = stress.tried(case)
    assert f"| {stress.RESULTS[ok]} |" in stress.tables([row])
    assert (f"* `black`: {mark}" in stress.summary([row])) == (ok is not True)


def test_the_source_of_the_rows_is_told(monkeypatch, capsys):
    """Rationale: rows of several versions of the plugin may stand in one table. Expected: a row keeps the
    digest of the source that was tried; the summary says how many rows are of which, those of older records
    included, which do not tell, and how long all took."""
    monkeypatch.setattr(stress, "apart", lambda name: stress.Outcome(True, "done"))
    (case,) = [case for case in cases() if case.name == "black"]
    row = stress.tried(case) | {"seconds": 120.0}
    assert row["source"] == stress.reference.source_digest()
    text = "cases, whose times add up to 2 minutes (2 run at a time); digest of the plugin's source: "
    assert f"{text}`{row['source']}`." in stress.summary([row])
    older = {key: value for key, value in row.items() if key != "source"}
    several = stress.summary([row, older, older])
    assert f"`{row['source']}` (1 cases), an earlier one, not kept (2 cases)." in several


def test_the_worst_of_several_is_told():
    """Expected: of tests that all pass, the one with the smallest p and how many there were; of others, those
    that do not pass."""
    fine = {"one": Judged(True, "said of one", 0.5, 0.01), "other": Judged(True, "said of other", 0.1, 0.02)}
    outcome = worst(fine)
    assert outcome.ok and "2 comparisons" in outcome.happened and "2 %" in outcome.happened
    assert "said of other" in outcome.happened and "said of one" not in outcome.happened
    outcome = worst(fine | {"wrong": Judged(False, "said of wrong", 1.0, 0.0)})
    assert not outcome.ok and "said of wrong" in outcome.happened and "said of other" not in outcome.happened


def test_other_figures_are_seen(tmp_path, monkeypatch, capsys):
    """Expected: exit status 0 beside a record of the same words and nearly the same figures, 1 if a figure is
    off by 2 % or a word is another, unless the case's figures depend on the clock."""
    happened = "means 1.234e-05 and 1,234.5 apart, 3 values not finite"
    record = tmp_path / "record.json"
    monkeypatch.setattr(stress, "apart", lambda name: stress.Outcome(True, happened))
    timed = next(case.name for case in stress.cases() if case.timed)
    plain = next(case.name for case in stress.cases() if not case.timed)
    for name, before, status in (
        (plain, happened, 0),
        (plain, happened.replace("1,234.5", "1,234.6"), 0),
        (plain, happened.replace("1,234.5", "1,260"), 1),
        (plain, happened.replace("values", "pixels"), 1),
        (timed, happened.replace("3", "4"), 0),
    ):
        record.write_text(json.dumps([{"name": name, "happened": before}]))
        assert stress.main([name, "--same", str(record)]) == status
    assert "before: means" in capsys.readouterr().out


def test_rows_of_some_cases_are_written(monkeypatch, tmp_path):
    """``--write`` puts the rows of the named cases in the place of theirs, and leaves all others."""
    copy = tmp_path / "stress.json"
    copy.write_text(stress.RECORD.read_text())
    monkeypatch.setattr(stress, "RECORD", copy)
    monkeypatch.setattr(stress, "apart", lambda name: stress.Outcome(True, "anew"))
    before = json.loads(stress.RECORD.read_text())
    chosen = before[3]["name"]
    assert stress.main([chosen]) == 0
    assert json.loads(stress.RECORD.read_text()) == before
    assert stress.main(["--write", chosen]) == 0
    after = json.loads(stress.RECORD.read_text())
    assert [row["happened"] for row in after] == [
        "anew" if row["name"] == chosen else row["happened"] for row in before
    ]
