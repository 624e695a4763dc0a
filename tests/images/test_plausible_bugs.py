"""Bugs that are easily made and were once not seen: each of these tests was seen failing on one of them."""

import drjit as dr
import internals
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.sampling.points import Points, Purpose
from scipy import stats

T = mi.ScalarTransform4f


def quad(size, height, radiance=None, reflectance=0.8):
    """A square that looks up, emitting or not."""
    to_world = T().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(size)
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}
    emitter = {} if radiance is None else {"emitter": {"type": "area", "radiance": radiance}}
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf} | emitter


def sensor(width=16, height=16, **more):
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "fov": 50,
        "to_world": T().look_at([0, 2, 3], [0, 0, 0], [0, 1, 0]),
        "film": film | {"pixel_format": "rgb"},
        **more,
    }


def lit_from_above(**parts):
    """A bright disk that looks down."""
    to_world = T().translate([0, 2.5, 0]).rotate([1, 0, 0], 90).scale(0.5)
    black = {"type": "diffuse", "reflectance": 0.0}
    lamp = {"type": "disk", "to_world": to_world, "bsdf": black, "emitter": {"type": "area", "radiance": 5.0}}
    return mi.load_dict({"type": "scene", "lamp": lamp, **parts})


def means(scene, seeds=16, spp=64, **parameters):
    """Mean radiance of the image for each seed."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 4, **parameters})
    return [float(np.mean(integrator.render(scene, seed=seed, spp=spp))) for seed in range(seeds)]


def agree(first, second):
    """Whether two sets of means are as expected of one number: Welch's test, level 1e-3."""
    return stats.ttest_ind(first, second, equal_var=False).pvalue > 1e-3


def test_light_on_a_hidden_lamp_is_not_splatted():
    """Rationale: under ``hide_emitters`` camera rays pass through a lamp, and what its surface reflects is
    not seen; a black lamp would not show a splat there. A lamp of reflectance 0.8 over the floor, lit by
    another. Expected: all strategies have the mean of camera subpaths alone."""
    scene = lit_from_above(screen=quad(0.6, 0.3, radiance=0.5), floor=quad(2, 0), sensor=sensor())
    alone = means(scene, hide_emitters=True, light_paths=0)
    assert agree(alone, means(scene, hide_emitters=True, skip="none"))


def test_a_ball_is_seen_as_it_is_through_a_hidden_lamp():
    """Rationale: `path` shades what lies behind a hidden lamp at a wrong point of spheres. The pole of a
    matte ball, which looks the same from everywhere: seen through the lamp above it, and from below the lamp.
    Expected: the same radiance by camera subpaths alone and by all strategies, within 1 % (the view's
    edges differ by less); `path` finds a ninth of it."""

    to_world = T().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(0.8)
    lamp = {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": 4.0}}

    def pole(height):
        to_world = T().look_at([0, height, 0], [0, 0, 0], [0, 0, 1])
        ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
        view = sensor(4, 4, to_world=to_world, fov=0.5 * 6 / height)
        return mi.load_dict({"type": "scene", "lamp": lamp, "ball": ball, "sensor": view})

    hidden = {"hide_emitters": True, "spp": 256}
    right = means(pole(1.5), light_paths=0, **hidden)
    for parameters in ({"light_paths": 0}, {"skip": "none"}):
        assert np.mean(means(pole(6.0), **parameters, **hidden)) == pytest.approx(np.mean(right), rel=0.01)
    path = mi.load_dict({"type": "path", "max_depth": 4, "hide_emitters": True})
    assert np.mean(path.render(pole(6.0), spp=256)) < 0.2 * np.mean(right)


def test_what_is_in_front_of_a_lens_hides_the_light_from_it():
    """Rationale: the lens is no shape, so that light subpaths that cross it (t = 0) have to be told what is
    in between. A lamp that shines at a large lens through a black plate. Expected: a black image."""
    black = {"type": "diffuse", "reflectance": 0.0}
    towards = T().look_at([0, 0, -3], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "lamp": {
                "type": "rectangle",
                "to_world": towards,
                "bsdf": black,
                "emitter": {"type": "area", "radiance": 5.0},
            },
            "plate": {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(5), "bsdf": black},
            "sensor": sensor(
                type="thinlens",
                to_world=T().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]),
                aperture_radius=0.5,
                focus_distance=3.0,
            ),
        }
    )
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 3, "skip": "none"})
    assert not np.any(np.array(integrator.render(scene, spp=64)))


