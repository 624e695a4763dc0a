"""Choice of the LLVM library that Dr.Jit loads.

Dr.Jit reads ``DRJIT_LIBLLVM_PATH`` once, on its first import. Mitsuba 3.9 rejects LLVM 14, and LLVM 15
and 16 abort the process on machines with AVX-512, so `prepare` chooses before ``drjit`` is imported:

1. the library that the user named in ``DRJIT_LIBLLVM_PATH``, as it is;
2. the newest library of the Python environment whose version is known to work (the wheel
   ``karellen-llvm-core``, conda), else of the system;
3. none if there is a CUDA driver, whose variants need no LLVM.

`quick_compilation` has LLVM compile kernels without its optional passes for a while.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
NAMED = f"named by {VARIABLE}"
WHEEL = "karellen-llvm-core"
KNOWN_GOOD = (19, 22, 23)
"""Major versions that passed this package's tests."""

# Where Linux distributions and Homebrew install libLLVM, within the root directory.
SYSTEM = (
    *("usr/lib/x86_64-linux-gnu", "usr/lib/aarch64-linux-gnu", "usr/lib64", "usr/lib", "usr/local/lib"),
    *("usr/lib/llvm*/lib", "usr/lib64/llvm*/lib*", "usr/lib/llvm/*/lib*"),
    *("opt/homebrew/opt/llvm*/lib", "usr/local/opt/llvm*/lib"),
)

_LIBRARY = re.compile(r"libLLVM(-\d+(\.\d+)*)?\.(so|dylib)(\.\d+)*")

# Whether `quick_compilation` is in effect.
_quick: ContextVar[bool] = ContextVar("quick", default=False)


class LLVMNotFoundError(ImportError):
    """No usable LLVM library; the message says how to install one."""


@dataclass(frozen=True)
class Choice:
    """The LLVM library in use; ``version`` is its major version, None if unknown.

    ``path`` is None where Dr.Jit was imported first, or LLVM is not used (``version`` None).
    """

    path: Path | None
    why: str
    version: int | None = None

    def __str__(self) -> str:
        if self.path is None and self.version is None:
            return self.why
        version = f"LLVM {self.version}" if self.version else "LLVM of unknown version"
        return f"{version}, {self.path or 'loaded before'} ({self.why})"


def prepare() -> Choice:
    """Choose a library and set ``DRJIT_LIBLLVM_PATH``, or check an imported Dr.Jit."""
    if (drjit := sys.modules.get("drjit")) is not None:
        mitsuba = sys.modules.get("mitsuba")
        if mitsuba is not None and (mitsuba.variant() or "").startswith("cuda"):
            return Choice(None, "the current variant runs on CUDA")
        return check_loaded(drjit.detail.llvm_version())
    finish_installation()
    if name := os.environ.get(VARIABLE):
        return named(name)
    found = libraries()
    choice = choose(*found)
    if choice.path or any(found):
        # Keeps Dr.Jit from loading an unusable library by itself.
        os.environ[VARIABLE] = str(choice.path or os.devnull)
    return choice


def named(name: str) -> Choice:
    """Return the library that `VARIABLE` names; none if it is ``os.devnull``, see `prepare`."""
    path = Path(name)
    if path.is_file():
        return Choice(path, NAMED, major_version(path))
    if name == os.devnull and cuda_driver():
        return _without_llvm(f"{VARIABLE}={name} asks for none")
    raise LLVMNotFoundError(
        f"{VARIABLE}={name!r} names no file. Unset {VARIABLE} to let mitsuba_bdpt choose, "
        "or set it to the path of a libLLVM shared library."
    )


def choose(environment: list[Path], system: list[Path]) -> Choice:
    """Return the library to load of those found, see `libraries`, or raise `LLVMNotFoundError`."""
    for paths, where in ((environment, "Python environment"), (system, "system")):
        path = max(paths, key=_known_version, default=Path())  # the first one on ties
        if version := _known_version(path):
            return Choice(path, f"found in the {where}, known to work", version)
    texts = [f"{path} (LLVM {major_version(path) or 'of unknown version'})" for path in environment + system]
    found = (
        f"found only {'; '.join(texts)} (to try a newer one, set {VARIABLE})" if texts else "none was found"
    )
    if cuda_driver():
        return _without_llvm(found)
    known = ", ".join(map(str, KNOWN_GOOD))
    raise LLVMNotFoundError(f"No usable LLVM library: {found}. Versions known to work: {known}. {remedy()}")


