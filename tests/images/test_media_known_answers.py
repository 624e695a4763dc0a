"""Scenes with participating media whose radiance is known, in closed form or by quadrature.

The statistic is the t-test of the mean over seeds against the known value, with Sidak's correction for the
number of values tested at once (`check`); where nothing is random, the tolerance is that of single precision.
Seeds are fixed. Each is rendered with all strategies, by default and by camera subpaths alone (`WAYS`).
"""

from functools import partial

import media_parts as parts
import mitsuba as mi
import numpy as np
import pytest
import welch as st
from scipy import integrate
from test_known_failures import ball_mesh

# Systematic error that float32 is allowed, relative.
ROUNDING = 5e-5

SEEDS = 12

WAYS = {"all": {"skip": "none"}, "default": {}, "camera": {"light_paths": 0}}

ways = pytest.mark.parametrize("way", WAYS)


check = partial(st.check_known, rounding=ROUNDING)


def render(scene, way, spp, seeds=SEEDS, **parameters):
    """Image means by seed and channel."""
    method = parts.integrator(**WAYS[way], **parameters)
    return parts.images(mi.load_dict(scene), method, spp, 10, seeds).mean((1, 2))


def slab(medium, thickness=1.0, bsdf="null", wide=1e4):
    """Between z = -``thickness`` and 0."""
    to_world = parts.transform().translate([0, 0, -thickness / 2]).scale([wide, wide, thickness / 2])
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": bsdf}, "interior": medium}


def view(mu=1.0, fov=0.01, size=2, distance=3.0, **more):
    """A camera above the slab's middle that looks down at the cosine ``mu`` to the normal."""
    d = np.array([np.sqrt(1 - mu * mu), 0, mu])
    return parts.sensor(
        origin=(d * distance / mu).tolist(),
        target=(0, 0, 0),
        fov=fov,
        size=size,
        near=1e-3,
        far_clip=1e5,
        **more,
    )


# -- transmittance ------------------------------------------------------------------------------------


def absorbing():
    return {
        "gray": (parts.fog(0.7, 0.0), [0.7] * 3),
        "chromatic": (parts.coloured(1.0) | {"albedo": 0.0}, [0.9, 0.4, 0.1]),
        "grid": (parts.grid(np.full((4, 4, 4), 0.5), [-6, -6, -1], [12, 12, 1], 1.4, 0.0), [0.7] * 3),
    }


@ways
@pytest.mark.parametrize("kind", absorbing())
def test_slab_absorbs(kind, way):
    """Rationale: the simplest of all. Under an even sky behind a slab that scatters nothing. Expected: e^-tau
    at the channel's own tau, straight on and at cosine .5. Tolerance: below 1 %, of 12 renders; flights are
    sampled, and only those that collide with nothing see the sky: a channel's variance is e^-tau of its
    square.
    """
    medium, sigma = absorbing()[kind]
    for mu in (1.0, 0.5):
        scene = {
            "type": "scene",
            "sensor": view(mu, size=8),
            "slab": slab(medium, wide=5.0),
            "sky": {"type": "constant", "radiance": 1.0},
        }
        check(render(scene, way, 4096), np.exp(-np.array(sigma) / mu), 0.01)


@ways
@pytest.mark.parametrize("kind", absorbing())
def test_fog_between_a_lamp_and_a_matte_wall(kind, way):
    """Rationale: joins evaluate T where walks sample it. A point lamp at height 1 over the middle of a matte
    plane (reflectance .5), the slab between both, the camera below the slab. Expected: .5 / pi e^-tau where
    the lamp is straight above (fov 0.01 degrees). Tolerance: below 3 %, t-test over 12 renders: homogeneous
    and by camera subpaths alone nothing is random.
    """
    medium, sigma = absorbing()[kind]
    to_world = parts.transform().translate([0, 0, 0.5])
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(1, 0, -1.5), target=(0, 0, -2), fov=0.01, size=2, near=1e-3),
        "slab": slab(medium, wide=5.0),
        "plane": {"type": "rectangle", "to_world": parts.transform().translate([0, 0, -2]).scale(3)}
        | {"bsdf": parts.matte(0.5, 0.5, 0.5)},
        "lamp": {"type": "point", "to_world": to_world, "intensity": 1.0},
    }
    found = render(scene, way, 16384 if kind == "grid" or way != "camera" else 16, max_depth=2)
    check(found, 0.5 / np.pi * np.exp(-np.array(sigma)) / 2.5**2, 0.03)


