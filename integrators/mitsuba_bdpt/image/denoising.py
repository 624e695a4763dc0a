"""Denoised images, by Intel's Open Image Denoise in the package mitsuba-oidn.

It is told what the first surfaces look like: their albedo and shading normals, which are made clean on their
own first (so does its documentation, "prefiltering").
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ..errors import UsageError

# What `FeatureLayers` is asked for, beside what a user asks for: pairs as of Mitsuba's ``aov``, whose normals
# of bump maps are not in the world's coordinates.
WORLD_NORMAL = "world_normal"
GUIDES = f"bdpt_albedo:albedo,bdpt_normal:{WORLD_NORMAL}"

# Channels of these.
ALBEDO, NORMAL = slice(0, 3), slice(3, 6)
GUIDE_CHANNELS = 6


def check_installed() -> None:
    """Raise ``UsageError`` if mitsuba-oidn is not there."""
    try:
        import mitsuba_oidn  # noqa: F401
    except ImportError as error:
        raise UsageError(
            f"denoise=True needs mitsuba-oidn ({error}); install it with: pip install 'mitsuba-bdpt[denoise]'"
        ) from error


def denoised(colours: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The image ``colours``, linear, without noise; all of shape (height, width, 3), in single precision.

    ``normal`` in world space, of any length up to 1: where pixels see no surface it is 0, as ``albedo`` is.
    """
    clean = {"albedo": _filtered({"albedo": albedo}), "normal": _filtered({"normal": normal})}
    return _filtered({"color": colours} | clean)


def _filtered(images: dict[str, np.ndarray]) -> np.ndarray:
    """The first of ``images`` without noise, by what the others tell."""
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
    """The processor: what is denoised is in its memory, and no image depends on the machine's cards."""
    import mitsuba_oidn

    return mitsuba_oidn.Device(mitsuba_oidn.DeviceType.CPU)
