"""Diagnostics: parameters that spoil images.

Images that are black or lack shapes, negative radiance, reflectances above 1, spots too narrow for single
precision, lamps that overlap, glass in the plane of another surface, and non-finite values.
"""

from __future__ import annotations

import math
import re
from itertools import product
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..emitters.radiance import is_negative
from ..errors import listed
from ..geometry.boxes import is_finite
from ..geometry.flaws import lets_through
from ..geometry.quadrics import ROUND
from ..geometry.rounding import offset_at
from ..host.introspection import LEAVES, all_shapes, children, is_instance, named, number, own_parameters
from ..host.notices import cached

if TYPE_CHECKING:
    from ..settings import Settings
    from .prepared import PreparedScene

_INSPECTED = 100  # most emitters whose radiance is inspected
NAMED = 5  # largest number of causes that a message lists

# Suffixes of the names of BSDF textures that scale scattered light.
_SCALES = ("reflectance", "transmittance", "base_color")

# Largest reflectance not above 1 by more than rounding (8 bits per colour, half precision).
_MORE_THAN_ALL = 1 + 1e-3

_STEP = 2.0**-24  # single-precision step below 1, the range of cosines of narrow cones

# Largest step relative to 1 - cos of the cutoff angle (0.2 degrees): bounds the relative error of the light.
_COARSE = 1e-2

# Least width of a face over the size of its shape, through which more than a little of its light passes.
_OF_PANE = 0.05

_QUICKLY_READ = 1 << 17  # most bitmap values that are read, of all bitmaps together


def spoilt(prepared: PreparedScene, settings: Settings) -> list[str]:
    """Describe parameters that spoil the image: causes, effects and remedies."""
    emitters, found = prepared.emitters, []
    if not emitters.count:
        found.append("the scene has no emitter; the image is black; add one, for example of type constant")
    elif emitters.black:
        found.append(
            "no emitter of the scene emits light: their radiance is 0; the image is black; raise their "
            "radiance, intensity, irradiance or scale"
        )
    if settings.max_depth == 0 and not settings.aovs:
        found.append(
            "max_depth=0 leaves no path between an emitter and the sensor; the image is black; set 1 to see "
            "emitters alone, 2 for direct light, -1 for all light"
        )
    if settings.max_depth == 1 and settings.hide_emitters and not settings.aovs:
        found.append(
            "max_depth=1 renders only directly visible emitters, and hide_emitters hides them; the image is "
            "black; set max_depth to 2 or more, or hide_emitters to false"
        )
    first = emitters.objects[:_INSPECTED]
    negative = [f"emitter {named(e.get_shape() or e)}" for e in first if is_negative(e)]
    if negative:
        found.append(
            f"{listed(negative, NAMED)} has negative radiance; pixels that it lights are too dark or "
            "negative; make its radiance, intensity, irradiance and scale 0 or more"
        )
    found += [f"{listed(names, NAMED)} {flaw.value}" for flaw, names in prepared.facts.flaws.items()]
    return found + [f"{listed(names, NAMED)}: {text}" for text, names in _wrong(prepared).items() if names]


def _wrong(prepared: PreparedScene) -> dict[str, list[str]]:
    """Parameters of which light is lost or added, by effects and remedies."""
    scene, sensor, facts = prepared.scene, prepared.sensor, prepared.facts
    bright = non_conserving_bsdfs([shape for shape in all_shapes(scene) if not is_instance(shape)])
    coplanar, _ = cached(
        scene, sensor, "coplanar", facts, lambda: (overlapping_lamps(scene), glass_in_planes(scene)), most=1
    )
    return {
        "more light returns than arrives, and where it cannot leave the image has no limit as max_depth "
        "grows; keep such parameters at 1 or below": bright,
        "Mitsuba rounds how the light falls off across so narrow a cone, with every integrator, and "
        "strategies do not agree about it; make it 0.2 degrees or more": narrow_spots(scene),
        "they overlap in one plane, where rays hit one of them but other strategies sample each, so that "
        "their light is wrong; leave out one, or move it by 1e-5 of the scene's size": coplanar[0],
        "they share a plane, where rays that leave one begin beyond the other, so that light through them is "
        "lost, with every integrator; move one by 1e-4 of the scene's size": coplanar[1],
    }


