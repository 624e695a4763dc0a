"""Spots so narrow that single precision rounds how their light falls off."""

from __future__ import annotations

import numpy as np
from mitsuba_bdpt.emitters.emitters import Emitters
from mitsuba_bdpt.scene import diagnostics
from mitsuba_bdpt.transport.inputs import Shared

import mitsuba as mi  # isort: skip

from .case import Outcome, of_section

_case = of_section("Transport")

# Degrees. Those below 0.2 are warned of.
ANGLES = (0.05, 0.1, 0.2, 0.3)

# At the largest angle: the most by which light subpaths may differ from `path`.
MOST_APART = 0.005

# Of each angle.
ORIENTATIONS = 16

# Points and directions are one in each of so many cells, squared.
CELLS = 512


def orientations():
    """Transformations: Mitsuba rounds a direction's cosine in another way in each.

    Along an axis, and others at random, at the origin and away from it.
    """
    rng, t = np.random.default_rng(2), mi.ScalarTransform4f()
    found = [t, t.look_at([0, 3, 0], [0, 0, 0], [1, 0, 0])]
    for number in range(2, ORIENTATIONS):
        origin, target = (number % 2) * rng.normal(size=3), rng.normal(size=3)
        found.append(t.look_at(origin.tolist(), target.tolist(), [0, 0, 1]))
    return found


def exact(angle: float) -> float:
    """Light of a spot of intensity 1, over the small angles of its cone.

    1 up to three quarters of the cutoff ``angle`` (radians), from there down to 0 in proportion to the angle.
    """
    beam = 0.75 * angle
    ramp = angle * (angle**2 - beam**2) / 2 - (angle**3 - beam**3) / 3
    return np.pi * beam**2 + 2 * np.pi * ramp / (angle - beam)


def cells() -> np.ndarray:
    """Over the unit square, (2, n), at random within each: a grid and the steps of the cosine do not mix."""
    corners = np.stack(np.meshgrid(np.arange(CELLS), np.arange(CELLS))).reshape(2, -1)
    return (corners + np.random.default_rng(1).random(corners.shape)) / CELLS


def by_next_event(spot, to_world, angle: float) -> float:
    """Light by `sample_direction`, as `path` asks for it, at points a distance of 5 away."""
    u, widest = cells(), 1.05 * angle
    theta, phi = widest * np.sqrt(u[0]), 2 * np.pi * u[1]
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    matrix = np.array(to_world.matrix)
    points = 5 * matrix[:3, :3] @ d + matrix[:3, 3:]
    it = mi.SurfaceInteraction3f()
    it.p = mi.Point3f(points.astype(np.float32))
    _, weight = spot.sample_direction(it, mi.Point2f(0.5), True)
    return float(np.array(weight, dtype=np.float64)[0].mean() * 25 * np.pi * widest**2)


def by_emission(scene) -> float:
    """Light by the plugin's light subpaths."""
    u = mi.Point2f(cells().astype(np.float32))
    like = Shared(mi.Float(0), mi.Color0f(), mi.Spectrum(1), mi.Float(0.5))
    emission = Emitters(scene).sample_emission(u, u, like, mi.Bool(True))
    return float(np.array(emission.weight, dtype=np.float64)[0].mean())


def measured(angle: float) -> tuple[list, list, list]:
    """By how much light of a spot of ``angle`` degrees is off, over all orientations; and what is warned of.

    By how much `path` is off, and by how much light subpaths differ from `path`, as shares.
    """
    off, apart, texts = [], [], []
    for to_world in orientations():
        lamp = {"type": "spot", "cutoff_angle": angle, "to_world": to_world}
        scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "lamp": lamp})
        path = by_next_event(scene.emitters()[0], to_world, np.deg2rad(angle))
        off.append(path / exact(np.deg2rad(angle)) - 1)
        apart.append(by_emission(scene) / path - 1)
        texts += diagnostics.narrow_spots(scene)
    return off, apart, texts


def _range(shares) -> str:
    return f"{100 * min(shares):+.2g} to {100 * max(shares):+.2g} %"


def _narrow() -> Outcome:
    said, ok = [], True
    for angle in ANGLES:
        off, apart, texts = measured(angle)
        ok &= len(texts) == len(off) * (angle < 0.2)
        step_share = 2.0**-24 / (1 - np.cos(np.deg2rad(angle)))
        ok &= max(map(abs, [*off, *apart])) < step_share
        said.append(f"{angle:g} degrees: `path` off by {_range(off)}, light subpaths from it {_range(apart)}")
    ok &= max(map(abs, apart)) < MOST_APART
    return Outcome(bool(ok), "; ".join(said))


CASES = (
    _case(
        "narrow-spots",
        f"spots of cutoff_angle 0.05 to 0.3 degrees in {ORIENTATIONS} orientations; light by next-event "
        "estimation, as in `path`, over the exact value, and by light subpaths over that of `path`",
        "errors below the warning's bound (2^-24 over 1 - cos of the angle, Mitsuba's rounding); a "
        f"warning below 0.2 degrees; at 0.3 the strategies agree to {100 * MOST_APART:g} %",
        _narrow,
        True,
    ),
)
