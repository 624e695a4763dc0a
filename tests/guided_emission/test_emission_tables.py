"""Guided emission: every strategy states the density sampled with. Tables are random, of neighbours that
differ by up to 50."""

import json
from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scene_parts as parts
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.emitters.tables import cell_at
from mitsuba_bdpt.geometry.smooth_meshes import is_flat
from mitsuba_bdpt.guided_emission.tables import SIDES, Cells, EmissionTables, side_of
from mitsuba_bdpt.host.jit import evaluated_mode
from scipy import stats

COUNT, LEVEL = 200_000, 1e-4


def random_tables(emitters, seed=1, side=0):
    side = side or side_of(sum(emitters.tables))
    densities = np.random.default_rng(seed).random((sum(emitters.tables), side, side)) ** 4 + 0.02
    return EmissionTables.of(densities / densities.mean(axis=(1, 2), keepdims=True), 0.5)


def without_sky(tables, emitters):
    """With uniform tables for the sky, the emitter that has more than one."""
    densities = tables.densities()
    sky = next(i for i, count in enumerate(emitters.tables) if count > 1)
    first = sum(emitters.tables[:sky])
    densities[first : first + emitters.tables[sky]] = 1
    return EmissionTables.of(densities, 0.5)


def emissions(emitters, name="", seed=11):
    u = [mi.Float(v) for v in np.random.default_rng(seed).random((4, COUNT), dtype=np.float32)]
    like = dr.zeros(mi.Interaction3f)
    like.time = mi.Float(0.3)
    with evaluated_mode(name == "timed_sunsky"):
        e = emitters.sample_emission(mi.Point2f(u[0], u[1]), mi.Point2f(u[2], u[3]), like, mi.Bool(True))
        dr.eval(e)
    return e


def column(x, count=COUNT):
    x = np.array(x, dtype=np.float64)
    return np.broadcast_to(x, (*x.shape[:-1], count)).copy()


def passing(e, center, radius):
    """Emissions that pass a ball."""
    d, away = column(e.d), column(e.si.p) - np.array(center)[:, None]
    return np.linalg.norm(away - np.sum(away * d, axis=0) * d, axis=0) < radius


def guidable():
    parts.register_plugins()
    return [name for name in parts.EMITTERS if parts.plugin_of(parts.EMITTERS[name]()) in GUIDED]


GUIDED = ("area", "point", "spot", "directional", "constant", "envmap", "sunsky", "timed_sunsky")


def scene_of(name, **others):
    parts.register_plugins()
    ball = {"type": "sphere", "center": [0.3, 0.5, 0], "radius": 0.5}
    return mi.load_dict({"type": "scene", "ball": ball, "lamp": parts.EMITTERS[name]()} | others)


def test_every_emitter_is_looked_at():
    with_tables = {name for name in parts.EMITTERS if sum(Emitters(scene_of(name)).tables)}
    assert with_tables == set(guidable())


@pytest.mark.parametrize("name", guidable())
def test_light_leaves_as_without_tables(name):
    """In each of 64 bins of directions (of places along them, for light from infinity). Normal test per bin,
    Sidak, 1e-4."""
    emitters = Emitters(scene_of(name))
    bins, weights = [], []
    for seed, made in ((11, emitters), (12, random_tables(emitters).guided(emitters))):
        e = emissions(made, name, seed)
        d = column(e.d)
        place = column(e.si.p) - np.array([[0.3], [0.5], [0.0]])
        along = place - np.sum(place * d, axis=0) * d if emitters.at_infinity else d
        far = np.abs(along) > 0.4
        bins.append(((along > 0) * [[1], [2], [4]]).sum(0) * 8 + (far * [[1], [2], [4]]).sum(0))
        weights.append(column(e.weight)[0])
    sums = [[np.bincount(b, w**k, 64) / COUNT for k in (1, 2)] for b, w in zip(bins, weights, strict=True)]
    error = np.sqrt(sum(square - mean**2 for mean, square in sums) / COUNT)
    used = error > 0
    z = (np.abs(sums[0][0] - sums[1][0])[used]) / error[used]
    p = 2 * stats.norm.sf(z)
    assert used.sum() >= 4
    assert -np.expm1(len(p) * np.log1p(-p.min())) > LEVEL, (z.max(), np.flatnonzero(used)[z.argmax()])


