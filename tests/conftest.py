"""What every test needs: the package imported first, then Mitsuba with a variant."""

import gc  # noqa: I001  (the package chooses the LLVM library; it must precede mitsuba)

import mitsuba_bdpt.workers
import mitsuba as mi
import pytest
import variants
from mitsuba_bdpt.host.jit import registered_emitters
from patience import PATIENCE

VARIANT = variants.of("rgb")
mi.set_variant(VARIANT)


@pytest.fixture(autouse=True)
def _variant():
    """Give every test the same variant, whatever the one before it has set, and no scene of its own.

    An exception that a test keeps, or failed with, keeps the test's scenes until the cycle collector runs, at
    any time, and calls of later tests visit their emitters.
    """
    mi.set_variant(VARIANT)
    before = registered_emitters()
    yield
    mi.set_variant(VARIANT)
    if registered_emitters() != before:
        gc.collect()


@pytest.fixture
def workers(_cluster, monkeypatch):
    """A dask.distributed cluster, whose scheduler may answer as late as the machine's load makes it."""
    monkeypatch.setattr(mitsuba_bdpt.workers, "ANSWERS_WITHIN", PATIENCE)
    return _cluster


@pytest.fixture(scope="session")
def _cluster():
    """A dask.distributed cluster of two processes on this machine, without a dashboard."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as cluster:
        yield cluster
