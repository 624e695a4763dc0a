"""Dictionaries of BSDFs that hold others; made on demand, since bitmaps need the variant."""

import mitsuba as mi
import numpy as np


def picture(pixels, **keys):
    """A texture of raw pixels (height, width, channels)."""
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32))
    return {"type": "bitmap", "raw": True, "bitmap": bitmap, **keys}


def bumps(nested):
    """Smooth waves (a checkerboard has no gradient)."""
    x = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    waves = 0.5 + 0.5 * np.sin(x)[:, None] * np.cos(x)[None, :]
    return {"type": "bumpmap", "scale": 0.1, "texture": picture(waves[..., None]), "nested": nested}


def tilted(nested):
    """A frame tilted by 20 degrees everywhere."""
    normal = np.array([np.sin(0.35) * 0.8, np.sin(0.35) * 0.6, np.cos(0.35)])
    pixels = np.broadcast_to(0.5 + 0.5 * normal, (2, 2, 3))
    return {"type": "normalmap", "normalmap": picture(pixels), "nested": nested}


def blend(weight, a, b):
    return {"type": "blendbsdf", "weight": weight, "a": a, "b": b}
