"""Mitsuba's log on standard error, without colours and function names."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator

import mitsuba as mi

LEVELS = {level: level.name.lower() for level in (mi.LogLevel.Trace, mi.LogLevel.Debug, mi.LogLevel.Info)}
LEVELS |= {mi.LogLevel.Warn: "warning", mi.LogLevel.Error: "error"}

CALLER = re.compile(r"[\w<>]+(\(\))?: (?=bdpt: )")  # `mi.Log` prepends the name of the calling function


class _Lines(mi.Appender):
    """Prints messages as ``warning: TEXT``, like the command's own."""

    def append(self, level: mi.LogLevel, text: str) -> None:
        # A closed stream must not end the render.
        if sys.stderr is not None:
            with contextlib.suppress(OSError, ValueError):
                print(f"{LEVELS[level]}: {CALLER.sub('', text, count=1)}", file=sys.stderr, flush=True)

    def log_progress(self, *_: object) -> None:
        """Show nothing: `progress` shows it."""


@contextlib.contextmanager
def lines(verbose: int) -> Iterator[None]:
    """Print Mitsuba's log; ``verbose`` 1 to 3 adds info, debug, trace, date and class."""
    logger, level = mi.logger(), mi.log_level()
    before, formatter = [logger.appender(i) for i in range(logger.appender_count())], logger.formatter()
    own = mi.DefaultFormatter()
    own.set_has_log_level(False)
    own.set_has_thread(False)
    own.set_has_date(verbose > 0)
    own.set_has_class(verbose > 0)
    logger.clear_appenders()
    logger.add_appender(_Lines())
    logger.set_formatter(own)
    if verbose:
        mi.set_log_level((mi.LogLevel.Info, mi.LogLevel.Debug, mi.LogLevel.Trace)[min(verbose, 3) - 1])
    try:
        yield
    finally:
        mi.set_log_level(level)
        logger.set_formatter(formatter)
        logger.clear_appenders()
        for appender in before:
            logger.add_appender(appender)
