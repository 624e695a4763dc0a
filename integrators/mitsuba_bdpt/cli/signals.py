"""Signals that end a command: Ctrl-C, and SIGTERM, by which farms and operating systems end a process."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from .mistakes import INTERRUPTED, TERMINATED

STATUS = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: TERMINATED}


@dataclass
class Ending:
    """What has ended a command before its time.

    ``status``, with which it exits then; ``patient``: whether the next signal is only noted, since what is
    done is being written; ``signalled``: whether one has come.
    """

    status: int = INTERRUPTED
    patient: bool = False
    signalled: bool = False

    def __call__(self, number: int, frame: object) -> None:
        """Answer a signal: the first one raises ``KeyboardInterrupt``; later ones change nothing."""
        if self.signalled:
            return
        self.signalled, self.status = True, STATUS[signal.Signals(number)]
        if not self.patient:
            raise KeyboardInterrupt


@contextmanager
def terminable() -> Iterator[Ending]:
    """Within, SIGINT and SIGTERM are answered as `Ending` says.

    Where another thread than the main one runs the command, signals are left as they are.
    """
    ending = Ending()
    if threading.current_thread() is not threading.main_thread():
        yield ending
        return
    before = {number: signal.signal(number, ending) for number in STATUS}
    try:
        yield ending
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
