"""SDS paths by vertex merging and guided s = 0: their lengths, weights and photons where others differ.

The scenes of `test_merging` have paths of an even number of edges, one diffuse vertex on each SDS path, and
discs of nearly one size.
"""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.merging import merging, passes
from mitsuba_bdpt.merging.radius import MEAN_FREE_PATHS, Balls, Footprints
from mitsuba_bdpt.sampling import sobol
from mitsuba_bdpt.transport.photons import photon_guide
from mitsuba_bdpt.transport.photons.photon import Photon
from sds_scenes import ball, images, matte, point, transform, under_glass
from snapshots import ROUNDING

import scenes
from scenes import area, square

import drjit as dr  # isort: skip


def through_the_plate(lamp):
    """The camera sees the floor through the plate: paths of six edges."""
    return under_glass(lamp)


def by_a_mirror(lamp):
    """The camera is below the plate and sees the floor in a mirror alone: paths of five edges."""
    to_world = transform().translate([-1.5, 0, 0.2]).rotate([0, 1, 0], 90).scale([0.2, 1, 1])
    mirror = {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "conductor"}}
    scene = under_glass(lamp, mirror=mirror)
    scene["sensor"] = scenes.camera(origin=(0, 0, 0.3), target=(-1.5, 0, 0.3), fov=16, size=16)
    return scene


@pytest.mark.parametrize(
    "lamp, way", [(point(), {"merging": True}), (ball(), {"guiding": "always"})], ids=["merging", "guided"]
)
@pytest.mark.parametrize(
    "described, edges", [(through_the_plate, 6), (by_a_mirror, 5)], ids=["plate", "mirror"]
)
def test_no_path_is_longer_than_max_depth(described, edges, lamp, way):
    """The edges of a merged path are those of a photon and of a camera vertex, those of a guided path those
    of two subpaths. With ``max_depth`` one less than the shortest SDS path the image of the same seed without
    merging and guiding, to the rounding of sums; another one from there on."""
    scene = mi.load_dict(described(lamp))
    for depth in (edges - 1, edges):
        settings = {"max_depth": depth, "skip": "impossible"}
        a = images(scene, 16, 1, merges=depth == edges, **settings, **way)
        b = images(scene, 16, 1, **settings, guiding="emission", merging=False)
        assert np.allclose(a, b, **ROUNDING) == (depth < edges)


def random_photons(count, volume):
    """Photons of random flux between -4 and 4, on the floor z = 0 or in a ``volume``, as arrays."""
    rng = np.random.default_rng(1)
    found = Photon.zeros(count, media=volume)
    found.p = mi.Point3f(*rng.uniform(-4, 4, (2, count)), rng.uniform(-4, 4, count) * volume)
    found.n = mi.Normal3f(dr.zeros(mi.Float, count), 0, 0 if volume else 1)
    found.flux = mi.Spectrum(mi.Float(rng.exponential(size=count)))
    found.edges = mi.UInt32(1 + rng.integers(0, 4, count).astype(np.uint32))
    found.lane = dr.arange(mi.UInt32, count)
    found.medium = dr.full(mi.UInt32, 1, count) if volume else None
    return found


