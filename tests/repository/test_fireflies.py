"""The paths behind the worst values: the command `fireflies`, its recording and its reconstruction."""

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import media_parts
import mitsuba as mi
import numpy as np
import pytest

import scenes

from instruments import fireflies, reconstruct, recording

T = scenes.transform


def between_mirrors(bsdf="conductor"):
    """A small lamp that lights the floor only by a mirror, and a camera that sees it only in another one."""
    mirror = {"type": "twosided", "bsdf": {"type": bsdf}, "id": "ceiling"}
    # Facing up, away from the floor.
    to_world = T().translate([-0.5, 1, -1]).rotate([1, 0, 0], -90).scale(0.35)
    lamp = {"type": "disk", "to_world": to_world, "bsdf": scenes.matte(0), "emitter": scenes.area(100.0)}
    return scenes.load(
        sensor=scenes.camera(origin=(2, 1, 0), target=(2, 2, -0.8), fov=30, size=12),
        lamp=lamp,
        upper=scenes.square((0, 2.5, 0), scenes.DOWNWARDS, 4, mirror),
        lower=scenes.floor(size=4, bsdf=scenes.both_sides(0.5) | {"id": "floor"}),
    )


def worst(scene, depth, count, level, **parameters):
    """The worst samples of a render, ``level`` times the image's mean over it."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": depth} | parameters)
    plain = np.array(integrator.render(scene, spp=64, seed=1))
    target = np.full_like(plain, plain.mean(), dtype=float)
    image, found = fireflies.fireflies(scene, integrator, target, 64, 1, level, count)
    # It is the render that it watches; sums are added in another order.
    assert np.allclose(image, plain, rtol=1e-4, atol=1e-6 * plain.mean())
    return found


def test_a_path_that_one_strategy_alone_makes_is_named():
    """Of paths of up to 4 edges only lamp, mirror, floor, mirror, eye brings light, by s = 0 alone. Expected:
    its estimate is radiance times reflectance, 50, its weight 1, and `path` has the same firefly."""
    found = worst(between_mirrors(), 4, 8, 0.3)
    assert len(found) == 8
    for firefly in found:
        assert firefly.kind == ((0, 5), "L S D S E", "ceiling, floor, ceiling")
        assert firefly.doubt == "" and firefly.path.weight == 1
        assert firefly.path.value == pytest.approx([50] * 3, rel=1e-4)
        assert np.flatnonzero(firefly.rebuilt.relative(0)).tolist() == [0]
        assert fireflies.in_use(firefly).sum() == pytest.approx(1)
    row = fireflies.line("room", found, sum(f.error for f in found), 8)
    assert row[1] == "100 %" and row[3] == "8 of 8" and row[6:] == ["none", "1x", "8 of 8"]


def test_the_worst_samples_of_all_strategies_are_found_anew():
    """A glossy ceiling takes all strategies. Expected: estimates and weights follow from the vertices by
    Mitsuba's own calls and the densities of all strategies (1 %: directions between float32 vertices)."""
    scene = between_mirrors("roughconductor")
    found = worst(scene, 5, 40, 0.02, light_paths=0.25, connections="one", skip="impossible")
    assert len(found) == 40 and [f.doubt for f in found if f.doubt] == []
    assert len({(f.path.s, f.path.t) for f in found}) >= 3


def box(scale):
    """Mitsuba's Cornell box with all lengths times ``scale``."""
    room = mi.cornell_box()
    for part in room.values():
        if isinstance(part, dict) and "to_world" in part:
            part["to_world"] = T().scale(scale) @ part["to_world"]
    look = T().look_at([0, 0, 3.9 * scale], [0, 0, 0], [0, 1, 0])
    room["sensor"] |= {"to_world": look, "near_clip": 0.001 * scale, "far_clip": 100 * scale}
    room["sensor"]["film"] |= {"width": 12, "height": 12}
    return room


def fill_memory():
    """Leave signalling NaN in the memory that Dr.Jit hands out again."""
    kept = []
    for size in np.repeat(1 << np.arange(4, 11), 3000).tolist():
        kept.append(dr.full(mi.UInt32, 0x7FA00000, size) + dr.opaque(mi.UInt32, 0))
        dr.eval(kept[-1])
    dr.sync_thread()


