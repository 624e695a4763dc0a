"""Versions of what makes an image."""

from __future__ import annotations

import importlib.metadata

import drjit as dr
import mitsuba as mi

from .._version import __version__


def versions() -> dict[str, str]:
    """Versions of what has made the image."""
    found = {"mitsuba-bdpt": __version__}
    found |= {name: importlib.metadata.version(name) for name in ("mitsuba", "drjit")}
    if "llvm" in mi.variant():
        found["LLVM"] = ".".join(map(str, dr.detail.llvm_version()))
    return found
