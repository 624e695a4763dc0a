"""What kinds of emitters there are, and what each can do."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError, UsageError
from ..geometry.quadrics import Sphere, sphere_normal
from ..host.introspection import all_shapes, children, matrix_of, named, number, own_parameters
from ..host.jit import registered_emitters

# The first four emit from surfaces or points, the next two from infinity; a directional area has no
# direction but its normal. A HIT_ONLY one is an area light whose points cannot be sampled, or tell no
# radiance: it can be hit and no more. THIRD_PARTY are classes that are not Mitsuba's: only the calls that
# camera subpaths need are used.
AREA, POINT, SPOT, PROJECTOR, INFINITE, DIRECTIONAL, DIRECTIONAL_AREA, HIT_ONLY, THIRD_PARTY = range(9)

_KINDS = {
    "AreaLight": AREA,
    "PointLight": POINT,
    "SpotLight": SPOT,
    "Projector": PROJECTOR,
    "DirectionalEmitter": DIRECTIONAL,
    "DirectionalArea": DIRECTIONAL_AREA,
    "ConstantBackgroundEmitter": INFINITE,
    "EnvironmentMapEmitter": INFINITE,
    "SunskyEmitter": INFINITE,
    "TimedSunskyEmitter": INFINITE,
}

# Emitters at a point: their intensity is asked of Mitsuba, their density of emission is known here.
POSITIONS = (POINT, SPOT, PROJECTOR)

# Shapes whose textured radiance Mitsuba samples rightly. On a cylinder the points have other densities than
# stated (0.4 to 1.6 times), on a mesh all faces with the same texture coordinates share one density but
# only one face is sampled (a cube: a sixth).
_TEXTURE_SAMPLED = {kind.value for kind in (mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Sphere)}

# Numbers of an environment map that are looked at for its contrast, at most: 4 ms.
_QUICKLY_READ = 1 << 20

_CURVES = {mi.ShapeType.BSplineCurve.value, mi.ShapeType.LinearCurve.value}
_SAMPLED = _TEXTURE_SAMPLED | {mi.ShapeType.Cylinder.value, mi.ShapeType.Mesh.value}


def kind_of(emitter) -> int:
    """The kind of an emitter; raises ``ValueError`` for one that Mitsuba itself renders inconsistently, and
    ``NotImplementedError`` for one that it cannot sample."""
    kind = _KINDS.get(emitter.class_name(), THIRD_PARTY)
    if kind == INFINITE and "to_world" in own_parameters(emitter):
        _check_rotation(emitter)
    if kind == AREA and not _tells_its_points(emitter):
        return HIT_ONLY
    return kind


def _tells_its_points(emitter) -> bool:
    """Whether the points that the shape of an area light samples have a density and a radiance."""
    shape = emitter.get_shape()
    if shape is None:
        raise UnsupportedError(
            f"emitter {named(emitter)} is on a shape that Mitsuba does not tell (an ellipsoidsmesh); "
            "use shape type ellipsoids, or a mesh"
        )
    if shape.shape_type() in _CURVES:
        raise UnsupportedError(
            f"emitter {named(emitter)} is on a curve ({named(shape)}), which Mitsuba's emitters cannot "
            "sample; use a cylinder or a mesh"
        )
    sampled = shape.shape_type() in _SAMPLED
    if not sampled and number(shape.sample_position(0, mi.Point2f(0.5)).pdf) == 0:
        return False
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying):
        check_coordinates(emitter)
    return not _reads_attributes(children(emitter)["radiance"])


def contrast(emitter) -> float:
    """The largest radiance of an environment over its mean; infinite for other emitters, and where that would
    take long to find out, where the numbers of an ``envmap`` are not radiances, or none that has a ratio."""
    kind = emitter.class_name()
    if kind == "ConstantBackgroundEmitter":
        return 1.0
    if kind != "EnvironmentMapEmitter" or mi.is_spectral:
        return math.inf
    data = own_parameters(emitter)["data"]
    if dr.width(data) > _QUICKLY_READ:
        return math.inf
    pixels = np.array(data).max(axis=-1)
    rows = np.sin(np.pi * (np.arange(len(pixels)) + 0.5) / len(pixels))
    mean = float((pixels.mean(axis=1) @ rows) / rows.sum())
    if not pixels.any():  # black everywhere
        return 1.0
    return float(pixels.max()) / mean if 0 < mean < math.inf else math.inf


def _reads_attributes(texture) -> bool:
    """Whether a texture reads a mesh's attributes, which need the number of a face; a sample has none."""
    if texture.class_name() == "MeshAttribute":
        return True
    inner = (value for value in children(texture).values() if isinstance(value, mi.Texture))
    return any(_reads_attributes(value) for value in inner)


def is_hittable(emitter, kind: int) -> bool:
    """Whether a camera subpath can hit the emitter."""
    if kind == THIRD_PARTY:
        return not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
    return kind in (AREA, INFINITE, HIT_ONLY)


def supports_next_event(kind: int) -> bool:
    """Whether next-event estimation can choose the emitter."""
    return kind not in (DIRECTIONAL_AREA, HIT_ONLY)


def supports_emission(kind: int) -> bool:
    """Whether light subpaths can start from the emitter."""
    return kind not in (HIT_ONLY, THIRD_PARTY)


_WHY_NOT = {
    DIRECTIONAL_AREA: "its light leaves in one direction only",
    HIT_ONLY: "no points of it with a known radiance can be sampled; it can only be hit",
    THIRD_PARTY: "its class is not Mitsuba's: only the calls that camera subpaths need are used",
}


