"""Bidirectional path tracing for Mitsuba 3.

``import mitsuba_bdpt`` selects the LLVM library that Dr.Jit loads (see `llvm`) and registers the plugin
``bdpt`` for the current variant and all later ones. Import it before ``mitsuba`` and ``drjit``, which load
LLVM when first imported. With one thread Mitsuba's EXR reader deadlocks; Dr.Jit gets at least two.
"""

import sys as _sys
from pathlib import Path as _Path

from ._version import __version__
from .errors import CommandError, FailureError, UnsupportedError, UsageError, UsageTypeError
from .host import llvm as _llvm
from .host import signals as _signals
from .host.llvm import LLVMNotFoundError
from .progress import Bar, Display, Lines

__all__ = [
    "BDPTIntegrator",
    "Bar",
    "CommandError",
    "Display",
    "FailureError",
    "LLVMNotFoundError",
    "Lines",
    "PassReport",
    "Snapshot",
    "Statistics",
    "UnsupportedError",
    "UsageError",
    "UsageTypeError",
    "__version__",
    "llvm_choice",
    "mix",
]

llvm_choice: _llvm.Choice | None = None
"""The LLVM library in use and why it was chosen."""

failure: ImportError | None = None
"""Why this package cannot be used. Only its own command sees it set; elsewhere it is raised."""


def _runs_own_command(arguments: list[str]) -> bool:
    """Return whether this process runs the package's own command."""
    module = "-m" in arguments and arguments[arguments.index("-m") :][1:2] == [__name__]
    return module or any(_Path(argument).stem == "mitsuba-bdpt" for argument in arguments[:2])


if _runs_own_command(_sys.orig_argv):
    _signals.end_at_once()
try:
    llvm_choice = _llvm.prepare()
    from .files.mixing import mix
    from .host.jit import ensure_two_threads as _ensure_two_threads
    from .integrator import BDPTIntegrator
    from .integrator import register as _register
    from .run.rendering import PassReport
    from .run.snapshot import Snapshot
    from .run.statistics import Statistics

    _register()
    _ensure_two_threads()
except ImportError as _error:
    # Python imports the package before its __main__. The command continues, since `doctor` explains the
    # failure; __main__ reports it for every other command.
    if not _runs_own_command(_sys.orig_argv):
        raise
    failure = _error
