"""Media: two scenes that are the same to light, and bugs that other renderers had with media.

Where both scenes draw the same random numbers along the same paths, images of one seed are compared: they
differ by rounding, and by the few paths that rounding sends elsewhere. Where they do not, the statistic is
Welch's t-test of tile means with Sidak's correction (`welch`). Seeds are fixed.
"""

import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import welch as st

CHANNELS = np.array([0.5, 1.0, 1.5])
SEEDS = 16


def image(scene, spp=64, seed=3, **parameters):
    method = parts.integrator(max_depth=4, **parameters)
    return np.array(mi.render(mi.load_dict(scene), integrator=method, spp=spp, seed=seed), dtype=np.float64)


def assert_same(a, b, share=0.98, factor=1.0):
    """Images of one seed are the same: ``share`` of the pixels to 1e-3, the mean to 2e-3; ``a`` times
    ``factor``.

    With all strategies, and with what a pilot decides for ``b``: surfaces that are nothing to light cost
    rays, and two choices that hardly differ may change places.
    """
    method = parts.integrator(max_depth=4)
    mi.render(mi.load_dict(b), integrator=method, spp=64, seed=3)
    decided = method.statistics["decisions"]
    brighter = [d | {"mean": d["mean"] / factor} for d in decided]
    for mine, parameters in (
        ({"skip": "none"}, {"skip": "none"}),
        ({"decisions": brighter}, {"decisions": decided}),
    ):
        x, y = image(a, **mine) * factor, image(b, **parameters)
        near = np.abs(x - y) <= 1e-3 * np.abs(y) + 1e-4 * y.mean()
        assert near.mean() >= share, (parameters, near.mean(), x.mean() / y.mean() - 1)
        assert x.mean() == pytest.approx(y.mean(), rel=2e-3), parameters


def assert_agree(a, b, spp=128, **parameters):
    """Renders of two scenes or methods agree, tile by tile; each is a scene, or a scene and an integrator."""

    def tiles(of, seed):
        scene, method = of if isinstance(of, tuple) else (of, parts.integrator(max_depth=4, **parameters))
        return parts.tile_means(mi.load_dict(scene), method, spp, seed, SEEDS) @ CHANNELS

    st.assert_agree(st.compare_images(tiles(a, 100), tiles(b, 900)), at_least=8)


def lit(**more):
    """A room lit by a point: `volpath` is right there."""
    return parts.room(light=parts.point(), **more)


def misty(**more):
    return parts.ball(interior=parts.fog(4, 0.9, **more))


# -- two scenes that are the same ----------------------------------------------------------------------


def test_a_constant_grid_is_homogeneous():
    """Rationale: delta and ratio tracking against closed forms, through one boundary. Expected: images agree.
    Statistic: see `assert_agree`.
    """
    grid = parts.grid(np.full((3, 3, 3), 0.5), parts.LOW - 0.1, parts.EDGE + 0.2, 8.0, 0.9)
    uniform = parts.box(interior=parts.fog(4, 0.9))
    for skip in ("none", "auto"):
        assert_agree(
            lit(box=parts.box(interior=grid | {"phase": {"type": "hg", "g": 0.3}})),
            lit(box=uniform),
            skip=skip,
        )


def test_a_null_wall_within_fog_is_nothing():
    """Rationale: a boundary between a medium and itself cuts edges into segments, which are no vertices. A
    null disk in a ball of fog, its fog on both sides; and a sheet across a foggy room. Expected: the same
    images, see `assert_same`.
    """
    medium = parts.fog(4, 0.9, id="m")
    sides = {"interior": {"type": "ref", "id": "m"}, "exterior": {"type": "ref", "id": "m"}}

    def cut(scale, at):
        to_world = parts.transform().translate(at).rotate([1, 0.3, 0], 40).scale(scale)
        return {"type": "disk", "to_world": to_world, "bsdf": {"type": "null"}, **sides}

    ball = parts.ball(interior={"type": "ref", "id": "m"})
    whole = {"m": medium, **lit(ball=ball)}
    assert_same({**whole, "cut": cut(0.25, [-0.35, -0.25, -0.25])}, whole)
    thin = parts.fog(0.5, 0.8, id="m")
    room = parts.foggy({"type": "ref", "id": "m"})
    # A far null surface, so that both scenes look for surfaces to pass.
    assert_same({"m": thin, **room, "cut": cut(0.9, [0, 0, -0.3])}, {"m": thin, **room}, share=0.95)


