"""Parallel sensors, irradiance meters, and sensors that only Mitsuba samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import rays
from ..geometry.quadrics import Sphere, sphere_normal
from ..geometry.smooth_meshes import SmoothMeshes
from ..host.introspection import number
from .checks import inverse, rays_of
from .records import CameraConnection, CameraStart, Sensor, SensorHit, view_at


class _Parallel(Sensor):
    """Sensors whose rays have one direction ``axis``; connections project along it.

    z_0 has the density ``density`` (over the area across the axis) and W_e = density: camera subpaths start
    with weight 1.
    """

    parallel = True
    _axis = _density = None  # set by the subclasses
    no_area = "its rays have one direction, which a light subpath takes with probability zero"

    def _starting(self, o, reach, shared) -> CameraStart:
        return CameraStart(
            ray=mi.Ray3f(o, mi.Vector3f(self._axis), reach, shared.time, shared.wavelengths),
            p=mi.Point3f(o),
            pdf_w=self._density,
        )

    def _connected(self, z0, position, valid) -> CameraConnection:
        return CameraConnection(
            p=mi.Point3f(z0),
            anchor=rays.free_anchor(z0),
            d=-self._axis,
            dist2=mi.Float(1),
            importance=self._density,
            pdf_w=self._density,
            position=position,
            valid=valid,
        )


class Orthographic(_Parallel):
    """An orthographic camera, which has no ``sample_direction``: its rays define it."""

    def __init__(self, sensor):
        super().__init__(sensor)
        o, d, ray = rays_of(sensor, mi.Point2f([0, 1, 0], [0, 0, 1]), mi.Point2f(0.5))
        origin, axis = o[:, 0], d[:, 0] / np.linalg.norm(d[:, 0])
        basis = np.stack([o[:, 1] - origin, o[:, 2] - origin, axis], axis=1)
        rows = inverse(basis, sensor)
        vector = mi.Vector3f
        self._origin, self._axis = dr.opaque(mi.Point3f, origin.tolist()), dr.opaque(vector, axis.tolist())
        self._along = [dr.opaque(vector, basis[:, i].tolist()) for i in (0, 1)]
        self._rows = [dr.opaque(vector, row.tolist()) for row in rows]
        self._reach = dr.opaque(mi.Float, number(dr.slice(ray.maxt, 0)))
        self._density = dr.opaque(mi.Float, 1 / (abs(np.linalg.det(basis)) * self.region.share))

    def _start(self, uv, u_lens, shared) -> CameraStart:
        return self._starting(self._on_near_plane(uv), self._reach, shared)

    def _on_near_plane(self, uv):
        return self._origin + self._along[0] * uv.x + self._along[1] * uv.y

    def connect(self, p, u_lens, u_film) -> CameraConnection:
        from_origin = p - self._origin
        x, y, depth = (dr.dot(row, from_origin) for row in self._rows)
        uv = mi.Point2f(x, y)
        valid = self.region.contains(uv) & (depth >= 0) & (depth <= self._reach)
        return self._connected(self._on_near_plane(uv), self.region.to_position(uv), valid)


class Distant(_Parallel):
    """A distant sensor without target: one pixel, rays from a disk about the scene."""

    needs_aperture_sample = True
    needs_film_sample = True

    def __init__(self, sensor):
        super().__init__(sensor)
        u = mi.Point2f([0.5, 1, 0.5], [0.5, 0.5, 1])  # the middle and two points of the rim
        o, d, _ = rays_of(sensor, mi.Point2f(0.5), u)
        axis, across = d[:, 0] / np.linalg.norm(d[:, 0]), o[:, 1:] - o[:, :1]
        self._origin = dr.opaque(mi.Point3f, o[:, 0].tolist())
        self._axis = dr.opaque(mi.Vector3f, axis.tolist())
        self._across = [dr.opaque(mi.Vector3f, across[:, i].tolist()) for i in (0, 1)]
        radius2 = float((across**2).sum(0).mean())
        self._radius2 = dr.opaque(mi.Float, radius2)
        self._density = dr.opaque(mi.Float, 1 / (np.pi * radius2))

    def _start(self, uv, u_lens, shared) -> CameraStart:
        disk = mi.warp.square_to_uniform_disk_concentric(u_lens)
        o = self._origin + self._across[0] * disk.x + self._across[1] * disk.y
        return self._starting(o, mi.Float(dr.inf), shared)

    def connect(self, p, u_lens, u_film) -> CameraConnection:
        from_origin = p - self._origin
        depth = dr.dot(from_origin, self._axis)
        aside = from_origin - self._axis * depth
        z0 = self._origin + aside
        valid = (depth >= 0) & (dr.squared_norm(aside) <= self._radius2)
        return self._connected(z0, self.region.anywhere(u_film), valid)


class _Face:
    """The shape of one irradiance meter, with the points that its film samples."""

    def __init__(self, sensor, shape_errors):
        self.shape, self._shape_errors = sensor.get_shape(), shape_errors
        self._smooth_mesh = SmoothMeshes.of([sensor])
        sphere = Sphere.of(self.shape)
        self._sphere = sphere if sphere is not None and sphere.turned else None

    def sample(self, u, shared):
        ps = self.shape.sample_position(shared.time, u)
        if self._sphere is not None:
            ps.n = sphere_normal(ps.p, self._sphere.center, self._sphere.outward)
        n = ps.n
        if self._smooth_mesh is not None:
            n = self._smooth_mesh.normal(n, mi.UInt32(0), u.y, mi.Bool(True))
        anchor = rays.sampled_anchor(ps.p, n, self._shape_errors.at(mi.ShapePtr(self.shape)))
        return mi.Point3f(ps.p), mi.Normal3f(ps.n), anchor


class IrradianceMeter(Sensor):
    """An irradiance meter, or several side by side (the views of a batch).

    z_0 is uniform on its shape (area measure), directions are distributed by the cosine with the shading
    normal, W_e = 1 / area * (cosine with the shading normal / cosine with the geometric normal). As in
    Mitsuba, the film position chooses the view and z_0.
    """

    needs_aperture_sample = True
    delta = False
    needs_film_sample = True

    def __init__(self, sensor, shape_errors, views=None, in_scene=True):
        super().__init__(sensor)
        self._faces = [_Face(view, shape_errors) for view in views or [sensor]]
        self._density = dr.opaque(mi.Float, 1 / number(self._faces[0].shape.surface_area()))
        self.no_area = self._why_no_area(in_scene)

    def _why_no_area(self, in_scene: bool) -> str:
        if len(self._faces) > 1:
            return "which of the batch's meters light hits is not looked for"
        if not in_scene:
            return "the meter's shape is not in the scene"
        if self.region.box and tuple(self.region.crop_size) == (1, 1):
            return ""
        return (
            "with more than one pixel, or a filter other than box, the film position of a point of its "
            "shape is unknown"
        )

    def _sample(self, u, shared):
        if len(self._faces) == 1:
            return self._faces[0].sample(u, shared)
        index, x = view_at(u.x, len(self._faces))
        u = mi.Point2f(x, u.y)
        found = self._faces[0].sample(u, shared)
        for i, face in enumerate(self._faces[1:], 1):
            found = dr.select(index == i, face.sample(u, shared), found)
        return found

    def _start(self, uv, u_lens, shared) -> CameraStart:
        p, n, anchor = self._sample(uv, shared)
        local = mi.warp.square_to_cosine_hemisphere(u_lens)
        d = mi.Frame3f(n).to_world(local)
        pdf_w = local.z * dr.inv_pi
        return CameraStart(
            ray=mi.Ray3f(rays.spawn(anchor, d, shared)),
            p=p,
            pdf_w=pdf_w,
            weight=mi.Float(dr.pi),
            # cos / (density * cos / pi)
            arrival=mi.Float(0) if self.no_area else dr.pi / self._density,
        )

    def _point(self, u_lens, u_film):
        any_time = dr.zeros(mi.Interaction3f)  # shapes do not move
        return *self._sample(u_film, any_time), u_film

    def _connection(self, point, d, dist2, to_z0=None) -> CameraConnection:
        z0, n, anchor, u_film = point
        cos = dr.dot(n, -d)
        return CameraConnection(
            p=z0,
            anchor=anchor,
            d=d,
            dist2=dist2,
            importance=cos,
            pdf_w=cos * dr.inv_pi,
            arrival=mi.Float(0) if self.no_area else cos / (dist2 * self._density),
            position=self.region.to_position(u_film),
            valid=cos > 0,
        )

    def hit(self, walk, vertex, distant) -> SensorHit:
        si = vertex.si
        cos = dr.maximum(mi.Frame3f.cos_theta(si.wi), 0)
        return SensorHit(
            dist2=dr.squared_norm(si.p - walk.previous),
            cos=cos,  # as in `start` and `connect`, so that all strategies have the same weights
            pdf_a=self._density,
            pdf_w=cos * dr.inv_pi,
            importance=self._density * cos / vertex.cos,
            position=self.region.to_position(mi.Point2f(0.5)),
            active=vertex.hit & (cos > 0) & (si.shape == mi.ShapePtr(self._faces[0].shape)),
        )


class RayOnlySensor(Sensor):
    """Sensors, one or several side by side, that use Mitsuba's camera rays alone."""

    needs_aperture_sample = True

    def __init__(self, sensor, reason: str, views=None):
        super().__init__(sensor)
        self.reason = self.no_area = reason
        self._views = views or [sensor]
        # Whether direct light of delta emitters reaches it, as far as known.
        area = (v.class_name() == "ThinLensCamera" or v.get_shape() is not None for v in self._views)
        self.delta = not any(area)

    def _start(self, uv, u_lens, shared) -> CameraStart:
        index, x = view_at(uv.x, len(self._views))
        uv = mi.Point2f(x, uv.y)
        ray, weight = _sampled(self._views[0], uv, u_lens, shared)
        for i, view in enumerate(self._views[1:], 1):
            chosen = index == i
            other, other_weight = _sampled(view, uv, u_lens, shared)
            ray, weight = dr.select(chosen, other, ray), dr.select(chosen, other_weight, weight)
        # The weight of the wavelengths is applied when the sample is added to the film.
        weight = dr.select(shared.weight != 0, weight / shared.weight, 0)
        return CameraStart(ray, mi.Point3f(ray.o), mi.Float(1), weight)


def _sampled(view, uv, u_lens, shared):
    ray, weight = view.sample_ray_differential(shared.time, shared.u_wavelength, uv, u_lens)
    return mi.Ray3f(ray.o, ray.d, ray.maxt, shared.time, shared.wavelengths), mi.unpolarized_spectrum(weight)
