"""Choice of the LLVM library that Dr.Jit loads.

Dr.Jit reads ``DRJIT_LIBLLVM_PATH`` once, on its first import. Mitsuba 3.9 rejects LLVM 14, and LLVM 15
and 16 abort the process on machines with AVX-512, so this module chooses before ``drjit`` is imported:

1. the library that the user named in ``DRJIT_LIBLLVM_PATH``, as it is;
2. the library of the installed wheel ``karellen-llvm-core``;
3. the newest library on the system whose version is known to work;
4. none if there is a CUDA driver, whose variants need no LLVM.

``choose`` is a pure function of a `Machine`; only `prepare` changes the process.

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
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
WHEEL = "karellen-llvm-core"
KNOWN_GOOD = (19, 22, 23)
"""Major versions that passed this package's tests."""

# Whether `quick_compilation` is in effect.
_quick: ContextVar[bool] = ContextVar("quick", default=False)

# Value of LLVM's option opt-bisect-limit that limits nothing.
_ALL_PASSES = 2**31 - 1

_LIBRARY = re.compile(r"libLLVM(-\d+(\.\d+)*)?\.(so|dylib)(\.\d+)*")


class LLVMNotFoundError(ImportError):
    """No usable LLVM library; the message says how to install one."""


@dataclass(frozen=True)
class Choice:
    """The LLVM library in use; `version` is its major version, None if unknown."""

    path: Path | None
    origin: str
    why: str
    version: int | None

    def __str__(self) -> str:
        if self.path is None and self.version is None:
            return self.why
        version = f"LLVM {self.version}" if self.version else "LLVM of unknown version"
        return f"{version}, {self.path or 'loaded before'} ({self.why})"


@dataclass(frozen=True)
class Machine:
    env: Mapping[str, str]
    wheel: tuple[Path, ...]
    """Libraries of the installed wheel."""
    system: tuple[Path, ...]
    """Other LLVM libraries that exist."""
    system_name: str = "Linux"
    architecture: str = "x86_64"
    has_cuda: Callable[[], bool] = lambda: False
    """Whether a driver of CUDA can be loaded; called only where no LLVM is found, since it is slow."""

    @classmethod
    def here(cls) -> Machine:
        return cls(
            env=os.environ,
            wheel=tuple(wheel_libraries(Path(sys.prefix))),
            system=tuple(system_libraries(library_directories(Path(sys.prefix)))),
            system_name=platform.system(),
            architecture=platform.machine(),
            has_cuda=cuda_driver,
        )


def choose(machine: Machine) -> Choice:
    """Return the library to load on `machine`, or raise `LLVMNotFoundError`."""
    named = machine.env.get(VARIABLE)
    if named and not (named == os.devnull and machine.has_cuda()):
        path = Path(named)
        if not path.is_file():
            raise LLVMNotFoundError(
                f"{VARIABLE}={named!r} names no file. Unset {VARIABLE} to let mitsuba_bdpt choose, "
                "or set it to the path of a libLLVM shared library."
            )
        return Choice(path, "variable", f"named by {VARIABLE}", major_version(path))
    if named:
        return _without_llvm(f"{VARIABLE}={named} asks for none")
    for path in machine.wheel:
        if major_version(path) in KNOWN_GOOD:
            return Choice(path, "wheel", f"installed by {WHEEL}", major_version(path))
    usable = [path for path in machine.system if major_version(path) in KNOWN_GOOD]
    if usable:
        # max() keeps the search order on ties.
        path = max(usable, key=lambda path: major_version(path) or 0)
        return Choice(path, "system", "found on the system, known to work", major_version(path))
    found = _describe(machine.wheel + machine.system)
    if machine.has_cuda():
        return _without_llvm(found)
    raise LLVMNotFoundError(
        f"No usable LLVM library: {found}. Versions known to work: {_versions()}. {remedy(machine)}"
    )


def _without_llvm(found: str) -> Choice:
    why = f"no usable LLVM ({found}): only variants of CUDA can be used"
    return Choice(None, "none", why, None)


def check_loaded(version: tuple[int, ...], machine: Machine) -> Choice:
    """Check the LLVM `version` of a Dr.Jit that was imported before this package.

    `version`: result of ``drjit.detail.llvm_version()``, negative if there is none.
    """
    how = (
        "Import mitsuba_bdpt before drjit and mitsuba (where an import sorter puts it below them: "
        f"`import mitsuba_bdpt  # isort: skip`), or {_before_start(machine)} (later it has no effect)."
    )
    if version[0] < 0 and machine.has_cuda():
        return _without_llvm("drjit was imported first and found none")
    if version[0] < 0:
        raise LLVMNotFoundError(f"drjit was imported first and found no usable LLVM. {how}")
    if version[0] < min(KNOWN_GOOD):
        number = ".".join(map(str, version))
        raise LLVMNotFoundError(
            f"drjit was imported first and loaded LLVM {number}, which is too old: versions below "
            f"{min(KNOWN_GOOD)} can abort the process. {how}"
        )
    return Choice(None, "drjit", "loaded by drjit, which was imported first", version[0])


def prepare() -> Choice:
    """Choose a library and set ``DRJIT_LIBLLVM_PATH``, or check an imported Dr.Jit."""
    drjit = sys.modules.get("drjit")
    if drjit is None:
        finish_installation()
        machine = Machine.here()
        choice = choose(machine)
        if choice.path or machine.wheel or machine.system:
            # Keeps Dr.Jit from loading an unusable library by itself.
            os.environ[VARIABLE] = str(choice.path or os.devnull)
        return choice
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is not None and (mitsuba.variant() or "").startswith("cuda"):
        return Choice(None, "none", "the current variant runs on CUDA", None)
    return check_loaded(drjit.detail.llvm_version(), Machine.here())