def non_conserving_bsdfs(owners) -> list[str]:
    """Describe the BSDFs, nested ones included, that are not energy-conserving."""
    scales = _scales([(owner,) for owner in owners])
    most = max(_QUICKLY_READ // max(len(scales), 1), 1)
    found = ((name, owners, _largest(owners[0], most)) for name, owners in scales)
    return [
        f"{_called(owners)} has {name} up to {largest:.4g}"
        for name, owners, largest in found
        if largest > _MORE_THAN_ALL
    ]


def _scales(chains) -> list[tuple[str, tuple]]:
    """Textures in ``chains`` that scale scattered light: names of parameters, and chains.

    A chain is an object followed by those that enclose it.
    """
    chains, found, seen = list(chains), [], set()
    for chain in chains:  # grows on the way
        is_shape = isinstance(chain[0], mi.Shape)  # its parameters need not be traversed
        for name, value in ({"bsdf": chain[0].bsdf()} if is_shape else children(chain[0])).items():
            if isinstance(value, mi.BSDF) and id(value) not in seen:
                seen.add(id(value))
                chains.append((value, *chain))
            elif isinstance(value, mi.Texture) and isinstance(chain[0], mi.BSDF) and name.endswith(_SCALES):
                found.append((name, (value, *chain)))
    return found


def _called(owners) -> str:
    """Identify the BSDF of a texture, the first of ``owners``, by the nearest id."""
    holder = next((owner for owner in owners[1:] if owner.id()), None)
    if isinstance(holder, mi.BSDF):
        return f"BSDF {named(holder)}"
    texture = owners[0].id() or _file_of(owners[0])
    if texture:
        return f"the BSDF with texture '{texture}'"
    if holder is not None:
        return f"the BSDF of shape {named(holder)}"
    return f"a BSDF without id ({' of '.join(owner.class_name() for owner in owners[1:])})"


def _file_of(texture) -> str:
    """File name of a bitmap without id, from its text; empty for other textures."""
    found = re.search(r'^\s*name = "(.*)",$', str(texture), re.MULTILINE)
    return found[1] if found and texture.class_name().startswith("BitmapTexture") else ""


def _largest(texture, most: int) -> float:
    """Largest value of a texture, 0 if unknown; ``most``: values read of a bitmap."""
    if texture.class_name() not in LEAVES:
        held = (value for value in children(texture).values() if isinstance(value, mi.Texture))
        if inner := [_largest(value, most) for value in held]:
            return max(inner)
    try:
        return number(texture.max())
    except RuntimeError:  # not implemented, for bitmaps among others
        pass
    data = own_parameters(texture).get("data")
    if data is None or (mi.is_spectral and data.shape[-1] == 3):
        return 0.0  # colours are coefficients of spectra, which are at most 1
    if dr.is_integral_v(data):
        return 1.0  # bytes are shares of 255, and undoing sRGB keeps 1
    values, count = dr.detach(data.array), min(dr.width(data), most)
    # Opaque sizes: one kernel for all.
    index = dr.arange(mi.UInt64, count) * dr.opaque(mi.UInt64, dr.width(data)) // dr.opaque(mi.UInt64, count)
    read = dr.gather(type(values), values, mi.UInt32(index))
    return float(np.nanmax(np.array(read, dtype=np.float32), initial=0))


def narrow_spots(scene) -> list[str]:
    """Describe spots whose falloff spans too few single-precision cosines."""
    found = []
    for emitter in scene.emitters():
        if emitter.class_name() != "SpotLight":
            continue
        angle = number(own_parameters(emitter)["cutoff_angle"])
        if not math.isfinite(angle):  # reported by `not_finite`
            continue
        opening = 2 * math.sin(math.radians(angle) / 2) ** 2  # 1 - cos, without cancellation
        if _STEP > _COARSE * opening:
            most = f"{_STEP / opening:.0%}" if opening > _STEP else "all"
            found.append(f"spot {named(emitter)} has cutoff_angle={angle:g} (up to {most} of its light)")
    return found


def _boxed(shapes) -> tuple[list, np.ndarray, np.ndarray, np.ndarray]:
    """Those of ``shapes`` with finite boxes, corners of these, and the ray offset at each."""
    shapes = [shape for shape in shapes if shape and is_finite(mi.ScalarBoundingBox3f(shape.bbox()))]
    boxes = [(shape.bbox().min, shape.bbox().max) for shape in shapes]
    low, high = np.array(boxes, dtype=np.float64).reshape(-1, 2, 3).swapaxes(0, 1)
    return shapes, low, high, offset_at(np.abs([low, high]).max((0, 2), initial=0))


def overlapping_lamps(scene) -> list[str]:
    """Describe lamps that overlap in one plane along the axes, each with one other; rectangles only."""
    # Shadow rays to the farther of two lamps end before the nearer one, see `rounding`.
    shapes, low, high, near = _boxed(emitter.get_shape() for emitter in scene.emitters())
    found = []
    for axis, a, b in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        (flat,) = np.nonzero(high[:, axis] - low[:, axis] <= near)
        flat = flat[np.argsort(low[flat, a])]
        starts = low[flat, a]
        for k, i in enumerate(flat):
            others = flat[k + 1 : np.searchsorted(starts, high[i, a] - near[i])]
            width = np.minimum(high[others, b], high[i, b]) - np.maximum(low[others, b], low[i, b])
            overlap = (width > near[i]) & (np.abs(low[others, axis] - low[i, axis]) <= near[i])
            found += [(shapes[i], shapes[j]) for j in others[overlap][:1]]
    return [f"lamps {named(a)} and {named(b)}" for a, b in found if _fills_its_box(a) and _fills_its_box(b)]


def glass_in_planes(scene) -> list[str]:
    """Describe shapes that let light through with a face in a flat shape along the axes.

    Not panes that stand on it.
    """
    shapes = [shape for shape in scene.shapes() if not is_instance(shape)]
    through = {id(s) for s in shapes if lets_through(s) and s.shape_type() not in ROUND}
    shapes, low, high, near = _boxed(shapes if through else ())
    through = [i for i, shape in enumerate(shapes) if id(shape) in through]
    found = []
    for axis in range(3):
        planes = np.flatnonzero(high[:, axis] - low[:, axis] <= near)
        planes = planes[np.argsort(low[planes, axis], kind="stable")]
        places, reach = low[planes, axis], 2 * near.max(initial=0)
        for i, side in product(through if len(planes) else (), (low, high)):
            flat = planes[slice(*places.searchsorted((side[i, axis] - reach, side[i, axis] + reach)))]
            if not len(flat):
                continue
            common = np.minimum(high[flat], high[i]) - np.maximum(low[flat], low[i])
            least, at = max(near[i], _OF_PANE * (high[i] - low[i]).max()), side[i, axis]
            touching = (flat != i) & (np.abs(low[flat, axis] - at) <= np.maximum(near[flat], near[i]))
            touching &= (np.delete(common, axis, axis=1) > least).all(axis=1)
            if touching.any() and (i in flat or _has_face(shapes[i], axis, at, near[i])):
                found.append(f"shapes {named(shapes[i])} and {named(shapes[flat[touching][0]])}")
    return list(dict.fromkeys(found))


def _has_face(shape, axis: int, at: float, near: float) -> bool:
    """Whether a triangle of a mesh lies in the plane ``at`` a coordinate along ``axis``."""
    params = own_parameters(shape) if shape.is_mesh() else {}
    if "vertex_positions" not in params:
        return False
    within = np.abs(np.array(params["vertex_positions"])[axis::3] - at) <= near
    return bool(within[np.array(params["faces"])].reshape(-1, 3).all(axis=1).any())


def _fills_its_box(shape) -> bool:
    """Whether a flat shape has the area of its bounding box."""
    _, width, height = sorted(shape.bbox().extents())
    return math.isclose(number(shape.surface_area()), width * height, rel_tol=1e-4)


def not_finite(scene) -> list[str]:
    """Names of the scene's parameters that hold NaN or infinity. (Reads every value.)"""
    found, held = [], children(scene)
    for name, value in mi.traverse(scene):
        value = getattr(value, "matrix", value)  # of transforms
        if dr.is_float_v(value) and not np.isfinite(np.array(value)).all():
            found.append(_in_words(name, held))
    return found


def _in_words(name: str, held) -> str:
    """Describe the parameter ``name`` of a scene, whose objects are ``held``.

    Mitsuba names objects without id by their address, which identifies nothing.
    """
    first, _, rest = name.partition(".")
    owner = held.get(first)
    return f"{rest} of an object {named(owner)}" if isinstance(owner, mi.Object) and not owner.id() else name
