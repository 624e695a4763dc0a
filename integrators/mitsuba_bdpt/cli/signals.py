"""Signals that end a command: SIGINT (Ctrl-C) and SIGTERM (farms, shutdown)."""

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
    """State of a command that a signal ends.

    ``status``: its exit status; ``patient``: whether the next signal is only recorded, while results are
    written; ``signalled``: whether one has come.
    """

    status: int = INTERRUPTED
    patient: bool = False
    signalled: bool = False

    def __call__(self, number: int, frame: object) -> None:
        """Handle a signal: the first raises ``KeyboardInterrupt``; later ones are ignored."""
        if self.signalled:
            return
        self.signalled, self.status = True, STATUS[signal.Signals(number)]
        if not self.patient:
            raise KeyboardInterrupt


@contextmanager
def terminable() -> Iterator[Ending]:
    """Within, `Ending` handles SIGINT and SIGTERM.

    Leaves signals unchanged outside of the main thread.
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
