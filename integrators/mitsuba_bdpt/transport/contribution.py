"""Contributions of strategies, and the counters of lanes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..emitters.records import Cell
from . import spectra
from .inputs import TraceContext
from .vacuum import ShadowRay

LEAST_SURVIVAL = 2.0**-20  # least survival probability of roulette: random numbers are multiples of 2^-24


@dataclass
class Counters:
    """Counters of a lane (``UInt32``); None if not counted, at no cost.

    * Closest hits of ``camera`` and ``light`` subpaths; shadow rays of s = 1, t = 1 and (1,1), inner ones.
    * Inner connections: ``evaluated``, of these ``zero``; ``rouletted`` (splats too) have no ray.
    * ``non_finite``: values that count as zero: contributions (s = 1 and t <= 1 if visible, inner ones before
      visibility), subpaths that end with a non-finite throughput, colours, features.
    * With media ``segments`` of edges and connections, with a ray each; tentative ``collisions`` in grids.
    * With merging or guiding closest hits of photon subpaths (``photon``), stored ``photons``; with merging
      ``merges``, camera vertices near a photon; with guiding all rays of guided subpaths (``guided``).

    Records are added, never changed: Dr.Jit's loops would not see it.
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
    guided: mi.UInt32 | None = None

    @staticmethod
    def zeros(*names: str) -> Counters:
        """Counters of these ``names`` at 0; loops store only counters that they change."""
        return Counters(**{name: mi.UInt32(0) for name in names})

    def __add__(self, other: Counters) -> Counters:
        def added(a, b):
            return b if a is None else a if b is None else a + b

        return Counters(*(added(getattr(self, name), getattr(other, name)) for name in COUNTERS))

    def summed(self) -> mi.UInt64:
        """Sum over lanes: ``UInt64``, in the order of `COUNTERS`."""
        total = dr.zeros(mi.UInt64, len(COUNTERS))
        for i, name in enumerate(COUNTERS):
            if (value := getattr(self, name)) is not None:
                dr.scatter_reduce(
                    dr.ReduceOp.Add, total, mi.UInt64(value), mi.UInt32(i), mode=dr.ReduceMode.Expand
                )
        return total


MEDIA = ("segments", "collisions")  # counters of edges in media
MERGING = ("photons", "merges")  # counters of merging besides rays

COUNTERS = tuple(field.name for field in fields(Counters))


def one(mask: mi.Bool) -> mi.UInt32:
    """1 in lanes where ``mask`` holds, else 0."""
    return dr.select(mask, mi.UInt32(1), mi.UInt32(0))


def counted_by_light(kernel: TraceContext) -> Counters:
    """Counters of the vertices of light subpaths."""
    plan = kernel.plan
    names = ["shadow_t1"] * plan.splat + ["rouletted"] * (plan.splat and plan.roulette)
    names += ["non_finite"] * (plan.splat or plan.arrival)
    return Counters.zeros(*names, *kernel.space.counters)


def counted_by_camera(kernel: TraceContext) -> Counters:
    """Counters of the vertices of camera subpaths."""
    plan = kernel.plan
    one, inner = plan.connections == "one", plan.connections != "none"
    names = ["non_finite"] + ["shadow_s1"] * plan.direct + ["rouletted"] * (one and plan.roulette)
    names += ["shadow_inner", "evaluated", "zero"] * inner
    return Counters.zeros(*names, *kernel.space.counters, *kernel.sds.counters)


@dataclass
class Contribution:
    """Estimate of one strategy.

    ``value``: unweighted spectrum; ``weight`` in [0, 1]; ``s``, ``t``: numbers of light and camera vertices;
    ``shares``: see `mis.ByClass`; ``kind``: class in `mis.CLASSES`, or ``merge``; ``position`` on the film in
    pixels, None for the lane's own pixel (t >= 2); ``counted``: `Counters`. With media ``value`` and
    ``weight`` exclude the connected edge until its ``shadow_ray`` is traced (`seen`), for which ``sides`` are
    the arguments of `mis.Heuristic.weigh`. ``emission``: of `TraceContext.cells`, for pilots. ``towards``:
    direction in which light reaches the sensor, None for t >= 2 (`CameraStart`). ``light_group`` of y_0,
    ``path_layer`` of the path (see `path_layers`), None without such layers.
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
    light_group: mi.UInt32 | None = None
    path_layer: mi.UInt32 | None = None
    shadow_ray: ShadowRay | None = None

    @property
    def layers(self) -> tuple[mi.UInt32, ...]:
        """Its layer in each partition of the image, in the order of the film."""
        return tuple(index for index in (self.light_group, self.path_layer) if index is not None)

    def weighted(self) -> mi.Spectrum:
        """The weighted contribution to the image."""
        return dr.select(self.active, self.value * self.weight, 0)


def seen(kernel: TraceContext, c: Contribution) -> Contribution:
    """``c`` after its shadow ray, if any; all contributions pass here before the sink."""
    return drop_non_finite(c if c.shadow_ray is None else kernel.space.seen(kernel, c))


def drop_non_finite(c: Contribution) -> Contribution:
    """Deactivate and count non-finite contributions, as densities from which no weight follows make them."""
    lost = c.active & ~spectra.is_finite(c.value * c.weight)
    return replace(c, active=c.active & ~lost, counted=c.counted + Counters(non_finite=one(lost)))


def roulette(
    kernel: TraceContext, value: mi.Spectrum, u: mi.Float, active: mi.Bool
) -> tuple[mi.Bool, mi.Float, Counters]:
    """Roulette on a weighted contribution; returns the survival mask, its probability, and `Counters`."""
    if not kernel.plan.roulette:
        return active, mi.Float(1), Counters()
    size = size_of(value)
    # At least the spacing of the random numbers; NaN survives.
    survival = dr.clip(size * kernel.inverse_threshold, LEAST_SURVIVAL, 1)
    survival = dr.select(dr.isfinite(size), survival, 1)
    survived = u < survival
    return active & survived, survival, Counters(rouletted=one(active & ~survived))


# Size of a contribution; any measure works that is positive where f is.
size_of = spectra.brightest
