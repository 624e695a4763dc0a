"""Files that the command has rendered."""

import json

import numpy as np
import OpenEXR


def image(path, channels=None):
    """An EXR file's ``channels`` (default: all, by name), and the statistics of its header."""
    file = OpenEXR.File(str(path), separate_channels=True)
    found = file.channels()
    pixels = np.stack([found[name].pixels for name in channels or sorted(found)], axis=-1)
    return pixels, json.loads(file.header()["bdptStatistics"])
