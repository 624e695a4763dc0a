"""What every test needs: the package imported first, then Mitsuba with a variant."""

import mitsuba_bdpt.workers  # noqa: I001 (it chooses the LLVM library; it must precede mitsuba)
import os
import mitsuba as mi
import leftovers
import pytest
import short_pilots  # noqa: F401
import variants
from costs import (  # noqa: F401  (hooks of pytest)
    pytest_addoption,
    pytest_collection_modifyitems,
    pytest_runtest_logreport,
    pytest_runtest_makereport,
    pytest_runtest_setup,
    pytest_sessionfinish,
)
from mitsuba_bdpt.host.jit import registered_emitters

# What rich and argparse read of the terminal in which the tests run.
os.environ |= {"COLUMNS": "80", "TERM": "xterm"}
os.environ.pop("FORCE_COLOR", None)

VARIANT = variants.of("rgb")
mi.set_variant(VARIANT)


@pytest.fixture(autouse=True)
def _variant():
    """Give every test the same variant, whatever the one before it has set, and free its scenes."""
    mi.set_variant(VARIANT)
    before = registered_emitters()
    yield
    mi.set_variant(VARIANT)
    leftovers.collect(before)


@pytest.fixture
def workers(_cluster, monkeypatch):
    """A dask.distributed cluster, whose scheduler may answer as late as the machine's load makes it."""
    monkeypatch.setattr(mitsuba_bdpt.workers, "ANSWERS_WITHIN", 1000.0)
    return _cluster


@pytest.fixture(scope="session")
def _cluster():
    """A dask.distributed cluster of two processes on this machine, without a dashboard."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as cluster:
        yield cluster
