"""Makes the meshes of the scenes: `python scripts/make_meshes.py [folder]`.

Every mesh is computed from the few numbers below and written as a small binary PLY. Coordinates are
rounded to 1e-5, so that the files come out the same, byte for byte, on every machine.
"""

import command_line
import numpy as np

DECIMALS = 5

# The egg of veach_bidir: (height, radius), measured on B. Bitterli's re-model (CC0).
EGG_BOTTOM, EGG_TOP = 1.907, 3.417
EGG_AXIS = (-2.377, -0.788)  # x, z
EGG = np.array(
    [
        (1.91, 0.108), (1.94, 0.239), (1.99, 0.342), (2.07, 0.420), (2.16, 0.474), (2.27, 0.509),
        (2.39, 0.526), (2.51, 0.527), (2.63, 0.516), (2.75, 0.495), (2.86, 0.466), (2.97, 0.432),
        (3.06, 0.393), (3.14, 0.350), (3.21, 0.305), (3.28, 0.257), (3.33, 0.209), (3.37, 0.160),
        (3.40, 0.095),
    ]
)  # fmt: skip

LAMP_AXIS = (-2.4816, 2.5894)  # x, z of the floor lamp of veach_bidir
SPOT_AXIS = np.array((0.070, -0.432, 0.899))  # the way its wall spot points
SPOT_CENTRE = np.array((-2.659, 4.911, -3.368))
SPOT_RADIUS, SPOT_LENGTH = 0.298, 0.98

# The cut-glass lamp of lamp_behind_glass: heights and radii of its edges around the lamp's middle.
CUT_GLASS = np.array(
    [(-0.28, -0.21, -0.09, 0.04, 0.15, 0.21, 0.225), (0.0, 0.12, 0.205, 0.215, 0.15, 0.08, 0.0)]
)
CUT_GLASS_SIDES = 12

# The water of pool: its corners (x, z), the edge of its squares, and its waves (wavelength, angle of
# travel from the x axis in degrees, amplitude, phase), in metres.
POOL_CORNERS = ((-2.02, -1.62), (2.02, 0.82))
POOL_GRID = (80, 48)
POOL_WAVES = np.array(
    [
        (1.30, 75.0, 0.0075, 0.0),
        (0.97, 118.0, 0.0055, 1.7),
        (0.74, 31.0, 0.0040, 4.0),
        (0.58, 152.0, 0.0030, 2.9),
        (0.46, 84.0, 0.0022, 5.5),
    ]
)

RING_INNER, RING_OUTER, RING_HEIGHT = 0.88, 1.0, 0.34  # the ring of ring_caustic
MIRROR_RIM = 3.0  # radius of the headlight's mirror, in focal lengths

# The pebble of small_casters: rows and sides (9,898 triangles), and its bumps: amplitude, waves from pole to
# pole, waves around the axis.
PEBBLE_ROWS, PEBBLE_SIDES = 50, 101
PEBBLE_BUMPS = ((0.10, 2, 3), (0.06, 5, 2), (0.03, 7, 6))


def egg_profile(rows):
    """Height, radius and outward normal (in the profile's plane) of the egg at `rows` + 1 angles.

    A cosine series for the distance from the middle, as a function of the angle from the upper
    pole, is smooth at both poles; eight terms meet the measured radii to within 4 mm (13 mm at
    the foot).
    """
    middle = 0.5 * (EGG_BOTTOM + EGG_TOP)
    points = np.vstack([EGG, [(EGG_BOTTOM, 0.0), (EGG_TOP, 0.0)]])
    height, radius = points[:, 0] - middle, points[:, 1]
    order = np.arange(8)
    terms = np.cos(order * np.arctan2(radius, height)[:, None])
    series = np.linalg.lstsq(terms, np.hypot(radius, height), rcond=None)[0]

    angle = np.linspace(0.0, np.pi, rows + 1)
    distance = np.cos(order * angle[:, None]) @ series
    slope = -(order * np.sin(order * angle[:, None])) @ series
    sin, cos = np.sin(angle), np.cos(angle)
    normal_r, normal_y = distance * sin - slope * cos, distance * cos + slope * sin
    length = np.hypot(normal_r, normal_y)
    radius = distance * sin
    radius[[0, -1]] = 0.0
    return middle + distance * cos, radius, normal_r / length, normal_y / length


