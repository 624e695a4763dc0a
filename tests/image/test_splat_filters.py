"""Splats with the film's filter: some pixels are drawn (`image.taps`); the mean is that of all of them."""

from math import ceil

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import variants
from mitsuba_bdpt.image.accumulator import Accumulator, Block
from mitsuba_bdpt.image.layers import strategies
from mitsuba_bdpt.image.taps import Taps
from mitsuba_bdpt.run.rendering import Render
from mitsuba_bdpt.transport import batch
from scipy import stats

# A crop window; positions inside it, at its corners, and outside within the filter's radius.
SIZE, OFFSET = (7, 6), (3, 2)
POSITIONS = np.array(
    [[6.5, 5.5], [6.02, 4.97], [6.31, 4.75], [3.1, 2.2], [9.9, 7.9], [2.2, 5.3], [11.4, 8.6], [6.0, 5.0]]
)
APART = SIZE[1] + 20  # rows from one position's pixels to the next one's
NUMBERS = 256  # per axis: midpoints of equal cells

FILTERS = {name: {"type": name} for name in ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")}
FILTERS |= {
    "narrow": {"type": "gaussian", "stddev": 0.15},
    "between": {"type": "gaussian", "stddev": 0.6},
    "wide": {"type": "gaussian", "stddev": 1.1},
}


def added(rfilter, put):
    """What ``put(block)`` adds: (positions, height, width)."""
    size = [SIZE[0], APART * len(POSITIONS)]
    block = Block(size, OFFSET, 2, mi.load_dict(FILTERS[rfilter]), dr.ReduceMode.Direct, mi.ArrayXd)
    put(block)
    sums = np.array(block.data).reshape(len(POSITIONS), APART, SIZE[0], 2)
    assert not sums[..., 1].any()  # the padding
    return sums[:, : SIZE[1], :, 0]


def exact(rfilter):
    """A splat of 1 at each position, added to every pixel of the filter's support."""

    def put(block):
        place = dr.arange(mi.UInt32, len(POSITIONS))
        position = dr.gather(mi.Point2f, mi.Float(POSITIONS.ravel()), place)
        block.put(position, [mi.Float(1)], mi.Bool(True), place * APART)

    return added(rfilter, put)


def drawn(rfilter, numbers=NUMBERS, shift=0.5):
    """The mean of splats of 1 over a grid of random numbers, at each position."""

    def put(block):
        lane = dr.arange(mi.UInt32, len(POSITIONS) * numbers**2)
        place, cell = lane // numbers**2, lane % numbers**2
        u = (mi.Point2f(mi.Float(cell % numbers), mi.Float(cell // numbers)) + shift) / numbers
        position = dr.gather(mi.Point2f, mi.Float(POSITIONS.ravel()), place)
        block.splat(position, [mi.Float(1 / numbers**2)], mi.Bool(True), u, place * APART)

    return added(rfilter, put)


@pytest.mark.parametrize("rfilter", FILTERS)
def test_the_mean_over_all_numbers_is_the_filter(rfilter):
    """Tolerance: a pixel's share of a grid of n cells per axis is exact to 1 / n per axis; times what the
    drawn pixels receive, at most 0.6 (lanczos)."""
    expected = exact(rfilter)
    assert np.abs(expected).max() > 0.1
    rounding = 1e-5
    bound = 2 / NUMBERS * 0.6 if rfilter not in ("box", "tent", "narrow", "wide") else 0
    assert np.abs(drawn(rfilter) - expected).max() < bound + rounding


@pytest.mark.parametrize("rfilter", ["tent", "gaussian", "between", "lanczos"])
def test_weights_add_up_to_those_of_all_pixels(rfilter):
    """A radius rounded down loses 0.1 % of the light. Tolerance: sums of a hundred numbers in single
    precision."""
    loaded = mi.load_dict(FILTERS[rfilter])
    u = [mi.Float(x) for x in np.random.default_rng(2).random((4, 1000), np.float32)]
    taps = Taps(loaded, mi.Point2f(u[0], u[1]), mi.Point2f(u[2], u[3]))
    found = sum(dr.abs(taps.tap(mi.Int32(k))[1]) for k in range(taps.count))
    pixels = range(1 - ceil(loaded.radius()), 1 + ceil(loaded.radius()))  # about positions in [0, 1)
    columns, rows = (sum(dr.abs(loaded.eval(k - x)) for k in pixels) for x in u[:2])
    np.testing.assert_allclose(found, columns * rows, rtol=100 * 2.0**-24)


@pytest.mark.parametrize("rfilter, most", [("tent", 4), ("gaussian", 4), ("lanczos", 7)])
def test_a_splat_adds_to_few_pixels(rfilter, most):
    """Additions are the cost of a splat; the supports have 4, 16 and 36 pixels."""
    for shift in (0.01, 0.5, 0.99):
        assert 3 <= np.count_nonzero(drawn(rfilter, 1, shift)[2]) <= most


@pytest.mark.parametrize("rfilter, most", [("tent", 1.001), ("gaussian", 1.07), ("lanczos", 1.15)])
def test_what_drawing_adds_to_the_variance(rfilter, most):
    """One pixel drawn of all would have 2 to 16 times the variance. The same grid of positions and random
    numbers for both; the ratio is exact to some 1e-2."""
    numbers = 16
    loaded, lanes = mi.load_dict(FILTERS[rfilter]), dr.arange(mi.UInt32, numbers**4)
    grid = [(mi.Float(lanes // numbers**k % numbers) + 0.5) / numbers for k in range(4)]
    at = mi.Point2f(grid[0], grid[1])
    taps = Taps(loaded, at, mi.Point2f(grid[2], grid[3]))
    pixels = range(-5, 7)
    exact = [sum(loaded.eval(k - at[axis]) ** 2 for k in pixels) for axis in (0, 1)]
    of_taps = [np.array(taps.tap(mi.Int32(k))[1]) for k in range(taps.count)]
    assert 0.999 < sum(np.mean(w**2) for w in of_taps) / np.mean(np.array(exact[0] * exact[1])) < most


@pytest.mark.parametrize(
    ("wide", "narrower"),
    [
        ({"type": "gaussian", "stddev": 5}, {"type": "gaussian", "stddev": 1}),
        ({"type": "tent", "radius": 10.0}, {"type": "tent", "radius": 4.0}),
        ({"type": "lanczos", "lobes": 9}, {"type": "lanczos", "lobes": 4}),
    ],
)
def test_wide_filters_are_added_to_all_pixels(wide, narrower):
    """Operations grew with the third power of the radius: 23 s for a first image. Tolerance: some roundings
    of values of at most 1."""
    at, operations = (31.3, 33.8), []
    for rfilter in map(mi.load_dict, (narrower, wide)):
        block = Block((64, 64), (0, 0), 2, rfilter, dr.ReduceMode.Expand, mi.ArrayXd)
        dr.eval(place := mi.Point2f(dr.opaque(mi.Float, at[0]), dr.opaque(mi.Float, at[1])))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            block.splat(place, [mi.Float(1)], mi.Bool(True), mi.Point2f(0.5))
            dr.eval(block.data)
            operations.append(sum(k.get("operation_count", 0) for k in dr.kernel_history()))
        x, y = (np.array(rfilter.eval(dr.arange(mi.Float, 64) + 0.5 - p)) for p in at)
        found = np.array(block.data).reshape(64, 64, 2)[..., 0]
        np.testing.assert_allclose(found, np.outer(y, x), rtol=0, atol=8 * 2.0**-24)
    assert operations[0] == operations[1]


@pytest.mark.skipif(variants.BACKEND != "llvm", reason="threads are those of a CPU")
@pytest.mark.parametrize(("stddev", "is_wide"), [(0.5, False), (5, True)])
def test_sums_of_wide_filters_are_copied_for_each_thread(stddev, is_wide):
    """Atomic additions to 1600 pixels took three to five times as long."""
    target = scene(rfilter={"type": "gaussian", "stddev": stddev})
    made = Render(target, target.sensors()[0], mi.load_dict({"type": "bdpt"}).settings, 0, 16).accumulator
    modes = made.camera._mode, made.light._mode
    expected = (dr.ReduceMode.Expand,) * 2 if is_wide else (dr.ReduceMode.Local, dr.ReduceMode.Direct)
    assert modes == expected


def scene(**film):
    """A lamp beside a sphere in a room, seen with a lens, of which light subpaths make most."""
    sensor = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0, "fov": 60}
    film = {"type": "hdrfilm", "width": 12, "height": 12, "component_format": "float32", **film}
    to_world = mi.ScalarTransform4f().look_at([0, 0, 0.8], [0.2, 0.1, -1], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor | {"film": film, "to_world": to_world},
            "room": {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
            "ball": {"type": "sphere", "radius": 0.2, "center": [0.1, 0, -0.3], "bsdf": {"type": "plastic"}},
            "lamp": {"type": "point", "position": [0.3, 0.5, 0], "intensity": 2.0},
        }
    )


def test_strips_of_camera_samples_are_apart(monkeypatch):
    """The image is that of a single sum. Tolerance: sums of some hundred numbers, relative to the brightest
    pixel."""
    target = scene(rfilter={"type": "gaussian"}, crop_width=3, crop_height=2)
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 3, "light_paths": 0})
    expected = np.array(bdpt.render(target, seed=1, spp=4))
    monkeypatch.setattr(batch, "STRIP", 1)
    apart = np.array(bdpt.render(target, seed=1, spp=4))
    np.testing.assert_allclose(apart, expected, rtol=0, atol=100 * 2.0**-24 * expected.max())


def test_numbers_of_the_filter_are_uniform_and_independent(monkeypatch):
    """Wherever in a pixel splats fall: chi-squared of 4 x 4 cells of the numbers in each of 4 x 4 cells of
    the pixel."""
    found = dr.zeros(mi.UInt32, 4**4)
    dr.make_opaque(found)
    original = Accumulator.put_light

    def put_light(self, c, colours, polarized, active, u):
        cell = mi.UInt32(0)
        for x in (*(c.position - dr.floor(c.position)), *u):
            cell = 4 * cell + mi.UInt32(4 * x)
        dr.scatter_reduce(dr.ReduceOp.Add, found, mi.UInt32(1), cell, active)
        original(self, c, colours, polarized, active, u)

    monkeypatch.setattr(Accumulator, "put_light", put_light)
    bdpt = mi.load_dict({"type": "bdpt", "skip": "none", "max_depth": 4})
    bdpt.render(scene(rfilter={"type": "gaussian"}), seed=4, spp=64)
    counts = np.array(found).reshape(16, 16)
    assert counts.sum() > 10000
    assert stats.chisquare(counts, axis=1).pvalue.min() > 0.001 / 16


def test_images_of_strategies_add_up():
    """A strategy's image that drew other pixels for its splats would only agree on average."""
    film = {"rfilter": {"type": "lanczos"}, "sample_border": True, "pixel_format": "rgb"}
    film |= {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 6, "crop_height": 8}
    bdpt = mi.load_dict({"type": "bdpt", "skip": "none", "max_depth": 3, "layers": "strategies"})
    layers = np.array(bdpt.render(scene(**film), seed=1, spp=8), dtype=np.float64)
    image, parts = layers[..., :3], layers[..., 3:].reshape(8, 6, -1, 2, 3)
    assert parts.shape[2] == len(list(strategies(3)))
    splats = [t <= 1 for _, _, t in strategies(3)]
    assert np.abs(parts[:, :, splats, 0].sum(2)).mean() > 0.1 * image.mean()
    np.testing.assert_allclose(parts[:, :, :, 0].sum(2), image, atol=1e-4 * np.abs(image).max())
