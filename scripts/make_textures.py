"""Makes the textures of the scenes: `python scripts/make_textures.py [folder]`.

Environment maps as Mitsuba reads them: rows from the zenith (+y) to the nadir, columns from -z by
way of +x, +z and -x back to -z. Slides from the top. Half floats in EXR.
"""

import command_line
import numpy as np
import OpenEXR

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


# The slide of projector_through_glass, in 64ths of its width. What is turned or mirrored can be told apart:
# four colours, a letter F, and a border. Transmittances are linear RGB.
SLIDE_SIZE = 64
UPPER_LEFT, UPPER_RIGHT = np.array((0.75, 0.12, 0.08)), np.array((0.85, 0.55, 0.08))
LOWER_LEFT, LOWER_RIGHT = np.array((0.08, 0.35, 0.75)), np.array((0.12, 0.55, 0.2))
LETTER, BORDER = np.array((0.95, 0.95, 0.9)), 0.03
STROKES = ((12, 52, 22, 29), (12, 19, 22, 46), (28, 35, 22, 41))  # top, bottom, left, right
BORDER_WIDTH = 3


def slide():
    """Four coloured quarters with a pale F across them, in a dark border."""
    half = SLIDE_SIZE // 2
    image = np.empty((SLIDE_SIZE, SLIDE_SIZE, 3))
    image[:half, :half], image[:half, half:] = UPPER_LEFT, UPPER_RIGHT
    image[half:, :half], image[half:, half:] = LOWER_LEFT, LOWER_RIGHT
    for top, bottom, left, right in STROKES:
        image[top:bottom, left:right] = LETTER
    inside = np.zeros((SLIDE_SIZE, SLIDE_SIZE), dtype=bool)
    inside[BORDER_WIDTH:-BORDER_WIDTH, BORDER_WIDTH:-BORDER_WIDTH] = True
    image[~inside] = BORDER
    return image


# The floor of small_casters: planks in rows, each of a brown of its own, with grain.
FLOOR_SIZE, PLANK = 128, (8, 32)  # texels; rows and columns of a plank
PALE, DARK = np.array((0.62, 0.45, 0.28)), np.array((0.22, 0.13, 0.07))


def planks():
    """A wooden floor: planks in shifted rows, with grain along them."""
    random = np.random.Generator(np.random.PCG64(7))
    rows, columns = np.indices((FLOOR_SIZE, FLOOR_SIZE))
    row = rows // PLANK[0]
    plank = (columns + 13 * row) % FLOOR_SIZE // PLANK[1]
    shade = random.random((FLOOR_SIZE // PLANK[0], FLOOR_SIZE // PLANK[1]))[row, plank]
    grain = np.repeat(random.random((FLOOR_SIZE, FLOOR_SIZE // 8)), 8, axis=1)
    part = 0.75 * shade + 0.25 * grain
    part[(rows % PLANK[0] == 0) | ((columns + 13 * row) % PLANK[1] == 0)] = 1.0
    return PALE + (DARK - PALE) * part[..., None]


TEXTURES = {"sky_with_sun": sky_with_sun, "slide": slide, "planks": planks}


def make_all(folder):
    """Writes every texture of TEXTURES into `folder`."""
    for name, make in TEXTURES.items():
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"RGB": make().astype(np.float16)}) as file:
            file.write(str(folder / f"{name}.exr"))


if __name__ == "__main__":
    command_line.make(__doc__, "textures", make_all)
