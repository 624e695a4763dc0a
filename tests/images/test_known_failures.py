"""Bugs that other bidirectional path tracers had in public, and bugs that were planted here and once not
seen.

The thread where each was reported stands first. Statistic, unless said: Welch's t-test of tile means over
seeds, which differ between the two sides, with Šidák's correction (`welch.agree`); tolerances are bounds of
the confidence interval of the image. More such bugs have rows in `test_known_answers` and `test_same_mean`.
"""

import os
import subprocess
import sys
from functools import partial

import drjit as dr
import internals
import mitsuba as mi
import numpy as np
import pytest
import welch
from meshes import as_ply, ball_mesh
from mitsuba_bdpt.sampling.points import Points, Purpose
from scipy import stats
from test_same_mean import BUMPS, bumpy_sphere, coarse_ball
from welch import tiles

from scenes import (
    DOWNWARDS,
    area,
    both_sides,
    camera,
    floor,
    integrator,
    layer,
    load,
    matte,
    renders,
    square,
    thinlens,
    transform,
)

ROUNDING = 1e-4  # systematic differences in float32 between two ways to one image, relative

agree = partial(welch.agree, rounding=ROUNDING)


def layered(max_depth, **parameters):
    return integrator(max_depth=max_depth, rr_depth=50, skip="none", layers="strategies", **parameters)


@pytest.mark.parametrize("kind", ["bumpmap", "normalmap"])
def test_no_spikes_inside_a_bumpy_sphere(kind):
    """pbrt-v3 #73: the adjoint factor of shading normals was in the walk but not at the connection. No pixel
    above three times its neighbourhood's median: noise at 256 spp reaches 2.1, the bug 5 to 12."""
    method = layered(8)
    image = renders(load(**bumpy_sphere(kind)), method, 256, 1, 1)
    for name in (None, *(f"weighted.s{k + 1 - t}t{t}" for k in range(3, 9) for t in (1, 2))):
        pixels = (image[..., :3] if name is None else layer(image, method, name))[0].mean(-1)
        padded = np.pad(pixels, 2, mode="reflect")
        around = np.median(np.lib.stride_tricks.sliding_window_view(padded, (5, 5)), axis=(2, 3))
        assert np.max(pixels / around) < 3, name


@pytest.mark.parametrize("kind", [*BUMPS, "coarse mesh"])
def test_light_side_agrees_with_camera_side(kind):
    """mitsuba3 #42, #45: a light tracer brighter than `path` on bumped surfaces; pbrt-v4 #385, #526, #13:
    surfaces with interpolated normals too shiny on the light side (16 to 57 % per pixel). s = 3 only where
    normals are not turned towards the camera."""
    scene = load(**(coarse_ball() if kind == "coarse mesh" else bumpy_sphere(kind)))
    method = layered(3)
    images, others = renders(scene, method, 256, 16), renders(scene, method, 256, 16, 50)
    pairs = [(2, 1)] if kind == "coarse mesh" else [(2, 1), (2, 2)]
    for s, t in pairs + [(3, 1)] * kind.endswith("unflipped"):
        reference = layer(others, method, f"unweighted.s1t{s + t - 1}")
        agree(tiles(layer(images, method, f"unweighted.s{s}t{t}")), tiles(reference), 0.03)


MIRRORED = transform().scale([-1, 1, 1])
STRETCHED = transform().rotate([0.26726124, 0.53452248, 0.80178373], 40).scale([0.7, -1.2, 1])