def test_a_null_shell_without_medium_is_nothing():
    """Rationale: null surfaces are no events, nested boundaries no bounces. Expected: a ball of fog within
    null shells that bound no medium has the image of the ball alone, see `assert_same`.
    """
    shells = {f"shell{i}": parts.ball(radius=0.3 + 0.02 * i) for i in (1, 2, 3)}
    assert_same(lit(ball=misty(), **shells), lit(ball=misty()))


def test_flags_and_order_of_media_do_not_matter():
    """Rationale: media are numbered by where they are found, and kernels branch on what they are like.
    Expected: the same images with ``has_spectral_extinction`` on and off (gray), and with media in another
    order, see `assert_same`.
    """
    first = parts.ball(interior=parts.fog(4, 0.9))
    second = parts.ball(radius=0.2, center=(0.3, -0.3, -0.2), interior=parts.fog(8, 0.5, 0.0))
    assert_same(lit(a=first, b=second), lit(b=second, a=first))
    for value in (True, False):
        flagged = parts.ball(interior=parts.fog(4, 0.9, has_spectral_extinction=value))
        assert_same(lit(ball=flagged), lit(ball=misty()))


def test_a_larger_scene_of_thinner_fog_looks_the_same():
    """Rationale: lengths enter by sigma times length alone. Expected: everything ten times as large with a
    tenth of the extinction has the same image (the point lamp a hundred times the intensity), see
    `assert_same`.
    """

    def scaled(f):
        scene = parts.room(
            parts.sensor(
                origin=(0.1 * f, -0.05 * f, 0.5 * f), target=(0, 0, -f), near=0.1 * f, far_clip=50 * f
            ),
            parts.point(position=[0.2 * f, 0.3 * f, -0.1 * f], intensity=float(f * f)),
        )
        scene["wall"] = parts.wall(radius=f)
        scene["ball"] = parts.ball(
            radius=0.3 * f, center=(-0.35 * f, -0.25 * f, -0.25 * f), interior=parts.fog(4 / f, 0.9)
        )
        return scene

    assert_same(scaled(10), scaled(1), share=0.95)


def test_an_instance_is_a_copy():
    """Rationale: instances have no media, their groups' shapes do. Expected: a ball of fog that is an
    instance, moved and twice as large as in its group, has the image of such a ball, see `assert_same`.
    """
    group = {
        "type": "shapegroup",
        "ball": parts.ball(radius=0.15, center=(0, 0, 0), interior=parts.fog(4, 0.9)),
    }
    to_world = parts.transform().translate([-0.35, -0.25, -0.25]).scale(2)
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world}
    assert_same({"group": group, **lit(ball=instance)}, lit(ball=misty()), share=0.95)


# -- bugs of others ------------------------------------------------------------------------------------


def spot(cutoff=40.0):
    to_world = parts.transform().look_at([0.6, 0.3, -0.4], [-0.6, -0.2, -0.5], [0, 1, 0])
    return {
        "type": "spot",
        "intensity": 4.0,
        "cutoff_angle": cutoff,
        "beam_width": cutoff * 0.9,
        "to_world": to_world,
    }


@pytest.mark.parametrize("cutoff", [40.0, 5.0], ids=["spot", "beam"])
def test_spots_in_fog(cutoff):
    """pbrt-v3 #179: bidirectional images of a spot in fog were 12 % darker; LuxCoreRender #216, #683: beams
    faded towards the middle. Expected: images agree with ``volpath``. Statistic: see `assert_agree`.
    """
    scene = parts.foggy(parts.fog(0.8, 0.8), light=spot(cutoff))
    reference = scene, parts.integrator("volpath", max_depth=4)
    assert_agree(scene, reference, skip="none")
    assert_agree(scene, reference)


