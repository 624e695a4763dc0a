"""Light endpoints: how each kind of emitter is sampled.

Mitsuba's emitters offer no density of ``sample_ray``, throw in ``pdf_position`` and are wrong in
places (a rotated ``envmap`` emits from the wrong disk), so emission is sampled here, by formulas of
our own on top of the calls that are right: ``sample_direction``, ``pdf_direction``, ``eval`` and
the shapes' ``sample_position``.

Densities of an emission are two factors, in this order:

* ``pdf_first`` of y_0: area measure on a surface; 1 for a point light (times its selection);
  solid angle of the direction for an emitter at infinity (1 for a directional one).
* ``pdf_second`` of y_1 given y_0: solid angle (1 for the fixed direction of a directional area); for an
  emitter at infinity the area density across the direction: 1 / (pi R^2) on the disk that covers the scene,
  or a mixture of that and a disk that covers its details.

Next-event estimation has its own density of y_0, which depends on the vertex that is lit (cones of
spheres, d^2/cos, environments).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from ..errors import UsageError
from ..geometry import rays, rounding
from ..geometry.agreement import check_densities
from ..geometry.quadrics import cone_density, is_turned_sphere, may_light_itself, sphere_normal
from ..geometry.smooth_meshes import SmoothMeshes
from ..geometry.to_world import check_to_world
from ..host.introspection import children, named, number
from ..host.jit import make_parameters_opaque, registered_emitters
from .infinity import Disks
from .kinds import (
    AREA,
    DIRECTIONAL,
    DIRECTIONAL_AREA,
    HIT_ONLY,
    INFINITE,
    POSITIONS,
    PROJECTOR,
    THIRD_PARTY,
    contrast,
    is_hittable,
    is_sampled_by_texture,
    is_textured,
    is_third_party,
    kind_of,
    left_out,
    needs_evaluation,
    refuse_curves,
    supports_emission,
    supports_next_event,
)
from .projectors import Projectors
from .tables import Placement, inverse_table, placement


@dataclass
class Emission:
    """Start of a light subpath; all fields have the width of the lanes.

    ``weight`` emitted radiance x cosine / all densities; ``d`` direction of travel; ``anchor`` start
    of the ray, with position and geometric normal of y_0 (zero unless on a surface);
    ``cos`` geometric cosine at y_0 (1 off surfaces); ``pdf_first``, ``pdf_second`` see the module;
    ``infinite`` and ``delta`` masks (delta: no camera subpath can hit it); ``beam`` mask: ``d`` is the only
    direction that leaves y_0, so that nothing can be joined with y_0; ``index`` of the emitter; ``si`` the
    emitting point for Mitsuba's calls.
    """

    weight: object
    d: object
    anchor: rays.Anchor
    cos: object
    pdf_first: object
    pdf_second: object
    infinite: object
    delta: object
    beam: object
    index: object
    si: object


@dataclass
class Direct:
    """A sample of next-event estimation: y_0 for a given camera vertex.

    ``weight`` radiance / ``pdf_w``; ``pdf_w`` solid angle at the camera vertex with the selection, or
    the selection alone where ``delta``; ``d`` unit direction to the emitter; ``anchor`` far end of
    the visibility ray (unused where ``infinite``), ``met`` the number of its shape (None if the scene has
    none so small that the ray asks for it, see `rounding.SMALL`); ``emission_ratio`` is
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
    met: object = None


