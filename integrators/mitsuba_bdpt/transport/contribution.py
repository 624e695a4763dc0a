"""What a strategy returns: its estimate and its weight; and what the lanes of a kernel count."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..emitters.emission_tables import Cell
from ..media.media import Space
from . import spectra
from .inputs import Kernel
from .plan import Plan

# Least probability of surviving roulette: random numbers are multiples of 2^-24.
LEAST_SURVIVAL = 2.0**-20


@dataclass
class Counters:
    """Numbers (``UInt32``) of what a lane has done; None for what is not counted, which costs nothing.

    Rays by kind: closest hits of ``camera`` and ``light`` subpaths, shadow rays of s = 1, t = 1 (with (1,1))
    and inner connections. Inner connections by what became of them: ``evaluated``, of these ``zero``;
    ``rouletted`` (splats too) have no ray. ``non_finite``: values that count as zero because they are not
    finite: contributions (those of s = 1 and t <= 1 if they are visible, inner ones before it is known),
    subpaths that end for want of a finite throughput, colours, features. In scenes with media ``segments``
    of edges, those of joins included, each with a ray of its own, and tentative ``collisions`` in grids.
    With merging closest hits of photons' subpaths (``photon``), the ``photons`` kept, and the ``merges``:
    camera vertices near to some. Where s = 0 is guided the same of photons, the camera vertices where it was
    (``aimed``), and the closest hits that followed (``guided``).

    Records are added up, never changed: Dr.Jit's loops would not see it.
    """

    camera: mi.UInt32 | None = None
    light: mi.UInt32 | None = None
    shadow_s1: mi.UInt32 | None = None
    shadow_t1: mi.UInt32 | None = None
    shadow_inner: mi.UInt32 | None = None
    evaluated: mi.UInt32 | None = None
    zero: mi.UInt32 | None = None
    rouletted: mi.UInt32 | None = None
    non_finite: mi.UInt32 | None = None
    segments: mi.UInt32 | None = None
    collisions: mi.UInt32 | None = None
    photon: mi.UInt32 | None = None
    photons: mi.UInt32 | None = None
    merges: mi.UInt32 | None = None
    aimed: mi.UInt32 | None = None
    guided: mi.UInt32 | None = None

    @staticmethod
    def zeros(*names: str) -> Counters:
        """Counters of these ``names`` at 0. Loops hold only those that they change, see `Walk`."""
        return Counters(**{name: mi.UInt32(0) for name in names})

    def __add__(self, other: Counters) -> Counters:
        def added(a, b):
            return b if a is None else a if b is None else a + b

        return Counters(*(added(getattr(self, name), getattr(other, name)) for name in COUNTERS))

    def summed(self) -> mi.UInt64:
        """The lanes' counters added up: ``UInt64``, in the order of `COUNTERS`."""
        total = dr.zeros(mi.UInt64, len(COUNTERS))
        for i, name in enumerate(COUNTERS):
            if (value := getattr(self, name)) is not None:
                dr.scatter_reduce(
                    dr.ReduceOp.Add, total, mi.UInt64(value), mi.UInt32(i), mode=dr.ReduceMode.Expand
                )
        return total


# What edges through media count.
MEDIA = ("segments", "collisions")

# What merging counts, beside its rays.
MERGING = ("photons", "merges")

COUNTERS = tuple(field.name for field in fields(Counters))


def one(mask: mi.Bool) -> mi.UInt32:
    """1 in lanes where ``mask`` holds, else 0."""
    return dr.select(mask, mi.UInt32(1), mi.UInt32(0))


def counted_in_media(space: Space | None) -> list[str]:
    """The names of what edges through media count in this scene: collisions where there are grids."""
    return [] if space is None else list(MEDIA if space.media.grids else MEDIA[:1])


def counted_by_light(plan: Plan, space: Space | None) -> Counters:
    """What the vertices of light subpaths count."""
    names = ["shadow_t1"] * plan.splat + ["rouletted"] * (plan.splat and plan.roulette)
    names += ["non_finite"] * (plan.splat or plan.arrival)
    return Counters.zeros(*names, *counted_in_media(space) * plan.splat)


def counted_by_camera(plan: Plan, space: Space | None) -> Counters:
    """What the vertices of camera subpaths count."""
    one, inner = plan.connections == "one", plan.connections != "none"
    names = ["non_finite"] + ["shadow_s1"] * plan.direct + ["rouletted"] * (one and plan.roulette)
    names += ["shadow_inner", "evaluated", "zero"] * inner
    return Counters.zeros(*names, *counted_in_media(space) * (plan.direct or inner))


@dataclass
class Contribution:
    """An estimate of one strategy.

    ``value`` unweighted (a spectrum), ``weight`` in [0, 1], numbers of light vertices ``s`` and camera
    vertices ``t``, ``active``; ``shares`` see `mis.ByClass`, ``kind`` the class among `mis.CLASSES`;
    ``position`` on the film in pixels, None where it adds to the lane's own pixel (t >= 2); ``counted`` what
    was done for it. In scenes with media ``value`` and ``weight`` are those of an edge without any until
    `visibility.seen` has looked; it needs the ``sides``: what `mis.Heuristic.weigh` takes. ``emission``: what
    `Emitters.cell` says of the path, where a pilot asks for it. ``towards``: the direction in which the light
    reaches the sensor, None for t >= 2, which know it by their `CameraStart`.
    """

    value: mi.Spectrum
    weight: mi.Float
    s: mi.UInt32
    t: mi.UInt32
    active: mi.Bool
    shares: mi.Vector4f | None = None
    kind: str = ""
    position: mi.Point2f | None = None
    counted: Counters = field(default_factory=Counters)
    sides: Any = None
    emission: Cell | None = None
    towards: mi.Vector3f | None = None

    def weighted(self) -> mi.Spectrum:
        """What the strategy adds to the image."""
        return dr.select(self.active, self.value * self.weight, 0)


def drop_non_finite(c: Contribution) -> Contribution:
    """``c``, inactive where it adds no finite value, which is counted: such a contribution counts as zero.

    All contributions pass here on their way to the sink; whatever finds a density from which no weight
    follows makes the value NaN.
    """
    lost = c.active & ~spectra.is_finite(c.value * c.weight)
    return replace(c, active=c.active & ~lost, counted=c.counted + Counters(non_finite=one(lost)))


def roulette(
    kernel: Kernel, value: mi.Spectrum, u: mi.Float, active: mi.Bool
) -> tuple[mi.Bool, mi.Float, Counters]:
    """Unbiased roulette on a weighted contribution before its visibility is tested.

    Returns where it survived, the probability of that, and `Counters`."""
    if not kernel.plan.roulette:
        return active, mi.Float(1), Counters()
    size = size_of(value)
    # Not below the spacing of the random numbers, which are 0 more often than that; NaN goes on.
    survival = dr.clip(size * kernel.inverse_threshold, LEAST_SURVIVAL, 1)
    survival = dr.select(dr.isfinite(size), survival, 1)
    survived = u < survival
    return active & survived, survival, Counters(rouletted=one(active & ~survived))


def size_of(value: mi.Spectrum):
    """A measure of a contribution's size; any will do as long as it is positive where f is."""
    return spectra.brightest(value)
