"""The space between vertices in scenes with media: what the kernel calls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi

from ..geometry.rounding import ShapeErrors
from . import flight, phase, transmittance
from .media import Media


@dataclass(frozen=True)
class Space:
    """The space between vertices: ``scene``, ``media``, rounding errors of shapes.

    ``null_transmission(si, active)``: transmission of a surface straight through (``Spectrum``); ``clipped``:
    some camera ray ends in a homogeneous medium at the far plane, in front of the environment.
    """

    scene: mi.Scene
    media: Media
    shape_errors: ShapeErrors
    null_transmission: Callable[[mi.SurfaceInteraction3f, mi.Bool], mi.UnpolarizedSpectrum]
    clipped: bool = False

    # Hooks of a walk: its first edge, the end of an edge, the event at its end.
    begin = flight.begin
    advance = flight.advance
    sample = phase.sample
    # Hooks of connections: the phase function, transmittance.
    evaluate = phase.evaluate
    between = transmittance.between
    depth_along = transmittance.depth_along
