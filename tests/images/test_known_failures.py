"""Bugs that other bidirectional path tracers had in public, each as a test that fails on the bug.

The thread where each was reported stands first. Where two images are compared, the statistic is Welch's
t-test of tile means over seeds with Sidak's correction (`agree`); where the answer is known, the t-test
against it. Seeds are fixed and differ between the two sides.
"""

import os
import subprocess
import sys
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
import views
import welch
from scipy import stats
from welch import OF_AGREE, tiles

ROUNDING = 1e-4  # systematic differences in float32 between two ways to one image, relative

agree = partial(welch.agree, rounding=ROUNDING)

T = mi.ScalarTransform4f


def integrator(kind="bdpt", **parameters):
    return mi.load_dict({"type": kind, **parameters})


def render(scene, method, seeds, spp):
    """Images, stacked: (seeds, height, width, channels)."""
    return np.stack([np.array(method.render(scene, seed=seed, spp=spp), dtype=np.float64) for seed in seeds])


def layer(images, bdpt, name):
    """The technique image ``name``, for example ``unweighted.s1t2``."""
    first = bdpt.aov_names().index(name + ".R")
    base = images.shape[-1] - len(bdpt.aov_names())
    return images[..., base + first : base + first + 3]


def camera(origin, target, fov=45, size=16, up=(0, 1, 0), rfilter="box", **film):
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-3,
        "to_world": T().look_at(list(origin), list(target), list(up)),
        "sampler": {"type": "independent"},
        "film": parts.film(size, rfilter, **film),
    }


def diffuse(reflectance, sides=2):
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [reflectance] * 3}}
    return {"type": "twosided", "bsdf": bsdf} if sides == 2 else bsdf


def bumps():
    """Three sines, as the height field of a bump map."""
    y, x = np.mgrid[0:64, 0:64] / 64 * 2 * np.pi
    height = 0.5 + 0.15 * (np.sin(6 * x) + np.sin(5 * y) + np.sin(3 * x + 4 * y))
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(height.astype(np.float32)[..., None]),
        "raw": True,
        "wrap_mode": "repeat",
    }


def normals(tilt):
    """Tangent-space normals of a wavy surface."""
    y, x = np.mgrid[0:64, 0:64] / 64 * 2 * np.pi
    n = np.stack([tilt * np.sin(4 * x), tilt * np.sin(3 * y), np.ones_like(x)], axis=-1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return {"type": "bitmap", "bitmap": mi.Bitmap(((n + 1) / 2).astype(np.float32)), "raw": True}


def rough(kind):
    """A bumpy or normal-mapped wall. By default Mitsuba turns normals that face away from the camera
    side; a walk from the light then cannot sample all that the camera side sees."""
    flip = {"flip_invalid_normals": False} if kind.endswith("unflipped") else {}
    texture = (
        {"type": "bumpmap", "height": bumps(), "scale": 0.3}
        if kind.startswith("bumpmap")
        else {"type": "normalmap", "normalmap": normals(0.4)}
    )
    return {"type": "twosided", "bsdf": texture | flip | {"bsdf": diffuse(0.7, 1)}}


def inside_of_a_sphere(bsdf):
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, -0.6, 0), (0.3, 0.2, -1), fov=70),
            "wall": {"type": "sphere", "bsdf": bsdf},
            "lamp": {"type": "point", "position": [0.1, 0.3, 0.2], "intensity": 3.0},
        }
    )


@pytest.mark.parametrize("kind", ["bumpmap", "normalmap"])
def test_no_spikes_inside_a_bumpy_sphere(kind):
    """pbrt-v3 #73: the adjoint factor of shading normals was in the walk but not at the join, and
    spikes were blamed on near vertices. They grow with every bounce of the light subpath. Expected: in the
    image and in each light-side strategy's weighted image, up to paths of 8 edges, no pixel above three times
    its neighbourhood's median. Tolerance: noise at 256 spp reaches 2.1; the bug reaches 9 to 12 (bump map),
    5 to 10 (normal map).
    """
    scene = inside_of_a_sphere(rough(kind))
    bdpt = integrator(max_depth=8, rr_depth=50, skip="none", layers="strategies")
    image = render(scene, bdpt, [1], 256)
    for name in (None, *(f"weighted.s{k + 1 - t}t{t}" for k in range(3, 9) for t in (1, 2))):
        pixels = (image[..., :3] if name is None else layer(image, bdpt, name))[0].mean(-1)
        padded = np.pad(pixels, 2, mode="reflect")
        around = np.median(np.lib.stride_tricks.sliding_window_view(padded, (5, 5)), axis=(2, 3))
        assert np.max(pixels / around) < 3, name


