"""Path layers: a partition of paths by their events, the same whichever strategy samples a path.

An event is *specular* if a delta lobe was sampled, or if it is near-specular by its densities from both
sides (`near_specular.is_narrow`); others are *rough*. Null events are none. Of a path with

* no rough event: ``emission`` (an emitter seen directly, in mirrors or through glass);
* one rough event, and no event between it and the emitter: ``direct``;
* one rough event, and specular ones alone between it and the emitter, one at least: ``caustic``;
* several rough events: ``indirect``.

Specular events between the camera and the first rough one do not matter.

Each subpath carries a number, the layer of its events. On a camera subpath it is that of the path that ends
if the next vertex is on an emitter. On a light subpath it is that of the path that ends on the sensor, but
`_SPECULAR` after specular events alone. Without path layers it is None.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .bsdf import Evaluation, Step
from .near_specular import is_narrow

# Names of the layers, by number.
NAMES = ("emission", "direct", "indirect", "caustic")
EMISSION, DIRECT, INDIRECT, CAUSTIC = range(len(NAMES))

_SPECULAR = len(NAMES)  # of light subpaths: specular events alone, one at least


def sampled(layer: mi.UInt32 | None, step: Step, adjoint: bool) -> mi.UInt32 | None:
    """Number of a subpath after the sampled ``step`` at a vertex; ``layer``: before."""
    if layer is None:
        return None
    return dr.select(step.null, layer, _after(layer, step.delta | is_narrow(step), adjoint))


def evaluated(layer: mi.UInt32 | None, f: Evaluation, adjoint: bool) -> mi.UInt32 | None:
    """The same after an event whose directions were given, with evaluation ``f``."""
    return None if layer is None else _after(layer, is_narrow(f), adjoint)


def joined(of_camera: Any, of_light: mi.UInt32 | None) -> mi.UInt32 | None:
    """Layer of the path of a camera and a light subpath with these numbers, each after its last event."""
    if of_camera is None or of_light is None:
        return None
    seen = dr.select(of_camera == EMISSION, of_light, INDIRECT)
    specular = dr.select(of_camera == DIRECT, CAUSTIC, of_camera)
    found = dr.select(of_light == _SPECULAR, specular, seen)
    return dr.select(of_light == EMISSION, of_camera, found)


def _after(layer: mi.UInt32, specular: mi.Bool, adjoint: bool) -> mi.UInt32:
    """Number of a subpath after another event; ``adjoint``: of a light subpath."""
    first = layer == EMISSION
    rough = dr.select(first, mi.UInt32(DIRECT), INDIRECT)
    if adjoint:
        rough = dr.select(layer == _SPECULAR, CAUSTIC, rough)
        return dr.select(specular, dr.select(first, _SPECULAR, layer), rough)
    return dr.select(specular, dr.select(layer == DIRECT, CAUSTIC, layer), rough)
