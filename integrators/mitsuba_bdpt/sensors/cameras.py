"""Perspective and thin-lens cameras, one or a batch of them.

Mitsuba's ``sample_direction`` drops 28-45 % of the points under a principal point offset and is zero for a
thin lens at its default focus distance, so the importance is evaluated here. The map from directions to the
film is measured once per render from Mitsuba's own camera rays: film positions of splats and of camera
samples agree by construction, including crop window, field-of-view axis and principal point offset.

With the solid-angle density p_w = 1 / (A cos^3) of camera rays (A: area at z = 1 of the film region that
camera samples cover, cos about the optical axis), the importance of a sensor point is W_e = p_A p_w / cos
with the lens density p_A, so that camera subpaths start with weight 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import rays
from ..host.introspection import number, own_parameters, world_matrix
from .checks import inverse, rays_of
from .records import CameraConnection, CameraStart, Sensor, SensorHit, view_at

KINDS = ("PerspectiveCamera", "ThinLensCamera")


@dataclass
class _View:
    """One camera, or a table of them.

    Rows of the transforms; affine map from (x/z, y/z) to the unit square and back (four numbers each) and its
    image of (0, 0); ``area`` of the region at z = 1; clip planes; lens ``radius``; distance of the plane in
    ``focus``.
    """

    to_camera: list
    to_world: list
    to_film: list
    from_film: list
    origin: mi.Point2f
    area: mi.Float
    near: mi.Float
    far: mi.Float
    radius: mi.Float
    focus: mi.Float

    @staticmethod
    def of(values) -> _View:
        """Construct from 39 numbers or arrays, in the order of `_numbers`."""
        return _View(
            [mi.Vector4f(*values[i : i + 4]) for i in (0, 4, 8)],
            [mi.Vector4f(*values[i : i + 4]) for i in (12, 16, 20)],
            values[24:28],
            values[28:32],
            mi.Point2f(*values[32:34]),
            *values[34:39],
        )

    def lens_point(self, u_lens):
        """Point of the lens in camera coordinates."""
        disk = mi.warp.square_to_uniform_disk_concentric(u_lens) * self.radius
        return mi.Point3f(disk.x, disk.y, 0)

    def axis_cos(self, d):
        """Cosine between ``d`` (world) and the optical axis."""
        return dr.dot(mi.Vector3f(*(row.z for row in self.to_world)), d)

    def density(self, cos):
        """Solid-angle density of camera rays."""
        return dr.rcp(self.area * cos * cos * cos)

    def lens_area(self):
        return dr.pi * dr.square(self.radius)


class Camera(Sensor):
    """Perspective or thin-lens cameras of the same kind, side by side on a film."""

    def __init__(self, sensor, views):
        super().__init__(sensor)
        self.lens = views[0].class_name() == KINDS[1]
        self.needs_aperture_sample = self.lens
        self.delta = not self.lens  # no area: (1,1) with a delta emitter has measure zero
        self._count = len(views)
        self.needs_film_sample = self._count > 1
        if self.lens:
            self.no_area = "which of the batch's lenses light hits is not looked for" * (self._count > 1)
        columns = zip(*(_numbers(view, self.region.share) for view in views), strict=True)
        # Opaque, so that moving the camera does not recompile the kernel.
        self._columns = [mi.Float(list(column)) for column in columns]
        dr.make_opaque(self._columns)

    def _view(self, index) -> _View:
        if self._count == 1:
            return _View.of(self._columns)
        return _View.of([dr.gather(mi.Float, column, index) for column in self._columns])

    def _start(self, uv, u_lens, shared) -> CameraStart:
        index = mi.UInt32(0)
        if self._count > 1:
            index, x = view_at(uv.x, self._count)
            uv = mi.Point2f(x, uv.y)
        view = self._view(index)
        uv = uv - view.origin
        a = view.from_film
        lens = view.lens_point(u_lens) if self.lens else mi.Point3f(0)
        # Through the point in the focal plane that the lens centre sees at this film position.
        in_focus = mi.Point3f(a[0] * uv.x + a[1] * uv.y, a[2] * uv.x + a[3] * uv.y, 1) * view.focus
        local = dr.normalize(in_focus - lens)
        cos = local.z
        d, z0 = _transform(view.to_world, local, 0), _transform(view.to_world, lens, 1)
        near, far = view.near / cos, view.far / cos
        pdf_w = view.density(cos)
        return CameraStart(
            ray=mi.Ray3f(z0 + d * near, mi.Vector3f(d), far - near, shared.time, shared.wavelengths),
            p=z0,
            pdf_w=pdf_w,
            arrival=mi.Float(0) if self.no_area else cos * view.lens_area() / pdf_w,
        )

    def _point(self, u_lens, u_film):
        """Point of a lens, the same in camera coordinates, view index, view."""
        index = mi.UInt32(0)
        if self._count > 1:
            index, _ = view_at(u_film.x, self._count)
        view = self._view(index)
        local = view.lens_point(u_lens) if self.lens else mi.Point3f(0)
        return _transform(view.to_world, local, 1), local, index, view

    def _connection(self, point, d, dist2, to_z0=None) -> CameraConnection:
        z0, lens, index, view = point
        position, depth, inside = self._project(index, view, -d if to_z0 is None else -to_z0, lens)
        within = depth > 0
        if to_z0 is not None:
            within &= (depth >= view.near) & (depth <= view.far)
        cos = view.axis_cos(-d)
        on_near_plane = z0 - d * (view.near / cos)
        pdf_w = view.density(cos)
        return CameraConnection(
            p=mi.Point3f(z0),
            anchor=rays.free_anchor(on_near_plane),
            d=mi.Vector3f(d),
            dist2=dist2,
            importance=pdf_w,
            pdf_w=pdf_w,
            arrival=mi.Float(0) if self.no_area else cos * view.lens_area() / dist2,
            position=position,
            reach=(view.far - view.near) / cos,
            valid=inside & within,
        )

    def _project(self, index, view, outward, lens):
        """Film position, depth and visibility along ``outward`` from the point ``lens`` (camera space)."""
        local = _transform(view.to_camera, outward, 0)
        depth = local.z
        x, y = local.x / depth, local.y / depth
        if self.lens:  # intersection with the focal plane, as seen from the lens centre
            x, y = x + lens.x / view.focus, y + lens.y / view.focus
        a = view.to_film
        uv = mi.Point2f(a[0] * x + a[1] * y, a[2] * x + a[3] * y) + view.origin
        if self._count > 1:
            inside = dr.all((uv >= 0) & (uv < 1))
            uv = mi.Point2f((mi.Float(index) + uv.x) / self._count, uv.y)
        else:
            inside = self.region.contains(uv)
        return self.region.to_position(uv), depth, inside

    def hit(self, walk, vertex, distant) -> SensorHit:
        """Intersect the walk's ray with the lens, no shape; only surfaces before the near plane block it."""
        view = self._view(mi.UInt32(0))
        centre = _transform(view.to_world, mi.Point3f(0), 1)
        o, d = (_transform(view.to_camera, v, 0) for v in (walk.previous - centre, walk.d))
        towards = walk.active & (d.z < 0) & (o.z > 0)
        slope = dr.select(towards, -d.z, 1)
        distance = o.z / slope
        local = mi.Point3f(o.x + d.x * distance, o.y + d.y * distance, 0)
        on_lens = dr.square(local.x) + dr.square(local.y) <= dr.square(view.radius)
        unhidden = distant | ~walk.pi.is_valid() | (walk.pi.t >= (o.z - view.near) / slope)
        within = distant | ((o.z >= view.near) & (o.z <= view.far))
        z0 = _transform(view.to_world, local, 1)
        position, _, inside = self._project(mi.UInt32(0), view, -walk.d, local)
        pdf_a, pdf_w = dr.rcp(view.lens_area()), view.density(slope)
        return SensorHit(
            dist2=dr.square(distance),
            cos=slope,
            pdf_a=pdf_a,
            pdf_w=pdf_w,
            importance=pdf_a * pdf_w / slope,
            position=position,
            active=towards & on_lens & unhidden & within & inside,
            # Camera rays see the environment behind the far plane, even if a surface there blocks it.
            surroundings=mi.Ray3f(
                z0 - walk.d * (view.near / slope),
                -walk.d,
                (view.far - view.near) / slope,
                vertex.si.time,
                vertex.si.wavelengths,
            ),
            near=view.near / slope,
        )