@pytest.mark.parametrize("kind", ["bumpmap", "normalmap", "bumpmap unflipped", "normalmap unflipped"])
def test_light_side_agrees_with_camera_side_on_bumpy_surfaces(kind):
    """mitsuba3 #42, #45: the light tracer was brighter than path on bumped surfaces. The
    reference is the camera side: Mitsuba's `path`. Expected: the unweighted images of every light-side
    strategy with k = 2 and k = 3 equal those of s = 1 (s = 3 only where normals are not turned towards
    the camera), and all together equal `path`. Tolerance: the confidence interval of the image, below 1 % for
    all together, 3 % for single strategies, unweighted and so noisier (the bug: 16 to 57 % per pixel).
    Statistic: Welch, 16 seeds a side.
    """
    scene = inside_of_a_sphere(rough(kind))
    bdpt = integrator(max_depth=3, rr_depth=50, skip="none", layers="strategies")
    images, others = render(scene, bdpt, range(16), 256), render(scene, bdpt, range(50, 66), 256)
    for s, t in ((2, 1), (2, 2), *([(3, 1)] if kind.endswith("unflipped") else [])):
        reference = layer(others, bdpt, f"unweighted.s1t{s + t - 1}")
        agree(tiles(layer(images, bdpt, f"unweighted.s{s}t{t}")), tiles(reference), 0.03)
    path = integrator("path", max_depth=3, rr_depth=50)
    agree(tiles(images[..., :3]), tiles(render(scene, path, range(50, 66), 512)), 0.01)


