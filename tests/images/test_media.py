"""Participating media: scenes that are the same to light, cases at the edge, what is explained and refused.

Statistic, unless said: Welch's t-test of image means by channel over `SEEDS` renders a side with Šidák's
correction (`welch`); seeds are fixed, and differ between the two sides. Strategies, known answers and
`volpath`: `test_strategies`, `test_known_answers`, `test_same_mean`.
"""

from __future__ import annotations

import drjit as dr
import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import welch as st
from media_parts import integrator, open_air, transform
from meshes import ball_mesh
from mitsuba_bdpt.errors import UnsupportedError, UsageError
from mitsuba_bdpt.image.layers import strategies
from mitsuba_bdpt.media.media import interaction
from scipy import stats
from test_known_answers import BOUNDARIES
from test_same_mean import CONTRADICTORY, beyond_the_far_plane, coloured_grid, lens_before_a_far_plane, lit
from test_strategies import microflakes

from scenes import area, camera, matte, meter, renders, square

SEEDS = 8
ALL, CAMERA = {"skip": "none"}, {"light_paths": 0}


def means(scene, seed, spp=256, depth=3, **parameters):
    """Image means, (seeds, channels)."""
    scene = mi.load_dict(scene) if isinstance(scene, dict) else scene
    return renders(scene, integrator(max_depth=depth, **parameters), spp, SEEDS, seed).mean((1, 2))


def assert_agree(a, b):
    st.assert_agree(st.welch(a, b), at_least=len(a[0]))


def unweighted(scene, depth, spp, **parameters):
    """``{(k, s): (seeds, channels)}``: each strategy alone, and the weighted sum of each length as s = -1."""
    found = means(scene, 100, spp, depth, layers="strategies", **ALL, **parameters)[:, 3:]
    split = found.reshape(SEEDS, -1, 2, 3)
    alone = {(k, s): split[:, i, 1] for i, (k, s, _) in enumerate(strategies(depth))}
    for k in range(1, depth + 1):
        alone[k, -1] = sum(split[:, i, 0] for i, (of, *_) in enumerate(strategies(depth)) if of == k)
    return alone


def explained(scene, **parameters) -> str:
    return integrator(max_depth=3, **parameters).explain(mi.load_dict(scene))


def contradiction(scene) -> str:
    """Why there are no light subpaths; empty if there are."""
    lines = explained(scene, **ALL).splitlines()
    return next((line for line in lines if "skipped (impossible): t=0, t=1, (1,1), inner" in line), "")


# -- two scenes that are the same ----------------------------------------------------------------------


def misty():
    return parts.ball(interior=parts.fog(4, 0.9))


REF = {"type": "ref", "id": "m"}


def null_wall_in_a_ball():
    """A null disk in a ball of fog, its fog on both sides: a boundary cuts edges into segments, no
    vertices."""
    whole = {"m": parts.fog(4, 0.9, id="m"), **lit(ball=parts.ball(interior=REF))}
    at = transform().translate([-0.35, -0.25, -0.25]).rotate([1, 0.3, 0], 40).scale(0.25)
    null = {"bsdf": {"type": "null"}, "interior": REF, "exterior": REF}
    return {**whole, "cut": {"type": "disk", "to_world": at, **null}}, whole


def null_shells():
    shells = {f"shell{i}": parts.ball(radius=0.3 + 0.02 * i) for i in (1, 2, 3)}
    return lit(ball=misty(), **shells), lit(ball=misty())


def instance():
    """Instances have no media, their groups' shapes do."""
    inner = parts.ball(radius=0.15, center=(0, 0, 0), interior=parts.fog(4, 0.9))
    to_world = transform().translate([-0.35, -0.25, -0.25]).scale(2)
    again = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world}
    return {"group": {"type": "shapegroup", "ball": inner}, **lit(ball=again)}, lit(ball=misty())


