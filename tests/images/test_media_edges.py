"""Media: cases at the edge, in which strategies once disagreed in silence.

Each compares ``skip=none`` with camera subpaths alone, or strategies with each other, or with a known image.
Statistic, unless said: Welch's t-test of image means by channel over `SEEDS` renders a side, with Sidak's
correction (`welch`); seeds are fixed, and differ between the two sides.
"""

from __future__ import annotations

import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import welch as st
from mitsuba_bdpt.errors import UnsupportedError, UsageError
from mitsuba_bdpt.image.layers import strategies

SEEDS = 8
ALL, CAMERA = {"skip": "none"}, {"light_paths": 0}


def means(scene, seed, spp=256, depth=3, kind="bdpt", **parameters):
    """Image means, (seeds, channels)."""
    scene = mi.load_dict(scene) if isinstance(scene, dict) else scene
    method = parts.integrator(kind, max_depth=depth, **parameters)
    return parts.images(scene, method, spp, seed, SEEDS).mean((1, 2))


def assert_agree(a, b):
    st.assert_agree(st.welch(a, b), at_least=len(a[0]))


def unweighted(scene, depth, spp, **parameters):
    """``{(k, s): (seeds, channels)}``: each strategy alone, and the weighted sum of each length as s = -1."""
    found = means(scene, 100, spp, depth, layers="strategies", **ALL, **parameters)[:, 3:]
    split = found.reshape(SEEDS, -1, 2, 3)
    alone = {(k, s): split[:, i, 1] for i, (k, s, _) in enumerate(strategies(depth))}
    for k in range(1, depth + 1):
        weighted = [split[:, i, 0] for i, (of, *_) in enumerate(strategies(depth)) if of == k]
        alone[k, -1] = sum(weighted)
    return alone


def explained(scene, **parameters) -> str:
    return parts.integrator(max_depth=3, **parameters).explain(mi.load_dict(scene))


def contradiction(scene) -> str:
    """Why there are no light subpaths; empty if there are."""
    lines = explained(scene, **ALL).splitlines()
    return next((line for line in lines if "skipped (impossible): t=0, t=1, (1,1), inner" in line), "")


def open_air(light, medium=None, **more):
    """A matte ball in the open; the sensor may declare a medium without end."""
    medium = {} if medium is None else {"medium": medium}
    eye = parts.sensor(origin=(0, 0.3, 2.5), target=(0, 0, 0), fov=30, size=8, **medium)
    matte = parts.ball(parts.matte(0.7, 0.5, 0.3), 0.4, (0, 0, 0))
    return {"type": "scene", "sensor": eye, "matte": matte, "light": light, **more}


@pytest.mark.parametrize("light", ["sky", "sun"])
@pytest.mark.parametrize("boundary", ["null", "mask"])
def test_light_from_infinity_hits_a_lens(boundary, light):
    """Rationale: t = 0 of light from infinity took no notice of where the flight ended, and counted each
    event on the way. A wide lens in a ball of fog. Expected: for k = 1 t = 0 alone is (1,1) alone (under a
    sky s = 0 alone too), and so is the weighted sum.
    """
    surface = (
        boundary if boundary == "null" else {"type": "mask", "opacity": 0.3, "bsdf": parts.matte(0, 0, 0)}
    )
    eye = parts.thinlens(size=4) | {"aperture_radius": 0.5, "medium": {"type": "ref", "id": "m"}}
    ball = parts.ball(surface, 1.0, (0, 0, 0), interior={"type": "ref", "id": "m"})
    sun = {"type": "directional", "direction": [0.1, 0.1, 1], "irradiance": 3.0}
    scene = {"type": "scene", "m": parts.fog(1.0, 0.8, id="m"), "sensor": eye, "ball": ball}
    found = unweighted(scene | {"light": parts.sky() if light == "sky" else sun}, 1, 2048)
    pairs = [(1, -1), (1, 0)] if light == "sky" and boundary == "null" else [(1, -1)]
    family = [st.welch(found[pair], found[1, 1]) for pair in pairs]
    family.append(st.welch(found[1, 2], found[1, 1]))
    st.assert_agree(st.Comparisons.join(family), at_least=3)