# -- single scattering --------------------------------------------------------------------------------


@ways
@pytest.mark.parametrize("kind", ["gray", "chromatic"])
def test_slab_under_the_sun(kind, way):
    """Rationale: albedo, phase function and both transmittances of one scattering. Expected, with the
    irradiance E across the light and cosines mu and mu0: albedo rho E mu0 / (mu + mu0) (1 - exp(-tau (1 / mu
    + 1 / mu0))), rho of hg with g = .3 (S. Chandrasekhar, "Radiative Transfer", 1950). Tolerance: below 5 %,
    t-test over 12 renders.
    """
    mu, mu0 = 0.8, 0.6
    medium = parts.fog(0.9, 0.8) if kind == "gray" else parts.coloured(1.0)
    tau, albedo = (0.9, 0.8) if kind == "gray" else (np.array([0.9, 0.4, 0.1]), np.array([0.5, 0.8, 0.95]))
    light = np.array([np.sqrt(1 - mu0 * mu0), 0.0, -mu0])
    scene = {
        "type": "scene",
        "sensor": view(mu, fov=0.5, size=1),
        "slab": slab(medium, wide=8.0),
        "sun": {"type": "directional", "direction": light.tolist(), "irradiance": 2.0},
    }
    out = np.array([np.sqrt(1 - mu * mu), 0, mu])
    method = parts.integrator(max_depth=2, **WAYS[way])
    found = parts.images(mi.load_dict(scene), method, 1 << 14, 10, SEEDS).mean((1, 2))
    cos, g = out @ light, 0.3
    rho = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cos) ** 1.5)
    expected = albedo * rho * 2 * mu0 / (mu + mu0) * (1 - np.exp(-tau * (1 / mu + 1 / mu0)))
    check(found, expected * np.ones(3), 0.05)


def foggy_lamp(h, sigma, albedo):
    """A point lamp in endless fog, seen along a ray at the distance ``h``, with no shape at all."""
    eye = parts.sensor(
        origin=(h, 0, 1),
        target=(h, 0, 0),
        fov=0.05,
        size=1,
        near=1e-3,
        medium=parts.fog(sigma, albedo, 0.0),
        far_clip=1e4,
    )
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": 3.0}
    return {"type": "scene", "sensor": eye, "lamp": lamp}


def test_fog_without_shapes():
    """Rationale: the box around no shapes is empty. Expected: an image, and no warning."""
    scene = mi.load_dict(foggy_lamp(0.3, 0.6, 0.7))
    image = mi.render(scene, integrator=parts.integrator(max_depth=2), spp=64)
    assert np.isfinite(np.array(image)).all() and np.array(image).mean() > 0


@ways
def test_airlight(way):
    """Rationale: a point lamp in fog with sensor and lamp in the medium, and a speck far from both. Expected:
    along a ray at the distance h = .3 from the lamp, sigma_s rho I int e^(-sigma (t + d)) / d^2 dt, by
    quadrature. Tolerance: below 5 %, t-test over 12 renders of a pixel of 0.05 degrees.
    """
    sigma, albedo, h, near = 0.6, 0.7, 0.3, 1e-3  # the fog begins at the near plane
    speck = parts.ball(parts.matte(0, 0, 0), 1e-3, (3, 0, 0))
    scene = foggy_lamp(h, sigma, albedo) | {"speck": speck}

    def along(t):
        d2 = h * h + (1 - t) ** 2
        return sigma * albedo / (4 * np.pi) * 3.0 * np.exp(-sigma * (t - near + np.sqrt(d2))) / d2

    expected, _ = integrate.quad(along, near, 60, points=[1.0], limit=400)
    check(render(scene, way, 1 << 15, max_depth=2), expected, 0.05)