def ball_mesh(path, subdivisions=2):
    """A coarse sphere of triangles with vertex normals, written as PLY."""
    t = (1 + 5**0.5) / 2
    v = np.array(
        [
            (-1, t, 0),
            (1, t, 0),
            (-1, -t, 0),
            (1, -t, 0),
            (0, -1, t),
            (0, 1, t),
            (0, -1, -t),
            (0, 1, -t),
            (t, 0, -1),
            (t, 0, 1),
            (-t, 0, -1),
            (-t, 0, 1),
        ],
        float,
    )
    f = np.array(
        [
            (0, 11, 5),
            (0, 5, 1),
            (0, 1, 7),
            (0, 7, 10),
            (0, 10, 11),
            (1, 5, 9),
            (5, 11, 4),
            (11, 10, 2),
            (10, 7, 6),
            (7, 1, 8),
            (3, 9, 4),
            (3, 4, 2),
            (3, 2, 6),
            (3, 6, 8),
            (3, 8, 9),
            (4, 9, 5),
            (2, 4, 11),
            (6, 2, 10),
            (8, 6, 7),
            (9, 8, 1),
        ]
    )
    for _ in range(subdivisions):
        corners = v[f]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        a, b, c = corners.transpose(1, 0, 2)
        ab, bc, ca = middles.transpose(1, 0, 2)
        triangles = np.concatenate(
            [np.stack(x, axis=1) for x in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        v, f = np.unique(triangles.reshape(-1, 3).round(9), axis=0, return_inverse=True)
        f = f.reshape(-1, 3)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    mesh = mi.Mesh("ball", len(v), len(f), has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = v.astype(np.float32).ravel()
    params["vertex_normals"] = v.astype(np.float32).ravel()
    params["faces"] = f.astype(np.uint32).ravel()
    params.update()
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path)}


def test_shading_normals_of_a_coarse_mesh(tmp_path):
    """pbrt-v4 #385, #526, #13: without the adjoint factor a surface with interpolated normals is too
    shiny on the light side. A ball of 80 triangles with vertex normals above a floor. Expected: t = 1
    and s = 1 alone agree, and everything agrees with `path` at depth 4. Tolerance: the confidence
    interval, below 3 %. Statistic: Welch, 16 seeds a side.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, 1, 5), (0, 0, 0), fov=35),
            "ball": ball_mesh(tmp_path / "ball.ply", 1) | {"bsdf": diffuse(0.8)},
            "floor": {
                "type": "rectangle",
                "bsdf": diffuse(0.5),
                "to_world": T().translate([0, -1.2, 0]).rotate([1, 0, 0], -90).scale(2),
            },
            "lamp": {
                "type": "spot",
                "intensity": 40.0,
                "cutoff_angle": 25,
                "to_world": T().look_at([3, 4, 1], [0, -0.5, 0], [0, 1, 0]),
            },
        }
    )
    bdpt = integrator(max_depth=4, rr_depth=50, skip="none", layers="strategies")
    images, others = render(scene, bdpt, range(16), 256), render(scene, bdpt, range(50, 66), 256)
    agree(
        tiles(layer(images, bdpt, "unweighted.s2t1")),
        tiles(layer(others, bdpt, "unweighted.s1t2")),
        0.03,
    )
    path = integrator("path", max_depth=4, rr_depth=50)
    agree(tiles(images[..., :3]), tiles(render(scene, path, range(50, 66), 512)), 0.02)


@pytest.mark.parametrize(
    "transform, flip",
    [
        (T(), False),
        (T().scale([-1, 1, 1]), False),
        (T().scale([-1, 1, 1]), True),
        (T().rotate([0.26726124, 0.53452248, 0.80178373], 40).scale([0.7, -1.2, 1]), False),
    ],
    ids=["plain", "mirrored", "mirrored, flipped", "mirrored, stretched"],
)
@pytest.mark.parametrize("inside", [False, True], ids=["outside", "inside"])
def test_emitter_mesh_with_vertex_normals(tmp_path, transform, flip, inside):
    """pbrt-v3 #229, mitsuba3 #1952: a mirrored emitter mesh with vertex normals emitted on
    one side when hit and on the other when sampled; its normal differed between sampling and density.
    A ball of 20 triangles lights a floor from outside and, where its normals point inwards, nothing
    outside. Expected: s = 0, s = 1 and t = 1 alone agree, with direct light (k = 2) and seen
    directly (k = 1); a side that is dark for one is dark for all. Tolerance: the confidence
    interval, below 20 % on the bright side. Statistic: Welch, 12 seeds a side.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, 0, 0) if inside else (0, 1.5, 4), (0, -0.6, 0.3), fov=60, up=(0, 0, 1)),
            "lamp": ball_mesh(tmp_path / "lamp.ply", 0)
            | {
                "to_world": T().scale(1.5 if inside else 0.5) @ transform,
                "flip_normals": flip,
                "bsdf": diffuse(0),
                "emitter": {"type": "area", "radiance": 2.0},
            },
            "floor": {
                "type": "rectangle",
                "bsdf": diffuse(0.8),
                "to_world": T()
                .translate([0, -0.45 if inside else -1.4, 0])
                .rotate([1, 0, 0], -90)
                .scale(0.2 if inside else 2),
            },
        }
    )
    bdpt = integrator(max_depth=2, skip="none", layers="strategies")
    images, others = render(scene, bdpt, range(12), 256), render(scene, bdpt, range(50, 62), 256)
    hit = layer(images, bdpt, "unweighted.s0t3")
    if hit.max() == 0:
        assert images.max() == 0  # dark for one, dark for all
        return
    assert images[..., :3].max() > 0
    bright = hit.mean() > 0.01  # else only what shading normals let through a dark side is seen
    for name in ("s1t2", "s2t1"):
        agree(tiles(hit), tiles(layer(others, bdpt, f"unweighted.{name}")), 0.2 if bright else 1)
    seen = layer(images, bdpt, "unweighted.s0t2")
    agree(tiles(seen), tiles(layer(others, bdpt, "unweighted.s1t1")), 0.2 if bright else 1)


def test_emitter_meshes_are_lit_on_one_side():
    """The cases above light both sides between them; a test of darkness alone would prove nothing.
    Expected: a rectangle, mirrored or not, emits along its normal only, for hits, next-event
    estimation and emission alike.
    """
    for transform, flip, lit in (
        (T(), False, True),
        (T(), True, False),
        (T().scale([-1, 1, 1]), False, None),
    ):
        scene = mi.load_dict(
            {
                "type": "scene",
                "sensor": camera((0, 0, 4), (0, 0, 0)),
                "lamp": {
                    "type": "rectangle",
                    "to_world": transform,
                    "flip_normals": flip,
                    "emitter": {"type": "area", "radiance": 1.0},
                },
            }
        )
        bdpt = integrator(max_depth=1, skip="none", layers="strategies")
        images = render(scene, bdpt, range(2), 64)
        hit, sampled = (layer(images, bdpt, f"unweighted.s{s}t{2 - s}").mean() for s in (0, 1))
        assert (hit > 0) == (sampled > 0)
        assert lit is None or (hit > 0) == lit