def test_a_glowing_shell_seen_from_outside():
    """Rationale: next-event estimation samples the front of a sphere, which is dark if it glows inwards; its
    back is seen through the front if that is null. It had a density there, and the light of s = 1 was
    missing. Expected: for k = 2 the weighted sum is s = 0 alone.
    """
    shell = parts.lamp(flip_normals=True, bsdf={"type": "null"})
    puff = parts.ball("null", 0.05, (-0.7, -0.3, -0.5), interior=parts.fog(1, 0.5))
    found = unweighted(parts.room(light=shell, puff=puff), 2, 256)
    assert found[2, 0].mean() > 0.05
    assert_agree(found[2, -1], found[2, 0])


@pytest.mark.parametrize("light", ["sky", "sun"])
def test_a_grid_without_boundary(light):
    """Rationale: a grid that the sensor declares ends at its box, outside of which the disks of light from
    infinity do not lie. Expected: camera subpaths alone, with the remedy; with it, a null sphere, all
    strategies and the same image.
    """
    light = parts.sky() if light == "sky" else parts.sun()
    grid = parts.grid(np.ones((3, 3, 3)), [-3] * 3, 6.0, 0.4, 0.8, id="g")
    medium = {"type": "ref", "id": "g"}
    endless = {"g": grid, **open_air(light, medium)}
    assert "put a shape with a null BSDF around it" in contradiction(endless)
    shell = parts.ball("null", 5.5, (0, 0, 0), interior=medium)
    bounded = {"g": grid, **open_air(light, medium, shell=shell)}
    assert not contradiction(bounded)
    assert_agree(means(endless, 10, 512), means(bounded, 300, 512, **ALL))


@pytest.mark.parametrize("light", ["sky", "sun"])
def test_a_medium_of_nothing(light):
    """Rationale: light from infinity does not come through a medium without end, unless that is nothing.
    Expected: with extinction 0 the image of ``path`` in vacuum; with extinction 0 in two channels camera
    subpaths alone.
    """
    light = parts.sky() if light == "sky" else parts.sun()
    nothing = {"type": "homogeneous", "sigma_t": 0.0, "albedo": 0.5}
    scene = open_air(light, nothing)
    assert not contradiction(scene)
    assert_agree(means(scene, 10, **ALL), means(open_air(light), 300, kind="path"))
    red = nothing | {"sigma_t": parts.rgb(0.3, 0, 0)}
    assert "not others" in contradiction(open_air(light, red))


def test_an_albedo_that_is_zero_at_the_origin():
    """Rationale: whether a medium scatters was asked at the origin. Expected: where the albedo is 0 there and
    .9 elsewhere, the image of an albedo that is 1e-6 more.
    """

    def scene(more):
        values = np.zeros((4, 2, 2, 1), np.float32)
        values[:2] = 0.9
        to_world = parts.transform().translate([-1, -1, -1]).scale([2, 2, 1.5])
        albedo = {"type": "gridvolume", "grid": mi.VolumeGrid(values + np.float32(more))}
        albedo |= {"to_world": to_world, "filter_type": "nearest"}
        return parts.foggy({"type": "homogeneous", "sigma_t": 1.0, "albedo": albedo})

    assert_agree(means(scene(0), 10, **ALL), means(scene(1e-6), 300, **ALL))


def test_a_lamp_of_which_a_hundredth_is_in_fog():
    """Rationale: a lamp partly in a medium has rays that start in it; few probes did not find that. A glowing
    floor with a small ball of fog on it, .8 % of its area. Expected: camera subpaths see the same.
    """
    x, y = -1.3, 0.9
    to_world = parts.transform().translate([0, 0, 4]).rotate([1, 0, 0], 180).scale(4)
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(x, y + 0.001, 2.0), target=(x, y, 0), fov=16, size=8),
        "floor": {
            "type": "rectangle",
            "to_world": parts.transform().scale(3),
            "bsdf": parts.matte(0.5, 0.5, 0.5),
            "emitter": {"type": "area", "radiance": 1.0},
        },
        "ball": parts.ball("null", 0.3, (x, y, 0), interior=parts.fog(6, 0.9)),
        "top": {"type": "rectangle", "to_world": to_world, "bsdf": parts.matte(0.5, 0.5, 0.5)},
    }
    scene = mi.load_dict(scene)
    assert_agree(means(scene, 10, depth=4, **ALL), means(scene, 300, depth=4, **CAMERA))