def lit_ball(sigma, albedo, n=4_000_000):
    """Radiance by one scattering in a null ball that a spherical lamp of radiance (5, 4, 3) lights, image
    mean.

    Monte Carlo in float64: rays of the film, distances evenly along chords, directions evenly in the lamp's
    cone. Returns it over the lamp's radiance, and its standard error.
    """
    rng = np.random.default_rng(1)
    o, target = np.array([0.1, -0.05, 0.5]), np.array([0, 0, -1.0])
    c, r, lc, lr = np.array([-0.35, -0.25, -0.25]), 0.3, np.array([0.25, 0.3, -0.2]), 0.2
    forward = (target - o) / np.linalg.norm(target - o)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    x, y = rng.uniform(-1, 1, (2, n, 1)) * np.tan(np.deg2rad(30))
    d = forward + x * right + y * np.cross(right, forward)
    d /= np.linalg.norm(d, axis=1, keepdims=True)

    def chord(p, d, c, r):
        b = ((c - p) * d).sum(1)
        q = b * b - ((c - p) ** 2).sum(-1) + r * r
        return b - np.sqrt(np.maximum(q, 0)), b + np.sqrt(np.maximum(q, 0)), q > 0

    near, far, meets = chord(o, d, c, r)
    before, _, blocked = chord(o, d, lc, lr)
    meets &= ~(blocked & (before < near))
    t = near + (far - near) * rng.random(n)
    p = o + t[:, None] * d
    w = lc - p
    distance = np.linalg.norm(w, axis=1)
    w /= distance[:, None]
    cone = np.sqrt(1 - (lr / distance) ** 2)
    cos = 1 - rng.random(n) * (1 - cone)
    u = np.cross(np.where(np.abs(w[:, :1]) > 0.5, [[0.0, 1, 0]], [[1.0, 0, 0]]), w)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    phi = 2 * np.pi * rng.random((n, 1))
    sin = np.sqrt(1 - cos * cos)[:, None]
    wo = cos[:, None] * w + sin * (np.cos(phi) * u + np.sin(phi) * np.cross(w, u))
    _, out, _ = chord(p, wo, c, r)
    value = meets * sigma * albedo * np.exp(-sigma * (t - near + out)) * (far - near) * (1 - cone) / 2
    return value.mean(), value.std() / np.sqrt(n)


def test_fog_lit_by_a_lamp():
    """Rationale: a null ball of fog under a lamp with an area, which phase function samples hit through the
    boundary. `volpath` of Mitsuba 3.9.1 is .6 % too dark there (1.2 % with a grid), so that it cannot judge.
    Expected: the image's mean by one scattering is that of `lit_ball` (standard error .15 %), with all
    strategies and by camera subpaths alone. Tolerance: their difference is below 4.5 standard errors of both,
    1 % at most (3 % by default).
    """
    scene = parts.room(sensor_of(), ball=parts.ball(interior=parts.fog(4, 0.9, 0.0)))
    scene["wall"] = parts.wall(bsdf=parts.matte(0, 0, 0))
    scene = mi.load_dict(scene)
    expected, error = lit_ball(4, 0.9)
    for way in WAYS:

        def mean(depth, way=way):
            method = parts.integrator(max_depth=depth, **WAYS[way])
            return parts.images(scene, method, 512, 10, SEEDS)[..., 0].mean((1, 2)) / 5

        found = mean(2) - mean(1)
        reach = 4.5 * np.hypot(error, found.std(ddof=1) / SEEDS**0.5)
        assert abs(found.mean() - expected) < reach < (0.03 if way == "default" else 0.01) * expected, way


def sensor_of():
    return parts.sensor(near=0.05)


# -- all orders of scattering -------------------------------------------------------------------------


@ways
@pytest.mark.parametrize("kind", ["gray", "chromatic", "grid", "glass"])
def test_white_furnace(kind, way):
    """Rationale: whatever scatters without loss is invisible in an even light. A ball (box) of albedo 1 under
    a sky of radiance 1, hg with g = .3; glass around it; chromatic extinction. Expected: 1 in the image and
    in its quarters. Tolerance: below 2 % (quarters 7 %), t-test over 12 renders.
    """
    media = {
        "gray": parts.fog(4, 1.0),
        "glass": parts.fog(4, 1.0),
        "chromatic": parts.coloured(8.0) | {"albedo": 1.0},
        "grid": parts.grid(np.random.default_rng(0).random((5, 5, 5)), [-0.5] * 3, 1.0, 8.0, 1.0),
    }
    shape = parts.ball("dielectric" if kind == "glass" else "null", 0.6, (0, 0, 0), interior=media[kind])
    if kind == "grid":
        shape = parts.box([-0.5] * 3, 1.0, interior=media[kind])
    scene = {
        "type": "scene",
        "sensor": parts.sensor(origin=(0, 0.3, 3), target=(0, 0, 0), fov=25, size=8),
        "shape": shape,
        "sky": {"type": "constant", "radiance": 1.0},
    }
    images = parts.images(mi.load_dict(scene), parts.integrator(**WAYS[way], max_depth=256), 256, 10, SEEDS)
    check(images.mean((1, 2)), 1.0, 0.02)
    check(images.reshape(SEEDS, 2, 4, 2, 4, 3).mean((2, 4)), 1.0, 0.07)