@pytest.mark.parametrize(
    "to_world, flip",
    [(transform(), False), (MIRRORED, False), (MIRRORED, True), (STRETCHED, False)],
    ids=["plain", "mirrored", "mirrored, flipped", "mirrored, stretched"],
)
@pytest.mark.parametrize("inside", [False, True], ids=["outside", "inside"])
def test_emitter_mesh_with_vertex_normals(to_world, flip, inside):
    """pbrt-v3 #229, mitsuba3 #1952: a mirrored emitter mesh with vertex normals emitted on one side when hit
    and on the other when sampled; its normal differed between sampling and density. A ball of 20 triangles
    lights a floor. Expected: s = 0, s = 1 and t = 1 alone agree with direct light and seen directly, to 20 %
    on the bright side; a side that is dark for one is dark for all."""
    lamp = {"to_world": transform().scale(1.5 if inside else 0.5) @ to_world, "flip_normals": flip}
    scene = load(
        sensor=camera(origin=(0, 0, 0) if inside else (0, 1.5, 4), target=(0, -0.6, 0.3), up=(0, 0, 1)),
        lamp=ball_mesh() | lamp | {"bsdf": matte(0), "emitter": area(2.0)},
        floor=floor(-0.45, 0.2, both_sides(0.8)) if inside else floor(-1.4, 2, both_sides(0.8)),
    )
    method = layered(2)
    images, others = renders(scene, method, 256, 12), renders(scene, method, 256, 12, 50)
    hit = layer(images, method, "unweighted.s0t3")
    if hit.max() == 0:
        assert images.max() == 0
        return
    assert images[..., :3].max() > 0
    bright = hit.mean() > 0.01  # else only what shading normals let through a dark side is seen
    for name in ("s1t2", "s2t1"):
        agree(tiles(hit), tiles(layer(others, method, f"unweighted.{name}")), 0.2 if bright else 1)
    seen = layer(images, method, "unweighted.s0t2")
    agree(tiles(seen), tiles(layer(others, method, "unweighted.s1t1")), 0.2 if bright else 1)


def test_emitter_meshes_are_lit_on_one_side():
    """The cases above light both sides between them; a test of darkness alone would prove nothing."""
    for to_world, flip, lit in (
        (transform(), False, True),
        (transform(), True, False),
        (MIRRORED, False, None),
    ):
        lamp = {"type": "rectangle", "to_world": to_world, "flip_normals": flip, "emitter": area(1.0)}
        method = layered(1)
        scene = load(sensor=camera(origin=(0, 0, 4), target=(0, 0, 0), fov=45), lamp=lamp)
        images = renders(scene, method, 64, 2)
        hit, sampled = (layer(images, method, f"unweighted.s{s}t{2 - s}").mean() for s in (0, 1))
        assert (hit > 0) == (sampled > 0)
        assert lit is None or (hit > 0) == lit


