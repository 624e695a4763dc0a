"""The LLVM library that Dr.Jit loads.

Dr.Jit reads ``DRJIT_LIBLLVM_PATH`` on its first import. `prepare` sets it to the library of the Python
environment (the wheel ``karellen-llvm-core``, conda) unless the user has set it; without both, Dr.Jit
searches the system. Mitsuba 3.9 rejects LLVM 14, and LLVM 15 and 16 abort the process on machines with
AVX-512: a version below those known to work is an error, unless the user names it.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
NAMED = f"named by {VARIABLE}"
WHEEL = "karellen-llvm-core"
KNOWN_GOOD = (19, 22, 23)  # major versions that passed this package's tests

_LIBRARY = re.compile(r"libLLVM(-\d+(\.\d+)*)?\.(so|dylib)(\.\d+)*")


class LLVMNotFoundError(ImportError):
    """No usable LLVM library; the message says how to install one."""


@dataclass(frozen=True)
class Choice:
    """The LLVM library: ``path`` (None: Dr.Jit chose), major ``version`` (None: LLVM is not used)."""

    path: Path | None
    why: str
    version: int | None = None

    def __str__(self) -> str:
        if self.version is None:
            return self.why
        return f"LLVM {self.version}, {self.path or 'without known path'} ({self.why})"


def prepare() -> Choice:
    """Choose the library, import Dr.Jit, and check the version that it has loaded."""
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is not None and (mitsuba.variant() or "").startswith("cuda"):
        return Choice(None, "the current variant runs on CUDA")
    first = "drjit" not in sys.modules
    path, why = _library() if first else (None, "loaded by drjit, which was imported first")
    if path is not None:
        os.environ[VARIABLE] = str(path)
    version = import_module("drjit").detail.llvm_version()
    return checked(version, path, why, first)


def _library() -> tuple[Path | None, str]:
    """Return the library to load, and why; None leaves the search to Dr.Jit."""
    if not (name := os.environ.get(VARIABLE)):
        finish_installation()
        path = in_environment()
        return path, "found in the Python environment" if path else "found by drjit in the system"
    if Path(name).is_file():
        return Path(name), NAMED
    raise LLVMNotFoundError(
        f"{VARIABLE}={name!r} names no file. Unset {VARIABLE} to let mitsuba_bdpt choose, "
        "or set it to the path of a libLLVM shared library."
    )


def in_environment() -> Path | None:
    """Return the newest libLLVM of the Python environment whose version is known to work, else the newest."""
    wheel = (file for found in importlib.metadata.distributions(name=WHEEL) for file in found.files or ())
    folders = [Path(str(file.locate())).parent for file in wheel if _LIBRARY.fullmatch(file.name)]
    files = (file for folder in (*folders, Path(sys.prefix) / "lib") for file in folder.glob("libLLVM*"))
    return max((file for file in files if _LIBRARY.fullmatch(file.name)), key=_rank, default=None)


def _rank(path: Path) -> tuple[bool, int]:
    number = re.search(r"\d{2,}", path.resolve().name)
    version = int(number[0]) if number else 0
    return version in KNOWN_GOOD, version


def checked(version: tuple[int, ...], path: Path | None, why: str, first: bool = True) -> Choice:
    """Return the library of this ``version``, or raise `LLVMNotFoundError`.

    ``version``: result of ``drjit.detail.llvm_version()``, negative if none was loaded; ``first``: whether
    this package imported Dr.Jit.
    """
    loaded = version[0] >= 0
    if version[0] >= min(KNOWN_GOOD) or (loaded and why == NAMED):
        return Choice(path, why, version[0])
    if not loaded and cuda_driver():
        return Choice(None, "drjit found no usable LLVM: only variants of CUDA can be used")
    number = ".".join(map(str, version))
    what = f"loaded LLVM {number}, which can abort the process" if loaded else "found no usable LLVM"
    if first:
        known = ", ".join(map(str, KNOWN_GOOD))
        raise LLVMNotFoundError(f"drjit {what}. Versions known to work: {known}. {remedy()}")
    raise LLVMNotFoundError(
        f"drjit was imported first and {what}. Import mitsuba_bdpt before drjit and mitsuba (where an import "
        f"sorter puts it below them: `import mitsuba_bdpt  # isort: skip`), or set {VARIABLE} to the path of "
        "a newer one before Python starts (later it has no effect)."
    )


def finish_installation() -> None:
    """Start a Python that finishes the installation of the wheel, where that is pending.

    The wheel's links, without which its libLLVM finds no libc++, are made by wheel-axle when Python starts.
    A process that has installed the wheel itself, such as a notebook's, started before.
    """
    for wheel in importlib.metadata.distributions(name=WHEEL):
        pending = wheel.read_text("axle.lck") is not None and wheel.read_text("axle.done") is None
        if pending and sys.executable:
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                subprocess.run([sys.executable, "-c", ""], timeout=60)


@contextlib.contextmanager
def quick_compilation(once: bool = True):
    """Compile kernels without LLVM's optional passes: for kernels that run only briefly.

    ``once``: nor with its optimizing register allocator. Results are the same; for times see experiments,
    "First images". Holds for the whole process, and Dr.Jit caches kernels as if they were compiled as usual.
    No effect with untested versions of LLVM.
    """
    allocator = b"-optimize-regalloc=false" if once else b"-optimize-regalloc=true"
    _set_options(b"-opt-bisect-verbose=false", b"-opt-bisect-limit=0", allocator)
    try:
        yield
    finally:  # limits nothing
        _set_options(b"-opt-bisect-limit=%d" % (2**31 - 1), b"-optimize-regalloc=true")


def _set_options(*options: bytes) -> bool:
    """Set options of the LLVM library in use; False, without effect, for an untested version."""
    if sys.modules["drjit"].detail.llvm_version()[0] not in KNOWN_GOOD:
        return False
    try:
        parse = ctypes.CDLL(os.environ.get(VARIABLE, "")).LLVMParseCommandLineOptions  # Dr.Jit's copy
    except (OSError, AttributeError):
        return False
    arguments = (ctypes.c_char_p * (1 + len(options)))(b"mitsuba_bdpt", *options)
    parse(len(arguments), arguments, b"")
    return True


def cuda_driver() -> bool:
    """Whether a driver of CUDA can be loaded; slow."""
    try:
        ctypes.CDLL("nvcuda.dll" if platform.system() == "Windows" else "libcuda.so.1")
    except OSError:
        return False
    return True


def remedy() -> str:
    """Return the command that installs a usable LLVM on this machine."""
    if (platform.system(), platform.machine()) == ("Linux", "x86_64"):
        return f"Mend it with: python -m pip install '{WHEEL}==23.1.*'"
    install = {"Linux": "apt install libllvm19", "Darwin": "brew install llvm"}
    command = install.get(platform.system(), "install LLVM 19 or newer")
    return f"Mend it with: {command}; set {VARIABLE} to the path of its shared library if it is not found."
