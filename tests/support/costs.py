"""Which tests run in `make test`: those that are cheap, and those that see a planted bug.

`costs.json` has the processor time in seconds of each test that takes more than `QUICK`, by its name without
the folder. Tests above `QUICK` are marked ``costly``, those above `COSTLY` ``slow``. Hooks of pytest, which
conftest.py imports; `make costs` records the file.
"""

import json
import resource
import time
from pathlib import Path

import planted_bugs
import pytest

COSTS = Path(__file__).with_name("costs.json")
# Seconds of processor time. Below the first lie two tests in three, which take a fortieth of the time of all;
# above the second one in ten, which takes over half.
QUICK, COSTLY = 0.3, 3.0


def name(nodeid):
    """Return the name of a test without its folders, which moves change."""
    file, _, rest = nodeid.partition("::")
    return f"{file.rsplit('/', 1)[-1]}::{rest}"


def needed():
    return {name(test) for bug in planted_bugs.BUGS for test in bug.tests}


def pytest_addoption(parser):
    parser.addoption("--costs", action="store_true", help=f"write the processor time of tests to {COSTS}")


def marker(test, costs, planted):
    """Return the marker of a test, or None for one that runs in `make test`."""
    seconds = costs.get(test, 0)
    if seconds <= QUICK or test in planted or test.split("[")[0] in planted:
        return None
    return "costly" if seconds <= COSTLY else "slow"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    costs, planted = json.loads(COSTS.read_text()), needed()
    for item in items:
        if found := marker(name(item.nodeid), costs, planted):
            item.add_marker(found)


def _seconds():
    """Return the processor time of this process and of the children that it waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    item.began = _seconds()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """Give the last report of a test its processor time, which comes to the main process with it."""
    outcome = yield
    if call.when == "teardown" and hasattr(item, "began"):
        outcome.get_result().user_properties.append(("seconds", _seconds() - item.began))


_measured = {}


def pytest_runtest_logreport(report):
    if report.when == "teardown":
        found = dict(report.user_properties)
        if "seconds" in found:
            _measured[name(report.nodeid)] = found["seconds"]


def pytest_sessionfinish(session):
    """Write what tests took, in the main process, in place of what stood there of tests that ran."""
    if session.config.getoption("costs") and not hasattr(session.config, "workerinput"):
        costs = {key: value for key, value in json.loads(COSTS.read_text()).items() if key not in _measured}
        costs |= {key: round(value, 1) for key, value in _measured.items() if value > QUICK}
        COSTS.write_text(json.dumps(dict(sorted(costs.items())), indent=0) + "\n")