@pytest.mark.parametrize("name", guidable())
def test_all_strategies_state_one_density(name):
    """For emissions that meet a plane, but for those within rounding of the edge of a cell (1e-3)."""
    emitters = Emitters(scene_of(name))
    guided = random_tables(emitters).guided(emitters)
    e = emissions(guided, name)
    far = e.si.p + e.d * 3
    stated = column(e.pdf_second)
    made = column(dr.max(e.weight)) > 0
    with evaluated_mode(name == "timed_sunsky"):
        direction = column(guided.direction_density(e, far, e.d, mi.Bool(True)))
    assert np.mean(np.abs(direction - stated)[made] > 1e-3 * stated[made]) < 1e-3
    cells = Cells(emitters)
    cell = cells.at(e.index, far, e.d, e.cos, mi.Bool(True))
    assert column(dr.select(cell.known, 1.0, 0.0)).all()
    assert column(cell.number).max() < cells.count


DETAILS = {"small": 0.02, "middle": 2.0, "large": 4.0}


def on_a_ground(radius, more=0):
    """A ball on a large ground under a sun and a sky, and points that make tables small."""
    scene = {
        "type": "scene",
        "ground": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20)},
        "thing": {"type": "sphere", "center": [6, 4, radius], "radius": radius},
        "sun": {"type": "directional", "direction": [0.1, 0.2, -1]},
        "sky": {"type": "constant", "radiance": 0.5},
    }
    points = {f"p{i}": {"type": "point", "position": [0.01 * i, 0, 5]} for i in range(more)}
    return mi.load_dict(scene | points)


@pytest.mark.parametrize("only_sun", [False, True])
@pytest.mark.parametrize("more", [0, 130])
@pytest.mark.parametrize("size", DETAILS)
def test_details_beside_tables(size, more, only_sun):
    """A point on the disk of the details is not in the cell of its numbers. Expected: one density for all
    strategies, also where the sky's table is uniform, and the same light on the ball (five standard
    errors)."""
    emitters = Emitters(on_a_ground(DETAILS[size], more))
    assert emitters.disks.details is not None
    tables = random_tables(emitters)
    if only_sun:
        tables = without_sky(tables, emitters)
    guided = tables.guided(emitters)
    e = emissions(guided)
    stated = column(e.pdf_second)
    asked = column(guided.direction_density(e, e.si.p + e.d, e.d, mi.Bool(True)))
    infinite = column(dr.select(e.infinite, 1.0, 0.0)) > 0
    assert np.mean(np.abs(asked - stated)[infinite] > 1e-3 * stated[infinite]) < 2e-3
    ball = [6.0, 4.0, DETAILS[size]], DETAILS[size]
    both = e, emissions(emitters, seed=12)
    light = [np.where(passing(x, *ball), column(x.weight)[0], 0) for x in both]
    error = np.sqrt(sum(x.var() for x in light) / COUNT)
    assert abs(light[0].mean() - light[1].mean()) < 5 * error


@pytest.mark.parametrize("name", [*guidable(), "small", "large"])
def test_what_tables_change_of_a_density(name):
    """Expected: the density is ``kept`` + ``scaled`` r times that without tables, but for the edges of
    cells."""
    scene = on_a_ground(DETAILS[name]) if name in DETAILS else scene_of(name)
    emitters = Emitters(scene)
    tables = random_tables(emitters)
    guided, cells = tables.guided(emitters), Cells(emitters)
    e = emissions(emitters, name)
    far = e.si.p if emitters.at_infinity else e.si.p + e.d
    before, after = (column(x.direction_density(e, far, e.d, mi.Bool(True))) for x in (emitters, guided))
    cos = dr.dot(e.si.sh_frame.n, e.d)
    cell = cells.at(e.index, far, e.d, cos, mi.Bool(True))
    r = tables.densities().ravel()[column(cell.number).astype(int)]
    expected = column(cell.factor.kept) + column(cell.factor.scaled) * r
    used = (before > 0) & (
        (column(cos) > 2e-3) | emitters.at_infinity | (name in ("point", "spot", "textured spot"))
    )
    assert used.mean() > 0.9
    assert np.mean(np.abs(after / np.where(used, before, 1) - expected)[used] > 2e-3 * expected[used]) < 5e-3


