"""A scene and a sensor, prepared for one render."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import drjit as dr
import mitsuba as mi

from .. import components
from ..emitters.emitters import Emitters
from ..emitters.infinite import contrast
from ..geometry.boxes import is_finite, known_box, scene_box
from ..geometry.hits import Hits
from ..geometry.shape_facts import ShapeFacts
from ..host.introspection import all_shapes, is_instance, media_of, own_parameters, registry_id
from ..host.notices import State, cached
from ..sensors.checks import check_sensor
from ..sensors.kinds import prepare
from ..settings import DEFAULT_STORED, MAX_STORED, Settings
from ..transport import bsdf, draws
from ..transport.near_specular import near_specular
from ..transport.photons.aim import EVEN_SKY

# Area of an emitter over the square of the scene's diagonal, pi / 64 / 10: at this size a tenth of a subpath
# hits it, of 64 that are scattered diffusely.
SMALL = 0.005

_LOBES = 1024  # most cached facts about lobes of BSDFs that follow from samples


class PreparedScene:
    """A scene seen by one of its sensors; lives for one render.

    ``emitters``, ``camera``: the endpoints; ``hits``: surfaces at hits; ``facts`` about shapes;
    ``smooth``, ``delta``, ``refracts``: some BSDF has such a lobe; ``specular``: some BSDF, as of glass or
    mirrors, has delta lobes alone;
    ``near_specular``: BSDFs of shapes with lobes that are not delta, but nearly so, and ``narrowest``, the
    largest density of these: see `near_specular`; ``traits``: see `bsdf.Traits`; ``space`` between vertices
    and ``light_media``, in which light subpaths start, are None in scenes without media.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor):
        self.scene, self.sensor = scene, sensor
        self.surfaces = bool(scene.shapes())
        self.facts = facts = ShapeFacts.of(scene, sensor)
        self.emitters, self.hits = Emitters(scene, facts), Hits(scene, facts.hits)
        check_sensor(sensor, scene.sensors())
        self.camera = prepare(sensor, self.emitters.shape_errors, scene)
        found = bsdfs(scene)
        family = draws.family(found)
        _prepare_bitmaps(family)
        flags, delta = {b.flags() for b in found}, int(mi.BSDFFlags.Delta)
        smooth, null = (int(f) for f in (mi.BSDFFlags.Smooth, mi.BSDFFlags.Null))
        self.smooth = any(f & smooth for f in flags)
        self.specular = any(f & delta & ~null and not f & smooth for f in flags)
        self.refracts = any(mi.has_flag(b.flags(), mi.BSDFFlags.Transmission) for b in found)
        sharp = _near_specular(scene, sensor, found, family)
        self.near_specular: list[mi.BSDF] = [b for b, _ in sharp]
        self.narrowest = max((density for _, density in sharp), default=0.0)
        instances = sum(map(is_instance, scene.shapes()))  # each has a BSDF
        self.traits = bsdf.Traits.of(found, instances, [b for b, _ in family])
        self.space = self.light_media = None
        if media := media_of(scene, [sensor]):
            self.space, self.light_media = components.media.prepare(
                media, self.emitters, sensor, found, self.traits, facts.about
            )
            delta &= ~null  # which edges pass
        self.delta = any(f & delta for f in flags)

    @property
    def contradiction(self) -> str:
        """Why light subpaths would see other media than the camera; empty if they would not."""
        return self.light_media.contradiction if self.light_media else ""

    @cached_property
    def has_small_emitter(self) -> bool:
        """Whether an emitter may be so small that few subpaths hit it (`SMALL`), or cannot be hit.

        Judged by bounding boxes. An environment counts as small unless it is even.
        """
        box, about = scene_box(self.scene, self.facts.about), self.facts.about
        size = float(dr.squared_norm(box.extents())) if is_finite(box) else math.inf
        return any(_is_small(emitter, size, about) for emitter in self.scene.emitters())

    def stored_vertices(self, settings: Settings) -> int:
        """Longest path, in edges, that uses all strategies."""
        if settings.internals.stored_vertices is not None:
            return settings.internals.stored_vertices
        return DEFAULT_STORED if self.space is None else MAX_STORED


def _is_small(emitter: mi.Emitter, size: float, about: Callable) -> bool:
    """Whether an emitter is small in a scene whose diagonal has the square ``size``."""
    if emitter.is_environment():
        return contrast(emitter) > EVEN_SKY
    delta = mi.EmitterFlags.DeltaPosition, mi.EmitterFlags.DeltaDirection
    shape = emitter.get_shape()
    if shape is None or any(mi.has_flag(emitter.flags(), flag) for flag in delta):
        return True
    box = known_box(shape, about)
    if box is None:
        return True
    _, width, height = sorted(float(extent) for extent in box.extents())
    return not width * height >= SMALL * size


def _near_specular(
    scene: mi.Scene, sensor: mi.Sensor, found: list[mi.BSDF], family
) -> list[tuple[mi.BSDF, float]]:
    """Those of the BSDFs ``found`` with a near-specular lobe, and its density.

    ``family``: `draws.family` of them.
    """

    def known(owner: mi.BSDF, name: str, find):
        key = registry_id(owner), name, State.of([owner])
        return cached(scene, sensor, "near-specular lobes", key, find, most=_LOBES)[0]

    hit = {id(owner) for owner in found}
    return [sharp for sharp in near_specular(family, known) if id(sharp[0]) in hit]


def _prepare_bitmaps(family):
    """Evaluate the bitmaps of BSDFs (a `draws.family`) once.

    Mitsuba prepares their data at the first evaluation, which runs what was recorded so far: it would split
    the first pass into two kernels.
    """
    si = dr.zeros(mi.SurfaceInteraction3f)
    held = (v for _, children in family for v in children.values() if isinstance(v, mi.Texture))
    textures = {id(t): t for t in held if t.class_name().startswith("BitmapTexture")}.values()
    # What an edit has computed is evaluated once: its numbers would compile each kernel that reads it anew.
    dr.eval([own_parameters(texture)["data"] for texture in textures])
    for texture in textures:
        for evaluate in (texture.eval, texture.eval_1, texture.eval_3):
            try:
                evaluate(si)
                break
            except RuntimeError:  # the implemented call depends on channels, ``raw`` and the variant
                continue


def bsdfs(scene: mi.Scene) -> list[mi.BSDF]:
    """BSDFs of all shapes, including those in shape groups, without instances' own."""
    found = [s.bsdf() for s in all_shapes(scene) if not is_instance(s)]
    return [b for b in found if b is not None]
