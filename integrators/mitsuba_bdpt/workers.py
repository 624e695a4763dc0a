"""Calls on workers of a ``dask.distributed`` scheduler."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import Counter
from contextlib import contextmanager

from .errors import CommandError, FailureError

ANSWERS_WITHIN = 3.0
"""Seconds that a scheduler may take to answer."""

one_at_a_time = threading.Lock()
"""Held by a call that takes all cores of a worker, whose threads would otherwise make several at once."""


def _check_answers(address: str) -> None:
    """Raise ``OSError`` if no scheduler sends at ``address``, where ``Client`` would wait forever."""
    from distributed.comm.addressing import parse_address, parse_host_port

    protocol, place = parse_address(address)
    if protocol != "tcp":
        return
    try:
        with socket.create_connection(parse_host_port(place), ANSWERS_WITHIN) as connection:
            if connection.recv(1):
                return
            why = "it ends the connection"
    except OSError as error:
        why = str(error)
    raise OSError(f"no dask scheduler answers at {address} within {ANSWERS_WITHIN:g} s: {why}")


def results(client, function, arguments):
    """Yield index and result of ``function(*arguments[index])`` as workers of ``client`` finish.

    Each index is yielded once. A worker runs one call at a time. Idle workers repeat unfinished calls, so
    that a slow machine does not delay the end; results must not depend on the worker. Calls of a lost worker
    move to another one.
    """
    from distributed import as_completed

    left, running, pending = dict(enumerate(arguments)), {}, as_completed()

    def fill():
        workers, times = max(1, worker_count(client)), Counter(running.values())  # may be 0 for a moment
        for index in sorted(left, key=times.__getitem__):  # those that run nowhere first
            if len(running) < workers and times[index] < 2:
                future = client.submit(function, *left[index], pure=False)
                running[future] = index
                pending.add(future)

    try:
        fill()
        while left:
            future = next(pending)
            index = running.pop(future)
            if index in left:
                found = _result(future, index)
                del left[index]
                yield index, found
            fill()
    finally:
        with contextlib.suppress(Exception):  # the scheduler may be gone
            client.cancel(list(running), force=True)


def _result(future, index: int):
    try:
        return future.result()
    except Exception as error:
        text = str(error) or type(error).__name__
        raise FailureError(f"part {index} failed on the cluster: {text}") from error


def worker_count(client) -> int:
    """Return the number of workers of a ``distributed.Client``; 0 while it has no scheduler."""
    return len(client.scheduler_info(n_workers=-1).get("workers", ()))


@contextmanager
def connected(address: str):
    """Yield a ``distributed.Client`` of the scheduler at ``address``.

    Raises ``CommandError`` if distributed is not installed or the scheduler has no worker, ``OSError`` if
    there is no scheduler within `ANSWERS_WITHIN`.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise CommandError(
            "scheduler needs dask.distributed; install it with: pip install 'mitsuba-bdpt[cluster]'"
        ) from error
    _check_answers(address)
    client = Client(address, timeout=ANSWERS_WITHIN)
    try:
        if not worker_count(client):
            raise CommandError(f"scheduler={address!r} has no worker; start some with `dask worker`.")
        yield client
    finally:
        with contextlib.suppress(Exception):  # the scheduler may be gone
            client.close(timeout=3)