def lit_from(name, guided, count=20_000):
    """Next-event estimation for points about the emitter."""
    u = [mi.Float(v) for v in np.random.default_rng(4).random((5, count), dtype=np.float32)]
    at = dr.zeros(mi.SurfaceInteraction3f, count)
    at.p = mi.Point3f(u[0] - 0.5, u[1] + 1.2, u[2] - 0.5)
    at.time = mi.Float(0.3)
    return at, guided.sample_direct(at, mi.Point2f(u[3], u[4]), mi.Bool(True))


@pytest.mark.parametrize("name", [n for n in guidable() if n != "timed_sunsky"])
def test_next_event_estimation_and_hits_state_the_same(name):
    """Expected: next-event estimation states the ratio of densities of what its ray hits; both change with
    the tables as the cell's density. To 2e-3, but for the edges of cells, texels and the sun (2 %)."""
    scene = scene_of(name)
    emitters = Emitters(scene)
    tables = random_tables(emitters)
    guided = tables.guided(emitters)
    at, direct = lit_from(name, guided)
    _, plain = lit_from(name, emitters)
    values = partial(column, count=dr.width(at))

    def changed(after, before):
        with np.errstate(all="ignore"):  # where nothing is emitted
            return values(after) / values(before)

    lit = values(dr.max(direct.weight)) > 0
    assert lit.sum() > 1000
    ratio = changed(direct.emission_ratio, plain.emission_ratio)
    cos = dr.abs(dr.dot(direct.anchor.n, direct.d))
    cell = Cells(emitters).at(direct.index, at.p, -direct.d, cos, mi.Bool(True)).number
    shape = scene.emitters()[0].get_shape()
    if shape is None or is_flat(shape):
        expected = tables.densities().ravel()[values(cell).astype(int)]
        assert np.mean(np.abs(ratio - expected)[lit] > 2e-3 * expected[lit]) < 2e-2
    if not emitters.hittable:
        return
    hit = scene.ray_intersect(mi.Ray3f(at.p, direct.d, 0.3, mi.Color0f()))
    seen = (values(dr.select(hit.emitter(scene) != dr.zeros(mi.EmitterPtr), 1.0, 0.0)) > 0) & lit
    assert seen.sum() > 1000
    after, before = (x.hit_densities(hit, at.p, mi.Bool(True))[2] for x in (guided, emitters))
    off = np.abs(changed(after, before) - ratio) > 2e-3 * ratio
    assert off[seen].mean() < 2e-2
    assert values(Cells(emitters).of_hit(hit, at.p, mi.Bool(True)).known)[seen].all()


@pytest.mark.parametrize("n", [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, -0.0], [0.6, 0.8, 0.0]])
def test_frames_do_not_depend_on_who_asks(n):
    """Rationale: a frame made of a normal is mirrored by the sign of a zero. Expected: one place for
    directions that differ by rounding."""
    turn = mi.ScalarTransform4f().look_at([0, 0, 0], n, [0.3, 0.2, 0.9])
    lamp = {"type": "rectangle", "to_world": turn, "emitter": {"type": "area"}}
    sun = {"type": "directional", "direction": n}
    for light in ({"lamp": lamp}, {"sun": sun}):
        ball = {"type": "sphere", "radius": 2.0}
        cells = Cells(Emitters(mi.load_dict({"type": "scene", "ball": ball} | light)))
        towards = np.array([n] * 7) + np.vstack([np.zeros(3), 1e-7 * np.eye(3), -1e-7 * np.eye(3)])
        d = dr.normalize(mi.Vector3f(*(mi.Float(np.float32(v)) for v in towards.T)))
        if "lamp" in light:  # not the middle, where all cells meet
            d = dr.normalize(d + mi.Vector3f(0.21, -0.17, 0.11))
        cell = cells.at(mi.UInt32(0), mi.Point3f(0.3, -0.4, 0.5), d, mi.Float(1), mi.Bool(True))
        assert len(set(np.array(cell.number).tolist())) == 1


