"""Makes the textures of the scenes: `python scripts/make_textures.py [folder]`.

Environment maps as Mitsuba reads them: rows from the zenith (+y) to the nadir, columns from -z by
way of +x, +z and -x back to -z. Half floats in EXR.
"""

import sys
from pathlib import Path

import numpy as np
import OpenEXR

FOLDER = Path(__file__).resolve().parents[1] / "scenes" / "textures"

# The sky of window_room, 256 columns: the sun covers 4 texels. Radiances are linear RGB.
SKY_SIZE = (128, 256)
SUN_TEXEL = (37, 200)  # row and column of its upper left texel: 52 degrees from the zenith, towards -x
SUN = np.array((22000.0, 19800.0, 16400.0))
ZENITH, HORIZON = np.array((0.8, 1.4, 3.0)), np.array((3.2, 3.5, 3.8))
GROUND = np.array((0.55, 0.48, 0.35))


def sky_with_sun():
    """A clear sky that pales towards the horizon, brown ground below, and a small sun."""
    rows, columns = SKY_SIZE
    up = np.cos(np.pi * (np.arange(rows) + 0.5) / rows)[:, None]
    above = HORIZON + (ZENITH - HORIZON) * np.sqrt(np.maximum(up, 0.0))
    column = np.where(up > 0.0, above, GROUND)
    image = np.repeat(column[:, None], columns, axis=1)
    row, first = SUN_TEXEL
    image[row : row + 2, first : first + 2] = SUN
    return image


TEXTURES = {"sky_with_sun": sky_with_sun}


def make_all(folder=FOLDER):
    """Writes every texture of TEXTURES into `folder`."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, make in TEXTURES.items():
        with OpenEXR.File(header, {"RGB": make().astype(np.float16)}) as file:
            file.write(str(folder / f"{name}.exr"))


if __name__ == "__main__":
    make_all(*sys.argv[1:2])
