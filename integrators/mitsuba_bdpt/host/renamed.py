"""What Mitsuba 3.9 and 3.10 have under different names: meshes, hits, and ``to_world``.

No other module asks for it, so that both work. (Tested with 3.9; of 3.10, which is in development, the names
are those of its release notes and of its branch ``motion_blur``, tested with parameters of that shape.)

``to_world`` is a transformation in 3.9. In 3.10 it is an object, ``AnimatedTransform4f``, which holds a
transformation for each key frame, within the shutter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import UnsupportedError

# Names of 3.9, one number after the other, and of 3.10, tensors.
POSITIONS = ("vertex_positions", "positions")
NORMALS = ("vertex_normals", "normals")
COORDINATES = ("vertex_texcoords", "texcoords")

# In 3.10: which position, and which normal, a vertex has; empty where they are numbered like the vertices.
_INDEX = {POSITIONS: "position_index", NORMALS: "normal_index"}

Parameters = Mapping[str, Any]


def is_transform(value: Any) -> bool:
    """Whether ``value`` is the object that is a ``to_world`` of 3.10."""
    kind = getattr(mi, "AnimatedTransform4f", None)
    return kind is not None and isinstance(value, kind)


def may_be_animated() -> bool:
    """Whether the installed Mitsuba has animated transformations."""
    return hasattr(mi, "AnimatedTransform4f")


def transform(value: Any, owner: str) -> Any:
    """The transformation that ``value`` is in 3.9 and holds in 3.10.

    Raises ``UnsupportedError`` if it has several key frames; ``owner`` is whose it is, for the message.
    """
    if not is_transform(value):
        return value
    if value.is_animated():
        raise UnsupportedError(
            f"to_world of {owner} is animated, which is not supported; give it a transformation without key "
            "frames, or render with path"
        )
    return value.eval(0.0)


def hit_flags() -> mi.RayFlags:
    """For ``compute_surface_interaction``: frames and coordinates too."""
    return mi.RayFlags.Default if hasattr(mi.RayFlags, "Default") else mi.RayFlags.All


def holds_a_mesh(parameters: Parameters) -> bool:
    """Whether ``parameters`` (of `introspection.own_parameters`) are those of a mesh."""
    return any(name in parameters for name in POSITIONS)


def faces(parameters: Parameters) -> mi.UInt32:
    """Vertices of all faces, three numbers for each."""
    return mi.UInt32(_flat(parameters["faces"]))


def positions(parameters: Parameters) -> mi.Float:
    """Positions of all vertices, three numbers for each."""
    return _of_vertices(parameters, POSITIONS)


def normals(parameters: Parameters) -> mi.Float:
    """Normals of all vertices, three numbers for each; empty if it has none."""
    return _of_vertices(parameters, NORMALS)


def has_coordinates(parameters: Parameters) -> bool:
    """Whether the mesh has texture coordinates."""
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