def left_out(emitter, kind: int) -> list[tuple[str, str]]:
    """What an emitter cannot take part in, and why."""
    names = ["s=1"] * (not supports_next_event(kind)) + ["light subpaths"] * (not supports_emission(kind))
    return [(f"{name} of emitter {named(emitter)}", _WHY_NOT[kind]) for name in names]


def is_third_party(class_name: str) -> bool:
    """Whether an emitter's class is not Mitsuba's."""
    return class_name not in _KINDS


def third_party_elsewhere(scene) -> int:
    """How many emitters live outside of ``scene`` whose class is not Mitsuba's: virtual calls visit them
    too."""
    own = sum(is_third_party(emitter.class_name()) for emitter in scene.emitters())
    return sum(map(is_third_party, registered_emitters())) - own


def needs_evaluation(class_name: str) -> bool:
    """Whether calls of such an emitter fail while a kernel is recorded: it asks for the value of a mask."""
    return class_name == "TimedSunskyEmitter"


def is_textured(emitter, kind: int) -> bool:
    """Whether an area light has another radiance at each of its points."""
    return kind == AREA and mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


def is_sampled_by_texture(emitter, kind: int) -> bool:
    """Whether Mitsuba chooses a point of the emitter by its texture, and rightly. (With a texel that is not
    finite all densities are NaN.)"""
    if not is_textured(emitter, kind) or emitter.get_shape().shape_type() not in _TEXTURE_SAMPLED:
        return False
    if _is_sampled_from_behind(emitter):
        return False
    try:
        return math.isfinite(number(children(emitter)["radiance"].mean()))
    except RuntimeError:  # a texture that knows no mean
        return True


def _is_sampled_from_behind(emitter) -> bool:
    """Whether the points that Mitsuba samples by the texture of an emitter have normals opposite to those of
    its shape: ``eval_parameterization`` of a rectangle knows nothing of ``flip_normals``."""
    if not emitter.get_shape().has_flipped_normals():  # of nearly all lamps: no kernel runs for them
        return False
    u = mi.Point2f(0.4, 0.6)
    by_texture, _ = emitter.sample_position(0, u)
    # A sphere's normals are compared at one point: those of two points may be opposite anyway.
    sphere = Sphere.of(emitter.get_shape())
    if sphere is not None:
        normal = sphere_normal(by_texture.p, sphere.center, sphere.outward)
    else:
        normal = emitter.get_shape().sample_position(0, u).n
    return number(dr.dot(by_texture.n, normal)) < 0


def check_coordinates(emitter):
    """Raise ``ValueError`` for a texture on a mesh that has no texture coordinates."""
    shape = emitter.get_shape()
    if shape.shape_type() == mi.ShapeType.Mesh.value and not shape.has_vertex_texcoords():
        raise UsageError(
            f"emitter {named(emitter)} has a textured radiance on a mesh without texture coordinates "
            f"({named(shape)}); make the radiance uniform, or give the mesh coordinates"
        )


def refuse_curves(scene, emitter, why: str):
    """Raise ``NotImplementedError`` if a call on shapes, which ``emitter`` needs, would meet curves: they
    have no ``sample_position``."""
    for shape in all_shapes(scene):
        if shape.shape_type() in _CURVES:
            raise UnsupportedError(
                f"emitter {named(emitter)} {why}, which is not supported beside curves "
                f"({named(shape)}); remove one of them, or use integrator type 'path'"
            )


def _check_rotation(emitter):
    """Raise ``ValueError`` unless the ``to_world`` of an environment keeps lengths: with any other matrix
    Mitsuba's own calls disagree with each other (next-event estimation four times the radiance)."""
    columns = _columns(emitter)
    if not np.allclose(columns.T @ columns, np.eye(3), atol=1e-3):
        raise UsageError(
            f"to_world of {_plugin(emitter)} {named(emitter)} is not a rotation (the lengths of its "
            f"columns are {_lengths(columns)}); leave out scaling, and give rotate an axis of length 1"
        )


def check_angles(emitter):
    """Raise ``ValueError`` if the ``to_world`` of a projector or spot distorts angles: what it sends into a
    direction is a function of the angles before, and densities of directions are those of these angles.
    Scaled by one factor or mirrored, it keeps them."""
    columns = _columns(emitter)
    scale = np.linalg.norm(columns, axis=0).mean()
    with np.errstate(invalid="ignore"):  # what is not finite is not close
        keeps = np.allclose(columns.T @ columns, np.eye(3) * scale**2, rtol=0, atol=1e-3 * scale**2)
    if not keeps:
        plugin, angle = {"Projector": ("projector", "fov"), "SpotLight": ("spot", "cutoff_angle")}[
            emitter.class_name()
        ]
        raise UsageError(
            f"to_world of {plugin} {named(emitter)} distorts angles (the lengths of its columns are "
            f"{_lengths(columns)}); leave out scaling and shear, and set {angle} instead"
        )


def _columns(emitter):
    return matrix_of(emitter)[:3, :3]


def _lengths(columns) -> str:
    return ", ".join(f"{x:.4g}" for x in np.linalg.norm(columns, axis=0))


def _plugin(emitter) -> str:
    return {"EnvironmentMapEmitter": "envmap", "TimedSunskyEmitter": "timed_sunsky"}.get(
        emitter.class_name(), emitter.class_name().removesuffix("Emitter").lower()
    )
