"""What `make stress` records of each case: what it tries and expects (its docstring) and what happened."""

import inspect
import re
from pathlib import Path

import pytest
import stress

HERE = Path(__file__).parent
MITSUBAS_LOG = re.compile(r"\x1b\[31m.*?\x1b\[0m\n?", re.DOTALL)
_rows = {}


def pytest_addoption(parser):
    """Add the option that writes the record."""
    parser.addoption("--record", action="store_true", help=f"write the outcomes to {stress.RECORD.name}")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the cases, before pytest deselects by markers, and let their reports carry what they try."""
    for item in items:
        if item.path.parent == HERE:
            item.add_marker("stress")
            words = inspect.cleandoc(item.function.__doc__)
            item.user_properties.append(("case", stress.described(item.path.stem, item.name, words)))


def pytest_runtest_logreport(report):
    """Collect outcomes in the main process: what cases print happened, or the error."""
    name = report.nodeid.rpartition("::test_")[2]
    case = dict(report.user_properties).get("case", {"name": name})  # of a process that died the name alone
    if f"{HERE.name}/" in report.nodeid and (report.when == "call" or not report.passed):
        error = getattr(report.longrepr, "reprcrash", None)
        said = "" if report.passed else getattr(error, "message", None) or str(report.longrepr)
        printed = MITSUBAS_LOG.sub("", report.capstdout).strip().split("\n")
        _rows[case["name"]] = case | {
            "ok": None if report.skipped else report.passed,
            "happened": "; ".join(filter(None, [said.partition("\n")[0], *printed[:20]])),
            "seconds": round(report.duration, 1),
        }


def pytest_sessionfinish(session):
    """Write the record, in the main process."""
    if session.config.getoption("--record", False) and not hasattr(session.config, "workerinput"):
        stress.write(_rows)
