"""Try to break the renderer, and record what happened.

    python scripts/stress.py             # all cases, under twenty minutes; writes docs/reports/stress.json
    python scripts/stress.py NAME ...    # some of them, printed; with --write in the place of their rows
    python scripts/stress.py --list      # names of all
    python scripts/stress.py --same ../before/docs/reports/stress.json   # the same as that record?

Each case runs in a process of its own, so that a crash or a hang is an outcome too. Exit status 1 if a case
failed; one that can't be tried here (as this user, on this system) is named. `summary` (counts and failures)
and `tables` (a row per case) of the record are in the site of `make docs`. ``--same`` writes nothing, and
exits with 1 if words or figures of a case differ from those of a record: the check, beside scripts/versus.py,
of a change that must keep all images.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import command_line
import repository
from mitsuba_bdpt.cli.values import number
from mitsuba_bdpt.files.texts import write_text
from mitsuba_bdpt.measure import reference
from mitsuba_bdpt.measure.tables import table

from stress_cases import cases
from stress_cases.case import Case, Outcome

import mitsuba as mi  # isort: skip

RECORD = repository.ROOT / "docs" / "reports" / "stress.json"

# Seconds after which a case counts as hanging: ten times what the longest takes on two cores,
# since others may use them as well.
LIMIT = 1800

# Cases at a time.
JOBS = 2

# Of a figure: what sums of floats in another order, and the digits that are shown, make of it.
ROUNDING = 1e-2

_NUMBER = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")

# What is put before that which happened, by `Outcome.ok`.
MARKS = {True: "", False: "**no**: ", None: "**not tried**: "}
RESULTS = {True: "as expected", False: "**not as expected**", None: "**not tried**"}


def here(name: str) -> Outcome:
    """The outcome of a case, run in this process."""
    mi.set_variant("llvm_ad_rgb")
    return next(case for case in cases() if case.name == name).run()


def apart(name: str, limit: float = LIMIT) -> Outcome:
    """The outcome of a case in a process of its own; a crash or a hang is not what is expected."""
    command = [sys.executable, __file__, "--here", name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return Outcome(False, f"does not end within {limit} s")
    try:  # what Mitsuba logged may come before or after it, on the same line too
        found, _ = json.JSONDecoder().raw_decode(done.stdout[done.stdout.rindex('{"ok":') :])
        return Outcome(**found)
    except (ValueError, TypeError):
        tail = done.stderr.strip().splitlines()[-1:] or ["nothing on stderr"]
        return Outcome(False, f"ends with status {done.returncode}: {tail[0]}")


def made_with(record: list[dict]) -> str:
    """Of which versions of the plugin's source the rows are, and how long they took, in words."""
    seconds = sum(row["seconds"] for row in record)
    counts = Counter(row.get("source") for row in record)  # rows of older versions of this script do not say
    sources = [f"`{name}`" if name else "an earlier one, not kept" for name in counts]
    if len(counts) > 1:
        sources = [f"{of} ({n} cases)" for of, n in zip(sources, counts.values(), strict=True)]
    text = f"{len(record)} cases, whose times add up to {seconds / 60:.0f} minutes ({JOBS} run at a time)"
    return f"{text}; digest of the plugin's source: {', '.join(sources)}."


def brief(text: str) -> str:
    """The first clause of an expectation or outcome, without what stands in brackets."""
    text = re.sub(r"( |^)\((?:[^()]|\([^()]*\))*\)", "", text)
    return re.split(r"[;:.] ", text)[0]


def tables(record: list[dict]) -> str:
    """A row per case, as Markdown; an expectation that several cases share stands once."""
    texts = []
    for section in dict.fromkeys(row["section"] for row in record):
        rows, first = [], {}
        for row in record:
            if row["section"] == section:
                expected = brief(row["expected"])
                name = first.setdefault(expected, row["name"])
                expected = expected if name == row["name"] else f"as `{name}`"
                tried = re.sub(r" \([^()]{30,}\)", "", row["tried"]).split("; ")[0]
                rows.append([f"`{row['name']}`", tried, expected, RESULTS[row["ok"]]])
        texts.append(f"### {section}\n\n" + table(["case", "tried", "expected", "result"], rows))
    return "\n\n".join(texts)


def happened(row: dict) -> str:
    """What happened, marked if it was not what is expected."""
    return MARKS[row["ok"]] + row["happened"]


