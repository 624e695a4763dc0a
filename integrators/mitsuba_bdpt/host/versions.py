"""Versions of the software that rendered an image."""

from __future__ import annotations

import importlib.metadata

import drjit as dr
import mitsuba as mi

from .._version import __version__


def versions() -> dict[str, str]:
    """Return the versions of this package, Mitsuba, Dr.Jit and LLVM."""
    found = {"mitsuba-bdpt": __version__}
    found |= {name: importlib.metadata.version(name) for name in ("mitsuba", "drjit")}
    if "llvm" in mi.variant():
        found["LLVM"] = ".".join(map(str, dr.detail.llvm_version()))
    return found