@pytest.mark.parametrize("width, height", [(3, 1), (5, 3)])
def test_splats_of_few_pixels_count_once(width, height):
    """Rationale: where S does not divide the samples, there are more light subpaths than 1/S of them: of
    three pixels with S = 16, one for each three samples. A point lamp in a glass ball, whose light splats
    alone bring to the floor. Expected: the mean that one light subpath for each camera subpath gives."""
    ball = {"type": "sphere", "center": [0, 1, 0], "radius": 0.2, "bsdf": {"type": "dielectric"}}
    lamp = {"type": "point", "position": [0, 1.05, 0]}
    parts = {"ball": ball, "lamp": lamp, "floor": quad(2, 0), "sensor": sensor(width, height)}
    scene = mi.load_dict({"type": "scene", **parts})
    shared, own = (means(scene, light_paths=n, connections="one", spp=63) for n in (1 / 16, 1))
    assert np.mean(own) > 0 and agree(own, shared)


@pytest.mark.parametrize("kind", ["sobol", "independent"])
def test_no_number_decides_two_things(kind):
    """Rationale: light and camera subpaths with one seed, or one dimension for two purposes, bias the image
    by what the two have to do with each other. Expected: first coordinates for all purposes at three
    vertices of both subpaths of 4,096 samples are uncorrelated in pairs (5 standard errors of independent
    numbers)."""
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
    """Rationale: as before, where the kernel asks for a stream. Expected: one stream for each side, and each
    draw of a side is from the one that was made for it."""
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
    scene = lit_from_above(floor=quad(2, 0), sensor=sensor())
    mi.load_dict({"type": "bdpt", "light_paths": 1, "connections": "one"}).render(scene, spp=1)
    sides = sorted(side for side, _ in made)
    made.clear()  # a failure would keep variables of a loop that is recorded beyond the end of Dr.Jit
    assert sides == ["camera", "light"] and not wrong


def test_each_purpose_is_drawn_for_at_one_place(monkeypatch):
    """Rationale: as before, at the place that draws. Expected: a kernel with all strategies draws for each
    purpose once (a loop is recorded once; what joins endpoints with a lens is of another vertex)."""
    drawn, original = [], Points._draw

    def recorded(self, side, stream, purpose, vertex, dims):
        drawn.append((side, purpose, isinstance(vertex, int)))
        return original(self, side, stream, purpose, vertex, dims)

    monkeypatch.setattr(Points, "_draw", recorded)
    lens = sensor(type="thinlens", aperture_radius=0.05, focus_distance=3.0)
    scene = lit_from_above(floor=quad(2, 0), sensor=lens)
    for connections in ("one", "all"):
        drawn.clear()
        integrator = mi.load_dict({"type": "bdpt", "light_paths": 1, "connections": connections})
        integrator.render(scene, spp=1)
        purposes = {(side, purpose) for side, purpose, _ in drawn}
        assert len(set(drawn)) == len(drawn)
        assert len(purposes) >= 2 * 4 and ("camera", Purpose.ROULETTE) in purposes


def test_what_plays_roulette_is_made_up_for():
    """Rationale: small splats and drawn connections are dropped before their ray, and those that stay stand
    for them; with the threshold of a render, a tenth of the image's mean at most, an error there is less than
    its noise. Expected: with a threshold of twice the mean, below which most of them are, the mean of the
    image is that without roulette, within 2 % (five standard errors)."""
    room = mi.cornell_box() | {
        "integrator": {"type": "bdpt", "max_depth": 5, "skip": "none", "light_paths": 1}
    }
    room["sensor"]["film"].update(width=32, height=32)
    room["light"] = {"type": "point", "position": [0, 0.9, 0], "intensity": 1.0}
    scene = mi.load_dict(room)
    expected = np.array(mi.render(scene, spp=512, seed=1)).mean()
    for connections in ("none", "one"):
        decision = {"light_paths": 1, "connections": connections, "cost": 1.0, "variance": 1.0}
        decision |= {"coefficients": {"t<=1": 1.0, "s=1": 1.0}, "mean": 20 * float(expected)}
        decided = internals.bdpt(max_depth=5, decisions=[decision])
        assert np.array(decided.render(scene, seed=2, spp=512)).mean() == pytest.approx(expected, rel=0.02)
        assert decided.statistics["connections"]["rouletted"] > 32 * 32 * 512 / 2
