"""Progress bars of measurements on standard error.

Silent elsewhere than on a terminal. Print before or after a bar, not inside.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from itertools import count

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


def bar() -> Progress:
    """Return a bar that counts steps."""
    console = Console(stderr=True)
    text = TextColumn("{task.description}", markup=False)  # names of integrators may contain brackets
    columns = text, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


@contextmanager
def steps(total: int) -> Generator[Callable[[str], None]]:
    """A `bar` of ``total`` steps; call the result with a description at each step."""
    with bar() as shown:
        task, done = shown.add_task("", total=total), count()
        yield lambda text: shown.update(task, description=text, completed=next(done))


@contextmanager
def amount(text: str, total: float) -> Generator[Callable[[float], None]]:
    """Like `steps`, for seconds or samples; call the result with the amount done."""
    with bar() as shown:
        task = shown.add_task(text, total=round(total))
        yield lambda done: shown.update(task, completed=min(round(done), round(total)))
