"""Inputs of a kernel besides its batch: scene, plan, coefficients, limits."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..sampling.points import Points
from ..settings import MAX_STORED, Settings
from . import mis
from .plan import Plan
from .sds import PhotonStrategy
from .vacuum import Vacuum

if TYPE_CHECKING:
    from ..emitters.light_groups import LightGroups
    from ..guided_emission import Cells

# Sizes of the lanes' local memory: irrelevant to the speed of CPUs; few sizes give few kernels.
STORE_SIZES = (64, 256, MAX_STORED)

KEPT = 64  # most stored vertices of a light subpath in scenes with media, see `light_path.Thinning`


@dataclass
class Coefficients:
    """kappa of each class of strategies in all weights, the Python number 0 for classes that are not in use.

    ``splat_prime``: kappa' of t = 1, without `Plan.kappa_light`.
    """

    hit: mi.Float | mi.Vector4f | int
    direct: mi.Float | mi.Vector4f | int
    splat: mi.Float | mi.Vector4f | int
    endpoints: mi.Float | mi.Vector4f | int
    arrival: mi.Float | mi.Vector4f | int
    inner: mi.Float | mi.Vector4f | int
    splat_prime: mi.Float | mi.Vector4f | int


@dataclass
class Shared:
    """Time and wavelengths of a lane's light subpath and its camera subpaths.

    ``u_wavelength``: sample value of the wavelengths, ``weight``: 1 / their density; ``wavelength_set``:
    index in `WavelengthSets`, None without sets.
    """

    time: mi.Float
    wavelengths: mi.Color0f | mi.UnpolarizedSpectrum
    weight: mi.UnpolarizedSpectrum
    u_wavelength: mi.Float
    wavelength_set: mi.UInt32 | None = None


class Observer:
    """Observes the subpaths of a lane during recording, for tools; does nothing.

    See `kernel.trace`. Arguments must not be changed. In recorded loops they have no values yet; disable
    `SymbolicLoops` and `SymbolicConditionals` to read them. ``lanes``: traces this many lanes, each with its
    first camera sample; 0: all.
    """

    lanes = 0

    def emitted(self, emission):
        """A light subpath starts: y_0 and the first direction, an `emitters.Emission`."""

    def started(self, kernel, side, walk):
        """A subpath is on its first edge; ``side``: its `walk.Side`."""

    def vertex(self, side, walk, vertex, step):
        """A ``walk``, as before its arrival, has reached a `walk.Vertex`; ``step`` from there, or None."""


class TraceContext:
    """Inputs of a pass besides its batch. Holds the scene for one render only.

    Constant once made: `replaced` and the methods ``with_...`` return another.
    """

    # Of one batch, see `bound`.
    points: Points
    count_light: mi.Float
    observer: Observer

    def __init__(self, prepared, plan: Plan, settings: Settings, heuristic: mis.Heuristic):
        u32 = partial(dr.opaque, mi.UInt32)
        self.scene, self.camera = prepared.scene, prepared.camera
        tables = plan.emission
        self.emitters = prepared.emitters if tables is None else tables.guided(prepared.emitters)
        self.plan, self.heuristic = plan, heuristic
        self.shape_errors, self.hits = prepared.emitters.shape_errors, prepared.hits
        self.surfaces, self.refracts = prepared.surfaces, prepared.refracts
        # Whether a strategy in use starts from the light's side, so that weights need reverse densities.
        self.reverse = plan.light or plan.merging or plan.guided > 0
        self.traits = prepared.traits if self.reverse else prepared.traits.from_one_side()
        self.has_media = prepared.space is not None
        self.space = prepared.space or Vacuum(self.scene, self.shape_errors)
        self.light_media = prepared.light_media
        if self.light_media is not None and (plan.light or plan.merging):
            self.light_media.settle()
        self.sensor_medium = u32(self.space.media.sensor) if self.has_media else None
        depth = settings.max_depth
        reach = min(depth, prepared.stored_vertices(settings))
        kept = plan.joined * (min(reach - 2, KEPT) if self.has_media else reach - 2)
        self.store_size = next(size for size in STORE_SIZES if size >= kept)
        self.strategy_images = settings.strategy_images
        self.max_depth, self.rr_depth = u32(depth), u32(settings.rr_depth)
        # Most edges of a path by all strategies; longer ones are sampled by s = 0 and s = 1 only.
        self.reach = u32(reach)
        after = 0 if plan.arrival else 1 if plan.splat else 2  # edges that the class adds to a light subpath
        self.last_light = u32(max(reach - after, 0))
        # Most edges of a merged path: weights of merges assume all strategies, not s = 0 and s = 1 alone.
        self.last_merged = self.reach if plan.light else self.max_depth
        self.camera_paths = u32(plan.camera_paths)
        self.kappa = _coefficients(plan, isinstance(heuristic, mis.ByClass))
        self.inverse_threshold = dr.opaque(mi.Float, dr.inf)
        self.sds = PhotonStrategy()  # of a pass
        # Whether photons guide through near-specular events too.
        self.near_specular = bool(prepared.near_specular)
        # What contributions store: light group, path layer, in a pilot the cell of the emission.
        self.light_groups: LightGroups | None = None
        self.path_layers = False
        self.cells: Cells | None = None

    def replaced(self, **changes) -> TraceContext:
        """A copy in which these attributes have other values."""
        other = copy(self)
        vars(other).update(changes)
        return other

    def bound(
        self, points: Points, count_light: float = 1.0, observer: Observer | None = None
    ) -> TraceContext:
        """The kernel for one batch with its ``points``.

        ``count_light``: exact number of light subpaths per camera subpath; divides estimates of t <= 1.
        """
        count = dr.opaque(mi.Float, count_light)
        return self.replaced(points=points, count_light=count, observer=observer or Observer())

    def with_light_groups(self, groups: LightGroups) -> TraceContext:
        """The kernel whose contributions store their light group."""
        return self.replaced(light_groups=groups, emitters=self.emitters.with_indices())

    def with_path_layers(self) -> TraceContext:
        """The kernel whose contributions store their path layer, for which events need both densities."""
        return self.replaced(path_layers=True, traits=replace(self.traits, reverse=True))

    def light_group(self, index: mi.UInt32, active: mi.Bool) -> mi.UInt32 | None:
        """The light group of the emitter ``index``; None without such layers."""
        return None if self.light_groups is None else self.light_groups.at(index, active)

    def with_threshold(self, size: mi.Float64) -> TraceContext:
        """The kernel with the roulette threshold ``size`` (``Float64`` of width 1), 0 for none.

        Rounded to a power of two, so that the order of atomic sums rarely changes a decision.
        """
        rounded = dr.exp2(dr.round(dr.log2(size)))
        inverse = mi.Float(dr.select(size > 0, dr.rcp(rounded), dr.inf))
        dr.eval(inverse)
        return self.replaced(inverse_threshold=inverse)


def _coefficients(plan: Plan, by_class: bool) -> Coefficients:
    """Coefficients of ``plan``; ``by_class``: one-hot for pilots, see `mis.ByClass`."""

    def entry(kind, value, used):
        if not used:
            return 0
        if by_class:
            return mi.Vector4f(*(1.0 if name == kind else 0.0 for name in mis.CLASSES))
        return dr.opaque(mi.Float, value)

    count = 1 / plan.camera_paths_per_light_path if plan.light else 0.0  # nominal, see `TraceContext.bound`
    light = count * plan.kappa_light
    return Coefficients(
        hit=entry("hit", 1, plan.hit),
        direct=entry("direct", plan.kappa_direct, plan.direct),
        splat=entry("light", light, plan.splat),
        endpoints=entry("light", light, plan.endpoints),
        arrival=entry("light", light, plan.arrival),
        # One of M candidates is not M independent samples (experiments, "Several light subpaths per lane").
        inner=entry("inner", math.sqrt(plan.joined), plan.connections != "none"),
        splat_prime=entry("light", count, plan.splat),
    )
