"""Whole scenes against Mitsuba's ``path``, and against ourselves where ``path`` does not converge.

Samples are means of tiles in one render; renders have different seeds on both sides; Welch's test
with Sidak's correction at 1e-3 over all tiles (and Kolmogorov-Smirnov for the p-values), see
``welch``. One channel decides: the channels of a tile share their paths.
"""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from welch import Comparisons, assert_agree, compare_images, tile_means

ROOT = Path(__file__).resolve().parents[2]
TILES = 4


def load(name, resolution=16, **parameters):
    if name == "veach_mis":
        parameters["resolution_y"] = resolution
    return mi.load_file(
        str(ROOT / "scenes" / f"{name}.xml"), integrator="path", resolution=resolution, **parameters
    )


def renders(scene, integrator, count, spp, first_seed, tiles=TILES):
    """Tile means (green) of ``count`` renders, shape (count, tiles^2)."""
    return np.stack(
        [
            tile_means(mi.render(scene, integrator=integrator, spp=spp, seed=first_seed + i), tiles)[:, 1]
            for i in range(count)
        ]
    )


def bdpt(max_depth, **parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": max_depth, **parameters})


def path(max_depth, **parameters):
    return mi.load_dict({"type": "path", "max_depth": max_depth, **parameters})


# Scenes that `path` renders without rare bright samples, and the depth to compare them at.
CONVERGING = {
    "cornell_box": 6,
    "uplight_room": 4,
    "veach_mis": 3,
    "open_sky": 5,
    "many_lights": 4,
}


@pytest.mark.parametrize("name", CONVERGING)
def test_scene_equals_path(name):
    """Every scene on which ``path`` converges: all strategies, and the default, give its image.

    Expected: equal in expectation, at 16x16 pixels, tiles of 4x4 pixels, 32 renders a side of 32
    samples, ``path`` at 128. Sensitivity: some 1-3 % per tile, 0.3-1 % of the image's mean.
    """
    depth = CONVERGING[name]
    scene = load(name)
    reference = renders(scene, path(depth), 32, 128, 0)
    family = [
        compare_images(reference, renders(scene, bdpt(depth, skip=skip), 32, 32, seed), f"{name} {skip}")
        for skip, seed in (("none", 1000), ("auto", 2000))
    ]
    assert_agree(Comparisons.join(family), at_least=2 * 8)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONVERGING)
def test_scene_equals_path_finely(name):
    """As `test_scene_equals_path`, with 32x32 pixels, 64 tiles, 64 renders of 256 samples."""
    depth = CONVERGING[name]
    scene = load(name, 32)
    reference = renders(scene, path(depth), 64, 1024, 0, 8)
    for skip, seed in (("none", 1000), ("auto", 2000)):
        ours = renders(scene, bdpt(depth, skip=skip), 64, 256, seed, 8)
        assert_agree(compare_images(reference, ours, f"{name} {skip}"), at_least=32)


# Scenes where `path` misses most of the light (caustics of small and of delta lamps, a spot that
# shines through an egg): its samples are too rare and too bright for a test of means. Ours are
# compared with each other. n1c0 (light tracing, no inner connections) has the same rare paths in
# s = 0 only; n0c0 loses what neither s = 0 nor s = 1 can make, so it takes part nowhere here.
OWN = {
    "glass_caustics": 6,
    "lamp_behind_glass": 6,
    "veach_bidir": 5,
}