@pytest.mark.parametrize("scale", [1, 1e-4])
def test_replays_add_up_to_what_was_rendered(scale):
    """Rationale: which connection was drawn followed from a distance in units of the scene; NumPy took a
    signalling NaN in masked lanes for an invalid cast. Tolerance: the same arithmetic in float32."""
    fill_memory()
    room = box(scale)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 5, "light_paths": 0.25})
    _, outliers = recording.render(mi.load_dict(room), integrator, np.full((12, 12, 3), 0.01), 16, 3)
    splats, samples = ([o for o in outliers if bool(o.s) is splat][:10] for splat in (True, False))
    assert len(splats) == len(samples) == 10
    outliers = splats + samples
    for outlier, paths in zip(outliers, recording.replay(outliers), strict=True):
        assert sum(path.value for path in paths) == pytest.approx(outlier.value, rel=1e-4)


def test_what_cannot_be_recorded_is_refused():
    film = SimpleNamespace(alpha=False, size=(1, 1))
    with pytest.raises(ValueError, match="lanes in a launch, more than 16777216: set a smaller spp_per_pass"):
        recording.Collector(film, np.ones((1, 1, 3)), (1 << 24) + 1)
    recording.Collector(film, np.ones((1, 1, 3)), 1 << 24)
    mi.set_variant("llvm_ad_spectral")
    band = {"type": "spectrum", "value": [(450, 0), (500, 1), (550, 0)]}
    sensor = {"type": "perspective", "film": {"type": "specfilm", "width": 4, "height": 4, "band": band}}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}})
    with pytest.raises(ValueError, match="of class SpecFilm is not RGB; use hdrfilm"):
        recording.render(scene, mi.load_dict({"type": "bdpt"}), np.ones((4, 4, 3)), 1, 0)


def test_wrong_paths_are_not_found():
    scene = between_mirrors()
    target = np.full((12, 12, 3), 0.1)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 4})
    _, outliers = recording.render(scene, integrator, 64 * target, 64, 1)
    ((path, *_),) = recording.replay(outliers[:1])
    kernel = outliers[0].launch.kernel
    kappa = fireflies.coefficients(kernel.plan, 4)
    assert fireflies._found_anew(scene, kernel, kappa, path)[1] == ""

    def doubt(**changes):
        return fireflies._found_anew(scene, kernel, kappa, replace(path, **changes))[1]

    moved = path.p + np.array([0, 0, 0.1]) * (np.arange(5) == 2)[:, None]
    assert "leads to the next vertex" in doubt(p=moved)
    along = path.p[4] + 0.1 * (path.p[4] - path.p[3])
    behind = doubt(p=np.array([*path.p[:4], along]))
    assert "vertex 4 is off by" in behind and "one without area cannot be hit" in behind
    assert "no delta lobe at vertex 2" in doubt(delta=[False, True, True, True, False])
    assert "weight is 0.5, that of the path 1" in doubt(weight=0.5)
    assert "estimate is 2 times" in doubt(estimate=2 * path.estimate)
    with pytest.raises(reconstruct.Lost, match="on no emitter"):
        reconstruct.rebuild(scene, kernel.emitters, replace(path, p=path.p[:4], delta=path.delta[:4]))


def under_water():
    """A small lamp above tilted water, a camera that looks at the floor below it: t = 1 brings nearly all,
    over one refraction (L S D E) and, by reflections in the water from below, over more."""
    lamp = T().translate([-0.7, 2.5, 0]).rotate([1, 0, 0], 90).scale(0.05)
    water = T().translate([0, 1, 0]).rotate([0, 0, 1], 15).rotate([1, 0, 0], -90).scale(4)
    glass = {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.0}
    return scenes.load(
        sensor=scenes.camera(origin=(0, 0.5, 1.5), target=(0, 0, 0), size=12),
        lamp={"type": "disk", "to_world": lamp, "bsdf": scenes.both_sides(0), "emitter": scenes.area(1000.0)},
        water={"type": "rectangle", "to_world": water, "bsdf": glass},
        floor=scenes.floor(size=4, bsdf=scenes.both_sides(0.8)),
    )


