"""Interface of sensors: camera subpath starts, connections, light subpath hits."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry import rays


@dataclass
class CameraStart:
    """Start of a camera subpath.

    ``ray`` (for cameras on the near plane); ``p`` of z_0; ``pdf_w`` density of the direction given z_0 (solid
    angle; for a parallel sensor, whose direction is fixed, the density of z_0 over the area across it);
    ``weight`` W_e cos / all densities; ``arrival`` cos / (density of z_0 * ``pdf_w``), the start of t = 0 (0
    without area); ``position`` on the film in pixels; ``counted`` position that the filter uses (a box
    filter: the pixel's corner, as in Mitsuba).
    """

    ray: mi.Ray3f
    p: mi.Point3f
    pdf_w: mi.Float
    weight: mi.Float | mi.UnpolarizedSpectrum = field(default_factory=lambda: mi.Float(1))
    arrival: mi.Float = field(default_factory=lambda: mi.Float(0))
    position: mi.Point2f | None = None
    counted: mi.Point2f | None = None


@dataclass
class CameraConnection:
    """A connection of a scene point with z_0.

    ``p`` of z_0; ``anchor`` end of the shadow ray (for cameras on the near plane); ``d`` unit direction from
    the point to z_0; ``dist2`` squared distance to z_0 (1 to a parallel sensor); ``importance`` W_e cos /
    density of z_0 (for a parallel sensor, whose z_0 follows from the point, W_e alone); ``pdf_w`` as in
    `CameraStart`, towards the point; ``arrival`` cos / (dist2 * density of z_0), which times a density of
    directions at the point is the ratio of t = 0 and t = 1 (0 without area); ``position`` on the film in
    pixels; ``reach`` length of camera rays along ``-d``; ``valid``: on the film, and within the clip planes.
    """

    p: mi.Point3f
    anchor: rays.Anchor
    d: mi.Vector3f
    dist2: mi.Float
    importance: mi.Float
    pdf_w: mi.Float
    position: mi.Point2f
    valid: mi.Bool
    reach: mi.Float = field(default_factory=lambda: mi.Float(dr.inf))
    arrival: mi.Float = field(default_factory=lambda: mi.Float(0))


@dataclass
class SensorHit:
    """A light subpath that hits the sensor at z_0.

    ``dist2`` of its last edge; ``cos`` at z_0; ``pdf_a`` density of z_0 (area measure) and ``pdf_w`` (solid
    angle) of the reverse direction in camera subpaths; ``importance`` W_e; ``position`` on the film in
    pixels; ``active``; ``surroundings``: ray from z_0 that must be unoccluded if the light comes from
    infinity (None where the subpath's own ray has shown it), see `CameraConnection.reach`; ``near`` distance
    from z_0 at which camera rays along its last edge start.
    """

    dist2: mi.Float
    cos: mi.Float
    pdf_a: mi.Float
    pdf_w: mi.Float
    importance: mi.Float
    position: mi.Point2f
    active: mi.Bool
    surroundings: mi.Ray3f | None = None
    near: mi.Float | float = 0.0


class Region:
    """The film region that camera samples cover: crop window and ``sample_border``.

    ``crop_size``, ``crop_offset``, ``size`` (width, height) and ``border`` in pixels; ``box``: of a box
    filter; ``share``: area relative to the crop window's.
    """

    def __init__(self, film: mi.Film):
        self.border: int = film.rfilter().border_size() if film.sample_border() else 0
        self.box = film.rfilter().is_box_filter()
        self.crop_size = np.array(film.crop_size(), dtype=int)
        self.crop_offset = np.array(film.crop_offset(), dtype=int)
        self.size = self.crop_size + 2 * self.border
        self.share = float(np.prod(self.size / self.crop_size))
        margin = self.border / self.crop_size
        self.low = dr.opaque(mi.Point2f, (-margin).tolist())
        self.high = dr.opaque(mi.Point2f, (1 + margin).tolist())
        self._width = dr.opaque(mi.UInt32, int(self.size[0]))
        self._first = dr.opaque(mi.Point2i, (self.crop_offset - self.border).tolist())
        self._size = dr.opaque(mi.Point2f, self.crop_size.astype(float).tolist())
        self._offset = dr.opaque(mi.Point2f, self.crop_offset.astype(float).tolist())

    def pixel(self, index: mi.UInt32) -> mi.Point2i:
        """Film pixel of the ``index``-th pixel of the region (row by row)."""
        y = index // self._width
        return mi.Point2i(mi.Int32(index - y * self._width), mi.Int32(y)) + self._first

    def to_uv(self, position: mi.Point2f) -> mi.Point2f:
        """Film position in the unit square of the crop window (beyond it in the border)."""
        return (position - self._offset) / self._size

    def tile(self, position: mi.Point2f, tiles: int) -> mi.UInt32:
        """Index of the tile at a film ``position``, of ``tiles`` per direction, row by row."""
        xy = dr.minimum(mi.Point2u(dr.clip(self.to_uv(position), 0, 1) * tiles), tiles - 1)
        return mi.UInt32(xy.y * tiles + xy.x)

    def to_position(self, uv: mi.Point2f) -> mi.Point2f:
        """Inverse of `to_uv`."""
        return mi.Point2f(uv) * self._size + self._offset

    def anywhere(self, u: mi.Point2f) -> mi.Point2f:
        """Film position that ``u`` in [0, 1)^2 chooses uniformly."""
        return self.to_position(self.low + u * (self.high - self.low))

    def contains(self, uv: mi.Point2f):
        return dr.all((uv >= self.low) & (uv < self.high))


def view_at(x: mi.Float, count: int) -> tuple[mi.UInt32, mi.Float]:
    """Index of the view among ``count`` side by side, and the position ``x`` in it."""
    index = dr.minimum(mi.UInt32(x * count), count - 1)
    return index, x * count - mi.Float(index)


class Sensor:
    """Interface of a sensor; made for each render.

    * ``region`` of the film; ``parallel``: all camera rays have one direction.
    * ``needs_aperture_sample``: z_0 needs a random point; ``needs_film_sample``: a connection a second one.
    * ``delta``: a connection with a delta emitter has measure zero.
    * ``reason``: why vertices of light subpaths cannot be connected to it; empty if they can.
    * ``no_area``: why light subpaths cannot hit it (t = 0); empty if they can.
    """

    needs_aperture_sample = False
    delta = True
    parallel = False
    needs_film_sample = False
    reason = ""
    no_area = "light cannot hit a pinhole (delta) sensor"

    def __init__(self, sensor: mi.Sensor):
        self.sensor = sensor
        self.region = Region(sensor.film())

    def start(self, pixel: mi.Point2i, u_film: mi.Point2f, u_lens: mi.Point2f, shared) -> CameraStart:
        """Start a camera subpath through ``pixel``; ``shared``: time and wavelengths."""
        position = mi.Point2f(pixel) + u_film
        start = self._start(self.region.to_uv(position), u_lens, shared)
        counted = mi.Point2f(pixel) if self.region.box else position
        return replace(start, position=position, counted=counted)

    def _start(self, uv, u_lens, shared) -> CameraStart:
        """Like `start`, from the unit square, without ``position`` and ``counted``."""
        raise NotImplementedError

    def connect(self, p: mi.Point3f, u_lens: mi.Point2f, u_film: mi.Point2f | None) -> CameraConnection:
        """Connect the scene point ``p`` with z_0, chosen by ``u_lens`` and ``u_film``."""
        point = self._point(u_lens, u_film)
        to_z0 = point[0] - p
        dist2 = dr.squared_norm(to_z0)
        return self._connection(point, mi.Vector3f(to_z0 * dr.rsqrt(dist2)), dist2, to_z0)

    def connect_direction(self, d: mi.Vector3f, u_lens: mi.Point2f, u_film) -> CameraConnection:
        """Like `connect`, for light from infinity along ``d``; ``dist2`` is 1."""
        return self._connection(self._point(u_lens, u_film), mi.Vector3f(d), mi.Float(1))

    def _point(self, u_lens, u_film) -> tuple:
        """Sample z_0, followed by what `_connection` needs besides."""
        raise NotImplementedError

    def _connection(self, point, d, dist2, to_z0=None) -> CameraConnection:
        """Connection along ``d`` with a ``point`` of `_point`; ``to_z0``: from the scene point, if finite."""
        raise NotImplementedError

    def hit(self, walk, vertex, distant) -> SensorHit:
        """Hit of a light subpath's last edge; ``distant``: it comes from infinity."""
        raise NotImplementedError