def test_point_light_in_a_cornell_box_has_no_hot_pixel():
    """Mitsuba 0.6 #132: a point light seen directly by a pinhole made one pixel above 80,000, and
    ever hotter with the resolution. Expected: the largest pixel below 1.2 times that of `path`
    (where the brightest is the ceiling over the lamp), at 16x16 and at 64x64; the median is equal
    within 5 %. A seen point light would be 1e3 times and more. Statistic: none, bounds.
    """
    for size in (16, 64):
        scene = mi.cornell_box()
        del scene["light"]
        scene["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
        scene["lamp"] = {"type": "point", "position": [0.1, 0.5, 0.1], "intensity": 1.0}
        scene = mi.load_dict(scene)
        image, reference = (
            render(scene, integrator(kind, max_depth=5), [3], 256)[0].mean(-1) for kind in ("bdpt", "path")
        )
        assert image.max() < 1.2 * reference.max()
        assert abs(np.median(image) / np.median(reference) - 1) < 0.05


@pytest.mark.parametrize(
    "environment",
    [
        {"type": "constant", "radiance": 0.8},
        {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.8, np.float32))},
    ],
    ids=["constant", "envmap"],
)
def test_environment_does_not_depend_on_other_objects(environment):
    """Mitsuba 0.6 #80: brightness depended on other objects in the scene. A grey disk under a sky
    of 0.8, alone, and with a small sphere far away, out of its sight, that makes the scene 30 times
    larger. Expected: t = 1 alone, and everything, give 0.8 x 0.5 on the disk. Tolerance: the
    confidence interval, below 5 %, for t = 1 in the large scene 50 %. Statistic: t-test, 16 seeds.
    """
    for far, tolerance in (
        ({}, 0.05),
        ({"far": {"type": "sphere", "center": [0, -60, 0], "bsdf": diffuse(0)}}, 0.5),
    ):
        scene = mi.load_dict(
            {
                "type": "scene",
                "sensor": camera((0, 3, 0), (0, 0, 0), fov=30, up=(0, 0, 1)),
                "disk": {
                    "type": "disk",
                    "bsdf": diffuse(0.5, 1),
                    "to_world": T().rotate([1, 0, 0], -90).scale(2),
                },
                "sky": environment,
            }
            | far
        )
        bdpt = integrator(max_depth=2, skip="none", layers="strategies")
        images = render(scene, bdpt, range(16), 256)
        splat = layer(images, bdpt, "unweighted.s2t1").mean((1, 2, 3))
        known(splat, 0.4, tolerance)
        known(images[..., :3].mean((1, 2, 3)), 0.4, 0.01)


def known(samples, expected, relative, allowed=ROUNDING):
    """t-test of seeds against a known value, with a systematic error of up to ``allowed`` (relative);
    the interval must be narrower than ``relative``."""
    reach = stats.t.isf(OF_AGREE / 2, len(samples) - 1) * samples.std(ddof=1) / len(
        samples
    ) ** 0.5 + allowed * abs(expected)
    assert abs(samples.mean() - expected) < reach, (samples.mean(), expected, reach)
    assert reach < relative * abs(expected), f"too noisy: {reach / abs(expected):.2e}"


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_crop_window_equals_the_region_of_the_whole(rfilter):
    """pbrt-v4 #347, #456: crop windows changed the number of light paths per pixel, in the image but
    not in the weights. Expected: each strategy's unweighted image and the weighted sum equal the same
    region of the whole image (inner pixels: at the crop's border the filter lacks samples; weighted
    images differ by right, for a crop has fewer light subpaths per pixel than the whole). Tolerance: the
    confidence interval; bounded at 3 % for the sum, 0.3 for single strategies. Statistic: Welch, 16
    seeds a side.
    """

    def scene(**film):
        return mi.load_dict(
            {
                "type": "scene",
                "sensor": camera((0, 0, 0.5), (0.3, 0.1, -1), fov=60, size=24, rfilter=rfilter, **film),
                "wall": {"type": "sphere", "bsdf": diffuse(0.5)},
                "lamp": {
                    "type": "sphere",
                    "radius": 0.1,
                    "center": [0.2, 0.3, -0.4],
                    "emitter": {"type": "area", "radiance": 5.0},
                },
            }
        )

    bdpt = integrator(max_depth=3, skip="none", layers="strategies")
    whole = render(scene(), bdpt, range(16), 128)[:, 5:15, 9:21]
    part = render(
        scene(crop_offset_x=7, crop_offset_y=3, crop_width=16, crop_height=14), bdpt, range(50, 66), 128
    )[:, 2:12, 2:14]
    assert part.shape == whole.shape
    agree(tiles(part[..., :3], 2), tiles(whole[..., :3], 2), 0.03)
    for k in (1, 2, 3):
        for s in range(k + 1):
            name = f"unweighted.s{s}t{k + 1 - s}"
            agree(tiles(layer(part, bdpt, name), 2), tiles(layer(whole, bdpt, name), 2), 0.3)


