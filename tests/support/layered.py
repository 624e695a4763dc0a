"""A small scene under several emitters, and renders of it divided into layers."""

import json

import mitsuba as mi
import numpy as np

from scenes import DOWNWARDS, area, camera, floor, matte, rgb, square
from scenes import ball as sphere

# Radiance, or intensity, of each emitter.
LAMPS = {"panel": (5, 1, 1), "globe": (0, 3, 1), "bulb": (0, 0, 4), "sky": (0.1, 0.1, 0.1)}

# One connection to one of four light subpaths in each lane.
JOINED = json.dumps(
    [
        {"light_paths": 1 / 16, "connections": "one", "joined": 4}
        | {"coefficients": {"t<=1": 1.0, "s=1": 1.0}, "cost": 1.0, "variance": 0.0, "mean": 0.0}
    ]
)


def scene(lit=tuple(LAMPS), medium=None, rfilter="gaussian", ball=None, wall=None, **crop):
    """A floor, a wall and a ball of glass under four emitters, black but those in ``lit`` (names, or their
    radiances). ``ball``, ``wall``: other BSDFs."""

    def light(name):
        colours = lit if isinstance(lit, dict) else LAMPS
        return rgb(*(float(x) * (name in lit) for x in colours[name]))

    view = camera(origin=(0, 0, 4), target=(0, 0, 0), fov=50, size=8, rfilter=rfilter, near=0.01, film=crop)
    view |= {} if medium is None else {"medium": medium}
    dark = matte(0)
    parts = {
        "sensor": view,
        "floor": floor(-1, 3),
        "wall": square((0, 0, -1.5), size=3, bsdf=wall),
        "ball": sphere(ball or {"type": "dielectric"}, 0.6),
        "panel": square((0, 2, 0), DOWNWARDS, 0.5, dark, light=area(light("panel"))),
        "globe": sphere(dark, 0.3, (1.5, 0, 0), light=area(light("globe"))),
        "bulb": {"type": "point", "position": [-1.5, 1, 1], "intensity": light("bulb")},
        "sky": {"type": "constant", "radiance": light("sky")},
    }
    return mi.load_dict({"type": "scene"} | parts, optimize=False)


def layers(integrator, target, spp=8, seed=3, kind="groups"):
    """The image (height, width, colours), and that of each layer of a ``kind``, by name."""
    image = np.array(integrator.render(target, spp=spp, seed=seed), dtype=np.float64)
    names = integrator.aov_names()
    first = image.shape[-1] - len(names)
    found = {}
    for i, name in enumerate(names):
        if name.startswith(f"{kind}."):
            found.setdefault(name.split(".")[1], []).append(image[..., first + i])
    return image[..., :first], {layer: np.stack(channels, axis=-1) for layer, channels in found.items()}


def check_sum(image, layers):
    """The layers add up to the image up to the rounding of single precision (2^-24 for each of some hundred
    additions, relative to the brightest pixel, whose filtered samples a pixel may share)."""
    assert sum(layer.max() > 0 for layer in layers.values()) > 1
    np.testing.assert_allclose(sum(layers.values()), image, rtol=0, atol=2e-5 * image.max())
