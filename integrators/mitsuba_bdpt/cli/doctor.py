"""``python -m mitsuba_bdpt doctor``: checks the installation.

Imports only the standard library and `llvm`, since Mitsuba may be missing. What may fail or abort runs in a
child process.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import mitsuba_bdpt

from ..host import llvm

PACKAGES = ("mitsuba", "drjit", "numpy", "OpenEXR", llvm.WHEEL)
TIME_LIMIT = 300  # seconds for the test image: a cold start takes two or three, a busy machine longer

PROBE = """
import json, sys
import mitsuba_bdpt
import drjit as dr, mitsuba as mi
backends = [name for name in ("LLVM", "CUDA") if dr.has_backend(getattr(dr.JitBackend, name))]
threads = dr.thread_count()
print(json.dumps({"variants": mi.variants(), "backends": backends, "threads": threads}), flush=True)
mi.set_variant(sys.argv[1])
scene = mi.cornell_box()
scene["integrator"] = {"type": "bdpt", "max_depth": 4}
scene["sensor"]["film"].update(width=16, height=16)
image = mi.render(mi.load_dict(scene), spp=16)
print(json.dumps({
    "llvm": ".".join(map(str, dr.detail.llvm_version())) if "llvm" in sys.argv[1] else "",
    "mean": float(dr.mean(image, axis=None).array[0]),
}), flush=True)
"""


class Finding(NamedTuple):
    """One line of the report. `state` is ``ok``, ``note`` or ``FAIL``."""

    state: str
    subject: str
    text: str

    def __str__(self) -> str:
        return f"{self.state:>4}  {self.subject:<20}{self.text}"


def run(variant: str) -> int:
    """Print the report for `variant`; returns 0 if bdpt works with it, else 1."""
    works = True
    for finding in findings(variant):
        print(finding, flush=True)
        works = works and finding.state != "FAIL"
    print("mitsuba_bdpt works." if works else "mitsuba_bdpt does not work; see FAIL above.")
    return 0 if works else 1


def findings(variant: str) -> Iterator[Finding]:
    yield from versions()
    yield llvm_library()
    yield kernel_cache()
    if mitsuba_bdpt.failure is None:
        yield from render_in_child(variant)


def versions() -> Iterator[Finding]:
    yield Finding("ok", "python", f"{platform.python_version()}, {sys.executable}")
    yield Finding("ok", "platform", f"{platform.system()} {platform.machine()}")
    yield Finding("ok", "mitsuba-bdpt", mitsuba_bdpt.__version__)
    for package in PACKAGES:
        try:
            yield Finding("ok", package, importlib.metadata.version(package))
        except importlib.metadata.PackageNotFoundError:
            if package == llvm.WHEEL:  # for one platform only; `llvm_library` reports whether it is needed
                yield Finding("note", package, "not installed")
            else:
                remedy = f"install it with: python -m pip install {package}"
                yield Finding("FAIL", package, f"not installed; {remedy}")


def llvm_library() -> Finding:
    failure, choice = mitsuba_bdpt.failure, mitsuba_bdpt.llvm_choice
    if failure is not None or choice is None:
        subject = "LLVM" if isinstance(failure, llvm.LLVMNotFoundError) else "import"
        return Finding("FAIL", subject, str(failure))
    if choice.version in llvm.KNOWN_GOOD or not (choice.path or choice.version):
        return Finding("ok", "LLVM", str(choice))
    known = ", ".join(map(str, llvm.KNOWN_GOOD))
    return Finding("note", "LLVM", f"{choice}; versions known to work: {known}")


def kernel_cache() -> Finding:
    folder = Path(os.environ.get("DRJIT_CACHE_DIR") or Path.home() / ".drjit")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return Finding("ok", "kernel cache", f"{folder} is writable")
    except OSError as error:
        text = f"{folder} is not writable ({error.strerror}): every process compiles anew. "
        return Finding("note", "kernel cache", text + "Set DRJIT_CACHE_DIR to a writable directory.")


def render_in_child(
    variant: str, start: Callable[..., subprocess.CompletedProcess] = subprocess.run
) -> Iterator[Finding]:
    """Render 16x16 pixels of the Cornell box in a child process; report its outcome."""
    command = [sys.executable, "-c", PROBE, variant]
    try:
        child = start(command, capture_output=True, text=True, errors="replace", timeout=TIME_LIMIT)
    except subprocess.TimeoutExpired:
        yield Finding("FAIL", "test image", f"not finished after {TIME_LIMIT} seconds")
        return
    report: dict = {}
    for line in child.stdout.splitlines():
        report |= json.loads(line) if line.startswith("{") else {}
    if "threads" in report:
        here = [name for name in report["variants"] if not why_not(name, report["backends"])]
        yield Finding("ok", "threads", f"{report['threads']}; processors: {os.cpu_count()}")
        yield Finding("ok" if here else "note", "variants", f"here: {', '.join(here) or 'none'}")
    yield judge(child, report, variant)


def why_not(variant: str, backends: list[str]) -> str:
    """Return why bdpt cannot render with ``variant``; empty if it can.

    ``backends``: ``LLVM`` or ``CUDA``, if its library or driver and device are found.
    """
    backend = variant.partition("_")[0].upper()
    if backend not in ("LLVM", "CUDA"):
        return f"bdpt does not support variants of {backend.lower()}"
    return "" if backend in backends else f"no {backend} library, driver or device was found"


def judge(child: subprocess.CompletedProcess, report: dict, variant: str) -> Finding:
    """Return the finding about the `child`, which printed `report`."""
    text = (child.stderr.strip().splitlines() or ["it printed no error"])[-1]
    mean = report.get("mean", float("nan"))
    if child.returncode < 0:
        text = f"the process rendering it was killed by {signal.Signals(-child.returncode).name} ({text})."
        if variant.startswith("llvm"):
            choice, remedy = mitsuba_bdpt.llvm_choice, llvm.remedy()
            if choice is not None and choice.why == llvm.NAMED:
                remedy = f"Unset {llvm.VARIABLE}; it names {str(choice.path)!r}."
            text += f" The usual reason is an LLVM version that Dr.Jit cannot use. {remedy}"
    elif child.returncode > 0:
        if "backends" in report and (reason := why_not(variant, report["backends"])):
            text = f"{variant} cannot render here: {reason}"
    # The box reflects less than its lamp emits, and no part of it is black.
    elif not 0.01 < mean < 10:
        text = f"rendered with {variant}, but its mean is {mean:g}"
    else:
        with_llvm = f", LLVM {report['llvm']}" if report.get("llvm") else ""
        return Finding("ok", "test image", f"rendered with {variant}{with_llvm}, mean {mean:.3f}")
    return Finding("FAIL", "test image", text)
