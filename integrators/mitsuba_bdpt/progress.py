"""Displays of a render's progress: a bar, lines of a log, or nothing.

A display is a function that a render calls with a `run.rendering.PassReport` after each pass::

    integrator.on_pass = mitsuba_bdpt.Bar()  # on a terminal or in a notebook
    mi.render(scene, integrator=integrator, spp=4096)

``limit``: seconds after which the render stops; None if unlimited.
"""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import dataclass, field
from datetime import timedelta
from io import StringIO
from typing import Any, TextIO

# Minimum interval between two lines of a log: seconds, and share of the elapsed time.
EVERY, SHARE = 10.0, 0.02


@dataclass(frozen=True)
class Report:
    """Progress after a pass, as displays show it."""

    spp_done: int
    """Samples per pixel so far."""
    spp_total: int
    """Samples per pixel of the whole render."""
    seconds: float
    """Seconds since the render began."""
    rays: int
    """Rays so far, of all kinds; 0 if they are not counted."""
    error: float | None
    """The relMSE at the last estimate for ``target_error``, else ``None``."""


def share_done(report: Report, limit: float | None = None) -> float:
    """Return the finished share of the samples, or of the time limit, from 0 to 1."""
    return min(max(report.spp_done / report.spp_total, report.seconds / limit if limit else 0), 1.0)


def in_words(report: Report, limit: float | None = None, open_ended: bool = False) -> str:
    """Describe samples per pixel (``open_ended``: not the total), rays, remaining time and error."""
    text = f"{report.spp_done}{'' if open_ended else f'/{report.spp_total}'} spp"
    if report.rays:  # unknown for other integrators
        text += f", {readable(report.rays / max(report.seconds, 1e-9))} rays/s"
    if limit and report.seconds >= limit and report.spp_done < report.spp_total:
        text += f", stopped after {limit:g} s"
    elif limit or not open_ended:
        left = report.seconds * (report.spp_total / max(report.spp_done, 1e-9) - 1)
        text += f", {max(0.0, min(left, limit - report.seconds)) if limit else left:.0f} s left"
    return text if report.error is None else f"{text}, relMSE {report.error:.2g}"


def readable(number: float) -> str:
    """Format a number with three digits and a unit prefix."""
    for limit, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= limit:
            return f"{number / limit:.3g}{unit}"
    return f"{number:.3g}"


@dataclass
class Display:
    """Shows nothing. ``open_ended``: time or an error ends the render, not its samples."""

    limit: float | None = None
    open_ended: bool = False

    def __call__(self, report: Report) -> None:
        """Show the ``report`` of a pass."""

    def close(self) -> None:
        """Remove the display."""


@dataclass
class Bar(Display):
    """A bar on a terminal's standard error, or in a notebook; shows nothing elsewhere.

    ``console``: another output. The bar disappears after the last pass, and by `close`.
    """

    # Of the class `Console` of rich, which is not imported for types: `doctor` runs without it.
    console: Any = field(default=None, kw_only=True)

    def __post_init__(self):
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        console = self.console or Console(stderr=True)
        columns = BarColumn(), TextColumn("{task.description}")
        # rich draws in notebooks with ipywidgets, which plain Jupyter lacks; `_show_in_cell` replaces it.
        self._in_cell, self._output = console.is_jupyter, None
        shown = console.is_terminal and not console.is_jupyter
        # Draws at passes only: a refresh thread would survive an interrupted render.
        self._bar = Progress(*columns, console=console, transient=True, auto_refresh=False, disable=not shown)
        self._task = self._bar.add_task("rendering", total=1.0)
        self._begun = False

    def __call__(self, report: Report) -> None:
        if not self._begun:
            self._bar.start()
            self._begun = True
        done = share_done(report, self.limit)
        text = in_words(report, self.limit, self.open_ended)
        self._bar.update(self._task, completed=done, description=text)
        self._bar.refresh()
        if self._in_cell:
            self._show_in_cell(self._bar.make_tasks_table(self._bar.tasks))
        if report.spp_done >= report.spp_total:
            self.close()

    def close(self) -> None:
        if self._begun:
            self._bar.stop()
        self._begun, self._output = False, None

    def _show_in_cell(self, shown: object) -> None:
        """Update the output by IPython's identifiers, which Jupyter, Colab and editors support."""
        if self._output is None:
            from IPython.display import display

            self._output: Any = display(shown, display_id=True)
        else:
            self._output.update(shown)


@dataclass
class Lines(Display):
    """Lines for a log: elapsed time, samples, share, remaining time.

    The first after ``every`` seconds, so that short renders print nothing; then after `SHARE` of the elapsed
    time. ``stream``: another output than standard error.
    """

    stream: TextIO | None = field(default=None, kw_only=True)
    every: float = field(default=EVERY, kw_only=True)

    def __post_init__(self):
        self._last = time.monotonic()

    def __call__(self, report: Report) -> None:
        now = time.monotonic()
        if now - self._last < max(self.every, SHARE * report.seconds):
            return
        self._last = now
        clock = timedelta(seconds=int(report.seconds))
        done = share_done(report, self.limit)
        text = f"{clock} {done:4.0%} {in_words(report, self.limit, self.open_ended)}"
        with contextlib.suppress(OSError, ValueError):  # a closed stream must not end the render
            print(text, file=self.stream or sys.stderr or StringIO(), flush=True)


_DISPLAYS: dict[str, type[Display]] = {"bar": Bar, "lines": Lines, "none": Display}
KINDS = ("auto", *_DISPLAYS)  # names of displays on the command line


def display(kind: str, limit: float | None = None, open_ended: bool = False) -> Display:
    """Return the `Display` of this name; ``auto``: a bar on a terminal, else lines."""
    if kind == "auto":
        kind = "bar" if sys.stderr is not None and sys.stderr.isatty() else "lines"
    return _DISPLAYS[kind](limit, open_ended)
