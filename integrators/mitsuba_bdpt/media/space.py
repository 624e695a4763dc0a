"""The space between vertices in scenes with media: what the kernel calls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..geometry import polarization
from ..sampling.points import Purpose
from ..transport.contribution import MEDIA
from ..transport.vacuum import Vacuum
from . import flight, transmittance
from .media import Media, coefficients, interaction, of_depth
from .phase import PhaseFunctions

# Largest optical depth of a connection's approximate transmittance, in the medium that it starts in:
# connections of less actual depth are drawn at most e^2 times too rarely.
_GUESSED_DEPTH = 2.0


@dataclass(frozen=True)
class Space(Vacuum):
    """The space between vertices: the scene's ``media``.

    ``null_transmission(si, active)``: transmission of a surface straight through (``Spectrum``); ``clipped``:
    some camera ray ends in a homogeneous medium at the far plane, in front of the environment.
    """

    media: Media
    null_transmission: Callable[[mi.SurfaceInteraction3f, mi.Bool], mi.UnpolarizedSpectrum]
    clipped: bool = False

    begin = flight.begin
    arrive = flight.arrive
    depart = flight.depart
    up_to_sensor = transmittance.up_to_sensor

    @property
    def phase(self) -> PhaseFunctions | None:
        return PhaseFunctions(self.media) if self.media.scatters else None

    @property
    def counters(self) -> tuple[str, ...]:
        return MEDIA if self.media.grids else MEDIA[:1]

    def allows_next_event(self, vertex):
        if self.media.all_lit:
            return mi.Bool(True)
        return ~vertex.volume | dr.gather(mi.Bool, self.media.lit, vertex.medium)

    def before_event(self, vertex, d):
        if self.phase is None:
            return vertex.throughput, None
        mei = interaction(vertex.si.p, d, vertex.si)
        sigma_s, _ = self.media.query(vertex.medium, coefficients, mei, vertex.volume)  # 0: throughput is 0
        ratio = dr.select(vertex.volume, self.media.mean(vertex.medium) / sigma_s, 1)
        ratio = mi.UnpolarizedSpectrum(dr.select(vertex.volume & (sigma_s == 0), 0, ratio))
        number = dr.select(vertex.volume, vertex.medium, mi.UInt32(0))
        return polarization.scaled(vertex.throughput, ratio), number

    def guessed(self, vertex, between):
        sigma = self.media.mean(self.media.beyond(vertex.si, between, vertex.medium))
        return dr.exp(-dr.minimum(sigma * dr.norm(between), _GUESSED_DEPTH))

    def seen(self, kernel, c):
        shadow_ray = c.shadow_ray
        z, medium, event, word = shadow_ray.vertex, kernel.sensor_medium, mi.UInt32(0), mi.UInt32(0)
        if z is not None:
            medium, event = self.media.beyond(z.si, shadow_ray.d, z.medium), z.event
        if self.media.grids:
            word = kernel.points.series(shadow_ray.stream, Purpose.TRACKING, event, 1 + shadow_ray.number)
        ends = shadow_ray.ray, medium, c.active, shadow_ray.own
        crossing = transmittance.between(self, *ends, word, shadow_ray.hidden)
        weight, shares = kernel.heuristic.weigh(*c.sides, tr=of_depth(crossing.depth))
        return replace(
            c,
            value=polarization.scaled(c.value, crossing.transmittance),
            weight=weight,
            shares=shares,
            # NaN is kept, to be counted.
            active=c.active & ~dr.all(crossing.transmittance == 0),
            counted=c.counted + crossing.counted,
        )

    def clear(self, ray, medium, active):
        return transmittance.between(self, ray, medium, active).clear
