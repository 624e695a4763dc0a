"""Calls on the workers of a ``dask.distributed`` scheduler."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import contextmanager

from .errors import CommandError

one_at_a_time = threading.Lock()
"""Held by a call that takes all cores of a worker, whose threads would otherwise make several at once."""


def results(client, function, arguments):
    """Index and result of ``function(*arguments[index])``, each index once, as they come from the workers.

    The workers are those of a ``distributed.Client``. A worker has one call at a time; where none are left to
    begin, idle ones take over calls that others still have, so that one slow machine does not hold up the
    rest: a call has to give the same wherever it runs. That of a lost worker is made by another one.
    """
    from distributed import as_completed

    to_do, running, done = deque(range(len(arguments))), {}, set()
    pending = as_completed()

    def submit(index):
        future = client.submit(function, *arguments[index], pure=False)
        running[future] = index
        pending.add(future)

    def fill():
        workers = max(1, worker_count(client))  # none for a moment: another one may come
        while len(running) < workers and to_do:
            submit(to_do.popleft())
        for index in [i for i in running.values() if i not in done]:
            if len(running) < workers and list(running.values()).count(index) == 1:
                submit(index)

    try:
        fill()
        while len(done) < len(arguments):
            future = next(pending)
            index = running.pop(future)
            if index not in done:
                done.add(index)
                yield index, _result(future, index)
            fill()
    finally:
        client.cancel(list(running), force=True)


def _result(future, index: int):
    try:
        return future.result()
    except Exception as error:
        text = str(error) or type(error).__name__
        raise RuntimeError(f"part {index} failed on the cluster: {text}") from error


def worker_count(client) -> int:
    """Workers that the scheduler of a ``distributed.Client`` has now."""
    return len(client.scheduler_info(n_workers=-1)["workers"])


@contextmanager
def connected(address: str):
    """A ``distributed.Client`` of the scheduler at ``address``.

    Raises ``CommandError`` if distributed is not installed or the scheduler has no worker, ``OSError`` if
    there is no such scheduler.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise CommandError(
            "scheduler needs dask.distributed; install it with: pip install 'mitsuba-bdpt[cluster]'"
        ) from error
    with Client(address, timeout="20s") as client:
        if not worker_count(client):
            raise CommandError(f"scheduler={address!r} has no worker; start some with `dask worker`.")
        yield client
