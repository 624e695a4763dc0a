"""Guided emission: unbiased with any tables, in the paths' weights and in images; when and what it gains."""

import json
from pathlib import Path

import internals
import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.guided_emission import Cells, EmissionTables, learning
from mitsuba_bdpt.measure.metrics import TRIM, rel_mse
from mitsuba_bdpt.planning import choice, pilot
from mitsuba_bdpt.planning.configuration import CANDIDATES
from mitsuba_bdpt.planning.moments import GROUPS, Moments
from mitsuba_bdpt.run import rendering
from snapshots import ROUNDING, stopped
from test_same_mean import decided, random_tables, scene_of

from scenes import DOWNWARDS, area, camera, floor, load, matte, square

from instruments.capture import Capture, Weighed

SCENES = Path(__file__).parents[2] / "scenes"
T = mi.ScalarTransform4f
CLASSES = learning.CLASSES


# -- unbiased -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("heuristic", ["balance", "power"])
@pytest.mark.parametrize("lamps", ["rectangle", "sphere", "spot", "constant", "sun along an axis"])
def test_weights_are_those_of_explicit_densities(lamps, heuristic):
    """Weights of real paths within 1e-3, and sums of 1 (but for the 2 % where rounding decides)."""
    scene = scene_of(lamps, lens=lamps != "spot")
    tables = random_tables(scene)
    more = {"max_depth": 4, "heuristic": heuristic} | decided(emission=vars(tables))
    found = Weighed()
    found.add(Capture(scene, internals.bdpt(**more), 4000, 3), heuristic)
    assert found.bad == 0 and found.paths > 3000
    # Within rounding of a cell's edge one side takes the neighbour's density.
    assert found.wrong < 2e-3 * found.paths and found.off < 2e-3 * found.paths


# -- what a pilot learns --------------------------------------------------------------------------------


def statistics_of(squares, odds, seed=0, noise=0.0):
    """What two halves of a pilot hear of these second moments (side, side), in one class of ``odds``."""
    rng = np.random.default_rng(seed)
    statistics = np.zeros((2, squares.size, learning.COLUMNS))
    kind = int(np.clip(np.log2(odds) / 2 + CLASSES / 2, 0, CLASSES - 1))
    share = learning.ODDS[kind] / (1 + learning.ODDS[kind])
    for half in range(2):
        found = (squares * np.exp(noise * rng.standard_normal(squares.shape))).ravel()
        statistics[half, :, kind], statistics[half, :, CLASSES], statistics[half, :, CLASSES + 1] = (
            found,
            share * found,
            found,
        )
    return statistics


def test_the_best_table_of_paths_that_emission_alone_makes():
    """Densities by the root of the second moments; what is left is the square of the mean root over the mean
    (Cauchy and Schwarz). Tolerance: the least density and a step of the tables; moments vary slowly, so that
    the blur is small."""
    x, y = np.meshgrid(np.linspace(0, 1, 16), np.linspace(0, 1, 16))
    squares = np.exp(4 * x + 2 * y)
    learnt = learning.learn(statistics_of(squares, 4.0**4), 16, [1])
    root = np.sqrt(squares)
    expected = 0.25 + 0.75 * root / root.mean()
    np.testing.assert_allclose(learnt.tables.densities()[0], expected, rtol=0.08)
    assert learnt.variance_ratio == pytest.approx(root.mean() ** 2 / squares.mean(), rel=0.1)
    assert learnt.whole == pytest.approx(learnt.variance_ratio, rel=0.05)


def test_the_best_table_of_unequal_shares():
    """l has to count where it differs from cell to cell. What is left is within 2 % of the least that a
    search finds, over densities that have two values (no blur: the two halves are large)."""
    squares = np.ones((16, 16))
    squares[:, :8] = 3.0
    often, seldom = statistics_of(squares, 4.0**1), statistics_of(squares, 4.0**-3)
    statistics = np.where((np.arange(256) % 16 < 8)[None, :, None], seldom, often)
    share = learning.ODDS / (1 + learning.ODDS)
    whole = statistics.sum(axis=0).reshape(16, 16, -1)[..., :CLASSES]

    def moment(high):
        density = np.where(np.arange(16) < 8, high, 2 - high)[None, :, None]
        return (whole / (1 - share + density * share)).sum()

    least = min(moment(high) for high in np.linspace(0.05, 1.95, 400))
    fitted = learning._fitted(statistics.sum(axis=0).reshape(1, 16, 16, -1), 1)[0]
    found = (whole / (1 - share + fitted[..., None] * share)).sum()
    assert found < 1.02 * least
    assert moment(1.0) > 1.02 * least


