"""What edges through media count: segments, each with a ray of its own, and tentative collisions in grids."""

import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest


def statistics(scene, spp=64, **parameters):
    method = parts.integrator(max_depth=4, **parameters)
    method.render(mi.load_dict(scene), spp=spp)
    return method.statistics


@pytest.mark.parametrize("skip", ["none", "auto"])
def test_segments_are_rays_where_nothing_is_passed(skip):
    found = statistics(parts.foggy(), skip=skip)
    assert found["media"] == {"segments": sum(found["rays"].values()), "collisions": 0}
    assert found["rays"]["shadow_s1"] and (found["rays"]["shadow_inner"] or skip == "auto")


def test_null_surfaces_cut_edges_into_segments():
    """Three segments of each ray through the middle of a ball with a null boundary, whose fog nothing
    collides in."""
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=0.1, size=4),
        "lamp": {
            "type": "rectangle",
            "to_world": parts.transform().translate([0, 0, -2]),
            "bsdf": parts.matte(0, 0, 0),
            "emitter": {"type": "area", "radiance": 1.0},
        },
        "ball": parts.ball(radius=0.1, center=(0, 0, 0), interior=parts.fog(1e-6, 0.0)),
    }
    found = statistics(scene, light_paths=0)
    assert found["media"] == {"segments": 3 * 16 * 64, "collisions": 0}


@pytest.mark.parametrize("way", ["flights", "joins"])
def test_collisions_of_a_grid(way):
    """Delta tracking counts collisions of flights, ratio tracking those of connections. A grid of majorant
    1.2, whose extinction is half of it on a way of length 1. Expected: 1.2 collisions of a connection; 2 (1 -
    e^-.6) of a flight, of which half end it; within five standard errors (second moment at most Poisson's;
    one in a thousand rays that the plate reflects meets the grid too)."""
    values = np.broadcast_to([0.0, 1.0], (2, 2, 2))
    medium = parts.grid(values, [-0.5, -0.5, -0.5], 1.0, 1.2, 0.0)
    scene = {"type": "scene", "box": parts.box([-0.5] * 3, 1.0, interior=medium)}
    if way == "joins":
        to_world = parts.transform().translate([0, 0, -20])
        scene["plate"] = {"type": "rectangle", "bsdf": parts.matte(0.5, 0.5, 0.5), "to_world": to_world}
        scene["lamp"] = parts.point(position=[0, 0, 2])
        scene["sensor"] = parts.sensor(origin=(8, 0, -10), target=(0, 0, -20), fov=0.02, size=8)
    else:
        scene["sky"] = parts.sky()
        scene["sensor"] = parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=0.02, size=8)
    found = statistics(scene, 256, light_paths=0)
    expected = 1.2 if way == "joins" else 2 * (1 - np.exp(-0.6))
    assert found["rays"]["shadow_s1"] == 64 * 256 * (way == "joins")
    tolerance = 5 * np.sqrt((1.2 + 1.2**2) / (64 * 256))
    assert found["media"]["collisions"] / (64 * 256) == pytest.approx(expected, abs=tolerance)


def test_scenes_without_media_have_none():
    assert "media" not in statistics(parts.room())