def summary(record: list[dict]) -> str:
    """How many cases of each section went as expected, and those that did not, as Markdown."""
    counts = Counter((row["section"], row["ok"]) for row in record)
    rows = []
    for section in dict.fromkeys(row["section"] for row in record):
        found = [counts[section, ok] for ok in (True, False, None)]
        rows.append([section, *map(str, (sum(found), *found))])
    rows.append(["all", *(str(sum(int(row[i]) for row in rows)) for i in range(1, 5))])
    text = table(["section", "cases", "as expected", "not as expected", "not tried here"], rows)
    others = [f"* `{row['name']}`: {happened(row)}" for row in record if row["ok"] is not True]
    return "\n".join([made_with(record) + "\n", text, *(line + "\n" for line in others)])


def write(record: list[dict]) -> None:
    """Write the record."""
    write_text(RECORD, json.dumps(record, indent=1, ensure_ascii=False) + "\n")


def tried(case: Case) -> dict:
    """Run a case, say so, and return its row."""
    started, source = time.perf_counter(), reference.source_digest()
    outcome = apart(case.name)
    seconds = round(time.perf_counter() - started, 1)
    mark = {True: "ok", False: "NO", None: "--"}[outcome.ok]
    print(f"{mark} {case.name} ({seconds} s): {outcome.happened}", flush=True)
    words = {name: getattr(case, name) for name in ("name", "section", "tried", "expected")}
    return words | {"ok": outcome.ok, "happened": outcome.happened, "seconds": seconds, "source": source}


def run(chosen: list[Case], jobs: int) -> list[dict]:
    """Rows of the ``chosen`` cases, ``jobs`` at a time.

    What took longest the last time begins first, so that no long one is left at the end.
    """
    last = {row["name"]: row["seconds"] for row in json.loads(RECORD.read_text())} if RECORD.exists() else {}
    order = sorted(chosen, key=lambda case: -last.get(case.name, 0))
    with ThreadPoolExecutor(jobs) as pool:
        futures = {case.name: pool.submit(tried, case) for case in order}
        return [futures[case.name].result() for case in chosen]


def is_same(one: str, other: str) -> bool:
    """Whether two texts have the same words, and figures within `ROUNDING` of each other."""
    if _NUMBER.sub("#", one) != _NUMBER.sub("#", other):
        return False
    pairs = zip(_NUMBER.findall(one), _NUMBER.findall(other), strict=True)
    return all(
        math.isclose(*(float(text.replace(",", "")) for text in pair), rel_tol=ROUNDING) for pair in pairs
    )


def changes(record: list[dict], before: list[dict]) -> list[str]:
    """What cases of a ``record`` did otherwise than ``before``, a line each.

    Not those whose figures depend on the clock."""
    known = {row["name"]: row["happened"] for row in before}
    timed = {case.name for case in cases() if case.timed}
    return [
        f"{row['name']}: {row['happened']}\n    before: {known[row['name']]}"
        for row in record
        if row["name"] in known
        and row["name"] not in timed
        and not is_same(row["happened"], known[row["name"]])
    ]


def main(arguments=None) -> int:
    """Run the command line."""
    parser = command_line.parser(__doc__)
    known = {case.name: case for case in cases()}
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="cases; default: all, and the record is written"
    )
    text = "cases at a time; much of one is compiling kernels, on one core (default: %(default)s)"
    parser.add_argument("--jobs", type=number(int, 1), default=JOBS, help=text)
    parser.add_argument("--write", action="store_true", help="put the rows of some cases into the record")
    parser.add_argument("--list", action="store_true", help="print the names of all cases")
    parser.add_argument(
        "--same", type=Path, metavar="RECORD", help="fail unless figures are those of a record"
    )
    parser.add_argument("--here", metavar="NAME", help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if unknown := {*args.names, *filter(None, [args.here])} - set(known):
        parser.error(f"no case is named {sorted(unknown)}; --list shows all")
    if args.write and (args.same is not None or not args.names):
        parser.error("--write is for some cases by NAME, and not with --same")
    if args.list:
        print("\n".join(known))
        return 0
    if args.here:
        outcome = here(args.here)
        ok = None if outcome.ok is None else bool(outcome.ok)
        print(json.dumps({"ok": ok, "happened": outcome.happened}))
        return 0
    record = run([known[name] for name in args.names or known], args.jobs)
    changed = []
    if args.same is not None:
        changed = changes(record, json.loads(args.same.read_text()))
        print("\n".join(changed) or f"{len(record)} cases as in {args.same}")
    elif not args.names:
        write(record)
    elif args.write:
        rows = {row["name"]: row for row in [*json.loads(RECORD.read_text()), *record]}
        write([rows[name] for name in known if name in rows])
    return 1 if changed or any(row["ok"] is False for row in record) else 0


if __name__ == "__main__":
    sys.exit(main())
