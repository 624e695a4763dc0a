"""Sensors that lack what their camera rays need: an error that names the sensor and the remedy."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.errors import UnsupportedError, UsageError

PIXEL = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
METER = {"type": "irradiancemeter", "film": PIXEL}
T = mi.ScalarTransform4f
BACK = T().translate([0, 0, -3])
CAMERA = {"type": "perspective", "to_world": BACK}
ORTHOGRAPHIC = {"type": "orthographic", "film": PIXEL}
LENS = {"type": "thinlens", "to_world": BACK, "aperture_radius": 0.1, "focus_distance": 3.0}
NAN, INFINITE = float("nan"), float("inf")
NOWHERE = {"type": "rectangle", "to_world": T().scale(0)}


def grid():
    """A shape of which Mitsuba samples no points."""
    return {
        "type": "sdfgrid",
        "grid": mi.TensorXf(np.linspace(-0.5, 0.5, 8, dtype=np.float32).reshape(2, 2, 2, 1)),
    }


def batch(*views):
    """A batch of these views, each a pixel wide."""
    film = PIXEL | {"width": len(views)}
    return {"type": "batch", "film": film} | {f"view{i}": view for i, view in enumerate(views)}


def distant(**parameters):
    return {"type": "distant", "film": PIXEL, **parameters}


def meter(sensor="eye"):
    return rf"irradiance meter '{sensor}' is on no shape; nest it in the shape"


SINGULAR = "is not finite, or cannot be inverted .*scale that is not 0"
LACKING = {
    "meter": (lambda: METER, meter()),
    "meter without area": (
        lambda: NOWHERE | {"s": METER},
        r"irradiance meter 's' is on a shape without area",
    ),
    "batch of a meter": (lambda: batch(METER), meter("view0")),
    "batch of a camera and a meter": (lambda: batch(CAMERA, METER), meter("view1")),
    "batch in a batch": (lambda: batch(CAMERA, batch(METER)), meter("view0")),
    "batch of a meter on a grid": (
        lambda: batch(CAMERA, grid() | {"s": METER}),
        "irradiance meter 's' is on a SDFGrid.*put it on another shape",
    ),
    "batch of a distant": (lambda: batch(CAMERA, distant()), "'view1' is not one of the scene's own sensors"),
    "distant without direction": (lambda: distant(direction=[0, 0, 0]), f"distant sensor 'eye' {SINGULAR}"),
    "distant on nothing": (lambda: distant(target=NOWHERE), "of distant sensor 'eye' are not finite.*target"),
    "distant on a grid": (lambda: distant(target=grid()), "of distant sensor 'eye' are not finite.*target"),
    "radiance meter": (
        lambda: {"type": "radiancemeter", "film": PIXEL, "origin": [0, 0, -3], "direction": [0, 0, 0]},
        f"radiance meter 'eye' {SINGULAR}",
    ),
    "camera nowhere": (
        lambda: CAMERA | {"to_world": T().translate([NAN, 0, 0])},
        f"perspective camera 'eye' {SINGULAR}",
    ),
    "camera far aside": (
        lambda: CAMERA | {"principal_point_offset_x": 1e9},
        "perspective camera 'eye' are the same .*principal_point_offset_x=1e.09",
    ),
    "camera too near": (
        lambda: CAMERA | {"near_clip": 1e-30},
        "'eye' are not finite; look at near_clip=1e-30",
    ),
    "camera to infinity": (lambda: CAMERA | {"far_clip": INFINITE}, "far_clip=inf of .*'eye' must be finite"),
    "flat camera": (lambda: ORTHOGRAPHIC | {"to_world": T().scale([1, 0, 1])}, f"camera 'eye' {SINGULAR}"),
    "camera without depth": (
        lambda: ORTHOGRAPHIC | {"to_world": T().scale([1, 1, 0])},
        f"orthographic camera 'eye' {SINGULAR}",
    ),
    "lens in focus nowhere": (
        lambda: LENS | {"focus_distance": 0.0},
        "focus_distance=0 of thinlens camera 'eye' must be greater than 0",
    ),
    "lens in focus behind": (lambda: LENS | {"focus_distance": -1.0}, "focus_distance=-1 of .* than 0"),
    "lens without size": (lambda: LENS | {"aperture_radius": NAN}, "aperture_radius=nan of .* be finite"),
}


@pytest.mark.parametrize("name", LACKING)
def test_what_a_sensor_lacks_is_said(name):
    """With such sensors Mitsuba ends the process, or renders black, NaN or what is not asked for."""
    make, message = LACKING[name]
    scene = mi.load_dict(
        {"type": "scene", "ball": {"type": "sphere"}, "sky": {"type": "constant"}, "eye": make()}
    )
    with pytest.raises((UsageError, UnsupportedError), match=f"bdpt: .*{message}"):
        mi.load_dict({"type": "bdpt"}).render(scene, sensor=scene.sensors()[-1], spp=1)


def test_a_distant_sensor_beside_the_scene_is_refused():
    """Mitsuba tells the sensors of a scene where it is. As a sensor of the scene, also in a batch, it sees
    the ball, of reflectance 1/2 under a sky of radiance 1, in both pixels."""
    parts = {"type": "scene", "ball": {"type": "sphere"}, "sky": {"type": "constant"}}
    loose = mi.load_dict(distant(target=[0, 0, 0]))
    with pytest.raises(UnsupportedError, match="not one of the scene's own sensors"):
        mi.load_dict({"type": "bdpt"}).render(mi.load_dict(parts), sensor=loose, spp=1)
    own = distant(target=[0, 0, 0]) | {"id": "own"}
    both = mi.load_dict(parts | {"own": own, "eye": batch(CAMERA, {"type": "ref", "id": "own"})})
    image = mi.load_dict({"type": "bdpt", "max_depth": 2}).render(both, sensor=both.sensors()[-1], spp=64)
    # Path tracing and light tracing of one pixel each: the error of 64 samples is about 0.03.
    assert np.array(image)[0, :, 0] == pytest.approx([0.5, 0.5], abs=0.15)
