"""Tables of the scene's emitters that a kernel can index."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .agreement import CHECKED, OFF, spread_points
from .emitter_kinds import AREA, DIRECTIONAL_AREA, POINT, PROJECTOR, SPOT, check_angles, is_textured
from .objects import children, matrix_of, named, own_parameters
from .spheres import Sphere, is_small


@dataclass
class Placement:
    """Where an emitter is: axes ``x``, ``y``, ``z`` and ``position`` of point and spot lights, their
    constant density of emission ``density_w`` (solid angle) within ``cos_cutoff``; ``position`` of
    projectors. Of spheres ``position``; the ``radius`` up to which one that emits inwards, and everywhere
    the same, samples as from inside, ``outward`` of a rotated one (see `Sphere`), the radius ``far`` of one
    that may be so small, as seen from the scene, that Mitsuba's density is wrong (see
    `spheres.cone_density`); 0 for all others.
    Scalars for one emitter, Dr.Jit arrays for a table of them."""

    x: object = (1, 0, 0)
    y: object = (0, 1, 0)
    z: object = (0, 0, 1)
    position: object = (0, 0, 0)
    density_w: object = 1.0
    cos_cutoff: object = -1.0
    radius: object = 0.0
    outward: object = 0.0
    far: object = 0.0

    @staticmethod
    def table(rows):
        """The rows as columns that `at` can look up."""

        def column(name):
            # Lists, not NumPy: Dr.Jit borrows an array's memory, and its alignment is part of the kernel.
            values = np.array([getattr(row, name) for row in rows], dtype=np.float64).T.tolist()
            if not isinstance(values[0], list):
                return mi.Float(values)
            return (mi.Point3f if name == "position" else mi.Vector3f)(*(mi.Float(v) for v in values))

        return Placement(**{name: column(name) for name in vars(Placement())})

    def at(self, index, active):
        """The row ``index``."""
        return Placement(**{k: dr.gather(type(v), v, index, active) for k, v in vars(self).items()})


def placement(emitter, kind, extent) -> Placement:
    """The row of one emitter in a scene of the diameter ``extent``."""
    if kind == POINT:
        position = dr.slice(mi.Point3f(own_parameters(emitter)["position"]))
        return Placement(position=position, density_w=1 / (4 * dr.pi))
    if kind == SPOT:
        check_angles(emitter)
        params = own_parameters(emitter)
        to_world = params["to_world"]
        x, y, z = (
            dr.slice(dr.normalize(mi.Vector3f(to_world @ mi.Vector3f(*a))))
            for a in ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        )
        cutoff_angle = mi.Float(params["cutoff_angle"])
        cos_cutoff = dr.slice(dr.cos(dr.deg2rad(cutoff_angle)))
        if cos_cutoff >= 1:
            raise ValueError(
                f"bdpt: spot {named(emitter)} has cutoff_angle={dr.slice(cutoff_angle):g}, a cone without "
                "width in single precision; make it 0.02 degrees or more"
            )
        return Placement(
            x=x,
            y=y,
            z=z,
            position=dr.slice(mi.Point3f(to_world @ mi.Point3f(0, 0, 0))),
            density_w=1 / (2 * dr.pi * (1 - cos_cutoff)),
            cos_cutoff=cos_cutoff,
        )
    if kind == PROJECTOR:
        to_world = own_parameters(emitter)["to_world"]
        return Placement(position=dr.slice(mi.Point3f(to_world @ mi.Point3f(0, 0, 0))))
    sphere = Sphere.of(emitter.get_shape()) if kind in (AREA, DIRECTIONAL_AREA) else None
    if sphere is not None:
        # By direction, unless it has a texture: then Mitsuba samples that, wherever the lit point is.
        by_direction = not is_textured(emitter, kind)
        small = kind == AREA and by_direction and is_small(sphere, extent)
        return Placement(
            position=sphere.center,
            # Mitsuba's RayEpsilon, as in Sphere::sample_direction.
            radius=sphere.radius * (1 + 1500 * 2.0**-24) if by_direction and sphere.outward < 0 else 0.0,
            outward=sphere.outward if sphere.turned else 0.0,
            far=sphere.radius if small else 0.0,
        )
    return Placement()


class Projectors:
    """What the scene's projectors send into each direction, as densities: Mitsuba offers none.

    A projector's ``uv`` is an affine map of (x / z, y / z) about its axis, read off its own answers.
    """

    @staticmethod
    def of(emitters, kinds):
        """Those of ``emitters`` that are projectors, or None."""
        found = [(i, e) for i, (e, k) in enumerate(zip(emitters, kinds, strict=True)) if k == PROJECTOR]
        return Projectors(found) if found else None

    def __init__(self, projectors):
        self._rows = [(index, _Projector(emitter)) for index, emitter in projectors]

    def sample(self, index, u, active):
        """Direction (world, unit length) and its density (solid angle) from the projector ``index``."""
        d, pdf_w = mi.Vector3f(0, 0, 1), mi.Float(1)
        for number, projector in self._rows:
            mask = active & (index == number)
            sampled, density = projector.sample(u, mask)
            d, pdf_w = dr.select(mask, sampled, d), dr.select(mask, density, pdf_w)
        return d, pdf_w

    def density(self, index, d, active):
        """Density (solid angle) of the direction ``d`` from the projector ``index``; 0 for others."""
        pdf_w = mi.Float(0)
        for number, projector in self._rows:
            mask = active & (index == number)
            pdf_w = dr.select(mask, projector.density(d, mask), pdf_w)
        return pdf_w


class _Projector:
    """One projector: axes ``x``, ``y``, ``z`` (unit length), the affine map to ``uv`` and back, and the
    texture that it chooses directions by, None where that would miss some: with ``to_uv`` Mitsuba's textures
    sample another image than they show."""

    def __init__(self, emitter):
        check_angles(emitter)
        matrix = matrix_of(emitter)
        probes = matrix @ np.array([[0, 0, 1, 1], [1, 0, 1, 1], [0, 1, 1, 1]], dtype=np.float64).T
        it = dr.zeros(mi.Interaction3f, 3)
        it.p = mi.Point3f(*(mi.Float(row.tolist()) for row in probes[:3]))
        ds, _ = emitter.sample_direction(it, mi.Point2f(0.5))
        uv = np.array(ds.uv, dtype=np.float64)
        to_uv = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=1)
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
        self._axes = [dr.opaque(mi.Vector3f, column.tolist()) for column in axes.T]
        self._origin = dr.opaque(mi.Point2f, uv[:, 0].tolist())
        self._to_uv = [dr.opaque(mi.Float, float(x)) for x in to_uv.ravel()]
        self._from_uv = [dr.opaque(mi.Float, float(x)) for x in np.linalg.inv(to_uv).ravel()]
        self._area = dr.opaque(mi.Float, abs(np.linalg.det(np.linalg.inv(to_uv))))
        texture = children(emitter)["irradiance"]
        self._texture = texture if texture.is_spatially_varying() and _is_as_it_was(texture) else None

    def sample(self, u, active):
        """Direction and its density (solid angle)."""
        uv, pdf = mi.Point2f(u), mi.Float(1)
        if self._texture is not None:
            uv, pdf = self._texture.sample_position(u, active)
        offset, back = uv - self._origin, self._from_uv
        x, y = back[0] * offset.x + back[1] * offset.y, back[2] * offset.x + back[3] * offset.y
        local = dr.normalize(mi.Vector3f(x, y, 1))
        d = self._axes[0] * local.x + self._axes[1] * local.y + self._axes[2] * local.z
        return d, self._to_solid_angle(pdf, local.z)

    def density(self, d, active):
        """Density (solid angle) with which `sample` returns the direction ``d``."""
        x, y, z = (dr.dot(axis, d) for axis in self._axes)
        a = self._to_uv
        uv = self._origin + mi.Point2f(a[0] * x + a[1] * y, a[2] * x + a[3] * y) / z
        active = active & (z > 0) & dr.all((uv >= 0) & (uv <= 1))
        pdf = mi.Float(1)
        if self._texture is not None:
            pdf = self._texture.pdf_position(uv, active)
        return dr.select(active, self._to_solid_angle(pdf, z), 0)

    def _to_solid_angle(self, pdf, cos):
        return pdf / (self._area * cos * cos * cos)


def _is_as_it_was(texture) -> bool:
    """Whether a texture has no ``to_uv`` that changes it."""
    found = own_parameters(texture)
    if "to_uv" not in found:
        return True
    return np.allclose(np.array(found["to_uv"].matrix).reshape(3, 3), np.eye(3), atol=1e-7)


class SmoothMeshes:
    """Geometric normals of emitting meshes that have vertex normals.

    Repeats the choice of a face that ``Mesh.sample_position`` makes: by area, from ``sample.y``. Mitsuba's
    table is of sums of areas in single precision, so the choice is repeated on the same sums, made in the
    same way: those in double precision find another face for 23 % of the points of a sphere of 32,512 faces.
    """

    @staticmethod
    def of(emitters):
        """Tables for those of ``emitters`` that need them, or None. An emitter may be None."""
        faces = [e and _Faces.of(e.get_shape()) for e in emitters]
        if all(f is None for f in faces):
            return None
        tables = SmoothMeshes(faces)
        for index, (e, f) in enumerate(zip(emitters, faces, strict=True)):
            if f is not None:
                tables._check(index, e, f)
        return tables

    def __init__(self, faces):
        normals, sums, first, count, area = [], [], [], [], []
        for mesh in faces:
            first.append(sum(len(s) for s in sums))
            count.append(0 if mesh is None else len(mesh.normals))
            area.append(0.0 if mesh is None else mesh.area)
            if mesh is not None:
                normals.append(mesh.normals)
                sums.append(mesh.sums)
        self._normals = mi.Normal3f(*(mi.Float(v) for v in np.concatenate(normals).T.tolist()))
        self._sums, self._area = mi.Float(np.concatenate(sums).tolist()), mi.Float(area)
        self._first, self._count = mi.UInt32(first), mi.UInt32(count)
        self._steps = max(count).bit_length()
        dr.make_opaque(self._normals, self._sums, self._area, self._first, self._count)

    def _check(self, index, owner, faces):
        """Raise ``ValueError`` unless the points that Mitsuba samples are in the planes of the faces here."""
        u, shape = spread_points(CHECKED), owner.get_shape()
        p = np.array(shape.sample_position(0, u).p, dtype=np.float64).T
        face = np.array(self._face(mi.UInt32(index), u.y, mi.Bool(True))) - int(self._first[index])
        with np.errstate(invalid="ignore"):  # vertices that are not finite
            height = np.abs(np.einsum("ij,ij->i", p - faces.corners[face], faces.normals[face]))
        # Rounding of the points is some 2e-7. A neighbour's plane is further away up to 10^7 faces.
        off = np.mean(height > 2e-6 * np.abs(faces.corners).max())
        if off > OFF:
            raise ValueError(
                f"bdpt: {off:.1%} of the points that Mitsuba samples on the mesh {named(shape)}, which emits "
                "or measures, are not on the faces that its areas tell: after an edit of faces Mitsuba keeps "
                "its table of areas; update vertex_positions with them, or load the scene anew"
            )

    def normal(self, n, index, u, active):
        """Normal of the face chosen by ``u``; ``n`` for emitters that are no such mesh."""
        mesh = active & (dr.gather(mi.UInt32, self._count, index, active) > 0)
        return dr.select(mesh, dr.gather(mi.Normal3f, self._normals, self._face(index, u, mesh), mesh), n)

    def _face(self, index, u, mesh):
        """Row of the face that ``u`` chooses, as `DiscreteDistribution::sample` of Mitsuba does."""
        low = dr.gather(mi.UInt32, self._first, index, mesh)
        high = dr.select(mesh, low + dr.gather(mi.UInt32, self._count, index, mesh) - 1, low)
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
    """The faces of a mesh: unit ``normals`` and first ``corners`` (faces, 3), the running ``sums`` of their
    areas as Mitsuba has them, and the whole ``area``."""

    normals: np.ndarray
    corners: np.ndarray
    sums: np.ndarray
    area: float

    @staticmethod
    def of(shape) -> _Faces | None:
        """Those of a mesh whose vertex normals differ from its faces' normals; None for all other shapes."""
        cross = _curved_faces(shape)
        if cross is None:
            return None
        length = np.linalg.norm(cross, axis=1)
        params = own_parameters(shape)
        faces, positions = mi.UInt32(params["faces"]), mi.Float(params["vertex_positions"])
        index = dr.gather(mi.Vector3u, faces, dr.arange(mi.UInt32, len(cross)))
        a, b, c = (dr.gather(mi.Point3f, positions, corner) for corner in index)
        # As Mesh::build_pmf of Mitsuba, rounding included.
        chosen = mi.DiscreteDistribution(dr.detach(0.5 * dr.norm(dr.cross(b - a, c - a))))
        normals = cross / np.maximum(length, 1e-300)[:, None]
        corners = np.array(a, dtype=np.float64).T
        return _Faces(normals, corners, np.array(chosen.cdf), dr.slice(chosen.sum()))