def finish_installation() -> None:
    """Start a Python that finishes the installation of the wheel, where that is pending.

    The wheel's links, without which its libLLVM finds no libc++, are made by wheel-axle when Python starts.
    A process that has installed the wheel itself, such as a notebook's, started before.
    """
    try:
        wheel = importlib.metadata.distribution(WHEEL)
    except importlib.metadata.PackageNotFoundError:
        return
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
        set_options(b"-opt-bisect-limit=%d" % _ALL_PASSES)
        _quick.reset(before)


@functools.cache
def _option_setter() -> Callable[..., None] | None:
    """Return what sets options of the LLVM library in use; None if that is unknown or untested."""
    drjit = sys.modules["drjit"]
    path = os.environ.get(VARIABLE, "")
    version = major_version(Path(path)) if path else None
    if version not in KNOWN_GOOD or drjit.detail.llvm_version()[0] != version:
        return None
    try:
        library = ctypes.CDLL(path)  # the copy that Dr.Jit has opened
        parse = library.LLVMParseCommandLineOptions
    except (OSError, AttributeError):
        return None

    def set_options(*options: bytes) -> None:
        arguments = (ctypes.c_char_p * (1 + len(options)))(b"mitsuba_bdpt", *options)
        parse(len(arguments), arguments, b"")

    return set_options


def cuda_driver() -> bool:
    try:
        ctypes.CDLL("nvcuda.dll" if platform.system() == "Windows" else "libcuda.so.1")
    except OSError:
        return False
    return True


def _before_start(machine: Machine) -> str:
    """Return what to do before Python starts so that Dr.Jit loads a usable LLVM."""
    try:
        path = choose(replace(machine, env={}, has_cuda=lambda: False)).path
    except LLVMNotFoundError:
        return f"install a newer one and set {VARIABLE} to its path before Python starts"
    return f"set {VARIABLE}={path} before Python starts"


def major_version(path: Path) -> int | None:
    """Read the major version from the name of a library or of its directory."""
    for name in dict.fromkeys((path, path.resolve())):
        match = re.search(r"libLLVM-(\d+)|libLLVM\.so\.(\d{2,})|libLLVM\.(\d{2,})", name.name)
        match = match or re.search(r"/llvm[@/-]?(\d{2,})", name.parent.as_posix())
        if match:
            return int(next(group for group in match.groups() if group))
    return None


def wheel_libraries(prefix: Path) -> list[Path]:
    """Return the wheel's existing libLLVM files."""
    try:
        files = importlib.metadata.distribution(WHEEL).files or []
    except importlib.metadata.PackageNotFoundError:
        return []
    listed = [Path(str(file.locate())) for file in files if _LIBRARY.fullmatch(file.name)]
    # Some installers omit the list of files.
    return _existing([*listed, *sorted((prefix / "lib").glob("libLLVM.so.*"))])


def system_libraries(directories: Iterable[Path]) -> list[Path]:
    """Return the libLLVM files in `directories`, without duplicates."""
    found: list[Path] = []
    for directory in directories:
        names = sorted(directory.glob("libLLVM*")) if directory.is_dir() else []
        found += [path for path in names if _LIBRARY.fullmatch(path.name)]
    return _existing(found)


def library_directories(prefix: Path) -> list[Path]:
    """Directories where Linux distributions, conda and Homebrew install libLLVM."""
    fixed = [prefix / "lib"]
    fixed += [Path(f"/usr/lib/{machine}-linux-gnu") for machine in ("x86_64", "aarch64")]
    fixed += [Path("/usr/lib64"), Path("/usr/lib"), Path("/usr/local/lib")]
    patterns = ["usr/lib/llvm*/lib", "usr/lib64/llvm*/lib*", "usr/lib/llvm/*/lib*"]
    patterns += ["opt/homebrew/opt/llvm*/lib", "usr/local/opt/llvm*/lib"]
    globbed = [path for pattern in patterns for path in sorted(Path("/").glob(pattern))]
    return fixed + globbed


def remedy(machine: Machine) -> str:
    """Return the command that installs a usable LLVM on `machine`."""
    if machine.system_name == "Linux" and machine.architecture == "x86_64":
        command = f"python -m pip install '{WHEEL}==23.1.*'"
    elif machine.system_name == "Darwin":
        command = "brew install llvm@19"
    elif machine.system_name == "Linux":
        command = "apt install libllvm19"
    else:
        return f"Install LLVM 19 and set {VARIABLE} to the path of its shared library."
    return f"Mend it with: {command}"


def _existing(paths: Iterable[Path]) -> list[Path]:
    """Return the existing files among `paths`, resolved and without duplicates."""
    return list(dict.fromkeys(path.resolve() for path in paths if path.is_file()))


def _versions() -> str:
    return ", ".join(map(str, KNOWN_GOOD))


def _describe(paths: Iterable[Path]) -> str:
    """List the libraries found and the reason why each is rejected."""
    texts: list[str] = []
    for path in paths:
        version = major_version(path)
        if version is None:
            texts.append(f"{path} (version unknown; to try it, set {VARIABLE})")
        elif version < min(KNOWN_GOOD):
            texts.append(f"{path} (LLVM {version}, too old)")
        else:
            texts.append(f"{path} (LLVM {version}, untested; to try it, set {VARIABLE})")
    return "found only " + "; ".join(texts) if texts else "none was found"
