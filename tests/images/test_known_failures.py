"""Bugs that other bidirectional path tracers had in public, and bugs that were planted here and once not
seen.

The thread where each was reported stands first. Statistic, unless said: Welch's t-test of tile means over
seeds, which differ between the two sides, with Šidák's correction (`welch.agree`); tolerances are bounds of
the confidence interval of the image. More such bugs have rows in `test_known_answers` and `test_same_mean`.
"""

from functools import partial

import drjit as dr
import internals
import mitsuba as mi
import numpy as np
import pytest
import welch
from meshes import ball_mesh
from mitsuba_bdpt.sampling.points import Points, Purpose
from test_same_mean import bumpy_sphere, under_a_disk
from welch import tiles

from scenes import (
    area,
    both_sides,
    camera,
    floor,
    integrator,
    layer,
    load,
    matte,
    renders,
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


# -- bugs that were planted here and once not seen ----------------------------------------------


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
    scene = load(**under_a_disk(floor=floor()))
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
    eye = thinlens(origin=(0, 2, 3), target=(0, 0, 0), fov=50, aperture_radius=0.05, focus_distance=3.0)
    scene = load(**under_a_disk(floor=floor(), sensor=eye))
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
