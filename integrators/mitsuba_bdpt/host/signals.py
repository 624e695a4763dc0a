"""Signals that end the command at once while it imports and loads.

By a thread: handlers of Python run after a call of Mitsuba only, and their exceptions break imports.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Callable

STATUSES = {signal.SIGINT: 130, signal.SIGTERM: 143}
"""Exit status of a process that a signal has ended, as shells have it."""

NOTHING_WRITTEN = "interrupted; no image written"

_ends: list[Callable[[], None]] = []


def end_at_once() -> None:
    """Until `end_later`, SIGINT and SIGTERM end the process with `NOTHING_WRITTEN`."""
    before = {n: handler for n in STATUSES if (handler := signal.getsignal(n)) != signal.SIG_IGN}
    for number in before:
        signal.signal(number, _noted)
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.fileno())
    watcher = threading.Thread(target=_watch, args=(reader,), daemon=True)
    watcher.start()

    def end() -> None:
        for number, handler in before.items():
            if signal.getsignal(number) is _noted:
                signal.signal(number, handler)
        signal.set_wakeup_fd(-1)
        writer.close()
        watcher.join()  # a signal that has come ends the process here

    _ends.append(end)


def end_later() -> None:
    """Undo `end_at_once`, if it was called; handlers set since then stay."""
    while _ends:
        _ends.pop()()


def _noted(number: int, frame: object) -> None:
    """Do nothing: Python has written the number to the socket."""


def _watch(reader: socket.socket) -> None:
    with reader:
        while number := reader.recv(1):
            if number[0] in STATUSES:
                os.write(2, f"{NOTHING_WRITTEN}\n".encode())
                os._exit(STATUSES[signal.Signals(number[0])])