@pytest.mark.parametrize("fov", [30, 1.5], ids=["the whole spot is seen", "a fiftieth of the spot is seen"])
def test_narrow_spot_on_a_matte_floor(fov):
    """pbrt-v4 #362: on a floor lit directly by a narrow spot, light tracing (s=2, t=1) was trusted
    too much. Expected: the variance with all strategies is below that of t = 1 alone and within the
    balance bound of next-event estimation's, mu^2 per sample above it. Seen as a whole, a lit pixel gets
    some eight splats per sample, and t = 1 itself is within that bound; of a fiftieth of the spot a pixel
    gets a splat in fifty samples, and t = 1 alone has fifty times the bound. Tolerance: a tenth (variances
    from 64 seeds, summed over the lit pixels: 5 % noise). Statistic: ratio of summed variances.
    """
    spp = 16
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, 4, 0), (0, 0, 0), fov=fov, up=(0, 0, 1)),
            "floor": {
                "type": "rectangle",
                "bsdf": diffuse(0.5),
                "to_world": T().rotate([1, 0, 0], -90).scale(3),
            },
            "lamp": {
                "type": "spot",
                "cutoff_angle": 6,
                "intensity": 30.0,
                "to_world": T().look_at([1, 4, 1], [0, 0, 0], [0, 0, 1]),
            },
        }
    )
    bdpt = integrator(max_depth=2, skip="none", layers="strategies", points="independent")
    images = render(scene, bdpt, range(64), spp)
    mean, total = images[..., :3].mean(0), images[..., :3].var(0, ddof=1).sum()
    splats, direct = (
        layer(images, bdpt, f"unweighted.{name}").var(0, ddof=1).sum() for name in ("s2t1", "s1t2")
    )
    bound = direct + np.sum(mean**2) / spp
    assert splats > (2 * direct if fov == 30 else 20 * bound)  # the scene shows what it is meant to show
    assert total < splats
    assert total < 1.1 * bound


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_borders_of_a_uniform_furnace(rfilter):
    """LuxCore #237, #239: dark or bright border rows with splats and filters. A sphere of radiance
    0.5 and reflectance 0.5 in which splats carry much of the light. Expected: the ring of border
    pixels has the radiance 0.75 of depth 2, as have those within. Tolerance: the confidence
    interval, below 0.5 %, and 0.1 % of the pixels within, which are more. Statistic: t-test over 16 seeds.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, 0, 0.5), (0, 0.1, -1), fov=60, rfilter=rfilter),
            "wall": {
                "type": "sphere",
                "flip_normals": True,
                "bsdf": diffuse(0.5),
                "emitter": {"type": "area", "radiance": 0.5},
            },
        }
    )
    image = render(scene, integrator(max_depth=2, skip="none"), range(16), 256).mean(-1)
    for border in (image[:, 0], image[:, -1], image[:, :, 0], image[:, :, -1]):
        known(border.mean(1), 0.75, 0.005)
    known(image[:, 1:-1, 1:-1].mean((1, 2)), 0.75, 0.001)


@pytest.mark.parametrize(
    "lamp_pane, camera_pane, emitter",
    [
        (True, False, "point"),
        (False, True, "point"),
        (True, True, "point"),
        (True, True, "area"),
        (True, False, "area"),
    ],
)
def test_brightness_does_not_depend_on_where_panes_lamp_and_camera_are(lamp_pane, camera_pane, emitter):
    """LuxCore #678: brightness depended on the distance for certain paths. Removable panes force
    strategies: one around the lamp leaves t = 1 and inner connections, with a lamp of area s = 0;
    one around the camera leaves s = 1 and inner; both leave inner alone (after two reflections), or
    s = 0. In a unit sphere of reflectance 1/2, light reflected m >= 2 times has the same radiance
    everywhere, wherever lamp and camera are: 2^-m for a flux of 4 pi^2. Expected: 1/4 after two
    reflections for three places of lamp and camera. Tolerance: the confidence interval, below 4 %,
    plus the 0.15 % that panes of radius 0.01 at most take out of the light between lamp and
    walls. Statistic: t-test over 16 seeds.
    """
    for lamp, eye in (
        ((0, 0, 0.7), (0, 0.1, 0.5)),
        ((0.3, 0.5, 0.4), (0.3, 0, 0.2)),
        ((-0.6, 0.1, 0.3), (0.2, -0.6, 0.1)),
    ):
        edges = 3 + lamp_pane + camera_pane
        scene = {
            "type": "scene",
            "sensor": camera(eye, (0.1, 0.1, -1), fov=50, size=8),
            "wall": {"type": "sphere", "bsdf": diffuse(0.5)},
        }
        if emitter == "point":
            scene["lamp"] = {"type": "point", "position": list(lamp), "intensity": float(np.pi)}
        else:  # flux 4 pi^2: area 4 pi 0.005^2, radiance flux / (area pi)
            scene["lamp"] = {
                "type": "sphere",
                "radius": 0.005,
                "center": list(lamp),
                "bsdf": {"type": "null"},
                "emitter": {"type": "area", "radiance": 1 / 0.005**2},
            }
        for there, place in ((lamp_pane, lamp), (camera_pane, eye)):
            if there:
                scene[f"pane{place is eye}"] = {
                    "type": "sphere",
                    "radius": 0.01,
                    "center": list(place),
                    "bsdf": {"type": "null"},
                }
        scene = mi.load_dict(scene)
        bdpt = integrator(max_depth=edges, rr_depth=50, skip="none", layers="strategies")
        images = render(scene, bdpt, range(16), 512)
        total = sum(
            layer(images, bdpt, f"weighted.s{s}t{edges + 1 - s}").mean((1, 2, 3)) for s in range(edges + 1)
        )
        known(total, 0.25, 0.04, allowed=0.0015)


@pytest.mark.parametrize("weights", [(1, 1), (0.1, 5), (30, 1)], ids=str)
def test_emitters_with_unequal_sampling_weights(weights):
    """LuxCore #671, #687: lights were picked with one probability by next-event estimation and with
    another by emission. Two point lights of the same power in the unit sphere, one in its centre.
    Expected: all strategies that see a path alone agree on it: s = 1, inner and t = 1 at k = 3, and together
    they give the known radiance. Tolerance: the confidence interval, below 6 % for single strategies (a
    light that is picked once in 51 times makes few and bright subpaths), 1 % for all. Statistic: t-test over
    16 seeds.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, 0, 0.5), (0, 0.1, -1), fov=60),
            "wall": {"type": "sphere", "bsdf": diffuse(0.5)},
            "one": {"type": "point", "intensity": float(np.pi) / 2, "sampling_weight": weights[0]},
            "two": {
                "type": "point",
                "position": [0.3, 0.2, -0.1],
                "intensity": float(np.pi) / 2,
                "sampling_weight": weights[1],
            },
        }
    )
    bdpt = integrator(max_depth=3, rr_depth=50, skip="none", layers="strategies")
    images = render(scene, bdpt, range(16), 256)
    for s in (1, 2, 3):
        known(layer(images, bdpt, f"unweighted.s{s}t{4 - s}").mean((1, 2, 3)), 0.25, 0.06)
    total = sum(layer(images, bdpt, f"weighted.s{s}t{4 - s}").mean((1, 2, 3)) for s in range(4))
    known(total, 0.25, 0.01)


