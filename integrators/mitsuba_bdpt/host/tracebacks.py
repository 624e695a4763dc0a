"""The last line of an uncaught exception's traceback.

``mi.render`` makes a ``RuntimeError`` of every exception, whose text is "error while performing a custom
differentiable operation (see above)". Where a `UsageError` or `UnsupportedError` is its cause, the text of
the cause is printed once more, below the traceback.
"""

from __future__ import annotations

import sys
from typing import Any

from ..errors import UnsupportedError, UsageError, behind

_installed: list[bool] = []


def last_line(error: BaseException) -> str:
    """The text of the user's mistake behind ``error``; empty if the text of ``error`` ends with it."""
    cause = behind(error, UsageError, UnsupportedError)
    text = "" if cause is None else str(cause)
    return "" if str(error).endswith(text) else text


def install():
    """Print `last_line` below the tracebacks of scripts and of IPython.

    Called for the first integrator: who imports the package, or lets Mitsuba find its entry point, keeps
    ``sys.excepthook`` until then.
    """
    if _installed:
        return
    _installed.append(True)
    show = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, traceback: Any):
        show(kind, error, traceback)
        _print(error)

    sys.excepthook = hook
    ipython = sys.modules.get("IPython")
    shell = ipython and ipython.get_ipython()
    if shell and not shell.custom_exceptions:  # a handler of the user's stays
        shell.set_custom_exc((RuntimeError,), _show_in_ipython)


def _show_in_ipython(
    shell: Any, kind: type[BaseException], error: BaseException, traceback: Any, **given: Any
):
    """As IPython calls handlers of exceptions: with ``tb_offset`` among those ``given``."""
    shell.showtraceback((kind, error, traceback), **given)
    _print(error)


def _print(error: BaseException):
    if line := last_line(error):
        print(line, file=sys.stderr)