def _known_version(path: Path) -> int:
    """Return the major version of a library if it is known to work, else 0."""
    version = major_version(path) or 0
    return version if version in KNOWN_GOOD else 0


def _without_llvm(found: str) -> Choice:
    return Choice(None, f"no usable LLVM ({found}): only variants of CUDA can be used")


def check_loaded(version: tuple[int, ...]) -> Choice:
    """Check the LLVM `version` of a Dr.Jit that was imported before this package.

    `version`: result of ``drjit.detail.llvm_version()``, negative if there is none.
    """
    if version[0] >= min(KNOWN_GOOD):
        return Choice(None, "loaded by drjit, which was imported first", version[0])
    if version[0] < 0 and cuda_driver():
        return _without_llvm("drjit was imported first and found none")
    number = ".".join(map(str, version))
    what = "found no usable LLVM" if version[0] < 0 else f"loaded LLVM {number}, which can abort the process"
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
def quick_compilation():
    """Compile kernels without LLVM's optional passes: for kernels that run only briefly.

    Results are the same; for times see experiments, "First images". Holds for the whole process, other
    threads included, and Dr.Jit caches kernels as if they were compiled as usual. No effect within itself, or
    with an LLVM library that this package was not tested with.
    """
    set_options = _option_setter()
    if set_options is None or _quick.get():
        yield
        return
    before = _quick.set(True)
    try:
        set_options(b"-opt-bisect-verbose=false", b"-opt-bisect-limit=0")
        yield
    finally:
        set_options(b"-opt-bisect-limit=%d" % (2**31 - 1))  # limits nothing
        _quick.reset(before)


@functools.cache
def _option_setter() -> Callable[..., None] | None:
    """Return what sets options of the LLVM library in use; None if that is unknown or untested."""
    path = Path(os.environ.get(VARIABLE, ""))
    if not _known_version(path) or sys.modules["drjit"].detail.llvm_version()[0] != major_version(path):
        return None
    try:
        parse = ctypes.CDLL(str(path)).LLVMParseCommandLineOptions  # of the copy that Dr.Jit has opened
    except (OSError, AttributeError):
        return None

    def set_options(*options: bytes) -> None:
        arguments = (ctypes.c_char_p * (1 + len(options)))(b"mitsuba_bdpt", *options)
        parse(len(arguments), arguments, b"")

    return set_options


def cuda_driver() -> bool:
    """Whether a driver of CUDA can be loaded; slow."""
    try:
        ctypes.CDLL("nvcuda.dll" if platform.system() == "Windows" else "libcuda.so.1")
    except OSError:
        return False
    return True


def major_version(path: Path) -> int | None:
    """Read the major version from the name of a library or of its directory."""
    for name in dict.fromkeys((path, path.resolve())):
        match = re.search(r"libLLVM-(\d+)|libLLVM\.so\.(\d{2,})|libLLVM\.(\d{2,})", name.name)
        match = match or re.search(r"/llvm[@/-]?(\d{2,})", name.parent.as_posix())
        if match:
            return int(next(group for group in match.groups() if group))
    return None


def libraries(root: Path = Path("/")) -> tuple[list[Path], list[Path]]:
    """Return the libLLVM files of the Python environment, and of the system in ``root``, each once."""
    wheel = (file for found in importlib.metadata.distributions(name=WHEEL) for file in found.files or ())
    own = [Path(str(file.locate())).parent for file in wheel if _LIBRARY.fullmatch(file.name)]
    folders = (folder for pattern in SYSTEM for folder in sorted(root.glob(pattern)))
    return _libraries_in([*own, Path(sys.prefix) / "lib"]), _libraries_in(folders)


def _libraries_in(folders: Iterable[Path]) -> list[Path]:
    files = (file for folder in folders for file in sorted(folder.glob("libLLVM*")))
    return list(dict.fromkeys(f.resolve() for f in files if f.is_file() and _LIBRARY.fullmatch(f.name)))


def remedy() -> str:
    """Return the command that installs a usable LLVM on this machine."""
    system, architecture = platform.system(), platform.machine()
    if system == "Linux" and architecture == "x86_64":
        command = f"python -m pip install '{WHEEL}==23.1.*'"
    elif system == "Darwin":
        command = "brew install llvm@19"
    elif system == "Linux":
        command = "apt install libllvm19"
    else:
        return f"Install LLVM 19 and set {VARIABLE} to the path of its shared library."
    return f"Mend it with: {command}"