@pytest.mark.parametrize("size", [16, 64])
def test_point_light_in_a_cornell_box_has_no_hot_pixel(size):
    """Mitsuba 0.6 #132: a point light seen by a pinhole made one pixel above 80,000, ever hotter with the
    resolution."""
    scene = mi.cornell_box()
    scene["light"] = {"type": "point", "position": [0.1, 0.5, 0.1], "intensity": 1.0}
    scene["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    scene = mi.load_dict(scene)
    ours, theirs = (
        renders(scene, integrator(kind, max_depth=5), 256, 1, 3)[0].mean(-1) for kind in ("bdpt", "path")
    )
    assert ours.max() < 1.2 * theirs.max()
    assert abs(np.median(ours) / np.median(theirs) - 1) < 0.05


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_crop_window_equals_the_region_of_the_whole(rfilter):
    """pbrt-v4 #347, #456: crop windows changed the number of light paths per pixel, in the image but not in
    the weights. At the crop's border the filter lacks samples; weighted images differ by right."""

    def scene(**film):
        eye = camera(origin=(0, 0, 0.5), target=(0.3, 0.1, -1), size=24, rfilter=rfilter, film=film)
        lamp = {"type": "sphere", "radius": 0.1, "center": [0.2, 0.3, -0.4], "emitter": area(5.0)}
        return load(sensor=eye, wall={"type": "sphere", "bsdf": both_sides(0.5)}, lamp=lamp)

    method = layered(3)
    whole = renders(scene(), method, 128, 16)[:, 5:15, 9:21]
    window = {"crop_offset_x": 7, "crop_offset_y": 3, "crop_width": 16, "crop_height": 14}
    part = renders(scene(**window), method, 128, 16, 50)[:, 2:12, 2:14]
    assert part.shape == whole.shape
    agree(tiles(part[..., :3], 2), tiles(whole[..., :3], 2), 0.03)
    for k in (1, 2, 3):
        for s in range(k + 1):
            name = f"unweighted.s{s}t{k + 1 - s}"
            agree(tiles(layer(part, method, name), 2), tiles(layer(whole, method, name), 2), 0.3)


@pytest.mark.parametrize("fov", [30, 1.5], ids=["the whole spot is seen", "a fiftieth of the spot is seen"])
def test_narrow_spot_on_a_matte_floor(fov):
    """pbrt-v4 #362: on a floor lit directly by a narrow spot, light tracing was trusted too much. Expected:
    the variance with all strategies is below that of t = 1 alone and within the balance bound of next-event
    estimation's, mu^2 per sample above it. Seen as a whole, a lit pixel gets some eight splats per sample; of
    a fiftieth of the spot a pixel gets a splat in fifty samples, and t = 1 alone has fifty times the bound.
    Tolerance: a tenth (variances from 64 seeds, summed over the lit pixels: 5 % noise)."""
    spp = 16
    spot = {"type": "spot", "cutoff_angle": 6, "intensity": 30.0}
    scene = load(
        sensor=camera(origin=(0, 4, 0), target=(0, 0, 0), fov=fov, up=(0, 0, 1)),
        floor=floor(0, 3, both_sides(0.5)),
        lamp=spot | {"to_world": transform().look_at([1, 4, 1], [0, 0, 0], [0, 0, 1])},
    )
    method = layered(2, points="independent")
    images = renders(scene, method, spp, 64)
    mean, total = images[..., :3].mean(0), images[..., :3].var(0, ddof=1).sum()
    splats, direct = (
        layer(images, method, f"unweighted.{name}").var(0, ddof=1).sum() for name in ("s2t1", "s1t2")
    )
    bound = direct + np.sum(mean**2) / spp
    assert splats > (2 * direct if fov == 30 else 20 * bound)  # the scene shows what it is meant to show
    assert total < splats
    assert total < 1.1 * bound


def test_a_crop_window_set_later_with_a_shifted_principal_point():
    """Mitsuba 3 #236: such a window showed another part of the scene."""
    window = {"crop_offset_x": 4, "crop_offset_y": 2, "crop_width": 8, "crop_height": 8}
    images = []
    for film in (window, {}):
        eye = camera(origin=(0, 2, 3), target=(0, 0.3, 0), fov=45, film=film)
        eye |= {"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1}
        ball = {"type": "sphere", "center": [0.3, 0.5, 0], "radius": 0.6, "bsdf": both_sides(0.5)}
        scene = load(sensor=eye, ball=ball, lamp={"type": "point", "position": [0, 2, 2], "intensity": 2.0})
        if not film:
            params = mi.traverse(scene)
            params["sensor.film.crop_offset"], params["sensor.film.crop_size"] = [4, 2], [8, 8]
            params.update()
        images.append(renders(scene, integrator(max_depth=3, skip="none"), 16, 1, 1))
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-5)


def patch(side):
    """A mesh of 2 side^2 triangles, the square [-1, 1]^2 at z = 0, whose front is below."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, side + 1)] * 2)
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    corner, above = first + 1, first + side + 1
    faces = np.concatenate([np.stack([first, above, corner], 1), np.stack([corner, above, above + 1], 1)])
    return as_ply(np.stack([x, y, 0 * x], -1).reshape(-1, 3), faces)


def under_a_patch(lamp):
    eye = camera(origin=(0, -5, -0.7), target=(0, 0, -1), fov=45, size=8, up=(0, 0, 1))
    ground = square((0, 0, -2), size=2, bsdf=both_sides(0.5))
    return load(lamp=lamp | {"emitter": area(2.0), "bsdf": both_sides(0)}, floor=ground, sensor=eye)


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
    scene = tests.under_a_patch(tests.patch(side))
    if not peaks:
        tests.renders(scene, method, 1, 1)  # imports and kernels are not counted
        tracemalloc.start()
    tracemalloc.clear_traces()
    many = tests.renders(scene, method, 16, 8)
    peaks.append(tracemalloc.get_traced_memory()[1])
np.savez(f"{folder}/found.npz", peaks=peaks, many=many)
os._exit(0)
"""


def test_meshes_of_many_emitting_triangles(tmp_path):
    """pbrt-v4 #183: a million emitting triangles took nine kilobytes each, one light per triangle. Expected:
    the image of one rectangle; at most 400 bytes of NumPy's memory per triangle more for 20,000 than for 200
    (vertices and normals in double precision: 150 bytes)."""
    command = [sys.executable, "-c", CHILD, mi.variant(), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    found = np.load(tmp_path / "found.npz")
    peaks, many = found["peaks"], found["many"]
    assert peaks[1] - peaks[0] < 400 * 2 * (100**2 - 10**2)
    rectangle = {"type": "rectangle", "to_world": transform().rotate([1, 0, 0], 180)}
    one = renders(under_a_patch(rectangle), integrator(max_depth=2, skip="none"), 16, 8, 9)
    agree(tiles(many), tiles(one), 0.03)


# -- bugs that were planted here and once not seen ----------------------------------------------


def sensor(**more):
    return camera(**{"origin": (0, 2, 3), "target": (0, 0, 0), "fov": 50} | more)


def lit_from_above(**parts):
    """A bright disk that looks down."""
    to_world = transform().translate([0, 2.5, 0]).rotate(*DOWNWARDS).scale(0.5)
    lamp = {"type": "disk", "to_world": to_world, "bsdf": matte(0), "emitter": area(5.0)}
    return load(lamp=lamp, **parts)


def means(scene, spp=64, seeds=16, **parameters):
    """Mean radiance of the image for each seed."""
    return renders(scene, integrator(**{"max_depth": 4, "rr_depth": 5} | parameters), spp, seeds).mean(
        (1, 2, 3)
    )


def are_one_mean(first, second):
    return stats.ttest_ind(first, second, equal_var=False).pvalue > 1e-3


def test_light_on_a_hidden_lamp_is_not_splatted():
    """Camera rays pass through a lamp under ``hide_emitters``, and what its surface reflects is not seen."""
    screen = floor(0.3, 0.6, matte(0.8), emitter=area(0.5))
    scene = lit_from_above(screen=screen, floor=floor(0, 2, matte(0.8)), sensor=sensor())
    alone = means(scene, hide_emitters=True, light_paths=0)
    assert are_one_mean(alone, means(scene, hide_emitters=True, skip="none"))


def test_a_ball_is_seen_as_it_is_through_a_hidden_lamp():
    """`path` shades what lies behind a hidden lamp at a wrong point of spheres (a ninth of it). The pole of a
    matte ball is seen through the lamp above it as from below the lamp (the views' edges differ by less than
    1 %)."""
    lamp = square((0, 2, 0), DOWNWARDS, 0.8, emitter=area(4.0))

    def pole(height):
        view = camera(origin=(0, height, 0), target=(0, 0, 0), up=(0, 0, 1), size=4, fov=0.5 * 6 / height)
        return load(lamp=lamp, ball={"type": "sphere", "bsdf": matte(0.5)}, sensor=view)

    hidden = {"hide_emitters": True, "spp": 256}
    right = means(pole(1.5), light_paths=0, **hidden)
    for parameters in ({"light_paths": 0}, {"skip": "none"}):
        assert np.mean(means(pole(6.0), **parameters, **hidden)) == pytest.approx(np.mean(right), rel=0.01)


def test_what_is_in_front_of_a_lens_hides_the_light_from_it():
    """The lens is no shape, so that light subpaths that cross it (t = 0) have to be told what is in
    between."""
    towards = transform().look_at([0, 0, -3], [0, 0, 0], [0, 1, 0])
    lens = thinlens(origin=(0, 0, 2), target=(0, 0, 0), aperture_radius=0.5, focus_distance=3.0)
    scene = load(
        lamp={"type": "rectangle", "to_world": towards, "bsdf": matte(0), "emitter": area(5.0)},
        plate=square((0, 0, -1), size=5, bsdf=matte(0)),
        sensor=lens,
    )
    assert not np.any(renders(scene, integrator(max_depth=3, skip="none"), 64, 1))


@pytest.mark.parametrize("width, height", [(3, 1), (5, 3)])
def test_splats_of_few_pixels_count_once(width, height):
    """Where S does not divide the samples, there are more light subpaths than 1/S of them: of three pixels
    with S = 16, one for each three samples."""
    ball = {"type": "sphere", "center": [0, 1, 0], "radius": 0.2, "bsdf": {"type": "dielectric"}}
    lamp = {"type": "point", "position": [0, 1.05, 0]}
    eye = sensor(film={"width": width, "height": height})
    scene = load(ball=ball, lamp=lamp, floor=floor(0, 2, matte(0.8)), sensor=eye)
    shared, own = (means(scene, 63, light_paths=n, connections="one") for n in (1 / 16, 1))
    assert np.mean(own) > 0 and are_one_mean(own, shared)


@pytest.mark.parametrize("kind", ["sobol", "independent"])
def test_no_number_decides_two_things(kind):
    """First coordinates for all purposes at three vertices of both subpaths are uncorrelated in pairs (5
    standard errors of independent numbers)."""
    lanes = dr.arange(mi.UInt32, 4096)
    points, drawn = Points(kind, mi.UInt32(3)), []
    purposes = Purpose.__members__.values()  # with aliases
    for side in ("camera", "light"):
        stream = points.stream(side, mi.UInt64(lanes) << 32)  # each of a sequence of its own
        for vertex in (0, 1, 2):
            drawn += [np.array(points.draw_1d(side, stream, p, vertex)) for p in purposes]
    found = np.corrcoef(np.array(drawn))
    assert len(drawn) == 2 * 3 * len(purposes)
    assert np.abs(found - np.eye(len(drawn))).max() < 5 / 4096**0.5


def test_subpaths_draw_from_their_own_streams(monkeypatch):
    made, wrong, stream, draw = [], [], Points.stream, Points._draw

    def making(self, side, *place):
        made.append((side, stream(self, side, *place)))
        return made[-1][1]

    def drawing(self, side, source, purpose, vertex, dims):
        owner = next(owner for owner, known in made if known is source)
        wrong.extend([(purpose, side, owner)] * (owner != side))
        return draw(self, side, source, purpose, vertex, dims)

    monkeypatch.setattr(Points, "stream", making)
    monkeypatch.setattr(Points, "_draw", drawing)
    scene = lit_from_above(floor=floor(), sensor=sensor())
    mi.load_dict({"type": "bdpt", "light_paths": 1, "connections": "one"}).render(scene, spp=1)
    sides = sorted(side for side, _ in made)
    made.clear()  # a failure would keep variables of a loop that is recorded beyond the end of Dr.Jit
    assert sides == ["camera", "light"] and not wrong


def test_each_purpose_is_drawn_for_at_one_place(monkeypatch):
    """A loop is recorded once; what connects endpoints with a lens is of another vertex."""
    drawn, original = [], Points._draw

    def recorded(self, side, stream, purpose, vertex, dims):
        drawn.append((side, purpose, isinstance(vertex, int)))
        return original(self, side, stream, purpose, vertex, dims)

    monkeypatch.setattr(Points, "_draw", recorded)
    scene = lit_from_above(
        floor=floor(), sensor=sensor(kind="thinlens", aperture_radius=0.05, focus_distance=3.0)
    )
    for connections in ("one", "all"):
        drawn.clear()
        method = mi.load_dict({"type": "bdpt", "light_paths": 1, "connections": connections})
        method.render(scene, spp=1)
        purposes = {(side, purpose) for side, purpose, _ in drawn}
        assert len(set(drawn)) == len(drawn)
        assert len(purposes) >= 2 * 4 and ("camera", Purpose.ROULETTE) in purposes


def test_what_plays_roulette_is_made_up_for():
    """With a threshold of twice the mean the mean of the image is that without roulette, within five standard
    errors; with the threshold of a render an error there is less than its noise."""
    room = mi.cornell_box() | {"light": {"type": "point", "position": [0, 0.9, 0], "intensity": 1.0}}
    room["sensor"]["film"].update(width=32, height=32)
    scene = mi.load_dict(room)
    everything = mi.load_dict({"type": "bdpt", "max_depth": 5, "skip": "none", "light_paths": 1})
    expected = renders(scene, everything, 512, 1, 1).mean()
    for connections in ("none", "one"):
        decision = {"light_paths": 1, "connections": connections, "cost": 1.0, "variance": 1.0}
        decision |= {"coefficients": {"t<=1": 1.0, "s=1": 1.0}, "mean": 20 * float(expected)}
        decided = internals.bdpt(max_depth=5, decisions=[decision])
        assert renders(scene, decided, 512, 1, 2).mean() == pytest.approx(expected, rel=0.02)
        assert decided.statistics["connections"]["rouletted"] > 32 * 32 * 512 / 2
