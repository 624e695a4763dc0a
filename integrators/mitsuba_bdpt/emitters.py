"""Light endpoints: the only file that knows kinds of emitters.

Mitsuba's emitters offer no density of ``sample_ray``, throw in ``pdf_position`` and are wrong in
places (a rotated ``envmap`` emits from the wrong disk), so emission is sampled here, by formulas of
our own on top of the calls that are right: ``sample_direction``, ``pdf_direction``, ``eval`` and
the shapes' ``sample_position``.

Densities of an emission are two factors, in this order:

* ``pdf_first`` of y_0: area measure on a surface; 1 for a point light (times its selection);
  solid angle of the direction for an emitter at infinity (1 for a directional one).
* ``pdf_second`` of y_1 given y_0: solid angle; for an emitter at infinity the area density on the
  disk perpendicular to the direction that covers the scene, 1 / (pi R^2).

Next-event estimation has its own density of y_0, which depends on the vertex that is lit (cones of
spheres, d^2/cos, environments).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import rays

AREA, POINT, SPOT, INFINITE, DIRECTIONAL = range(5)

# Shapes whose textured radiance Mitsuba samples rightly. On a cylinder the points have other densities than
# stated (0.4 to 1.6 times), on a mesh all faces with the same texture coordinates share one density but
# only one face is sampled (a cube: a sixth).
_TEXTURE_SAMPLED = {kind.value for kind in (mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Sphere)}

_KINDS = {
    "AreaLight": AREA,
    "PointLight": POINT,
    "SpotLight": SPOT,
    "DirectionalEmitter": DIRECTIONAL,
    "ConstantBackgroundEmitter": INFINITE,
    "EnvironmentMapEmitter": INFINITE,
}


@dataclass
class Emission:
    """Start of a light subpath; all fields have the width of the lanes.

    ``weight`` emitted radiance x cosine / all densities; ``d`` direction of travel; ``anchor`` start
    of the ray, with position and geometric normal of y_0 (zero unless on a surface);
    ``cos`` geometric cosine at y_0 (1 off surfaces); ``pdf_first``, ``pdf_second`` see the module;
    ``infinite`` and ``delta`` masks (delta: no camera subpath can hit it); ``index`` of the emitter;
    ``si`` the emitting point for Mitsuba's calls.
    """

    weight: object
    d: object
    anchor: rays.Anchor
    cos: object
    pdf_first: object
    pdf_second: object
    infinite: object
    delta: object
    index: object
    si: object


@dataclass
class Direct:
    """A sample of next-event estimation: y_0 for a given camera vertex.

    ``weight`` radiance / ``pdf_w``; ``pdf_w`` solid angle at the camera vertex with the selection, or
    the selection alone where ``delta``; ``d`` unit direction to the emitter; ``anchor`` far end of
    the visibility ray (unused where ``infinite``); ``emission_ratio`` is
    pdf_first pdf_second / (density of y_0 in the measure of pdf_first), to be multiplied by the
    geometric cosine at the camera vertex: the ratio of p_2 and p_1 without the camera's density.
    """

    weight: object
    pdf_w: object
    d: object
    anchor: rays.Anchor
    infinite: object
    delta: object
    emission_ratio: object


class Emitters:
    """The scene's emitters as tables that a kernel can index.

    Built anew for each render, so that edits of the scene count. Raises ``NotImplementedError`` for
    kinds that cannot take part yet.
    """

    def __init__(self, scene):
        self.scene = scene
        self.quadrics = rays.Quadrics(scene)
        emitters = scene.emitters()
        kinds = [_kind(e) for e in emitters]
        self.kinds = frozenset(kinds)
        self.count = len(kinds)
        self.hittable = bool(self.kinds & {AREA, INFINITE})
        self.delta = bool(self.kinds - {AREA, INFINITE})
        if not kinds:
            return
        self._kind = mi.UInt32(kinds)
        self._pointers = scene.emitters_dr()
        sampling_weight = self._pointers.sampling_weight()
        pmf = sampling_weight / dr.sum(sampling_weight)
        area = mi.Float(
            [
                dr.slice(e.get_shape().surface_area()) if k == AREA else 1.0
                for e, k in zip(emitters, kinds, strict=True)
            ]
        )
        placements = [_placement(e, k) for e, k in zip(emitters, kinds, strict=True)]
        bounds = _bounds(scene)
        sphere = bounds.bounding_sphere() if bounds.valid() else mi.ScalarBoundingSphere3f([0] * 3, 1)
        # As in Mitsuba, a little larger, so that surfaces on the sphere are not missed.
        radius = max(float(sphere.radius) * (1 + 1e-4), 1e-30)
        self._pmf = pmf
        self._inv_area = dr.rcp(area)
        self._placements = _Placement.table(placements)
        textured = [
            k == AREA and mi.has_flag(e.flags(), mi.EmitterFlags.SpatiallyVarying)
            for e, k in zip(emitters, kinds, strict=True)
        ]
        # Where Mitsuba samples the texture: elsewhere its map to the surface misses parts of it.
        by_texture = [
            t and e.get_shape().shape_type() in _TEXTURE_SAMPLED
            for e, t in zip(emitters, textured, strict=True)
        ]
        by_shape = [t and not b for t, b in zip(textured, by_texture, strict=True)]
        self._any_by_texture, self._by_texture = any(by_texture), mi.Bool(by_texture)
        self._any_by_shape, self._by_shape = any(by_shape), mi.Bool(by_shape)
        for emitter, t in zip(emitters, textured, strict=True):
            if t:
                _check_coordinates(emitter)
        if self._any_by_shape:
            _refuse_curves(scene, emitters[by_shape.index(True)])
        self._inverse = _inverse_table(self._pointers)
        self._smooth_meshes = _SmoothMeshes.of(emitters)
        self._inward_spheres = any(p.radius > 0 for p in placements)
        self.center = mi.Point3f(sphere.center)
        self.radius = mi.Float(radius)
        dr.make_opaque(
            self._kind, self._pmf, self._inv_area, self._placements, self._inverse, self.center, self.radius
        )

    # -- tables -----------------------------------------------------------------------------

    def _index_of(self, emitter, active):
        return dr.gather(mi.UInt32, self._inverse, dr.reinterpret_array(mi.UInt32, emitter), active)

    def _pointer(self, index, active):
        return dr.gather(mi.EmitterPtr, self._pointers, index, active)

    def _is(self, index, active, *kinds):
        """Mask of the emitters of ``kinds``; decided from the scene alone where possible."""
        if not self.kinds & set(kinds):
            return mi.Bool(False)
        if self.kinds <= set(kinds):
            return mi.Bool(active)
        kind = dr.gather(mi.UInt32, self._kind, index, active)
        found = mi.Bool(False)
        for k in kinds:
            found |= kind == k
        return active & found

    def _select(self, u, active):
        """Choose an emitter; returns index, probability and the reused part of ``u``."""
        if self.count == 1:
            return mi.UInt32(0), mi.Float(1), u
        index, _, u = self.scene.sample_emitter(u, active)
        return index, dr.gather(mi.Float, self._pmf, index, active), u

    def _disk_density(self):
        return dr.rcp(dr.pi * dr.square(self.radius))

    def _direction_density(self, index, active):
        """Solid-angle density of the emission from point and spot lights."""
        return dr.gather(mi.Float, self._placements.density_w, index, active)

    # -- emission ---------------------------------------------------------------------------

    def sample_emission(self, u_point, u_direction, like, active) -> Emission:
        """Sample y_0 and the direction to y_1.

        ``u_point`` chooses the emitter and y_0, ``u_direction`` the direction; ``like`` carries time
        and wavelengths.
        """
        index, pmf, u_x = self._select(u_point.x, active)
        u_point = mi.Point2f(u_x, u_point.y)
        emitter = self._pointer(index, active)
        e = None
        for kinds, sampler in (
            ((AREA,), self._emit_area),
            ((POINT, SPOT), self._emit_position),
            ((INFINITE, DIRECTIONAL), self._emit_infinite),
        ):
            if not self.kinds & set(kinds):
                continue
            mask = self._is(index, active, *kinds)
            of_kind = sampler(emitter, index, u_point, u_direction, like, mask)
            e = of_kind if e is None else dr.select(mask, of_kind, e)
        e.pdf_first *= pmf
        e.weight = dr.select(pmf > 0, e.weight / pmf, 0)
        return e

    def _emit_area(self, emitter, index, u_point, u_direction, like, active) -> Emission:
        shape = emitter.get_shape()
        # Asked of the emitter: a call on shapes would visit curves too, which cannot be sampled.
        ps, _ = emitter.sample_position(like.time, u_point, active)
        if self._any_by_shape:
            mask = self._is_by_shape(index, active)
            ps = dr.select(mask, shape.sample_position(like.time, u_point, mask), ps)
        local = mi.warp.square_to_cosine_hemisphere(u_direction)
        si = mi.SurfaceInteraction3f(ps, like.wavelengths)
        si.t = mi.Float(0)
        si.shape = shape
        si.wi = local
        d = si.to_world(local)
        pdf_first = ps.pdf
        pdf_second = mi.warp.square_to_cosine_hemisphere_pdf(local)
        n = self.geometric_normal(ps, index, u_point, active)
        cos = dr.abs(dr.dot(n, d))
        radiance = emitter.eval(si, active)
        return Emission(
            weight=dr.select(pdf_second > 0, radiance * (cos / (pdf_first * pdf_second)), 0),
            d=d,
            anchor=rays.sampled_anchor(ps.p, n, ps.p, self.quadrics.ends(shape, active)),
            cos=cos,
            pdf_first=pdf_first,
            pdf_second=pdf_second,
            infinite=mi.Bool(False),
            delta=mi.Bool(False),
            index=index,
            si=si,
        )

    def geometric_normal(self, ps, index, u_point, active):
        """Geometric normal, up to its sign, at the point that a shape sampled from ``u_point``.

        Meshes report the interpolated vertex normal there; all other shapes the geometric one.
        """
        if self._smooth_meshes is None:
            return ps.n
        return self._smooth_meshes.normal(ps.n, index, u_point.y, active)

    def _pdf_direction(self, emitter, index, it, ds, active):
        """Density with which next-event estimation at ``it`` samples ``ds`` (solid angle, without
        the selection). Turns ``ds.n``, which callers build for this call alone.

        A sphere with flipped normals samples as from inside up to its radius times 1 + RayEpsilon,
        but its pdf_direction only up to the radius: wrong for points of the sphere itself.
        """
        # Mitsuba masks by the sign of the normal, but which side emits is the shading frame's affair.
        ds.n = mi.Normal3f(ds.n * dr.select(dr.dot(ds.n, ds.d) > 0, -1.0, 1.0))
        pdf = emitter.pdf_direction(it, ds, active)
        by_area = mi.Bool(False)
        if self._inward_spheres:
            sphere = self._placements.at(index, active)
            by_area |= active & (dr.squared_norm(it.p - sphere.position) <= dr.square(sphere.radius))
        if self._any_by_shape:
            by_area |= self._is_by_shape(index, active)
        inv_area = dr.gather(mi.Float, self._inv_area, index, active)
        cos = dr.abs(dr.dot(ds.d, ds.n))
        return dr.select(by_area, inv_area * dr.square(ds.dist) / cos, pdf)

    def _is_by_shape(self, index, active):
        return active & dr.gather(mi.Bool, self._by_shape, index, active)

    def _emit_position(self, emitter, index, u_point, u_direction, like, active) -> Emission:
        placed = self._placements.at(index, active)
        p = placed.position
        local = mi.warp.square_to_uniform_cone(u_direction, placed.cos_cutoff)
        d = placed.x * local.x + placed.y * local.y + placed.z * local.z
        intensity = self._intensity(emitter, p, d, like, active)
        pdf_second = placed.density_w
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t, si.p, si.time, si.wavelengths = mi.Float(0), p, like.time, like.wavelengths
        return Emission(
            weight=intensity / pdf_second,
            d=d,
            anchor=rays.free_anchor(p),
            cos=mi.Float(1),
            pdf_first=mi.Float(1),
            pdf_second=pdf_second,
            infinite=mi.Bool(False),
            delta=mi.Bool(True),
            index=index,
            si=si,
        )

    def _intensity(self, emitter, p, d, like, active):
        """Intensity of a point or spot light at ``p`` into direction ``d``, by its own calls."""
        far = 1 + dr.max(dr.abs(p))  # keeps the probe's relative rounding small away from 0
        it = dr.zeros(mi.Interaction3f)
        it.p, it.time, it.wavelengths = p + d * far, like.time, like.wavelengths
        ds, weight = emitter.sample_direction(it, mi.Point2f(0.5), active)
        return weight * dr.square(ds.dist)

    def _emit_infinite(self, emitter, index, u_point, u_direction, like, active) -> Emission:
        it = dr.zeros(mi.Interaction3f)
        it.p, it.time, it.wavelengths = mi.Point3f(self.center), like.time, like.wavelengths
        ds, weight = emitter.sample_direction(it, u_direction, active)
        directional = self._is(index, active, DIRECTIONAL)
        d = -ds.d
        disk = mi.warp.square_to_uniform_disk_concentric(u_point)
        frame = mi.Frame3f(d)
        p = self.center + self.radius * (frame.s * disk.x + frame.t * disk.y - d)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi, si.p, si.time, si.wavelengths = d, p, like.time, like.wavelengths
        pdf_second = self._disk_density()
        return Emission(
            weight=dr.select(ds.pdf > 0, weight / pdf_second, 0),
            d=d,
            anchor=rays.free_anchor(p),
            cos=mi.Float(1),
            pdf_first=dr.select(directional, 1, ds.pdf),
            pdf_second=pdf_second,
            infinite=mi.Bool(True),
            delta=directional,
            index=index,
            si=si,
        )

    def connection_density(self, emission: Emission, si, active):
        """Density of next-event estimation making y_0 of ``emission`` from its first hit ``si``.

        In the measure of ``pdf_first``, times the squared length of the edge (1 at infinity): on
        surfaces that is the solid-angle density at the hit times the geometric cosine at y_0.
        """
        emitter = self._pointer(emission.index, active)
        pmf = self._probability(emission.index, active)
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p, ds.n, ds.uv, ds.time = (
            emission.si.p,
            emission.anchor.n,
            emission.si.uv,
            emission.si.time,
        )
        ds.d = -emission.d
        ds.dist = dr.norm(emission.si.p - si.p)
        ds.emitter = emitter
        smooth = active & ~emission.delta
        pdf = self._pdf_direction(emitter, emission.index, mi.Interaction3f(si), ds, smooth)
        finite = dr.select(emission.infinite, pdf, pdf * emission.cos)
        delta = dr.select(emission.infinite, 1, dr.square(ds.dist))
        return pmf * dr.select(emission.delta, delta, finite)

    def radiance_towards(self, emission: Emission, d, active):
        """What y_0 sends into direction ``d``: radiance, intensity (point) or irradiance (delta
        direction), for y_0 joined with the sensor."""
        emitter = self._pointer(emission.index, active)
        value = dr.zeros(mi.Spectrum)
        if AREA in self.kinds:
            mask = self._is(emission.index, active, AREA)
            si = mi.SurfaceInteraction3f(emission.si)
            si.wi = si.to_local(d)
            value = dr.select(mask, emitter.eval(si, mask), value)
        if self.kinds & {POINT, SPOT}:
            mask = self._is(emission.index, active, POINT, SPOT)
            value = dr.select(mask, self._intensity(emitter, emission.si.p, d, emission.si, mask), value)
        if INFINITE in self.kinds:
            mask = self._is(emission.index, active, INFINITE)
            si = mi.SurfaceInteraction3f(emission.si)
            si.t = mi.Float(dr.inf)
            value = dr.select(mask, emitter.eval(si, mask), value)
        if DIRECTIONAL in self.kinds:
            mask = self._is(emission.index, active, DIRECTIONAL)
            # weight = E / (pdf_first pdf_second) with the selection
            density = emission.pdf_first * emission.pdf_second
            value = dr.select(mask, emission.weight * density, value)
        return value

    # -- next-event estimation --------------------------------------------------------------

    def sample_direct(self, si, u, active) -> Direct:
        """Sample y_0 for the camera vertex ``si`` with ``u`` in [0, 1)^2 (reused for selection)."""
        index, pmf, u_x = self._select(u.x, active)
        u = mi.Point2f(u_x, u.y)
        emitter = self._pointer(index, active)
        ds, weight = emitter.sample_direction(si, u, active)
        if self._any_by_shape:
            mask = self._is_by_shape(index, active)
            by_shape, its_weight = _sample_shape(emitter, si, u, mask)
            ds, weight = dr.select(mask, by_shape, ds), dr.select(mask, its_weight, weight)
        area = self._is(index, active, AREA)
        infinite = self._is(index, active, INFINITE, DIRECTIONAL)
        delta = self._is(index, active, POINT, SPOT, DIRECTIONAL)
        n = dr.select(area, self.geometric_normal(ds, index, u, area), 0)
        cos_shading = dr.dot(ds.n, -ds.d)
        cos = dr.abs(dr.dot(n, ds.d))
        # Mitsuba divides by the shading normal's cosine; the measure is the geometric one.
        to_geometric = dr.select(area & (cos != dr.abs(cos_shading)), dr.abs(cos_shading) / cos, 1)
        pdf = dr.select(delta, 1, ds.pdf * to_geometric) * pmf
        weight = dr.select(ds.pdf > 0, weight / (to_geometric * pmf), 0)
        ratio = mi.Float(0)
        if AREA in self.kinds:
            density = self._area_density(emitter, index, ds, n, area)
            emitted = pmf * density * dr.maximum(cos_shading, 0) * dr.inv_pi
            ratio = dr.select(area, emitted / (pdf * cos), ratio)
        if self.kinds & {POINT, SPOT}:
            here = self._is(index, active, POINT, SPOT)
            emitted = self._direction_density(index, here) / dr.square(ds.dist)
            ratio = dr.select(here, emitted, ratio)
        ratio = dr.select(infinite, self._disk_density(), ratio)
        curvature = mi.Float(0)
        if AREA in self.kinds:
            curvature = self.quadrics.ends(emitter.get_shape(), area)
        anchor = rays.sampled_anchor(ds.p, n, si.p, curvature)
        return Direct(weight, pdf, ds.d, anchor, infinite, delta, ratio)

    # -- hits by camera subpaths ------------------------------------------------------------

    def emitted(self, si, active):
        """Radiance of the emitter hit (or missed into) at ``si`` towards ``si.wi``."""
        emitter = si.emitter(self.scene)
        return emitter.eval(si, active)

    def hit_densities(self, si, previous, active):
        """Densities with which light-side strategies make the hit emitter point.

        ``previous`` is the camera vertex before (position). Returns ``(connect, first, second)``:
        next-event estimation from ``previous``, and the two factors of emission towards it; area
        measure on surfaces, solid angle (and disk area) at infinity, selection included.
        """
        emitter = si.emitter(self.scene)
        active = active & (emitter != dr.zeros(mi.EmitterPtr))
        index = self._index_of(emitter, active)
        pmf = self._probability(index, active)
        it = dr.zeros(mi.Interaction3f)
        it.p, it.time, it.wavelengths = previous, si.time, si.wavelengths
        ds = mi.DirectionSample3f(self.scene, si, it)
        ds.n = mi.Normal3f(si.n)
        pdf = pmf * self._pdf_direction(emitter, index, it, ds, active)
        connect, first, second = mi.Float(pdf), mi.Float(pdf), self._disk_density()
        if AREA in self.kinds:
            on_surface = si.is_valid()
            density = self._area_density(emitter, index, si, si.n, active & on_surface)
            to_area = dr.abs(dr.dot(si.n, ds.d)) / dr.square(ds.dist)
            cos_second = dr.maximum(mi.Frame3f.cos_theta(si.wi), 0) * dr.inv_pi
            connect = dr.select(on_surface, pdf * to_area, connect)
            first = dr.select(on_surface, pmf * density, first)
            second = dr.select(on_surface, cos_second, second)
        return connect, first, second

    def _area_density(self, emitter, index, at, n, active):
        """Density of emission's y_0 on a surface, without the selection. ``at`` has ``p``, ``uv``."""
        density = dr.gather(mi.Float, self._inv_area, index, active)
        if not self._any_by_texture:
            return density
        # A textured emitter samples its texture. It tells the area density only to a reference point
        # at unit distance straight above.
        textured = active & dr.gather(mi.Bool, self._by_texture, index, active)
        it = dr.zeros(mi.Interaction3f)
        it.p = at.p + n
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p, ds.n, ds.uv, ds.d, ds.dist = at.p, n, at.uv, -mi.Vector3f(n), mi.Float(1)
        return dr.select(textured, emitter.pdf_direction(it, ds, textured), density)

    def _probability(self, index, active):
        if self.count == 1:
            return mi.Float(1)
        return dr.gather(mi.Float, self._pmf, index, active)