def revolve(height, radius, normal_r, normal_y, sides, axis=(0.0, 0.0)):
    """Surface around the ``axis`` (x, z) along y. The profile runs from top to bottom for outward faces.

    Returns vertices, normals (both (n, 3)) and triangles; a profile end on the axis becomes a fan.
    """
    turn = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = np.stack([np.sin(turn), np.zeros(sides), np.cos(turn)], axis=1)
    up = np.array((0.0, 1.0, 0.0))
    vertices, normals, rows = [], [], []
    for y, r, n_r, n_y in zip(height, radius, normal_r, normal_y, strict=True):
        around = ring[:1] if r == 0.0 and abs(n_r) < 1e-9 else ring  # a pole needs one vertex only
        rows.append(np.resize(np.arange(len(around)), sides) + len(vertices))
        vertices.extend(r * around + y * up)
        normals.extend(n_r * around + n_y * up)
    faces = []
    for upper, lower, above, below in zip(rows, rows[1:], radius, radius[1:], strict=False):
        for a, b, c, d in zip(upper, np.roll(upper, -1), lower, np.roll(lower, -1), strict=True):
            faces += [(a, c, d)] * bool(c != d and below > 0.0) + [(a, d, b)] * bool(a != b and above > 0.0)
    vertices = np.array(vertices) + (axis[0], 0.0, axis[1])
    return vertices, np.array(normals), np.array(faces, dtype=np.int32)


def egg():
    return revolve(*egg_profile(rows=40), sides=64, axis=EGG_AXIS)


def lamp_base():
    """Spherical cap, radius .995 at y = 0, height .30."""
    radius, height = 0.995, 0.30
    sphere = (radius**2 + height**2) / (2.0 * height)
    angle = np.linspace(0.0, np.arcsin(radius / sphere), 9)
    sin, cos = np.sin(angle), np.cos(angle)
    y = sphere * cos - (sphere - height)
    return revolve(y, sphere * sin, sin, cos, sides=48, axis=LAMP_AXIS)


def lamp_head():
    """Cone, apex at y = 5.736, rim of radius 1.172 at y = 6.439; normals point out and down."""
    bottom, top, rim = 5.736, 6.439, 1.172
    part = np.linspace(1.0, 0.0, 4)
    slant = np.hypot(top - bottom, rim)
    normal_r, normal_y = np.full(4, (top - bottom) / slant), np.full(4, -rim / slant)
    y, radius = bottom + part * (top - bottom), part * rim
    return revolve(y, radius, normal_r, normal_y, sides=64, axis=LAMP_AXIS)


def spot_cap():
    """Half sphere that closes the rear of the wall spot's tube."""
    angle = np.linspace(0.0, 0.5 * np.pi, 9)
    sin, cos = np.sin(angle), np.cos(angle)
    vertices, normals, faces = revolve(SPOT_RADIUS * cos, SPOT_RADIUS * sin, sin, cos, sides=32)
    back = -SPOT_AXIS / np.linalg.norm(SPOT_AXIS)  # where the half sphere's own y axis goes
    side = np.cross(back, (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    to_world = np.stack([np.cross(back, side), back, side], axis=1)
    rear = SPOT_CENTRE + 0.5 * SPOT_LENGTH * back
    return vertices @ to_world.T + rear, normals @ to_world.T, faces


def cut_glass():
    """Body with flat facets: no normals, so that refraction follows the geometry exactly."""
    height, radius = CUT_GLASS[:, ::-1]
    nothing = np.zeros(len(height))
    vertices, _, faces = revolve(height, radius, nothing, nothing, sides=CUT_GLASS_SIDES)
    return vertices, None, faces


def pool_water():
    """Sum of plane waves over a rectangle, normals up."""
    (left, back), (right, front) = POOL_CORNERS
    columns, rows = POOL_GRID
    z, x = np.meshgrid(
        np.linspace(back, front, rows + 1), np.linspace(left, right, columns + 1), indexing="ij"
    )
    length, angle, amplitude, phase = POOL_WAVES.T
    wave_x = 2.0 * np.pi / length * np.cos(np.radians(angle))
    wave_z = 2.0 * np.pi / length * np.sin(np.radians(angle))
    at = x[..., None] * wave_x + z[..., None] * wave_z + phase
    y = np.sin(at) @ amplitude
    slope_x, slope_z = np.cos(at) @ (amplitude * wave_x), np.cos(at) @ (amplitude * wave_z)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    normals = np.stack([-slope_x, np.ones_like(y), -slope_z], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    row, column = np.divmod(np.arange(rows * columns), columns)
    a = row * (columns + 1) + column
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    faces = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)])
    return vertices, normals, faces.astype(np.int32)