@ways
def test_glowing_sphere_filled_with_fog(way):
    """Rationale: as in `test_known_answers.py`, in fog, with roulette and unlimited depth. A closed sphere of
    reflectance 1/2 that emits 1/2, filled with fog of albedo 1. Expected: 1 everywhere, as without fog.
    Tolerance: below 1 %, t-test over 12 renders.
    """
    glowing = parts.wall(bsdf=parts.matte(0.5, 0.5, 0.5), emitter={"type": "area", "radiance": 0.5})
    scene = {"type": "scene", "sensor": parts.sensor(medium=parts.fog(1.5, 1.0)), "wall": glowing}
    check(render(scene, way, 256, rr_depth=5), 1.0, 0.01)


@pytest.mark.parametrize("kind", ["mesh", "cube", "rectangles"])
def test_glowing_walls_that_bound_fog(kind, tmp_path):
    """Rationale: the medium that light starts in is that on its side of the wall, by the geometric normal of
    hits. Samples report another one on meshes with interpolated normals that are flipped, and on mirrored
    cubes and rectangles. Black walls of radiance 1, seen from within, around fog of albedo 1; thin fog that
    only absorbs is on their other side. Expected, with all strategies: 1 everywhere; light that starts in the
    other medium leaves 0.6. Tolerance: below 2 %, t-test over 12 renders (the interval reaches 0.8 to 1 %).
    """
    mirrored = parts.transform().scale([-1, 1, 1])
    glowing = {"bsdf": parts.matte(0, 0, 0), "emitter": {"type": "area", "radiance": 1.0}}
    inside, outside = ({"type": "ref", "id": name} for name in ("inside", "outside"))
    if kind == "mesh":
        mesh = ball_mesh(tmp_path / "ball.ply", 4)
        walls = {"wall": mesh | glowing | {"flip_normals": True, "exterior": inside, "interior": outside}}
    elif kind == "cube":
        cube = {"type": "cube", "to_world": mirrored, "flip_normals": True}
        walls = {"wall": cube | glowing | {"exterior": outside, "interior": inside}}
    else:
        turns = [([0, 1, 0], angle) for angle in (0, 90, 180, 270)] + [([1, 0, 0], 90), ([1, 0, 0], 270)]
        walls = {
            f"wall {i}": glowing
            | {
                "type": "rectangle",
                "to_world": parts.transform().rotate(*turn).translate([0, 0, -1]) @ mirrored,
                "interior": inside,
                "exterior": outside,
            }
            for i, turn in enumerate(turns)
        }
    media = {"inside": parts.fog(1.5, 1.0, id="inside"), "outside": parts.fog(0.05, 0.0, id="outside")}
    scene = {"type": "scene", **media, "sensor": parts.sensor(medium=inside, size=8), **walls}
    check(render(scene, "all", 256, max_depth=64), 1.0, 0.02)


def coloured_grid():
    """A grid of even extinction .9, .4, .1 (per channel) around the unit sphere."""
    values = np.broadcast_to(np.float32([0.9, 0.4, 0.1]), (2, 2, 2, 3))
    medium = parts.grid(np.zeros((2, 2, 2)), [-1.1] * 3, 2.2, 1.0, 0.0)
    medium["sigma_t"] |= {"raw": True, "grid": mi.VolumeGrid(np.ascontiguousarray(values))}
    return medium


def spiky_grid():
    """A grid whose mean extinction is a ninth of its majorant, which T~ must not take for it."""
    values = np.random.default_rng(1).random((6, 6, 6)) ** 8
    return parts.grid(values, [-1.1] * 3, 2.2, 9.0, 1.0)


