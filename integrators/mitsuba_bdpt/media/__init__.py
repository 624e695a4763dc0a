"""Participating media: tables, free flight, transmittance between two points. A component.

Measures: surface vertices are in the area measure, volume vertices in the volume measure. Free flight samples
the density sigma_t T of collisions, so that a walk multiplies by the albedo sigma_s / sigma_t alone; only
connections evaluate the transmittance T. Every strategy of a path samples each of its volume vertices once,
and every edge but the connecting one: of these densities the MIS weights keep 1 / T of the connecting edge
(M. Raab, D. Seibert, A. Keller 2008; J. Křivánek et al. 2014, "Unifying Points, Beams, and Paths in
Volumetric Light Transport Simulation", supplemental document).

The weights use ``T~`` in place of T, a function of the edge alone that all strategies share: the estimate
stays unbiased, since weights add up to 1 for each path. A random estimate of T would not do.

An *edge* connects two vertices; null surfaces and null collisions on it are no vertices, but cut it into
*segments*.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mitsuba as mi

from ..emitters.emitters import Emitters
from ..errors import UnsupportedError
from ..host.introspection import named
from ..transport import bsdf
from .light_media import LightMedia, medium_at_far_plane
from .media import Media
from .space import Space


def prepare(
    found: dict[int, mi.Medium],
    emitters: Emitters,
    sensor: mi.Sensor,
    bsdfs: list[mi.BSDF],
    traits: bsdf.Traits,
    about: Callable,
) -> tuple[Space, LightMedia]:
    """The space between vertices, and the media in which light subpaths start.

    ``found``: see `introspection.media_of`; ``bsdfs`` of the scene's shapes, with their ``traits``;
    ``about``: caches facts about shapes, see `ShapeFacts.about`.
    """
    media = Media(found, sensor.get_medium(), bsdfs)
    for one in bsdf.polarizing(bsdfs):
        raise UnsupportedError(
            f"{named(one)} of class {one.class_name()} polarizes what it lets pass, which is not supported "
            "in scenes with participating media; take out the media or the surface, or use volpath"
        )
    space = Space(emitters.scene, emitters.shape_errors, media, traits.null_transmission)
    far = medium_at_far_plane(space, sensor)
    space = replace(space, clipped=far > 0 and media.properties[far - 1].medium.is_homogeneous())
    return space, LightMedia(space, emitters, sensor, far, about)
