"""The record of `make stress`, docs/reports/stress.json, and its tables in the documentation's pages."""

from __future__ import annotations

import json
from collections import Counter

import repository
from mitsuba_bdpt.files.texts import write_text
from mitsuba_bdpt.measure import reference
from mitsuba_bdpt.measure.tables import table

RECORD = repository.ROOT / "docs" / "reports" / "stress.json"
RESULTS = {True: "as expected", False: "**not as expected**", None: "**not tried**"}


def described(module: str, test: str, docstring: str) -> dict:
    """The words of a case, from its module, its name and the two parts of its docstring."""
    tried, _, expected = docstring.partition("\n\nExpected: ")
    words = {"tried": tried, "expected": expected}
    section = module.removeprefix("test_").replace("_", " ").capitalize()
    words = {key: " ".join(text.split()).rstrip(".") for key, text in words.items()}
    return {"name": test.removeprefix("test_"), "section": section} | words


def write(rows: dict[str, dict]) -> None:
    """Put ``rows`` by name into the record, with the version of the plugin's source."""
    source = reference.source_digest()
    known = {row["name"]: row for row in json.loads(RECORD.read_text())}
    known |= {name: known.get(name, {}) | row | {"source": source} for name, row in rows.items()}
    record = sorted(known.values(), key=lambda row: (row["section"], row["name"]))
    write_text(RECORD, json.dumps(record, indent=1, ensure_ascii=False) + "\n")


def tables(record: list[dict]) -> str:
    """A row per test, as Markdown, in a table per section."""
    texts = []
    for section in dict.fromkeys(row["section"] for row in record):
        tests: dict[str, list[dict]] = {}
        for row in record:
            if row["section"] == section:
                tests.setdefault(row["name"].partition("[")[0], []).append(row)
        rows = []
        for name, cases in tests.items():
            counts = Counter(row["ok"] for row in cases)
            found = [RESULTS[ok] + f" ({n} of {len(cases)})" * (n > 1) for ok, n in counts.items()]
            rows.append([f"`{name}`", cases[0]["tried"], cases[0]["expected"], ", ".join(found)])
        texts.append(f"### {section}\n\n" + table(["case", "tried", "expected", "result"], rows))
    return "\n\n".join(texts)


def summary(record: list[dict]) -> str:
    """How many cases of each section went as expected, and those that did not, as Markdown."""
    counts = Counter((row["section"], row["ok"]) for row in record)
    rows = []
    for section in dict.fromkeys(row["section"] for row in record):
        found = [counts[section, ok] for ok in (True, False, None)]
        rows.append([section, *map(str, (sum(found), *found))])
    rows.append(["all", *(str(sum(int(row[i]) for row in rows)) for i in range(1, 5))])
    minutes = sum(row["seconds"] for row in record) / 60
    sources = ", ".join(f"`{source}` ({n})" for source, n in Counter(r["source"] for r in record).items())
    head = f"{len(record)} cases, {minutes:.0f} minutes; digests of the plugin's source (cases): {sources}."
    others = [
        f"* `{row['name']}`: {RESULTS[row['ok']]}: {row['happened']}" for row in record if not row["ok"]
    ]
    text = table(["section", "cases", "as expected", "not as expected", "not tried here"], rows)
    return "\n\n".join([head, text, *others])
