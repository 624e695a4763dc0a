"""A small camera and its film, for scenes of tests."""

from __future__ import annotations

import mitsuba as mi


def camera(
    kind="perspective",
    origin=(0.1, -0.05, 0.5),
    target=(0, 0, -1),
    fov=60,
    size=16,
    near=0.05,
    pixel_format="rgb",
    **more,
):
    """A camera of this ``kind`` with a box filter; ``more`` of its parameters."""
    return {
        "type": kind,
        "fov": fov,
        "near_clip": near,
        "far_clip": 50,
        "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0]),
        "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "rfilter": {"type": "box"},
            "pixel_format": pixel_format,
            "component_format": "float32",
        },
        **more,
    }


def thinlens(**more):
    """The camera with a small lens."""
    return camera("thinlens", aperture_radius=0.08, focus_distance=1.2, **more)