ABSORBED = np.exp([-0.9, -0.4, -0.1])
METERS = {
    "gray": (lambda: parts.fog(1.0, 1.0), 1.0),
    "chromatic": (lambda: parts.coloured(1.0) | {"albedo": 1.0}, 1.0),
    "chromatic, absorbing": (lambda: parts.coloured(1.0) | {"albedo": 0.0}, ABSORBED),
    "grid": (lambda: parts.grid(np.full((2, 2, 2), 1.0), [-1.1] * 3, 2.2, 1.0, 1.0), 1.0),
    "coloured grid": (coloured_grid, ABSORBED),
    "spiky grid": (spiky_grid, 1.0),
}


@pytest.mark.parametrize("way", ["all", "default"])
@pytest.mark.parametrize("kind", METERS)
def test_meter_in_fog(kind, way):
    """Rationale: t = 0 and the last edge of light subpaths, which ends before the flight does (in coloured
    grids there is none). A point lamp in fog within a black unit sphere, which is an irradiance meter.
    Expected: with albedo 1 intensity / radius^2, of light that scatters any number of times (which camera
    subpaths alone cannot find: e^-1 of it comes straight); with albedo 0 times the transmittance. Tolerance:
    below 2 %, t-test over 12 renders.
    """
    medium, expected = METERS[kind]
    film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    meter = {"type": "irradiancemeter", "film": film | {"component_format": "float32"}, "medium": medium()}
    scene = {
        "type": "scene",
        "wall": parts.wall(bsdf=parts.matte(0, 0, 0), sensor=meter),
        "lamp": {"type": "point", "position": [0, 0, 0], "intensity": 1.0},
    }
    check(render(scene, way, 1 << 15), expected, 0.02)


def chandrasekhar(albedo, mu, n=64):
    """1 - sqrt(1 - albedo) H(mu): what a half space that scatters evenly reflects of an even light.

    H of isotropic scattering by iteration of 1 / H(mu) = sqrt(1 - a) + a / 2 int x H(x) / (mu + x) dx
    (S. Chandrasekhar, "Radiative Transfer", 1950, section 37).
    """
    x, w = np.polynomial.legendre.leggauss(n)
    x, w = (x + 1) / 2, w / 2
    h = np.ones(n)
    root = np.sqrt(1 - albedo)
    for _ in range(500):
        h = 1 / (root + albedo / 2 * ((w * x * h) / (x[:, None] + x)).sum(1))
    return 1 - root / (root + albedo / 2 * (w * x * h / (mu + x)).sum())


@ways
@pytest.mark.parametrize("mu", [1.0, 0.5])
def test_half_space(mu, way):
    """Rationale: many scatterings, in closed form. A slab of optical thickness 50 and albedo .8, isotropic,
    under an even sky. Expected: Chandrasekhar's 1 - sqrt(1 - albedo) H(mu); the slab's far side is e^-50
    away. Tolerance: below 1.5 %, t-test over 12 renders.
    """
    scene = {
        "type": "scene",
        "sensor": view(mu, size=4),
        "slab": slab(parts.fog(50, 0.8, 0.0), wide=100.0),
        "sky": {"type": "constant", "radiance": 1.0},
    }
    check(render(scene, way, 1024, max_depth=200), chandrasekhar(0.8, mu), 0.015)


def test_white_slab_reflects_what_it_does_not_transmit():
    """Rationale: energy. A slab of albedo 1 under a lid of radiance 1 that covers all directions above it;
    below all is black. Seen from above and from below at one cosine. Expected: by reciprocity both sum to 1
    (5e-4 of it leaves at the edges, in `volpath` too). Tolerance: below 1 %, t-test over 12 renders of each.
    """
    lid = {
        "type": "rectangle",
        "to_world": parts.transform().translate([0, 0, 4]).rotate([1, 0, 0], 180).scale(1000),
        "bsdf": parts.matte(0, 0, 0),
        "emitter": {"type": "area", "radiance": 1.0},
    }
    medium = slab(parts.fog(1.5, 1.0), wide=100.0)
    found = []
    for side in (1, -1):
        d = np.array([0.6, 0, 0.8 * side])
        eye = parts.sensor(origin=(d * 3.5).tolist(), target=(0, 0, 0), fov=0.01, size=4, near=1e-3)
        scene = {"type": "scene", "sensor": eye, "slab": medium, "lid": lid}
        found.append(render(scene, "camera", 4096, max_depth=200))
    check(sum(found).mean(1) / (1 - 5e-4), 1.0, 0.01)