def _curved_faces(shape):
    """Cross products of the edges of each face, shape (faces, 3), for a mesh whose vertex normals
    differ from its faces' normals; None for all other shapes."""
    if shape is None or not shape.is_mesh():
        return None
    params = own_parameters(shape)
    # Neither a rectangle (flat, without vertices) nor a mesh without normals at its vertices.
    if "vertex_positions" not in params or not len(params["vertex_normals"]):
        return None
    faces = np.array(params["faces"]).reshape(-1, 3)
    p = np.array(params["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    n = np.array(params["vertex_normals"], dtype=np.float64).reshape(-1, 3)
    if faces.max(initial=0) >= len(p):
        raise ValueError(
            f"bdpt: the emitting mesh {named(shape)} has a face with vertex {faces.max()} of {len(p)}; "
            "mend the file that it comes from"
        )
    a, b, c = p[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    unit = cross / np.maximum(np.linalg.norm(cross, axis=1), 1e-300)[:, None]
    flat = np.abs(np.einsum("fvi,fi->fv", n[faces], unit)) > 1 - 1e-6
    return None if flat.all() else cross


def inverse_table(pointers):
    """Emitter index by the number that Dr.Jit gives to a pointer."""
    ids = dr.reinterpret_array(mi.UInt32, pointers).numpy()
    table = [0] * (int(ids.max()) + 1)
    for index, number in enumerate(ids):
        table[int(number)] = index
    return mi.UInt32(table)
