"""How far a measurement is: a bar on standard error, as from the command render.

Silent where that is no terminal. Words of the command itself belong before or after a bar, not inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


def bar() -> Progress:
    """A bar that counts steps."""
    console = Console(stderr=True)
    text = TextColumn("{task.description}", markup=False)  # names of integrators may hold brackets
    columns = text, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


@contextmanager
def steps(total: int) -> Iterator[Callable[[str], None]]:
    """A `bar` of so many steps; the result is to be called with a description where each begins."""
    with bar() as shown:
        task, done = shown.add_task("", total=total), count()
        yield lambda text: shown.update(task, description=text, completed=next(done))


@contextmanager
def amount(text: str, total: float) -> Iterator[Callable[[float], None]]:
    """As `steps`, of an amount such as seconds or samples; the result is to be called with what is done."""
    with bar() as shown:
        task = shown.add_task(text, total=round(total))
        yield lambda done: shown.update(task, completed=min(round(done), round(total)))