def test_what_a_pilot_accumulates():
    """Of the second moments of light tracing and of camera subpaths each counts once per sample, whatever the
    number of light subpaths (noise of 15 %; a factor of two and more if splats counted by themselves)."""
    scene = load(
        sensor=camera(origin=(0, 2, 0.01), target=(0, 0, 0), fov=40, size=32),
        floor=floor(0, 1, parts.grey(0.6)),
        lamp={"type": "spot", "cutoff_angle": 20, "beam_width": 19}
        | {"to_world": T().look_at([0, 1.5, 0], [0, 0, 0], [0, 0, 1])},
    )
    render = rendering.Render(scene, scene.sensors()[0], mi.load_dict({"type": "bdpt"}).settings, 0, 64)
    statistics = []
    for times in (1, 4):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pilot, "LIGHT_TIMES", times)
            found = pilot.measure(render.prepared, render.plan, render.settings, mi.UInt32(5), 1 << 15)
        statistics.append(found.emission.sum(axis=(0, 1))[[CLASSES, CLASSES + 1]])
    np.testing.assert_allclose(statistics[0], statistics[1], rtol=0.15)


@pytest.mark.parametrize("side", [24, 16])
def test_noise_teaches_nothing(side):
    """A table of noise destroys what points achieve; the same noise over a real difference has a table."""
    even, odd = np.ones((side, side)), np.ones((side, side))
    odd[side // 4 : side // 2, side // 4 : side // 2] = 400
    for seed in range(20):
        assert learning.learn(statistics_of(even, 16.0, seed, noise=2.0), side, [1]).tables is None
        assert learning.learn(statistics_of(odd, 16.0, seed, noise=1.0), side, [1]).tables is not None


def hill(side, height):
    """Second moments that rise smoothly to the middle, by this factor."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, side)] * 2)
    return 1 + height * np.exp(-4 * (x**2 + y**2))


def test_detail_is_kept_where_it_pays():
    """A table that is blurred little is used where it pays, though one that is blurred more would leave
    less."""
    squares = hill(24, 50)
    statistics = statistics_of(squares, 16.0, seed=4, noise=1.2)
    narrow, wide = learning.BLURS[24]
    ways = [learning._learnt(statistics.reshape(2, 1, 24, 24, -1), times, [1]) for times in (narrow, wide)]
    assert narrow < wide and ways[1].variance_ratio < ways[0].variance_ratio < learning.PAYS
    assert learning.learn(statistics, 24, [1]) == ways[0]


def test_noise_is_blurred_where_it_would_not_pay():
    """20 pilots learn twice as often by the wide blur as by the narrow one, which is used where both pay."""
    narrow, wide = learning.BLURS[24]
    pays = {narrow: 0, wide: 0}
    for seed in range(20):
        statistics = statistics_of(hill(24, 20), 16.0, seed, noise=2.0)
        ways = {n: learning._learnt(statistics.reshape(2, 1, 24, 24, -1), n, [1]) for n in pays}
        for n, learnt in ways.items():
            pays[n] += learnt.tables is not None
        both = all(learnt.tables is not None for learnt in ways.values())
        assert learning.learn(statistics, 24, [1]) == ways[narrow if both else wide]
    assert pays[wide] >= 2 * pays[narrow] > 0


def test_outliers_alone_teach_nothing():
    squares = np.exp(np.random.default_rng(2).standard_normal((16, 16)))
    squares[2, 3] = 1e5
    assert learning.learn(statistics_of(squares, 64.0), 16, [1]).tables is None


def test_emitters_without_a_part_are_left_alone():
    squares = np.ones((2, 16, 16))
    squares[0, 4:8, 4:8] = 400
    squares[1] = 1e-3
    learnt = learning.learn(statistics_of(squares, 64.0), 16, [1, 1])
    densities = learnt.tables.densities()
    assert densities[0].std() > 0.5 and (densities[1] == 1).all()


def test_tables_count_in_the_choice():
    """What tables leave of the variance is in the predictions of light subpaths, less of it where these are
    not connected; without tables nothing changes."""
    rays = dict.fromkeys(("camera", "shadow_s1", "light", "shadow_t1", "evaluated"), 1.0)
    found = Moments(np.ones((2, GROUPS, len(CANDIDATES))), (0.0, 0.0), mean=1.0, rays=rays)
    tables = EmissionTables.of(np.ones((1, 4, 4)), 0.5)
    for learnt in (learning.Learnt(tables, 0.4, 0.5), learning.Learnt(None, 0.4, 0.5)):
        rows = choice.choose(found, list(CANDIDATES), learnt=learnt)
        assert len(rows) == len(CANDIDATES)
        for row in rows:
            way, left = row.candidate, 0.5 if learnt.tables else 1.0
            power = 1 if way.connections == "one" else choice.TABLES_ALONE
            assert row.error == row.variance == pytest.approx(left**power if way.light_paths else 1)
            assert way.emission == (learnt.tables if way.light_paths else None)


# -- renders --------------------------------------------------------------------------------------------


def spotlit(size=32):
    """A box with a hole in its lid about a lamp: most of what it emits stays inside."""
    dark = {"type": "twosided", "bsdf": matte(0.02)}
    lamp = floor(1.2, 0.1, parts.grey(0.0), emitter=area(100.0))
    hood = {"type": "cylinder", "p0": [0, 1.1, 0], "p1": [0, 2.0, 0], "radius": 0.2, "bsdf": dark}
    ceiling = square((0, 2.5, 0), DOWNWARDS, 2, parts.grey(0.8))
    eye = camera(origin=(0, 1.0, 4), target=(0, 0.8, 0), fov=40, size=size)
    return mi.load_dict(parts.room(eye, lamp=lamp, hood=hood, ceiling=ceiling))


def rendered(scene, seed=0, spp=64, **parameters):
    method = internals.bdpt(**{"max_depth": 6, **parameters})
    image = np.array(method.render(scene, seed=seed, spp=spp), dtype=np.float64)[..., :3]
    return image, method


def test_it_gains_and_says_so():
    """A lamp in a hood is aimed at its opening. Errors are trimmed, of means over five seeds; the reference
    has 4,096 samples."""
    scene = spotlit()
    reference = np.mean([rendered(scene, 50 + i, 512, guiding="photons")[0] for i in range(8)], axis=0)
    never = [rendered(scene, i, guiding="photons") for i in range(5)]
    auto = [rendered(scene, i) for i in range(5)]
    errors = [np.mean([rel_mse(image, reference, TRIM) for image, _ in of]) for of in (auto, never)]
    decision = auto[0][1].statistics["decisions"][0]
    assert decision["emission"]["left"] < 0.9
    assert never[0][1].statistics["decisions"][0]["emission"] is None
    assert errors[0] < 0.85 * errors[1], errors
    text = auto[0][1].explain(scene, spp=64)
    assert "used: guided emission (predicted to lower squared errors of light subpaths to" in text
    assert "skipped (by hand): guided emission: guiding=photons" in never[0][1].explain(scene, spp=64)


def test_many_lamps_have_small_tables_or_none():

    def lamps(count):
        return {
            f"lamp{i}": {"type": "point", "position": [0.01 * i, 2, 0], "intensity": 0.1}
            for i in range(count)
        }

    many = mi.load_dict(parts.open_scene(**lamps(40)))
    assert Cells(Emitters(many)).side == 8
    most = mi.load_dict(parts.open_scene(**lamps(613)))
    text = mi.load_dict({"type": "bdpt", "max_depth": 4}).explain(most, spp=4)
    assert "guided emission: 613 tables would be needed, and 612 are the most" in text


def test_a_decision_is_done_again():
    scene = spotlit()
    image, method = rendered(scene)
    decisions = method.statistics["decisions"]
    again, other = rendered(scene, decisions=json.dumps(decisions))
    np.testing.assert_allclose(again, image, **ROUNDING)
    assert other.statistics["decisions"] == decisions and other.statistics["pilots"] == {
        "rendered": 0,
        "cached": 0,
    }


def test_a_stopped_render_goes_on():
    scene = spotlit()

    def method():
        return mi.load_dict({"type": "bdpt", "max_depth": 6, "spp_per_pass": 16})

    arguments = {"seed": 3, "spp": 64}
    whole = np.array(method().render(scene, **arguments))
    snapshot = stopped(method(), scene, 1, **arguments)
    assert snapshot.progress.decided.decisions[0].emission is not None
    rest = np.array(method().render(scene, start=snapshot, **arguments))
    np.testing.assert_allclose(rest, whole, **ROUNDING)
