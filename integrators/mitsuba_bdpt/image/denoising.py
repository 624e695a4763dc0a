"""Denoising by Intel's Open Image Denoise (package mitsuba-oidn).

Auxiliary images are albedo and shading normal of the first surface, both prefiltered (see its documentation).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ..errors import UsageError

# Features for the denoiser, as pairs of Mitsuba's ``aov``; `FeatureLayers` has the normals in world space.
GUIDES = "bdpt_albedo:albedo,bdpt_normal:sh_normal"

# Their channels.
ALBEDO, NORMAL = slice(0, 3), slice(3, 6)
GUIDE_CHANNELS = 6


def check_installed() -> None:
    """Raise ``UsageError`` if mitsuba-oidn is not installed."""
    try:
        import mitsuba_oidn  # noqa: F401
    except ImportError as error:
        raise UsageError(
            f"layers=denoised needs mitsuba-oidn ({error}); install it with: pip install "
            "'mitsuba-bdpt[denoise]'"
        ) from error


def denoised(colours: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Denoise the linear image ``colours``.

    All arrays have shape (height, width, 3), single precision. ``normal``: in world space, of length up to 1.
    ``normal`` and ``albedo`` are 0 where pixels see no surface.
    """
    clean = {"albedo": _filtered({"albedo": albedo}), "normal": _filtered({"normal": normal})}
    return _filtered({"color": colours} | clean)


def _filtered(images: dict[str, np.ndarray]) -> np.ndarray:
    """Denoise the first of ``images``; the others are auxiliary."""
    first = next(iter(images.values()))
    images = {name: np.ascontiguousarray(image, np.float32) for name, image in images.items()}
    found = np.empty(first.shape, np.float32)
    work = _device().new_filter("RT")
    for name, image in images.items():
        work.set_image(name, image)
    work.set_image("output", found)
    if "color" in images:
        work.hdr, work.clean_aux = True, True
    work.execute()
    return found


@cache
def _device() -> Any:
    """Return the CPU device, on every machine: images do not depend on its GPUs."""
    import mitsuba_oidn

    return mitsuba_oidn.Device(mitsuba_oidn.DeviceType.CPU)
