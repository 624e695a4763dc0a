"""Progress of measurements on standard error: bars on a terminal.

Elsewhere than on a terminal only long `Renders` are shown, by lines. Print before or after, not inside.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from itertools import count
from typing import Self

from rich import progress as rich
from rich.console import Console


def bar(*columns: rich.ProgressColumn) -> rich.Progress:
    """Return a bar with a text before it and these ``columns`` after it."""
    console = Console(stderr=True)
    text = rich.TextColumn("{task.description}", markup=False)  # names of integrators may contain brackets
    is_off = not console.is_terminal
    return rich.Progress(text, rich.BarColumn(), *columns, console=console, transient=True, disable=is_off)


@contextmanager
def steps(total: int) -> Generator[Callable[[str], None]]:
    """A `bar` of ``total`` steps; call the result with a description at each step."""
    with bar(rich.MofNCompleteColumn(), rich.TimeRemainingColumn()) as shown:
        task, done = shown.add_task("", total=total), count()
        yield lambda text: shown.update(task, description=text, completed=next(done))


@contextmanager
def amount(text: str, total: float) -> Generator[Callable[[float], None]]:
    """Like `steps`, for seconds or samples; call the result with the amount done."""
    with bar(rich.MofNCompleteColumn(), rich.TimeRemainingColumn()) as shown:
        task = shown.add_task(text, total=round(total))
        yield lambda done: shown.update(task, completed=min(round(done), round(total)))


EVERY, SHARE = 30.0, 0.02  # least time between two lines: seconds, and share of the time so far


class Renders:
    """Progress of renders of differing lengths.

    ``works``: in proportion to their seconds. ``limit``: of the seconds.
    """

    def __init__(self, works: Sequence[float], limit: float = math.inf):
        self._bar = bar()
        task = self._bar.add_task("", total=sum(works))
        self._task, self._update = self._bar.tasks[0], partial(self._bar.update, task)
        self._done, self._total, self._limit, self._printed = 0, len(works), limit, 0.0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, text: str) -> None:
        """Show what is rendered next."""
        self._update(description=self.words(text))

    def end(self, text: str, work: float) -> None:
        """Count a render."""
        self._done += 1
        self._update(advance=work)
        self.begin(text)
        elapsed = self._task.elapsed or 0.0
        if self._bar.disable and elapsed - self._printed >= max(EVERY, SHARE * elapsed):
            self._printed = elapsed
            print(self.words(text), file=sys.stderr, flush=True)

    def seconds_left(self) -> float:
        """Return the estimated seconds until all is rendered or the limit is over."""
        task, elapsed = self._task, self._task.elapsed or 0.0
        left = elapsed * (task.remaining or 0.0) / task.completed if task.completed else math.inf
        return max(min(left, self._limit - elapsed), 0.0)

    def words(self, text: str) -> str:
        """Return how many renders are done, and the time left."""
        left = self.seconds_left()
        time_left = f", {timedelta(seconds=round(left))} left" if left < math.inf else ""
        return f"{self._done} of {self._total} renders{time_left}: {text}"