def test_boundaries_are_no_bounces():
    """pbrt-v3 #69: interfaces counted as bounces. A lamp behind ten null boundaries, those of five balls
    of fog that absorbs. Expected: at ``max_depth`` 1 it is seen, e^-tau of its radiance, tau by the
    chords of the balls; 1 % (of the rays of a pixel in the middle, flights that collide are lost: 2^16
    samples).
    """
    black = parts.matte(0, 0, 0)
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=0.1, size=4),
        "lamp": {"type": "rectangle", "to_world": parts.transform().translate([0, 0, -2]), "bsdf": black}
        | {"emitter": {"type": "area", "radiance": 1.0}},
    }
    for i in range(5):
        scene[f"ball{i}"] = parts.ball(radius=0.1, center=(0, 0, 0.3 * i), interior=parts.fog(0.6, 0.0))
    for way in ({"light_paths": 0}, {"skip": "none"}, {}):
        method = parts.integrator(max_depth=1, **way)
        found = np.array(mi.render(mi.load_dict(scene), integrator=method, spp=4096, seed=1)).mean()
        assert found == pytest.approx(np.exp(-5 * 0.2 * 0.6), rel=0.01), way


def test_joins_start_on_the_right_side_of_a_boundary():
    """mitsuba3 #538, #552: joins that start on a boundary had the wrong medium. A matte cube of thick fog in
    thin fog, which the sensor declares, one face of it lit by a point and seen. Expected: .5 / pi I cos
    e^(-sigma (r + d)) / r^2 over the film, r and d the ways of a point of the face to lamp and camera, by
    camera subpaths alone, by t = 1 alone (unweighted), by all strategies and by default; within 5 standard
    errors, of 0.5 % at most.
    """
    sides = {"exterior": {"type": "ref", "id": "thin"}, "interior": parts.fog(40.0, 0.0)}
    eye = parts.sensor(origin=(0.8, 0, 2.6), target=(0, 0, 1), fov=25, size=8, near=1e-3)
    scene = mi.load_dict(
        {
            "thin": parts.fog(0.2, 0.0, id="thin"),
            "type": "scene",
            "sensor": eye | {"medium": {"type": "ref", "id": "thin"}},
            "cube": {"type": "cube", "bsdf": parts.matte(0.5, 0.5, 0.5), **sides},
            "lamp": {"type": "point", "position": [0, 0, 2], "intensity": 1.0},
        }
    )
    expected = _lit_face(scene.sensors()[0], 0.2)
    for way in ({"light_paths": 0}, {"skip": "none", "layers": "strategies"}, {}):
        method = parts.integrator(max_depth=2, **way)
        images = parts.images(scene, method, 1024, 1, 12).mean((1, 2))
        found = {"image": images[:, :3].mean(1)}
        if "layers" in way:
            assert method.statistics["rays"]["light"]
            first = images.shape[1] - len(method.aov_names()) + method.aov_names().index("unweighted.s2t1.R")
            found["t=1"] = images[:, first : first + 3].mean(1)
        for name, values in found.items():
            error = values.std(ddof=1) / np.sqrt(len(values))
            assert error < 0.005 * expected, (way, name)
            assert values.mean() == pytest.approx(expected, abs=5 * error), (way, name)


def _lit_face(sensor, sigma):
    """Mean radiance over a film that sees the plane z = 1 below a point at z = 2."""
    u = mi.Point2f(*((np.indices((128, 128)).reshape(2, -1) + 0.5) / 128))
    rays, _ = sensor.sample_ray(0.0, 0.5, u, mi.Point2f(0.5))
    o, d = np.array(rays.o, dtype=np.float64), np.array(rays.d, dtype=np.float64)
    t = (1 - o[2]) / d[2]  # from the near plane, where the fog before the sensor begins
    p = (o + d * t).T
    r = np.linalg.norm(p - [0, 0, 2], axis=1)
    assert np.abs(p[:, :2]).max() < 1
    return np.mean(0.5 / np.pi * np.exp(-sigma * (r + t)) / r**3)


def test_flights_by_all_channels():
    """mitsuba2 #323: free flights had the density of one channel. Expected: in a chromatic ball seen against
    the sky, camera subpaths alone have less than a fifth of ``volpath``'s variance in the channel of least
    extinction (here a tenth), and the same mean as ``volpathmis`` (Welch).
    """
    medium = parts.coloured(8.0) | {"sigma_t": parts.rgb(1.0, 0.5, 0.03), "albedo": 0.9}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=15, size=8),
            "ball": parts.ball(radius=0.5, center=(0, 0, 0), interior=medium),
            "sky": {"type": "constant", "radiance": 1.0},
        }
    )

    def renders(kind, seed, **more):
        return parts.images(scene, parts.integrator(kind, max_depth=8, **more), 64, seed, SEEDS)

    ours, theirs, mis = renders("bdpt", 1, light_paths=0), renders("volpath", 50), renders("volpathmis", 90)
    assert ours[..., 2].var(0).mean() < theirs[..., 2].var(0).mean() / 5
    st.assert_agree(st.welch(ours.mean((1, 2)), mis.mean((1, 2))), at_least=3)


