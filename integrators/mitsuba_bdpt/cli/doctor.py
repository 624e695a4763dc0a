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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba_bdpt

from ..host import llvm

PACKAGES = ("mitsuba", "drjit", "numpy", "OpenEXR", llvm.WHEEL)
TIME_LIMIT = 300
"""Seconds for the test image: a cold start takes two or three, a busy machine longer."""

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


@dataclass(frozen=True)
class Finding:
    """One line of the report. `state` is ``ok``, ``note`` or ``FAIL``."""

    state: str
    subject: str
    text: str

    def __str__(self) -> str:
        return f"{self.state:>4}  {self.subject:<20}{self.text}"


def run(variant: str) -> int:
    """Print the report for `variant`; returns 0 if bdpt works with it, else 1."""
    findings = [*versions(), llvm_library(), kernel_cache()]
    for finding in findings:
        print(finding, flush=True)
    if mitsuba_bdpt.failure is None:
        found = render_in_child(variant)
        print(*found, sep="\n", flush=True)
        findings += found
    works = all(finding.state != "FAIL" for finding in findings)
    print("mitsuba_bdpt works." if works else "mitsuba_bdpt does not work; see FAIL above.")
    return 0 if works else 1


def versions() -> list[Finding]:
    findings = [
        Finding("ok", "python", f"{platform.python_version()}, {sys.executable}"),
        Finding("ok", "platform", f"{platform.system()} {platform.machine()}"),
        Finding("ok", "mitsuba-bdpt", mitsuba_bdpt.__version__),
    ]
    for package in PACKAGES:
        try:
            findings.append(Finding("ok", package, importlib.metadata.version(package)))
        except importlib.metadata.PackageNotFoundError:
            text = f"not installed; mend it with: python -m pip install {package}"
            # The LLVM wheel exists for one platform only; `llvm_library` reports whether it is needed.
            found = ("note", package, "not installed") if package == llvm.WHEEL else ("FAIL", package, text)
            findings.append(Finding(*found))
    return findings


def llvm_library() -> Finding:
    failure, choice = mitsuba_bdpt.failure, mitsuba_bdpt.llvm_choice
    if failure is not None or choice is None:
        subject = "LLVM" if isinstance(failure, llvm.LLVMNotFoundError) else "import"
        return Finding("FAIL", subject, str(failure))
    if choice.version in llvm.KNOWN_GOOD or not (choice.path or choice.version):
        return Finding("ok", "LLVM", str(choice))
    return Finding(
        "note", "LLVM", f"{choice}; versions known to work: {', '.join(map(str, llvm.KNOWN_GOOD))}"
    )


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
) -> list[Finding]:
    """Render 16x16 pixels of the Cornell box in a child process; report its outcome."""
    command = [sys.executable, "-c", PROBE, variant]
    try:
        child = start(command, capture_output=True, text=True, errors="replace", timeout=TIME_LIMIT)
    except subprocess.TimeoutExpired:
        return [Finding("FAIL", "test image", f"not finished after {TIME_LIMIT} seconds")]
    report: dict = {}
    for line in child.stdout.splitlines():
        report |= json.loads(line) if line.startswith("{") else {}
    findings = [threads(report["threads"])] if "threads" in report else []
    if "variants" in report:
        findings.append(variants(report["variants"], report.get("backends", [])))
    return [*findings, Finding(*judge(child, report, variant))]


def threads(count: int) -> Finding:
    """Report Dr.Jit's ``count`` of threads, and why there are two on one processor."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    why = ", two of which Mitsuba needs to read and write EXR files" if available == 1 < count else ""
    return Finding("ok", "threads", f"{count}{why}; processors: {available}")


def variants(installed: list[str], backends: list[str]) -> Finding:
    """Report which ``installed`` variants bdpt can use, and why not the others.

    ``backends``: ``LLVM`` or ``CUDA``, if its library or driver and device are found.
    """
    reasons: dict[str, list[str]] = {}
    for name in installed:
        reasons.setdefault(why_not(name, backends), []).append(name)
    here = reasons.pop("", [])
    others = [f"{', '.join(names)} ({why})" for why, names in reasons.items()]
    text = f"here: {', '.join(here) or 'none'}" + (f"; not: {'; '.join(others)}" if others else "")
    return Finding("ok" if here else "note", "variants", text)


def why_not(variant: str, backends: list[str]) -> str:
    """Return why bdpt cannot render with ``variant``; empty if it can."""
    reasons = {
        "scalar": "bdpt has no scalar variant",
        "metal": "bdpt does not support Metal",
        "cuda": "" if "CUDA" in backends else "no CUDA device or driver was found",
        "llvm": "" if "LLVM" in backends else "no LLVM library was found",
    }
    return reasons[variant.partition("_")[0]]


def judge(child: subprocess.CompletedProcess, report: dict, variant: str) -> tuple[str, str, str]:
    """Return the finding about the `child`, which printed `report`."""
    last = (child.stderr.strip().splitlines() or ["it printed no error"])[-1]
    mean = report.get("mean", float("nan"))
    if child.returncode < 0:
        text = f"the process rendering it was killed by {signal.Signals(-child.returncode).name} ({last})."
        if variant.startswith("llvm"):
            text += f" The usual reason is an LLVM version that Dr.Jit cannot use. {crash_remedy()}"
    elif child.returncode > 0:
        reason = why_not(variant, report["backends"]) if "backends" in report else ""
        text = f"{variant} cannot render here: {reason}" if reason else last
    # The box reflects less than its lamp emits, and no part of it is black.
    elif not 0.01 < mean < 10:
        text = f"rendered with {variant}, but its mean is {mean:g}"
    else:
        with_llvm = f", LLVM {report['llvm']}" if report.get("llvm") else ""
        return "ok", "test image", f"rendered with {variant}{with_llvm}, mean {mean:.3f}"
    return "FAIL", "test image", text


def crash_remedy() -> str:
    choice = mitsuba_bdpt.llvm_choice
    if choice is not None and choice.why == llvm.NAMED:
        return f"Unset {llvm.VARIABLE}; it names {str(choice.path)!r}."
    return llvm.remedy()