@pytest.mark.parametrize("volume", [False, True])
def test_all_photons_of_a_disc_are_found(volume):
    """Photons lie in grids whose cells double in size with the radius, and a disc or ball meets photons of
    several grids where the radius grows quickly. The total flux in each of 4,096 is that of a search among
    all photons, up to the paths' length, and the mean flux of those drawn by flux has a standard error of
    1 %; the photons of a hundred at least are of two grids."""
    n, most = 4096, 5
    radius = Footprints((0.0, 0.0, 0.3), 0.0, 0.1, 0.2).radius(4.0)
    found = random_photons(n, volume)
    balls = Balls(radius, SimpleNamespace(mean=lambda medium: mi.Float(0.02))) if volume else None
    of_pass = merging.Merging(radius, mi.Float(n), mi.Float(1), balls=balls)
    of_pass.photons = passes.sort(of_pass, found, n)
    rng = np.random.default_rng(2)
    p, edges = rng.uniform(-3, 3, (3, n)), rng.integers(1, 4, n)
    p[2] *= volume
    z = SimpleNamespace(
        si=SimpleNamespace(p=mi.Point3f(*p), n=mi.Normal3f(dr.zeros(mi.Float, n), 0, 0 if volume else 1)),
        edges=mi.UInt32(edges.astype(np.uint32)),
        anchor=SimpleNamespace(offset=mi.Float(0)),
        volume=mi.Bool(volume),
        medium=mi.UInt32(1) if volume else None,
    )
    word = sobol.mix(dr.arange(mi.UInt32, n))
    chosen, total = merging._draw(of_pass, z, dr.opaque(mi.UInt32, most) - z.edges, word, None)

    off = np.array(found.p)[:, None, :] - p[:, :, None]
    r = 1 / (1 / np.array(radius.at(z.si.p)) + 0.02 / MEAN_FREE_PATHS * volume)
    near = (off**2).sum(0) < r[:, None] ** 2
    near &= np.array(found.edges) + edges[:, None] <= most
    flux, total = np.array(found.flux)[0], np.array(total)
    np.testing.assert_allclose(total, near @ flux, rtol=1e-4)
    drawn = np.array(of_pass.photons.found.lane)[chosen][total > 0]
    assert near[total > 0, drawn].all()
    expected = (near @ flux**2)[total > 0] / total[total > 0]
    assert flux[drawn].mean() == pytest.approx(expected.mean(), rel=0.05)
    level = np.array(merging.level_of(radius, radius.at(found.p)))
    assert sum(len(set(level[row])) > 1 for row in near) > 100

    width = 1.1 * r[:, None]  # cells that a flat disc or a ball overlaps, no others
    first, cells = merging._overlapped(z, mi.Float(r), mi.Float(1.1 * r))
    low = (np.array(first)[..., None] + np.mgrid[:3, :3, :3][::-1].reshape(3, 1, 27)) * width
    away = p[..., None] - np.clip(p[..., None], low, low + width)
    overlapped = (away**2).sum(0) <= r[:, None] ** 2
    overlapped &= volume | (np.abs(low[2] + width / 2 - p[2][:, None]) <= 0.25 * r[:, None] + width / 2)
    assert (overlapped == (np.array(cells)[:, None] >> np.arange(27) & 1)).mean() > 0.9999


def lit_by_a_wall():
    """A floor that a lamp lights by a wall, and a wide lens above it; surfaces between all of these.

    The lamp does not shine at the floor and the lens does not see the wall, so that the SDS paths of seven
    edges, all that there are, have two diffuse vertices. The surfaces are delta ones that change nothing.
    """

    clear = {"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0}
    lens = {"size": 4, "aperture_radius": 0.8, "focus_distance": 1.2}
    lamp = square([0, 0, 1.7], ([0, 1, 0], -90), 0.5, matte(0.0))
    parts = {
        "wall": square([-1, 0, 1.5], ([0, 1, 0], 90), 1.5, matte(0.9)),
        "before the wall": square([-0.9, 0, 1.5], ([0, 1, 0], 90), 3, clear),
        "lamp": lamp | {"emitter": area(10.0)},
        "floor": square([1, 0, 0], ([0, 0, 1], 0), 1, matte(0.9)),
        "above the floor": square([2, 0, 0.1], ([0, 0, 1], 0), 2.8, clear),
        "sensor": scenes.camera("thinlens", origin=(1, 0, 1.2), target=(1, 0, 0), **lens),
    }
    return mi.load_dict({"type": "scene", **parts})


def test_light_subpaths_with_two_diffuse_vertices(monkeypatch):
    """Guided s = 0 makes a path at the last vertex from the camera whose event is not delta, so of the
    diffuse vertices of a light subpath t = 0 has to count it at the first alone. The guide makes directions
    at the floor alone, where none of them leads to the lamp, and t = 0 has a third of the weight: the image
    of the same seed without guiding, to the rounding of sums."""

    def draw(guide, p, found, u1, u2):
        return mi.warp.square_to_uniform_sphere(u2), p.x > -0.5

    def density(guide, p, found, d, lobes=None):
        return dr.select(p.x > -0.5, dr.inv_four_pi, 0)

    scene = lit_by_a_wall()
    settings = {"skip": "none", "max_depth": 7}
    expected = images(scene, 256, 1, guiding="emission", **settings)
    monkeypatch.setattr(photon_guide, "draw", draw)
    monkeypatch.setattr(photon_guide, "density", density)
    found = images(scene, 256, 1, guiding="always", **settings)
    np.testing.assert_allclose(found, expected, **ROUNDING)
    assert (expected > 0).sum() > 8
