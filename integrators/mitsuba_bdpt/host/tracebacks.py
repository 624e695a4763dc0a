"""Prints a user's mistake once more below an uncaught exception's traceback.

``mi.render`` turns every exception into a ``RuntimeError`` with the text "error while performing a custom
differentiable operation (see above)". If its cause is a `UsageError` or `UnsupportedError`, the cause's
text is printed below the traceback.
"""

from __future__ import annotations

import sys
from typing import Any

from ..errors import UnsupportedError, UsageError, behind

_installed: list[bool] = []


def last_line(error: BaseException) -> str:
    """Text of the user's mistake behind ``error``; empty if ``error`` ends with it."""
    cause = behind(error, UsageError, UnsupportedError)
    text = "" if cause is None else str(cause)
    return "" if str(error).endswith(text) else text


def install():
    """Print `last_line` below tracebacks of scripts and of IPython.

    Called for the first integrator, so that importing the package leaves ``sys.excepthook`` alone.
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
    if shell and not shell.custom_exceptions:  # a user's own handler stays
        shell.set_custom_exc((RuntimeError,), _show_in_ipython)


def _show_in_ipython(
    shell: Any, kind: type[BaseException], error: BaseException, traceback: Any, **given: Any
):
    """Handle an exception in IPython, which passes ``tb_offset`` in ``given``."""
    shell.showtraceback((kind, error, traceback), **given)
    _print(error)


def _print(error: BaseException):
    if line := last_line(error):
        print(line, file=sys.stderr)