def test_directional_light_on_a_wide_floor():
    """pbrt-v3 #69, 21f2ece: a directional light was treated as point-like. A floor much wider than
    the view, lit at 40 degrees. Expected: rho E cos / pi in every tile, for s = 1 exactly, for t = 1
    alone and for all together; doubling the floor changes nothing. Tolerance: the confidence
    interval, below 1e-3 for s = 1; for t = 1, whose subpaths start on a disk as wide as the scene, so that
    few meet the view, 3 % in tiles of 8 x 8 pixels and 1 % in the image; 1e-3 for all together. Statistic:
    t-test over 16 seeds.
    """
    expected = 0.5 * 3 * np.cos(np.deg2rad(40)) / np.pi
    for size in (3, 6):
        scene = mi.load_dict(
            {
                "type": "scene",
                "sensor": camera((0, 4, 0), (0, 0, 0), fov=40, up=(0, 0, 1)),
                "floor": {
                    "type": "rectangle",
                    "bsdf": diffuse(0.5),
                    "to_world": T().rotate([1, 0, 0], -90).scale(size),
                },
                "sun": {
                    "type": "directional",
                    "irradiance": 3.0,
                    "direction": [float(np.sin(np.deg2rad(40))), -float(np.cos(np.deg2rad(40))), 0],
                },
            }
        )
        bdpt = integrator(max_depth=2, skip="none", layers="strategies")
        images = render(scene, bdpt, range(16), 256)
        known(layer(images, bdpt, "unweighted.s1t2").mean((1, 2, 3)), expected, 1e-3)
        splat = tiles(layer(images, bdpt, "unweighted.s2t1"), 8)
        for tile in splat.T:
            known(tile, expected, 0.03)
        known(splat.mean(1), expected, 0.01)
        known(images[..., :3].mean((1, 2, 3)), expected, 1e-3)