def test_sensors_are_asked_where_their_rays_start():
    """Rationale: sensors on shapes, distant ones and near clips are not at the origin of the sensor's space.
    Expected: no contradiction for a meter beside a ball of fog at the origin, for a distant sensor above it,
    for a camera in a glass bell of air under which endless fog begins.
    """
    fog = parts.ball("null", 1.0, (0, 0, 0), interior=parts.fog(1, 0.8))
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "irradiancemeter", "film": film}
    at = parts.transform().translate([3, 0, 0])
    lamp = parts.point(position=[0, 3, 0])
    plate = {"type": "rectangle", "to_world": at, "sensor": meter}
    assert not contradiction({"type": "scene", "fog": fog, "lamp": lamp, "plate": plate})
    distant = {"type": "distant", "direction": [0, -1, 0], "film": film}
    assert not contradiction({"type": "scene", "fog": fog, "lamp": lamp, "eye": distant})
    bell = parts.ball("thindielectric", 1.0, (0, 0, 0), exterior=parts.fog(1, 0.8))
    eye = parts.sensor(origin=(0, 0, 0.5), target=(0, 0, 0), near=0.01)
    assert not contradiction({"type": "scene", "bell": bell, "lamp": lamp, "eye": eye})


def test_a_phase_function_that_is_not_symmetric():
    """Rationale: Mitsuba's ``blendphase`` does not pass on the projected area of microflakes, so that light
    and camera subpaths scatter differently. Expected: camera subpaths alone, with the reason.
    """
    matrix = np.array([1, 0.02, 0.02, 0, 0, 0], np.float32)
    values = mi.VolumeGrid(np.tile(matrix, (2, 2, 2, 1)))
    flakes = {"type": "sggx", "S": {"type": "gridvolume", "raw": True, "grid": values}}
    blend = {"type": "blendphase", "weight": 0.5, "a": flakes, "b": {"type": "hg", "g": 0.3}}
    assert not contradiction(parts.foggy(parts.fog() | {"phase": flakes}))
    assert "is not symmetric" in contradiction(parts.foggy(parts.fog() | {"phase": blend}))


def test_microflakes_that_vary_in_a_homogeneous_medium_are_refused():
    """Rationale: Mitsuba samples flights with the microflakes at the origin. Expected: an error with the
    remedy.
    """
    values = np.zeros((2, 2, 2, 6), np.float32)
    values[:, :, 0], values[:, :, 1] = [1, 0.02, 0.02, 0, 0, 0], [0.02, 0.02, 1, 0, 0, 0]
    flakes = {"type": "gridvolume", "raw": True, "grid": mi.VolumeGrid(values)}
    medium = parts.fog() | {"phase": {"type": "sggx", "S": flakes}}
    with pytest.raises(UnsupportedError, match="microflakes that vary in space.*heterogeneous"):
        explained(parts.foggy(medium))


@pytest.mark.parametrize(
    "numbers, message",
    [
        ({"sigma_t": -1.0}, "sigma_t down to -1; use 0 or more"),
        ({"sigma_t": float("nan")}, "that is NaN"),
        ({"albedo": -1.0}, "albedo down to -1; use 0 or more"),
    ],
    ids=["negative", "nan", "albedo"],
)
def test_numbers_that_are_no_mediums_are_refused(numbers, message):
    """Expected: an error that names the medium, the parameter and the value."""
    with pytest.raises(UsageError, match=f"medium 'milk' has .*{message}"):
        explained(parts.foggy(parts.fog() | numbers | {"id": "milk"}))


