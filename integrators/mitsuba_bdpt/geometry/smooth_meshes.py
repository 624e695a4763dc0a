"""Meshes with vertex normals: the face that Mitsuba sampled, and its normal.

The normal has the sign that hits report (``si.n``): that of the face's winding, turned by ``flip_normals``.
Vertex normals may point to the other side: a mirroring ``to_world`` turns the winding only.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UsageError
from ..host.introspection import named, own_parameters
from .mitsubas_choices import spread_points

_CHECKED, _OFF = 4096, 0.05  # points that are checked; largest share that may differ by rounding


class SmoothMeshes:
    """Geometric normals, as hits report them, of emitting meshes with vertex normals.

    Replicates the choice of a face in ``Mesh.sample_position``: by area, from ``sample.y``. The running sums
    of areas must be Mitsuba's, in single precision: sums in double precision select other faces (see
    experiments, section Rounding).
    """

    @staticmethod
    def of(emitters):
        """Return tables for the ``emitters`` (or None) that need them, else None."""
        faces = [e and _Faces.of(e.get_shape()) for e in emitters]
        if all(f is None for f in faces):
            return None
        tables = SmoothMeshes(faces)
        for index, (e, f) in enumerate(zip(emitters, faces, strict=True)):
            if f is not None:
                tables._check(index, e, f)
        return tables

    def __init__(self, faces):
        meshes = [mesh for mesh in faces if mesh is not None]
        self._first = np.cumsum([0, *(0 if mesh is None else len(mesh.sums) for mesh in faces)])
        starts = [np.zeros(0, int) if mesh is None else mesh.starts() for mesh in faces]
        self._steps = max(int(np.diff(s).max(initial=0)).bit_length() for s in starts)
        rows = np.concatenate([s + first for s, first in zip(starts, self._first, strict=False)])
        self._starts = mi.UInt32(rows.astype(np.uint32))
        self._area = mi.Float([0.0 if mesh is None else mesh.area for mesh in faces])
        self._normals = mi.Normal3f(np.concatenate([mesh.normals for mesh in meshes]).T.astype(np.float32))
        self._sums = mi.Float(np.concatenate([mesh.sums for mesh in meshes]))
        self._parts = mi.Float([max(len(s) - 1, 0) for s in starts])
        self._part = mi.UInt32(np.cumsum([0, *map(len, starts)]).tolist())
        dr.make_opaque(self._normals, self._sums, self._area, self._starts, self._parts, self._part)

    def _check(self, index, owner, faces):
        """Raise ``UsageError`` unless Mitsuba's sampled points are in the faces' planes."""
        u, shape = spread_points(_CHECKED), owner.get_shape()
        p = np.array(shape.sample_position(0, u).p, dtype=np.float64).T
        face = np.array(self._face(mi.UInt32(index), u.y, mi.Bool(True))) - int(self._first[index])
        with np.errstate(invalid="ignore"):  # non-finite vertices
            height = np.abs(np.einsum("ij,ij->i", p - faces.corners[face], faces.normals[face]))
        # Points are rounded by about 2e-7; a neighbour's plane is further away up to 10^7 faces.
        off = np.mean(height > 2e-6 * np.abs(faces.corners).max())
        if off > _OFF:
            raise UsageError(
                f"{off:.1%} of the points that Mitsuba samples on the mesh {named(shape)}, which emits "
                "or measures, are not on the faces of its table of areas, which Mitsuba keeps after an edit "
                "of faces; update vertex_positions with them, or load the scene "
                "anew"
            )

    def normal(self, n, index, u, active):
        """Normal of the face chosen by ``u``; ``n`` for other emitters."""
        mesh = active & (dr.gather(mi.Float, self._parts, index, active) > 0)
        return dr.select(mesh, dr.gather(mi.Normal3f, self._normals, self._face(index, u, mesh), mesh), n)

    def _face(self, index, u, mesh):
        """Row of the face chosen by ``u``, as Mitsuba's ``DiscreteDistribution::sample``."""
        parts = dr.gather(mi.Float, self._parts, index, mesh)
        part = mi.UInt32(dr.clip(u * parts, 0, dr.maximum(parts - 1, 0)))  # exact, see `_Faces.starts`
        part += dr.gather(mi.UInt32, self._part, index, mesh)
        low, high = (dr.gather(mi.UInt32, self._starts, part + end, mesh) for end in (0, 1))
        area = dr.gather(mi.Float, self._area, index, mesh)
        u = u * area
        for _ in range(self._steps):
            middle = (low + high) // 2
            value = dr.gather(mi.Float, self._sums, middle, mesh)
            right = ((value < u) | (value == 0)) & (value != area)
            low = dr.select(right & (middle < high), middle + 1, low)
            high = dr.select(right, high, middle)
        return low


