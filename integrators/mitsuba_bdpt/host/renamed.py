"""Names that differ between Mitsuba 3.9 and 3.10: meshes, hits and ``to_world``.

``to_world`` is a transformation in 3.9, and an ``AnimatedTransform4f`` with key frames in 3.10. Names of
3.10, in development, are from its release notes and its branch ``motion_blur``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import UnsupportedError

# Names in 3.9 (flat arrays) and in 3.10 (tensors).
POSITIONS = ("vertex_positions", "positions")
NORMALS = ("vertex_normals", "normals")
COORDINATES = ("vertex_texcoords", "texcoords")

# In 3.10: indices from vertices to positions and normals; empty if these are numbered like the vertices.
_INDEX = {POSITIONS: "position_index", NORMALS: "normal_index"}

Parameters = Mapping[str, Any]


def is_transform(value: Any) -> bool:
    """Whether ``value`` is an ``AnimatedTransform4f``, the ``to_world`` of 3.10."""
    return isinstance(value, getattr(mi, "AnimatedTransform4f", ()))


def may_be_animated() -> bool:
    return hasattr(mi, "AnimatedTransform4f")


def transform(value: Any, owner: str) -> Any:
    """Return the transformation in ``value``; ``UnsupportedError`` if it has several key frames."""
    if not is_transform(value):
        return value
    if value.is_animated():
        raise UnsupportedError(
            f"to_world of {owner} is animated, which is not supported; give it a transformation without key "
            "frames, or render with path"
        )
    return value.eval(0.0)


def hit_flags() -> mi.RayFlags:
    """Flags for ``compute_surface_interaction`` that include frames and coordinates."""
    return mi.RayFlags.Default if hasattr(mi.RayFlags, "Default") else mi.RayFlags.All


def holds_a_mesh(parameters: Parameters) -> bool:
    """Whether ``parameters`` (of `introspection.own_parameters`) are those of a mesh."""
    return any(name in parameters for name in POSITIONS)


def faces(parameters: Parameters) -> mi.UInt32:
    """Vertex indices of all faces, flat (3 per face)."""
    return mi.UInt32(_flat(parameters["faces"]))


def positions(parameters: Parameters) -> mi.Float:
    """Vertex positions, flat (3 per vertex)."""
    return _of_vertices(parameters, POSITIONS)


def normals(parameters: Parameters) -> mi.Float:
    """Vertex normals, flat (3 per vertex); empty if the mesh has none."""
    return _of_vertices(parameters, NORMALS)


def has_coordinates(parameters: Parameters) -> bool:
    return len(_flat(_named(parameters, COORDINATES))) > 0


def _named(parameters: Parameters, names: tuple[str, str]) -> Any:
    return next((parameters[name] for name in names if name in parameters), mi.Float())


def _flat(value: Any) -> Any:
    return value.array if dr.is_tensor_v(value) else value


def _of_vertices(parameters: Parameters, names: tuple[str, str]) -> mi.Float:
    values = mi.Float(_flat(_named(parameters, names)))
    index = _flat(parameters.get(_INDEX[names], mi.UInt32()))
    if not len(index) or not len(values):
        return values
    return mi.Float(dr.ravel(dr.gather(mi.Point3f, values, mi.UInt32(index))))