@pytest.mark.parametrize("rr_depth", [1, 100])
def test_refractions_on_the_light_side(rr_depth):
    """A light subpath counts a refraction in solid angle on the other side than a camera subpath."""
    scene = under_water()
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 6, "rr_depth": rr_depth})
    plain = np.array(integrator.render(scene, spp=64, seed=1))
    target = np.full_like(plain, plain.mean(), dtype=float)
    _, found = fireflies.fireflies(scene, integrator, target, 64, 1, 0.002, 40)
    assert len(found) == 40
    assert [f.doubt for f in found if f.doubt] == []
    assert any(f.path.s >= 3 and "S" in f.letters for f in found)


# -- media ---------------------------------------------------------------------------------------------


def test_paths_in_media_are_named():
    """Expected: a vertex in a medium is V; no path of a scene with media is rebuilt, and the row says so."""
    ball = media_parts.ball(interior=media_parts.fog(4, 0.9))
    for light, expected in ((media_parts.point(), "lies in a medium, where"), (None, "has media, through")):
        room = media_parts.room(light=light, ball=ball)
        room["wall"] = media_parts.wall() | {"bsdf": media_parts.matte(0.2, 0.2, 0.2)}
        found = worst(mi.load_dict(room), 4, 40, 0.02)
        assert len(found) == 40
        for firefly in found:
            inner = [letter for letter in firefly.letters.split() if letter != "¦"][1:-1]
            assert firefly.names == ", ".join("medium" for _ in inner) and set(inner) == (
                {"V"} if light else set()
            )
            assert firefly.rebuilt is None and expected in firefly.doubt
        row = fireflies.line("ball", found, sum(f.error for f in found), 40)
        assert row[6:8] == ["not known", "not known"] and expected in row[8]


@pytest.mark.parametrize("boundary", ["null", "mask"])
def test_replays_in_media(boundary):
    """Expected: without roulette subpaths live with probability 1, with it some with less and none with more.
    Tolerance: rounding."""
    bsdf = {"type": "mask", "opacity": 0.4, "bsdf": media_parts.matte(0.35, 0.35, 0.35)}
    ball = media_parts.ball("null" if boundary == "null" else bsdf, interior=media_parts.coloured(6.0))
    scene = mi.load_dict(media_parts.room(light=media_parts.point(), ball=ball))
    for rr_depth in (100, 1):
        integrator = mi.load_dict({"type": "bdpt", "max_depth": 5, "rr_depth": rr_depth, "skip": "none"})
        _, outliers = recording.render(scene, integrator, np.full((16, 16, 3), 0.2), 16, 3)
        splats, samples = ([o for o in outliers if bool(o.s) is splat][:10] for splat in (True, False))
        survival = []
        for outlier, paths in zip(splats + samples, recording.replay(splats + samples), strict=True):
            assert sum(path.value for path in paths) == pytest.approx(outlier.value, rel=1e-4)
            assert all(len(path.p) == path.s + path.t for path in paths)
            survival += [path.survival for path in paths]
        assert max(survival) < 1 + 1e-4
        assert min(survival) > 1 - 1e-4 if rr_depth == 100 else min(survival) < 0.9


def test_what_is_passed_is_no_vertex():
    """Of visits with one number the last is the vertex."""
    numbers = [1, 1, 2, 2, 3]
    places = [np.full((3, 1), i) for i in range(5)]
    visits = [SimpleNamespace(number=np.array([n]), p=p) for n, p in zip(numbers, places, strict=True)]
    subpath = recording._Subpath(np.zeros((3, 1)), np.zeros(1, dtype=bool), visits)
    assert subpath.chain(4, 0) == [1, 3, 4] and subpath.chain(3, 0) == [1, 3]
    assert subpath.chain(2, 0, before=1) == [0] and subpath.chain(1, 0) == subpath.chain(0, 0) == []
    assert subpath.ends_at(3, 0).tolist() == [3] * 3 and np.isinf(subpath.ends_at(5, 0)).all()