def _sample_shape(emitter, si, u, active):
    """Next-event estimation by a uniform point of the emitter's shape, in Mitsuba's conventions: the
    density is over the cosine with the shading normal, the weight is radiance over density."""
    ps = emitter.get_shape().sample_position(si.time, u, active)
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.n, ds.uv, ds.time, ds.emitter = ps.p, ps.n, ps.uv, si.time, emitter
    between = ps.p - si.p
    ds.dist = dr.norm(between)
    ds.d = between / ds.dist
    cos = dr.abs(dr.dot(ds.n, ds.d))
    ds.pdf = dr.select(active & (cos > 0), ps.pdf * dr.square(ds.dist) / cos, 0)
    there = mi.SurfaceInteraction3f(ps, si.wavelengths)
    there.wi = there.to_local(-ds.d)
    radiance = emitter.eval(there, active)
    return ds, dr.select(ds.pdf > 0, radiance / ds.pdf, 0)


def _check_coordinates(emitter):
    """Raise ``ValueError`` for a texture on a mesh that has no texture coordinates."""
    shape = emitter.get_shape()
    if shape.shape_type() == mi.ShapeType.Mesh.value and not shape.has_vertex_texcoords():
        raise ValueError(
            f"bdpt: emitter '{emitter.id()}' has a textured radiance on a mesh without texture coordinates "
            f"('{shape.id()}'); make the radiance uniform, or give the mesh coordinates"
        )