@pytest.mark.parametrize("twins", [null_wall_in_a_ball, null_shells, instance])
def test_scenes_that_are_the_same_to_light(twins):
    """Images of one seed: 95 % of the pixels to 1e-3, the mean to 2e-3; by all strategies, and by the choice
    of a pilot for one (two choices that hardly differ may change places)."""
    a, b = (mi.load_dict(scene) for scene in twins())
    method = integrator(max_depth=4)
    renders(b, method, 64, 1, 3)
    for parameters in (ALL, {"decisions": method.statistics["decisions"]}):
        x, y = (renders(scene, integrator(max_depth=4, **parameters), 64, 1, 3) for scene in (a, b))
        assert (np.abs(x - y) <= 1e-3 * np.abs(y) + 1e-4 * y.mean()).mean() >= 0.95
        assert x.mean() == pytest.approx(y.mean(), rel=2e-3), parameters


# -- strategies that once disagreed --------------------------------------------------------------------


@pytest.mark.parametrize("light", ["sky", "sun"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_light_from_infinity_hits_a_lens(boundary, light):
    """t = 0 of light from infinity took no notice of where the flight ended, and counted each event on the
    way. For k = 1 t = 0 alone is (1,1) alone (under a sky s = 0 alone too), and so is the weighted sum."""
    eye = parts.thinlens(size=4, medium=REF) | {"aperture_radius": 0.5}
    sun = {"type": "directional", "direction": [0.1, 0.1, 1], "irradiance": 3.0}
    ball = parts.ball(BOUNDARIES[boundary](), 1.0, (0, 0, 0), interior=REF)
    scene = {"type": "scene", "m": parts.fog(1.0, 0.8, id="m"), "sensor": eye, "ball": ball}
    found = unweighted(scene | {"light": parts.sky() if light == "sky" else sun}, 1, 2048)
    others = [2, -1, 0] if light == "sky" and boundary == "null" else [2, -1]
    family = [st.welch(found[1, s], found[1, 1]) for s in others]
    st.assert_agree(st.Comparisons.join(family), at_least=3)


def glowing_shell():
    """Next-event estimation samples the front of a sphere, which is dark if it glows inwards; its back is
    seen through the front if that is null. It had a density there, and the light of s = 1 was missing."""
    shell = parts.lamp(flip_normals=True, bsdf={"type": "null"})
    puff = parts.ball("null", 0.05, (-0.7, -0.3, -0.5), interior=parts.fog(1, 0.5))
    return parts.room(light=shell, puff=puff), 256, {}, 0, (-1,)


def behind_a_hidden_lamp(boundary):
    """Camera rays pass a hidden lamp, and so do visibility rays of splats. It covers most of the image."""
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(0, 0, 4), target=(0, 0, 0), fov=14, size=2),
        "ball": parts.ball(BOUNDARIES[boundary](), 1.0, (0, 0, 0), interior=parts.fog(0.5, 0.8)),
        "lamp": parts.lamp(center=[0, 0, 0], radius=0.4, emitter=area(1.0)),
        "wall": square((0, 0, -2), bsdf=matte(0.8)),
    }
    return scene, 2048, {"hide_emitters": True}, 1, (2, -1)


def lamp_between_two_media():
    """Light leaves a lamp that bounds media into the medium of its side. A null ball of triangles that glows,
    with dense fog in it; by its vertex normals, turned by 60 degrees, a third of its light goes inwards."""
    to_world = transform().translate([0.25, 0.3, -0.2]).scale(0.25)
    lamp = ball_mesh(lean=60) | {"to_world": to_world, "bsdf": {"type": "null"}, "emitter": area(3.0)}
    return parts.room(light=lamp | {"interior": parts.fog(8.0, 0.0)}), 256, {}, 1, (2, -1)


CASES = {
    "a glowing shell": glowing_shell,
    "behind a hidden lamp, null": lambda: behind_a_hidden_lamp("null"),
    "behind a hidden lamp, mask": lambda: behind_a_hidden_lamp("mask"),
    "a lamp between two media": lamp_between_two_media,
}