def test_an_infinite_voxel_ends():
    """Rationale: tracking through an infinite majorant made no step. Expected: the render ends, samples that
    meet the grid count as not finite.
    """
    values = np.ones((4, 4, 4))
    values[1, 2, 1] = np.inf
    box = parts.box(interior=parts.grid(values, parts.LOW, parts.EDGE))
    method = parts.integrator(max_depth=3, **ALL)
    image = method.render(mi.load_dict(parts.room(light=parts.point(), box=box)), spp=4)
    assert np.isfinite(np.array(image)).all() and method.statistics["non_finite"] > 0


def test_flights_through_coloured_grids_do_not_end_at_a_lens():
    """Expected: t = 0 is left out where grids have colours, with the reason, and not where they are gray."""
    gray = parts.grid(np.ones((2, 2, 2)), [-1.2] * 3, 2.4)
    coloured = parts.grid(np.ones((2, 2, 2)), [-1.2] * 3, 2.4)
    values = np.ones((2, 2, 2, 3), np.float32) * np.float32([1, 0.5, 0.1])
    coloured["sigma_t"] |= {"raw": True, "grid": mi.VolumeGrid(values)}
    reason = "t=0: what a flight through a grid carries of each colour"
    assert reason in explained(parts.foggy(coloured, camera=parts.thinlens))
    assert reason not in explained(parts.foggy(gray, camera=parts.thinlens))


@pytest.mark.parametrize("light", ["sky", "sun"])
@pytest.mark.parametrize("blocker", [False, True])
def test_the_far_plane_in_fog(light, blocker):
    """Rationale: a camera ray that ends at the far plane saw the sky through the fog before it, and light
    from infinity came to the lens through all fog: twice what ``volpath`` shows under a sky, 38 times under a
    sun. Expected: ``volpath``'s image (homogeneous fog goes on behind the plane), and the remedy in words.
    """
    light = parts.sky() if light == "sky" else parts.sun() | {"direction": [0, 0, 1]}
    medium = {"type": "ref", "id": "m"}
    view = {"origin": (0, 0, 1), "target": (0, 0, 0), "fov": 30, "medium": medium}
    eye = parts.thinlens(size=4, far_clip=1.5, **view) | {"aperture_radius": 0.3}
    scene = {"type": "scene", "m": parts.fog(0.6, 0.8, 0.3, id="m"), "eye": eye, "light": light}
    scene["box"] = parts.box(low=(-2, -2, -2), edge=4, interior=medium)
    if blocker:  # behind the plane
        scene["ball"] = parts.ball(parts.matte(0.5, 0.5, 0.5), 0.6, (0, 0, -1.2))
    assert "raise far_clip" in contradiction(scene)
    assert_agree(means(scene, 10, 2048), means(scene, 300, 2048, kind="volpath"))


@pytest.mark.parametrize("light", ["sky", "sun"])
def test_fog_behind_the_far_plane(light):
    """Rationale: t = 0 took what lies behind the far plane out of light from infinity, which camera rays do
    not meet: 8 % of the sun's light on a wide lens. Expected: as if there were nothing behind the plane.
    """
    light = parts.sky() if light == "sky" else parts.sun() | {"direction": [0.05, 0, 1]}
    view = {"origin": (0, 0, 1), "target": (0, 0, 0), "fov": 30}
    eye = parts.thinlens(size=4, far_clip=1.5, **view) | {"aperture_radius": 0.3}
    puff = parts.ball("null", 0.1, (0, 0, 0.3), interior=parts.fog(2.0, 0.5))
    scene = {"type": "scene", "eye": eye, "light": light, "puff": puff}
    behind = {
        "box": parts.box(low=(-0.5, -0.5, -2), edge=1, interior=parts.fog(0.6, 0.8, 0.3)),
        "ball": parts.ball(parts.matte(0.5, 0.5, 0.5), 0.2, (0.2, 0, -1.2)),
    }
    assert "behind the far plane" in explained(scene | behind)
    assert_agree(unweighted(scene, 1, 2048)[1, -1], unweighted(scene | behind, 1, 2048)[1, -1])
