"""Camera endpoints: the only file that knows kinds of sensors.

Mitsuba's ``sample_direction`` drops 28-45 % of the points under a principal point offset and is
zero for a thin lens at its default focus distance, so the importance is evaluated here. The map
from directions to the film is read off Mitsuba's own camera rays, once per render: film positions
of splats and of camera samples agree by construction, crop window, field-of-view axis and principal
point offset included.

With the solid-angle density p_w = 1 / (A cos^3) of camera rays (A: area at z = 1 of the film region
that camera samples cover, cos about the optical axis), the importance of a sensor point is W_e = p_w
after division by the lens density, so that camera subpaths start with throughput 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import rays

_KINDS = ("PerspectiveCamera", "ThinLensCamera")


@dataclass
class CameraStart:
    """Start of a camera subpath: ``ray`` (on the near plane), ``p`` of z_0,
    ``pdf_w`` density of the direction (solid angle), ``position`` on the film in pixels,
    ``counted`` where the filter counts it (a box filter: at the pixel's corner, as Mitsuba does)."""

    ray: object
    p: object
    pdf_w: object
    position: object
    counted: object


@dataclass
class CameraJoin:
    """z_0 joined with a point of the scene.

    ``anchor`` on the near plane, where visibility ends; ``d`` unit direction from the point to z_0;
    ``dist2`` squared distance to z_0; ``importance`` W_e over the density of z_0, equal to the
    solid-angle density p_w with which a camera subpath leaves towards the point; ``position`` on
    the film in pixels; ``reach`` length of camera rays along ``-d``; ``valid``: within the film region
    and the clip planes.
    """

    anchor: rays.Anchor
    d: object
    dist2: object
    importance: object
    position: object
    reach: object
    valid: object


class Camera:
    """A perspective or thin-lens sensor, prepared for one render.

    Raises ``NotImplementedError`` for other kinds of sensors.
    """

    def __init__(self, sensor):
        name = sensor.class_name()
        if name not in _KINDS:
            raise NotImplementedError(
                f"bdpt: sensor '{sensor.id()}' of class {name} is not supported yet; supported are "
                "perspective and thinlens. Replace it, or use integrator type 'path'."
            )
        self.sensor = sensor
        self.lens = name == "ThinLensCamera"
        self.delta = not self.lens  # no area: (1,1) with a delta emitter has measure zero
        film = sensor.film()
        self.border = film.rfilter().border_size() if film.sample_border() else 0
        self.box = film.rfilter().is_box_filter()
        self.crop_size = np.array(film.crop_size(), dtype=int)
        self.crop_offset = np.array(film.crop_offset(), dtype=int)
        self.region = self.crop_size + 2 * self.border
        params = mi.traverse(sensor)
        world = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        to_film, origin = _film_map(sensor, world, self.lens)
        # Area at z = 1 that one crop window covers, times the share that a border adds.
        area = 1 / abs(np.linalg.det(to_film)) * np.prod(self.region / self.crop_size)
        margin = self.border / self.crop_size
        values = [
            *np.linalg.inv(world)[:3].ravel(),
            *world[:3].ravel(),
            *to_film.ravel(),
            *np.linalg.inv(to_film).ravel(),
            *origin,
            area,
            *-margin,
            *(1 + margin),
            sensor.near_clip(),
            sensor.far_clip(),
            params["aperture_radius"] if self.lens else 0,
            sensor.focus_distance() if self.lens else 1,
        ]
        # Opaque, so that moving the camera does not recompile the kernel.
        v = [dr.opaque(mi.Float, _number(x)) for x in values]
        self._to_camera = [mi.Vector4f(*v[i : i + 4]) for i in (0, 4, 8)]
        self._to_world = [mi.Vector4f(*v[i : i + 4]) for i in (12, 16, 20)]
        self._to_film, self._from_film, self._origin = v[24:28], v[28:32], mi.Point2f(*v[32:34])
        self._area = v[34]
        self._low, self._high = mi.Point2f(*v[35:37]), mi.Point2f(*v[37:39])
        self._near, self._far, self._radius, self._focus = v[39:43]
        self._width = dr.opaque(mi.UInt32, int(self.region[0]))
        self._first = dr.opaque(mi.Point2i, (self.crop_offset - self.border).tolist())
        self._size = dr.opaque(mi.Point2f, self.crop_size.astype(float).tolist())
        self._offset = dr.opaque(mi.Point2f, self.crop_offset.astype(float).tolist())

    def pixel(self, index):
        """Film pixel of the ``index``-th pixel of the region (row by row), as ``mi.Point2i``."""
        y = index // self._width
        x = index - y * self._width
        return mi.Point2i(mi.Int32(x), mi.Int32(y)) + self._first

    def start(self, pixel, u_film, u_lens, like) -> CameraStart:
        """Start of a camera subpath through ``pixel``; ``like`` carries time and wavelengths."""
        position = mi.Point2f(pixel) + u_film
        uv = (position - self._offset) / self._size - self._origin
        a, lens = self._from_film, self._lens_local(u_lens)
        # Through the point of the plane in focus that the lens centre sees at this film position.
        in_focus = mi.Point3f(a[0] * uv.x + a[1] * uv.y, a[2] * uv.x + a[3] * uv.y, 1) * self._focus
        local = dr.normalize(in_focus - lens)
        cos = local.z
        d, z0 = _transform(self._to_world, local, 0), _transform(self._to_world, lens, 1)
        near, far = self._near / cos, self._far / cos
        return CameraStart(
            ray=mi.Ray3f(z0 + d * near, mi.Vector3f(d), far - near, like.time, like.wavelengths),
            p=z0,
            pdf_w=self._density(cos),
            position=position,
            counted=mi.Point2f(pixel) if self.box else position,
        )

    def join(self, p, u_lens) -> CameraJoin:
        """Join the scene point ``p`` with a point of the lens chosen by ``u_lens``."""
        z0 = self._lens_point(u_lens)
        to_z0 = z0 - p
        dist2 = dr.squared_norm(to_z0)
        d = to_z0 * dr.rsqrt(dist2)
        return self._join(p - z0, d, dist2, z0, (self._near, self._far))

    def join_direction(self, d, u_lens) -> CameraJoin:
        """As `join`, with light that travels along ``d`` from infinity; ``dist2`` is 1."""
        return self._join(-d, mi.Vector3f(d), mi.Float(1), self._lens_point(u_lens), (0, dr.inf))

    def _join(self, outward, d, dist2, z0, clip) -> CameraJoin:
        local = _transform(self._to_camera, outward, 0)  # from z_0, camera coordinates
        depth = local.z
        # The film position is where the line crosses the plane in focus, seen from the lens centre.
        lens = _transform(self._to_camera, z0, 1)
        x = local.x / depth + lens.x / self._focus
        y = local.y / depth + lens.y / self._focus
        a = self._to_film
        uv = mi.Point2f(a[0] * x + a[1] * y, a[2] * x + a[3] * y) + self._origin
        inside = dr.all((uv >= self._low) & (uv < self._high))
        within = (depth > 0) & (depth >= clip[0]) & (depth <= clip[1])
        cos = self._axis_cos(-d)
        on_near_plane = z0 - d * (self._near / cos)
        return CameraJoin(
            anchor=rays.free_anchor(on_near_plane),
            d=mi.Vector3f(d),
            dist2=dist2,
            importance=self._density(cos),
            position=uv * self._size + self._offset,
            reach=(self._far - self._near) / cos,
            valid=inside & within,
        )

    def _lens_point(self, u_lens):
        return _transform(self._to_world, self._lens_local(u_lens), 1)

    def _lens_local(self, u_lens):
        if not self.lens:
            return mi.Point3f(0)
        disk = mi.warp.square_to_uniform_disk_concentric(u_lens) * self._radius
        return mi.Point3f(disk.x, disk.y, 0)

    def _axis_cos(self, d):
        return dr.dot(mi.Vector3f(*(row.z for row in self._to_world)), d)

    def _density(self, cos):
        return dr.rcp(self._area * cos * cos * cos)


def _transform(rows, v, w):
    return mi.Point3f(*(dr.dot(row.xyz, mi.Vector3f(v)) + row.w * w for row in rows))


def _number(x) -> float:
    return float(dr.slice(x) if dr.is_array_v(x) else x)


def _film_map(sensor, world, lens: bool):
    """Affine map from (x/z, y/z) in camera space to the crop window's unit square."""
    u = mi.Point2f([0, 1, 0], [0, 0, 1])
    ray, _ = sensor.sample_ray(0, 0.5, u, mi.Point2f(0.5))
    d = np.array(ray.d, dtype=np.float64)
    local = np.linalg.inv(world[:3, :3]) @ d
    xy = (local[:2] / local[2]).T
    to_film = np.linalg.inv(np.stack([xy[1] - xy[0], xy[2] - xy[0]], axis=1))
    return to_film, -to_film @ xy[0]
