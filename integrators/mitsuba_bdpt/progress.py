"""What a render shows of its progress: a bar, lines for a log, or nothing.

A display is a function that a render calls with a `run.rendering.PassReport` after each pass::

    integrator.on_pass = mitsuba_bdpt.Bar()  # on a terminal or in a notebook
    mi.render(scene, integrator=integrator, spp=4096)

Each knows by ``limit`` (seconds; None without one) when a render will be stopped for time.
"""

from __future__ import annotations

import contextlib
import sys
import time
from typing import TYPE_CHECKING, Protocol, TextIO

# Not here: the command declares its options, and `doctor` runs, where rich is missing.
if TYPE_CHECKING:
    from rich.console import Console

# Seconds between two lines of a log, at least, and as a share of those that the render has taken.
EVERY, SHARE = 10.0, 0.02


class Report(Protocol):
    """What displays ask of a `PassReport`."""

    @property
    def spp_done(self) -> int: ...
    @property
    def spp_total(self) -> int: ...
    @property
    def seconds(self) -> float: ...
    @property
    def rays(self) -> int: ...


def share_done(report: Report, limit: float | None = None) -> float:
    """Share of the render that is done, of its samples or of the time that limits it, from 0 to 1."""
    done = report.spp_done / report.spp_total
    if limit:
        done = max(done, report.seconds / limit)
    return min(done, 1.0)


def seconds_left(report: Report, limit: float | None = None) -> float:
    """Seconds that the rest of the render is expected to take."""
    left = report.seconds * (report.spp_total / max(report.spp_done, 1e-9) - 1)
    return max(0.0, min(left, limit - report.seconds)) if limit else left


def in_words(report: Report, limit: float | None = None, open_ended: bool = False) -> str:
    """Samples per pixel, rays per second, what is left, and the estimated error if there is one.

    ``open_ended``: the total is not what somebody asked for.
    """
    text = f"{report.spp_done}{'' if open_ended else f'/{report.spp_total}'} spp"
    if report.rays:  # of other integrators they are not known
        text += f", {readable(report.rays / max(report.seconds, 1e-9))} rays/s"
    if limit or not open_ended:
        text += f", {seconds_left(report, limit):.0f} s left"
    error = getattr(report, "error", None)
    return text if error is None else f"{text}, relMSE {error:.2g}"


def readable(number: float) -> str:
    """A number to three digits with a unit prefix."""
    for limit, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= limit:
            return f"{number / limit:.3g}{unit}"
    return f"{number:.3g}"


def _say(line: str, stream: TextIO | None) -> None:
    """Print a ``line``, as long as somebody listens: the render must not end with them."""
    if stream is not None:
        with contextlib.suppress(OSError, ValueError):
            print(line, file=stream, flush=True)


class Display:
    """Shows nothing.

    ``open_ended``: time or an error ends the render, not its total of samples.
    """

    def __init__(self, limit: float | None = None, open_ended: bool = False):
        self._limit, self._open_ended = limit, open_ended

    def __call__(self, report: Report) -> None:
        """Show the ``report`` of a pass."""

    def close(self) -> None:
        """Take away what is shown."""


class Bar(Display):
    """A bar on standard error of a terminal, or under the cell of a notebook; shows nothing elsewhere.

    ``console``: another place. The last pass of a render takes the bar off a terminal, and so does `close`.
    """

    def __init__(
        self, limit: float | None = None, open_ended: bool = False, *, console: Console | None = None
    ):
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        super().__init__(limit, open_ended)
        console = console or Console(stderr=True)
        columns = BarColumn(), TextColumn("{task.description}")
        # In notebooks rich draws with ipywidgets, which a plain Jupyter does not have: `_CellOutput` does it.
        self._cell = _CellOutput() if console.is_jupyter else None
        shown = console.is_terminal and not console.is_jupyter
        # Nothing is drawn between passes: a thread would go on for ever after a render that was interrupted.
        self._bar = Progress(*columns, console=console, transient=True, auto_refresh=False, disable=not shown)
        self._task = self._bar.add_task("rendering", total=1.0)
        self._begun = False

    @property
    def description(self) -> str:
        """The text beside the bar."""
        return self._bar.tasks[0].description

    @property
    def completed(self) -> float:
        """Share of the bar that is filled."""
        return self._bar.tasks[0].completed

    def __call__(self, report: Report) -> None:
        if not self._begun:
            self._bar.start()
            self._begun = True
        done = share_done(report, self._limit)
        text = in_words(report, self._limit, self._open_ended)
        self._bar.update(self._task, completed=done, description=text)
        self._bar.refresh()
        if self._cell is not None:
            self._cell.show(self._bar.make_tasks_table(self._bar.tasks))
        if report.spp_done >= report.spp_total:
            self.close()

    def close(self) -> None:
        if self._begun:
            self._bar.stop()
        if self._cell is not None:
            self._cell = _CellOutput()  # the next render's, of another cell
        self._begun = False


class _CellOutput:
    """One output of a notebook's cell, which is replaced by the next that is shown.

    By IPython's display identifiers, which Jupyter, Colab and editors support without an extension.
    """

    def __init__(self):
        self._handle = None

    def show(self, shown: object) -> None:
        """Show an object, as IPython displays it, in the place of the one before."""
        if self._handle is None:
            from IPython.display import display

            self._handle = display(shown, display_id=True)
        else:
            self._handle.update(shown)


class Lines(Display):
    """A line for a log now and then: time, samples, share, what is left.

    The first after `EVERY` seconds, so that short renders are silent; later ones after `SHARE` of the time
    that the render has taken.
    """

    def __init__(
        self,
        limit: float | None = None,
        open_ended: bool = False,
        *,
        stream: TextIO | None = None,
        every: float = EVERY,
    ):
        super().__init__(limit, open_ended)
        self._stream, self._every = stream or sys.stderr, every
        self._last = time.monotonic()

    def __call__(self, report: Report) -> None:
        now = time.monotonic()
        if now - self._last < max(self._every, SHARE * report.seconds):
            return
        self._last = now
        minutes, seconds = divmod(int(report.seconds), 60)
        clock = f"{minutes // 60:02d}:{minutes % 60:02d}:{seconds:02d}"
        done = share_done(report, self._limit)
        _say(f"{clock} {done:4.0%} {in_words(report, self._limit, self._open_ended)}", self._stream)


KINDS = ("auto", "bar", "lines", "none")
"""Names of displays on the command line."""


def display(kind: str, limit: float | None = None, open_ended: bool = False) -> Display:
    """The `Display` of this name; ``auto``: a bar on a terminal, lines elsewhere."""
    if kind == "auto":
        kind = "bar" if sys.stderr is not None and sys.stderr.isatty() else "lines"
    return {"bar": Bar, "lines": Lines, "none": Display}[kind](limit, open_ended)