@dataclass
class _Faces:
    """Faces: unit ``normals``, first ``corners`` (faces, 3), running ``sums`` of areas, total ``area``."""

    normals: np.ndarray
    corners: np.ndarray
    sums: np.ndarray
    area: float

    @staticmethod
    def of(shape) -> _Faces | None:
        """Return the faces of a mesh with curved faces (`_curved_faces`), else None."""
        cross = _curved_faces(shape)
        if cross is None:
            return None
        length = np.linalg.norm(cross, axis=1)
        params = own_parameters(shape)
        faces, positions = params["faces"], params["vertex_positions"]
        index = dr.gather(mi.Vector3u, faces, dr.arange(mi.UInt32, len(cross)))
        a, b, c = (dr.gather(mi.Point3f, positions, corner) for corner in index)
        # As in Mitsuba's Mesh::build_pmf, rounding included.
        chosen = mi.DiscreteDistribution(dr.detach(0.5 * dr.norm(dr.cross(b - a, c - a))))
        normals = cross / np.maximum(length, 1e-300)[:, None]
        corners = np.array(a, dtype=np.float64).T
        return _Faces(normals, corners, np.array(chosen.cdf), dr.slice(chosen.sum()))

    def starts(self) -> np.ndarray:
        """Faces chosen at the ends of 2^k equal parts of [0, 1] (cutpoints, Chen and Asau 1974)."""
        sums, area, parts = self.sums, np.float32(self.area), 1 << len(self.sums).bit_length()
        u = np.arange(parts + 1, dtype=np.float32) / np.float32(parts) * area
        found = np.maximum(np.searchsorted(sums, u), np.searchsorted(sums, 0, "right"))
        return np.minimum(found, np.searchsorted(sums, area)).clip(0, len(sums) - 1)


def _arrays(params) -> list[np.ndarray]:
    """Faces, vertex positions and normals, (n, 3); a shape first met as an emitter's has no mesh methods."""
    parts = params["faces"], params["vertex_positions"], params["vertex_normals"]
    return [
        np.array(part, dtype=kind).reshape(-1, 3)
        for part, kind in zip(parts, (int, float, float), strict=True)
    ]


def _curved_faces(shape):
    """Cross products of faces' edges on the side of hits' normals, (faces, 3); None if it is flat."""
    if shape is None or not shape.is_mesh():
        return None
    params = own_parameters(shape)
    # Rectangles have no vertices; other meshes may have no vertex normals.
    if "vertex_positions" not in params or not len(params["vertex_normals"]):
        return None
    faces, p, n = _arrays(params)
    if faces.max(initial=0) >= len(p):
        raise UsageError(
            f"the emitting mesh {named(shape)} has a face with vertex {faces.max()} of {len(p)}; "
            "mend the file that it comes from"
        )
    a, b, c = p[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    unit = cross / np.maximum(np.linalg.norm(cross, axis=1), 1e-300)[:, None]
    # `flip_normals` turns the normals of hits and of samples alike.
    flat = np.einsum("fvi,fi->fv", n[faces], unit) > 1 - 1e-6
    if flat.all():
        return None
    return -cross if shape.has_flipped_normals() else cross


# Largest 1 - cos between unit normals that count as one; rounding of vertices causes about 1e-14.
_SAME = 1e-10


def is_flat(shape: mi.Shape) -> bool:
    """Whether a shape has one normal, shading normals included; false if unknown."""
    if shape.shape_type() in (mi.ShapeType.Rectangle.value, mi.ShapeType.Disk.value):
        return True
    if shape.shape_type() != mi.ShapeType.Mesh.value:
        return False
    faces, vertices, normals = _arrays(own_parameters(shape))
    if not len(faces) or faces.max() >= len(vertices):
        return False
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return _are_one(np.cross(b - a, c - a)) and (not len(normals) or _are_one(normals[faces].reshape(-1, 3)))


def _are_one(normals: np.ndarray) -> bool:
    length = np.linalg.norm(normals, axis=1)
    if not (length > 0).any():
        return False
    unit = normals[length > 0] / length[length > 0, None]
    return bool((unit @ unit[0] > 1 - _SAME).all())