@pytest.mark.parametrize("name", CASES)
def test_strategies_see_the_light_of_two_edges(name):
    """Each of the strategies, -1 for the weighted sum, has the mean of the first."""
    scene, spp, parameters, first, others = CASES[name]()
    found = unweighted(scene, 2, spp, **parameters)
    assert found[2, first].mean() > 0.01
    for s in others:
        assert_agree(found[2, s], found[2, first])


def test_a_lens_behind_a_mask_in_fog():
    """The last edge of t = 0 goes on through null lobes and ends in the open, before the light does: for k =
    1 it is alone what (1,1) is alone."""
    eye = parts.thinlens(origin=(0, 0, 1), target=(0, 0, 0), size=4, medium=parts.coloured())
    mask = parts.ball(BOUNDARIES["mask"](), 0.4, (0, 0, 0))
    scene = {"type": "scene", "sensor": eye | {"aperture_radius": 0.5}, "mask": mask}
    found = unweighted(scene | {"lamp": parts.point(position=[0, 0, 0])}, 1, 4096)
    assert_agree(found[1, 2], found[1, 1])


@pytest.mark.parametrize("light", ["sky", "sun"])
def test_a_grid_without_boundary(light):
    """A grid that the sensor declares ends at its box, outside of which the disks of light from infinity do
    not lie: camera subpaths alone, and all strategies in a null sphere."""
    grid = parts.grid(np.ones((3, 3, 3)), [-3] * 3, 6.0, 0.4, 0.8, id="m")
    endless = {"m": grid, **open_air(light)}
    endless["sensor"] |= {"medium": REF}
    assert "put a shape with a null BSDF around it" in contradiction(endless)
    bounded = endless | {"shell": parts.ball("null", 5.5, (0, 0, 0), interior=REF)}
    assert not contradiction(bounded)
    assert_agree(means(endless, 10, 512), means(bounded, 300, 512, **ALL))


@pytest.mark.parametrize("light", ["sky", "sun"])
def test_fog_behind_the_far_plane(light):
    """t = 0 took what lies behind the far plane out of light from infinity, which camera rays do not meet: 8
    % of the sun's light on a wide lens."""
    sun = parts.sun() | {"direction": [0.05, 0, 1]}
    puff = parts.ball("null", 0.1, (0, 0, 0.3), interior=parts.fog(2.0, 0.5))
    scene = {
        "type": "scene",
        "eye": lens_before_a_far_plane(),
        "light": parts.sky() if light == "sky" else sun,
    }
    scene |= {"puff": puff}
    behind = {
        "box": parts.box(low=(-0.5, -0.5, -2), edge=1, interior=parts.fog(0.6, 0.8, 0.3)),
        "ball": parts.ball(matte(0.5), 0.2, (0.2, 0, -1.2)),
    }
    assert "behind the far plane" in explained(scene | behind)
    assert_agree(unweighted(scene, 1, 2048)[1, -1], unweighted(scene | behind, 1, 2048)[1, -1])


def test_flights_by_all_channels():
    """mitsuba2 #323: free flights had the density of one channel. Less than a fifth of ``volpath``'s variance
    in the channel of least extinction (a tenth was measured)."""
    medium = parts.coloured(8.0) | {"sigma_t": parts.rgb(1.0, 0.5, 0.03), "albedo": 0.9}
    eye = parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=15, size=8)
    ball = parts.ball(radius=0.5, center=(0, 0, 0), interior=medium)
    scene = mi.load_dict({"type": "scene", "sensor": eye, "ball": ball, "sky": {"type": "constant"}})

    ours, theirs, mis = (
        renders(scene, integrator(kind, max_depth=8, **more), 64, 16, seed)
        for kind, seed, more in (("bdpt", 1, CAMERA), ("volpath", 50, {}), ("volpathmis", 90, {}))
    )
    assert ours[..., 2].var(0).mean() < theirs[..., 2].var(0).mean() / 5
    assert_agree(ours.mean((1, 2)), mis.mean((1, 2)))