def test_point_light_in_a_glass_shell_lights_the_room():
    """mitsuba2 #262, #491, mitsuba3 #1462: a lamp behind glass lights nothing, for `path` cannot find
    it. A point light in a shell of glass in the unit sphere. All light that leaves the shell is
    reflected on; glass absorbs nothing, so with every bounce the room is as bright as without the
    shell: 1 after all bounces but for paths that meet the shell again. Expected: `path` sees
    black; we see the flux times the transmittance of the two interfaces after one reflection
    (multiple reflections within the shell at higher depth). Tolerance: the confidence interval,
    below 4 % (which 512 samples would just reach). Statistic: t-test over 16 seeds.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": camera((0, 0, 0.6), (0, 0.5, 1), fov=50, size=8),
            "wall": {"type": "sphere", "bsdf": diffuse(0.5)},
            "outer": {"type": "sphere", "radius": 0.3, "bsdf": {"type": "dielectric", "int_ior": 1.5}},
            "inner": {
                "type": "sphere",
                "radius": 0.25,
                "flip_normals": False,
                "bsdf": {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5},
            },
            "lamp": {"type": "point", "intensity": float(np.pi)},
        }
    )
    assert render(scene, integrator("path", max_depth=6), [1], 16).max() == 0
    transmittance = (1 - ((1.5 - 1) / (1.5 + 1)) ** 2) ** 2
    for skip in ("none", "auto"):
        images = render(scene, integrator(max_depth=4, skip=skip), range(16), 1024)
        known(images.mean((1, 2, 3)), 0.5 * transmittance, 0.04)


def frame(angle):
    """A ball of glass over a floor under an uneven sky, through a lens that moves on a circle."""
    origin = (3 * np.sin(angle), 2, 3 * np.cos(angle))
    eye = views.camera("thinlens", origin, (0, 0, 0), fov=45, aperture_radius=0.1, focus_distance=3.6)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": eye,
            "floor": {
                "type": "rectangle",
                "bsdf": diffuse(0.7),
                "to_world": T().rotate([1, 0, 0], -90).scale(2),
            },
            "ball": {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.4, "bsdf": {"type": "dielectric"}},
            "sky": {"type": "envmap", "bitmap": parts.sky_bitmap()},
        }
    )


def test_caustics_do_not_flash():
    """LuxCore #441: under an environment, caustics of a ball at rest flashed from frame to frame of a moving
    camera with depth of field. Expected: each of six frames, with light tracing, is as bright as `path` finds
    it. Tolerance: 5 %, four standard errors of 64 samples per pixel.
    """
    for i in range(6):
        scene = frame(0.05 * i)
        ours = render(scene, integrator(max_depth=6, skip="none"), [i], 64).mean()
        path = render(scene, integrator("path", max_depth=6), [100 + i], 512).mean()
        assert ours == pytest.approx(path, rel=0.05)


def test_lights_of_two_kinds_add_up():
    """LuxCore #68: a point light beside a uniform environment; each alone was right, both together were not,
    as one of them was chosen with a wrong probability. Expected: the image is the sum of those with each
    light alone. Tolerance: the confidence interval, below 2 %. Statistic: Welch's t-test over 8 seeds.
    """
    lights = {
        "lamp": {"type": "point", "position": [0, 1, 1], "intensity": 2.0},
        "sky": {"type": "constant", "radiance": 0.5},
    }
    scene = {
        "type": "scene",
        "sensor": camera((0, 2, 3), (0, 0.3, 0), size=8),
        "floor": {"type": "rectangle", "bsdf": diffuse(0.7), "to_world": T().rotate([1, 0, 0], -90).scale(2)},
        "ball": {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.4, "bsdf": diffuse(0.5)},
    }
    bdpt = integrator(max_depth=4, skip="none")
    alone = [
        render(mi.load_dict(scene | {name: light}), bdpt, range(8), 256)[..., :3]
        for name, light in lights.items()
    ]
    both = render(mi.load_dict(scene | lights), bdpt, range(20, 28), 256)[..., :3]
    agree(tiles(both, 4), tiles(sum(alone), 4), relative=0.02)


def test_a_crop_window_set_later_with_a_shifted_principal_point():
    """Mitsuba 3 #236: a crop window set on the film of a camera with a shifted principal point showed another
    part of the scene. Expected: the same image as with the crop window in the scene, to rounding.
    """
    window = {"crop_offset_x": 4, "crop_offset_y": 2, "crop_width": 8, "crop_height": 8}
    images = []
    for later in (False, True):
        eye = camera((0, 2, 3), (0, 0.3, 0), **({} if later else window))
        eye |= {"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1}
        scene = mi.load_dict(
            {
                "type": "scene",
                "sensor": eye,
                "ball": {"type": "sphere", "center": [0.3, 0.5, 0], "radius": 0.6, "bsdf": diffuse(0.5)},
                "lamp": {"type": "point", "position": [0, 2, 2], "intensity": 2.0},
            }
        )
        if later:
            params = mi.traverse(scene)
            params["sensor.film.crop_offset"], params["sensor.film.crop_size"] = [4, 2], [8, 8]
            params.update()
        images.append(render(scene, integrator(max_depth=3, skip="none"), [1], 16))
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-5)


def patch(path, side):
    """Write a mesh of 2 side^2 triangles, the square [-1, 1]^2 at z = 0, whose front is below."""
    line = np.linspace(-1, 1, side + 1)
    x, y = np.meshgrid(line, line)
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    corner, above = first + 1, first + side + 1
    faces = np.concatenate([np.stack([first, above, corner], 1), np.stack([corner, above, above + 1], 1)])
    mesh = mi.Mesh("patch", x.size, len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.stack([x, y, 0 * x], -1).astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path)}


def under_a_patch(lamp):
    lamp |= {"emitter": {"type": "area", "radiance": 2.0}, "bsdf": diffuse(0)}
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -2]).scale(2), "bsdf": diffuse(0.5)}
    eye = camera((0, -5, -0.7), (0, 0, -1), size=8, up=(0, 0, 1))
    return mi.load_dict({"type": "scene", "lamp": lamp, "floor": floor, "sensor": eye})


# A process of its own, which ends while it traces: Python 3.11 crashes if tracemalloc stops while a thread of
# Dr.Jit allocates (CPython's issue 128679).
CHILD = """
import os, sys, tracemalloc
import mitsuba_bdpt, mitsuba as mi
import numpy as np

