"""Which camera samples share a light subpath, and the noise they have in common: `transport.batch`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.transport.batch import LEAST_RUNS, LONGEST_RUN, Sharing

PIXELS = (*range(1, 40), 97, 256, 257, 31 * 17, 997, 64 * 64, 4097, 4 * LEAST_RUNS * LONGEST_RUN + 13)


def slots_of(pixels, samples, camera_paths, seed) -> tuple[Sharing, np.ndarray]:
    """The slots of all parts (part, lane); -1 where a lane has none."""
    sharing = Sharing(pixels, samples, camera_paths, mi.UInt32(seed))
    lane, part = dr.meshgrid(dr.arange(mi.UInt32, sharing.lanes), dr.arange(mi.UInt32, camera_paths))
    slots = sharing.slots(lane)(part).numpy().astype(int).reshape(camera_paths, sharing.lanes)
    return sharing, np.where(slots < sharing.total, slots, -1)


@pytest.mark.parametrize("camera_paths", [1, 2, 3, 4, 8, 16])
def test_every_sample_has_one_lane(camera_paths):
    """Rationale: samples of a pixel that share a light subpath depend on each other; those that share with
    others in every pass have no net of light subpaths (8 % more error). Expected: each slot has one lane;
    a lane's slots are of different pixels; a pixel's samples share in order with those of
    the same pixels; there are no more lanes than the next whole number of pixels takes; the first part is in
    order."""
    for number, pixels in enumerate(PIXELS):
        for samples in (1, 2, 3, 16) if pixels < 5000 else (1, 3):
            sharing, slots = slots_of(pixels, samples, camera_paths, number)
            assert sharing.lanes == -(-pixels // camera_paths) * samples
            there = slots >= 0
            assert np.array_equal(np.sort(slots[there]), np.arange(pixels * samples))
            assert np.array_equal(slots[0], np.arange(sharing.lanes))
            if samples == 1:
                partners = slots
            samples_of = partners[..., None] * samples + np.arange(samples)
            assert np.array_equal(
                slots, np.where(partners[..., None] < 0, -1, samples_of).reshape(camera_paths, -1)
            )
        partners = np.sort(np.where(partners < 0, -1 - np.arange(camera_paths)[:, None], partners), axis=0)
        assert (np.diff(partners, axis=0) > 0).all()


def lags(width, height):
    """Pairs of pixels at each lag (2 height, 2 width), negative lags behind the positive ones."""
    down, across = (np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n)) for n in (height, width))
    return (height - down)[:, None] * (width - across)


@pytest.mark.parametrize(
    ("width", "height"),
    [(64, 64), (61, 47), (128, 96), (160, 90), (97, 61), (640, 360), (1, 4999), (5000, 1)],
)
@pytest.mark.parametrize("camera_paths", [2, 3, 4, 8, 16])
def test_sharers_lie_at_no_distance_in_particular(width, height, camera_paths):
    """Rationale: common noise at one distance makes stripes. Expected, as far as a quarter of all pixels have
    a neighbour at a lag: of the pairs there fewer than 0.05 share, hence a correlation below 0.03, and a
    pixel shares with its own column 0.05 above chance at most (0.35 if pixels keep their places in runs).
    Chance alone makes (S - 1) / pixels at each lag, 0.005."""
    pairs = lags(width, height)
    for seed in (0, 1):
        _, slots = slots_of(width * height, 1, camera_paths, seed)
        shared = np.zeros((2 * height, 2 * width))
        for one in range(camera_paths):
            for other in range(one + 1, camera_paths):
                there = (slots[one] >= 0) & (slots[other] >= 0)
                a, b = slots[one][there], slots[other][there]
                down, across = b // width - a // width, b % width - a % width
                for sign in (1, -1):
                    np.add.at(shared, (sign * down, sign * across), 1)
        assert shared.sum() == (camera_paths - 1) * width * height or (width * height) % camera_paths
        column = shared[:, 0].sum() / (width * height)
        assert column < (camera_paths - 1) * (height - 1) / (width * height - 1) + 0.05
        enough = pairs >= width * height / 4
        assert (shared[enough] / pairs[enough]).max() < 0.05
