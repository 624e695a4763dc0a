"""Every kind of lamp in scenes of other units: a scene in millimetres looks as it does in metres."""

import mitsuba as mi
import numpy as np
import pytest
from scene_parts import EMITTERS, T, grey, room, texture

SCALES = (2.0**-10, 2.0**10)

# Placed by a position or a frame, which does not stretch.
FRAMED = {"perspective", "point", "spot", "projector", "envmap", "sunsky"}


def of_scale(part, scale):
    """An entry of a scene with all lengths times ``scale``, lamps so that all radiances stay."""
    if not isinstance(part, dict):
        return part
    part, kind = dict(part), part["type"]
    if kind in FRAMED and "to_world" in part:
        matrix = np.array(part["to_world"].matrix)
        matrix[:3, 3] *= scale
        part["to_world"] = T(matrix)
    elif "to_world" in part:
        part["to_world"] = T().scale(scale) @ part["to_world"]
    for name in {"center", "p0", "p1", "position"} & part.keys():
        part[name] = [x * scale for x in part[name]]
    if "radius" in part:
        part["radius"] *= scale
    for name in {"intensity", "scale"} & part.keys() if kind in FRAMED - {"envmap"} else ():
        part[name] *= scale**2
    return part | ({"near_clip": 0.01 * scale, "far_clip": 1e4 * scale} if kind == "perspective" else {})


def on_shapes():
    """Shapes that lamps are on, by name, 0.3 wide, about the origin."""
    turn = T().rotate([0.26726124, 0.53452248, 0.80178373], 130)
    return {
        "rectangle": {"type": "rectangle", "to_world": turn.scale(0.15)},
        "flipped rectangle": {"type": "rectangle", "to_world": turn.scale(0.15), "flip_normals": True},
        "disk": {"type": "disk", "to_world": turn.scale(0.15)},
        "flipped disk": {"type": "disk", "to_world": turn.scale(0.15), "flip_normals": True},
        "sphere": {"type": "sphere", "to_world": T().scale(0.15)},
        "turned sphere": {"type": "sphere", "to_world": turn.scale(0.15)},
        "dome": {"type": "sphere", "to_world": T().scale(8), "flip_normals": True},
        "cylinder": {"type": "cylinder", "to_world": turn.scale([0.1, 0.1, 0.3])},
        "cube": {"type": "cube", "to_world": turn.scale(0.12)},
        "upright disk": {"type": "disk", "to_world": T().rotate([1, 0, 0], 90).scale(0.15)},
    }


def textures():
    """Textures by name; `texture` is a bitmap without interpolation."""
    checks = {"type": "checkerboard", "color0": 0.2, "color1": 5.0, "to_uv": T().scale([4, 4, 1])}
    return {"nearest": texture(), "bilinear": texture() | {"filter_type": "bilinear"}, "checks": checks}


def lamps_on_shapes(*radiances):
    """One lamp of each shape, beside each other, their radiances in turn."""
    found = {}
    for number, (name, shape) in enumerate(on_shapes().items()):
        radiance = radiances[number % len(radiances)]
        place = T().translate([(number % 6) * 0.6 - 1.5, 1.2 + 0.5 * (number // 6), 0.3])
        shape["to_world"] = place @ shape["to_world"]
        emitter = {"type": "area", "radiance": radiance}
        found[name] = shape | {"bsdf": grey(0.1), "emitter": emitter}
    return found


def some(*names):
    return {name: EMITTERS[name]() for name in names}


LAMPS = {
    "on shapes": lambda: lamps_on_shapes(5.0) | some("flat mesh", "smooth mesh", "mirrored mesh"),
    "textured": lambda: lamps_on_shapes(*textures().values()),
    "at a point": lambda: some(
        "point", "spot", "textured spot", "projector", "textured projector", "rotated envmap"
    ),
    "beams": lambda: some("directional", "directionalarea", "constant"),
    "sunsky": lambda: some("sunsky"),
}


@pytest.mark.parametrize("name", LAMPS)
def test_lamps_of_any_size(name):
    """Scales that are powers of two change no rounding. Tolerance: 1e-6 of the mean for the order of sums,
    and for lamps at a point, which are asked at a distance of 1 + |p|."""
    lamps, images = LAMPS[name](), []
    for scale in (1.0, *SCALES):
        parts = {key: of_scale(part, scale) for key, part in (room() | lamps).items()}
        scene = mi.load_dict(parts, optimize=False)  # which shuffles emitters
        bdpt = mi.load_dict({"type": "bdpt", "max_depth": 3, "skip": "none"})
        images.append(np.array(bdpt.render(scene, seed=1, spp=16), dtype=float))
        assert not bdpt.statistics["non_finite"]
    for scale, image in zip(SCALES, images[1:], strict=True):
        off = np.abs(image - images[0]).mean() / images[0].mean()
        assert off <= 1e-6, f"scale {scale:g}: {off:.1e} of the mean off"
