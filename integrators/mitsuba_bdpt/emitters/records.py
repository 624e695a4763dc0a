"""Records that groups of emitters return to a kernel."""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi

from ..geometry import rays


@dataclass
class Chosen:
    """The selected emitters, their ``index`` in the scene and its probability ``pmf``."""

    emitter: mi.EmitterPtr
    index: mi.UInt32
    pmf: mi.Float


@dataclass
class Emission:
    """Start of a light subpath.

    ``weight`` emitted radiance x cosine / all densities; ``d`` direction of travel; ``anchor`` start of the
    ray, with position and geometric normal of y_0 as a hit reports it (zero unless on a surface); ``cos``
    geometric cosine at y_0 (1 off surfaces); ``pdf_first``, ``pdf_second`` see the subpackage's docstring;
    ``infinite``, ``delta`` masks (delta: no camera subpath can hit it); ``beam`` mask: ``d`` is the only
    direction that leaves y_0, so that y_0 cannot be connected; ``index`` of the emitter; ``si`` the emitting
    point for Mitsuba's calls.
    """

    weight: mi.Spectrum
    d: mi.Vector3f
    anchor: rays.Anchor
    cos: mi.Float
    pdf_first: mi.Float
    pdf_second: mi.Float
    index: mi.UInt32
    si: mi.SurfaceInteraction3f
    infinite: mi.Bool = field(default_factory=lambda: mi.Bool(False))
    delta: mi.Bool = field(default_factory=lambda: mi.Bool(False))
    beam: mi.Bool = field(default_factory=lambda: mi.Bool(False))


@dataclass
class Direct:
    """A sample of next-event estimation: y_0 for a given camera vertex.

    ``weight`` radiance / ``pdf_w``; ``pdf_w`` solid angle at the camera vertex with the selection, or the
    selection alone where ``delta``; ``d`` unit direction to the emitter; ``anchor`` far end of the shadow ray
    (unused where ``infinite``); ``met`` index of its shape (None unless the scene has shapes below
    `rounding.SMALL`); ``emission_ratio``: pdf_first pdf_second / (density of y_0 in the measure of pdf_first,
    times the squared distance; 1 at infinity), which times the geometric cosine at the camera vertex is the
    ratio of the densities of s = 2 and s = 1, without the camera subpath's density of the vertex; ``index``
    of the emitter.
    """

    weight: mi.Spectrum
    pdf_w: mi.Float
    d: mi.Vector3f
    anchor: rays.Anchor
    emission_ratio: mi.Float
    infinite: mi.Bool = field(default_factory=lambda: mi.Bool(False))
    delta: mi.Bool = field(default_factory=lambda: mi.Bool(False))
    met: mi.UInt32 | None = None
    index: mi.UInt32 | None = None


@dataclass
class Place:
    """An emission's primary numbers ``u`` in the unit square, and the index ``bin`` of that square."""

    bin: mi.UInt32
    u: mi.Point2f


@dataclass
class Factor:
    """Effect on the density of emission of a guide with density r: ``kept`` + ``scaled`` r."""

    scaled: mi.Float
    kept: mi.Float

    @staticmethod
    def whole() -> Factor:
        return Factor(mi.Float(1), mi.Float(0))


@dataclass
class Cell:
    """Cell of an emission: ``number`` in all tables, ``known`` if it has a table."""

    number: mi.UInt32
    known: mi.Bool
    factor: Factor
