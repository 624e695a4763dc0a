"""Signals that end the command at once while it imports and loads, and are answered while it renders.

By a thread: handlers of Python run after a call of Mitsuba only, and their exceptions break imports.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator

STATUSES = {signal.SIGINT: 130, signal.SIGTERM: 143}
"""Exit status of a process that a signal has ended, as shells have it."""

NOTHING_WRITTEN = "interrupted; no image written"

_ending = contextlib.ExitStack()


def end_at_once() -> None:
    """Until `end_later`, SIGINT and SIGTERM end the process with `NOTHING_WRITTEN`."""
    before = {n: handler for n in STATUSES if (handler := signal.getsignal(n)) != signal.SIG_IGN}

    def restore() -> None:
        for number, handler in before.items():
            if signal.getsignal(number) is _noted:
                signal.signal(number, handler)

    for number in before:
        signal.signal(number, _noted)
    _ending.enter_context(_watched(_end))  # a signal that has come ends the process where this is left
    _ending.callback(restore)


def end_later() -> None:
    """Undo `end_at_once`, if it was called; handlers set since then stay."""
    _ending.close()


def announced(text: str) -> contextlib.AbstractContextManager[None]:
    """Within, print ``text`` to standard error as soon as a signal comes; its handler runs as before."""
    return _watched(lambda number: _say(text))


@contextlib.contextmanager
def _watched(act: Callable[[int], None]) -> Iterator[None]:
    """Call ``act`` in a thread with each signal of `STATUSES`; of the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    former = signal.set_wakeup_fd(writer.fileno())

    def watch() -> None:
        with reader:
            while number := reader.recv(1):
                if number[0] in STATUSES:
                    act(number[0])

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(former)
        writer.close()
        watcher.join()


def _noted(number: int, frame: object) -> None:
    """Do nothing: Python has written the number to the socket."""


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # a closed stream
        os.write(2, f"{text}\n".encode())


def _end(number: int) -> None:
    _say(NOTHING_WRITTEN)
    os._exit(STATUSES[signal.Signals(number)])