def ring():
    """Band with a rounded section (a superellipse of exponent 4) that stands on y = 0."""
    angle = np.linspace(0.0, 2.0 * np.pi, 29)
    sin, cos = np.sin(angle), np.cos(angle)
    half = 0.5 * np.array((RING_OUTER - RING_INNER, RING_HEIGHT))
    # Both roots of the ellipse's coordinates; the gradient of x^4 + y^4 is the normal.
    across, up = np.sign(cos) * np.sqrt(np.abs(cos)), np.sign(sin) * np.sqrt(np.abs(sin))
    normal_r, normal_y = across**3 / half[0], up**3 / half[1]
    size = np.hypot(normal_r, normal_y)
    # From top to bottom on the outer side, and up again on the inner one.
    order = np.roll(np.arange(28)[::-1], 8)
    order = np.append(order, order[0])
    radius = 0.5 * (RING_OUTER + RING_INNER) + half[0] * across
    y = half[1] * (1.0 + up)
    return revolve(y[order], radius[order], (normal_r / size)[order], (normal_y / size)[order], sides=128)


def headlight_mirror():
    """Paraboloid with focal length 1 and its vertex at the origin, open towards +y; normals point in."""
    radius = np.linspace(0.0, MIRROR_RIM, 33)  # upwards, so that the faces look in
    slope = 0.5 * radius
    size = np.hypot(1.0, slope)
    return revolve(0.25 * radius**2, radius, -slope / size, 1.0 / size, sides=64)


def pebble():
    """A bumpy ball of radius about 1: rho(theta, phi) with analytic normals."""
    theta = np.linspace(0.0, np.pi, PEBBLE_ROWS + 1)[1:-1, None]
    phi = np.linspace(0.0, 2.0 * np.pi, PEBBLE_SIDES, endpoint=False)[None]
    sin, cos = np.sin(theta), np.cos(theta)
    rho, d_theta, d_phi = np.ones(np.broadcast(theta, phi).shape), 0.0, 0.0
    for amplitude, down, around in PEBBLE_BUMPS:
        # sin^2 theta: smooth at the poles, where all phi meet.
        wave, angle = np.cos(down * theta + around * phi), down * theta + around * phi
        rho = rho + amplitude * sin**2 * wave
        d_theta = d_theta + amplitude * (2 * sin * cos * wave - down * sin**2 * np.sin(angle))
        d_phi = d_phi - amplitude * around * sin**2 * np.sin(angle)
    radial = np.stack(np.broadcast_arrays(sin * np.sin(phi), cos, sin * np.cos(phi)), axis=-1)
    along = np.stack(np.broadcast_arrays(cos * np.sin(phi), -sin, cos * np.cos(phi)), axis=-1)
    across = np.stack(np.broadcast_arrays(np.cos(phi), 0.0, -np.sin(phi)), axis=-1)
    normals = rho[..., None] * radial - d_theta[..., None] * along - (d_phi / sin)[..., None] * across
    poles = np.array([(0.0, 1.0, 0.0), (0.0, -1.0, 0.0)])
    vertices = np.vstack([(rho[..., None] * radial).reshape(-1, 3), poles])
    normals = np.vstack([normals.reshape(-1, 3), poles])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    rows, sides = PEBBLE_ROWS - 1, PEBBLE_SIDES
    row, column = np.divmod(np.arange((rows - 1) * sides), sides)
    a, b = row * sides + column, row * sides + (column + 1) % sides
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    top, bottom, last = np.full(sides, rows * sides), np.full(sides, rows * sides + 1), (rows - 1) * sides
    parts = [(a, a + sides, b + sides), (a, b + sides, b), (top, i, j), (bottom, last + j, last + i)]
    faces = np.concatenate([np.stack(part, axis=1) for part in parts])
    return vertices, normals, faces.astype(np.int32)


def write_ply(path, vertices, normals, faces):
    """Binary little-endian PLY with float32 vertices and, unless None, normals."""
    names = ["x", "y", "z"] + ([] if normals is None else ["nx", "ny", "nz"])
    data = vertices if normals is None else np.hstack([vertices, normals])
    data = np.round(data, DECIMALS) + 0.0  # + 0.0 turns -0.0 into 0.0
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(data)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    text = "\n".join([*header, ""]).encode("ascii")
    path.write_bytes(text + data.astype("<f4").tobytes() + rows.tobytes())


MESHES = {
    "veach_bidir_egg": egg,
    "veach_bidir_lamp_base": lamp_base,
    "veach_bidir_lamp_head": lamp_head,
    "veach_bidir_spot_cap": spot_cap,
    "cut_glass": cut_glass,
    "pool_water": pool_water,
    "ring": ring,
    "headlight_mirror": headlight_mirror,
    "pebble": pebble,
}


def make_all(folder):
    """Writes every mesh of MESHES into `folder`."""
    for name, make in MESHES.items():
        write_ply(folder / f"{name}.ply", *make())


if __name__ == "__main__":
    command_line.make(__doc__, "meshes", make_all)
