"""Films of odd sizes, crop windows, and films that don't fit: part of the section on bad input."""

from __future__ import annotations

import os
from collections import Counter

import numpy as np

import mitsuba as mi  # isort: skip

from . import child
from .case import Outcome
from .counting import counted, short


def _film(width, height, **keys):
    """A room of radiance 1 (its walls give 0.5, reflect half), seen through a film of this size."""
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **keys}
    # Where there are no pixels the larger axis has no field of view, and Mitsuba would speak of that.
    axis = "larger" if min(width, height) > 0 else "x"
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60, "fov_axis": axis, "film": film},
            "wall": {
                "type": "sphere",
                "flip_normals": True,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 0.5}},
            },
        }
    )


# How far the mean of such an image may be off, and what each row and column has at least.
MEAN, LINE = 0.2, 0.5


def seen(films: dict[str, tuple], parameters: dict) -> Outcome:
    """Render the room with each film, and look for its radiance in the image, its rows and its columns."""
    counts, wrong, least_of_all = Counter(), [], np.inf
    bdpt = mi.load_dict({"type": "bdpt", **parameters})
    for words, (size, shape, keys) in films.items():
        try:
            image = np.array(bdpt.render(_film(*size, **keys), spp=16), dtype=np.float64)
        except (ValueError, RuntimeError) as error:
            counts["refused"] += 1
            window = keys.get("crop_width", size[0]), keys.get("crop_height", size[1])
            named = any(name in str(error) for name in ("width", "height", "crop", "{} x {}".format(*window)))
            if shape is not None or not named:
                wrong.append(f"{words}: {short(error)}")
        else:
            counts["rendered"] += 1
            if image.shape[:2] != shape or not np.isfinite(image).all():
                wrong.append(f"{words}: {image.shape}, not finite: {(~np.isfinite(image)).sum()}")
                continue
            # Roulette of long paths leaves noise; one-sidedness would be off by far more.
            least = min(image.mean((1, 2)).min(), image.mean((0, 2)).min())
            least_of_all = min(least_of_all, least)
            if abs(image.mean() - 1) > MEAN or least < LINE:
                wrong.append(f"{words}: mean {image.mean():.3g}, least of a row or column {least:.3g}")
    outcome = counted(counts, wrong)
    return Outcome(outcome.ok, f"{outcome.happened}; least mean of a row or column {least_of_all:.2g}")


def _crop(x, y, width, height):
    return {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}


SIZES = {
    f"{w} x {h}": ((w, h), shape, {})
    for w, h, shape in [
        (0, 0, None),
        (0, 8, None),
        (8, 0, None),
        (-1, 8, None),
        (1, 1, (1, 1)),
        (1, 7, (7, 1)),
        (301, 1, (1, 301)),
        (1, 4097, (4097, 1)),
        (40_000, 2, (2, 40_000)),
        (17, 13, (13, 17)),
    ]
}
CROPS = {
    f"{window} of 16 x 12": ((16, 12), shape, _crop(*window))
    for window, shape in [
        ((0, 0, 1, 1), (1, 1)),
        ((15, 11, 1, 1), (1, 1)),
        ((15, 0, 1, 12), (12, 1)),
        ((3, 5, 7, 1), (1, 7)),
        ((0, 0, 16, 12), (12, 16)),
        ((0, 0, 0, 0), None),
        ((4, 4, 0, 5), None),
        ((16, 12, 1, 1), None),
        ((8, 8, 9, 4), None),
        ((0, 0, 17, 1), None),
    ]
} | {"16 x 16 of 100000 x 100000": ((100_000, 100_000), (16, 16), _crop(50_000, 50_000, 16, 16))}

HUGE = """
import resource
width, height, memory = map(int, sys.argv[2:])
resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
scene = mi.load_dict({"type": "scene", "wall": {"type": "sphere", "emitter": {"type": "area"}}, "sensor": {
    "type": "perspective", "film": {"type": "hdrfilm", "width": width, "height": height}}})
integrator = mi.load_dict({"type": sys.argv[1], "max_depth": 2})
try:
    image = integrator.render(scene, spp=1)
    dr.eval(image)
    dr.sync_thread()
    print("image", image.shape)
except Exception as error:
    print(type(error).__name__, " ".join(str(error).split()))
"""

# What a process of these may take, in bytes, so that nothing else suffers; too little for any of them.
HUGE_MEMORY = 8 << 30


def huge() -> Outcome:
    """Films that don't fit into this machine's memory, or whose numbers can't be counted in 32 bits."""
    side = int((os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 100) ** 0.5)
    happened, ok = [], True
    for width, height in ((side, side), (65_536, 65_536), (100_000, 100_000), (2**31 - 1, 3)):
        said = {"path": "not tried"}  # it would take the memory
        for kind in ("bdpt",) if width == side else ("bdpt", "path"):
            done = child.python(HUGE, kind, str(width), str(height), str(HUGE_MEMORY))
            said[kind] = done.stdout.strip() or f"ends with status {done.returncode}"
        ok &= said["bdpt"].startswith("UsageError bdpt: the film of ")
        happened.append(f"{width} x {height}: {short(said['bdpt'], 90)} (`path`: {short(said['path'], 60)})")
    return Outcome(ok, "; ".join(happened))