def test_what_is_flat():
    for kind in ("rectangle", "disk", "sphere", "cube", "cylinder"):
        assert is_flat(mi.load_dict({"type": kind})) == (kind in ("rectangle", "disk")), kind
    for name in ("flat mesh", "smooth mesh"):  # of many faces, without and with normals at vertices
        scene = scene_of(name)  # holds the shape
        assert not is_flat(scene.emitters()[0].get_shape()), name
    plane = mi.Mesh("plane", 4, 2, has_vertex_normals=False)
    params = mi.traverse(plane)
    params["vertex_positions"] = [0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0]
    params["faces"] = [0, 1, 2, 0, 2, 3]
    params.update()
    assert is_flat(plane)
    params["vertex_positions"] = [0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0.1]
    params.update()
    assert not is_flat(plane)


def test_only_what_gains_is_looked_up():
    """Looking densities up takes time at every vertex."""
    scene = scene_of("constant", more=parts.EMITTERS["rectangle"]())
    emitters = Emitters(scene)
    guided = without_sky(random_tables(emitters), emitters).guided(emitters)
    groups = {type(group).__name__: group.guide for group in guided.groups}
    assert groups["InfiniteEmitters"] is None and groups["AreaEmitters"] is not None


@pytest.mark.parametrize("radius, kept", [(0.02, True), (1.0, False)])
def test_details_smaller_than_a_cell_keep_their_disk(radius, kept):
    """Half of all emissions go towards small things on a large ground."""
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(10)}
    thing = {"type": "sphere", "center": [3, 2, radius], "radius": radius}
    sun = {"type": "directional", "direction": [0.1, 0.2, -1]}
    emitters = Emitters(mi.load_dict({"type": "scene", "ground": ground, "thing": thing, "sun": sun}))
    assert emitters.disks.details is not None
    e = emissions(random_tables(emitters).guided(emitters))
    assert (0.4 < passing(e, [3, 2, radius], 1.8 * radius).mean() < 0.6) == kept


# -- tables ---------------------------------------------------------------------------------------------


def test_tables_come_back_from_json():
    """Densities within half of a step of 2^(1/16)."""
    densities = np.random.default_rng(3).random((5, 8, 8)) + 0.1
    densities /= densities.mean(axis=(1, 2), keepdims=True)
    tables = EmissionTables.of(densities, 0.5)
    again = EmissionTables(**json.loads(json.dumps(vars(tables))))
    assert again == tables and hash(again) == hash(tables)
    np.testing.assert_allclose(again.densities(), densities, rtol=0.045)
    np.testing.assert_allclose(again.densities().mean(axis=(1, 2)), 1)


@pytest.mark.parametrize("side", SIDES)
def test_warped_numbers_are_distributed_as_the_tables_say(side):
    """Expected: stratified numbers, the stated density that of the cell; the order of neighbours stays."""
    emitters = Emitters(scene_of("rectangle"))
    tables = random_tables(emitters, side=side)
    guided = tables.guided(emitters)
    n = 512
    x, y = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n)
    u = mi.Point2f(mi.Float(x.ravel().astype(np.float32)), mi.Float(y.ravel().astype(np.float32)))
    warped, density = guided.groups[0].guide.warp(mi.UInt32(0), mi.UInt32(0), u, mi.Bool(True))
    cell = np.array(cell_at(warped, side))
    shares = np.bincount(cell, minlength=side**2) / n**2
    expected = tables.densities().ravel() / side**2
    # A cell's edges cut rows and columns of numbers anywhere.
    np.testing.assert_allclose(shares, expected, atol=4 / n * np.sqrt(expected.max()))
    stated = tables.densities().ravel()[cell]
    assert np.mean(np.abs(np.array(density) - stated) > 1e-4 * stated) < 1e-3
    rows = np.array(warped.y).reshape(n, n)
    assert (np.diff(rows, axis=0) >= 0).all()
    assert (np.diff(np.array(warped.x).reshape(n, n)[0]) >= 0).all()


def test_a_copy_leaves_the_emitters_alone():
    emitters = Emitters(scene_of("sphere"))
    before = column(emissions(emitters).pdf_second)
    guided = random_tables(emitters).guided(emitters)
    assert (column(emissions(guided).pdf_second) != before).mean() > 0.9
    np.testing.assert_array_equal(column(emissions(emitters).pdf_second), before)
    assert replace(random_tables(emitters), left=0.7) != random_tables(emitters)
