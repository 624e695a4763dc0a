"""Calls on workers of a ``dask.distributed`` scheduler."""

from __future__ import annotations

import contextlib
import socket
import threading
from contextlib import contextmanager

from .errors import CommandError, FailureError

ANSWERS_WITHIN = 3.0  # seconds that a scheduler may take to answer

one_at_a_time = threading.Lock()
"""Held by a call that takes all cores of a worker, whose threads would otherwise make several at once."""


def _check_answers(address: str) -> None:
    """Raise ``OSError`` if no scheduler sends at ``address``, where ``Client`` would wait forever.

    ``CommandError`` for an ``address`` without a valid port.
    """
    from distributed.comm.addressing import parse_address, parse_host_port

    protocol, place = parse_address(address)
    if protocol != "tcp":
        return
    try:
        with socket.create_connection(parse_host_port(place), ANSWERS_WITHIN) as connection:
            if connection.recv(1):
                return
            why = "it ends the connection"
    except (ValueError, OverflowError) as error:
        raise CommandError(f"scheduler={address!r}: {error}; give HOST:PORT.") from error
    except OSError as error:
        why = str(error)
    raise OSError(f"no dask scheduler answers at {address} within {ANSWERS_WITHIN:g} s: {why}")


def results(client, function, arguments):
    """Yield index and result of ``function(*arguments[index])`` as workers of ``client`` finish.

    Calls of a lost worker move to another one. Raises ``FailureError`` for a call that failed, and if the
    scheduler is gone.
    """
    from distributed import as_completed

    futures = {client.submit(function, *given, pure=False): i for i, given in enumerate(arguments)}
    try:
        for future in as_completed(list(futures)):
            index = futures.pop(future)
            try:
                found = future.result()
            except Exception as error:
                text = str(error) or type(error).__name__
                raise FailureError(f"part {index} failed on the cluster: {text}") from error
            yield index, found
    finally:
        with contextlib.suppress(Exception):  # the scheduler may be gone
            client.cancel(list(futures), force=True)


def worker_count(client) -> int:
    """Return the number of workers of a ``distributed.Client``; 0 while it has no scheduler."""
    return len(client.scheduler_info(n_workers=-1).get("workers", ()))


@contextmanager
def connected(address: str):
    """Yield a ``distributed.Client`` of the scheduler at ``address``.

    Raises ``CommandError`` if distributed is not installed, the ``address`` has no port or the scheduler no
    worker, ``OSError`` if there is no scheduler within `ANSWERS_WITHIN`.
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
