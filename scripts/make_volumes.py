"""Makes the volumes of the scenes: `python scripts/make_volumes.py [folder]`.

Grids as Mitsuba's `gridvolume` reads them: 32-bit floats, x fastest, then y, then z, in a box of [0, 1]^3.
"""

import struct

import command_line
import numpy as np

# The cloud of cloud_sky: cells along x, y and z; balls whose union it is.
CLOUD_SIZE = (24, 12, 24)
BALLS = 40
SOFT = 0.35  # width of the border, in radii


def cloud():
    """A heap of soft balls, flat below, with the largest density 1: an array by z, y, x."""
    random = np.random.Generator(np.random.PCG64(3))
    nx, ny, nz = CLOUD_SIZE
    z, y, x = ((np.indices((nz, ny, nx)).T + 0.5) / (nz, ny, nx)).T
    density = np.zeros((nz, ny, nx))
    for _ in range(BALLS):
        around, out, up = 2.0 * np.pi * random.random(), 0.3 * np.sqrt(random.random()), random.random()
        centre = 0.5 + out * np.cos(around), 0.25 + 0.3 * up * (1.0 - out / 0.35), 0.5 + out * np.sin(around)
        radius = 0.1 + 0.06 * random.random()
        # Half as high as wide in space: the box of the cloud is.
        away = np.sqrt((x - centre[0]) ** 2 + (0.5 * (y - centre[1])) ** 2 + (z - centre[2]) ** 2) / radius
        density = np.maximum(density, np.clip((1.0 - away) / SOFT, 0.0, 1.0))
    return density * np.clip((y - 0.1) / 0.15, 0.0, 1.0)


VOLUMES = {"cloud": cloud}


def make_all(folder):
    """Writes every volume of VOLUMES into `folder`."""
    for name, make in VOLUMES.items():
        grid = make().astype("<f4")
        nz, ny, nx = grid.shape
        # Version 3, type 1 (32-bit floats), size, one channel, the box.
        header = b"VOL\x03" + struct.pack("<5i6f", 1, nx, ny, nz, 1, 0, 0, 0, 1, 1, 1)
        (folder / f"{name}.vol").write_bytes(header + grid.tobytes())


if __name__ == "__main__":
    command_line.make(__doc__, "volumes", make_all)