class Emitters:
    """The scene's emitters as tables that a kernel can index.

    Built anew for each render, so that edits of the scene count. Raises ``ValueError`` and
    ``NotImplementedError`` for emitters of which Mitsuba's own calls contradict each other.

    What the scene's ``count`` emitters of the ``kinds`` can do, decided from all of them: ``hittable``,
    ``direct``, ``traced``, ``connectible_to_sensor``: camera subpaths can hit one, next-event estimation can
    choose one, light subpaths can start from one, one of these points can be joined with a sensor;
    ``unhittable``: one cannot be hit; ``finite_hittable``: one that can be hit and joined is not at
    infinity; ``on_shapes``: one is on a shape; ``at_infinity``: light subpaths can start at infinity,
    ``far_share`` of them do; ``beams``: one can be reached only by the light subpaths that it starts;
    ``evaluated``: one that lives, be it in another scene, makes it necessary to record kernels without
    symbolic loops, calls and branches.
    ``left_out``: what single ones cannot take part in, and why. ``disks`` where light subpaths from infinity
    start, if any do; ``shape_errors`` of the scene, for rays.
    """

    def __init__(self, scene):
        self.scene = scene
        self.shape_errors = rounding.ShapeErrors(scene)
        emitters = scene.emitters()
        kinds = [kind_of(e) for e in emitters]
        self.kinds = frozenset(kinds)
        self.count = len(kinds)
        hittable = [is_hittable(e, k) for e, k in zip(emitters, kinds, strict=True)]
        self.hittable, self.unhittable = any(hittable), not all(hittable)
        self.direct = any(supports_next_event(k) for k in kinds)
        self.traced = any(supports_emission(k) for k in kinds)
        self.connectible_to_sensor = any(supports_emission(k) and supports_next_event(k) for k in kinds)
        self.finite_hittable = AREA in self.kinds
        self.on_shapes = any(e.get_shape() is not None for e in emitters)
        self.beams = DIRECTIONAL_AREA in self.kinds
        self.at_infinity, self.far_share = bool(self.kinds & {INFINITE, DIRECTIONAL}), 0.0
        living = registered_emitters()
        self.evaluated = any(needs_evaluation(name) for name in living)
        self.left_out = [text for e, k in zip(emitters, kinds, strict=True) for text in left_out(e, k)]
        if not kinds:
            return
        make_parameters_opaque([*emitters, *filter(None, (e.get_shape() for e in emitters))])
        self._pointers = scene.emitters_dr()
        weights = [number(e.sampling_weight()) for e in emitters]
        sampling_weight = mi.Float(weights)
        self._kind, self._pmf = mi.UInt32(kinds), sampling_weight / dr.sum(sampling_weight)
        of_kinds = list(zip(weights, kinds, strict=True))
        far = sum(w for w, k in of_kinds if k in (INFINITE, DIRECTIONAL))
        self.far_share = far / sum(w for w, k in of_kinds if supports_emission(k)) if far > 0 else 0.0
        foreign = any(is_third_party(name) for name in living)
        self._ask_shapes = foreign and not _all_answer(self._pointers)
        self._read_shapes(scene, emitters, kinds)
        extent = 2 * scene.bbox().bounding_sphere().radius
        placements = [placement(e, k, extent) for e, k in zip(emitters, kinds, strict=True)]
        self._placements = Placement.table(placements)
        self._inward_spheres = any(p.radius > 0 for p in placements)
        self._turned_spheres = any(p.outward for p in placements)
        self._small_spheres = any(p.far for p in placements)
        self._projectors = Projectors.of(emitters, kinds)
        self._inverse = inverse_table(self._pointers)
        self.disks = Disks(scene) if self.at_infinity else None
        dr.make_opaque(self._kind, self._pmf, self._inv_area, self._placements, self._inverse)
        for index, row in enumerate(placements):
            if self._by_texture[index] or row.radius > 0:
                check_densities(self, index)

    @cached_property
    def contrast(self) -> float:
        """The largest `kinds.contrast`: infinite unless all light comes from environments."""
        return max((contrast(emitter) for emitter in self.scene.emitters()), default=math.inf)

    def _read_shapes(self, scene, emitters, kinds):
        """Areas of the emitting shapes, how their points are chosen, and their geometric normals."""
        pairs = list(zip(emitters, kinds, strict=True))
        sampled = [k in (AREA, DIRECTIONAL_AREA) for k in kinds]
        for e, s in zip(emitters, sampled, strict=True):
            if s:
                check_to_world(e.get_shape(), f"emitter {named(e)}")
        areas = [
            dr.slice(e.get_shape().surface_area()) if s else 1.0
            for e, s in zip(emitters, sampled, strict=True)
        ]
        self._inv_area = dr.rcp(mi.Float(areas))
        textured = [is_textured(e, k) for e, k in pairs]
        # Where Mitsuba samples the texture: elsewhere its map to the surface misses parts of it.
        by_texture = [
            not self._ask_shapes and is_sampled_by_texture(e, k) and not is_turned_sphere(e.get_shape())
            for e, k in pairs
        ]
        by_shape = [t and not b for t, b in zip(textured, by_texture, strict=True)]
        self._any_by_texture, self._by_texture = any(by_texture), mi.Bool(by_texture)
        self._any_by_shape, self._by_shape = any(by_shape), mi.Bool(by_shape)
        if self._any_by_shape:
            refuse_curves(scene, emitters[by_shape.index(True)], "has a textured radiance on such a shape")
        if self._ask_shapes and any(sampled):
            refuse_curves(
                scene, emitters[sampled.index(True)], "lives with a class that has no sample_position"
            )
        glass = [s and may_light_itself(e.get_shape()) for e, s in zip(emitters, sampled, strict=True)]
        self._any_glass, self._glass = any(glass), mi.Bool(glass)
        self._smooth_meshes = SmoothMeshes.of(
            [e if s else None for e, s in zip(emitters, sampled, strict=True)]
        )
        if 0 in areas:
            emitter = emitters[areas.index(0)]
            raise UsageError(
                f"emitter {named(emitter)} is on a shape without area ({named(emitter.get_shape())}); "
                "remove it, or give it some"
            )
        # The radiance of a directional area is told by its texture alone.
        self._beam_radiances = [
            (i, children(e)["radiance"]) for i, (e, k) in enumerate(pairs) if k == DIRECTIONAL_AREA
        ]

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

    def _density_across(self, p, d):
        """`Disks.density`; 0 where no light subpath starts at infinity."""
        return self.disks.density(p, d) if self.disks is not None else mi.Float(0)

    def covers(self, p, d):
        """`Disks.covers`; true where no light subpath starts at infinity."""
        return self.disks.covers(p, d) if self.disks is not None else mi.Bool(True)

    def _direction_density(self, index, d, active):
        """Solid-angle density of the emission into the direction ``d`` from emitters at a point."""
        density = dr.gather(mi.Float, self._placements.density_w, index, active)
        if self._projectors is None:
            return density
        projector = self._is(index, active, PROJECTOR)
        return dr.select(projector, self._projectors.density(index, d, projector), density)

    # -- emission ---------------------------------------------------------------------------

    def sample_emission(self, u_point, u_direction, shared, active) -> Emission:
        """Sample y_0 and the direction to y_1.

        ``u_point`` chooses the emitter and y_0, ``u_direction`` the direction; ``shared`` carries time
        and wavelengths.
        """
        index, pmf, u_x = self._select(u_point.x, active)
        u_point = mi.Point2f(u_x, u_point.y)
        emitter = self._pointer(index, active)
        e = None
        for kinds, sampler in (
            ((AREA,), self._emit_area),
            ((DIRECTIONAL_AREA,), self._emit_beam),
            (POSITIONS, self._emit_position),
            ((INFINITE, DIRECTIONAL), self._emit_infinite),
        ):
            if not self.kinds & set(kinds):
                continue
            mask = self._is(index, active, *kinds)
            of_kind = sampler(emitter, index, u_point, u_direction, shared, mask)
            e = of_kind if e is None else dr.select(mask, of_kind, e)
        e.pdf_first *= pmf
        e.weight = dr.select(pmf > 0, e.weight / pmf, 0)
        if self.kinds & {
            THIRD_PARTY,
            HIT_ONLY,
        }:  # chosen with the probability of next-event estimation, and left
            e.weight = dr.select(self._is(index, active, THIRD_PARTY, HIT_ONLY), 0, e.weight)
        return e

    def _sample_surface(self, emitter, index, u_point, shared, active):
        """A point on the shape of an emitter, density included."""
        shape = emitter.get_shape()
        if self._ask_shapes:
            return self.upright(shape.sample_position(shared.time, u_point, active), index, active)
        # Asked of the emitter: a call on shapes would visit curves too, which cannot be sampled.
        ps, _ = emitter.sample_position(shared.time, u_point, active)
        if self._any_by_shape:
            mask = self._is_by_shape(index, active)
            ps = dr.select(mask, shape.sample_position(shared.time, u_point, mask), ps)
        return self.upright(ps, index, active)

    def upright(self, ps, index, active):
        """A point that a shape has sampled, with its normal as it should be, see `Sphere`."""
        if self._turned_spheres:
            sphere = self._placements.at(index, active)
            n = sphere_normal(ps.p, sphere.position, sphere.outward)
            ps.n = dr.select(sphere.outward != 0, n, ps.n)
        return ps

    def _emit_area(self, emitter, index, u_point, u_direction, shared, active) -> Emission:
        shape = emitter.get_shape()
        ps = self._sample_surface(emitter, index, u_point, shared, active)
        local = mi.warp.square_to_cosine_hemisphere(u_direction)
        si = mi.SurfaceInteraction3f(ps, shared.wavelengths)
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
            # Here and below a density that is NaN leaves the weight NaN, to be counted.
            weight=dr.select(pdf_first * pdf_second == 0, 0, radiance * (cos / (pdf_first * pdf_second))),
            d=d,
            anchor=rays.sampled_anchor(ps.p, n, ps.p, self.shape_errors.at(shape, active)),
            cos=cos,
            pdf_first=pdf_first,
            pdf_second=pdf_second,
            infinite=mi.Bool(False),
            delta=mi.Bool(False),
            beam=mi.Bool(False),
            index=index,
            si=si,
        )

    def _emit_beam(self, emitter, index, u_point, u_direction, shared, active) -> Emission:
        ps = self._sample_surface(emitter, index, u_point, shared, active)
        n = self.geometric_normal(ps, index, u_point, active)
        d = mi.Vector3f(ps.n)
        si = mi.SurfaceInteraction3f(ps, shared.wavelengths)
        si.t, si.wi = mi.Float(0), mi.Vector3f(0, 0, 1)
        radiance = dr.zeros(mi.Spectrum)
        for place, texture in self._beam_radiances:
            mask = active & (index == place)
            radiance = dr.select(mask, mi.Spectrum(texture.eval(si, mask)), radiance)
        errors = self.shape_errors.at(emitter.get_shape(), active)
        return Emission(
            weight=dr.select(ps.pdf == 0, 0, radiance / ps.pdf),  # without cosine, as in Mitsuba
            d=d,
            anchor=rays.sampled_anchor(ps.p, n, ps.p, errors),
            cos=dr.abs(dr.dot(n, d)),
            pdf_first=ps.pdf,
            pdf_second=mi.Float(1),
            infinite=mi.Bool(False),
            delta=mi.Bool(True),
            beam=mi.Bool(True),
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

    def density_of_direction(self, emitter, index, it, ds, active):
        """Density with which next-event estimation at ``it`` samples ``ds`` (solid angle, without
        the selection). Turns ``ds.n``, which callers build for this call alone.

        A sphere with flipped normals samples as from inside up to its radius times 1 + RayEpsilon,
        but its pdf_direction only up to the radius: wrong for points of the sphere itself.
        """
        # Mitsuba masks by the sign of the normal, but which side emits is the shading frame's affair.
        turned = mi.Normal3f(ds.n * dr.select(dr.dot(ds.n, ds.d) > 0, -1.0, 1.0))
        if THIRD_PARTY in self.kinds:
            turned = dr.select(self._is(index, active, THIRD_PARTY), ds.n, turned)
        ds.n = turned
        pdf = emitter.pdf_direction(it, ds, active)
        by_area = mi.Bool(False)
        if self._inward_spheres:
            sphere = self._placements.at(index, active)
            by_area |= active & (dr.squared_norm(it.p - sphere.position) <= dr.square(sphere.radius))
        if self._any_by_shape:
            by_area |= self._is_by_shape(index, active)
        inv_area = dr.gather(mi.Float, self._inv_area, index, active)
        cos = dr.abs(dr.dot(ds.d, ds.n))
        pdf = dr.select(by_area, inv_area * dr.square(ds.dist) / cos, pdf)
        if self._small_spheres:
            narrow = self._cone_density(index, it.p, active)
            pdf = dr.select(narrow > 0, narrow, pdf)
        return pdf

    def _cone_density(self, index, p, active):
        """`quadrics.cone_density` of the emitter ``index``; 0 for one that is no small sphere."""
        sphere = self._placements.at(index, active)
        return dr.select(active, cone_density(sphere.position, sphere.far, p), 0)

    def _is_by_shape(self, index, active):
        return active & dr.gather(mi.Bool, self._by_shape, index, active)

    def _emit_position(self, emitter, index, u_point, u_direction, shared, active) -> Emission:
        placed = self._placements.at(index, active)
        p = placed.position
        local = mi.warp.square_to_uniform_cone(u_direction, placed.cos_cutoff)
        d, pdf_second = placed.x * local.x + placed.y * local.y + placed.z * local.z, placed.density_w
        if self._projectors is not None:
            mask = self._is(index, active, PROJECTOR)
            projected, density = self._projectors.sample(index, u_direction, mask)
            d, pdf_second = dr.select(mask, projected, d), dr.select(mask, density, pdf_second)
        intensity = self._intensity(emitter, p, d, shared, active)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t, si.p, si.time, si.wavelengths = mi.Float(0), p, shared.time, shared.wavelengths
        return Emission(
            weight=dr.select(pdf_second == 0, 0, intensity / pdf_second),
            d=d,
            anchor=rays.free_anchor(p),
            cos=mi.Float(1),
            pdf_first=mi.Float(1),
            pdf_second=pdf_second,
            infinite=mi.Bool(False),
            delta=mi.Bool(True),
            beam=mi.Bool(False),
            index=index,
            si=si,
        )

    def _intensity(self, emitter, p, d, shared, active):
        """Intensity of an emitter at the point ``p`` into direction ``d``, by its own calls."""
        far = 1 + dr.max(dr.abs(p))  # keeps the probe's relative rounding small away from 0
        it = dr.zeros(mi.Interaction3f)
        it.p, it.time, it.wavelengths = p + d * far, shared.time, shared.wavelengths
        ds, weight = emitter.sample_direction(it, mi.Point2f(0.5), active)
        return weight * dr.square(ds.dist)

    def _emit_infinite(self, emitter, index, u_point, u_direction, shared, active) -> Emission:
        it = dr.zeros(mi.Interaction3f)
        it.p, it.time, it.wavelengths = mi.Point3f(self.disks.scene.center), shared.time, shared.wavelengths
        ds, weight = emitter.sample_direction(it, u_direction, active)
        directional = self._is(index, active, DIRECTIONAL)
        d = -ds.d
        p, pdf_second = self.disks.start(d, u_point)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi, si.p, si.time, si.wavelengths = d, p, shared.time, shared.wavelengths
        return Emission(
            weight=dr.select(ds.pdf == 0, 0, weight / pdf_second),
            d=d,
            anchor=rays.free_anchor(p),
            cos=mi.Float(1),
            pdf_first=dr.select(directional, 1, ds.pdf),
            pdf_second=pdf_second,
            infinite=mi.Bool(True),
            delta=directional,
            beam=mi.Bool(False),
            index=index,
            si=si,
        )

    def connection_density(self, emission: Emission, si, active):
        """Density of next-event estimation making y_0 of ``emission`` from its first hit ``si``.

        In the measure of ``pdf_first``, times the squared length of the edge (1 at infinity): on
        surfaces that is the solid-angle density at the hit times the geometric cosine at y_0.
        """
        # From infinity the lit vertex does not matter: both densities of y_0 are the same.
        density = mi.Float(emission.pdf_first)
        pmf = self._probability(emission.index, active)
        dist = dr.norm(emission.si.p - si.p)
        if self.kinds & set(POSITIONS):
            here = self._is(emission.index, active, *POSITIONS)
            density = dr.select(here, pmf * dr.square(dist), density)
        if AREA in self.kinds:
            here = self._is(emission.index, active, AREA)
            emitter = self._pointer(emission.index, here)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p, ds.n, ds.uv = emission.si.p, emission.anchor.n, emission.si.uv
            ds.time, ds.d, ds.dist, ds.emitter = emission.si.time, -emission.d, dist, emitter
            pdf = self.density_of_direction(emitter, emission.index, mi.Interaction3f(si), ds, here)
            density = dr.select(here, pmf * pdf * emission.cos, density)
        return dr.select(emission.beam, 0, density) if self.beams else density

    def direction_density(self, emission: Emission, p, d, active):
        """Density with which emission from y_0 goes along ``d`` to ``p``, in ``pdf_second``'s measure."""
        density = self._density_across(p, d)  # what is not at infinity is replaced
        if AREA in self.kinds:
            mask = self._is(emission.index, active, AREA)
            cos = dr.dot(emission.si.sh_frame.n, d)
            density = dr.select(mask, dr.maximum(cos, 0) * dr.inv_pi, density)
        if self.kinds & set(POSITIONS):
            mask = self._is(emission.index, active, *POSITIONS)
            density = dr.select(mask, self._direction_density(emission.index, d, mask), density)
        return density

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
        if self.kinds & set(POSITIONS):
            mask = self._is(emission.index, active, *POSITIONS)
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
            ps = self.upright(emitter.get_shape().sample_position(si.time, u, mask), index, mask)
            by_shape, its_weight = _sample_shape(emitter, ps, si, mask)
            ds, weight = dr.select(mask, by_shape, ds), dr.select(mask, its_weight, weight)
        if self._small_spheres:
            density = self._cone_density(index, si.p, active)
            narrow = density > 0
            ds.pdf = dr.select(narrow, density, ds.pdf)
            weight = dr.select(narrow, _radiance_over_density(emitter, ds, si, narrow), weight)
        if self._any_glass:
            own = active & (si.shape == emitter.get_shape()) & dr.gather(mi.Bool, self._glass, index, active)
            weight = dr.select(own, 0, weight)
        area = self._is(index, active, AREA)
        infinite = self._is(index, active, INFINITE, DIRECTIONAL)
        delta = self._is(index, active, *POSITIONS, DIRECTIONAL)
        n = dr.select(area, self.geometric_normal(ds, index, u, area), 0)
        if THIRD_PARTY in self.kinds:
            unknown = self._is(index, active, THIRD_PARTY)
            flags = emitter.flags()
            infinite |= unknown & mi.has_flag(flags, mi.EmitterFlags.Infinite)
            delta |= unknown & (mi.has_flag(flags, mi.EmitterFlags.Delta) | ds.delta)
            n = dr.select(unknown & mi.has_flag(flags, mi.EmitterFlags.Surface), ds.n, n)
        cos_shading = dr.dot(ds.n, -ds.d)
        cos = dr.abs(dr.dot(n, ds.d))
        # Mitsuba divides by the shading normal's cosine; the measure is the geometric one.
        to_geometric = dr.select(area & (cos != dr.abs(cos_shading)), dr.abs(cos_shading) / cos, 1)
        pdf = dr.select(delta, 1, ds.pdf * to_geometric) * pmf
        weight = dr.select(ds.pdf == 0, 0, weight / (to_geometric * pmf))
        weight = dr.select(dr.isfinite(ds.pdf), weight, dr.nan)  # no weight of strategies follows from it
        if HIT_ONLY in self.kinds:  # what Mitsuba samples of it has no radiance or the wrong one
            weight = dr.select(self._is(index, active, HIT_ONLY), 0, weight)
        ratio = mi.Float(0)
        if AREA in self.kinds:
            density = self.area_density(emitter, index, ds, n, area)
            emitted = pmf * density * dr.maximum(cos_shading, 0) * dr.inv_pi
            ratio = dr.select(area, emitted / (pdf * cos), ratio)
        if self.kinds & set(POSITIONS):
            here = self._is(index, active, *POSITIONS)
            emitted = self._direction_density(index, -ds.d, here) / dr.square(ds.dist)
            ratio = dr.select(here, emitted, ratio)
        ratio = dr.select(infinite, self._density_across(si.p, ds.d), ratio)
        if THIRD_PARTY in self.kinds:
            ratio = dr.select(unknown, 0, ratio)  # no light subpath starts there
        shape = emitter.get_shape() if self.on_shapes else dr.zeros(mi.ShapePtr)
        errors = self.shape_errors.at(shape, active) if self.on_shapes else None
        anchor = rays.sampled_anchor(ds.p, n, si.p, errors)
        met = rounding.met(shape) if self.shape_errors.small else None
        return Direct(weight, pdf, ds.d, anchor, infinite, delta, ratio, met)

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
        ds.time = mi.Float(si.time)
        if THIRD_PARTY in self.kinds:  # their own density has their own idea of a normal
            ds.n = dr.select(self._is(index, active, THIRD_PARTY), ds.n, mi.Normal3f(si.n))
        else:
            ds.n = mi.Normal3f(si.n)
        pdf = pmf * self.density_of_direction(emitter, index, it, ds, active)
        connect, first, second = mi.Float(pdf), mi.Float(pdf), self._density_across(previous, ds.d)
        on_surface = si.is_valid()
        if self.kinds & {AREA, THIRD_PARTY}:
            to_area = dr.abs(dr.dot(si.n, ds.d)) / dr.square(ds.dist)
            connect = dr.select(on_surface, pdf * to_area, connect)
        if AREA in self.kinds:
            density = self.area_density(emitter, index, si, si.n, active & on_surface)
            cos_second = dr.maximum(mi.Frame3f.cos_theta(si.wi), 0) * dr.inv_pi
            first = dr.select(on_surface, pmf * density, first)
            second = dr.select(on_surface, cos_second, second)
        if self.kinds & {THIRD_PARTY, HIT_ONLY}:
            first = dr.select(self._is(index, active, THIRD_PARTY, HIT_ONLY), 0, first)
            connect = dr.select(self._is(index, active, HIT_ONLY), 0, connect)
        return connect, first, second

    def area_density(self, emitter, index, at, n, active):
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


def _all_answer(pointers) -> bool:
    """Whether `sample_position` can be called on ``pointers``: a call visits every living emitter, those of
    other scenes too, and classes of the user's need not have it."""
    try:
        pointers.sample_position(mi.Float(0), mi.Point2f(0.5), mi.Bool(True))
    except RuntimeError:
        return False
    return True


def _sample_shape(emitter, ps, si, active):
    """Next-event estimation by the uniform point ``ps`` of the emitter's shape, in Mitsuba's conventions: the
    density is over the cosine with the shading normal, the weight is radiance over density."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.n, ds.uv, ds.time, ds.emitter = ps.p, ps.n, ps.uv, si.time, emitter
    between = ps.p - si.p
    ds.dist = dr.norm(between)
    ds.d = between / ds.dist
    cos = dr.abs(dr.dot(ds.n, ds.d))
    ds.pdf = dr.select(active & (cos > 0), ps.pdf * dr.square(ds.dist) / cos, 0)
    return ds, _radiance_over_density(emitter, ds, si, active)


def _radiance_over_density(emitter, ds, si, active):
    """Radiance of the point ``ds`` of an emitter on a surface towards ``si``, over the density ``ds.pdf``."""
    there = mi.SurfaceInteraction3f(ds, si.wavelengths)
    there.wi = there.to_local(-ds.d)
    return dr.select(ds.pdf == 0, 0, emitter.eval(there, active) / ds.pdf)