def test_null_collisions_by_channel():
    """mitsuba3 #1387, #1628: the probability of null collisions per channel. A grid with another extinction
    in each channel. Expected: images agree with ``volpathmis``. Statistic: see `assert_agree`.
    """
    values = np.random.default_rng(0).random((6, 6, 6, 3)).astype(np.float32)
    values *= np.float32([1.0, 0.5, 0.1])
    medium = parts.grid(np.zeros((2, 2, 2)), parts.LOW, parts.EDGE)
    medium["sigma_t"] |= {"raw": True, "grid": mi.VolumeGrid(values)}
    scene = lit(ball=parts.box(interior=medium))
    reference = scene, parts.integrator("volpathmis", max_depth=4)
    assert_agree(scene, reference, skip="none")


def test_nothing_is_lost_outside_of_a_dense_grid():
    """mitsuba3 #336: black spots beside a dense grid. Expected: an even sky of radiance 1 is 1 in each pixel
    that does not see the box, also where the grid ends before its box does: to 1e-5 by camera subpaths, which
    have no noise there; with all strategies (whose (1,1) has) each pixel's mean over seeds by Student's test,
    Sidak over them, with standard errors below 1 %. Black where the grid is.
    """
    medium = parts.grid(np.ones((4, 4, 4)), [-0.2, -0.2, -0.2], 0.4, 500.0, 0.0)
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(0, 0, 3), target=(0, 0, 0), fov=25, size=16),
        "box": parts.box([-0.4] * 3, 0.8, interior=medium),
        "sky": {"type": "constant", "radiance": 1.0},
    }
    for way in ({"light_paths": 0}, {"skip": "none"}):
        method = parts.integrator(max_depth=4, **way)
        found = parts.images(mi.load_dict(scene), method, 64, 3, SEEDS).mean(-1)
        x = np.abs((np.arange(16) - 7.5) / 8 * np.tan(np.deg2rad(12.5)))
        beside = np.maximum(x[:, None], x) > 0.25 / 2.8 + np.tan(np.deg2rad(12.5)) / 16
        inside = np.maximum(x[:, None], x) < 0.15 / 3.2
        around = found[:, beside]
        if "light_paths" in way:
            assert np.abs(around - 1).max() < 1e-5
        else:
            assert method.statistics["rays"]["light"]
            assert around.std(0, ddof=1).max() / np.sqrt(SEEDS) < 0.01
            st.assert_agree(st.one_sample(around, 1.0))
        assert found[:, inside].max() < 1e-3 and inside.any() and beside.mean() > 0.3


# -- contradictory scenes ------------------------------------------------------------------------------


def inside_without_saying():
    """The sensor is in a ball of fog, and declares no medium."""
    return lit(ball=parts.ball(radius=0.9, center=(0, 0, 0), interior=parts.fog(1, 0.8)))


def hole_in_fog():
    """A ball with a medium of its own whose shape says that outside of it is none, in a foggy room."""
    scene = parts.foggy(parts.fog(0.5, 0.8), light=parts.point())
    return scene | {"ball": parts.ball(interior=parts.fog(4, 0.9))}


@pytest.mark.parametrize(
    "scene, why",
    [(inside_without_saying, "declares no medium"), (hole_in_fog, "that it is in no medium")],
)
def test_contradictory_scenes_get_camera_subpaths(scene, why):
    """LuxCoreRender #485 and the like: what media a subpath is in depends on where it comes from, and light
    and camera subpaths would see two scenes. Expected: `explain` says why, no light subpath is traced, also
    with ``skip=none``, and the image is ``volpath``'s. Statistic: see `assert_agree`.
    """
    loaded = mi.load_dict(scene())
    for skip in ("none", "auto"):
        method = parts.integrator(max_depth=4, skip=skip)
        (line,) = (x for x in method.explain(loaded).splitlines() if "t=1, (1,1), inner" in x)
        assert line.startswith("skipped (impossible)") and why in line
        method.render(loaded, spp=16)
        assert not method.statistics["rays"].get("light")
    assert_agree(scene(), (scene(), parts.integrator("volpath", max_depth=4)))