def _numbers(sensor, share: float):
    """Return the numbers for `_View.of`; ``share`` see `Region`."""
    lens = sensor.class_name() == KINDS[1]
    to_world = world_matrix(sensor)
    to_film, origin = _film_map(sensor, to_world)
    # Area at z = 1 of one crop window, times the share that a border adds.
    area = 1 / abs(np.linalg.det(to_film)) * share
    values = [
        *np.linalg.inv(to_world)[:3].ravel(),
        *to_world[:3].ravel(),
        *to_film.ravel(),
        *np.linalg.inv(to_film).ravel(),
        *origin,
        area,
        sensor.near_clip(),
        sensor.far_clip(),
        own_parameters(sensor)["aperture_radius"] if lens else 0,
        sensor.focus_distance() if lens else 1,
    ]
    return [number(x) for x in values]


def _transform(rows, v, w):
    return mi.Point3f(*(dr.dot(row.xyz, mi.Vector3f(v)) + row.w * w for row in rows))


def _film_map(sensor, to_world):
    """Affine map from (x/z, y/z) in camera space to the crop window's unit square."""
    u = mi.Point2f([0, 1, 0], [0, 0, 1])
    _, d, _ = rays_of(sensor, u, mi.Point2f(0.5))
    local = np.linalg.inv(to_world[:3, :3]) @ d
    xy = (local[:2] / local[2]).T
    to_film = inverse(np.stack([xy[1] - xy[0], xy[2] - xy[0]], axis=1), sensor)
    return to_film, -to_film @ xy[0]