def test_nothing_is_lost_outside_of_a_dense_grid():
    """mitsuba3 #336: black spots beside a dense grid. An even sky is 1 in each pixel that does not see the
    grid, also where that ends before its box does: to 1e-5 by camera subpaths; with all strategies by
    Student's test."""
    medium = parts.grid(np.ones((4, 4, 4)), [-0.2, -0.2, -0.2], 0.4, 500.0, 0.0)
    eye = parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=25, size=16)
    box = parts.box([-0.4] * 3, 0.8, interior=medium)
    scene = mi.load_dict({"type": "scene", "sensor": eye, "box": box, "sky": {"type": "constant"}})
    x = np.abs((np.arange(16) - 7.5) / 8 * np.tan(np.deg2rad(12.5)))
    beside = np.maximum(x[:, None], x) > 0.25 / 2.8 + np.tan(np.deg2rad(12.5)) / 16
    inside = np.maximum(x[:, None], x) < 0.15 / 3.2
    for way in (CAMERA, ALL):
        method = integrator(max_depth=4, **way)
        found = renders(scene, method, 64, 16, 3).mean(-1)
        around = found[:, beside]
        if way is CAMERA:
            assert np.abs(around - 1).max() < 1e-5
        else:
            assert method.statistics["rays"]["light"]
            assert around.std(0, ddof=1).max() / 4 < 0.01
            st.assert_agree(st.one_sample(around, 1.0))
        assert found[:, inside].max() < 1e-3 and inside.any() and beside.mean() > 0.3


def test_an_infinite_voxel_ends():
    """Tracking through an infinite majorant made no step."""
    values = np.ones((4, 4, 4))
    values[1, 2, 1] = np.inf
    method = integrator(max_depth=3, **ALL)
    box = parts.box(interior=parts.grid(values, parts.LOW, parts.EDGE))
    image = method.render(mi.load_dict(lit(box=box)), spp=4)
    assert np.isfinite(np.array(image)).all() and method.statistics["non_finite"] > 0


# -- what is explained and refused ---------------------------------------------------------------------


@pytest.mark.parametrize("why", CONTRADICTORY)
def test_contradictory_scenes_get_camera_subpaths(why):
    """LuxCoreRender #485: what media a subpath is in depends on where it comes from."""
    scene = mi.load_dict(CONTRADICTORY[why]())
    for skip in ("none", "auto"):
        method = integrator(max_depth=4, skip=skip)
        (line,) = (x for x in method.explain(scene).splitlines() if "t=1, (1,1), inner" in x)
        assert line.startswith("skipped (impossible)") and why in line
        method.render(scene, spp=16)
        assert not method.statistics["rays"].get("light")


def test_sensors_are_asked_where_their_rays_start():
    """Sensors on shapes, distant ones and near clips are not at the origin of the sensor's space."""
    scene = {"type": "scene", "lamp": parts.point(position=[0, 3, 0])}
    fog = {"fog": parts.ball("null", 1.0, (0, 0, 0), interior=parts.fog(1, 0.8))}
    assert not contradiction(scene | fog | {"plate": square((3, 0, 0), sensor=meter())})
    distant = {"type": "distant", "direction": [0, -1, 0], "film": meter()["film"]}
    assert not contradiction(scene | fog | {"eye": distant})
    bell = parts.ball("thindielectric", 1.0, (0, 0, 0), exterior=parts.fog(1, 0.8))
    eye = camera(origin=(0, 0, 0.5), target=(0, 0, 0), near=0.01)
    assert not contradiction(scene | {"bell": bell, "eye": eye})


def test_media_that_hide_light_from_infinity_are_explained():
    """A medium without end that is empty hides none; one that is empty in two channels does."""
    for sigma_t, hides in ((0.0, False), (parts.rgb(0.3, 0, 0), True)):
        scene = open_air("sun")
        scene["sensor"] |= {"medium": {"type": "homogeneous", "sigma_t": sigma_t, "albedo": 0.5}}
        assert ("not others" in contradiction(scene)) == hides
    assert "raise far_clip" in contradiction({"type": "scene"} | beyond_the_far_plane("sky", blocker=True))