variant, folder = sys.argv[1:]
mi.set_variant(variant)
import test_known_failures as tests

method = tests.integrator(max_depth=2, skip="none")
peaks = []
for side in (10, 100):
    scene = tests.under_a_patch(tests.patch(f"{folder}/{side}.ply", side))
    if not peaks:
        tests.render(scene, method, [1], 1)  # imports and kernels are not counted
        tracemalloc.start()
    tracemalloc.clear_traces()
    many = tests.render(scene, method, range(8), 16)
    peaks.append(tracemalloc.get_traced_memory()[1])
np.savez(f"{folder}/found.npz", peaks=peaks, many=many)
os._exit(0)
"""


def test_meshes_of_many_emitting_triangles(tmp_path):
    """pbrt-v4 #183: a million emitting triangles took nine kilobytes each, one light per triangle.

    Expected: the image of one rectangle; at most 400 bytes of NumPy's memory per triangle more for 20,000
    than for 200 (vertices and normals in double precision: 150 bytes).
    """
    command = [sys.executable, "-c", CHILD, mi.variant(), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    found = np.load(tmp_path / "found.npz")
    peaks, many = found["peaks"], found["many"]
    assert peaks[1] - peaks[0] < 400 * 2 * (100**2 - 10**2)
    method = integrator(max_depth=2, skip="none")
    rectangle = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], 180)}
    one = render(under_a_patch(rectangle), method, range(9, 17), 16)
    agree(tiles(many), tiles(one), 0.03)