@pytest.mark.parametrize("name", OWN)
def test_choices_do_not_change_the_image(name):
    """Light subpaths per camera subpath, and inner connections all, one or none, change noise only.

    Rationale: ``path`` is no reference here. n1c1 with everything against: one light subpath for
    four, one drawn connection, and both with connections' roulette; and against n1c0, which is
    unbiased where every path has s = 0, s = 1 or t = 1. Light of a delta lamp behind glass, seen in
    turn through glass, needs connections: lamp_behind_glass compares n1c0 at max_depth 3 only,
    where t = 1 makes all. Expected: equal in expectation. 24 renders a side of 16x16 pixels; tiles
    in which a few samples decide are left to the image's mean, see ``welch.welch``.
    """
    depth = OWN[name]
    scene = load(name)
    everything = renders(scene, bdpt(depth, skip="none"), 24, 32, 0)
    family = []
    choices = [{}, {"skip": "none", "connections": "one"}, {"skip": "none", "light_paths": 0.25}]
    if name == "veach_bidir":
        choices = choices[:1]  # dear, and the default has both
    for seed, parameters in enumerate(choices, 1):
        ours = renders(scene, bdpt(depth, **parameters), 24, 32, 1000 * seed)
        family.append(compare_images(everything, ours, f"{name} {parameters}"))
    if name != "lamp_behind_glass":
        no_connections = renders(scene, bdpt(depth, skip="none", connections="none"), 24, 64, 4000)
        family.append(compare_images(everything, no_connections, f"{name} n1c0"))
    assert_agree(Comparisons.join(family), at_least=30)


def test_light_of_delta_lamps_through_glass():
    """A delta lamp in a glass shell: light tracing alone agrees with all strategies where both can.

    Rationale: mitsuba2 #262, #491, mitsuba3 #1462, a lamp behind glass lights nothing; `path` is
    black here, so the classes check each other. At max_depth 4 and with light tracing only (no inner
    connections) t = 1 makes every path that s = 0, 1 cannot, except those through glass on both sides of
    one vertex.
    Expected: n1c0 is not above n1c1, and more than 99 % of the light is there; `path` has under
    50 % of it. Statistic: means of images over 16 renders, 4.5 standard errors.
    """
    scene = load("lamp_behind_glass")
    means = {}
    for seed, (label, integrator, spp) in enumerate(
        (
            ("n1c1", bdpt(4, skip="none"), 128),
            ("n1c0", bdpt(4, skip="none", connections="none"), 128),
            ("path", path(4), 128),
        )
    ):
        images = renders(scene, integrator, 16, spp, 1000 * seed).mean(1)
        means[label] = images.mean(), images.std(ddof=1) / 4
    (full, e_full), (light, e_light) = means["n1c1"], means["n1c0"]
    error = np.hypot(e_full, e_light)
    assert light < full + 4.5 * error, means
    assert light > 0.99 * full - 4.5 * error, means
    assert means["path"][0] < 0.5 * full, means


def bumpy_scene(nested, lamp, spp=64):
    """A bumpy matte floor and a normal-mapped wall beside it, lit from low above the floor."""
    x = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    waves = (0.5 + 0.5 * np.sin(3 * x)[:, None] * np.cos(2 * x)[None, :]).astype(np.float32)
    slope = 0.4 * np.stack([np.sin(x)[None] + 0 * x[:, None], np.cos(x)[:, None] + 0 * x[None]], -1)
    normal = np.concatenate([slope, np.ones((32, 32, 1))], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)

    def bitmap(values):
        return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(values.astype(np.float32))}

    t = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 45.0,
                "to_world": t().look_at(origin=[-2.5, -2.5, 1.6], target=[0.2, 0.2, 0.3], up=[0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": 16,
                    "height": 16,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                    "component_format": "float32",
                },
                "sampler": {"type": "independent", "sample_count": spp},
            },
            "floor": {
                "type": "rectangle",
                "to_world": t().scale(1.5),
                "bsdf": {
                    "type": "bumpmap",
                    "scale": 0.15,
                    "t": bitmap(waves[..., None]),
                    "nested": nested,
                },
            },
            "wall": {
                "type": "rectangle",
                "to_world": t().translate([1.2, 0, 0.8]) @ t().rotate([0, 1, 0], -90),
                "bsdf": {
                    "type": "normalmap",
                    "normalmap": bitmap(0.5 + 0.5 * normal),
                    "nested": nested,
                },
            },
            "lamp": lamp,
        }
    )


GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}
GLOSSY = {"type": "roughconductor", "alpha": 0.3}
POINT = {"type": "point", "position": [-0.6, 0.5, 0.6], "intensity": {"type": "rgb", "value": 3.0}}


def sphere_lamp():
    return {
        "type": "sphere",
        "center": [-0.6, 0.5, 0.6],
        "radius": 0.15,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 40.0}},
    }


@pytest.mark.parametrize(
    "nested, lamp", [(GREY, "area"), (GLOSSY, "point")], ids=["matte-area", "glossy-point"]
)
def test_bumped_surfaces_equal_path(nested, lamp):
    """Light subpaths on bump- and normal-mapped surfaces agree with ``path``, the reference.

    Rationale: mitsuba3 #42, #45, a light tracer brighter than the path tracer on bumped surfaces.
    `path` (camera subpaths, the BSDF as it is evaluated from the camera) is the reference; t = 1
    alone and all strategies together must equal it. Expected: for paths of up to 3 edges, the image
    with all strategies equals `path`, and for the point lamp the unweighted t = 1 image of k = 2
    equals `path`'s k = 2. 24 renders a side, Welch with Sidak over tiles.
    """
    scene = bumpy_scene(nested, POINT if lamp == "point" else sphere_lamp())
    reference = renders(scene, path(3), 24, 64, 0)
    family = [
        compare_images(reference, renders(scene, bdpt(3, skip="none"), 24, 32, 1000), "all"),
        compare_images(reference, renders(scene, bdpt(3), 24, 32, 2000), "default"),
    ]
    if lamp == "point":
        # k = 2 alone: nothing is seen directly.
        direct = renders(scene, path(2), 24, 64, 4000)
        images = bdpt(2, skip="none", layers="strategies")
        start = 3 + 2 * 6 + 2 * 6 + 3 + 1  # RGB, k = 1, (0,3) and (1,2), weighted (2,1), green
        splats = np.stack(
            [
                tile_means(mi.render(scene, integrator=images, spp=32, seed=5000 + i), TILES)[:, start]
                for i in range(24)
            ]
        )
        family.append(compare_images(direct, splats, "light tracing"))
    assert_agree(Comparisons.join(family), at_least=16)


def test_shapes_that_cannot_emit(tmp_path):
    """Curves and SDF grids beside an area lamp: they render as in ``path``.

    Rationale: Mitsuba's virtual calls visit every live instance; one on shapes' sample_position
    fails as soon as a curve exists. Expected: equal in expectation, as above.
    """
    points = "\n".join(f"{x:.3f} {-0.2 + 0.2 * x:.3f} 0.6 0.12" for x in np.linspace(-0.7, 0.7, 6))
    (tmp_path / "curve.txt").write_text(points + "\n")
    z, y, x = np.meshgrid(*[np.linspace(0, 1, 12)] * 3, indexing="ij")
    ball = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.3
    scene = {k: v for k, v in mi.cornell_box().items() if k not in ("small-box", "large-box")}
    scene["sensor"]["film"].update(width=16, height=16, rfilter={"type": "box"})
    scene["curve"] = {"type": "bsplinecurve", "filename": str(tmp_path / "curve.txt"), "bsdf": GLOSSY}
    scene["grid"] = {
        "type": "sdfgrid",
        "grid": mi.TensorXf(ball[..., None].astype(np.float32)),
        "bsdf": GREY,
        "to_world": mi.ScalarTransform4f().translate([-0.6, -1, -0.5]) @ mi.ScalarTransform4f().scale(0.9),
    }
    scene = mi.load_dict(scene)
    reference = renders(scene, path(4), 16, 32, 0)
    ours = renders(scene, bdpt(4), 16, 16, 1000)
    assert_agree(compare_images(reference, ours, "curve and grid"), at_least=8)