def test_a_phase_function_that_is_not_symmetric():
    """Mitsuba's ``blendphase`` does not pass on the projected area of microflakes, so that light and camera
    subpaths scatter differently: camera subpaths alone."""
    blend = {"type": "blendphase", "weight": 0.5, "a": microflakes(), "b": {"type": "hg", "g": 0.3}}
    assert not contradiction(parts.foggy(parts.fog() | {"phase": microflakes()}))
    assert "is not symmetric" in contradiction(parts.foggy(parts.fog() | {"phase": blend}))


def test_microflakes_that_vary_in_a_homogeneous_medium_are_refused():
    """Mitsuba samples flights with the microflakes at the origin."""
    values = np.zeros((2, 2, 2, 6), np.float32)
    values[:, :, 0], values[:, :, 1] = [1, 0.02, 0.02, 0, 0, 0], [0.02, 0.02, 1, 0, 0, 0]
    flakes = {"type": "gridvolume", "raw": True, "grid": mi.VolumeGrid(values)}
    with pytest.raises(UnsupportedError, match="microflakes that vary in space.*heterogeneous"):
        explained(parts.foggy(parts.fog() | {"phase": {"type": "sggx", "S": flakes}}))


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
    with pytest.raises(UsageError, match=f"medium 'milk' has .*{message}"):
        explained(parts.foggy(parts.fog() | numbers | {"id": "milk"}))


@pytest.mark.parametrize("colours", [1, 3])
def test_flights_through_coloured_grids_do_not_end_at_a_lens(colours):
    values = np.ones((2, 2, 2, colours)) * [1, 0.5, 0.1][:colours]
    scene = parts.foggy(coloured_grid(values, [-1.2] * 3, 2.4), camera=parts.thinlens)
    reason = "t=0: what a flight through a grid carries of each colour"
    assert (reason in explained(scene)) == (colours == 3)


# -- densities of microflakes --------------------------------------------------------------------------


def at_origin(wi, n):
    return interaction(mi.Point3f(0) + dr.zeros(mi.Point3f, n), -wi, dr.zeros(mi.Ray3f))


def test_our_frames_make_microflakes_sample_their_density():
    """Mitsuba 3.9.1's ``sggx`` samples with the transpose of the frame's matrix, which is another
    distribution than its density unless the frame is its own transpose. Means of eight functions for 24
    directions of arrival: chi-squared (65,536 samples and as many uniform directions), level 1e-3."""
    phase, ctx, n = mi.load_dict(microflakes()), mi.PhaseFunctionContext(None), 65536
    rng = mi.PCG32(n)

    def pair():
        return mi.Point2f(rng.next_float32(), rng.next_float32())

    def functions(d):
        x, y, z = np.array(d, dtype=np.float64)
        return np.array([x, y, z, x * y, y * z, x * z, x * x, y * y])

    def chi2(frame):
        total = 0.0
        for wi in np.random.default_rng(1).normal(size=(24, 3)):
            wi = mi.Vector3f((wi / np.linalg.norm(wi)).tolist())
            mei = at_origin(wi, n)
            if frame is not None:
                mei.sh_frame = frame(wi)
            sampled, _, _ = phase.sample(ctx, mei, rng.next_float32(), pair())
            uniform = mi.warp.square_to_uniform_sphere(pair())
            _, pdf = phase.eval_pdf(ctx, mei, uniform)
            f, g = functions(sampled), functions(uniform) * np.array(pdf) * 4 * np.pi
            gap = f.mean(1) - g.mean(1)
            # Correlated functions: Mahalanobis.
            total += gap @ np.linalg.pinv((np.cov(f) + np.cov(g)) / n) @ gap
        return total

    limit = stats.chi2.isf(1e-3, 24 * 8)
    assert chi2(None) < limit
    assert chi2(mi.Frame3f) > limit
