"""What a kernel is given besides its batch: scene, strategies in use, coefficients, limits, an observer."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..sampling.points import Points
from ..settings import MAX_STORED, Settings
from . import mis
from .plan import Plan

# Sizes of the lanes' local memory. On CPUs they do not matter for speed; few of them make few kernels.
STORE_SIZES = (64, 256, MAX_STORED)

# In scenes with media, so many vertices of a light subpath are kept at most; see `light_path.Thinning`.
KEPT = 64


@dataclass
class Coefficients:
    """kappa of each class of strategies, with which it enters all weights, see `plan.Plan`.

    The Python number 0 for classes that are not in use.
    """

    hit: mi.Float | mi.Vector4f | int
    direct: mi.Float | mi.Vector4f | int
    splat: mi.Float | mi.Vector4f | int
    endpoints: mi.Float | mi.Vector4f | int
    arrival: mi.Float | mi.Vector4f | int
    inner: mi.Float | mi.Vector4f | int


@dataclass
class Shared:
    """Time and wavelengths of a lane's light subpath and of all camera subpaths it serves.

    ``u_wavelength`` chose the wavelengths, ``weight`` is 1 / their density; ``wavelength_set`` their number
    among `WavelengthSets` (None where there are none).
    """

    time: mi.Float
    wavelengths: mi.Color0f | mi.UnpolarizedSpectrum
    weight: mi.UnpolarizedSpectrum
    u_wavelength: mi.Float
    wavelength_set: mi.UInt32 | None = None


class Observer:
    """Observes the subpaths of a lane while they are recorded, for tools; this one does nothing.

    `kernel.retrace` takes one. What it is given are arrays of Dr.Jit, which it must not change. In recorded
    loops they have no values yet; who wants to read them turns `SymbolicLoops` and `SymbolicConditionals`
    off, so that loops run step by step. Lanes whose subpath has ended keep the values of their last step,
    with ``active`` false.
    """

    def emitted(self, emission):
        """A light subpath starts: y_0 and the direction of its first edge, an `emitters.Emission`."""

    def started(self, kernel, side, walk, stream):
        """A subpath is on its first edge; ``side`` is its `walk.Side`, ``stream`` its random numbers."""

    def vertex(self, side, walk, vertex, step):
        """A subpath has reached a ``vertex`` (`walk.Vertex`) and sampled the next ``step``.

        ``step`` is a `bsdf.Step`, None in scenes without surfaces; ``walk`` as it was before it arrived.
        """

    def drawn(self, end):
        """One inner connection of a camera vertex was drawn.

        ``end``: the light vertex, or where a visibility ray ends that is to reach it.
        """


class Kernel:
    """Everything that a pass needs besides its batch. Holds the scene for one render only."""

    # What `bound` adds for one batch.
    points: Points
    count_light: mi.Float
    observer: Observer

    def __init__(self, prepared, plan: Plan, settings: Settings, heuristic: mis.Heuristic):
        u32, f32 = _opaque(mi.UInt32), _opaque(mi.Float)
        self.scene, self.camera = prepared.scene, prepared.camera
        self.emitters = (
            prepared.emitters if plan.emission is None else prepared.emitters.placed(plan.emission)
        )
        self.plan, self.heuristic = plan, heuristic
        self.shape_errors = prepared.emitters.shape_errors
        self.surfaces, self.refracts = prepared.surfaces, prepared.refracts
        # Whether some path can be made from the light's side too, so that weights know how likely that is.
        self.reverse = plan.light or plan.merging or plan.guided > 0
        self.traits = prepared.traits if self.reverse else prepared.traits.from_one_side()
        self.space = prepared.space
        self.light_media = prepared.light_media
        self.sensor_medium = None if self.space is None else u32(self.space.media.sensor)
        self.scatters = self.surfaces or (self.space is not None and self.space.media.scatters)
        depth = settings.max_depth
        reach = min(depth, prepared.stored_vertices(settings))
        kept = plan.joined * (min(reach - 2, KEPT) if self.space is not None else reach - 2)
        self.store_size = next(size for size in STORE_SIZES if size >= kept)
        self.strategy_images = settings.strategy_images
        self.max_depth, self.rr_depth = u32(depth), u32(settings.rr_depth)
        self._reach = u32(reach)
        self.last_stored, self.last_inner = u32(max(reach - 2, 0)), u32(reach)
        self.last_splat, self.last_arrival = u32(max(reach - 1, 0)), u32(reach)
        after = 0 if plan.arrival else 1 if plan.splat else 2  # edges that the class adds to a light subpath
        self.last_light = u32(max(reach - after, 0))
        self.served = u32(plan.served)
        self.kappa = _coefficients(plan, isinstance(heuristic, mis.ByClass))
        self.inverse_threshold = f32(dr.inf)
        # The photons of a pass, a `photons.merging.Merging`; None where vertices are not merged.
        self.merging = None
        # What guides s = 0, a `photons.photon_guide.Guide`; None where nothing does.
        self.guide = None
        # Whether s = 0 makes no paths on which it might be guided: see `photons.guiding_benefit`.
        self.without_isolated = False
        # Whether contributions say where their path is emitted, see `Contribution.emission`.
        self.tells_emission = False

    def bound(self, points: Points, count_light: float, observer: Observer) -> Kernel:
        """The kernel for one batch, with the batch's ``points``.

        ``count_light`` is the batch's exact count of light subpaths per camera subpath, which the estimates
        of t <= 1 are divided by (weights keep the nominal one).
        """
        other = copy(self)
        other.points, other.count_light = points, dr.opaque(mi.Float, count_light)
        other.observer = observer
        return other

    def within_store(self, k: mi.UInt32) -> mi.Bool:
        """Mask: paths of ``k`` edges use all strategies; longer ones s = 0 and s = 1 only."""
        return k <= self._reach

    def set_threshold(self, size: mi.Float64):
        """Contributions below ``size`` play roulette, none if it is 0.

        The threshold is a power of two near it, so that the order of atomic sums rarely changes a decision.
        ``size``: ``Float64`` of width 1.
        """
        rounded = dr.exp2(dr.round(dr.log2(size)))
        self.inverse_threshold = mi.Float(dr.select(size > 0, dr.rcp(rounded), dr.inf))
        dr.eval(self.inverse_threshold)


def _coefficients(plan: Plan, by_class: bool) -> Coefficients:
    """Run-time values, or ``by_class`` those of a pilot: 1 in the place of the class, see `mis.ByClass`."""

    def entry(kind, value, used):
        if not used:
            return 0
        if by_class:
            return mi.Vector4f(*(1.0 if name == kind else 0.0 for name in mis.CLASSES))
        return dr.opaque(mi.Float, value)

    count = 1 / plan.camera_paths_per_light_path if plan.light else 0.0  # nominal, see `Kernel.bound`
    light = count * plan.kappa_light
    return Coefficients(
        hit=entry("hit", 1, plan.hit),
        direct=entry("direct", plan.kappa_direct, plan.direct),
        splat=entry("light", light, plan.splat),
        endpoints=entry("light", light, plan.endpoints),
        arrival=entry("light", light, plan.arrival),
        # One of M candidates is no M independent samples. (With M = 4 the error is 0.96 times that with
        # kappa = M in `cornell_box`, 0.88 in `veach_bidir`.)
        inner=entry("inner", math.sqrt(plan.joined), plan.connections != "none"),
    )


def _opaque(kind):
    return lambda value: dr.opaque(kind, value)
