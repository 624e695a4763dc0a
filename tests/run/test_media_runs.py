"""Renders of a scene with media that stop, go on, are replayed, edited, and report errors and features."""

import internals
import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.planning import budget
from snapshots import ROUNDING, stopped

# From here on there is a pilot.
SPP = max(budget.LEAST_SAMPLES // parts.SIZE**2, 64)


def misty():
    """A foggy room with a cloud and a ball of coloured fog: each kind of medium."""
    box = parts.box(
        interior=parts.grid(np.random.default_rng(0).random((4, 4, 4)), parts.LOW, parts.EDGE),
        exterior={"type": "ref", "id": "around"},
    )
    ball = parts.ball(
        radius=0.2,
        center=(0.4, -0.4, -0.2),
        interior=parts.coloured(4.0),
        exterior={"type": "ref", "id": "around"},
    )
    around = {"type": "ref", "id": "around"}
    return mi.load_dict({"around": parts.fog(id="around"), **parts.foggy(around, box=box, ball=ball)})


def bdpt(**parameters):
    return internals.bdpt(**{"max_depth": 4, "spp_per_pass": 16} | parameters)


@pytest.mark.parametrize(
    "parameters", [{"skip": "none"}, {"layers": "variance", "aovs": "dd:depth"}], ids=str
)
def test_a_resumed_render_is_the_uninterrupted_one(parameters):
    """What a lane carries in media belongs to no snapshot, and must start anew the same. Expected: image,
    layers and counts, those of media included, of a render that was stopped and went on in a new integrator
    are those of the render that never stopped, up to the order of sums."""
    target, whole = misty(), bdpt(**parameters)
    expected = np.array(whole.render(target, seed=3, spp=SPP))
    start = stopped(bdpt(**parameters), misty(), 2, seed=3, spp=SPP)
    assert 0 < start.spp < SPP
    again = bdpt(**parameters)
    image = np.array(again.render(target, seed=3, spp=SPP, start=start))
    np.testing.assert_allclose(image, expected, **ROUNDING)
    for name in ("rays", "connections", "passes", "decisions", "media"):
        assert again.statistics[name] == whole.statistics[name], name
    assert whole.statistics["rays"]["light"] or not parameters.get("skip")
    assert bool(whole.statistics["decisions"]) == ("skip" not in parameters)


def test_features_are_those_of_aov():
    """Expected: depth, position and albedo behind fog and null boundaries are what Mitsuba's ``aov`` gives
    with as many samples, to 2 % of their range in six pixels of seven (its samples are others, which tells at
    edges), and the image beside them is that without."""
    aovs = "dd:depth,pp:position,aa:albedo,nn:sh_normal"
    target = misty()
    ours = np.array(bdpt(aovs=aovs).render(target, seed=1, spp=64))
    plain = np.array(bdpt().render(target, seed=1, spp=64))
    np.testing.assert_allclose(ours[..., :3], plain, **ROUNDING)
    theirs = np.array(mi.load_dict({"type": "aov", "aovs": aovs}).render(target, seed=1, spp=64))
    assert ours.shape[2] == 3 + theirs.shape[2]
    close = np.abs(ours[..., 3:] - theirs) <= 0.02 * np.ptp(theirs, axis=(0, 1)) + 1e-6
    assert close.mean((0, 1)).min() > 6 / 7
    # Boundaries are seen, not what is behind.
    bare = np.array(mi.load_dict({"type": "aov", "aovs": aovs}).render(mi.load_dict(parts.room()), spp=64))
    nearer = ours[..., 3] < bare[..., 0] - 0.1
    assert nearer.mean() > 0.1
