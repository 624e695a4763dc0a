"""Blends of BSDFs: Mitsuba's ``blendbsdf`` draws by other densities than it states, and dims delta events."""

import mitsuba_bdpt  # noqa: F401  (chooses the LLVM; must come before mitsuba)

import mitsuba as mi  # isort: skip
import numpy as np
import pytest
import variants
from views import camera
from welch import assert_agree, compare_known, tiles, welch

SEEDS = 8
MATTE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
FROSTED = {"type": "roughdielectric", "alpha": 0.3}


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(variants.of("rgb"))


def blend(a, b, weight=0.5):
    return {"type": "blendbsdf", "weight": weight, "a": a, "b": b}


def above_a_floor(origin, size, floor, **more):
    """A camera at ``origin`` that looks at the middle of a floor, a square of twice this ``size``."""
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera(origin=origin, target=(0, 0, 0), fov=30, size=16),
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(size),
                "bsdf": floor,
            },
            **more,
        }
    )


def images(scene, spp, **parameters):
    """Images of all strategies, one per seed, and the layers' names."""
    bdpt = mi.load_dict({"type": "bdpt", "skip": "none", "rr_depth": 100, **parameters})
    found = [np.array(mi.render(scene, integrator=bdpt, spp=spp, seed=seed)) for seed in range(SEEDS)]
    return np.stack(found), bdpt.aov_names()


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_mirror_in_a_blend(wrapped):
    """A floor of 0.4 mirror (reflecting all) and 0.6 matte, of 0.5, under a sky of 1 shows 0.4 + 0.3.

    Rationale: Mitsuba's ``blendbsdf`` divides what its mirror reflects by the sum of its probability and of
    the matte part's density in that direction, so that `path` shows 0.64 to 0.66. Expected: 0.7 in every
    pixel; Student's t-test of tiles, as everywhere here.
    """
    floor = blend(MATTE, {"type": "conductor", "material": "none"}, 0.4)
    floor = {"type": "twosided", "nested": floor} if wrapped else floor
    scene = above_a_floor((0, 3, 3), 100, floor, sky={"type": "constant"})
    for parameters in ({}, {"skip": "auto"}):
        found, _ = images(scene, 64, max_depth=3, **parameters)
        assert_agree(compare_known(tiles(found[..., :3]), 0.7))


def test_every_strategy_through_a_blend_from_behind():
    """A point light in a ball of frosted glass and matte parts, above a floor: all strategies find the same.

    Rationale: what the matte part draws from behind, and the glass below its horizon, Mitsuba's blend keeps
    as directions of the other part; light subpaths found twice the light. `path`, which meets the ball from
    outside here, is right. Expected: unweighted strategies of paths light - ball - floor - camera agree with
    the one of next-event estimation, and the image with `path`. Statistic: Welch's t-test of means over the
    image, 8 seeds.
    """
    ball = {"type": "sphere", "center": [0, 1, 0], "radius": 0.5, "bsdf": blend(FROSTED, MATTE)}
    light = {"type": "point", "position": [0, 1, 0], "intensity": 5.0}
    scene = above_a_floor((0, 1.2, 4), 2, MATTE, ball=ball, light=light)
    found, names = images(scene, 256, max_depth=3, layers="strategies")
    layers = found[..., found.shape[-1] - len(names) :].mean((1, 2))

    def unweighted(strategy):
        index = [i for i, name in enumerate(names) if name.startswith(f"unweighted.{strategy}.")]
        return layers[:, index]

    for strategy in ("s2t2", "s3t1"):
        assert_agree(welch(unweighted(strategy), unweighted("s1t3")))
    path = mi.load_dict({"type": "path", "max_depth": 3, "rr_depth": 100})
    theirs = [np.array(mi.render(scene, integrator=path, spp=1024, seed=seed)) for seed in range(SEEDS)]
    assert_agree(welch(found[..., :3].mean((1, 2)), np.stack(theirs).mean((1, 2))))