def _refuse_curves(scene, emitter):
    """Raise ``NotImplementedError`` if a call on shapes would meet curves, which have no
    ``sample_position``."""
    for shape in scene.shapes():
        if shape.shape_type() in (mi.ShapeType.BSplineCurve.value, mi.ShapeType.LinearCurve.value):
            raise NotImplementedError(
                f"bdpt: emitter '{emitter.id()}' has a textured radiance on a "
                f"{emitter.get_shape().class_name()}, which is not supported beside curves "
                f"('{shape.id()}'); make the radiance uniform, put it on a rectangle, disk or sphere, "
                "or use integrator type 'path'"
            )


def _kind(emitter) -> int:
    name = emitter.class_name()
    if name not in _KINDS:
        raise NotImplementedError(
            f"bdpt: emitter '{emitter.id()}' of class {name} is not supported yet; supported are area, "
            "point, spot, directional, constant and envmap. Replace it, or use integrator type 'path'."
        )
    if name == "EnvironmentMapEmitter":
        _check_rotation(emitter)
    return _KINDS[name]


def _check_rotation(emitter):
    """Raise ``ValueError`` unless an environment map's ``to_world`` keeps lengths: with any other matrix
    Mitsuba's own calls disagree with each other (next-event estimation four times the radiance)."""
    matrix = np.array(mi.traverse(emitter)["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3):
        raise ValueError(
            f"bdpt: to_world of envmap '{emitter.id()}' is not a rotation (the lengths of its columns are "
            f"{', '.join(f'{x:.4g}' for x in np.linalg.norm(matrix, axis=0))}); leave out scaling, and give "
            "rotate an axis of length 1"
        )


@dataclass
class _Placement:
    """Where an emitter is: axes ``x``, ``y``, ``z`` and ``position`` of point and spot lights, their
    constant density of emission ``density_w`` (solid angle) within ``cos_cutoff``. Of a sphere that
    emits inwards, ``position`` and the ``radius`` up to which it samples as from inside; 0 for all
    others. Scalars for one emitter, Dr.Jit arrays for a table of them."""

    x: object = (1, 0, 0)
    y: object = (0, 1, 0)
    z: object = (0, 0, 1)
    position: object = (0, 0, 0)
    density_w: object = 1.0
    cos_cutoff: object = -1.0
    radius: object = 0.0

    @staticmethod
    def table(rows):
        """The rows as columns that `at` can look up."""

        def column(name):
            # Lists, not NumPy: Dr.Jit borrows an array's memory, and its alignment is part of the kernel.
            values = np.array([getattr(row, name) for row in rows], dtype=np.float64).T.tolist()
            if not isinstance(values[0], list):
                return mi.Float(values)
            return (mi.Point3f if name == "position" else mi.Vector3f)(*(mi.Float(v) for v in values))

        return _Placement(**{name: column(name) for name in vars(_Placement())})

    def at(self, index, active):
        """The row ``index``."""
        return _Placement(**{k: dr.gather(type(v), v, index, active) for k, v in vars(self).items()})


def _placement(emitter, kind) -> _Placement:
    if kind == POINT:
        position = dr.slice(mi.Point3f(mi.traverse(emitter)["position"]))
        return _Placement(position=position, density_w=1 / (4 * dr.pi))
    if kind == SPOT:
        params = mi.traverse(emitter)
        to_world = params["to_world"]
        x, y, z = (
            dr.slice(dr.normalize(mi.Vector3f(to_world @ mi.Vector3f(*a))))
            for a in ((1, 0, 0), (0, 1, 0), (0, 0, 1))
        )
        cos_cutoff = dr.slice(dr.cos(dr.deg2rad(mi.Float(params["cutoff_angle"]))))
        return _Placement(
            x=x,
            y=y,
            z=z,
            position=dr.slice(mi.Point3f(to_world @ mi.Point3f(0, 0, 0))),
            density_w=1 / (2 * dr.pi * (1 - cos_cutoff)),
            cos_cutoff=cos_cutoff,
        )
    if kind == AREA and emitter.get_shape().shape_type() == mi.ShapeType.Sphere.value:
        to_world = mi.traverse(emitter.get_shape())["to_world"]
        p = mi.Point3f(to_world @ mi.Point3f(0, 0, 0))
        ps = emitter.get_shape().sample_position(0, mi.Point2f(0.5))
        inwards = dr.slice(dr.dot(ps.n, ps.p - p)) < 0
        # Mitsuba's RayEpsilon, as in Sphere::sample_direction.
        radius = dr.slice(dr.norm(ps.p - p)) * (1 + 1500 * 2.0**-24) if inwards else 0.0
        return _Placement(position=dr.slice(p), radius=radius)
    return _Placement()


class _SmoothMeshes:
    """Geometric normals of emitting meshes that have vertex normals.

    Repeats the choice of a face that ``Mesh.sample_position`` makes: by area, from ``sample.y``.
    """

    @staticmethod
    def of(emitters):
        """Tables for those of ``emitters`` that need them, or None."""
        faces = [_curved_faces(e.get_shape()) for e in emitters]
        return _SmoothMeshes(faces) if any(f is not None for f in faces) else None

    def __init__(self, faces):
        normals, cumulative, first, count = [], [], [], []
        for cross in faces:
            first.append(sum(len(c) for c in cumulative))
            count.append(0 if cross is None else len(cross))
            if cross is not None:
                length = np.linalg.norm(cross, axis=1)
                normals.append(cross / np.maximum(length, 1e-300)[:, None])
                cumulative.append(np.cumsum(length) / length.sum())
        self._normals = mi.Normal3f(*(mi.Float(v) for v in np.concatenate(normals).T.tolist()))
        self._cumulative = mi.Float(np.concatenate(cumulative).tolist())
        self._first, self._count = mi.UInt32(first), mi.UInt32(count)
        self._steps = max(count).bit_length()
        dr.make_opaque(self._normals, self._cumulative, self._first, self._count)

    def normal(self, n, index, u, active):
        """Normal of the face chosen by ``u``; ``n`` for emitters that are no such mesh."""
        first = dr.gather(mi.UInt32, self._first, index, active)
        count = dr.gather(mi.UInt32, self._count, index, active)
        mesh = active & (count > 0)
        low, high = first, dr.select(mesh, first + count - 1, first)
        for _ in range(self._steps):
            middle = (low + high) // 2
            right = dr.gather(mi.Float, self._cumulative, middle, mesh) < u
            low = dr.select(right & (middle < high), middle + 1, low)
            high = dr.select(right, high, middle)
        face = low
        return dr.select(mesh, dr.gather(mi.Normal3f, self._normals, face, mesh), n)


def _curved_faces(shape):
    """Cross products of the edges of each face, shape (faces, 3), for a mesh whose vertex normals
    differ from its faces' normals; None for all other shapes."""
    if shape is None or not shape.is_mesh():
        return None
    params = mi.traverse(shape)
    # Neither a rectangle (flat, without vertices) nor a mesh without normals at its vertices.
    if "vertex_positions" not in params or not len(params["vertex_normals"]):
        return None
    faces = np.array(params["faces"]).reshape(-1, 3)
    p = np.array(params["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    n = np.array(params["vertex_normals"], dtype=np.float64).reshape(-1, 3)
    a, b, c = p[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    unit = cross / np.maximum(np.linalg.norm(cross, axis=1), 1e-300)[:, None]
    flat = np.abs(np.einsum("fvi,fi->fv", n[faces], unit)) > 1 - 1e-6
    return None if flat.all() else cross


def _bounds(scene):
    """Bounding box of all shapes.

    Not ``scene.bbox()`` alone: meshes that Mitsuba merges when it loads a scene keep the box of one
    part.
    """
    bounds = mi.ScalarBoundingBox3f(scene.bbox())
    for shape in scene.shapes():
        params = mi.traverse(shape) if shape.is_mesh() else {}
        if "vertex_positions" in params:
            vertices = np.array(params["vertex_positions"]).reshape(-1, 3)
            bounds.expand(mi.ScalarPoint3f(vertices.min(axis=0).tolist()))
            bounds.expand(mi.ScalarPoint3f(vertices.max(axis=0).tolist()))
    return bounds


def _inverse_table(pointers):
    """Emitter index by the number that Dr.Jit gives to a pointer."""
    ids = dr.reinterpret_array(mi.UInt32, pointers).numpy()
    table = [0] * (int(ids.max()) + 1)
    for index, number in enumerate(ids):
        table[int(number)] = index
    return mi.UInt32(table)
