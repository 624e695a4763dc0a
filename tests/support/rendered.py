"""Files that the command has rendered, and whether two images are the same."""

import json

import numpy as np
import OpenEXR


def image(path, channels=None):
    """An EXR file's ``channels`` (default: all, by name), and the statistics of its header."""
    file = OpenEXR.File(str(path), separate_channels=True)
    found = file.channels()
    pixels = np.stack([found[name].pixels for name in channels or sorted(found)], axis=-1)
    return pixels, json.loads(file.header()["bdptStatistics"])


def same(found, expected):
    """Whether images of the same random numbers differ by rounding only.

    Sums have another order, and a choice may be another one where two are alike to rounding, in a few pixels.
    """
    close = np.isclose(found, expected, rtol=1e-3, atol=1e-3 * expected.mean())
    return np.mean(close) > 0.99 and abs(found.mean() / expected.mean() - 1) < 1e-3
