"""Prepares the media of a scene for one render."""

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
    space = replace(space, clipped=far > 0 and media.objects[far - 1].is_homogeneous())
    return space, LightMedia(space, emitters, sensor, far, about)
